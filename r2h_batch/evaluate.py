"""The Evaluator: a batch of handovers in, verdicts with margins and reasons out.

A row passes these stages in this order. Their files stand in `r2h_batch.judge`:

| stage | file | result |
|---|---|---|
| inputs | `inputs`, `object_errors`, `execution_error` | poses and trials that fit; poses as a robot with errors reaches them |
| grasp | `attach`, `grasp_physics` | the object in the gripper: invalid rows, Stability's margin, poses of all bodies |
| pick | `pick` | whether the arm gets the object from the table, where the benchmark asks for it |
| IK | `ik` | every branch of the arm that reaches the handover pose |
| plan | `plan` | a path without collision to one of the branches, from home or from where the object is lifted |
| motion | `motion.time_law`, `motion.execute` | the path with times, as the arm executes it |
| clearance | `distance` | where the robot is nearest to the receiver |
| verdict | `metrics`, `scores` | five criteria with margins, and Pick where the benchmark asks for it; one outcome |
| giving | `reception`, `received` | whether the person can take it, where the benchmark asks |

`_score_planned` runs all stages. `_score_pose` has the goal posture (`goal`) in place of a path, and
`_score_trace` has a motion that the caller gives. `prepared.py` has the rest: construction, copies, chunks of rows, memory.
"""

import copy
import time
import warnings
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.io.progress import busy
from r2h_batch.base.launch.memory import in_chunks
from r2h_batch.base.validate import instance_of, suggest_names
from r2h_batch.config import EvalConfig
from r2h_batch.judge import metrics
from r2h_batch.judge.attach import AttachedBatch, attach_object
from r2h_batch.judge.compile import compile_stages
from r2h_batch.judge.distance import (
    NearestApproach,
    hand_distance,
    hand_distance_at,
    nearer_of,
    over_motion,
    person_distance,
    person_distance_at,
)
from r2h_batch.judge.goal import failed_clearance, judge_goals, weaken_singular_reason
from r2h_batch.judge.ik import IkResult, home_posture, nearest_turns, one_branch, solve_ik
from r2h_batch.judge.inputs import (
    Stages,
    check_benchmark,
    check_indices,
    check_receiver,
    checked_inputs,
    warn_of_doubts,
    warn_of_no_gradient,
)
from r2h_batch.judge.presented import presented
from r2h_batch.judge.scores import motion_scores, not_given, pose_fields, pose_scores, verdict
from r2h_batch.prepared import Prepared
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.training import torch_op
from r2h_batch.training.gradients import differentiable
from r2h_batch.types import GivenScores, PlanReason, ScoreInputs, Scores, Trials

if TYPE_CHECKING:
    from r2h_batch.judge.pick import Picked
    from r2h_batch.judge.plan import Plan
    from r2h_batch.judge.trace import Trace

# Stages of paths and motions are imported where they are called: with their kernels and MuJoCo they
# would take a fifth of the time to the first verdict on a pose.

SMALL_ROWS = 255
"""CPU pose calls up to SMALL_ROWS rows are recorded and replayed (`base.launch.repeated`)."""


class Evaluator(Prepared):
    """Judges predicted handovers on one device. Build it once: it holds the scene's tables and
    compiled kernels.

    Args:
        benchmark: what is judged (`load_benchmark`); None: the default benchmark.
        config: how it is judged, planning and motion: a configuration, or a preset's name (`r2h-batch ls presets`);
            None: the default preset. Its thresholds and workplace must be defaults or equal the benchmark's.
        device: `cpu`, `cuda` or `cuda:N`.
        threads: CPU threads of a call; None: all cores.
        plans_in: the cameras by whose images arms are planned (docs/pick.md, "What planning believes"); None: planning
            knows the truth. For benchmarks that ask for Pick.

    Raises:
        TypeError, ValueError: one of these is something else.
    """

    @suggest_names
    def score(
        self,
        T_obj_ee: Float32[Tensor, "*g 4 4"],
        T_world_ee: Float32[Tensor, "*b 4 4"],
        trials: Trials,
        stages: Stages = "all",
        *,
        keep_motion: bool = False,
    ) -> Scores:
        """Verdicts of B handovers: outcome, five criteria with margins (m), reasons, times, joint
        path.

        A row has the same bits for any batch size, order, chunk and thread count on one device. The
        first call on a CPU warns of poses that look transposed, exchanged or in millimetres.

        Args:
            T_obj_ee: grasps, (B, 4, 4): the ee in the object's frame, m. (N, K, 4, 4) for K candidates
                of each of N trials; (N, 4, 4) or (N, 1, 4, 4) where each trial has one grasp for K
                poses. Tensors on the evaluator's device, NumPy arrays or nested lists of float32 or
                float64; judged in float32.
            T_world_ee: handover poses: the ee in the world frame, m, (B, 4, 4) or (N, K, 4, 4).
                Rotations off by at most 1e-3 are orthonormalised.
            trials: B (or N) trials.
            stages: `all`: the benchmark. `pose`: what needs no path, with the same kernels
                (Stability, Reach, Affordance; Plan and Safe at the goal posture). A pose that fails
                there fails the benchmark too (docs/training_loop.md). Its margins have gradients
                where poses require them (docs/gradients.md).
            keep_motion: also return the executed joint angles (24 kB for 8 s of motion).

        Returns:
            Scores of B (or N K) rows, trial by trial (`Scores.by_trial`). A row whose matrix is not a
            rigid transform is INVALID_INPUT; other rows are not affected. `pose`: `path` has width 0, times are NaN,
            `q_goal` and Plan's margin are those of `judge.goal.Goal`.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        T_obj_ee, T_world_ee, trials = self._known_inputs.checked(
            self.scene, T_obj_ee, T_world_ee, trials, stages
        )
        check_receiver(self.config, trials)
        if stages == "all" and _differentiates(T_obj_ee, T_world_ee):
            warn_of_no_gradient()
        if torch.compiler.is_compiling():
            # the operator has the columns of the five criteria alone, and no bodies
            if self.benchmark.asks or self.config.receiver == "body":
                return torch.compiler.disable(self.score)(
                    T_obj_ee, T_world_ee, trials, stages, keep_motion=keep_motion
                )
            return torch_op.call(self.handle, T_obj_ee, T_world_ee, trials, stages)
        check_benchmark(self.benchmark, trials)
        first = not self.called and not T_obj_ee.is_cuda  # looking at values would wait for a GPU
        if first:
            self.called = True
            warn_of_doubts(T_obj_ee, T_world_ee, trials)
        with busy("judging") if first else nullcontext(), self.working():
            check_indices(self.scene, trials)
            compile_stages(self.scene, paths=stages == "all")
            scores = self._score(
                T_obj_ee.detach(), T_world_ee.detach(), trials, stages, keep_motion
            )
            if stages == "pose" and _differentiates(T_obj_ee, T_world_ee):
                judge = partial(self.score, stages="pose")
                scores = differentiable(judge, scores, (T_obj_ee, T_world_ee), trials)
            if first and (words := self.hint(scores, T_obj_ee, T_world_ee, trials)):
                warnings.warn(words, stacklevel=3)
            # Copies: an optimizer's step in place must not change the stored inputs, from which
            # pictures of these scores are drawn.
            scores = scores.with_inputs(
                ScoreInputs(T_obj_ee.detach().clone(), T_world_ee.detach().clone(), trials, self)
            )
            return scores if stages == "pose" else self._given(scores)

    @suggest_names
    def score_motion(
        self,
        T_obj_ee: Float32[Tensor, "b 4 4"],
        q: Float[Tensor, "b w j"],
        time_s: Float[Tensor, "b w"] | Float[Tensor, " w"],
        trials: Trials,
        *,
        length: Int[Tensor, " b"] | None = None,
        planned_q: Float[Tensor, "b p j"] | None = None,
        planned_length: Int[Tensor, " b"] | None = None,
    ) -> Scores:
        """Verdicts of B motions that you planned: the same five criteria and the same columns.

        Plan: the motion collides with nothing (certified between the samples) and keeps the robot's
        limits of angles and speeds; `plan_reason` is OK, MOTION_IN_COLLISION, BEYOND_JOINT_LIMITS
        or BEYOND_SPEED_LIMITS. It may start anywhere. Safe: along the motion as given, no
        simulator. The handover pose is where the motion ends. `t_exec_s` is the motion's duration, `t_plan_s` NaN.

        Args:
            T_obj_ee: the grasp, ee in the object's frame, m.
            q: angles of the robot's joints in W samples, rad; joints move at a constant rate between two samples.
            time_s: time of each sample, s; of all motions at once if it is (W,).
            trials: B trials.
            length: how many samples of each motion count, 2 to W; None: all W.
            planned_q: the planned path, if q is its execution by a robot or a simulator. Plan then judges
                both; if the robot touches the hand, Safe judges q and Plan judges planned_q alone.
                The other criteria judge q. None: q is the plan.
            planned_length: as `length`, of the plan.

        Returns:
            Scores of B rows. INVALID_INPUT: an angle is not finite, times go back, are not finite or
            end after 1e9 s, a joint moves between two samples of equal time, or the plan's first sample is more
            than 0.1 rad away from the motion's. A motion
            beyond the limits of angles is judged as one without a path.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        from r2h_batch.judge.trace import checked_plan, checked_trace, final_pose

        # torch.compile cannot trace this function. As a decorator, `disable` would cost every import a second.
        if torch.compiler.is_compiling():
            return torch.compiler.disable(self.score_motion)(
                T_obj_ee,
                q,
                time_s,
                trials,
                length=length,
                planned_q=planned_q,
                planned_length=planned_length,
            )
        instance_of(Trials, "benchmark.trials(...), or r2h_batch.Trials")("trials", trials)
        check_benchmark(self.benchmark, trials)
        for section in ("execution_error", "object_errors"):
            if getattr(self.config, section).any:
                raise ValueError(
                    f"{section} changes poses, and motions are judged as they are; score motions"
                    " with an Evaluator without it"
                )
        trace = checked_trace(q, time_s, length, len(trials), self.scene)
        plan = trace
        if planned_q is not None:
            plan = checked_plan(planned_q, planned_length, trace, self.scene)
            trace = replace(trace, usable=trace.usable & plan.usable)
        T_world_ee = final_pose(self.scene, trace)
        T_obj_ee, T_world_ee, trials = checked_inputs(
            self.scene, T_obj_ee, T_world_ee, trials, "all"
        )
        T_obj_ee = T_obj_ee.detach()
        check_receiver(self.config, trials)

        def chunk(first: int, last: int) -> Scores:
            rows = slice(first, last)
            motion = trace[rows]
            return self._score_trace(
                T_obj_ee[rows],
                T_world_ee[rows],
                motion if plan is trace else plan[rows],
                motion,
                trials[rows],
            )

        with self.working():
            check_indices(self.scene, trials)
            scores = Scores.concatenate(in_chunks(len(trials), self.rows_at_once(), chunk))
        if not self.moved and not T_obj_ee.is_cuda and planned_q is None:
            self.moved = True
            if words := self.motion_hint(scores, T_obj_ee, trials, q, time_s, length):
                warnings.warn(words, stacklevel=3)
        scores = scores.with_inputs(ScoreInputs(T_obj_ee.clone(), T_world_ee, trials, self))
        with self.working():
            return self._given(scores)

    def _given(self, scores: Scores) -> Scores:
        """The same verdicts once the person has been asked to take what was presented, where the benchmark asks for it."""
        if not isinstance(scores, GivenScores):
            return scores
        from r2h_batch.judge.received import given

        return given(scores)

    def _score_planned(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, keep_motion: bool
    ) -> Scores:
        """Every stage: hold, IK, plan, move, judge."""
        from r2h_batch.judge.motion.execute import execute
        from r2h_batch.judge.motion.time_law import time_path

        scene, config = self.scene, self.config
        held = attach_object(scene, T_obj_ee, T_world_ee, trials, config)
        active = held.active
        if self.plans_in is None:
            picked = self._picked(held, T_obj_ee, trials, ways=True)
            planned, missed_m, t_plan_s = self._plan(held, trials, picked)
        else:
            picked, planned, missed_m, t_plan_s = self._believed(held, T_obj_ee, trials)
        weight = self.scene.robot.joint_weight
        motion = time_path(planned.path, planned.length, config.execute, weight)
        # the clearance is certified only for exact edges and the true hand
        certified = (
            planned.clearance_m
            if (config.plan.edge_check, config.plan.hand) == ("exact", "true")
            and self.plans_in is None
            else None
        )
        executed = execute(
            scene,
            held.body_poses,
            planned.path,
            planned.length,
            motion,
            config.execute,
            clearance_m=certified,
        )

        nearest = hand_distance(scene, held.body_poses, executed, active)
        body_m, body, _ = over_motion(
            scene, held.body_poses, executed, partial(self._person_distance, trials)
        )  # fmt: skip
        goal_reached = (planned.reason == int(PlanReason.OK)) & executed.settled
        shared, nearest = self._judge(
            held,
            goal_reached=goal_reached,
            moves=active & (executed.length > 0),
            clearance_m=torch.where(goal_reached, planned.clearance_m, missed_m),
            reason=planned.reason,
            nearest=nearest,
            person=(body_m, body),
            valid=executed.valid,
            picked=picked,
        )
        region = presented(scene, held, config.thresholds)
        return motion_scores(
            trials.trial_id, shared, region, active, planned, motion, executed, nearest, config.execute,
            t_plan_s=t_plan_s, keep_motion=keep_motion, body_m=body_m,
        )  # fmt: skip

    def _plan(
        self, held: AttachedBatch, trials: Trials, picked: "Picked | None"
    ) -> tuple["Plan", Tensor, float]:
        """Paths from home, or from where the object is lifted; how far rows without one are from one (m, below 0); seconds a
        trial."""
        from r2h_batch.judge.plan import plan_paths, random_key

        scene, config = self.scene, self.config
        plan_start = time.perf_counter()
        ik, branches = self._branches(config, held)
        goals, begins, start = ik.q, held.active, None
        if picked is not None:  # carried from where the lift ends
            begins = begins & picked.picked
            home = home_posture(str(begins.device), config.workplace.home_q)
            start = torch.where(begins[:, None], picked.lifted, home)
            goals = nearest_turns(ik.q, start, scene.robot)
        planned = plan_paths(
            scene,
            held.planner_poses,
            goals,
            branches,
            begins,
            random_key(trials.trial_id),
            config.plan,
            execute=config.execute,
            start=start,
        )
        t_plan_s = (time.perf_counter() - plan_start) / max(len(trials), 1)
        missed_m = failed_clearance(
            scene, held.planner_poses, held.T_world_ee, ik, branches, planned.reason
        )  # fmt: skip
        reason = weaken_singular_reason(planned.reason, ik)
        return replace(planned, reason=reason), missed_m, t_plan_s

    def _believed(
        self, held: AttachedBatch, T_obj_ee: Tensor, trials: Trials
    ) -> tuple["Picked", "Plan", Tensor, float]:
        """As `_picked` and `_plan`, where the arm is planned in what cameras saw: what it does there, judged in the truth."""
        from r2h_batch.judge.followed import follow_plans, no_plan, nothing_to_pick, put
        from r2h_batch.judge.pick import follow_picks, judge_picks
        from r2h_batch.observe.believed_world import believed_world

        assert self.plans_in is not None  # the caller has asked
        scene, b, device = self.scene, len(trials), held.active.device
        T_world_obj = self._moments(held, trials)
        T_world_grasp = se3.matmul(T_world_obj.double(), T_obj_ee.double())
        picked = nothing_to_pick(scene, T_world_grasp.float())
        planned = no_plan(b, len(scene.robot.joints), device)
        missed_m = torch.full_like(planned.clearance_m, -torch.inf)
        t_plan_s, rows = 0.0, torch.nonzero(held.active)[:, 0]
        world = believed_world(scene, trials[rows], self.plans_in) if len(rows) else None
        if world is not None:
            rows = rows[world.row.to(device)]
            grasps, rest = world.grasps(T_world_grasp[rows]), world.T_world_obj.float()
            seen = attach_object(
                world.scene, grasps, held.T_world_ee[rows], world.trials, self.config
            )
            own = judge_picks(world.scene, grasps, rest, world.trials)
            plan, missed, seconds = self.in_scene(world.scene)._plan(seen, world.trials, own)
            put(picked, rows, own)
            put(planned, rows, plan)
            missed_m[rows], t_plan_s = missed, seconds * len(rows) / b
        picked = follow_picks(scene, T_obj_ee, T_world_obj, trials, picked)
        planned = follow_plans(scene, held, planned, held.active & picked.picked)
        met = planned.reason == int(PlanReason.MOTION_IN_COLLISION)
        return picked, planned, torch.where(met, planned.clearance_m, missed_m), t_plan_s

    def in_scene(self, scene: Scene) -> "Evaluator":
        """The same evaluator in another scene, where planning knows the truth.

        Args:
            scene: its benchmark has the same limits and criteria.
        """
        twin = copy.copy(self)
        twin.scene, twin.plans_in = scene, None
        return twin

    def _score_trace(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, plan: "Trace", trace: "Trace", trials: Trials
    ) -> Scores:
        """The stages of a motion given by the caller: grasp, then tests of the motion in place of IK and planning, verdict.

        A plan beside the motion is tested too, and the worse of both counts.
        """
        from r2h_batch.judge.trace import executed_trace, plan_of_trace, worse_plan

        scene = self.scene
        held = attach_object(scene, T_obj_ee, T_world_ee, trials, self.config)
        active, poses = held.active, held.body_poses
        if self.config.receiver == "body":
            assert trials.receiver is not None  # `check_receiver` has refused its absence
            poses = with_person(scene, poses, trials.receiver, hand=True)
        planned = plan_of_trace(scene, poses, trace, active)
        executed, motion = executed_trace(trace, planned)
        moves = active & (planned.length > 0)  # before a plan beside it may fail
        nearest = hand_distance(scene, held.body_poses, executed, active)
        person = self._person_distance(trials, held.body_poses, executed.path, executed.length)
        if plan is not trace:
            free_plan = plan_of_trace(scene, poses, plan, active)
            planned = worse_plan(free_plan, planned, nearest.distance_m <= 0)
        shared, nearest = self._judge(
            held,
            goal_reached=planned.reason == int(PlanReason.OK),
            moves=moves,
            clearance_m=planned.clearance_m,
            reason=planned.reason,
            nearest=nearest,
            person=person,
            valid=executed.valid,
            picked=self._picked(held, T_obj_ee, trials, ways=True),
        )
        region = presented(scene, held, self.config.thresholds)
        return motion_scores(
            trials.trial_id, shared, region, active, planned, motion, executed, nearest, None,
            t_plan_s=float("nan"), keep_motion=False, body_m=person[0],
        )  # fmt: skip

    def _score_pose(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> Scores:
        """The stages of `_score_planned` that need no path."""
        of_trials = trials._tensors()
        of_trials.pop("person", None)  # no stage looks at it
        inputs = tuple(x.contiguous() for x in (T_obj_ee, T_world_ee, *of_trials.values()))
        if 0 < len(trials) <= SMALL_ROWS and not T_obj_ee.is_cuda and not self.benchmark.asks:
            kept = self._small_calls(self._judge_pose, *inputs)
            return pose_scores(trials.trial_id, {name: x.clone() for name, x in kept.items()})
        return pose_scores(trials.trial_id, self._judge_pose(*inputs))

    def _judge_pose(self, *inputs: Tensor) -> dict[str, Tensor]:
        """Results of `_score_pose` for poses and trials, field by field; it launches
        mostly kernels, so small calls can be recorded."""
        scene, config = self.scene, self.config
        T_obj_ee, T_world_ee, *of_trials = inputs
        trials = Trials(*of_trials)
        held = attach_object(scene, T_obj_ee, T_world_ee, trials, config)
        active = held.active
        ik, branches = self._branches(config, held)
        goal = judge_goals(scene, held.planner_poses, held.T_world_ee, ik, branches, active)
        nearest = hand_distance_at(scene, held.body_poses, goal.q, active)
        person = None
        if trials.receiver is not None:
            person = person_distance_at(scene, held.body_poses, trials.receiver, goal.q, active)
        shared, nearest = self._judge(
            held,
            goal_reached=None,
            moves=active,
            clearance_m=goal.clearance_m,
            reason=goal.reason,
            nearest=nearest,
            person=person,
            valid=None,
            picked=self._picked(held, T_obj_ee, trials, ways=False),
        )
        found = shared | pose_fields(presented(scene, held, config.thresholds), goal, nearest)
        if person is not None:
            found["body_m"] = person[0]
        return found

    def _judge(
        self,
        held: AttachedBatch,
        *,
        goal_reached: Tensor | None,
        moves: Tensor,
        clearance_m: Tensor,
        reason: Tensor,
        nearest: NearestApproach,
        person: tuple[Tensor, Tensor] | None,
        valid: Tensor | None,
        picked: "Picked | None",
    ) -> tuple[dict[str, Tensor], NearestApproach]:
        """The fields of `Scores` that need no path, and where the robot is nearest to the
        receiver; arguments as in `Evidence` and `verdict`."""
        scene, config = self.scene, self.config
        if config.receiver == "body" and person is not None:
            nearest = nearer_of(nearest, *person)
        slip_m = None
        if config.stability == "physics":
            from r2h_batch.judge.grasp_physics import shake

            rows = held.active & (held.grasp.margin_m >= 0)
            slip_m = shake(scene.objects, held.objects, held.attached, rows, scene.robot)
        evidence = metrics.Evidence(
            scene, config, held, goal_reached, moves, clearance_m, reason, nearest, slip_m, picked
        )
        found = verdict(metrics.judge(evidence), held, slip_m, valid)
        if picked is not None:
            found["pick"] = torch.stack([picked.reason, picked.pair, picked.body], 1)
            if "received" in self.benchmark.asks:
                found |= not_given(len(picked.reason), picked.reason.device)
        return found, nearest

    def _picked(
        self, held: AttachedBatch, T_obj_ee: Tensor, trials: Trials, *, ways: bool
    ) -> "Picked | None":
        """Whether the arm picks the objects where they rest; None where the benchmark does not ask.
        `ways`: also by the ways to the grasp and up from it."""
        if "pick" not in self.benchmark.asks:
            return None
        from r2h_batch.judge.pick import judge_picks

        T_world_obj = self._moments(held, trials)
        return judge_picks(self.scene, T_obj_ee, T_world_obj, trials, ways=ways)

    def picks(self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> "Picked":
        """How the arm picks, or fails to, as a part of the verdict on B handovers.

        Args:
            T_obj_ee: (B, 4, 4) grasps, as of `score`.
            T_world_ee: (B, 4, 4) handover poses, as of `score`.
            trials: B trials of a benchmark that asks for Pick.

        Raises:
            TypeError, ValueError: shape, dtype or device do not fit; before any work.
        """
        T_obj_ee, T_world_ee, trials = checked_inputs(
            self.scene, T_obj_ee, T_world_ee, trials, "all"
        )
        with self.working():
            held = attach_object(self.scene, T_obj_ee, T_world_ee, trials, self.config)
            if self.plans_in is not None:
                return self._believed(held, T_obj_ee, trials)[0]
            found = self._picked(held, T_obj_ee, trials, ways=True)
        assert found is not None  # the benchmark asks for it
        return found

    def _moments(self, held: AttachedBatch, trials: Trials) -> Float32[Tensor, "b 4 4"]:
        """Where the objects rest, m; the identity where a hand is no pose and has no moment."""
        from r2h_batch.observe.known import known_moments

        active = torch.nonzero(held.active)[:, 0]
        T_world_obj = torch.eye(4, dtype=torch.float32, device=active.device).repeat(
            len(trials), 1, 1
        )
        T_world_obj[active] = known_moments(self.scene).of(trials[active])
        return T_world_obj

    def _person_distance(
        self,
        trials: Trials,
        body_poses: BodyPoses,
        path: Tensor,
        length: Tensor,
        rows: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """How near the robot comes to the receiver's arm and torso, and which of its bodies; NaN and -1 where
        there is none. `rows`: the trials of the paths, where these are not all."""
        if trials.receiver is not None:
            receiver = trials.receiver if rows is None else trials.receiver[rows]
            return person_distance(self.scene, body_poses, receiver, path, length)
        return torch.full_like(path[:, 0, 0], torch.nan), torch.full_like(length, -1)

    def _branches(self, config: EvalConfig, held: AttachedBatch) -> tuple[IkResult, Tensor]:
        """All IK branches, and which of them may be used."""
        solve = solve_ik
        if config.ik.solver == "pytorch-kinematics":
            from r2h_batch.judge.ik_jacobian import solve_ik as solve
        robot, home = self.scene.robot, config.workplace.home_q
        ik = solve(held.T_world_ee, active=held.active, robot=robot, home=home)
        if config.plan.goals == "set":
            return ik, ik.valid
        return ik, one_branch(ik, held.T_world_ee, robot=robot, home=home)


def _differentiates(*poses: Tensor) -> bool:
    """Whether margins need gradients with respect to these poses."""
    return torch.is_grad_enabled() and any(T.requires_grad for T in poses)
