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


T_FROM_TABLE = "tests/protocols/test_from_table.py"
T_CERTIFIED = "tests/protocols/test_certified.py"
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
T_SEEDS = "tests/closed_loop/test_env.py::test_each_row_plays_with_its_own_seed_as_where_all_rows_have_it"
ANY_ARM, RECEPTION = "kernels/ik/any_arm.py", "kernels/judge/reception.py"
T_SEVEN = "tests/test_seven_joints.py::test_it_reaches_what_it_can_reach_and_says_only_what_is_proven"
T_PANDA = "tests/test_robots.py::test_a_redundant_arm_gets_eight_postures_a_target_for_few_steps"
T_COME = "tests/judge/test_reception.py::test_hands_come_the_first_way_on_which_samples_keep_off_the_gripper"
T_RELEASE = (
    "tests/judge/test_reception.py::test_the_gripper_lets_go_where_samples_of_opening_and_backing_off_keep_off_the_hand"
)
TAKEN = "r2h_batch/judge/reception.py"
T_RAYS = "tests/observe/test_rays.py"
T_ROBUST = "tests/methods/test_robust.py"
T_BELIEVED = "tests/methods/test_believed.py"
SENSOR, T_SENSOR = "kernels/observe/sensor.py", "tests/observe/test_sensor.py"
T_APART, T_ESTIMATES, T_SEES = (
    "tests/observe/test_apart.py",
    "tests/observe/test_estimates.py",
    "tests/sweep/test_sees.py",
)
T_SPY = f"{T_APART}::test_a_spy_finds_no_pose_no_object_no_hand_and_no_name_of_the_truth_in_all_that_it_can_reach"
T_OWN_TRIALS = f"{T_APART}::test_answers_come_back_to_their_own_trials_whatever_the_order_and_the_batch"
T_SENSOR_TWIN = f"{T_SENSOR}::test_measured_depth_is_that_of_a_float64_twin"
SEEN, T_OBJECT = "r2h_batch/judge/object_errors.py", "tests/judge/test_object_errors.py"
T_COSTS = "tests/judge/test_reception.py::test_turn_and_travel_are_those_of_the_hand_from_how_it_waits"
T_WHOLE = "tests/judge/test_reception.py::test_whole_ways_are_free_where_every_sample_of_hand_and_arm_is"
T_VERDICT = f"{T_ROWS}::test_the_verdict_is_the_first_criterion_that_was_evaluated_and_failed"
T_GRASP = f"{T_ROWS}::test_the_grasp_is_that_of_close_gripper_and_squeezed_to_the_bit"
T_BALL = f"{T_ROWS}::test_the_attachment_and_the_receivers_ball_are_those_of_se3_to_the_bit"

GATE, T_GATE = "r2h_batch/methods/gate.py", "tests/methods/test_gate.py"
DRAWN, T_FAM = "r2h_batch/scene/families/draw.py", "tests/scene/test_families.py"
T_ONE_MATERIAL = f"{T_FAM}::test_mass_centre_and_inertia_of_one_material_are_those_of_the_surface"
T_NEW_INSTANCES = f"{T_FAM}::test_new_instances_are_drawn_by_what_the_flag_says"
FAMILY_OBJECTS = "r2h_batch/protocols/family_objects.py"
PEOPLE, T_PEOPLE = "r2h_batch/protocols/draw/people.py", "tests/protocols/draw/test_people.py"
RECEIVERS, WHEELCHAIR = "r2h_batch/protocols/draw/receivers.py", "r2h_batch/protocols/draw/wheelchair.py"
T_LAP = f"{T_PEOPLE}::test_the_lap_ends_at_the_knees_buttock_knee_length_from_the_back"
T_IN_WHEELCHAIRS = (
    f"{T_PEOPLE}::test_people_in_wheelchairs_sit_as_high_as_these_and_keep_hand_and_forearm_off_their_lap"
)
T_PAIRS, T_ENV = "tests/protocols/test_pairs.py", "tests/closed_loop/test_env.py"
T_FROZEN = f"{T_PAIRS}::test_a_frozen_benchmark_and_its_trials_never_change"
T_DIGEST = f"{T_PAIRS}::test_all_that_decides_is_in_the_digest_and_names_are_not"
T_SAME_NAME = (
    f"{T_PAIRS}::test_answers_to_an_edited_benchmark_of_the_same_name_are_refused_and_to_a_renamed_one_are_not"
)
T_KNOW = f"{T_PAIRS}::test_trials_know_their_benchmark_wherever_they_go"
T_OF_RUN = f"{T_PAIRS}::test_a_run_is_judged_by_the_benchmark_that_it_says_to_the_last_limit"
BENCHMARK, OF_RUN, STORED = (
    "r2h_batch/protocols/benchmark.py",
    "r2h_batch/protocols/of_run.py",
    "r2h_batch/report/compare/stored.py",
)
T_STORED = (
    "tests/report/statistics/test_baselines.py"
    "::test_stored_rows_of_another_preset_are_no_baselines_and_those_of_the_same_engine_come_first"
)
T_BASELINES = (
    "tests/report/statistics/test_baselines.py"
    "::test_a_benchmark_knows_its_stored_rows_by_digest_simulated_ones_of_the_default_preset"
)
GRASP_PHYSICS, T_PADS = "r2h_batch/judge/grasp_physics.py", "tests/judge/test_grasp_physics.py"
CAPACITY, T_CAPACITY = "r2h_batch/trials/holding/capacity.py", "tests/trials/holding/test_capacity.py"
T_LEAST_GRIP = (
    f"{T_CAPACITY}"
    "::test_a_load_is_carried_by_the_least_grip_and_a_margin_and_a_pinch_cannot_carry_a_moment_about_itself"
)
T_KEPT = f"{T_CAPACITY}::test_capacities_of_a_users_object_are_kept_for_its_hand_its_mesh_and_its_mass"
SHARD, T_SHARD = "r2h_batch/runs/shard.py", "tests/runs/test_shard.py"
PICK, LINE, T_PICK = "r2h_batch/judge/pick.py", "kernels/plan/line.py", "tests/judge/test_pick.py"
STRAIGHT_WAY = "r2h_batch/judge/straight_way.py"
T_FOLLOWED = f"{T_PICK}::test_a_line_is_followed_from_branch_to_nearest_branch_at_any_turn_within_limits"
T_OFF = f"{T_PICK}::test_a_branch_that_takes_the_gripper_off_the_line_is_not_followed"
T_CLOSING, FINGERS = "tests/judge/test_fingers_way.py", "r2h_batch/judge/fingers_way.py"
T_WAY_IN = f"{T_CLOSING}::test_the_clearance_on_the_way_in_is_the_least_of_four_hundred_places_on_it"
T_HEIGHTS = f"{T_CLOSING}::test_no_closing_finger_is_lower_on_a_part_of_its_way_than_is_said_nor_much_higher"
T_FLOOR = f"{T_CLOSING}::test_an_interval_whose_floor_is_high_enough_is_not_asked_again"
T_LEAST = f"{T_CLOSING}::test_the_least_of_a_way_is_found_to_the_tolerance_with_few_questions"
T_RESTING = f"{T_PICK}::test_an_object_that_rests_is_as_far_from_the_robot_as_mujoco_says"
T_SAMPLED = f"{T_PICK}::test_verdicts_and_margins_are_those_of_sampled_ways"
T_WAYS = f"{T_PICK}::test_the_path_ends_where_the_way_in_begins_and_ways_are_ten_centimetres"

T_HOSTILE, CLOSED = "tests/scene/test_hostile_meshes.py", "r2h_batch/scene/mesh_import/closed.py"
SOLID = "r2h_batch/scene/mesh_import/winding_solid.py"

T_NAMED = "tests/view/test_environment.py::test_the_name_is_registered_whichever_of_the_two_is_imported_first"

MUTATIONS = (
    Mutation(
        "trained on: names are not counted",
        "r2h_batch/sweep/jobs.py",
        "if len(names) > MOST_TRAINED_ON:",
        "if False:",
        ("tests/sweep/test_method_jobs.py::test_a_method_is_not_judged_on_what_it_was_trained_on",),
    ),
    Mutation(
        "seen: a pipe that a method made not wait is a traceback",
        "r2h_batch/observe/messages.py",
        'head = pipe.read(_LENGTH.size) or b""',
        "head = pipe.read(_LENGTH.size)",
        ("tests/observe/test_apart.py::test_a_pipe_that_no_longer_waits_is_one_that_has_ended",),
    ),
    Mutation(
        "view: a visitor that is no browser is a traceback",
        "r2h_batch/view/page.py",
        "quiet.propagate, quiet.disabled = False, True",
        "pass",
        ("tests/view/test_view.py::test_only_its_own_page_may_connect_to_the_viewer_and_odd_messages_do_not_end_it",),
    ),
    Mutation(
        "gymnasium: who imports it after us does not find the environment",
        "r2h_batch/base/imported.py",
        "sys.meta_path.insert(0, _Watch(name, call))",
        "pass",
        (T_NAMED,),
    ),
    Mutation(
        "mesh: rims are compared without a look at the clock",
        CLOSED,
        'budget.spend("comparing rims that may be two edges of one wall", i / len(rims))',
        "pass",
        (f"{T_HOSTILE}::test_rims_that_are_compared_with_each_other_end_within_the_time",),
    ),
    Mutation(
        "mesh: sheets at one edge are not counted",
        SOLID,
        "if count > MOST_BODIES:",
        "if False:",
        (f"{T_HOSTILE}::test_sheets_at_one_edge_are_refused_before_they_become_a_solid",),
    ),
    Mutation(
        "mesh: a long face's cuts are counted once",
        SOLID,
        "(4.0**cuts - 1)",
        "(0.0 * cuts)",
        (f"{T_HOSTILE}::test_long_faces_are_refused_before_their_pieces_take_the_memory",),
    ),
    Mutation(
        "mesh: the time of a mesh is that of one thread",
        "r2h_batch/scene/mesh_import/limits.py",
        "used, now = time.process_time() - self._start",
        "used, now = time.thread_time() - self._start",
        (f"{T_HOSTILE}::test_the_time_of_a_mesh_counts_every_thread_of_the_process",),
    ),
    Mutation(
        "the drivers weigh where MuJoCo's compiler puts them",
        GRASP_PHYSICS,
        "ipos=frames.pad if jaws else frames.pin / 2,",
        "",
        (f"{T_PADS}::test_parts_of_a_finger_weigh_where_they_are",),
    ),
    Mutation(
        "the pads weigh where MuJoCo's compiler puts them",
        GRASP_PHYSICS,
        "inertia=[LINK[1]] * 3, ipos=frames.pad,",
        "inertia=[LINK[1]] * 3,",
        (f"{T_PADS}::test_parts_of_a_finger_weigh_where_they_are",),
    ),
    Mutation(
        "the four-bar's ties are as soft as MuJoCo's default",
        GRASP_PHYSICS,
        '"solimp": TIE_IMPEDANCE}',
        '"solimp": (0.9, 0.95, 0.001, 0.5, 2.0)}',
        (f"{T_PADS}::test_pads_that_press_stay_upright",),
    ),
    Mutation(
        "pick: a joint keeps the turn of its branch",
        LINE,
        "TURN * wp.round((x[j] - q[j]) / TURN)",
        "TURN * wp.round(0.0 * (x[j] - q[j]) / TURN)",
        (T_FOLLOWED,),
    ),
    Mutation(
        "pick: a line goes on beyond the limits",
        LINE,
        "x[j] < world.lower[j] or x[j] > world.upper[j]",
        "x[j] < world.lower[j] - 9.0 or x[j] > world.upper[j] + 9.0",
        (T_FOLLOWED,),
    ),
    Mutation(
        "pick: the first branch is as good as the nearest",
        LINE,
        "if turn < best:",
        "if turn < best and found < 0:",
        (T_FOLLOWED,),
    ),
    Mutation(
        "pick: nobody looks how far the gripper leaves the line",
        LINE,
        "running = aside <= most_off",
        "running = aside <= 1.0e3 * most_off",
        (T_OFF,),
    ),
    Mutation(
        "pick: turning takes no point off the line",
        LINE,
        "0.5 * lever * wp.length(axis)",
        "0.0 * lever * wp.length(axis)",
        (T_OFF,),
    ),
    Mutation(
        "pick: what a point travels does not count",
        "r2h_batch/judge/least.py",
        "bound = found - travel(row, low, middle, high)",
        "bound = found",
        (T_LEAST,),
    ),
    Mutation(
        "pick: the middle of a way is all that is measured",
        "r2h_batch/judge/least.py",
        "row.repeat(2)\n        low, high = torch.cat([low, middle]), torch.cat([middle, high])",
        "row.repeat(1)\n        low, high = low, middle",
        (T_LEAST,),
    ),
    Mutation(
        "pick: the object rests turned back",
        "kernels/robot/resting.py",
        "wp.float64(T[i, j]) * wp.float64(x[j])",
        "wp.float64(T[j, i]) * wp.float64(x[j])",
        (T_RESTING,),
    ),
    Mutation(
        "pick: the gripper may not come near the object either",
        "r2h_batch/scene/resting.py",
        "first[-1] = first[-2]",
        "first[-1] = first[-1]",
        (T_RESTING,),
    ),
    Mutation(
        "pick: the gripper backs off forwards",
        STRAIGHT_WAY,
        "-= m[:, None] * T_world_ee[:, None, :3, 2]",
        "+= m[:, None] * T_world_ee[:, None, :3, 2]",
        (T_WAYS,),
    ),
    Mutation(
        "pick: the arm lifts along the gripper",
        STRAIGHT_WAY,
        "T[:, 1:, 2, 3] += m",
        "T[:, 1:, 1, 3] += m",
        (T_WAYS,),
    ),
    Mutation(
        "pick: the lift goes the way in",
        PICK,
        "self._lift(grasp, rows[row], ways.way_up[row, slot], depths=False)",
        "self._lift(grasp, rows[row], ways.way_in[row, slot], depths=False)",
        (f"{T_PICK}::test_a_person_above_makes_the_way_up_fail_where_the_way_in_is_free",),
    ),
    Mutation(
        "pick: the open gripper comes from within the object",
        "kernels/grasp/way_in.py",
        "T[k, 3] = T[k, 3] - back * T[k, 2]",
        "T[k, 3] = T[k, 3] + back * T[k, 2]",
        (T_WAY_IN,),
    ),
    Mutation(
        "pick: the way in is not halved",
        "kernels/grasp/way_in.py",
        "level, index = descend(level, index)",
        "level, index = next_interval(level, index)",
        (T_WAY_IN,),
    ),
    Mutation(
        "pick: all rows have the cap of the first",
        "kernels/grasp/way_in.py",
        "best = float(cap_in[trial])",
        "best = float(cap_in[0])",
        (T_WAY_IN,),
    ),
    Mutation(
        "pick: a finger bends nowhere on its way",
        FINGERS,
        "off = fingers_bend(scene)",
        "off = -fingers_bend(scene)",
        (T_HEIGHTS,),
    ),
    Mutation(
        "pick: boxes of fingers are flat",
        "kernels/grasp/lowest.py",
        "wp.abs(u[1]) * size[1] + wp.abs(u[2]) * size[2]",
        "wp.abs(u[1]) * size[1]",
        (T_HEIGHTS,),
    ),
    Mutation(
        "pick: the highest part of a way is its floor",
        FINGERS,
        "self.least_m[row], torch.inf).amin(1)",
        "self.least_m[row], -torch.inf).amax(1)",
        (T_HEIGHTS,),
    ),
    Mutation(
        "pick: a floor is enough",
        "r2h_batch/judge/least.py",
        "bound = torch.maximum(bound, floor(row, low, high))",
        "bound = torch.maximum(bound, floor(row, low, high) + 1.0)",
        (T_FLOOR,),
    ),
    Mutation(
        "pick: what enters the object has the bound of what is known",
        PICK,
        "grasp.margin_m + TOLERANCE_M, tried.found().clearance_m",
        "grasp.margin_m + TOLERANCE_M, 0.0 * tried.found().clearance_m",
        (T_SAMPLED,),
    ),
    Mutation(
        "pick: nobody waits",
        PICK,
        "return with_person(self.scene, poses, self.trials.receiver, hand=True)",
        "return poses",
        (f"{T_PICK}::test_a_person_in_the_way_makes_it_fail",),
    ),
    Mutation(
        "pick: the table gives way",
        PICK,
        "room < 0, room, torch.inf",
        "room < -1.0, room, torch.inf",
        (f"{T_PICK}::test_a_grasp_that_pushes_the_object_into_the_table_fails_by_what_the_pads_do_not_give",),
    ),
    Mutation(
        "pick: closing pushes the other way",
        PICK,
        "pad_squeeze_m - down",
        "pad_squeeze_m + down",
        (f"{T_PICK}::test_a_grasp_that_pushes_the_object_into_the_table_fails_by_what_the_pads_do_not_give",),
    ),
    Mutation(
        "pick: one free branch is enough for all",
        PICK,
        "up = walked & (tried.lift.clearance_m > 0)",
        "up = walked",
        (f"{T_PICK}::test_a_person_above_makes_the_way_up_fail_where_the_way_in_is_free",),
    ),
    Mutation(
        "pick: the gripper at the grasp meets nothing",
        PICK,
        "met = touching.clearance_m <= 0",
        "met = touching.clearance_m <= -9.0",
        (T_SAMPLED,),
    ),
    Mutation(
        "pick: the branch nearest to home is the only one",
        PICK,
        "(first, fresh & ~first)",
        "(first,)",
        (f"{T_PICK}::test_no_branch_of_a_grasp_that_fails_by_its_branches_is_free",),
    ),
    Mutation(
        "pick: waypoints of a way bunch up",
        STRAIGHT_WAY,
        "first + t * delta",
        "first + t * t * delta",
        (f"{T_PICK}::test_a_way_has_the_same_straight_lines_at_any_number_of_waypoints",),
    ),
    Mutation(
        "progress: what was kept from before counts as speed",
        "r2h_batch/base/io/progress.py",
        "speed = (done - free) / (now - begin)",
        "speed = done / (now - start)",
        ("tests/base/test_progress.py::test_the_speed_is_that_of_what_had_to_be_done",),
    ),
    Mutation(
        "pick: the way up is never off its line",
        STRAIGHT_WAY,
        'torch.maximum(way_in["off"], way_up["off"])',
        'way_in["off"]',
        (f"{T_PICK}::test_no_half_way_between_two_waypoints_is_farther_from_the_line_than_is_said",),
    ),
    Mutation(
        "pick: the fingers close nowhere",
        PICK,
        "return gap + s * (shut[row] - gap)",
        "return gap + 0.0 * s * (shut[row] - gap)",
        (T_SAMPLED,),
    ),
    Mutation(
        "the pendant counts in the frame of ROS 2",
        "r2h_batch/view/lab/frames.py",
        "np.diag([-1.0, -1.0, 1.0, 1.0])",
        "np.diag([1.0, 1.0, 1.0, 1.0])",
        ("tests/view/lab/test_lab.py::test_the_pendants_numbers_are_those_of_the_controllers_own_kinematics",),
    ),
    Mutation(
        "URScript's TCP stands at the flange",
        "r2h_batch/view/lab/paths.py",
        "T, step_s = robot.T_flange_ee,",
        "T, step_s = np.eye(4),",
        ("tests/view/lab/test_lab.py::test_ros_2_and_urscript_say_the_same_path",),
    ),
    Mutation(
        "a slower path keeps the run's velocities",
        "r2h_batch/view/lab/paths.py",
        "/ (slower * 2 * ahead)",
        "/ (2 * ahead)",
        ("tests/view/lab/test_lab.py::test_a_path_starts_at_home_ends_at_the_goal_and_keeps_to_the_speed",),
    ),
    Mutation(
        "sheets are fitted to the page",
        "r2h_batch/view/lab/sheets.py",
        "room / 2000",
        "room / 1900",
        ("tests/view/lab/test_lab.py::test_sheets_are_in_true_size",),
    ),
    Mutation(
        "a robot's outcomes are paired by their place",
        "r2h_batch/sweep/study/real.py",
        "tried = [(judged[i], row) for i, row in rows.items() if row[\"outcome\"]]",
        "tried = [(a, row) for a, row in zip(judged.values(), rows.values()) if row[\"outcome\"]]",
        ("tests/sweep/study/test_real.py::test_trials_are_paired_by_their_ids",),
    ),
    Mutation(
        "the rank violation forgets its sign",
        "r2h_batch/sweep/study/real.py",
        "(s[:, None] < s[None]) != (r[:, None] < r[None])",
        "(s[:, None] < s[None]) == (r[:, None] < r[None])",
        ("tests/sweep/study/test_real.py::test_the_rank_violation_is_simplers",),
    ),
    Mutation(
        "reach: sign of the margin",
        METRICS,
        "limit=e.config.thresholds.reach_radius_m, below=True",
        "limit=e.config.thresholds.reach_radius_m",
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
        "limit=e.config.thresholds.safe_margin_m",
        "limit=-e.config.thresholds.safe_margin_m",
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
        "goal_reached = (planned.reason == int(PlanReason.OK)) & executed.settled",
        "goal_reached = planned.reason == int(PlanReason.OK)",
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
        "methods that see: any length is read from their pipe",
        "r2h_batch/observe/messages.py",
        "    if size > most:",
        "    if False:",
        (
            "tests/observe/test_apart.py::"
            "test_what_a_method_writes_into_the_pipe_itself_is_said_in_one_line_and_its_process_ends",
        ),
    ),
    Mutation(
        "methods that see: any arrays are an answer",
        "r2h_batch/observe/apart.py",
        "        if wrong := _wrong(answer, len(seen)):",
        "        if wrong := '':",
        (
            "tests/observe/test_apart.py::"
            "test_what_a_method_writes_into_the_pipe_itself_is_said_in_one_line_and_its_process_ends",
        ),
    ),
    Mutation(
        "training: what torch says of a damaged checkpoint ends the command",
        "r2h_batch/learning/rank.py",
        "    except Exception as error:  # torch's readers",
        "    except ZeroDivisionError as error:  # torch's readers",
        ("tests/learning/test_rank.py::test_a_checkpoint_that_is_none_is_refused_in_one_line",),
    ),
    Mutation(
        "export: a file is called what a stranger's run says",
        "r2h_batch/view/export/release.py",
        "own = _ID.fullmatch(text) and times[text.casefold()] == 1",
        "own = text and times[text.casefold()] == 1",
        (
            "tests/view/export/test_export_release.py::"
            "test_a_text_that_is_no_id_of_the_release_gets_another_one_and_nothing_lies_beside_the_folder",
        ),
    ),
    Mutation(
        "user's code: an error must say what it is",
        "r2h_batch/base/user_code.py",
        "    except Exception:\n        return",
        "    except KeyError:\n        return",
        ("tests/sweep/test_answers.py::test_an_answer_that_cannot_be_scored_names_method_and_argument",),
    ),
    Mutation(
        "user's code: a function in the evaluator itself is nobody's",
        "r2h_batch/sweep/scoring.py",
        "if callable(getattr(type(evaluator), k, None))",
        "if False",
        ("tests/sweep/test_user_code.py::test_a_method_that_changes_what_judges_it_is_refused_in_one_line",),
    ),
    Mutation(
        "rigs: a field of tables in tables is shown whole",
        "r2h_batch/observe/rig.py",
        "describe_value(first['input'])",
        "repr(first['input'])",
        ("tests/observe/test_rays.py::test_a_rig_that_cannot_be_is_refused_in_one_line",),
    ),
    Mutation(
        "turns: degrees in digits of other scripts are read",
        "r2h_batch/protocols/edit.py",
        "parse_number(angle) for angle",
        "float(angle) for angle",
        ("tests/sweep/test_turn.py::test_an_invalid_turn_is_refused_before_anything_is_scored",),
    ),
    Mutation(
        "tables: what a method says of itself is markup",
        "r2h_batch/report/table.py",
        "plain(n) if n in table.trained else n",
        "n",
        ("tests/report/test_report.py::test_what_a_method_says_that_it_learned_from_is_text_in_markdown",),
    ),
    Mutation(
        "other trials: a seed draws the published ones",
        "r2h_batch/protocols/draw/rule.py",
        'seed = f"{self.name} {benchmark.seed}" if benchmark.seed else self.name',
        "seed = self.name",
        ("tests/protocols/test_seed.py::test_a_seed_draws_other_trials_of_the_same_rule_and_none_draws_the_published_ones",),
    ),
    Mutation(
        "bodies: a torso may be around the robot",
        "r2h_batch/protocols/trials_file.py",
        "near, near < FROM_BASE_M,",
        "near, near < 0.0,",
        ("tests/protocols/test_listed_bodies.py::test_a_body_that_nobody_has_is_refused_in_one_line",),
    ),
    Mutation(
        "all rows see with the first row's seed",
        ENV,
        "        for seed, own in rows_of_seeds(self._seen_seeds):",
        "        for seed, own in rows_of_seeds(self._seen_seeds[[0] * self.num_envs]):",
        (T_SEEDS,),
    ),
    Mutation(
        "all receivers move by the first row's seed",
        ENV,
        "self._drawn, self.motion, self._moved_seeds)",
        "self._drawn, self.motion, self._moved_seeds[[0] * self.num_envs])",
        (T_SEEDS,),
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
        "robots: home is the first posture, whatever overlaps",
        "r2h_batch/data/robot_home.py",
        "if not found:\n            return home",
        "if True:\n            return home",
        ("tests/data/test_robot_home.py::test_home_is_the_first_posture_without_overlap",),
    ),
    Mutation(
        "robots: the proposed turn points into the arm",
        "r2h_batch/data/robot_home.py",
        "turn: (-round(along(turn), 2), -along(turn, away[-1:]), turn)",
        "turn: (round(along(turn), 2), -along(turn, away[-1:]), turn)",
        (
            "tests/data/test_robot_home.py::test_a_flange_whose_z_points_across_is_refused_with_the_turn_and_yes_takes_it",
        ),
    ),
    Mutation(
        "robots: bodies of another mesh are taken from the cache",
        "r2h_batch/data/robot_bodies.py",
        "+ np.ascontiguousarray(array).tobytes())",
        ")",
        ("tests/data/test_robot_fitting.py::test_bodies_of_a_mesh_are_kept_by_its_digest",),
    ),
    Mutation(
        "robots: a triangle counts as held if one shape holds a corner of it",
        "r2h_batch/data/robot_shapes.py",
        "<= 0).all(1) for s in shapes]",
        "<= 0).any(1) for s in shapes]",
        (
            "tests/data/test_robot_fitting.py::test_what_sticks_out_of_hulls_is_measured_between_the_corners_of_triangles_too",
        ),
    ),
    Mutation(
        "robots: a module of a package may download",
        "r2h_batch/data/robot_packages.py",
        '"GIT_ALLOW_PROTOCOL": "none", ',
        "",
        ("tests/data/test_robot_packages.py::test_what_is_not_there_is_said_in_one_line",),
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
        "executed = executed_poses(evaluator.config, scene.objects, *asked, trials)",
        "executed = asked",
        ("tests/judge/test_execution_error.py::test_reception_is_asked_where_the_robot_brings_the_object",),
    ),
    Mutation(
        "object errors: the answer's frame moves the wrong way",
        SEEN,
        "se3.matmul(T_obj_seen, T_obj_ee.double())",
        "se3.matmul(se3.inverse(T_obj_seen), T_obj_ee.double())",
        (f"{T_OBJECT}::test_the_grasp_that_is_taken_is_that_of_a_twin_in_float64",),
    ),
    Mutation(
        "object errors: turns about the origin of the frame",
        SEEN,
        "np.stack([box_middle(o) for o in objects])",
        "np.stack([0 * box_middle(o) for o in objects])",
        (f"{T_OBJECT}::test_the_grasp_that_is_taken_is_that_of_a_twin_in_float64",),
    ),
    Mutation(
        "object errors: gross errors in every trial",
        SEEN,
        "hit < errors.gross",
        "hit < 1",
        (f"{T_OBJECT}::test_gross_errors_come_as_often_as_asked_about_each_axis_and_any_angle_of_the_symmetry",),
    ),
    Mutation(
        "object errors: drawn by the place in the batch",
        SEEN,
        "ids, key = trial_ids(trials.trial_id), rng",
        "ids, key = np.arange(len(trials)), rng",
        (f"{T_OBJECT}::test_a_trial_meets_the_same_error_alone_in_any_order_and_in_shards_and_another_with_another_seed",),
    ),
    Mutation(
        "object errors: the oracle knows them",
        "r2h_batch/prepared.py",
        "            object_errors=ObjectErrors(),\n",
        "",
        (f"{T_OBJECT}::test_a_method_that_searches_with_the_evaluator_believes_what_it_sees",),
    ),
    Mutation(
        "object errors: a sweep forgets its seed",
        "r2h_batch/sweep/request.py",
        "told = replace(config.object_errors, seed=options.seed)",
        "told = config.object_errors",
        (
            "tests/sweep/test_options.py::"
            "test_a_level_of_object_errors_is_two_settings_and_gross_errors_are_settings_of_their_own",
        ),
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
    Mutation(
        'stream: the workers share their items',
        'r2h_batch/learning/pairs.py',
        '(0, 1) if worker is None else (worker.id, worker.num_workers)',
        '(0, 1)',
        ('tests/learning/test_stream.py::test_items_are_the_same_by_number_for_any_number_of_workers_alone_and_anew',),
    ),
    Mutation(
        'stream: items share memory, which a worker moves while the next one reads it',
        'r2h_batch/learning/pairs.py',
        'return [trials[own] for own in rows]',
        'return [trials[int(own[0]) : int(own[-1]) + 1] for own in rows]',
        ('tests/learning/test_stream.py::test_an_items_tensors_have_memory_of_their_own',),
    ),
    Mutation(
        'stream: a run that goes on begins anew',
        'r2h_batch/learning/pairs.py',
        'at, end = self.first_item + start, None',
        'at, end = start, None',
        ('tests/learning/test_stream.py::test_items_are_the_same_by_number_for_any_number_of_workers_alone_and_anew',),
    ),
    Mutation(
        'stream: what is left out has the trials of what is learned',
        'r2h_batch/learning/pairs.py',
        'first_id=first_id + IDS_OF_SEED // 2, see=see',
        'first_id=first_id, see=see',
        ('tests/learning/test_stream.py::test_seeds_and_what_is_left_out_share_no_trial_and_no_object_with_what_is_learned',),
    ),
    Mutation(
        'stream: all seeds have the same trials',
        'r2h_batch/learning/pairs.py',
        'first_id += first_id % 2 + IDS_OF_SEED * seed',
        'first_id += first_id % 2',
        ('tests/learning/test_stream.py::test_seeds_and_what_is_left_out_share_no_trial_and_no_object_with_what_is_learned',),
    ),
    Mutation(
        'stream: margins that were not evaluated count',
        'r2h_batch/learning/pairs.py',
        'margin = torch.where(scores.evaluated, scores.margin, torch.nan)',
        'margin = scores.margin.nan_to_num()',
        ('tests/learning/test_stream.py::test_labels_and_margins_are_what_score_says_of_these_poses_and_trials',),
    ),
    Mutation(
        'stream: a network sees the true hand',
        'r2h_batch/methods/ranker/observe.py',
        'hand = predict_target(trials, scene, seed=seed, noise=see.noise, seen=seen)',
        'hand = predict_target(trials, scene, seed=seed, noise=PredictorNoise().scaled(0))',
        ('tests/learning/test_stream.py::test_what_is_seen_is_what_the_methods_are_given',),
    ),
    Mutation(
        'stream: ids of the benchmark are learned from',
        'r2h_batch/learning/pairs.py',
        'if first_id < 2 * MOST_TRIALS:',
        'if first_id < 0:',
        ('tests/learning/test_stream.py::test_wrong_arguments_are_refused_in_one_line',),
    ),
    Mutation(
        'stream: a tested object passes under another name',
        'r2h_batch/learning/instances.py',
        'model.vertices.tobytes() + model.faces.tobytes()',
        'model.vertices.tobytes() + model.name.encode()',
        ('tests/learning/test_stream.py::test_objects_that_methods_are_tested_with_are_refused_under_any_name_and_turned',),
    ),
    Mutation(
        'stream: a tested object passes turned',
        'r2h_batch/learning/instances.py',
        'own = model if model.turn is None else model.turn.own',
        'own = model',
        ('tests/learning/test_stream.py::test_objects_that_methods_are_tested_with_are_refused_under_any_name_and_turned',),
    ),
    Mutation(
        'stream: a category cannot be left out',
        'r2h_batch/learning/instances.py',
        'return fnmatchcase(one.name, pattern) or fnmatchcase(category(one) or "", pattern)',
        'return fnmatchcase(one.name, pattern)',
        ('tests/learning/test_stream.py::test_a_split_goes_by_category_name_or_pattern',),
    ),
    Mutation(
        'stream: poses bring the origin of the gripper',
        'r2h_batch/methods/ranker/proposals.py',
        'target - se3.rotate(R, held)',
        'target',
        ('tests/learning/test_stream.py::test_poses_bring_the_objects_middle_to_the_palm_from_behind',),
    ),
    Mutation(
        'regions: all are declared ones',
        'r2h_batch/learning/regions.py',
        'more = [m for o in objects for k in range(count) if (m := _with_region(o, k)) is not None]',
        "more = [replace(o, name=f'{o.name}_region{k}') for o in objects for k in range(count)]",
        ('tests/learning/test_stream.py::test_regions_at_random_are_new_objects_of_s1_with_the_grasps_of_the_old_ones',),
    ),
    Mutation(
        'stream: poses of one candidate are one pose',
        'r2h_batch/learning/pairs.py',
        'pick = torch.from_numpy(drawn).repeat_interleave(poses, dim=1)',
        'pick = torch.from_numpy(drawn).repeat(1, poses)',
        ('tests/learning/test_stream.py::test_pairs_of_one_candidate_share_it_and_have_poses_of_their_own',),
    ),
    Mutation(
        'mined: the worst pairs are kept',
        'r2h_batch/learning/mining.py',
        'best = good[:, :first].topk(self.pairs - late, dim=1).indices',
        'best = (-good[:, :first]).topk(self.pairs - late, dim=1).indices',
        ('tests/learning/test_rank.py::test_mined_pairs_are_the_best_of_each_round_and_are_judged',),
    ),
    Mutation(
        'search: the second round goes far',
        'r2h_batch/methods/ranker/search.py',
        '[NEAR_M] * 3 + [NEAR_RAD] * 3',
        '[10 * NEAR_M] * 3 + [NEAR_RAD] * 3',
        ('tests/learning/test_rank.py::test_mined_pairs_are_the_best_of_each_round_and_are_judged',),
    ),
    Mutation(
        "search: a pair is ranked with another candidate's cloud",
        'r2h_batch/methods/ranker/search.py',
        'found: Tensor = net(picked(code), picked(numbers), pair)[..., 0]',
        'found: Tensor = net(code[:, : pick.shape[1]], picked(numbers), pair)[..., 0]',
        ('tests/learning/test_rank.py::test_a_search_takes_what_the_network_likes_best_and_near_is_near',),
    ),
    Mutation(
        'rank: a resumed training draws other batches',
        'r2h_batch/learning/rank.py',
        'self.random.set_state(kept["random"])',
        'pass',
        ('tests/learning/test_rank.py::test_an_interrupted_training_goes_on_with_the_same_bits_and_another_recipe_is_refused',),
    ),
    Mutation(
        'rank: a folder of another recipe is gone on with',
        'r2h_batch/learning/rank.py',
        'if kept["recipe"] != plain(recipe, pairs):',
        'if False:',
        ('tests/learning/test_rank.py::test_an_interrupted_training_goes_on_with_the_same_bits_and_another_recipe_is_refused',),
    ),
    Mutation(
        'family: a mesh that is not watertight is taken',
        'r2h_batch/scene/families/answer.py',
        'if not mesh.is_watertight or not mesh.is_winding_consistent:',
        'if False:',
        ('tests/scene/test_families.py::test_what_a_generator_answers_wrongly_is_one_line_that_names_the_family',),
    ),
    Mutation(
        'family: a solid in metres is taken',
        'r2h_batch/scene/families/answer.py',
        'if not SMALLEST_MM <= (largest',
        'if not 0 <= (largest',
        ('tests/scene/test_families.py::test_what_a_generator_answers_wrongly_is_one_line_that_names_the_family',),
    ),
    Mutation(
        'family: a part without density is taken',
        'r2h_batch/scene/families/answer.py',
        'if name not in shape.density:',
        'if False:',
        ('tests/scene/test_families.py::test_what_a_generator_answers_wrongly_is_one_line_that_names_the_family',),
    ),
    Mutation(
        'family: any word says how it lies',
        'r2h_batch/scene/families/family.py',
        'if unknown := [w for w in rests if w not in TURNS] or ([] if rests else [""]):',
        'if unknown := [w for w in rests if w is None]:',
        ('tests/scene/test_families.py::test_wrong_words_of_a_family_are_one_line',),
    ),
    Mutation(
        'ranker: the criteria that a file of weights names are not read',
        'r2h_batch/methods/ranker/network.py',
        'criteria = _told(path).get(_CRITERIA, UNNAMED)',
        'criteria = UNNAMED',
        ('tests/learning/test_rank.py::test_a_file_of_weights_names_its_criteria_whatever_the_reader_judges_by',),
    ),
    Mutation(
        "ranker: contacts are of the cloud's first points",
        'r2h_batch/methods/ranker/observe.py',
        'contact[:, points].contiguous()',
        'contact[:, : len(points)].contiguous()',
        (
            'tests/methods/test_learned.py'
            '::test_a_small_cloud_says_of_its_points_what_the_whole_one_says',
        ),
    ),
    Mutation(
        "features: the thumb's side is the other one for left hands",
        'r2h_batch/methods/ranker/features.py',
        'thumb = torch.where((seen["side"] == _RIGHT)[:, None], -thumb, thumb)',
        'thumb = -thumb',
        ('tests/learning/test_rank.py::test_the_thumbs_side_is_one_axis_for_both_hands',),
    ),
    Mutation(
        "features: a hidden region is told by the fingers' distances",
        'r2h_batch/methods/ranker/features.py',
        'candidate[rows, ..., :marks], candidate[rows, ..., marks] = 10 * FAR_M, 0.0',
        'candidate[rows, ..., marks] = 0.0',
        ('tests/learning/test_rank.py::test_hidden_regions_give_the_features_of_an_object_without_one',),
    ),
    Mutation(
        "features: the grasp's frame is taken the wrong way round",
        'r2h_batch/methods/ranker/features.py',
        'R_world_obj = R @ grasp.mT',
        'R_world_obj = R @ grasp',
        ('tests/learning/test_rank.py::test_features_do_not_depend_on_where_the_object_frame_lies_nor_on_the_batch',),
    ),
    Mutation(
        'weights: NaN passes',
        'r2h_batch/methods/ranker/network.py',
        'if not all(bool(v.isfinite().all()) for v in found.values()):',
        'if False:',
        ('tests/learning/test_rank.py::test_wrong_weights_are_refused_in_one_line',),
    ),
    Mutation(
        'trained on: a method is judged on what it learned',
        'r2h_batch/sweep/jobs.py',
        'if fnmatchcase(model.name, pattern)\n        ]:',
        'if model.name == pattern and len(names) > 99\n        ]:',
        ('tests/sweep/test_method_jobs.py::test_a_method_is_not_judged_on_what_it_was_trained_on',),
    ),
    Mutation(
        "baselines: methods that came later are left out",
        "r2h_batch/report/compare/stored.py",
        "if folder.parent == SHIPPED and later.is_dir() else [folder]",
        "if False else [folder]",
        (
            "tests/report/statistics/test_baselines.py::test_baselines_of_the_default_benchmark_hold_the_learned_method_and_what_it_was_trained_on",
        ),
    ),
    Mutation(
        "join: runs that were joined before are one folder",
        "r2h_batch/runs/store.py",
        "parts = tuple(part for run in runs for part in run.runs)",
        "parts = tuple(runs)",
        (
            "tests/report/statistics/test_baselines.py::test_baselines_of_the_default_benchmark_hold_the_learned_method_and_what_it_was_trained_on",
        ),
    ),
    Mutation(
        "weights: another file of them is the same method",
        "r2h_batch/sweep/jobs.py",
        '{str(v): Path(v) for v in named if v}',
        "{}",
        (
            "tests/sweep/test_method_jobs.py::test_the_learned_method_says_what_it_learned_from_and_its_weights_are_part_of_what_it_is",
        ),
    ),
    Mutation(
        "weights: a foreign run's file is opened",
        "r2h_batch/sweep/jobs.py",
        "if own := given & {*METHODS[word].files}:",
        "if own := given & set():",
        (
            "tests/sweep/test_method_jobs.py::test_the_learned_method_says_what_it_learned_from_and_its_weights_are_part_of_what_it_is",
        ),
    ),
    Mutation(
        'trained on: tables do not say it',
        'r2h_batch/report/table.py',
        '            *self.trained,\n',
        '',
        ('tests/sweep/test_method_jobs.py::test_what_a_method_was_trained_on_stands_in_tables_and_comparisons',),
    ),
    Mutation(
        'labels: what was not evaluated fails',
        'r2h_batch/training/reward.py',
        'return torch.where(scores.evaluated, scores.passed.float(), torch.nan)',
        'return scores.passed.float()',
        ('tests/learning/test_stream.py::test_labels_say_nothing_of_a_criterion_that_was_not_evaluated',),
    ),
    Mutation(
        'inputs: one grasp goes with the first pose alone',
        'r2h_batch/judge/inputs.py',
        'T_world_ee.ndim == 4 and T_obj_ee.shape in ((n, 4, 4), (n, 1, 4, 4))',
        'T_world_ee.ndim == 4 and T_obj_ee.shape in ((n, 4, 4),)',
        ('tests/test_evaluate_inputs.py::test_a_trials_grasp_goes_with_all_of_its_poses',),
    ),
    Mutation(
        'instances: all of a category are kept as one',
        'r2h_batch/scene/families/kept.py',
        'f"instance {family.category} {series} {index} {standing} {_code()}"',
        'f"instance {family.category} {series} {standing} {_code()}"',
        ('tests/scene/test_families.py::test_an_instance_is_drawn_once_and_then_read_from_disk_with_all_that_it_had',),
    ),
    Mutation(
        "instances: other people's families are kept though their code may change",
        'r2h_batch/scene/families/kept.py',
        'return family.make.__module__.startswith(f"{__package__}.")',
        'return True',
        ('tests/scene/test_families.py::test_an_instance_of_a_family_of_other_code_is_drawn_each_time',),
    ),
    Mutation(
        'arm at home: one point along a limb is enough to be clear',
        'r2h_batch/protocols/draw/reachable_set.py',
        'free.reshape(-1, points.shape[1]).all(1)',
        'free.reshape(-1, points.shape[1]).any(1)',
        ('tests/protocols/test_families_protocol.py::test_the_protocol_is_frozen',),
    ),
    Mutation(
        'families: overlapping parts weigh twice',
        DRAWN,
        'share = volume / own',
        'share = 1.0',
        (T_ONE_MATERIAL,),
    ),
    Mutation(
        'families: the parallel axes pull the other way',
        DRAWN,
        '(c @ c) * np.eye(3) - np.outer(c, c)',
        'np.outer(c, c) - (c @ c) * np.eye(3)',
        (T_ONE_MATERIAL,),
    ),
    Mutation(
        'families: the inertia does not turn with the object',
        DRAWN,
        '1e-15 * (R @ inertia @ R.T)',
        '1e-15 * inertia',
        (T_ONE_MATERIAL,),
    ),
    Mutation(
        'families: the centre of mass stays where the parts were drawn',
        DRAWN,
        '(R @ com - middle) / 1000',
        '(com - middle) / 1000',
        (T_ONE_MATERIAL,),
    ),
    Mutation(
        'families: an instance may rest beside its support',
        DRAWN,
        '(weight > -1e-9).all(1)',
        '(weight > -1e-9).any(1)',
        (f"{T_FAM}::test_an_instance_rests_on_a_side_over_which_its_centre_of_mass_stands",),
    ),
    Mutation(
        'families: all series are one',
        'r2h_batch/scene/families/family.py',
        'f"r2h families {category} {series}"',
        'f"r2h families {category} 0"',
        (f"{T_FAM}::test_an_instance_is_a_function_of_category_series_and_number_alone",),
    ),
    Mutation(
        "families: the centre of mass is that of the surface",
        DRAWN,
        "        com=instance.com,\n",
        "",
        (T_NEW_INSTANCES,),
    ),
    Mutation(
        'families: every seed draws the same',
        FAMILY_OBJECTS,
        'FIRST_SERIES + seed',
        'FIRST_SERIES',
        (T_NEW_INSTANCES,),
    ),
    Mutation(
        "families: every split is S0",
        FAMILY_OBJECTS,
        "{f.split for f in _asked(text, OBJECTS)[0]}",
        '{"S0"}',
        (T_NEW_INSTANCES,),
    ),
    Mutation(
        'people: large hands for small people',
        PEOPLE,
        'kind="stable")]',
        'kind="stable")][::-1]',
        (f"{T_PEOPLE}::test_body_and_hand_are_of_one_person_of_the_table",),
    ),
    Mutation(
        'people: in wheelchairs some stand',
        PEOPLE,
        'seated = (u[1] < SEATED) | found.people.wheelchair',
        'seated = u[1] < SEATED',
        (T_IN_WHEELCHAIRS,),
    ),
    Mutation(
        'people: a trial that is drawn again changes its side',
        PEOPLE,
        'members = np.flatnonzero(side[todo] == s), found.members(s)',
        'members = np.flatnonzero(side[todo] == s), found.members(1 - s)',
        (f"{T_PEOPLE}::test_hands_keep_their_sides_when_a_trial_is_drawn_again",),
    ),
    Mutation(
        'people: the shoes count twice in a wheelchair',
        WHEELCHAIR,
        'POPLITEAL_M = SEAT_M - SHOES_M',
        'POPLITEAL_M = SEAT_M - 2 * SHOES_M',
        (T_IN_WHEELCHAIRS,),
    ),
    Mutation(
        'people: knees half a chest too far ahead',
        WHEELCHAIR,
        'KNEES * stature - 0.5 * chest_depth',
        'KNEES * stature',
        (T_LAP,),
    ),
    Mutation(
        'people: a forearm on the lap is as thin as a line',
        WHEELCHAIR,
        '(above < r)',
        '(above < 0.0)',
        (T_LAP,),
    ),
    Mutation(
        'people: an elbow may be in the chest',
        RECEIVERS,
        'clear &= ~(inside[:, 0] & inside[:, 1] & inside[:, 2])',
        'clear &= True',
        (T_FROZEN,),
    ),
    Mutation(
        "people: men's lengths for women",
        RECEIVERS,
        'np.where(woman, row[3 + k], row[k])',
        'np.where(woman, row[k], row[3 + k])',
        (T_FROZEN,),
    ),
    Mutation(
        'cache: entries with infinite numbers are made again',
        'r2h_batch/base/io/cache.py',
        'np.isnan(a).any()',
        'not np.isfinite(a).all()',
        ("tests/base/test_cache.py::test_an_entry_with_infinite_numbers_is_read_and_not_made_again",),
    ),
    Mutation(
        'closed loop: the true gap is the seen one',
        ENV,
        '"true_gap": self.gap.clone()',
        '"true_gap": gap.clone()',
        (f"{T_ENV}::test_the_true_gap_is_that_to_the_hand_as_it_is_whatever_is_seen",),
    ),
    Mutation(
        "closed loop: the gripper's first body is the arm's",
        ENV,
        'near.body >= len(names) - 1 - gripper',
        'near.body > len(names) - 1 - gripper',
        (f"{T_ENV}::test_a_hand_that_takes_may_come_to_every_body_of_the_gripper_and_to_none_of_the_arm",),
    ),
    Mutation(
        'capacity: kept without the hand',
        CAPACITY,
        '{object_digest(model)} {hand.digest} ',
        '{object_digest(model)} ',
        (T_KEPT,),
    ),
    Mutation(
        'capacity: kept without the object',
        CAPACITY,
        '{object_digest(model)} {hand.digest} ',
        '{hand.digest} ',
        (T_KEPT,),
    ),
    Mutation(
        'capacity: people grip no firmer than they must',
        CAPACITY,
        'SAFETY * least[carries]',
        'least[carries]',
        (T_LEAST_GRIP,),
    ),
    Mutation(
        "capacity: the load's own part is missing",
        CAPACITY,
        '(further + abs(load[carries]))',
        'further',
        (T_LEAST_GRIP,),
    ),
    Mutation(
        'capacity: moments in other units than they came in',
        CAPACITY,
        ' / total[carries, None] / MOMENT_SCALE',
        ' / total[carries, None]',
        (f"{T_CAPACITY}::test_a_pinch_of_two_points_has_its_closed_form",),
    ),
    Mutation(
        'capacity: gravity pulls the other way',
        CAPACITY,
        'GRAVITY).argmax(1)',
        'GRAVITY).argmin(1)',
        (f"{T_CAPACITY}::test_held_out_grasps_that_carry_the_object_withstand_more_than_its_weight",),
    ),
    Mutation(
        'capacity: a turned object has the axes of its own',
        CAPACITY,
        'np.asarray(o.turn.R_new_own)',
        'np.eye(3)',
        (f"{T_CAPACITY}::test_a_turned_object_has_the_capacities_of_its_own_frame",),
    ),
    Mutation(
        'shard: one of another method passes',
        SHARD,
        '"method": method, "first": shard.first, "last": shard.last}',
        '"first": shard.first, "last": shard.last}',
        (f"{T_SHARD}::test_a_shard_of_another_method_of_the_run_is_refused_under_this_ones_name",),
    ),
    Mutation(
        'shard: of two files of one the last is read',
        SHARD,
        'found.setdefault(number, path)',
        'found[number] = path',
        (f"{T_SHARD}::test_of_two_files_of_one_shard_the_one_with_the_smallest_name_counts",),
    ),
    Mutation(
        'shard: a digest in a name is not compared',
        SHARD,
        'if named is not None and found == named[2]:',
        'if named is not None:',
        ("tests/runs/test_verify.py::test_a_damaged_shard_is_named_verify_marks_it_and_only_it_is_written_again",),
    ),
    Mutation(
        'shard: a second writer gives its own name too',
        SHARD,
        'if _named(place, shard) is None:',
        'if True:',
        (f"{T_SHARD}::test_of_writers_at_the_same_moment_one_is_stored_and_nothing_of_the_others",),
    ),
    Mutation(
        'shard: rows of trials that it does not have are null',
        SHARD,
        'if len(trial_id) - place.null_count != len(table):',
        'if False:',
        (f"{T_SHARD}::test_rows_of_trials_that_a_shard_does_not_have_are_refused",),
    ),
    Mutation(
        'benchmark: the digest leaves out what is seen of the person',
        BENCHMARK,
        'if self.receiver != "hand":  #',
        'if False:  #',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: the digest leaves out the people',
        BENCHMARK,
        'f"people {self.people.digest}\\n"',
        'f"people\\n"',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: the digest leaves out where people stand',
        BENCHMARK,
        'f"robot {self.robot.digest} {self.persons}\\n"',
        'f"robot {self.robot.digest}\\n"',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: the digest leaves out table and home',
        BENCHMARK,
        'for part in (self.thresholds, self.workplace):',
        'for part in (self.thresholds,):',
        (T_DIGEST,),
    ),
    Mutation(
        "benchmark: the digest leaves out an object's roles",
        BENCHMARK,
        '"roles": None if o.roles is None else dict(o.roles)',
        '"roles": None',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: the digest leaves out where listed hands are',
        BENCHMARK,
        '"hand_index", "T_world_hand"):',
        '"hand_index"):',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: trials do not say whose they are',
        BENCHMARK,
        'trials.named(self.objects, benchmark=self.label)',
        'trials.named(self.objects)',
        (T_KNOW,),
    ),
    Mutation(
        'benchmark: the digest has the name in it',
        BENCHMARK,
        'f"{self.protocol}\\n{self.hand_set.digest}\\n"',
        'f"{self.protocol}\\n{self.hand_set.digest}\\n{self.name}\\n"',
        (T_DIGEST,),
    ),
    Mutation(
        'benchmark: an evaluator refuses by the name',
        'r2h_batch/judge/inputs.py',
        'if digest and digest != benchmark.digest:',
        'if digest and name != benchmark.name:',
        (T_SAME_NAME,),
    ),
    Mutation(
        'benchmark: a file of answers is refused by the name',
        'r2h_batch/trials/predictions.py',
        'if answers.benchmark and digest != own:',
        'if answers.benchmark and name != ours:',
        (T_SAME_NAME,),
    ),
    Mutation(
        'benchmark: people stand for another robot as for the UR5e',
        BENCHMARK,
        'placing = self.on(load_robot(DEFAULT_ROBOT), self.persons)',
        'placing = self',
        ("tests/test_robots.py::test_persons_stand_for_the_robot_or_as_for_the_ur5e",),
    ),
    Mutation(
        "of run: its benchmark's digest is not compared",
        OF_RUN,
        'if "benchmark" in digests:',
        'if False:',
        (T_OF_RUN,),
    ),
    Mutation(
        "gate: a pose that meets the estimated hand passes",
        GATE,
        "return reached & (distance > clearance_m), reached",
        "return reached, reached",
        (f"{T_GATE}::test_contacts_gate_leaves_out_poses_whose_gripper_meets_the_estimated_hand",),
    ),
    Mutation(
        "gate: where no pose passes, any is taken though the arm reaches some",
        GATE,
        "for more in (usable & reached, usable):",
        "for more in (usable, usable):",
        (f"{T_GATE}::test_a_gate_that_nothing_passes_gives_way_to_what_the_arm_reaches_and_then_to_all",),
    ),
    Mutation(
        "gate: Intent-Handover asks it with orientation axis alone",
        "r2h_batch/methods/intent.py",
        'if asked != "none" and not turns:',
        "if False:",
        (f"{T_GATE}::test_intents_gate_chooses_among_grasps_as_each_has_one_pose",),
    ),
    Mutation(
        "gate: Handover-VA goes on from a pose that passes",
        "r2h_batch/methods/handover_va.py",
        "todo = todo[~found]",
        "todo = todo[found]",
        ("tests/methods/test_baselines.py::test_va_goes_through_grasps_distances_and_turns_as_the_original_program_does",),
    ),
    Mutation(
        "gate: Contact-Handover's least cost is of all poses",
        "r2h_batch/methods/least_cost_pose.py",
        "best = least(cost, let_through(passes, reached, every), every)",
        "best = least(cost, every, every)",
        (f"{T_GATE}::test_contacts_gate_leaves_out_poses_whose_gripper_meets_the_estimated_hand",),
    ),
    Mutation(
        "gate: FC-Handover takes the first roll",
        GATE,
        "at = first_true(let_through(passes, reached, torch.ones_like(passes)))",
        "at = first_true(torch.ones_like(passes))",
        (f"{T_GATE}::test_fcs_roll_is_the_first_or_the_first_that_the_arm_reaches",),
    ),
    Mutation(
        "contacts: other-categories shows an object to the network of all sixteen",
        "r2h_batch/methods/predictors/contacts.py",
        'if contacts == "other-categories":',
        'if False:',
        ('tests/methods/predictors/test_contacts.py::test_an_object_can_be_shown_to_a_network_that_never_saw_its_category',),
    ),
    Mutation(
        "contacts: other-categories forgets the category",
        "r2h_batch/methods/predictors/contacts.py",
        'own.name if frozen else category_of(model)\n',
        'None\n',
        ('tests/methods/predictors/test_contacts.py::test_an_object_can_be_shown_to_a_network_that_never_saw_its_category',),
    ),
    Mutation(
        "scans: a category that a mesh names is forgotten",
        "r2h_batch/protocols/yaml_file.py",
        'more["category"] = entry.category',
        "pass",
        ("tests/test_scans.py::test_a_mesh_names_the_category_that_its_predictor_must_not_have_seen",),
    ),
    Mutation(
        "scans: rows of an older version are no column",
        "r2h_batch/report/table.py",
        '{**r.header, "configuration": complete(r.header["configuration"])}',
        "{**r.header}",
        ("tests/test_scans.py::test_the_stored_rows_are_a_column_of_table_one",),
    ),
    Mutation(
        "spreads: splits count by their categories",
        "bench/families.py",
        "more = [w**2 * sum(counts) / c for w, c in zip(weights, counts, strict=True)]",
        "more = [c / sum(counts) for w, c in zip(weights, counts, strict=True)]",
        ("tests/test_rates.py::test_rates_of_table_one_are_counted_in_the_rows_that_ship",),
    ),
    Mutation(
        "spreads: noise of the trials stays in the spread of instances",
        "bench/families.py",
        "max(inner - trial, 0.0)",
        "max(inner, 0.0)",
        ("tests/test_rates.py::test_rates_of_table_one_are_counted_in_the_rows_that_ship",),
    ),
    Mutation(
        "unseen: the trees of the next group answer",
        "r2h_batch/methods/predictors/unseen.py",
        'return FromShape(stored[str(k)])',
        'return FromShape(stored[str((k + 1) % 4)])',
        ('tests/methods/predictors/test_unseen.py::test_the_logged_areas_are_those_of_the_stored_trees',),
    ),
    Mutation(
        "unseen: a tree turns right where its threshold is met",
        "r2h_batch/methods/predictors/unseen.py",
        '<= threshold[node]',
        '>= threshold[node]',
        ('tests/methods/predictors/test_unseen.py::test_trees_answer_as_scikit_learn_does_and_merged_ones_with_the_mean',),
    ),
    Mutation(
        "unseen: merged trees answer with the sum",
        "r2h_batch/methods/predictors/unseen.py",
        'found["value"] = found["value"] / len(sets)',
        'found["value"] = found["value"] / 1',
        ('tests/methods/predictors/test_unseen.py::test_trees_answer_as_scikit_learn_does_and_merged_ones_with_the_mean',),
    ),
    Mutation(
        "unseen: voxels beside the solid have no answer",
        "r2h_batch/methods/predictors/unseen.py",
        'torch.where(full, found, around)',
        'torch.where(full, found, 0.0 * around)',
        ('tests/methods/predictors/test_unseen.py::test_an_empty_grid_and_voxels_beside_the_solid_have_answers',),
    ),
    Mutation(
        "shape features: depth leaves an axis out",
        "r2h_batch/methods/predictors/shape_features.py",
        'for axis in range(3):',
        'for axis in range(2):',
        ('tests/methods/predictors/test_unseen.py::test_depths_and_sums_around_are_those_of_scipy',),
    ),
    Mutation(
        "shape features: sums around are twice as wide",
        "r2h_batch/methods/predictors/shape_features.py",
        '-0.5 * ((i[:, None] - i[None]) / deviation) ** 2',
        '-0.125 * ((i[:, None] - i[None]) / deviation) ** 2',
        ('tests/methods/predictors/test_unseen.py::test_depths_and_sums_around_are_those_of_scipy',),
    ),
    Mutation(
        "shape features: the axis has a sign",
        "r2h_batch/methods/predictors/shape_features.py",
        '        t.abs() / length,',
        '        t / length,',
        ('tests/methods/predictors/test_unseen.py::test_features_and_answers_are_of_the_shape_and_not_of_its_frame',),
    ),
    Mutation(
        'of run: a file called like a function runs',
        OF_RUN,
        ' or (name == "benchmark" and names_function(at)):',
        ':',
        (f"{T_PAIRS}::test_a_file_called_like_a_function_beside_a_stored_run_does_not_run",),
    ),
    Mutation(
        'import robot: a UR points into its wrist',
        "r2h_batch/data/robot_home.py",
        "    way = ahead + middle if",
        "    way = middle if",
        ("tests/data/test_robot_home.py::test_the_tool0_of_a_ur_points_away_although_the_last_link_lies_behind_it",),
    ),
    Mutation(
        'import robot: .. leads anywhere',
        "r2h_batch/data/robot_model.py",
        "        if at.is_relative_to(folder):",
        "        if folder:",
        ("tests/data/test_robots_as_sold.py::test_files_that_lie_above_are_read_from_a_folder_of_the_user_and_from_no_other",),
    ),
    Mutation(
        'grasps: a gripper of several frames is looked up',
        "r2h_batch/data/grasp_files.py",
        "        _check_gripper(gripper, where)",
        "        pass",
        ("tests/data/test_grasps_refused.py::test_a_gripper_or_a_source_that_is_none_is_refused_with_what_is_allowed",),
    ),
    Mutation(
        'of run: what it saw of the person is forgotten',
        OF_RUN,
        'receiver=header["configuration"].get("receiver", "hand")',
        'receiver="hand"',
        (T_OF_RUN,),
    ),
    Mutation(
        'of run: files that its sweep was not given pass',
        OF_RUN,
        '!= {f.split()[0] for f in _files(given)}:',
        "< {f.split()[0] for f in _files(replace(given, people=''))}:",
        (T_OF_RUN,),
    ),
    Mutation(
        'stored: rows of another preset are baselines',
        STORED,
        'if benchmark and preset]',
        'if benchmark]',
        (T_STORED,),
    ),
    Mutation(
        'stored: rows of another engine come first',
        STORED,
        'int(len({*engines}) == 1)',
        'int(len({*engines}) == 2)',
        (T_STORED,),
    ),
    Mutation(
        'stored: rows of other objects are baselines',
        STORED,
        'for k in ("objects", "hand_set")',
        'for k in ("hand_set",)',
        (T_STORED,),
    ),
    Mutation(
        'stored: planned rows before simulated ones',
        STORED,
        '(simulated or found)[0]',
        'found[-1]',
        (T_BASELINES,),
    ),
    Mutation(
        "stored: a benchmark's rows by its rule's name",
        STORED,
        'own["digests"]["benchmark"] == digest if digest else own["protocol"] == name',
        'own["protocol"] == name',
        (T_BASELINES,),
    ),
    Mutation(
        "stored: rows of any preset are a benchmark's",
        STORED,
        'if own["configuration"]["name"] == "default"\n        and (',
        'if (',
        (T_BASELINES,),
    ),
    Mutation(
        "cameras: half a pixel",
        "kernels/observe/rays.py",
        "corner[0]) + 0.5 * float(stride)",
        "corner[0])",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "cameras: a transposed rotation",
        "kernels/observe/rays.py",
        "    return rotation(T) * (ray * scale), scale",
        "    return wp.transpose(rotation(T)) * (ray * scale), scale",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "cameras: depth along the ray",
        "kernels/observe/rays.py",
        "depth_out[i, p] = best * scale",
        "depth_out[i, p] = best",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "table: people read other digits of a digest",
        "r2h_batch/report/text.py",
        r"([0-9a-f]{12})[0-9a-f]{52}",
        r"[0-9a-f]{52}([0-9a-f]{12})",
        ("tests/report/test_report.py::test_people_read_twelve_digits_of_a_digest_and_programs_all",),
    ),
    Mutation(
        "cameras: the upper arm is called the forearm",
        "kernels/observe/rays.py",
        "what = FOREARM + k",
        "what = FOREARM",
        (f"{T_SENSOR}::test_arm_and_torso_face_the_ray_as_a_ball_and_a_box_do",),
    ),
    Mutation(
        "cameras: what is met is as near as its ball",
        "kernels/observe/rays.py",
        "found = wp.vec2(met.t, wp.abs(wp.dot(ld, met.normal)))",
        "found = wp.vec2(wp.dot(first_three(ball) - lo, ld) - ball[3], wp.abs(wp.dot(ld, met.normal)))",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "cameras: swapped",
        "r2h_batch/observe/seeing.py",
        "    cameras = rig.T_world_camera.to(T_world_obj.device)",
        "    cameras = rig.T_world_camera.to(T_world_obj.device).flip(0)",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "cameras: a left hand is a right one's skin",
        "r2h_batch/observe/rays.py",
        "self.scene.device, self._skin[h], self._faces[int(side[h])]",
        "self.scene.device, self._skin[int(needed[0])], self._faces[int(side[h])]",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "cameras: the gripper is closed",
        "r2h_batch/observe/robot_mesh.py",
        "drive = drive_from_gap(robot, gap_m)",
        "drive = drive_from_gap(robot, 0.0 * np.asarray(gap_m))",
        (f"{T_RAYS}::test_the_robot_at_home_is_mujocos_with_an_open_gripper",),
    ),
    Mutation(
        "moments: drawn by row",
        "r2h_batch/observe/moment.py",
        "rng.uniforms(key, ids[rows][of], 3",
        "rng.uniforms(key, rows[of], 3",
        (f"{T_RAYS}::test_moments_and_images_have_the_same_bits_alone_in_sevens_and_permuted",),
    ),
    Mutation(
        "moments: on the hand's side",
        "r2h_batch/observe/moment.py",
        "np.where(hand_y > 0, -1.0, 1.0)",
        "np.where(hand_y > 0, 1.0, -1.0)",
        (f"{T_RAYS}::test_objects_rest_on_the_table_away_from_the_hand_and_touch_nobody",),
    ),
    Mutation(
        "robust: above is along the table",
        "r2h_batch/methods/robust.py",
        "down = -T_world_obj[some, 2, :3]",
        "down = -T_world_obj[some, :3, 2]",
        ("tests/methods/test_from_the_table.py::test_above_is_where_the_vertical_is_of_an_object_that_rests_on_another_side",),
    ),
    Mutation(
        "robust: a pair that has not won yet is given up",
        "r2h_batch/methods/robust.py",
        "(held + left > beyond)",
        "(held > beyond)",
        (f"{T_ROBUST}::test_pairs_that_can_exceed_their_rivals_are_counted_to_the_end_and_others_are_given_up",),
    ),
    Mutation(
        "robust: hopeless pairs are judged to the end",
        "r2h_batch/methods/robust.py",
        "(held + left > beyond)",
        "(held + left > -1)",
        (f"{T_ROBUST}::test_a_pair_that_can_no_longer_win_is_not_judged_to_the_end_and_no_answer_changes",),
    ),
    Mutation(
        "robust: grasps from above are those of another side",
        "r2h_batch/methods/robust.py",
        "(x, y, z))\n    spare_m",
        "(0.0, 0.0, 1.0))\n    spare_m",
        ("tests/methods/test_from_the_table.py::test_above_is_where_the_vertical_is_of_an_object_that_rests_on_another_side",),
    ),
    Mutation(
        "robust: candidates with spare margins come last",
        "r2h_batch/methods/robust.py",
        "np.where(place < spare[:, None], 0, 1)",
        "np.where(place < spare[:, None], 1, 0)",
        (
            "tests/methods/test_from_the_table.py"
            "::test_candidates_of_a_search_with_errors_are_tried_once_each_and_those_with_spare_margins_first",
        ),
    ),
    Mutation(
        "clouds: one pixel late",
        "r2h_batch/observe/seen.py",
        "own & np.uint64(0xFFFFFFFF)",
        "(own & np.uint64(0xFFFFFFFF)) + np.uint64(1)",
        (f"{T_RAYS}::test_clouds_take_every_pixel_once_and_mask_the_rest",),
    ),
    Mutation(
        "clouds: drawn by the row of the batch",
        "r2h_batch/observe/seen.py",
        "rng.uniforms(key, ids[row], 1",
        "rng.uniforms(key, row, 1",
        (f"{T_RAYS}::test_moments_and_images_have_the_same_bits_alone_in_sevens_and_permuted",),
    ),
    Mutation(
        "clouds: the first pixels",
        "r2h_batch/observe/seen.py",
        "order = (turn * 2.0**32).astype(np.uint64) << np.uint64(32) | pixel.astype(np.uint64)",
        "order = pixel.astype(np.uint64)",
        (f"{T_RAYS}::test_clouds_are_even_samples_and_smaller_ones_begin_larger_ones",),
    ),
    Mutation(
        "sensor: noise grows with depth, not with its square",
        SENSOR,
        "sensor.stereo * z * z *",
        "sensor.stereo * z *",
        (f"{T_SENSOR}::test_noise_of_depth_grows_with_its_square_as_stereo_has_it_and_has_no_bias",),
    ),
    Mutation(
        "sensor: every pixel has a stereo error of its own",
        SENSOR,
        "side = sensor.stereo_px",
        "side = int(1)",
        (f"{T_SENSOR}::test_noise_is_shared_by_squares_of_two_pixels_and_by_nothing_else",),
    ),
    Mutation(
        "sensor: errors by the window's pixel",
        SENSOR,
        "place = draw(key_0, key_1, trial, y * width + x, PLACE)",
        "place = draw(key_0, key_1, trial, v * width + at, PLACE)",
        (T_SENSOR_TWIN,),
    ),
    Mutation(
        "sensor: errors by the row of the batch",
        SENSOR,
        "    trial = trial_in[i]\n    exact",
        "    trial = wp.int64(i)\n    exact",
        (f"{T_SENSOR}::test_a_pixel_has_the_same_error_in_every_window_that_shows_it_and_in_any_batch",),
    ),
    Mutation(
        "sensor: the upper half of a trial's id is dropped",
        "kernels/native/philox.h",
        "b = (bits64)trial >> 32;",
        "b = 0;",
        (f"{T_SENSOR}::test_a_pixel_has_the_same_error_in_every_window_that_shows_it_and_in_any_batch",),
    ),
    Mutation(
        "sensor: all cameras have the first one's errors",
        SENSOR,
        "key_0 = wp.uint32(key_in[c, 0])",
        "key_0 = wp.uint32(key_in[0, 0])",
        (T_SENSOR_TWIN,),
    ),
    Mutation(
        "sensor: flying pixels lie in the middle",
        SENSOR,
        "(far - near) * uniform(fate[2, k])",
        "(far - near) * 0.5",
        (f"{T_SENSOR}::test_shares_of_lost_and_flying_pixels_at_edges_are_the_stated_ones_and_flying_ones_lie_anywhere_between",),
    ),
    Mutation(
        "sensor: steep surfaces are measured",
        SENSOR,
        "if z <= 0.0 or steep:",
        "if z <= 0.0:",
        (f"{T_SENSOR}::test_surfaces_steeper_than_eighty_degrees_are_lost_and_others_are_not",),
    ),
    Mutation(
        "sensor: a pixel looks beside itself along rows only",
        SENSOR,
        "wp.clamp(v + down, 0, rows - 1)",
        "v",
        (T_SENSOR_TWIN,),
    ),
    Mutation(
        "sensor: calibration is drawn by camera alone",
        "r2h_batch/observe/sensor.py",
        "ids, sensor = trial_ids(trial_id), self.rig.sensor",
        "ids, sensor = 0 * trial_ids(trial_id), self.rig.sensor",
        (f"{T_SENSOR}::test_calibration_errors_have_the_stated_deviations_in_the_cameras_frame_and_differ_by_camera_and_trial",),
    ),
    Mutation(
        "sensor: eroded masks grow",
        "r2h_batch/observe/sensor.py",
        '{"eroded": -1, "grown": 1}',
        '{"eroded": 1, "grown": 1}',
        (f"{T_SENSOR}::test_masks_shrink_and_grow_by_two_pixels",),
    ),
    Mutation(
        "sensor: what leaves a mask keeps its label",
        SENSOR,
        "            shown = 0\n",
        "            shown = own\n",
        (f"{T_SENSOR}::test_masks_shrink_and_grow_by_two_pixels",),
    ),
    Mutation(
        "sees: the method is told where the hand is",
        "r2h_batch/observe/estimates.py",
        "noise=PredictorNoise().scaled(noise),",
        "noise=PredictorNoise().scaled(0.0),",
        (f"{T_ESTIMATES}::test_hands_are_estimated_as_methods_that_are_told_see_them",),
    ),
    Mutation(
        "sees: the method is told where the object lies",
        "r2h_batch/observe/estimates.py",
        "se3.matmul(T_world_obj.double(), T_obj_seen).float()",
        "T_world_obj",
        (f"{T_ESTIMATES}::test_known_objects_lie_where_the_level_of_error_puts_them",),
    ),
    Mutation(
        "sees: the method is told where the cameras stand",
        "r2h_batch/observe/seeing.py",
        "errors.believed(trials.trial_id),",
        "rig.T_world_camera.expand(len(trials), -1, -1, -1).to(scene.device),",
        (T_SPY,),
    ),
    Mutation(
        "sees: images go along with the objects' true poses",
        "r2h_batch/observe/seeing.py",
        "image_keys(own, hand),",
        "T_world_obj,",
        (T_SPY,),
    ),
    Mutation(
        "sees: rows come in the order of the trials",
        "r2h_batch/observe/apart.py",
        "order = torch.argsort(seen.key.cpu())",
        "order = torch.arange(len(seen))",
        (T_OWN_TRIALS,),
    ),
    Mutation(
        "sees: answers stay in the order of the keys",
        "r2h_batch/observe/apart.py",
        "back = torch.argsort(order)",
        "back = torch.arange(len(order))",
        (T_OWN_TRIALS,),
    ),
    Mutation(
        "sees: every module can be imported",
        "r2h_batch/observe/asked.py",
        "sys.meta_path.insert(0, Forbidden())",
        "Forbidden()",
        (f"{T_APART}::test_a_method_that_reaches_for_the_truth_is_refused_in_one_line",),
    ),
    Mutation(
        "sees: a run's sight is no part of its identity",
        "r2h_batch/sweep/jobs.py",
        'setting.header["digests"]["sees"] = sees.digest',
        "pass",
        (f"{T_SEES}::test_runs_that_see_otherwise_are_not_paired_and_do_not_share_a_folder",),
    ),
    Mutation(
        "planned by sight: the robot is judged against the person by Plan",
        "r2h_batch/judge/followed.py",
        "without(scene, poses, person=True),",
        "poses,",
        ("tests/judge/test_followed.py::test_a_plan_is_judged_without_the_robot_against_the_person_and_with_what_it_holds",),
    ),
    Mutation(
        "planned by sight: a path from home is not looked at again",
        "r2h_batch/judge/pick.py",
        "stages.fail(way.clearance_m <= 0, PickReason.PATH_COLLIDES, way)",
        "pass",
        ("tests/judge/test_followed.py::test_a_path_from_home_that_meets_the_true_object_fails_by_that",),
    ),
    Mutation(
        "planned by sight: arm and torso are not shifted",
        "r2h_batch/observe/believed_world.py",
        "receiver[:, :4, :3] += (seen - true)[:, None]",
        "receiver[:, :4, :3] += 0.0",
        ("tests/observe/test_believed_world.py::test_hands_and_persons_stand_where_the_estimate_says_and_are_grown",),
    ),
    Mutation(
        "planned by sight: a hand has no room",
        "r2h_batch/scene/tables.py",
        '"piece_round": (np.full(len(center), room), wp.float32),',
        '"piece_round": (np.zeros(len(center)), wp.float32),',
        ("tests/judge/test_followed.py::test_a_scene_with_room_keeps_it_from_hand_and_person_alone",),
    ),
    Mutation(
        "a film of the draft tells the verdict before the arm is there",
        "r2h_batch/view/film.py",
        'verdict if t >= decided_s else ""',
        "verdict",
        ("tests/view/test_whole_film.py::test_a_film_keeps_the_order_and_says_the_verdict_at_its_end_alone",),
    ),
    Mutation(
        "sees: grasps are taken for ones in the object's frame",
        "r2h_batch/sweep/seeing.py",
        "T_obj_ee = se3.matmul(se3.inverse(look.T_world_obj.double()), grasp.to(home)).float()",
        "T_obj_ee = grasp.to(home).float()",
        (f"{T_SEES}::test_grasps_of_the_world_are_judged_where_the_object_lay_at_the_moment",),
    ),
    Mutation(
        "believed: the hand lies beside where it was seen",
        "r2h_batch/methods/believed.py",
        "p = receiver.palm.double() - se3.rotate(R, palm)",
        "p = receiver.palm.double()",
        (f"{T_BELIEVED}::test_a_believed_hand_has_the_palm_the_normal_and_the_direction_that_were_seen",),
    ),
    Mutation(
        "believed: a kept solid is anybody's whose object looks the same",
        "r2h_batch/observe/believed_object.py",
        '("object", "T_", "key", "region")',
        '("object", "T_", "region")',
        (f"{T_BELIEVED}::test_a_kept_solid_is_that_of_the_trials_own_images",),
    ),
    Mutation(
        "believed: hands are drawn by the row of the batch",
        "r2h_batch/methods/believed.py",
        "int(left[i]), int(seen.key[i]), noise, seed",
        "int(left[i]), i, noise, seed",
        (f"{T_BELIEVED}::test_answers_have_the_same_bits_alone_and_in_any_order",),
    ),
    Mutation(
        "believed: the true objects are what methods answer about",
        "r2h_batch/methods/believed.py",
        "own = replace(benchmark, objects=tuple(names.values()), hand_set=hands)",
        "own = replace(benchmark, objects=benchmark.objects[: len(names)], hand_set=hands)",
        (f"{T_BELIEVED}::test_other_meshes_behind_the_same_images_move_no_bit_of_the_answers",),
    ),
    Mutation(
        "believed: what a solid was built of is left to Python",
        "r2h_batch/observe/believed_object.py",
        "if next(_BUILT) % GARBAGE_AFTER == 0:",
        "if False:",
        (f"{T_BELIEVED}::test_meshes_that_a_solid_was_built_of_do_not_pile_up",),
    ),
    Mutation(
        "region told: of what was not measured too",
        "r2h_batch/observe/estimates.py",
        '    shown = (images.label == LABELS.index("object")) & (images.depth_m > 0)',
        '    shown = images.label == LABELS.index("object")',
        (f"{T_ESTIMATES}::test_nothing_but_the_region_of_what_was_seen_is_told",),
    ),
    Mutation(
        "region told: its border is exact",
        "r2h_batch/observe/estimates.py",
        "    border_m = PredictorNoise().scaled(noise).border_m",
        "    border_m = PredictorNoise().scaled(0.0 * noise).border_m",
        (f"{T_ESTIMATES}::test_borders_are_misplaced_as_those_that_methods_told_the_truth_get",),
    ),
    Mutation(
        "region told: a part's number in place of the region",
        "r2h_batch/observe/estimates.py",
        "label[i][nearest] % 2 == 1",
        "label[i][nearest] // 2 == 1",
        (f"{T_ESTIMATES}::test_without_errors_a_pixel_is_told_the_region_of_the_face_that_it_shows",),
    ),
    Mutation(
        "region told: a cloud's rows and columns are swapped",
        "r2h_batch/observe/seen.py",
        "        return self.region[of, camera, v, u] & mask",
        "        return self.region[of, camera, u, v] & mask",
        (f"{T_ESTIMATES}::test_the_region_of_a_cloud_is_that_of_its_own_points",),
    ),
    Mutation(
        "region told: it is lost in the pipe",
        "r2h_batch/observe/seen.py",
        'tensors["key"], known, tensors.get("region"),',
        'tensors["key"], known, None,',
        (f"{T_APART}::test_an_observation_comes_out_of_the_pipe_as_it_went_in",),
    ),
    Mutation(
        "region told: the believed region is the rest",
        "r2h_batch/observe/solid.py",
        "    found: NDArray[np.bool_] = 2 * told[nearest].sum(1) > votes",
        "    found: NDArray[np.bool_] = 2 * told[nearest].sum(1) < votes",
        (f"{T_BELIEVED}::test_a_believed_object_has_the_told_region_and_no_other_part",),
    ),
    Mutation(
        "region told: its border is misplaced twice",
        "r2h_batch/methods/believed.py",
        "target_translation_m=0.0, border_m=0.0)",
        "target_translation_m=0.0)",
        (f"{T_BELIEVED}::test_a_believed_object_has_the_told_region_and_no_other_part",),
    ),
    Mutation(
        "region told: a solid without it is kept for those with it",
        "r2h_batch/observe/believed_object.py",
        '("object", "T_", "key", "region")',
        '("object", "T_", "key")',
        (f"{T_BELIEVED}::test_a_told_region_moves_answers_of_its_own_trials_alone",),
    ),
    Mutation(
        "region told: the run does not say so",
        "r2h_batch/observe/sees.py",
        '        told = {"region": self.region} if self.region != "hidden" else {}',
        "        told: dict[str, str] = {}",
        (f"{T_SEES}::test_a_told_region_reaches_the_method_and_such_runs_are_not_paired_with_others",),
    ),
    Mutation(
        "solid: nothing is carved",
        "r2h_batch/observe/solid.py",
        "full[rows[view.carves(nodes[rows])]] = False",
        "full[rows[view.carves(nodes[rows])]] = True",
        (f"{T_BELIEVED}::test_nothing_of_a_solid_stands_where_a_camera_looks_through",),
    ),
    Mutation(
        "solid: cameras are not levelled",
        "r2h_batch/observe/solid.py",
        "views[c] = replace(views[c], T_world_camera=T)",
        "pass",
        (f"{T_BELIEVED}::test_errors_of_calibration_are_taken_out_as_far_as_table_and_object_show_them",),
    ),
    Mutation(
        "rays: the last column of cells that a face may be seen in is left out",
        "kernels/observe/rays.py",
        "for u in range(u0 / CELL, u1 / CELL + 1):",
        "for u in range(u0 / CELL, u1 / CELL):",
        (f"{T_RAYS}::test_a_pixel_shows_the_same_in_every_window_wherever_the_window_begins",),
    ),
    Mutation(
        "rays: a forearm ends where its last piece does",
        "r2h_batch/observe/rays.py",
        "size = 0.5 * se3.dot(along, along).sqrt() + a[:, 3]",
        "size = 0.5 * a[:, 3]",
        (f"{T_RAYS}::test_depth_and_labels_are_those_of_float64_rays_on_mujocos_robot_and_the_meshes",),
    ),
    Mutation(
        "rays: tiles of a window are those in which all of the robot is",
        "r2h_batch/observe/rays.py",
        "tiles = (met[1][..., :, None] & met[0][..., None, :]).any(2).flatten(2)",
        "tiles = (met[1][..., :, None] & met[0][..., None, :]).all(2).flatten(2)",
        (f"{T_RAYS}::test_whole_images_show_table_robot_and_person_where_float64_rays_do",),
    ),
    Mutation(
        "robust: the object lies where it is believed to",
        "r2h_batch/methods/robust.py",
        "replace(sizes.object, seed=own)",
        "ObjectErrors()",
        (f"{T_ROBUST}::test_errors_are_those_of_the_object_and_of_the_hand_one_verdict_each",),
    ),
    Mutation(
        "robust: the first pair that succeeds as believed is taken",
        "r2h_batch/methods/robust.py",
        "done[solved] = held == draws",
        "done[solved] = True",
        (f"{T_ROBUST}::test_what_it_takes_holds_under_errors_that_it_has_not_drawn_better_than_what_a_plain_search_takes",),
    ),
    Mutation(
        "robust: all errors are one",
        "r2h_batch/methods/robust.py",
        'rng.key_of(f"robust {seed} {k}")',
        'rng.key_of(f"robust {seed}")',
        (f"{T_ROBUST}::test_errors_are_those_of_the_object_and_of_the_hand_one_verdict_each",),
    ),
    Mutation(
        "cameras: the background of the row below",
        "kernels/observe/rays.py",
        "    at = int(y) * sensor[0] + int(x)",
        "    at = wp.min(int(y) + 1, sensor[1] - 1) * sensor[0] + int(x)",
        (f"{T_RAYS}::test_a_background_that_is_kept_changes_no_bit",),
    ),
    Mutation(
        "cameras: a side of the table faces up",
        "kernels/observe/rays.py",
        "    return wp.abs(d[k])",
        "    return wp.abs(d[2])",
        (f"{T_SENSOR}::test_arm_and_torso_face_the_ray_as_a_ball_and_a_box_do",),
    ),
    Mutation(
        "draft r2h-v3: pick counts behind all others",
        "r2h_batch/verdicts.py",
        "IN_ORDER = (REGISTRY[0], ASKED[0], *REGISTRY[1:], *ASKED[1:])",
        "IN_ORDER = (*REGISTRY, *ASKED)",
        (f"{T_FROM_TABLE}::test_the_first_failure_is_stability_then_pick_then_the_others",),
    ),
    Mutation(
        "draft r2h-v3: a benchmark that asks for pick has the digest of one that does not",
        "r2h_batch/protocols/benchmark.py",
        "asks = f\"asks {' '.join(self.asks)}\\n\" if self.asks else \"\"",
        'asks = ""',
        (f"{T_FROM_TABLE}::test_only_a_benchmark_that_asks_for_pick_has_another_digest_and_another_column",),
    ),
    Mutation(
        "draft r2h-v3: moments of other hands are taken for this one's",
        "r2h_batch/observe/known.py",
        "trials.hand_index, trials.T_world_hand]\n    decide +=",
        "trials.hand_index]\n    decide +=",
        (f"{T_FROM_TABLE}::test_moments_are_drawn_once_and_are_those_of_any_draw",),
    ),
    Mutation(
        "draft r2h-v3: grasps are pushed into the table, not backed out of it",
        "r2h_batch/methods/from_table.py",
        "T[:, :3, 3] -= back[todo, None]",
        "T[:, :3, 3] += back[todo, None]",
        (f"{T_FROM_TABLE}::test_grasps_of_the_oracle_are_picked_and_some_are_backed_out_of_the_table",),
    ),
    Mutation(
        "draft r2h-v3: a row names another pair than the one that pick is about",
        "r2h_batch/runs/rows.py",
        "np.where(met == CollidingPair.NONE, -1, met)",
        "np.where(met == CollidingPair.NONE, -1, met - 1)",
        (f"{T_FROM_TABLE}::test_tables_and_words_show_pick",),
    ),
    Mutation(
        "draft r2h-v3: the carry begins at home",
        "r2h_batch/evaluate.py",
        "            start = torch.where(begins[:, None], picked.lifted, home)\n",
        "            start = home.expand(len(active), -1)\n",
        (f"{T_FROM_TABLE}::test_the_carry_begins_where_the_lift_of_the_accepted_branch_ends",),
    ),
    Mutation(
        "draft r2h-v3: the carry begins at the grasp on the table",
        "r2h_batch/judge/pick.py",
        "        return self.way_up[:, 0]\n",
        "        return self.way_up[:, -1]\n",
        (f"{T_FROM_TABLE}::test_the_carry_begins_where_the_lift_of_the_accepted_branch_ends",),
    ),
    Mutation(
        "draft r2h-v3: what is not picked fails plan too",
        "r2h_batch/judge/metrics.py",
        "        judged = judged & (e.reason != int(PlanReason.NOT_EVALUATED))\n",
        "        judged = judged & True\n",
        (f"{T_FROM_TABLE}::test_nothing_is_carried_that_was_not_picked",),
    ),
    Mutation(
        "draft r2h-v3: goals are turned once too often",
        "r2h_batch/judge/ik.py",
        "/ turn + 0.5).floor()",
        "/ turn).floor()",
        (f"{T_FROM_TABLE}::test_goals_are_taken_at_the_turns_nearest_to_the_start",),
    ),
    Mutation(
        "draft r2h-v3: planning has a time where nothing is planned",
        "r2h_batch/judge/scores.py",
        "torch.where(begun, t_plan_s",
        "torch.where(active, t_plan_s",
        (f"{T_FROM_TABLE}::test_nothing_is_carried_that_was_not_picked",),
    ),
    Mutation(
        "draft r2h-v3: everybody is asked to take it, whatever failed before",
        "r2h_batch/judge/received.py",
        "rows = torch.nonzero(scores.success)[:, 0]",
        "rows = torch.nonzero(scores.evaluated[:, 0])[:, 0]",
        (f"{T_FROM_TABLE}::test_received_is_what_reception_says_of_what_passed_all_else",),
    ),
    Mutation(
        "draft r2h-v3: a reason of received names the step before",
        "r2h_batch/judge/received.py",
        "1 + none.to(torch.int8).argmax(1)",
        "none.to(torch.int8).argmax(1)",
        (f"{T_FROM_TABLE}::test_what_nobody_can_take_fails_received_and_says_why",),
    ),
    Mutation(
        "draft r2h-v3: what fails received stays a success",
        "r2h_batch/judge/scores.py",
        "        success=put(\"success\", passed, rows),\n",
        "        success=scores.success,\n",
        (f"{T_FROM_TABLE}::test_what_nobody_can_take_fails_received_and_says_why",),
    ),
    Mutation(
        "draft r2h-v3: until present still asks for received",
        "r2h_batch/protocols/benchmark.py",
        "asks = ASKED_NAMES[: 1 + UNTIL.index(",
        "asks = ASKED_NAMES[: 2 + UNTIL.index(",
        (f"{T_FROM_TABLE}::test_a_benchmark_may_end_before_the_giving",),
    ),
    Mutation(
        "draft r2h-v3: a trial that is drawn again has its first moment",
        "r2h_batch/observe/moment.py",
        "again(f\"moment {seed}\", k)",
        "f\"moment {seed}\"",
        (f"{T_CERTIFIED}::test_only_what_was_drawn_again_is_another_trial_with_another_moment",),
    ),
    Mutation(
        "draft r2h-v3: trials that were drawn again come in another order",
        "r2h_batch/protocols/draw/rule.py",
        "np.argsort(np.concatenate(groups))",
        "np.concatenate(groups)",
        (f"{T_CERTIFIED}::test_trials_have_the_same_bits_alone_and_in_any_order",),
    ),
    Mutation(
        "draft r2h-v3: certificates hold for any benchmark",
        "r2h_batch/protocols/benchmark.py",
        "certified is not None and certified.benchmark == self.undrawn_digest",
        "certified is not None",
        (f"{T_CERTIFIED}::test_the_digest_covers_the_redraws_and_certificates_hold_for_no_other_benchmark",),
    ),
    Mutation(
        "draft r2h-v3: the digest does not know the redraws",
        "r2h_batch/protocols/benchmark.py",
        "        if (certified := self.own_certified) is None:\n",
        "        if (certified := self.own_certified) is None or self.robot:\n",
        (f"{T_CERTIFIED}::test_the_digest_covers_the_redraws_and_certificates_hold_for_no_other_benchmark",),
    ),
    Mutation(
        "draft r2h-v3: an unsolved trial counts as certified",
        "r2h_batch/protocols/certified.py",
        "        return here & self.solved[at]\n",
        "        return here\n",
        (f"{T_CERTIFIED}::test_a_trial_without_an_answer_is_not_certified",),
    ),
    Mutation(
        "draft r2h-v3: the oracle forgets the certificate",
        "r2h_batch/methods/oracle.py",
        "    if for_ == \"success\" and len(todo):",
        "    if for_ == \"reception\" and len(todo):",
        (f"{T_CERTIFIED}::test_the_oracle_answers_with_the_certificate_where_its_search_finds_nothing",),
    ),
    Mutation(
        "draft r2h-v3: rows of a run without pick have its columns",
        "r2h_batch/runs/columns.py",
        "if c.asked and c.asked not in asks:",
        "if False:",
        ("tests/runs/test_rows.py::test_rows_of_any_number_of_trials_have_the_schemas",),
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
