"""r2h-v3: r2h-v2 with Pick. What Pick adds, what it leaves as it is, and the same bits however trials are asked."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from judge_twin import Again
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base.io.read import read_json
from r2h_batch.config import EvalConfig, ExecConfig, ExecutionError
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import metrics
from r2h_batch.judge import received as giving
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.ik import nearest_turns
from r2h_batch.judge.pick import picked
from r2h_batch.judge.reception import reception
from r2h_batch.judge.scores import verdict
from r2h_batch.methods import oracle, random
from r2h_batch.methods.from_table import BACKS, MOST_BACK_M, picked_grasps
from r2h_batch.observe import moments
from r2h_batch.observe.known import KnownMoments
from r2h_batch.report.statistics.thresholds import rethreshold
from r2h_batch.report.table import object_lines, render, table_of
from r2h_batch.runs.explain import MET, PICKS, RECEIVES, ROOMS, body_name, headline
from r2h_batch.runs.store import load_run
from r2h_batch.scene.robot import ee_pose
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate
from r2h_batch.sweep.results.rethreshold import render as render_points
from r2h_batch.trials.of_run import benchmark_of_run
from r2h_batch.types import CollidingPair
from r2h_batch.verdicts import (
    CRITERIA,
    EVERY,
    IN_ORDER,
    Outcome,
    PickReason,
    PlanReason,
    ReceiveReason,
)

KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))
N = 8
LINE = [
    "--benchmark",
    "r2h-v3",
    "--method",
    "random",
    "oracle",
    "--trials",
    "4",
    "--execute.sim",
    "none",
    "--save-paths",
]


@pytest.fixture(scope="module")
def v3():
    return load_benchmark("r2h-v3")


@pytest.fixture(scope="module")
def presents(v3):
    """r2h-v3 until the arm is at rest."""
    return v3.until("present")


@pytest.fixture(scope="module")
def judge(presents):
    return Evaluator(presents, KINEMATIC)


@pytest.fixture(scope="module")
def gives(v3):
    return Evaluator(v3, KINEMATIC)


@pytest.fixture(scope="module")
def whole(gives, asked):
    """The same answers by all criteria."""
    T_obj_ee, T_world_ee, trials = asked
    return gives.score(T_obj_ee, T_world_ee, gives.benchmark.trials_with_ids(trials.trial_id))


@pytest.fixture(scope="module")
def asked(judge):
    """Half of the answers are random, half of the oracle: each criterion passes and fails for some."""
    trials = judge.benchmark.trials(N)
    answers = (random.predict(trials, judge.scene, seed=1), oracle.predict(trials, judge.scene, evaluator=judge))
    T = (torch.cat([getattr(a, k) for a in answers]) for k in ("T_obj_ee", "T_world_ee"))
    twice = benchmark_rows(judge, trials)
    return (*T, twice)


def rows_of(run, method):
    """Trial id -> its columns of all files."""
    rows = {}
    for table in (run.trials(method), run.details(method), run.poses(method), run.paths(method)):
        for row in table.to_pylist():
            rows.setdefault(row["trial_id"], {}).update(row)
    return rows


def benchmark_rows(judge, trials):
    return judge.benchmark.trials_with_ids(torch.cat([trials.trial_id, trials.trial_id]))


@pytest.fixture(scope="module")
def scores(judge, asked):
    return judge.score(*asked)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("from_table")
    assert sweep([*LINE, "--out", str(where / "whole")]) == 0
    return where


@pytest.fixture(scope="module")
def others(folder):
    """The same sweep in shards on one thread, and one until the arm is at rest, beside it."""
    random_alone = [word for word in LINE if word != "oracle"]
    runs = (("parts", "5", [*LINE, "--threads", "1"]), ("presents", "0", [*random_alone, "--until", "present"]))
    for name, shard, line in each(runs):
        assert sweep([*line, "--shard-trials", shard, "--out", str(folder / name)]) == 0
    return folder


def test_only_a_benchmark_that_asks_for_pick_has_another_digest_and_another_column(v3):
    v2 = load_benchmark("r2h-v2")
    assert v2.asks == () and v3.asks == ("pick", "presented", "received")
    assert replace(v3, asks=()).digest != v3.digest
    assert replace(v2, asks=("pick",)).digest != v2.digest == replace(v2, asks=()).digest
    for asks in each((("plan",), ("pick", "pick"), ("",), ("received",), ("pick", "received", "taken"))):
        with pytest.raises(ValueError, match=r"asks is .* must be some of \('pick', "):
            replace(v2, asks=asks)
    others = Evaluator(v2, KINEMATIC)
    trials = v2.trials(1)
    answers = random.predict(trials, others.scene, seed=0)
    for stages in each(("pose", "all")):
        found = others.score(answers.T_obj_ee, answers.T_world_ee, trials, stages)
        assert found.criteria == CRITERIA and not hasattr(found, "pick") and "outcome/pick" not in found.scalars()


def test_pick_is_what_the_judge_of_grasps_says_of_the_moment(judge, asked, scores):
    T_obj_ee, _, trials = asked
    alone = picked(judge.scene, T_obj_ee, moments(judge.scene, trials), trials)
    column = scores.criteria.index("pick")
    assert torch.equal(scores.passed[:, column], alone.picked) and bool(scores.evaluated[:, column].all())
    assert torch.equal(scores.margin[:, column], alone.margin_m)
    for k, field in each(enumerate(("reason", "pair", "body"))):
        assert torch.equal(scores.pick[:, k], getattr(alone, field))
    assert scores.passed[:, column].any() and not scores.passed[:, column].all()
    assert scores.scalars()["outcome/pick"] > 0 and "pick" in scores.summary()
    assert {"passed_pick", "margin_pick_m"} <= set(scores.to_pandas())


def test_all_else_but_the_carry_is_as_without_pick(v3, judge, asked, scores):
    T_obj_ee, T_world_ee, trials = asked
    other = Evaluator(replace(v3, asks=()), KINEMATIC)
    before = other.score(T_obj_ee, T_world_ee, other.benchmark.trials_with_ids(trials.trial_id))
    same = [CRITERIA.index(name) for name in ("stability", "reach", "affordance")]
    for name in each(("passed", "evaluated", "margin_kind", "margin")):
        mine, theirs = (getattr(x, name)[:, same].float().nan_to_num(-9) for x in (scores, before))
        assert torch.equal(mine, theirs), name
    assert torch.equal(scores.success, (scores.passed | ~scores.evaluated).all(1)) and scores.success.any()
    assert torch.equal(scores.opening_m, before.opening_m)


def test_the_carry_begins_where_the_lift_of_the_accepted_branch_ends(judge, asked, scores):
    T_obj_ee, _, trials = asked
    rest = moments(judge.scene, trials)
    alone = picked(judge.scene, T_obj_ee, rest, trials)
    has = scores.path_len > 0
    assert has.any() and not (has & ~alone.picked).any()
    assert torch.equal(scores.path[has, 0], alone.lifted[has])
    lifted = (rest.double() @ T_obj_ee.double()).numpy()
    lifted[:, 2, 3] += 0.1
    for i in each(torch.nonzero(has)[:, 0].tolist()):
        at = ee_pose(judge.scene.robot, scores.path[i, 0].double().numpy())
        assert np.abs(at - lifted[i]).max() < 2e-5
        end = ee_pose(judge.scene.robot, scores.path[i, int(scores.path_len[i]) - 1].double().numpy())
        assert np.abs(end - asked[1][i].double().numpy()).max() < 1e-4  # as the pose is read: orthonormalised


def test_nothing_is_carried_that_was_not_picked(scores):
    lost = ~scores.passed[:, scores.criteria.index("pick")]
    assert lost.any() and not lost.all()
    plan, safe = (scores.criteria.index(name) for name in ("plan", "safe"))
    assert torch.equal(scores.evaluated[:, plan], ~lost) and not scores.evaluated[lost, safe].any()
    assert (scores.plan_reason[lost] == int(PlanReason.NOT_EVALUATED)).all()
    assert (scores.path_len[lost] == 0).all() and scores.t_plan_s[lost].isnan().all()
    assert scores.margin[lost, plan].isnan().all() and scores.t_plan_s[~lost].isfinite().all()


def test_goals_are_taken_at_the_turns_nearest_to_the_start(judge):
    robot, rng = judge.scene.robot, np.random.default_rng(4)
    lower, upper = (torch.tensor(np.array(x), dtype=torch.float64) for x in (robot.lower, robot.upper))
    start = torch.from_numpy(rng.uniform(lower, upper, (64, 6)).astype(np.float32))
    q = torch.from_numpy(rng.uniform(lower, upper, (64, 8, 6)).astype(np.float32))
    found = nearest_turns(q, start, robot).double()
    turns = (found - q.double()) / (2 * np.pi)
    assert (turns - turns.round()).abs().max() < 1e-6 and turns.round().abs().max() >= 1
    assert (found >= lower).all() and (found <= upper).all()
    for k in each((-1, 1)):  # no other turn within the limits is nearer
        other = found + 2 * np.pi * k
        allowed = (other >= lower + 1e-6) & (other <= upper - 1e-6)
        away, there = ((x - start.double()[:, None]).abs() for x in (found, other))
        assert (away <= there + 1e-5)[allowed].all() and allowed.any()


@pytest.mark.parametrize("most", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_other_code_judges_the_rows_with_their_carry_again(folder, most):
    """Of the oracle, rows that are carried; of random, the first one, and (slow) what is carried."""
    run = load_run(folder / "whole")
    judge, carried = Judge(run), 0
    for name in each(run.methods):
        rows = rows_of(run, name)
        trials = judge.trials(np.array(list(rows)))
        rest = moments(judge.evaluator.scene, trials)
        has_path = [k for k, row in enumerate(rows.values()) if row.get("q")][:most]
        kept = [0, *has_path[: most - 1]] if name == "random" else has_path
        for k, row in each([(k, list(rows.values())[k]) for k in kept]):
            scene, config = judge.evaluator.scene, judge.evaluator.config
            twin = Again(
                scene, config, trials[k : k + 1], row, row["T_obj_ee"], row["T_world_ee"], T_world_rest=rest[k]
            )
            wrong = [f for f in twin.findings() if not f.holds]
            assert not wrong, (name, row["trial_id"], wrong)
            carried += len(twin.q) > 0
    assert carried >= most


@pytest.mark.check
def test_the_first_failure_is_stability_then_pick_then_the_others():
    assert [entry.name for entry in IN_ORDER] == ["stability", "pick", *CRITERIA[1:], "presented", "received"]

    class Held:
        active = torch.ones(3, dtype=torch.bool)

        class grasp:
            width_m = opening_m = shift_m = torch.zeros(3)

    fine, bad = torch.ones(3), torch.tensor([-1.0, 1.0, 1.0])
    numbers = dict.fromkeys((e.name for e in EVERY), fine) | {
        "stability": bad,
        "pick": torch.tensor([-1.0, -1.0, 1.0]),
        "plan": torch.tensor([-1.0, -1.0, -1.0]),
    }
    found = verdict(EVERY, [metrics.Criterion(numbers[e.name], Held.active) for e in EVERY], Held, None)
    assert [Outcome(k).name for k in found["outcome"].tolist()] == ["STABILITY", "PICK", "PLAN"]


def test_rows_have_the_same_bits_alone_and_in_any_order(judge, asked, scores):
    T_obj_ee, T_world_ee, trials = asked
    order = torch.randperm(2 * N, generator=torch.Generator().manual_seed(3))
    again = judge.score(T_obj_ee[order], T_world_ee[order], trials[order])
    lone = [judge.score(T_obj_ee[i : i + 1], T_world_ee[i : i + 1], trials[i : i + 1]) for i in (0, N + 1)]
    for name in each(("outcome", "margin", "pick", "margin_kind", "borderline", "path", "t_exec_s")):
        mine = getattr(scores, name)
        assert torch.equal(getattr(again, name).nan_to_num(-9), mine[order].nan_to_num(-9)), name
        for i, row in zip((0, N + 1), lone, strict=True):
            assert torch.equal(getattr(row, name).nan_to_num(-9), mine[i : i + 1].nan_to_num(-9)), name


def test_received_is_what_reception_says_of_what_passed_all_else(scores, whole):
    rows = torch.nonzero(scores.success)[:, 0]
    n = len(CRITERIA) + 2
    for name in each(("passed", "evaluated", "margin", "margin_kind")):
        mine, theirs = (getattr(x, name)[:, :n].float().nan_to_num(-9) for x in (whole, scores))
        assert torch.equal(mine, theirs), name
    received = whole.criteria.index("received")
    found = reception(scores[rows], margins=True)
    assert torch.equal(whole.evaluated[:, received], scores.success)
    assert torch.equal(whole.passed[rows, received], found.received) and found.received.any()
    assert torch.equal(whole.receives[rows, 1], found.count[:, -1].int())
    assert torch.equal(whole.margin[rows, received], found.margin_m) and torch.equal(
        whole.receives[rows, 2], found.room.int()
    )
    assert torch.equal(found.margin_m > 0, found.received) and (found.margin_kind[found.received] > 0).all()
    assert torch.equal(whole.success, whole.evaluated[:, received] & whole.passed[:, received])
    lost = torch.nonzero(~scores.success)[:, 0]
    assert torch.equal(whole.outcome[lost], scores.outcome[lost]) and (whole.receives[lost] == -1).all()


def test_the_person_takes_the_object_where_all_other_criteria_judge_it(gives, asked, scores):
    rows = torch.nonzero(scores.success)[:, 0]
    T_obj_ee, T_world_ee, trials = (x[rows] for x in asked)
    found = reception(scores[rows])
    held = attach_object(gives.scene, T_obj_ee, T_world_ee, trials, gives.config)
    assert torch.equal(found.T_obj_ee, held.attached)
    assert torch.allclose(found.T_world_obj @ held.attached, T_world_ee, atol=1e-6)


def test_giving_does_not_depend_on_the_batch(gives, asked, whole):
    T_obj_ee, T_world_ee, trials = asked
    trials = gives.benchmark.trials_with_ids(trials.trial_id)
    order = torch.nonzero(whole.success)[:, 0].flip(0)[:3]
    again = gives.score(T_obj_ee[order], T_world_ee[order], trials[order])
    lone = gives.score(T_obj_ee[order[:1]], T_world_ee[order[:1]], trials[order[:1]])
    for name in each(("outcome", "success", "margin", "margin_kind", "receives", "borderline")):
        mine = getattr(whole, name)[order].nan_to_num(-9)
        assert torch.equal(getattr(again, name).nan_to_num(-9), mine), name
        assert torch.equal(getattr(lone, name).nan_to_num(-9), mine[:1]), name


def test_what_nobody_can_take_fails_received_and_says_why(gives, asked, whole, monkeypatch):
    T_obj_ee, T_world_ee, trials = asked
    rows = torch.nonzero(whole.success)[:, 0][:6]
    trials = gives.benchmark.trials_with_ids(trials.trial_id[rows])

    def nobody(scores, margins):
        """As reception, but the first five rows fail: at some steps, on the way, and without any known grasp."""
        found = reception(scores, margins=margins)
        count = found.count.clone()
        count[0], count[1, 3:], count[2, 5:], count[4] = 0, 0, 0, 0
        known = found.known.clone()
        known[4] = 0
        margin, room = found.margin_m.clone(), found.room.clone()
        margin[:5], room[:5] = torch.tensor([-0.01, -0.02, -torch.inf, -0.03, -torch.inf]), -1
        got = torch.tensor([False] * 5 + [True])
        return replace(found, count=count, known=known, received=got, margin_m=margin, room=room)

    monkeypatch.setattr(giving, "reception", nobody)
    found = gives.score(T_obj_ee[rows], T_world_ee[rows], trials)
    assert [Outcome(k).name for k in found.outcome.tolist()] == ["RECEIVED"] * 5 + ["SUCCESS"]
    assert found.success.tolist() == [False] * 5 + [True]
    words = [ReceiveReason(k).name for k in found.receives[:, 0].tolist()]
    assert words == ["ARM", "CLEAR", "HOLD", "WHOLE_WAY", "NO_GRASP", "OK"]
    received = found.criteria.index("received")
    assert found.margin[:5, received].tolist() == pytest.approx([-0.01, -0.02, -torch.inf, -0.03, -torch.inf])
    assert found.margin[5, received] > 0 and (found.receives[:5, 2] == -1).all() and found.receives[5, 2] >= 0


def test_a_benchmark_may_end_before_the_giving(v3, presents, scores):
    assert presents.asks == ("pick", "presented") and v3.until("received").asks == v3.asks
    assert v3.until("received").digest == v3.digest != presents.digest
    assert torch.equal(presents.trials(3).T_world_hand, v3.trials(3).T_world_hand)
    assert scores.criteria == (*CRITERIA, "pick", "presented") and not hasattr(scores, "receives")
    with pytest.raises(ValueError, match="r2h-v2 asks for none of these; until 'present' needs pick"):
        load_benchmark("r2h-v2").until("present")
    with pytest.raises(ValueError, match="until 'received' needs pick, received"):
        presents.until("received")
    with pytest.raises(ValueError, match="stage is 'given'"):
        v3.until("given")


def test_the_pose_stage_asks_nobody_to_take_anything(gives, asked):
    T_obj_ee, T_world_ee, trials = (x[-2:] for x in asked)
    pose = gives.score(T_obj_ee, T_world_ee, gives.benchmark.trials_with_ids(trials.trial_id), "pose")
    received = pose.criteria.index("received")
    assert pose.success.any() and not pose.evaluated[:, received:].any() and (pose.receives == -1).all()


@pytest.mark.whole(part="trials")
def test_a_sweep_until_present_says_so_and_lacks_the_columns(others):
    run, whole = load_run(others / "presents"), load_run(others / "whole")
    assert run.asks == ("pick", "presented") and whole.asks == ("pick", "presented", "received")
    names = set(run.trials(run.methods[0]).column_names)
    assert "passed_pick" in names and not {"passed_received", "received_reason"} & names
    assert benchmark_of_run(run.header, "x").asks == run.asks
    again = reevaluate(run, run.methods[0], 8, Judge(run))
    assert again.equal == 8 and not again.differences
    assert "F_recv" not in render(table_of(run), "md")


def test_tables_and_words_show_received(folder):
    run = load_run(folder / "whole")
    table = table_of(run)
    shown = render(table, "md").replace("\n  ", " ")
    assert "F_pres" in shown and "F_recv" in shown and "Safe, Presented, Received" in " ".join(shown.split())
    for fmt in each(("csv", "json", "latex")):
        assert "rec" in render(table, fmt)
    rows = [r for m in run.methods for r in run.trials(m).to_pylist()]
    for row in each([r for r in rows if r["passed_received"] is not None]):
        assert row["passed_received"] == (row["received_reason"] == "ok") == (row["outcome"] == "success")
        assert row["received_grasps"] > 0 or not row["passed_received"]
        assert (row["received_by"] in ROOMS) == row["passed_received"] == (row["margin_received_m"] > 0)
    blocked = {"outcome": "received", "received_reason": "whole_way"}
    assert headline(blocked) == "received fails: the hand's way from where it waits is blocked"
    assert set(RECEIVES) == {r.name.lower() for r in ReceiveReason} - {"ok"}


@pytest.mark.parametrize("name", ["whole", pytest.param("presents", marks=pytest.mark.whole(part="trials"))])
def test_thresholds_of_what_was_given_can_only_be_stricter(name, request):
    before = load_run(Path(__file__).parents[1] / "frozen" / "draft")  # of 0.3: it did not ask for Presented
    assert rethreshold(before, reach_radius_m=[0.05])
    with pytest.raises(ValueError, match="these rows allow stricter thresholds only, or sweep with --until present"):
        rethreshold(before, reach_radius_m=[0.9])
    run = load_run(request.getfixturevalue("folder" if name == "whole" else "others") / name)
    assert rethreshold(run, safe_margin_m=[0.02]) and rethreshold(run, reach_radius_m=[0.1])
    with pytest.raises(ValueError, match="Presented has it too"):
        rethreshold(run, reach_radius_m=[0.05])


def test_the_pose_stage_judges_pick_at_the_grasp_alone(judge):
    trials = judge.benchmark.trials(40)
    answers = random.predict(trials, judge.scene, seed=1)
    scores, pose = (judge.score(answers.T_obj_ee, answers.T_world_ee, trials, stages) for stages in ("all", "pose"))
    column = scores.criteria.index("pick")
    assert pose.criteria == scores.criteria
    assert not (scores.passed & ~pose.passed)[:, column].any()  # what fails there fails the benchmark too
    at_grasp = torch.tensor([int(r) for r in (PickReason.OUT_OF_REACH, PickReason.GRASP_COLLIDES)], dtype=torch.int32)
    fails = torch.isin(scores.pick[:, 0], at_grasp)
    assert fails.any() and (~scores.passed[:, column] & ~fails).any()
    assert torch.equal(pose.passed[:, column], ~fails) and pose.evaluated[:, column].all()
    assert torch.equal(pose.margin[fails, column], scores.margin[fails, column])
    assert torch.equal(pose.pick[fails], scores.pick[fails]) and (pose.pick[~fails, 0] == int(PickReason.OK)).all()
    passes = scores.passed[:, column]
    assert (pose.margin[passes, column] >= scores.margin[passes, column]).all()
    assert (pose.margin[~fails, column] > 0).all()


def test_a_row_that_is_no_pose_is_not_picked(judge, asked):
    T_obj_ee, T_world_ee, trials = (x[:2].clone() for x in asked)
    T_obj_ee[0, 0, 0] = torch.nan
    trials.T_world_hand[1, 0, 3] = torch.nan
    found = judge.score(T_obj_ee, T_world_ee, trials)
    assert found.outcome.tolist() == [Outcome.INVALID_INPUT] * 2 and not found.evaluated.any()
    assert found.pick[:, 0].tolist() == [PickReason.NOT_EVALUATED] * 2


def test_errors_of_execution_are_refused(v3):
    config = replace(KINEMATIC, execution_error=ExecutionError(camera_m=0.001))
    with pytest.raises(ValueError, match="execution_error changes poses, and r2h-v3 asks for Pick"):
        Evaluator(v3, config)


def test_moments_are_drawn_once_and_are_those_of_any_draw(judge, monkeypatch):
    trials, known = judge.benchmark.trials(3), KnownMoments(judge.scene)
    whole = moments(judge.scene, trials)
    assert torch.equal(known.of(trials[[4, 1]]), whole[[4, 1]])
    assert torch.equal(known.of(trials), whole)
    monkeypatch.setattr("r2h_batch.observe.known.moments", None)  # it is not asked again
    assert torch.equal(known.of(trials[[5, 0, 4]]), whole[[5, 0, 4]])
    moved = replace(trials[:1], T_world_hand=trials.T_world_hand[:1] + 1e-3)
    with pytest.raises(TypeError):  # another hand: another moment
        known.of(moved)


def test_grasps_of_the_oracle_are_picked_and_some_are_backed_out_of_the_table(judge):
    trials = judge.benchmark.trials(N)
    fan = oracle.Fan(trials, judge, 0)
    found = fan._picked
    rest, deepest = moments(judge.scene, trials), []
    for k in each(range(int(found.count.max()))):
        rows = np.flatnonzero(found.count > k)
        T = torch.from_numpy(found.T_obj_ee[rows, k].astype(np.float32))
        assert bool(picked(judge.scene, T, rest[rows], trials[rows]).picked.all())
    drawn = [fan._candidates(turn) for turn in range(64)]
    for i, k in each([(row, k) for row in range(2 * N) for k in range(found.count[row])]):
        T = found.T_obj_ee[i, k]
        own = [d[i] for d in drawn if np.array_equal(d[i][:3, :3], T[:3, :3])]
        back = [float((d[:3, 3] - T[:3, 3]) @ T[:3, 2]) for d in own]
        assert own and -1e-9 <= min(back, key=abs) <= MOST_BACK_M
        deepest.append(min(back, key=abs))
    assert 0 < sum(b > 1e-9 for b in deepest) < len(deepest) and BACKS > 1
    assert set(found.count.tolist()) - {0}


def test_trials_for_which_nothing_is_picked_keep_their_candidates(judge):
    trials = judge.benchmark.trials(1)
    below = np.tile(np.eye(4), (2, 1, 1))
    below[:, 2, 3] = 5.0  # out of reach
    rest = moments(judge.scene, trials)
    found = picked_grasps(judge.scene, trials, rest, lambda turn: below, np.array([3, 3]))
    assert found.count.tolist() == [0, 0]
    assert np.array_equal(found.chosen(np.array([1]), np.array([0.5]), below[:1]), below[:1])


@pytest.mark.whole(part="trials")
def test_a_sweep_has_the_same_rows_in_any_shards_and_on_one_thread(others):
    whole, parts = (load_run(others / name) for name in ("whole", "parts"))
    for method in each(whole.methods):
        assert whole.digest(method) == parts.digest(method)


def test_a_sweep_stores_pick(folder):
    whole = load_run(folder / "whole")
    asks = ["pick", "presented", "received"]
    assert list(whole.asks) == asks == read_json(folder / "whole" / "run.json", most=1 << 24)["asks"]
    for method in each(whole.methods):
        table = whole.trials(method)
        assert {"passed_pick", "margin_pick_m", "margin_kind_pick", "pick_reason", "pick_pair", "pick_part"} <= set(
            table.column_names
        )
        for row in table.to_pylist():
            assert (row["pick_reason"] == "ok") == row["passed_pick"]
            assert row["outcome"] != "pick" or not row["passed_pick"]
    again = reevaluate(whole, whole.methods[0], 8, Judge(whole))
    assert again.equal == 8 and not again.differences
    given = benchmark_of_run(whole.header, "x")
    assert given.digest == load_benchmark("r2h-v3").digest


@pytest.mark.whole(part="trials")
def test_a_sweep_goes_on_where_it_was(others, capsys):
    run = load_run(others / "parts")
    before = run.digest("oracle")
    next((others / "parts").rglob("*.parquet")).unlink()
    assert len(load_run(others / "parts").unfinished) == 1
    assert sweep([*LINE, "--shard-trials", "5", "--out", str(others / "parts")]) == 0
    assert load_run(others / "parts").digest("oracle") == before


def test_tables_and_words_show_pick(folder):
    run = load_run(folder / "whole")
    table = table_of(run)
    assert "F_pick" in render(table, "md") and "Stability, Pick, Plan" in render(table, "md").replace("\n  ", " ")
    for row in table.rows:
        if row.split != "Avg":
            assert row.rates["f_pick"].count == row.counts["pick"]
    assert any(row.counts["pick"] for row in table.rows)
    for fmt in each(("csv", "json", "latex")):
        assert "pick" in render(table, fmt)
    assert "F_pick" in object_lines(run)
    points = rethreshold(run, safe_margin_m=[0.0, 0.02])
    assert "F_pick" in render_points(points, run.methods)
    rows = [r for m in run.methods for r in run.trials(m).to_pylist() if r["outcome"] == "pick"]
    for row in each(rows):
        why, pair = PICKS[row["pick_reason"]], row["pick_pair"]
        if "something" in why and pair is not None:  # what is met is named in its place
            why = why.replace("something", MET[pair])
        assert headline(row).startswith(f"pick fails: {why}")
    met = next(r for r in rows if r["pick_pair"] == CollidingPair.TABLE.name.lower())
    assert "meets the table" in headline(met) or "the table is in the way" in headline(met)
    assert "something" not in headline(met) and re.search(rf"\({body_name(met['pick_part'])}\), by ", headline(met))
    assert set(PICKS) == {r.name.lower() for r in PickReason} - {"ok", "not_evaluated"}
