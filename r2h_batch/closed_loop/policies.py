"""Policies to compare with: the planned motion, the same with a stop, a servo with a stop, and planning again.

A policy is called with an observation of `HandoverEnv` and says an action. One that is a class is made for an
environment, `Policy(env)`, before each episode; its `action` says which kind of action it gives.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch import se3
from r2h_batch.closed_loop.arm import ee_and_jacobian, joint_speeds, twist_between
from r2h_batch.closed_loop.env import HandoverEnv
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.plan import path_clearances

__all__ = ["POLICIES", "Planned", "Replan", "Servo", "StopAndWait", "kind_of_action"]

Seen = dict[str, Tensor]

SLOW_M, STOP_M = 0.10, 0.02
"""Nearer than the first to the hand that it sees, a robot slows down; nearer than the second it stands."""
REPLAN_HZ = 2.0
FOLLOW = 0.15


class Planned:
    """The motion that was planned before the episode, blind. Each segment keeps its time law; the next one begins
    with a step, so that every waypoint is a sample."""

    action = "posture"

    def __init__(self, env: HandoverEnv) -> None:
        scores = env.scores
        self.step_s, self.speed, self.acceleration = env.step_s, env.speed, env.acceleration
        home = torch.tensor(
            env.scene.config.workplace.home_q, dtype=torch.float32, device=env.q.device
        )
        length = scores.path_len.long()
        slot = torch.arange(scores.path.shape[1], dtype=torch.int64, device=length.device)
        last = (length - 1).clamp(min=0)[:, None]
        rows = torch.arange(len(length), dtype=torch.int64, device=length.device)[:, None]
        path = scores.path[rows, slot.minimum(last)]
        self.path = torch.where((length > 0)[:, None, None], path, home)
        self.far = (self.path[:, 1:].double() - self.path[:, :-1].double()).abs().amax(2)
        steps = torch.ceil(self._duration(self.far) / self.step_s - 1e-6)
        self.begin = self.step_s * torch.nn.functional.pad(steps.cumsum(1), (1, 0))
        self.clock = torch.zeros(len(path), dtype=torch.float64, device=length.device)

    def __call__(self, seen: Seen) -> Float32[Tensor, "b 6"]:
        self.clock = self.clock + self.step_s
        return self.posture(self.clock)

    def _duration(self, far: Tensor) -> Tensor:
        v, a = self.speed, self.acceleration
        return torch.where(far >= v * v / a, far / v + v / a, 2 * (far / a).sqrt())

    def posture(self, time_s: Float64[Tensor, " b"]) -> Float32[Tensor, "b 6"]:
        """Where the plan has the arm at a time of each row's own."""
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


class StopAndWait(Planned):
    """The planned motion, which stands while the hand that it sees is nearer than `STOP_M`."""

    action = "posture"
    RAMP_S = 0.25

    def __init__(self, env: HandoverEnv) -> None:
        super().__init__(env)
        self.pace = torch.ones_like(self.clock)

    def __call__(self, seen: Seen) -> Float32[Tensor, "b 6"]:
        go = torch.where(seen["gap"] < STOP_M, -1.0, 1.0)
        self.pace = (self.pace + go * self.step_s / self.RAMP_S).clamp(0.0, 1.0)
        self.clock = self.clock + self.step_s * self.pace
        return self.posture(self.clock)


class Servo(Planned):
    """The planned motion with a goal that follows the hand: the posture of the handover pose beside the hand that
    it sees, found by damped least squares from the planned goal on. The path bends with it, in proportion to how
    far it has come. Slows down from `slow_m` to the hand that it sees, stands from `stop_m` on."""

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
        """`follow`: share of the way to where the hand is seen that the goal goes in a step, against noise. Numbers
        may differ from row to row."""
        super().__init__(env)
        self.robot = env.scene.robot
        self.slow_m, self.stop_m, self.follow = (
            torch.as_tensor(x, dtype=torch.float64, device=self.clock.device).expand(
                len(self.clock)
            )
            for x in (slow_m, stop_m, follow)
        )
        self.goal = self.path[:, -1].double()
        self.end_s = self.begin[:, -1].clamp(min=self.step_s)

    def __call__(self, seen: Seen) -> Float32[Tensor, "b 6"]:
        asked = se3.matmul(seen["T_world_hand"].double(), seen["T_hand_ee"].double())
        T, jacobian = ee_and_jacobian(self.robot, self.goal)
        turn = self.follow[:, None] * joint_speeds(jacobian, twist_between(T, asked))
        self.goal = self.goal + turn / (turn.abs().amax(1, keepdim=True) / self.GOAL_RAD).clamp(
            min=1.0
        )
        room = (self.slow_m - self.stop_m).clamp(min=1e-6)
        pace = ((seen["gap"].double() - self.stop_m) / room).clamp(0.0, 1.0)
        self.clock = torch.minimum(self.clock + self.step_s * pace, self.end_s)
        bent = (self.clock / self.end_s)[:, None] * (self.goal - self.path[:, -1].double())
        to, q = self.posture(self.clock).double() + bent, seen["q"].double()
        most = self.speed * self.step_s * pace
        return (
            q + (to - q) * (most / (to - q).abs().amax(1).clamp(min=1e-9)).clamp(max=1.0)[:, None]
        ).float()


class Replan:
    """Twice a second: the free straight joint line from where the arm is to a posture of the handover pose
    beside the hand that it sees, the shortest; between, along that line. Without one it stands. Stops as
    `Servo` does. (The judge's search begins at home, so a line that is blocked is not searched around.)"""

    action = "velocity"

    def __init__(self, env: HandoverEnv) -> None:
        self.env, self.every = env, max(1, round(env.config.rate_hz / REPLAN_HZ))
        self.k, self.goal = 0, env.q.clone()

    def __call__(self, seen: Seen) -> Float32[Tensor, "b 6"]:
        if self.k % self.every == 0:
            self._plan(seen)
        self.k += 1
        env = self.env
        left = self.goal.double() - seen["q"].double()
        far = left.abs().amax(1)
        # as fast as it may be to come to rest there
        speed = torch.minimum((2 * env.acceleration * far).sqrt(), far / env.step_s).clamp(
            max=env.speed
        )
        pace = ((seen["gap"].double() - STOP_M) / (SLOW_M - STOP_M)).clamp(0.0, 1.0)
        return (left * (pace * speed / far.clamp(min=1e-9))[:, None]).float()

    def _plan(self, seen: Seen) -> None:
        env, q = self.env, seen["q"]
        T = se3.orthonormalise(
            se3.matmul(seen["T_world_hand"].double(), seen["T_hand_ee"].double())
        ).float()
        ik = solve_ik(
            T,
            robot=env.scene.robot,
            home=env.scene.config.workplace.home_q,
        )
        far = (ik.q.double() - q[:, None].double()).abs().amax(2)
        order = torch.where(ik.valid, far, torch.inf).argsort(dim=1, stable=True)
        bodies = env.bodies(seen["T_world_hand"])
        row = torch.arange(len(q), dtype=torch.int64, device=q.device)
        self.goal, left = q.clone(), torch.ones(len(q), dtype=torch.bool, device=q.device)
        for turn in range(order.shape[1]):
            k = order[:, turn]
            tried = left & ik.valid[row, k]
            if not bool(tried.any()):
                break
            line = torch.stack([q, torch.where(tried[:, None], ik.q[row, k], q)], 1).contiguous()
            length = torch.where(tried, 2, 0).to(torch.int32)
            clearance, _, _ = path_clearances(env.scene, bodies, line, length)
            free = tried & (clearance > 0)
            self.goal = torch.where(free[:, None], line[:, 1], self.goal)
            left = left & ~free


POLICIES: dict[str, Any] = {
    "planned": Planned,
    "stop": StopAndWait,
    "servo": Servo,
    "replan": Replan,
}
"""By their names in commands."""


def kind_of_action(policy: Callable[..., Any]) -> str:
    """What a policy says: its `action`, else joint velocities."""
    return str(getattr(policy, "action", "velocity"))
