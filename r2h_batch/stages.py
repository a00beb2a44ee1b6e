"""The judge on one page: the stages of a verdict, in their order.

A stage is a function that reads `Work` and writes more of it, and an entry of the lists at the end of this page, which says
when there is such a stage:

| list | judges | asked for by |
|---|---|---|
| `PLANNED` | grasps and handover poses, as the benchmark does | `Evaluator.score` |
| `BELIEVED` | the same, where the arm is planned in what cameras saw | `Evaluator(plans_in=)` |
| `POSE` | the same without a path | `score(stages="pose")` |
| `TRACE` | motions that the caller gives | `score_motion` |
| `LAST` | what has passed all that: can the person take it? | all but POSE |

What a stage computes stands in its file of `r2h_batch.judge`; how rows reach the stages in `launching`; the criteria in
`verdicts.EVERY` (words, units, order) and `judge.metrics` (equations). Stages of paths import that when they are called: with
its kernels and MuJoCo it would take a fifth of the time to the first verdict on a pose.
"""

import time
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.judge import metrics
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.distance import (
    hand_distance,
    hand_distance_at,
    nearer_of,
    over_motion,
    person_distance,
    person_distance_at,
)
from r2h_batch.judge.goal import failed_clearance, judge_goals, weaken_singular_reason
from r2h_batch.judge.ik import IkResult, home_posture, nearest_turns, one_branch, solve_ik
from r2h_batch.judge.presented import presented
from r2h_batch.judge.reach import reached
from r2h_batch.judge.scores import motion_fields, not_given, pose_fields, verdict
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses
from r2h_batch.types import PlanReason
from r2h_batch.verdicts import criteria_of
from r2h_batch.work import Stage, Work


def grasp(w: Work) -> None:
    """The object in the closed gripper; rows that are no handover are not active from here on."""
    w.held = attach_object(w.scene, w.T_obj_ee, w.T_world_ee, w.trials, w.config)


def pick(w: Work, *, ways: bool = True) -> None:
    """Whether the arm picks the objects where they rest. `ways`: also by the ways to the grasp and up from it."""
    from r2h_batch.judge.pick import judge_picks

    w.picked = judge_picks(w.scene, w.T_obj_ee, w.resting, w.trials, ways=ways)


def plan(w: Work) -> None:
    """A path without collision from home, or from where the object is lifted."""
    from r2h_batch.judge.plan import plan_paths, random_key

    scene, config, held, started = w.scene, w.config, w.held, time.perf_counter()
    ik, usable = branches(w)
    goals, begins, start = ik.q, held.active, None
    if w.picked is not None:  # carried from where the lift ends
        begins = begins & w.picked.picked
        home = home_posture(str(begins.device), config.workplace.home_q)
        start = torch.where(begins[:, None], w.picked.lifted, home)
        goals = nearest_turns(ik.q, start, scene.robot)
    planned = plan_paths(
        scene, held.planner_poses, goals, usable, begins, random_key(w.trials.trial_id), config.plan,
        execute=config.execute, start=start,
    )  # fmt: skip
    w.t_plan_s = (time.perf_counter() - started) / max(len(w.trials), 1)
    w.missed_m = failed_clearance(
        scene, held.planner_poses, held.T_world_ee, ik, usable, planned.reason
    )
    w.planned = replace(planned, reason=weaken_singular_reason(planned.reason, ik))


def branches(w: Work) -> tuple[IkResult, Tensor]:
    """All IK branches that reach the handover pose, and which of them may be used."""
    solve = solve_ik
    if w.config.ik.solver == "pytorch-kinematics":
        from r2h_batch.judge.ik_jacobian import solve_ik as solve
    robot, home = w.scene.robot, w.config.workplace.home_q
    ik = solve(w.held.T_world_ee, active=w.held.active, robot=robot, home=home)
    if w.config.plan.goals == "set":
        return ik, ik.valid
    return ik, one_branch(ik, w.held.T_world_ee, robot=robot, home=home)


def believe(w: Work) -> None:
    """`pick` and `plan` in what cameras saw; then what the arm does by that, judged in the truth."""
    from r2h_batch.judge.followed import follow_plans, no_plan, nothing_to_pick, put
    from r2h_batch.judge.pick import follow_picks
    from r2h_batch.observe.believed_world import believed_world

    assert w.plans_in is not None  # the list says so
    scene, b, device = w.scene, len(w.trials), w.held.active.device
    T_world_grasp = se3.matmul(w.resting.double(), w.T_obj_ee.double())
    picked = nothing_to_pick(scene, T_world_grasp.float())
    planned = no_plan(b, len(scene.robot.joints), device)
    missed_m = torch.full_like(planned.clearance_m, -torch.inf)
    w.t_plan_s, rows = 0.0, torch.nonzero(w.held.active)[:, 0]
    world = believed_world(scene, w.trials[rows], w.plans_in) if len(rows) else None
    if world is not None:
        rows = rows[world.row.to(device)]
        own = Work(
            world.scene, w.config, world.trials, world.grasps(T_world_grasp[rows]), w.held.T_world_ee[rows],
            T_world_obj=world.T_world_obj.float(),
        ).through((GRASP, PICK, PLAN))  # fmt: skip
        assert own.picked is not None  # the benchmark asks, else nobody believes anything
        put(picked, rows, own.picked)
        put(planned, rows, own.planned)
        missed_m[rows], w.t_plan_s = own.missed_m, own.t_plan_s * len(rows) / b
    w.picked = follow_picks(scene, w.T_obj_ee, w.resting, w.trials, picked)
    w.planned = follow_plans(scene, w.held, planned, w.held.active & w.picked.picked)
    met = w.planned.reason == int(PlanReason.MOTION_IN_COLLISION)
    w.missed_m = torch.where(met, w.planned.clearance_m, missed_m)


def move(w: Work) -> None:
    """The path with times, as the arm executes it."""
    from r2h_batch.judge.motion.execute import execute
    from r2h_batch.judge.motion.time_law import time_path

    planned, law = w.planned, w.config.execute
    w.motion = time_path(planned.path, planned.length, law, w.scene.robot.joint_weight)
    # the clearance is certified only for exact edges, the true hand, and plans in the true world
    sure = (w.config.plan.edge_check, w.config.plan.hand, w.plans_in) == ("exact", "true", None)
    clearance_m = planned.clearance_m if sure else None
    w.executed = execute(
        w.scene,
        w.held.body_poses,
        planned.path,
        planned.length,
        w.motion,
        law,
        clearance_m=clearance_m,
    )
    w.goal_reached = (planned.reason == int(PlanReason.OK)) & w.executed.settled
    w.moves = w.held.active & (w.executed.length > 0)
    w.clearance_m = torch.where(w.goal_reached, planned.clearance_m, w.missed_m)
    w.reason, w.valid = planned.reason, w.executed.valid


def keep_clear(w: Work) -> None:
    """Where the robot is nearest to the receiver's hand on its way."""
    w.nearest = hand_distance(w.scene, w.held.body_poses, w.executed, w.held.active)


def keep_clear_of_body(w: Work) -> None:
    """How near the robot comes to arm, torso and head on its way."""
    body_m, body, _ = over_motion(w.scene, w.held.body_poses, w.executed, partial(_from_body, w))
    w.person = body_m, body


def follow(w: Work) -> None:
    """The caller's motion in place of a planned one; a plan beside it is tested too, and the worse of both counts."""
    from r2h_batch.judge.trace import executed_trace, plan_of_trace, worse_plan

    scene, active, poses = w.scene, w.held.active, w.held.body_poses
    if w.config.receiver == "body":
        assert w.trials.receiver is not None  # `check_receiver` has refused its absence
        poses = with_person(scene, poses, w.trials.receiver, hand=True)
    w.planned = plan_of_trace(scene, poses, w.trace, active)
    w.executed, w.motion = executed_trace(w.trace, w.planned)
    w.moves = active & (w.planned.length > 0)  # before a plan beside it may fail
    w.nearest = hand_distance(scene, w.held.body_poses, w.executed, active)
    if w.beside is not w.trace:
        free = plan_of_trace(scene, poses, w.beside, active)
        w.planned = worse_plan(free, w.planned, w.nearest.distance_m <= 0)
    w.goal_reached = w.planned.reason == int(PlanReason.OK)
    w.clearance_m, w.reason, w.valid = w.planned.clearance_m, w.planned.reason, w.executed.valid


def follow_by_body(w: Work) -> None:
    """How near the robot comes to arm, torso and head on the caller's motion."""
    w.person = _from_body(w, w.held.body_poses, w.executed.path, w.executed.length)


def _from_body(
    w: Work, poses: BodyPoses, path: Tensor, length: Tensor, rows: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """How near the robot comes to arm, torso and head, and which of its bodies; `rows`: the trials of the paths, or all."""
    assert w.trials.receiver is not None  # `has_body`
    receiver = w.trials.receiver if rows is None else w.trials.receiver[rows]
    return person_distance(w.scene, poses, receiver, path, length)


def stand(w: Work) -> None:
    """The goal posture in place of a path, and where the robot is nearest to the receiver's hand there."""
    held, (ik, usable) = w.held, branches(w)
    w.goal = judge_goals(
        w.scene, held.planner_poses, held.T_world_ee, ik, usable, held.active,
        from_home=w.picked is None,
    )  # fmt: skip
    w.nearest = hand_distance_at(w.scene, held.body_poses, w.goal.q, held.active)
    w.moves, w.clearance_m, w.reason = held.active, w.goal.clearance_m, w.goal.reason


def stand_by_body(w: Work) -> None:
    """How near the robot is to arm, torso and head at the goal posture."""
    held, receiver = w.held, w.trials.receiver
    assert receiver is not None  # `has_body`
    w.person = person_distance_at(w.scene, held.body_poses, receiver, w.goal.q, held.active)


def count_body(w: Work) -> None:
    """Arm, torso and head of the receiver count as the hand does."""
    assert w.person is not None  # `body_counts`
    w.nearest = nearer_of(w.nearest, *w.person)


def shake(w: Work) -> None:
    """The grasps that hold by geometry, shaken in a simulator."""
    from r2h_batch.judge.grasp_physics import shake as slips

    rows = w.held.active & (w.held.grasp.margin_m >= 0)
    w.slip_m = slips(w.scene.objects, w.held.objects, w.held.attached, rows, w.scene.robot)


def present(w: Work) -> None:
    """What of the object is in the ball, what comes to the hand first, and whether a vessel stands upright."""
    objects, ball = w.held.objects, w.held.ball
    w.reached = of_solid = reached(w.scene, objects, ball)
    if w.config.reach != "solid":
        of_solid = reached(w.scene, objects, ball, solid=True)
    w.presented = presented(w.scene, w.held, of_solid, w.config.thresholds)
    w.fields |= w.presented.fields


def criteria(w: Work) -> None:
    """The benchmark's criteria with margins, and the outcome: the first that fails."""
    evidence = metrics.Evidence(
        w.scene, w.config, w.held, w.goal_reached, w.moves, w.clearance_m, w.reason, w.nearest, w.slip_m, w.reached,
        w.presented, w.trials, w.picked,
    )  # fmt: skip
    entries = criteria_of(w.scene.benchmark.asks)
    w.fields |= verdict(entries, metrics.judge(evidence), w.held, w.slip_m, w.valid)


def tell_motion(w: Work) -> None:
    """The columns of motions: times, witnesses, path."""
    law = None if w.trace is not None else w.config.execute
    w.fields |= motion_fields(
        w.held.active, w.planned, w.motion, w.executed, w.nearest, law,
        t_plan_s=w.t_plan_s, keep_motion=w.keep_motion, body_m=None if w.person is None else w.person[0],
    )  # fmt: skip


def tell_posture(w: Work) -> None:
    """The columns of postures."""
    w.fields |= pose_fields(w.goal, w.nearest)
    if w.person is not None:
        w.fields["body_m"] = w.person[0]


def tell_pick(w: Work) -> None:
    """The columns of Pick beside its criterion's."""
    assert w.picked is not None  # the benchmark asks
    w.fields["pick"] = w.picked.column


def tell_nobody_takes(w: Work) -> None:
    """The columns of Received beside its criterion's, before `receive`."""
    w.fields |= not_given(len(w.trials), w.held.active.device)


def receive(w: Work) -> None:
    """Whether the person can take what was presented."""
    from r2h_batch.judge.received import given

    w.scores = given(w.scores)  # type: ignore[arg-type]  # the benchmark asks


def asks_pick(w: Work) -> bool:
    """The objects rest on the table first."""
    return "pick" in w.scene.benchmark.asks


def asks_received(w: Work) -> bool:
    """The person takes the object in the end."""
    return "received" in w.scene.benchmark.asks


def has_body(w: Work) -> bool:
    """The receivers are persons, not hands alone."""
    return w.trials.receiver is not None


def body_counts(w: Work) -> bool:
    """Planning and Safe see the person's arm, torso and head (`receiver="body"`)."""
    return w.config.receiver == "body" and has_body(w)


def is_shaken(w: Work) -> bool:
    """Grasps have to hold in a simulator too (`stability="physics"`)."""
    return w.config.stability == "physics"


GRASP = Stage(grasp)
PICK = Stage(pick, asks_pick, records=False)
PICK_POSE = Stage(partial(pick, ways=False), asks_pick, rests=True)
PLAN, BELIEVE, MOVE = (Stage(run, records=False) for run in (plan, believe, move))
CLEAR = (Stage(keep_clear, records=False), Stage(keep_clear_of_body, has_body, records=False))
FOLLOW = (Stage(follow, records=False), Stage(follow_by_body, has_body, records=False))
STAND = (Stage(stand), Stage(stand_by_body, has_body))
JUDGE = (Stage(count_body, body_counts), Stage(shake, is_shaken), Stage(present), Stage(criteria))
TELL = (Stage(tell_pick, asks_pick), Stage(tell_nobody_takes, asks_received))
TELL_MOTION = (*TELL, Stage(tell_motion, records=False))

PLANNED = (GRASP, PICK, PLAN, MOVE, *CLEAR, *JUDGE, *TELL_MOTION)
BELIEVED = (GRASP, BELIEVE, MOVE, *CLEAR, *JUDGE, *TELL_MOTION)
POSE = (GRASP, PICK_POSE, *STAND, *JUDGE, *TELL, Stage(tell_posture))
TRACE = (GRASP, PICK, *FOLLOW, *JUDGE, *TELL_MOTION)
LAST = (Stage(receive, asks_received),)

PICKS, BELIEVED_PICKS = (GRASP, PICK), (GRASP, BELIEVE)
"""How the arm picks, and nothing else."""
