"""`import region`: the contact network proposes where people take an object, in any frame of its file, and draws it."""

import numpy as np
import pytest
from needs import needs
from PIL import Image

from r2h_batch.commands.import_robot import region
from r2h_batch.scene.objects import build_object, load_objects

TURNS = {"as it lies": np.eye(3), "half a turn about z": np.diag([-1.0, -1.0, 1.0])}


@needs("gl")
@pytest.mark.parametrize("turn", TURNS)
def test_a_proposal_for_a_hammer_is_its_grip_however_the_file_lies_and_its_picture_shows_it(tmp_path, turn, capsys):
    (hammer,) = load_objects(["hammer"])
    mesh = hammer.mesh
    mesh.vertices = 1000 * mesh.vertices @ TURNS[turn].T  # in millimetres, as many files are
    mesh.export(tmp_path / "saw.obj")
    assert region(tmp_path / "saw.obj", out=tmp_path, scale=0.001) == 0
    assert f"{tmp_path / 'saw.obj'}:S1:{tmp_path / 'saw.region.npy'}" in capsys.readouterr().out
    found, area = np.load(tmp_path / "saw.region.npy"), hammer.mesh.area_faces
    both, either = found & hammer.receiver_face, found | hammer.receiver_face
    assert area[both].sum() > 0.6 * area[either].sum()
    model = build_object(
        tmp_path / "saw.obj", split="S1", scale=0.001, receiver=tmp_path / "saw.region.npy", pieces=False
    )
    assert (model.receiver_face == found).all()
    red, _, blue = np.moveaxis(np.asarray(Image.open(tmp_path / "saw.region.png").convert("RGB")).astype(int), 2, 0)
    assert (red - blue > 80).sum() > 2000 and (blue - red > 40).sum() > 2000
