"""Policies to compare with: the planned motion, the same with a stop, a servo with a stop, and planning again.

A policy is called with an observation of `HandoverEnv` and says an action. One that is a class is made for an
environment, `Policy(env)`, before each episode; its `action` says which kind of action it gives.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.closed_loop.arm import ee_and_jacobian, joint_speeds, twist_between
from r2h_batch.closed_loop.env import End, HandoverEnv
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.plan import plan_paths, random_key
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.plugins import Registry

Observation = dict[str, Tensor]

POLICIES: Registry[Any] = Registry(
    "policy",
    wrong=lambda name, thing: (
        "" if callable(thing) else f"is {thing!r:.100}; it must be a function or a class"
    ),
)
"""By their names in commands: classes of this file, and what packages name as `policy.NAME`."""

SLOW_M, STOP_M = 0.10, 0.02
"""Nearer than the first to the hand that it sees, a robot slows down; nearer than the second it stands."""
REPLAN_HZ = 2.0
FOLLOW = 0.15


@POLICIES("planned")
class Planned:
    """The motion that was planned before the episode, blind. Each segment keeps its time law; the next one begins
    with a step, so that every waypoint is a sample.

    Args:
        env: whose trials it moves; `env.scores` has their plans.
    """

    action = "posture"

    def __init__(self, env: HandoverEnv) -> None:
        scores = env.scores
        self.step_s, self.speed, self.acceleration = env.step_s, env.speed, env.acceleration
        home = torch.tensor(
            env.scene.config.workplace.home_q, dtype=torch.float32, device=env.q.device
        )
        whole, length = scores.path, scores.path_len.long()
        slot = torch.arange(whole.shape[1], dtype=torch.int64, device=length.device)
        last = (length - 1).clamp(min=0)[:, None]
        rows = torch.arange(len(length), dtype=torch.int64, device=length.device)[:, None]
        postures = whole[rows, slot.minimum(last)]
        self.path = torch.where((length > 0)[:, None, None], postures, home)
        turns = (self.path[:, 1:].double() - self.path[:, :-1].double()).abs()
        self.far = (turns * env.weight).amax(2)
        steps = torch.ceil(self._duration(self.far) / self.step_s - 1e-6)
        self.begin = self.step_s * torch.nn.functional.pad(steps.cumsum(1), (1, 0))
        self.clock = torch.zeros(len(length), dtype=torch.float64, device=length.device)

    def __call__(self, observation: Observation) -> Float32[Tensor, "b j"]:
        self.clock = self.clock + self.step_s
        return self.posture(self.clock)

    def _duration(self, far: Tensor) -> Tensor:
        v, a = self.speed, self.acceleration
        return torch.where(far >= v * v / a, far / v + v / a, 2 * (far / a).sqrt())

    def posture(self, time_s: Float64[Tensor, " b"]) -> Float32[Tensor, "b j"]:
        """Joint angles (B, J; rad) of the plan at a time of each row's own.

        Args:
            time_s: (B,) seconds since the row's episode began.
        """
        v, a = self.speed, self.acceleration
        k = (self.begin[:, 1:] <= time_s[:, None] + 1e-9).sum(1).clamp(max=self.far.shape[1] - 1)
        row = torch.arange(len(k), dtype=torch.int64, device=k.device)
        far, t = self.far[row, k], time_s - self.begin[row, k]
        whole = self._duration(far)
        near = torch.minimum(t, whole - t).clamp(min=0)  # the trapezoid is symmetric
        ramp = torch.minimum(torch.full_like(far, v / a), whole / 2)
        gone = torch.where(near <= ramp, 0.5 * a * near * near, a * ramp * (near - 0.5 * ramp))
        gone = torch.where(t <= whole / 2, gone, far - gone)
        share = torch.where(t >= whole - 1e-9, 1.0, gone / far.clamp(min=1e-12))[:, None]
        p, q = self.path[row, k].double(), self.path[row, k + 1].double()
        return torch.where(share >= 1.0, q, p + share * (q - p)).float()


@POLICIES("stop")
class StopAndWait(Planned):
    """The planned motion, which stands while the hand that it sees is nearer than `STOP_M`.

    Args:
        env: whose trials it moves; `env.scores` has their plans.
    """

    action = "posture"
    RAMP_S = 0.25

    def __init__(self, env: HandoverEnv) -> None:
        super().__init__(env)
        self.pace = torch.ones_like(self.clock)

    def __call__(self, observation: Observation) -> Float32[Tensor, "b j"]:
        go = torch.where(observation["gap"] < STOP_M, -1.0, 1.0)
        self.pace = (self.pace + go * self.step_s / self.RAMP_S).clamp(0.0, 1.0)
        self.clock = self.clock + self.step_s * self.pace
        return self.posture(self.clock)


@POLICIES("servo")
class Servo(Planned):
    """The planned motion with a goal that follows the hand: the posture of the handover pose beside the hand that
    it sees, found by damped least squares from the planned goal on. The path bends with it, in proportion to how
    far it has come. Slows down from `slow_m` to the hand that it sees, stands from `stop_m` on, and where it
    would not keep off table, robot and object.

    Args:
        env: whose trials it moves; `env.scores` has their plans.
        slow_m: distance, one number or (B,).
        stop_m: distance, one number or (B,).
        follow: share of the way to where the hand is seen that the goal goes in a step, against noise; one number
            or (B,).
    """

    action = "posture"
    GOAL_RAD = 0.1
    """The most that the goal's joints turn in a step."""

    def __init__(
        self,
        env: HandoverEnv,
        *,
        slow_m: float | Float64[Tensor, " b"] = SLOW_M,
        stop_m: float | Float64[Tensor, " b"] = STOP_M,
        follow: float | Float64[Tensor, " b"] = FOLLOW,
    ) -> None:
        super().__init__(env)
        self.env, self.robot = env, env.scene.robot
        self.slow_m, self.stop_m, self.follow = (
            torch.as_tensor(x, dtype=torch.float64, device=self.clock.device).expand(
                len(self.clock)
            )
            for x in (slow_m, stop_m, follow)
        )
        self.goal = self.path[:, -1].double()
        self.end_s = self.begin[:, -1].clamp(min=self.step_s)

    def __call__(self, observation: Observation) -> Float32[Tensor, "b j"]:
        T_wanted = se3.matmul(
            observation["T_world_hand"].double(), observation["T_hand_ee"].double()
        )
        T, jacobian = ee_and_jacobian(self.robot, self.goal)
        turn = self.follow[:, None] * joint_speeds(jacobian, twist_between(T, T_wanted))
        self.goal = self.goal + turn / (turn.abs().amax(1, keepdim=True) / self.GOAL_RAD).clamp(
            min=1.0
        )
        room = (self.slow_m - self.stop_m).clamp(min=1e-6)
        pace = ((observation["gap"].double() - self.stop_m) / room).clamp(0.0, 1.0)
        self.clock = torch.minimum(self.clock + self.step_s * pace, self.end_s)
        bent = (self.clock / self.end_s)[:, None] * (self.goal - self.path[:, -1].double())
        to, q = self.posture(self.clock).double() + bent, observation["q"].double()
        most = self.speed * self.step_s * pace
        turns = (to - q).abs() * self.env.weight
        share = (most / turns.amax(1).clamp(min=1e-9)).clamp(max=1.0)
        to = (q + (to - q) * share[:, None]).float()
        return torch.where(self.env.keeps_off(to)[:, None], to, observation["q"])


@POLICIES("replan")
class Replan:
    """Plans twice a second, with the judge's planner from where the arm is to the handover pose beside the hand that it
    sees, while that hand has moved since the last plan or there is none; goes from waypoint to waypoint. Without a
    path it stands. Slows down as `Servo` does.

    Args:
        env: whose trials it moves.
    """

    action = "velocity"
    MOVED_M, MOVED_RAD = 0.01, 0.07
    """Shift of the seen hand after which a new path is planned: more than the noise of frames
    [choice]."""
    ROUNDS = (50,)
    """Rounds of a search: as many as most searches need (`PlanConfig.rounds`)."""
    THERE_RAD = 1e-3

    def __init__(self, env: HandoverEnv) -> None:
        self.env, self.every, self.k = env, max(1, round(env.config.rate_hz / REPLAN_HZ)), 0
        b, device = env.num_envs, env.q.device
        self.path = env.q[:, None].repeat(1, WAYPOINTS, 1)
        self.length = torch.ones(b, dtype=torch.int64, device=device)
        self.next = torch.zeros(b, dtype=torch.int64, device=device)
        self.planned = torch.zeros(b, dtype=torch.bool, device=device)
        self.T_planned_for = torch.eye(4, dtype=torch.float64, device=device).repeat(b, 1, 1)
        self.key = random_key(env.trials.trial_id)

    def __call__(self, observation: Observation) -> Float32[Tensor, "b j"]:
        if self.k % self.every == 0:
            with self.env.evaluator.working():
                self._plan(observation)
        self.k += 1
        env = self.env
        rows = torch.arange(len(self.path), dtype=torch.int64, device=self.path.device)
        q = observation["q"].double()
        there = (self.path[rows, self.next] - q).abs().amax(1) < self.THERE_RAD
        self.next = torch.where(there, self.next + 1, self.next).minimum(self.length - 1)
        left = self.path[rows, self.next].double() - q
        far = (left.abs() * env.weight).amax(1)
        # as fast as it may be to come to rest there
        speed = torch.minimum((2 * env.acceleration * far).sqrt(), far / env.step_s).clamp(
            max=env.speed
        )
        pace = ((observation["gap"].double() - STOP_M) / (SLOW_M - STOP_M)).clamp(0.0, 1.0)
        pace = torch.where(self.planned, pace, 0.0)
        v = left * (pace * speed / far.clamp(min=1e-9))[:, None]
        return torch.where(env.keeps_off(v)[:, None], v, 0.0).float()

    def _plan(self, observation: Observation) -> None:
        env = self.env
        T_wanted = se3.matmul(
            observation["T_world_hand"].double(), observation["T_hand_ee"].double()
        )
        off = twist_between(self.T_planned_for, T_wanted)
        way, turn = (se3.dot(x, x).sqrt() for x in (off[:, :3], off[:, 3:]))
        moved = (way > self.MOVED_M) | (turn > self.MOVED_RAD)
        runs = env.ends == int(End.RUNNING)
        rows = torch.nonzero(runs & (moved | ~self.planned)).flatten()
        if not len(rows):
            return
        T = se3.orthonormalise(T_wanted[rows]).float()
        ik = solve_ik(T, robot=env.scene.robot, home=env.scene.config.workplace.home_q)
        config = replace(env.scene.config.plan, rounds=self.ROUNDS, seed=self.k)
        found = plan_paths(
            env.scene, env.obstacles(observation["T_world_hand"][rows], rows), ik.q, ik.valid, ik.reachable, self.key[rows],
            config, execute=env.scene.config.execute, start=observation["q"][rows],
        )  # fmt: skip
        some = (found.length > 0)[:, None, None]
        self.path[rows] = torch.where(some, found.path, observation["q"][rows][:, None])
        self.length[rows] = found.length.long().clamp(min=1)
        self.next[rows], self.planned[rows] = 0, found.length > 0
        self.T_planned_for[rows] = T_wanted[rows]


def kind_of_action(policy: Callable[..., Any]) -> str:
    """A policy's kind of action; joint velocities where it says none.

    Args:
        policy: a class or function; its attribute `action`, if any.
    """
    return str(getattr(policy, "action", "velocity"))
