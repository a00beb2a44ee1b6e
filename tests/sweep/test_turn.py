"""The turn test: the same trials with turned objects, whose rows are the same where a method knows no frame."""

import json
import re
import shutil

import numpy as np
import pytest

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.runs.store import load_run
from r2h_batch.scene.objects import S1_NAMES, object_digest
from r2h_batch.trials.edit import FRAMES, frame_of, in_frame

BY_X = """
import torch
from r2h_batch.methods.intent import predict as solved


def by_x(trials, scene, *, seed):
    '''Answers objects whose centre of mass has a positive x: it depends on how a mesh lies.'''
    ahead = torch.tensor([bool(o.com[0] > 0) for o in scene.objects])[trials.object_index.long()]
    grasps, handovers = (torch.eye(4).repeat(len(trials), 1, 1) for _ in range(2))
    handovers[:, :3, 3] += 5.0
    if ahead.any():
        answer = solved(trials[ahead], scene, seed=seed)
        grasps[ahead], handovers[ahead] = answer.T_obj_ee, answer.T_world_ee
    return grasps, handovers
"""


TURNED = (*FRAMES, "20,40,-60")
SOME = "".join(f"  - built_in: {category}_{k:02d}\n" for category in S1_NAMES for k in (0, 3))
"""Objects of r2h-v2: each turn makes the scene's tables anew, of every object."""
FEW = ("--trials", "28", "--splits", "S1", "--execute.sim", "none", "--quiet")


def command(*words):
    return main(list(map(str, words)))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run, and its turn test: the same sweep with each turn, into a folder beside it."""
    folder = tmp_path_factory.mktemp("turn")
    (folder / "own.py").write_text(BY_X)
    (folder / "some.yaml").write_text(f"protocol: r2h-v2\nobjects:\n{SOME}")
    line = ["--method", "intent", f"mine={folder / 'own.py'}:by_x", "--benchmark", folder / "some.yaml", *FEW]
    assert command("sweep", *line, "--out", folder / "run") == 0
    for turn in TURNED:
        assert command("sweep", *line, f"--turn={turn}", "--out", folder / "run-turned" / turn) == 0
    return folder


@pytest.mark.whole(part="sweep")
def test_a_method_that_depends_on_the_frame_moves_and_one_that_does_not_stays(run, capsys):
    capsys.readouterr()
    assert command("compare", run / "run", "--format", "json") == 0
    (compared,) = json.loads(capsys.readouterr().out)
    found = {t["method"].partition(" ")[0]: t for t in compared["turns"]}
    assert {name: t["marked"] for name, t in found.items()} == {"Intent-Handover": False, "mine": True}
    moves = {name: {m["turn"]: m["points"] for m in t["moves"]} for name, t in found.items()}
    names = load_run(run / "run").trials("mine")["object"].to_pylist()
    objects = load_benchmark(run / "some.yaml").objects
    ahead = {o.name: o.com[0] > 0 for o in objects}
    assert set(moves["mine"]) == set(TURNED) and any(ahead[n] for n in names)
    assert max(abs(points) for points in moves["mine"].values()) >= 20
    assert all(moves["Intent-Handover"][turn] == 0 for turn in FRAMES)
    assert command("report", run / "run") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "mine ^" in said and "Intent-Handover ^" not in said and "^ mine, S1: success" in said
    assert command("report", run / "run", "--format", "json") == 0
    table = json.loads(capsys.readouterr().out)
    rows = {row["method"].partition(" ")[0]: row for row in table["rows"]}
    most = max(moves["mine"].values(), key=abs)
    assert rows["mine"]["turn"] == most and rows["mine"]["turn_marked"] is True
    assert abs(rows["Intent-Handover"]["turn"]) < 10 and rows["Intent-Handover"]["turn_marked"] is False
    assert command("report", run / "run", "--format", "html", "--out", run / "page.html") == 0
    capsys.readouterr()
    page = (run / "page.html").read_text()
    moved = re.findall(r'<td class=l title="([^"]*)"[^>]*>([^<]*\^)</td>', page)
    assert [name.partition(" ")[0] for _, name in moved] == ["mine"] * 2  # overview and Table I
    assert all("mine, S1: success" in title for title, _ in moved)
    assert command("compare", run / "run") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "^ mine, S1: success" in said and "| mine ^" in said and "Intent-Handover ^" not in said
    for turn in TURNED:
        table = load_run(run / "run-turned" / turn).trials("mine")
        com = {o.name: (frame_of(turn) @ o.com)[0] > 0 for o in objects}
        solved = np.array(table["outcome"].to_pylist()) == "success"
        assert not solved[[not com[n] for n in table["object"].to_pylist()]].any() and solved.any()
    # a turned run is a run like any other: its rows are what the evaluator says
    assert command("results", "reevaluate", run / "run-turned" / "half", "--rows", 5, "--method", "intent") == 0
    capsys.readouterr()


@pytest.mark.whole(part="sweep")
def test_turned_runs_of_fewer_trials_are_paired_with_the_first_ones(run, capsys, tmp_path):
    shutil.copytree(run / "run", tmp_path / "run")
    few = ["--trials", "4", "--splits", "S1", "--execute.sim", "none", "--quiet", "--benchmark", run / "some.yaml"]
    for turn in FRAMES:
        out = tmp_path / "run-turned" / turn
        assert command("sweep", "--method", "intent", *few, "--turn", turn, "--out", out) == 0
    capsys.readouterr()
    assert command("compare", tmp_path / "run", "--format", "json") == 0
    (compared,) = json.loads(capsys.readouterr().out)
    assert [(t["method"].partition(" ")[0], t["n"]) for t in compared["turns"]] == [("Intent-Handover", 4)]


@pytest.mark.whole(part="sweep")
def test_a_turn_test_of_another_run_is_refused(run, capsys, tmp_path):
    few = ["--trials", "1", "--splits", "S1", "--execute.sim", "none", "--quiet", "--benchmark", run / "some.yaml"]
    assert command("sweep", "--method", "random", *few, "--seed", 3, "--out", tmp_path / "run") == 0
    shutil.copytree(run / "run-turned", tmp_path / "run-turned")
    capsys.readouterr()
    assert command("report", tmp_path / "run") == 2
    assert "no turn test of" in capsys.readouterr().err


@pytest.mark.parametrize("protocol", ["r2h-v1", "r2h-release"])
def test_turned_objects_have_the_same_trials(protocol):
    own = load_benchmark(protocol)
    few = own.trials(4, splits=["S0", "S1"])
    for turn, R in FRAMES.items():
        other = in_frame(own, turn)
        again = other.trials(4, splits=["S0", "S1"])
        assert np.array_equal(few.T_world_hand.numpy(), again.T_world_hand.numpy())
        assert np.isclose(np.linalg.det(R), 1) and object_digest(other.objects[3]) != object_digest(own.objects[3])


@pytest.mark.parametrize("word", ["halff", "1,2", "1,2,nan", "1,2,400", "a,b,c", "\u0661,2,3", "1_0,2,3"])
def test_an_invalid_turn_is_refused_before_anything_is_scored(tmp_path, capsys, word):
    assert command("sweep", "--method", "random", *FEW, "--turn", word, "--out", tmp_path / "run") == 2
    assert "give half, cycled, or degrees about x, y and z" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("word", ["0,0,0", "360,0,-360", "180,180,180"])
def test_angles_that_turn_nothing_are_refused(word):
    """The turn test counts them as a turn that no method depends on."""
    with pytest.raises(FileError, match=f"'{word}' turns nothing; give other degrees"):
        frame_of(word)


def test_angles_turn_about_fixed_axes_in_their_order():
    c, s = np.cos(np.pi / 6), 0.5
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(frame_of("90,0,30"), about_z @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), atol=1e-12)
