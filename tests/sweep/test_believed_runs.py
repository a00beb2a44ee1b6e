"""Runs of benchmarks that begin on the table, whose arms are planned in what cameras saw."""

import json
from collections import Counter

import pytest
import torch
from rounds import each
from sweep_command import in_process

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import UsageError
from r2h_batch.evaluate import Evaluator
from r2h_batch.observe.believed_world import ROOM_M
from r2h_batch.observe.sees import Sees
from r2h_batch.runs.store import load_run
from r2h_batch.scene.person import PIECES
from r2h_batch.view.captions import title
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.stored import Reader

pytestmark = pytest.mark.whole(part="sweep")
"""A film in tests/view/test_whole_film.py begins with such a run; what planning believes: tests/judge/test_followed.py."""
LINE = [
    "--benchmark",
    "r2h-v3",
    "--until",
    "present",
    "--method",
    "learned",
    "--trials",
    "3",
    "--execute.sim",
    "none",
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same method in one shard, and in shards of four with other chunks and threads; and one that was told the truth."""
    folder = tmp_path_factory.mktemp("believed")
    for name, more in (
        ("one", ["--sees", "cell-v1"]),
        ("five", ["--sees", "cell-v1", "--shard-trials", "4", "--chunk", "3", "--threads", "2"]),
        ("truth", []),
    ):
        done = in_process(*LINE, *more, "--out", folder / name)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """A method that does not know the person: its plans fail."""
    folder = tmp_path_factory.mktemp("failing") / "run"
    line = [word if word != "learned" else "handover-va" for word in LINE]
    assert in_process(*line, "--sees", "cell-v1", "--out", folder).returncode == 0
    return folder


def rows(folder):
    run = load_run(folder)
    return run.trials(run.methods[0]).sort_by("trial_id").drop_columns(["t_plan_s", "t_method_s"]).to_pylist()


def test_rows_are_the_same_in_shards_chunks_threads_and_when_a_run_goes_on(runs):
    a, b = (rows(runs / name) for name in ("one", "five"))
    assert len(a) == 6 and str(a) == str(b)
    lost = next((runs / "five" / "shards").rglob("*.parquet"))
    lost.unlink()
    assert load_run(runs / "five").unfinished
    line = [*LINE, "--sees", "cell-v1", "--shard-trials", "4", "--threads", "1", "--out", runs / "five"]
    assert in_process(*line).returncode == 0
    assert not load_run(runs / "five").unfinished and str(rows(runs / "five")) == str(a)


def test_a_run_says_that_its_arms_were_planned_by_what_was_seen(runs):
    header = json.loads((runs / "one" / "run.json").read_text())
    assert header["sees"]["plans"] == "seen"
    assert "sees" not in json.loads((runs / "truth" / "run.json").read_text())
    own = Sees.parse("cell-v1")
    assert "plans" not in own.on(load_benchmark("r2h-v2")).identity  # the object is in the gripper there
    assert Sees.planning(header) == own.on(load_benchmark("r2h-v3"))
    assert Sees.planning({"sees": own.identity}) is None and Sees.planning({}) is None
    assert own.on(load_benchmark("r2h-v3")).digest != own.digest


def test_every_row_is_judged_again_bit_for_bit_and_its_method_asked_again(runs, capsys):
    assert main(["results", "reevaluate", str(runs / "one"), "--rows", "6"]) == 0
    assert (
        "6 of 6 rows judged again" in (out := capsys.readouterr().out)
        and "none differs, 6 are equal bit for bit" in out
    )
    assert "asked again for the same trials" in out


def test_rows_judged_as_if_planning_knew_the_truth_differ(runs):
    """A header that leaves the belief out is found: the stored rows are others."""
    header = json.loads((runs / "one" / "run.json").read_text())
    del header["sees"]["plans"]
    assert Sees.planning(header) is None
    reader = Reader(runs / "one")
    stored = {r["trial_id"]: r for r in rows(runs / "one")}
    told = Evaluator(reader.benchmark, reader.evaluator.config)
    poses = reader.run.poses(reader.method()).sort_by("trial_id").to_pylist()
    T = [torch.tensor([p[k] for p in poses]).reshape(-1, 4, 4).float() for k in ("T_obj_ee", "T_world_ee")]
    ids = torch.tensor([p["trial_id"] for p in poses])
    scores = told.score(*T, reader.benchmark.trials_with_ids(ids))
    plan = scores.criteria.index("plan")
    margins = [stored[i]["margin_plan_m"] for i in ids.tolist()]
    assert any(
        m is not None and abs(m - x) > 1e-3 for m, x in zip(margins, scores.margin[:, plan].tolist(), strict=True)
    )


def test_a_picture_shows_the_legs_that_were_planned_in_the_belief(runs):
    reader = Reader(runs / "one")
    own = next(r["trial_id"] for r in rows(runs / "one") if r["passed_pick"] and r["passed_plan"])
    stored = reader.trial(own)
    trial = reader.trial_of(stored.row)
    poses = [torch.from_numpy(x)[None].float() for x in (stored.T_obj_ee, stored.T_world_ee)]
    found = reader.evaluator.picks(*poses, trial)
    picks, lifts = Drawing(stored).legs
    assert torch.allclose(torch.from_numpy(picks.stored.q[0]).float(), found.path[0, 0], atol=1e-6)
    assert torch.allclose(torch.from_numpy(lifts.stored.q[-1]).float(), found.lifted[0], atol=1e-6)
    assert not stored.note


def test_cameras_of_a_file_cannot_plan_again(runs):
    header = json.loads((runs / "one" / "run.json").read_text())
    header["sees"]["rig"] = "mine.toml"
    with pytest.raises(UsageError, match=r"mine\.toml"):
        Sees.planning(header)


def test_what_fails_is_said_in_words(runs, capsys):
    failed = [r for r in rows(runs / "one") if r["outcome"] in ("pick", "plan")]
    assert failed
    for row in failed[:2]:
        assert main(["why", str(runs / "one"), str(row["trial_id"])]) == 0
        out = capsys.readouterr().out
        assert f"{row['outcome']} fails" in out and "would pass" in out
    assert Counter(r["outcome"] for r in rows(runs / "truth")) != Counter(r["outcome"] for r in rows(runs / "one"))


def test_a_plan_that_fails_in_the_belief_is_drawn_there_with_the_pair_of_its_margin(failing):
    reader, persons = Reader(failing), 0
    failed = [r for r in rows(failing) if r["outcome"] == "plan" and r["plan_reason"] == "ik_in_collision"]
    for row in each(failed[:5]):
        stored = reader.trial(row["trial_id"])
        drawing = Drawing(stored)
        assert stored.believed and stored.object_model.name.startswith("seen_") and "believed" in title(drawing)
        assert stored.asked.clearance_m == pytest.approx(row["margin_plan_m"], abs=1e-6)
        near, witness = stored.asked.nearest, drawing.witness
        ends = {name.partition("/")[2] or name for name in witness.geoms}
        assert near.part in ends | {"object"} and witness.distance_m < ROOM_M + 1e-3
        if near.other in PIECES:
            persons += 1
            assert any(name.startswith("receiver/") for name in witness.geoms)
    assert persons


def test_a_motion_that_was_made_is_drawn_in_the_true_world(runs):
    reader = Reader(runs / "one")
    for row in each([r for r in rows(runs / "one") if r["plan_reason"] in ("ok", "motion_in_collision")][:3]):
        stored = reader.trial(row["trial_id"])
        assert not stored.believed and stored.object_model.name == row["object"]
