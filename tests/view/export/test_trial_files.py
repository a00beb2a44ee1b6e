"""Trials written to files: what the manifest says is what is there, and what the library makes."""

import json

import numpy as np
import pytest
import torch
from hand_twins import hand_vertices, palms

from r2h_batch import load_benchmark
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import S0_NAMES, S1_NAMES, load_objects
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.view.export.trial_files import write_trials


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trials") / "made" / "here"
    digest = write_trials(folder, ["S0", "S1"], 12, benchmark=load_benchmark("r2h-v1"))
    return folder, digest


@pytest.mark.check
def test_written_files_hold_what_the_manifest_says(written):
    folder, digest = written
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["protocol"] == "r2h-v1" and manifest["digests"]["trials"] == digest
    assert digest == trials_digest(load_benchmark("r2h-v1").trials(12)) and digest in (folder / "README.md").read_text()
    names = {f"objects/{n}.npz" for n in (*S0_NAMES, *S1_NAMES)}
    assert {str(p.relative_to(folder)) for p in folder.rglob("*.npz")} == names | {"trials.npz", "hands.npz"}
    for file in ("trials.npz", "hands.npz", *sorted(names)):
        said = manifest["arrays"][file if file in manifest["arrays"] else "objects/NAME.npz"]
        with np.load(folder / file, allow_pickle=False) as data:
            assert set(data.files) == set(said)
            for key, about in said.items():
                assert data[key].dtype.name == about["dtype"] or data[key].dtype.kind == "U", (file, key)
                fits = (b is None or a == b for a, b in zip(data[key].shape, about["shape"], strict=True))
                assert all(fits), (file, key)
                assert len(about["meaning"]) > 3
    assert (folder / "README.md").read_text().count("| ") > 100


def test_written_trials_agree_with_the_library(written):
    folder, _ = written
    trials = load_benchmark("r2h-v1").trials(12)
    made, hands = np.load(folder / "trials.npz"), np.load(folder / "hands.npz")
    for key in ("trial_id", "object_index", "hand_index", "T_world_hand"):
        assert np.array_equal(made[key], getattr(trials, key).numpy())
    c, n = palms(trials)
    assert np.abs(made["ball_center"] - c).max() < 1e-6 and np.abs(made["palm_normal"] - n).max() < 1e-6
    assert made["object_name"].tolist()[10:14] == ["cup", "wineglass", "hammer", "pliers"]
    assert "screwdriver" in made["instruction"][16] and made["split"].tolist() == ["S0"] * 12 + ["S1"] * 12
    again = load_hand().pose(*(torch.from_numpy(made[k]) for k in ("pose", "shape", "side"))).joints.double()
    T = trials.T_world_hand.double()
    assert np.abs((again @ T[:, :3, :3].mT + T[:, None, :3, 3]).numpy() - made["joints"]).max() < 1e-6
    assert np.array_equal(hands["vertices"][made["hand_index"]], hand_vertices()[trials.hand_index.long()].float())
    for o in load_objects():
        data = np.load(folder / "objects" / f"{o.name}.npz")
        assert np.array_equal(data["vertices"], o.vertices) and data["occupancy"].sum() == o.occupancy.sum()
        assert data["grasp_T_obj_ee"].shape == (100, 4, 4) and data["grasp_part"].max() < len(data["part_names"])
        assert data["point_receiver"].any() == (o.split == "S1")
