"""A user's object that a method cannot handle is named before work starts, and fails that method and object only."""

import pytest
import trimesh

from r2h_batch.methods import candidates
from r2h_batch.methods.grasps import NoGraspError
from r2h_batch.runs.store import load_run
from r2h_batch.scene.objects import load_objects
from r2h_batch.sweep.command import main
from r2h_batch.trials.holding import receiving


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two bodies in a folder; grasps and holds are a cup's (sampling takes seconds), 31 right hands and no left one."""
    monkeypatch.setenv("R2H_BATCH_CACHE", "off")
    (tmp_path / "meshes").mkdir()
    for name, radius in (("stick", 0.012), ("ball", 0.06)):
        mesh = trimesh.creation.capsule(height=0.1, radius=radius, count=[12, 12])
        mesh.faces = mesh.faces[name == "stick" :]  # the stick misses a face
        mesh.export(tmp_path / "meshes" / f"{name}.ply")
    (cup,) = load_objects(["cup"])
    found, held = candidates.candidates_of((cup,))[0].rows(slice(0, 10)), receiving.load_receiving([cup])
    hold = {k: getattr(held, k)[1:32].numpy() for k in receiving.FIELDS}
    monkeypatch.setattr(receiving, "sample_receiving", lambda model, **_: hold)
    monkeypatch.setattr(candidates, "sample_grasps", lambda model, **_: found)
    return tmp_path


def sweep(folder, *more):
    words = [
        "--objects",
        str(folder / "meshes"),
        "--splits",
        "S0",
        "--trials",
        "8",
        "--execute.sim",
        "none",
        "--no-poses",
    ]
    return main([*words, "--out", str(folder / "run"), *more])


def outcomes(folder, method):
    rows = load_run(folder / "run").trials(method).to_pylist()
    return {(r["object"], r["side"]): r["outcome"] == "invalid_input" for r in rows}


def test_what_was_found_is_enough_and_the_side_without_holds_fails_that_method_only(folder, capsys):
    with pytest.warns(UserWarning, match="31 of 32 right receiving grasps found"):
        assert sweep(folder, "--benchmark", "r2h-v1", "--method", "random", "contact") == 0
    said = capsys.readouterr().err
    assert said.count("contact: no left hand was found that can hold") == 2 and "random: no " not in said
    (guess,) = (line for line in said.splitlines() if "network of contacts learned from 16 categories" in line)
    assert (
        "contact: " in guess and "and ball, stick may be of none of them" in guess and "--predicted-contacts" in guess
    )
    ball, stick = load_run(folder / "run").header["objects"]
    assert stick["repair"]["steps"] == ["filled 1 holes"] and "repair" not in ball
    assert stick["repair"]["volume_given_m3"] is None and 0 <= stick["repair"]["moved_m"] < 1e-3
    names = load_run(folder / "run").methods
    contact = next(n for n in names if n.startswith("Contact"))
    assert set(outcomes(folder, "random").values()) == {False}
    found = outcomes(folder, contact)
    assert {side for (_, side), failed in found.items() if failed} == {"left"}
    assert {side for (_, side), failed in found.items() if not failed} == {"right"}


def test_an_object_too_wide_for_the_gripper_is_refused_in_one_line_unless_it_may_fail(folder, monkeypatch, capsys):
    found = candidates.sample_grasps

    def sample(model, **options):
        if model.name == "ball":
            raise NoGraspError("none")
        return found(model, **options)

    monkeypatch.setattr(candidates, "sample_grasps", sample)
    with pytest.warns(UserWarning, match="ball: no grasp found"):
        assert sweep(folder, "--benchmark", "r2h-v1", "--method", "random") == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if not line.endswith(" s")]  # a slow machine says "reading ball.ply, 5 s"
    assert len(said) == 1 and "sweep: ball: no grasp found; the gripper needs a part narrower" in said[0]
    assert not (folder / "run").exists()
    assert sweep(folder, "--benchmark", "r2h-v1", "--method", "random", "--allow-empty-candidates") == 0
    assert "random: no grasp candidate of ball" in capsys.readouterr().err
    assert {o: failed for (o, _), failed in outcomes(folder, "random").items()} == {"ball": True, "stick": False}
