"""A stored row in words: the failing criterion, its margin, what decides it and what would have passed."""

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.config import PRESENTED_M
from r2h_batch.observe.rig import load_rig
from r2h_batch.report.reasons import MOST, reasons
from r2h_batch.report.text import MOST_LINES
from r2h_batch.runs import load_run
from r2h_batch.runs.explain import CALIBRATION_M, ROOMS, explained, headline, presented_words, reason_of
from r2h_batch.runs.files import RunError
from r2h_batch.verdicts import CRITERIA, Outcome, Room
from r2h_batch.view import explain

LIMITS = {"w_min_m": 0.002, "w_max_m": 0.085, "reach_radius_m": 0.1}
OUTCOMES = np.array([0, 0, 0, 0, 2, 2, 3, int(Outcome.INVALID_SIM), 0, 1, 4, 5])


def row(outcome, margin_m, **more):
    own = {"trial_id": 7, "outcome": outcome, f"margin_{outcome}_m": margin_m, f"margin_kind_{outcome}": "distance"}
    return own | more


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(
        tmp_path_factory.mktemp("explain") / "run", {"m": OUTCOMES, "n": OUTCOMES[::-1]}, 6, 6, shard_trials=5
    )


@pytest.mark.check
@pytest.mark.parametrize(
    ("stored", "why", "passes"),
    [
        (row("stability", -0.0071, width_m=0.0921), "92.1 mm of material between the pads", "2.0 to 85.0 mm of material"),
        (row("reach", -0.0342), "by 34.2 mm", "34.2 mm nearer to the ball's middle (radius 100 mm)"),
        (row("presented", -0.014, presented_margin_m=-0.014, presented_by="gripper", split="S0"),
         f"the gripper is {100 * PRESENTED_M['S0'] + 1.4:.1f} cm nearer to the palm than the object",
         "the object 14.0 mm nearer to the hand, or the gripper"),
        (row("presented", -0.03, presented_margin_m=-0.03, presented_by="sharp", split="S1"),
         f"a sharp part is {100 * PRESENTED_M['S1'] + 3:.1f} cm nearer to the palm than the receiver's part",
         "or a sharp part farther away"),
        (row("presented", -0.052, presented_margin_m=-0.052, presented_by="ball", split="S1"),
         "the receiver's part is 5.2 cm outside the ball", "the receiver's part 52.0 mm nearer to the ball's middle"),
        (row("affordance", -0.0031, margin_kind_affordance="bound"), "by at least 3.1 mm", "at least 3.1 mm farther"),
        (row("safe", -0.004, witness_safe_part="wrist_3_0", witness_time_s=3.21, witness_point_m=[0.1, 0.2, 0.3]),
         "wrist 3 meets the hand at 3.2 s", "the robot 4.0 mm farther from the hand then"),
        (row("safe", -0.004, witness_safe_part="wrist_3_0", witness_time_s=3.21, witness_point_m=None),
         "wrist 3 meets the receiver's arm, torso or head", "the robot 4.0 mm farther from the receiver's arm, torso or head"),
        (row("plan", -0.1453, plan_reason="ik_unreachable", plan_pair=None), "145.3 mm short", "145.3 mm from this one"),
        (row("plan", -0.005, plan_reason="ik_in_collision", plan_pair="hand"), "every posture", "overlaps by 5.0 mm"),
        (row("plan", -np.inf, plan_reason="no_path_in_budget", plan_pair=None), "no path was found", "a longer search"),
        (row("pick", -0.0009, pick_reason="grasp_collides", pick_pair="table", pick_part="right_inner_finger_1"),
         "fails: the open gripper meets the table at the grasp (right inner finger), by 0.9 mm", "a grasp that the table"),
        (row("pick", -0.002, pick_reason="lift_collides", pick_pair="object_table", pick_part=None),
         "fails: the table is in the way up (the object), by 2.0 mm", "a grasp that the table"),
        (row("received", -0.0032, received_reason="free", margin_kind_received="bound"),
         "fails: the hand would meet the closed gripper, by at least 3.2 mm", "leaves the hand a grasp"),
        (row("received", -0.0231, received_reason="way"),
         "fails: the hand's last 10 cm are blocked: 23.1 mm are left", "leaves the hand a grasp"),
        (row("received", -0.011, received_reason="clear", margin_kind_received="bound"),
         "fails: the arm, the torso or the head would meet the robot, or the head the object", "leaves the hand a grasp"),
        (row("received", -np.inf, received_reason="hold", margin_kind_received="cap"),
         "fails: the hand could not carry it", "leaves the hand a grasp"),
    ],
)  # fmt: skip
def test_every_failure_says_its_criterion_margin_and_what_would_have_passed(stored, why, passes):
    found = explained(stored, "mine", LIMITS, "r2h-batch view RUN --trial 7")
    assert found.criterion == stored["outcome"] and why in found.why and passes in found.passes
    margin = stored[f"margin_{found.criterion}_m"]
    assert found.margin == (margin if np.isfinite(margin) else None)
    text = str(found)
    if found.criterion in ("plan", "reach", "affordance", "received"):
        assert found.why.startswith(reason_of(stored))
    assert text.startswith("trial 7, mine") and "r2h-batch view RUN --trial 7" in text
    assert ("mm" in text.split("margin:")[1].splitlines()[0]) if np.isfinite(margin) else "margin:" not in text


def test_what_presented_is_about_is_said_of_every_row_and_the_limit_of_what_fails():
    told = {"split": "S1", "presented_by": "gripper"}
    assert presented_words({**told, "presented_margin_m": PRESENTED_M["S1"] + 0.03}) == (
        "the receiver's part is 3.0 cm nearer to the palm than the gripper"
    )
    assert presented_words({**told, "presented_margin_m": PRESENTED_M["S1"] - 0.01}).startswith(
        "the gripper is 1.0 cm nearer"
    )
    inside = {**told, "presented_by": "ball", "presented_margin_m": 0.08}
    assert presented_words(inside) == "the receiver's part is 8.0 cm inside the ball in front of the palm"
    assert presented_words({"split": "S1", "presented": True}) == ""  # a row of before
    failed = row("presented", -0.014, presented_margin_m=-0.014, presented_by="gripper", split="S0")
    assert explained(failed, "mine", LIMITS, "").witness.endswith("than the object; up to 7.5 cm is allowed")


def test_a_pick_that_meets_the_person_says_what_is_kept_from_the_head():
    failed = row("pick", -0.004, pick_reason="lift_collides", pick_pair="object_hand")
    assert explained(failed, "mine", LIMITS, "").why.startswith("pick fails: the person is in the way up (the object)")
    kept = explained(failed, "mine", LIMITS, "", head_m=0.1).why
    assert kept.startswith(
        "pick fails: the person or the 10 cm around the head is in the way up (the object), by 4.0 mm"
    )
    table = row("pick", -0.004, pick_reason="lift_collides", pick_pair="object_table")
    assert "head" not in explained(table, "mine", LIMITS, "", head_m=0.1).why


def test_a_pick_with_less_room_than_a_calibration_errs_by_is_named():
    passed = {"trial_id": 7, "outcome": "success", "passed_pick": True, "pick_pair": "table", "pick_part": "left_pad_0"}
    words = "the pick has 0.9 mm of room (robot and table, left pad), less than the 2 mm that a calibration may err by"
    assert explained({**passed, "margin_pick_m": 0.0009}, "m", LIMITS, "").witness == words
    assert explained({**passed, "margin_pick_m": 0.003}, "m", LIMITS, "").witness == ""
    assert load_rig("cell-v1").sensor.calibration_m == CALIBRATION_M


@pytest.mark.parametrize(
    ("room", "words"),
    [
        ("hand", "between hand and gripper"),
        ("body", "between the person's body and the robot, or the head and the object"),
        ("reach", "of the arm's reach"),
        ("joints", "of the joints' ranges"),
    ],
)
def test_a_success_says_where_the_person_has_least_room(room, words):
    stored = {"trial_id": 7, "outcome": "success", "t_exec_s": 4.0, "received_by": room, "margin_received_m": 0.0042}
    found = explained(stored, "mine", LIMITS, "")
    assert found.witness == f"4.2 mm {words} is the least room where the person takes it" and found.criterion == ""
    assert {r.name.lower() for r in Room} == set(ROOMS)
    assert explained({**stored, "received_by": None}, "mine", LIMITS, "").witness == ""
    near = {**stored, "passed_pick": True, "margin_pick_m": 0.0009}
    assert explained(near, "mine", LIMITS, "").witness.endswith(f"may err by; {found.witness}")


def test_what_is_kept_from_the_head_is_said_where_the_hand_is_not_meant():
    stored = row("safe", -0.004, witness_safe_part="wrist_3_0", witness_time_s=3.21, witness_point_m=None)
    words = "wrist 3 meets the receiver's arm or torso, or is within 10 cm of the head"
    assert headline(stored, head_m=0.1).endswith(words) and explained(stored, "m", LIMITS, "", head_m=0.1).why.endswith(
        words
    )


def test_the_pair_of_the_margin_is_named_where_it_was_computed():
    stored = row("plan", -0.005, plan_reason="ik_in_collision", plan_pair="hand")
    assert "(" not in headline(stored) and headline(stored, "object_hand").endswith("(object and hand)")


def test_a_run_explains_its_trials_and_its_repr_is_a_line(run):
    loaded = load_run(run.folder)
    assert "configuration" not in repr(loaded) and len(repr(loaded)) < 300
    assert "methods: m, n" in repr(loaded) and "12 trials (6 S0, 6 S1)" in repr(loaded)
    for trial, code in enumerate(OUTCOMES.tolist()):
        found = explain(loaded, trial, "m")
        wanted = CRITERIA[code - 1] if 0 < code < 6 else ""
        assert (found.criterion, found.trial, found.method) == (wanted, trial, "m")
        assert f"--trial {trial} --strips" in found.picture
    with pytest.raises(RunError, match="name one: m, n"):
        explain(loaded, 3)
    with pytest.raises(RunError, match="has no trial 99"):
        explain(loaded, 99, "m")
    with pytest.raises(RunError, match=f"has no trial {1 << 63}"):  # no column of 64 bits holds it
        explain(loaded, 1 << 63, "m")
    table = loaded.to_pandas()
    assert len(table) == 24 and set(table.method) == {"m", "n"} and table.margin_plan_m.notna().any()


def test_without_a_trial_every_reason_is_counted_with_a_trial_that_has_it(run, capsys):
    assert main(["why", str(run.folder)]) == 0
    said = capsys.readouterr().out
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in said.splitlines() if " fails: " in line]
    assert {row[0] for row in rows} == {"m", "n"} and len(said.splitlines()) <= MOST_LINES
    for name, why, n, share, trial in rows:
        same = [k for k in range(12) if reason_of(run.row(k, name)) == why]
        assert (int(n), float(share), int(trial)) == (len(same), round(100 * len(same) / 12, 1), same[0])
        assert main(["why", str(run.folder), trial, "--method", name]) == 0
        assert why.split(":")[0] in capsys.readouterr().out
    for name in ("m", "n"):
        assert sum(r["n"] for r in reasons(run, name)) == 12 and reasons(run, name)[0]["reason"] == "success"
    command = said.splitlines()[-1].removeprefix("One of them: r2h-batch ")
    assert main(command.split()) == 0 and "plan fails" in capsys.readouterr().out
    assert main(["why", str(run.folder), "--method", "m"]) == 0
    one = capsys.readouterr().out
    assert "| n " not in one and "| m " in one and "invalid sim" in one
    assert main(["why", str(run.folder), "--method", "k"]) == 2 and "no method 'k'" in capsys.readouterr().err


def test_many_reasons_are_cut_to_the_most_frequent_and_a_method_of_successes_has_no_command(tmp_path, capsys):
    run = write_run(tmp_path / "run", {f"m{k}": OUTCOMES for k in range(4)} | {"good": np.zeros(12, int)}, 6, 6)
    every = sum(len(reasons(run, method)) for method in run.methods)
    assert main(["why", str(run.folder)]) == 0
    said = capsys.readouterr().out
    assert len(said.splitlines()) <= MOST_LINES and f"{every - MOST} rarer reasons are left out" in said
    assert all(f"| {method} " in said for method in run.methods)
    assert main(["why", str(run.folder), "--method", "good"]) == 0
    assert "r2h-batch why" not in capsys.readouterr().out


def test_the_command_prints_every_method_or_one(run, capsys):
    assert main(["why", str(run.folder), "0"]) == 0
    both = capsys.readouterr().out
    assert both.count("trial 0, ") == 2
    assert main(["why", str(run.folder), "6", "--method", "m"]) == 0
    one = capsys.readouterr().out
    assert one.startswith("trial 6, m") and "criterion:  reach" in one and "would pass:" in one
    assert main(["why", str(run.folder), "99", "--method", "m"]) != 0 and "has no trial 99" in capsys.readouterr().err
