"""Faults, put into the code one at a time: does a quick test fail? `python tools/mutate.py [NAME ...] [--list]`.

Each mutation replaces one text in one file of a temporary copy of the repository and runs the tests that must fail there.
A row of the table says `killed` or `SURVIVED`. Exit codes: 0 all killed, 1 one survived, 2 the tests fail without any
mutation, or an old text is not there exactly once. Mutated kernels are compiled anew, which takes minutes of CPU time.

To renew a mutation after the code has moved, change its `file` and `old`; `tests/test_mutations.py` names it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("assets", "docs")
"""Folders without code that is mutated: the copy has links to them."""


class Mutation(NamedTuple):
    """One fault: in `file` the text `old`, found there exactly once, becomes `new`; one of `tests` must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


METRICS, VERDICT, ROWS = "r2h_batch/judge/metrics.py", "kernels/judge/verdict.py", "kernels/judge/rows.py"
T_METRICS, T_ROWS, T_MOTION = (
    "tests/judge/test_metrics.py",
    "tests/judge/test_rows.py",
    "tests/judge/motion/test_motion.py",
)
MOVING, ENV = "r2h_batch/closed_loop/moving.py", "r2h_batch/closed_loop/env.py"
T_ISO = "tests/closed_loop/test_env.py::test_times_too_near_and_shares_of_the_allowed_force_are_those_of_iso_ts_15066"
T_SEEN = (
    "tests/closed_loop/test_env.py::test_what_is_seen_is_late_noisy_and_sometimes_old_and_the_truth_only_on_request"
)
ANY_ARM, RECEPTION = "kernels/ik/any_arm.py", "kernels/judge/reception.py"
T_SEVEN = "tests/test_seven_joints.py::test_it_reaches_what_it_can_reach_and_says_only_what_is_proven"
T_PANDA = "tests/test_robots.py::test_a_redundant_arm_gets_eight_postures_a_target_for_few_steps"
T_COME = "tests/judge/test_reception.py::test_hands_come_the_first_way_on_which_samples_keep_off_the_gripper"
T_RELEASE = (
    "tests/judge/test_reception.py::test_the_gripper_lets_go_where_samples_of_opening_and_backing_off_keep_off_the_hand"
)
TAKEN = "r2h_batch/judge/reception.py"
T_COSTS = "tests/judge/test_reception.py::test_turn_and_travel_are_those_of_the_hand_from_how_it_waits"
T_WHOLE = "tests/judge/test_reception.py::test_whole_ways_are_free_where_every_sample_of_hand_and_arm_is"
T_VERDICT = f"{T_ROWS}::test_the_verdict_is_the_first_criterion_that_was_evaluated_and_failed"
T_GRASP = f"{T_ROWS}::test_the_grasp_is_that_of_close_gripper_and_squeezed_to_the_bit"
T_BALL = f"{T_ROWS}::test_the_attachment_and_the_receivers_ball_are_those_of_se3_to_the_bit"

MUTATIONS = (
    Mutation(
        "reach: sign of the margin",
        METRICS,
        "limit_m=e.config.thresholds.reach_radius_m, below=True",
        "limit_m=e.config.thresholds.reach_radius_m",
        (f"{T_METRICS}::test_reach_passes_up_to_the_balls_radius",),
    ),
    Mutation(
        "criteria: touching passes the other way round",
        VERDICT,
        "(margin == 0.0 and touching != 0)",
        "(margin == 0.0 and touching == 0)",
        (f"{T_METRICS}::test_touching_passes_where_the_paper_says_so",),
    ),
    Mutation(
        "safe: the safety margin is added",
        METRICS,
        "limit_m=e.config.thresholds.safe_margin_m",
        "limit_m=-e.config.thresholds.safe_margin_m",
        (f"{T_METRICS}::test_a_safety_margin_is_taken_off",),
    ),
    Mutation(
        "safe: the motion between samples is forgotten",
        "r2h_batch/judge/distance.py",
        "(distance_m - slack_m).clamp(min=-TOUCH_M)",
        "distance_m",
        (f"{T_MOTION}::test_safe_judges_the_recorded_motion_less_its_slack",),
    ),
    Mutation(
        "plan: a motion that does not settle passes",
        "r2h_batch/evaluate.py",
        "goal_reached = (planned.length > 0) & executed.settled",
        "goal_reached = planned.length > 0",
        (f"{T_MOTION}::test_a_motion_that_cannot_come_to_rest_in_time_is_run_to_the_limit_and_fails_plan",),
    ),
    Mutation(
        "verdict: the last failure decides",
        VERDICT,
        "elif not fine and outcome_inout[row] == wp.int8(0):",
        "elif not fine:",
        (T_VERDICT,),
    ),
    Mutation(
        "verdict: borderline on one side only",
        VERDICT,
        "if wp.abs(margin) < borderline:",
        "if margin > 0.0 and margin < borderline:",
        (T_VERDICT,),
    ),
    Mutation(
        "ball: world and object frame swapped",
        ROWS,
        "moved(inverse(product(T_world_ee_in[row], inverse(A))), c)",
        "moved(product(T_world_ee_in[row], inverse(A)), c)",
        (T_BALL,),
    ),
    Mutation(
        "attachment: closing moves the object the other way",
        ROWS,
        "p = wp.vec3(p[0] + y[0] * s, p[1] + y[1] * s, p[2] + y[2] * s)",
        "p = wp.vec3(p[0] - y[0] * s, p[1] - y[1] * s, p[2] - y[2] * s)",
        (T_GRASP,),
    ),
    Mutation(
        "stability: material of any thinness is held",
        ROWS,
        "return wp.min(w_max - width, width - w_min)",
        "return w_max - width",
        (T_GRASP,),
    ),
    Mutation(
        "palm: on the back of the left hand",
        "r2h_batch/scene/hand.py",
        "sign = torch.where(side == LEFT, -1.0, 1.0)",
        "sign = torch.where(side == LEFT, 1.0, 1.0)",
        ("tests/scene/test_hand.py::test_palm_normal_points_out_of_the_palm_on_both_sides",),
    ),
    Mutation(
        "presented: radians for degrees",
        "kernels/judge/presented.py",
        "angle = wp.degrees(angle_of(wp.length(wp.cross(a, b)), wp.dot(a, b)))",
        "angle = angle_of(wp.length(wp.cross(a, b)), wp.dot(a, b))",
        ("tests/judge/test_presented.py::test_angle_and_distance_are_those_of_the_region_and_s0_has_none",),
    ),
    Mutation(
        "presented: one of the two limits is enough",
        "kernels/judge/presented.py",
        "angle <= facing_deg and distance <= reach_radius",
        "angle <= facing_deg or distance <= reach_radius",
        ("tests/judge/test_presented.py::test_angle_and_distance_are_those_of_the_region_and_s0_has_none",),
    ),
    Mutation(
        "transforms: the inverse keeps the rotation",
        "r2h_batch/base/se3.py",
        "R_t = T[..., :3, :3].transpose(-1, -2)",
        "R_t = T[..., :3, :3]",
        ("tests/base/test_se3.py::test_products_inverses_and_points_agree_with_numpy",),
    ),
    Mutation(
        "time law: the last segment takes no time",
        "r2h_batch/judge/motion/time_law.py",
        "torch.where(slot < length[:, None] - 1, d, 0.0)",
        "torch.where(slot < length[:, None] - 2, d, 0.0)",
        (f"{T_MOTION}::test_servos_shortcuts_and_the_times_of_a_path_know_one_law",),
    ),
    Mutation(
        "distance: the radius of one body is missing",
        "kernels/geometry/gjk.py",
        "radii = a.radius + b.radius",
        "radii = a.radius",
        ("tests/kernels/test_gjk.py::test_it_agrees_with_mujoco_c",),
    ),
    Mutation(
        "collision: one pair of links is skipped",
        "r2h_batch/scene/tables.py",
        "for a, b in robot.self_pairs:",
        "for a, b in robot.self_pairs[:-1]:",
        ("tests/kernels/test_collision.py::test_verdicts_on_postures_agree_with_mujoco_c",),
    ),
    Mutation(
        "collision: an interval is free although its bodies may still meet",
        "kernels/plan/obstacles.py",
        "    return apart >= margin + travel",
        "    return apart >= margin",
        ("tests/kernels/test_collision.py::test_edges_certified_free_never_penetrate_when_sampled_densely",),
    ),
    Mutation(
        "trials: objects of the other split",
        "r2h_batch/base/schedule.py",
        "of_split = (ids & 1) == k",
        "of_split = (ids & 1) != k",
        ("tests/protocols/test_trials.py::test_objects_alternate_and_every_object_meets_both_hands_alike",),
    ),
    Mutation(
        "statistics: a criterion that was not evaluated fails",
        "r2h_batch/report/statistics/codes.py",
        "found[state[entry.name] == FAILED]",
        "found[state[entry.name] <= FAILED]",
        ("tests/report/statistics/test_breakdown.py::test_the_outcome_is_the_first_failure_and_never_a_success_that_was_not_fully_judged",),
    ),
    Mutation(
        "statistics: methods with equal rates share no ranks",
        "r2h_batch/report/statistics/paired.py",
        "probability[i, first : first + size] += count / size",
        "probability[i, first] += count",
        ("tests/report/statistics/test_compare.py::test_methods_with_equal_rates_share_their_ranks_evenly",),
    ),
    Mutation(
        "closed loop: every hand turns by 20 degrees",
        MOVING,
        "np.radians(motion.turn_deg)",
        "np.radians(20.0)",
        ("tests/closed_loop/test_moving.py::test_the_turn_of_a_hand_that_moves_has_the_root_mean_square_that_is_asked",),
    ),
    Mutation(
        "closed loop: a hand withdraws again and again",
        MOVING,
        " & self.way.begin[1].isinf()",
        "",
        ("tests/closed_loop/test_moving.py::test_a_hand_withdraws_once",),
    ),
    Mutation(
        "closed loop: a robot that stands counts as too near",
        ENV,
        's["ssm"][rows] += dt * inside',
        's["ssm"][rows] += dt * near',
        (T_ISO,),
    ),
    Mutation(
        "closed loop: half of the distance counts",
        ENV,
        "protective - passed.gap_m, 0.0",
        "protective - 0.5 * passed.gap_m, 0.0",
        (T_ISO,),
    ),
    Mutation(
        "closed loop: the whole arm's mass meets the hand",
        ENV,
        "2.0 / arm_kg",
        "1.0 / arm_kg",
        (T_ISO,),
    ),
    Mutation(
        "robots: pairs of links are left out however near they come",
        "r2h_batch/data/robot_pairs.py",
        "NEAR_M = 0.010",
        "NEAR_M = 0.0",
        (
            "tests/scene/test_robot_pairs.py::test_pairs_are_left_out_that_stay_10_mm_apart_with_two_joints_between_them_or_always_touch",
        ),
    ),
    Mutation(
        "robots: the pads of every gripper meet",
        "r2h_batch/scene/grasp_tables.py",
        "g.table_gap = robot.closed_gap_m",
        "g.table_gap = 0.0",
        (
            "tests/data/test_robots_as_sold.py::test_pads_of_a_loop_that_stop_apart_stand_where_the_crank_has_them_and_hold_nothing_thinner",
        ),
    ),
    Mutation(
        "export: the total time is that of execution",
        "r2h_batch/view/export/release.py",
        "else plan_s + exec_s",
        "else exec_s",
        (
            "tests/view/export/test_export_release.py::test_each_object_counts_the_same_in_the_exported_averages_and_a_total_is_the_sum_of_both_times",
        ),
    ),
    Mutation(
        "closed loop: an object 5 cm outside of the ball is within reach",
        ENV,
        "self._within_reach(near) >= 0",
        "self._within_reach(near) >= -0.05",
        ("tests/closed_loop/test_env.py::test_an_object_that_stays_2_cm_outside_of_the_ball_is_not_received",),
    ),
    Mutation(
        "closed loop: contact blames the other",
        ENV,
        "by_robot = robot < self._apart(",
        "by_robot = robot > self._apart(",
        ("tests/closed_loop/test_env.py::test_contacts_say_who_moved",),
    ),
    Mutation(
        "closed loop: an object that went 10 cm is taken",
        ENV,
        "> STAYED_M",
        "> 10 * STAYED_M",
        ("tests/closed_loop/test_env.py::test_an_object_that_goes_farther_than_1_cm_while_it_is_taken_is_not_received",),
    ),
    Mutation(
        "closed loop: what is seen is never late",
        ENV,
        "back = torch.minimum(self.k_of, torch.full_like(frame, late))",
        "back = torch.zeros_like(frame)",
        (T_SEEN,),
    ),
    Mutation(
        "closed loop: half of the drop-outs",
        ENV,
        "u < c.dropout",
        "u < 0.5 * c.dropout",
        (T_SEEN,),
    ),
    Mutation(
        "closed loop: collisions are not looked for",
        ENV,
        "rows[~self._meets_nothing(rows, self._since(self._postures, rows))]",
        "rows[:0]",
        ("tests/closed_loop/test_env.py::test_policies_that_follow_the_hand_keep_off_table_robot_and_object",),
    ),
    Mutation(
        "closed loop: held out for half of the time",
        ENV,
        ">= HELD_OUT_S - 1e-6",
        ">= 0.5 * HELD_OUT_S - 1e-6",
        ("tests/closed_loop/test_env.py::test_an_object_within_reach_is_received_after_it_was_held_out_for_a_tenth_of_a_second",),
    ),
    Mutation(
        "closed loop: half of the hand's way between two steps",
        "r2h_batch/closed_loop/relative.py",
        "way[i].travel(*times)",
        "0.5 * way[i].travel(*times)",
        ("tests/closed_loop/test_env.py::test_a_hand_that_comes_to_the_robot_and_goes_back_within_one_step_touches_it",),
    ),
    Mutation(
        "reception: straight ways end after 5 cm",
        RECEPTION,
        "if s >= WAY_M:",
        "if s >= 0.5 * WAY_M:",
        (T_COME,),
    ),
    Mutation(
        "reception: the release looks at narrower openings",
        RECEPTION,
        "float(k + 1) / 3.0",
        "float(k) / 3.0",
        (T_RELEASE,),
    ),
    Mutation(
        "reception: the gripper backs off forwards",
        RECEPTION,
        "wp.vec3(0.0, 0.0, 1.0), eps, begin)",
        "wp.vec3(0.0, 0.0, -1.0), eps, begin)",
        (T_RELEASE,),
    ),
    Mutation(
        "reception: the torso is a point when pairs are left out",
        RECEPTION,
        " - arm.half[k], 0.0)",
        ", 0.0)",
        ("tests/judge/test_reception.py::test_arms_that_only_the_torso_keeps_off_the_robot_are_as_fcl_says",),
    ),
    Mutation(
        "reception: the hand turns the other way on its way",
        RECEPTION,
        "-turn_left * angle",
        "turn_left * angle",
        (T_WHOLE,),
    ),
    Mutation(
        "reception: forearms go through the torso",
        RECEPTION,
        " and not crosses_torso(arm)",
        "",
        ("tests/judge/test_reception.py::test_no_forearm_goes_through_the_torso",),
    ),
    Mutation(
        "reception: the arm may meet the robot on its way",
        RECEPTION,
        "e = arm_distance(world, bodies, trial, links, origins, arm, FAR_M)",
        "e = float(FAR_M)",
        (T_WHOLE,),
    ),
    Mutation(
        "reception: no turn about the axis of revolution",
        RECEPTION,
        "if k % 2 == 1 and",
        "if k % 2 == 3 and",
        ("tests/judge/test_reception.py::test_every_second_grasp_of_an_object_of_revolution_is_turned_to_where_the_hand_turns_least",),
    ),
    Mutation(
        "reception: where the robot was asked to go, not where it went",
        TAKEN,
        "executed = executed_poses(error, inputs.T_obj_ee, inputs.T_world_ee, trials)",
        "executed = inputs.T_obj_ee, inputs.T_world_ee",
        ("tests/judge/test_execution_error.py::test_reception_is_asked_where_the_robot_brings_the_object",),
    ),
    Mutation(
        "reception: half of the hand's turn",
        TAKEN,
        "cosine.clamp(-1.0, 1.0).acos()",
        "0.5 * cosine.clamp(-1.0, 1.0).acos()",
        (T_COSTS,),
    ),
    Mutation(
        "reception: the wrist's way begins at the elbow",
        TAKEN,
        'batch.robot["receiver"][:, 2, :3]',
        'batch.robot["receiver"][:, 1, :3]',
        (T_COSTS,),
    ),
    Mutation(
        "export: objects with more trials count more",
        "r2h_batch/view/export/release.py",
        "float(np.mean([np.mean([v for v, o in pairs if o == name]) for name in objects]))",
        "float(np.mean([v for v, _ in pairs]))",
        (
            "tests/view/export/test_export_release.py::test_each_object_counts_the_same_in_the_exported_averages_and_a_total_is_the_sum_of_both_times",
        ),
    ),
    Mutation(
        "any arm: whole turns are other postures",
        ANY_ARM,
        "d - TWO_PI * wp.floor(d / TWO_PI + 0.5)",
        "d",
        (T_SEVEN,),
    ),
    Mutation(
        "any arm: unreachable from 90 % of the length on",
        ANY_ARM,
        "> chain.reach + position_tolerance_m",
        "> wp.float64(0.9) * chain.reach",
        (T_SEVEN,),
    ),
    Mutation(
        "any arm: the rotation does not count",
        ANY_ARM,
        " and off_rad <= rotation_tolerance_rad",
        "",
        (T_SEVEN, T_PANDA,),
    ),
    Mutation(
        "any arm: the position does not count",
        ANY_ARM,
        "last > 0 and off_m <= position_tolerance_m and",
        "last > 0 and",
        (T_SEVEN, T_PANDA,),
    ),
    Mutation(
        "any arm: compared with the last posture only",
        ANY_ARM,
        "new = new and far >= apart",
        "new = far >= apart",
        (T_SEVEN, T_PANDA,),
    ),
    Mutation(
        "any arm: a miss is reported beside postures",
        ANY_ARM,
        "    if found > 0:\n        residual_out",
        "    if found > 99:\n        residual_out",
        (T_SEVEN,),
    ),
)  # fmt: skip


def stale(root: Path = ROOT) -> list[str]:
    """The mutations whose old text is not in its file exactly once, or whose tests do not exist."""
    wrong = []
    for m in MUTATIONS:
        file = root / m.file
        count = file.read_text(encoding="utf-8").count(m.old) if file.is_file() else 0
        if count != 1:
            wrong.append(f"{m.name}: {m.file} has the old text {count} times")
        for test in m.tests:
            path, _, name = test.partition("::")
            if not (root / path).is_file() or f"def {name}(" not in (root / path).read_text(encoding="utf-8"):
                wrong.append(f"{m.name}: there is no test {test}")
    return wrong


def copy_tree(to: Path) -> None:
    """The tracked files in `to`; `r2h_batch` there has kernels and assets as an installed package has."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    for name in listed.splitlines():
        if name.split("/")[0] not in LINKED and (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name)
    for name in LINKED:
        (to / name).symlink_to(ROOT / name)
    for name in ("kernels", "assets"):
        (to / "r2h_batch" / name).symlink_to(to / name)


def run_tests(tree: Path, tests: tuple[str, ...]) -> int:
    """pytest's exit code: 0 all passed, 1 some failed; anything else is no answer."""
    line = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    env = {"MUJOCO_GL": "osmesa", **os.environ, "PYTHONPATH": str(tree)}
    return subprocess.run(line, cwd=tree, env=env, capture_output=True, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="parts of mutations' names; all unless given")
    parser.add_argument("--list", action="store_true", help="print the mutations and stop")
    parser.add_argument("--no-baseline", action="store_true", help="do not run the tests without a mutation first")
    options = parser.parse_args()
    chosen = [m for m in MUTATIONS if not options.names or any(n in m.name for n in options.names)]
    if options.list:
        print("\n".join(f"{m.name} ({m.file})" for m in chosen))
        return 0
    if wrong := stale():
        print("\n".join(wrong), file=sys.stderr)
        return 2
    survived = 0
    with tempfile.TemporaryDirectory(prefix="mutate-") as folder:
        tree = Path(folder)
        copy_tree(tree)
        tests = tuple(dict.fromkeys(test for m in chosen for test in m.tests))
        if not options.no_baseline and run_tests(tree, tests) != 0:
            print("the tests fail without a mutation; mend them first", file=sys.stderr)
            return 2
        print("| mutation | file | result | seconds |\n|---|---|---|--:|", flush=True)
        for m in chosen:
            start, file = time.monotonic(), tree / m.file
            text = file.read_text(encoding="utf-8")
            file.write_text(text.replace(m.old, m.new), encoding="utf-8")
            code = run_tests(tree, m.tests)
            file.write_text(text, encoding="utf-8")
            result = {0: "SURVIVED", 1: "killed"}.get(code, f"NO ANSWER (pytest {code})")
            survived += code != 1
            print(f"| {m.name} | {m.file} | {result} | {time.monotonic() - start:.0f} |", flush=True)
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
