"""A built-in policy from the table on: a scripted pick, then the policy."""

from typing import Any

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.closed_loop.env import End
from r2h_batch.closed_loop.from_table import Phase, TableHandoverEnv
from r2h_batch.closed_loop.policies import SLOW_M, STOP_M, Observation, Planned, kind_of_action
from r2h_batch.judge.pick import picked
from r2h_batch.observe.known import known_moments

STRAIGHT_M_S = 0.1
"""Speed of the gripper on the straight ways into the grasp and up [choice]."""
THERE_RAD = 1e-6


class Picks:
    """Picks as Pick was judged: home, 10 cm before the grasp, straight in, close, straight up. Then `policy` goes on.

    Slows down and stands before a hand as `Servo` does, unless the policy is blind (`Planned` itself). Where Pick finds no way
    the arm stands.

    Args:
        env: whose trials it moves.
        policy: an instance of a class of `POLICIES`, made for `env`.
    """

    def __init__(self, env: TableHandoverEnv, policy: Any) -> None:
        inputs, scene = env.scores.inputs, env.scene
        assert inputs is not None
        self.env, self.policy = env, policy
        self.action = kind_of_action(policy)
        trials, device = env.trials, env.q.device
        found = picked(scene, inputs.T_obj_ee.to(device), known_moments(scene).of(trials), trials)
        self.found, b = found, env.num_envs
        self.to_grasp = Planned(env, (found.path, torch.where(found.picked, found.length, 0)))
        some = found.picked[:, None, None]
        home = env.q[:, None]
        self.way_in = _Straight(env, torch.where(some, found.way_in, home))
        self.way_up = _Straight(env, torch.where(some, found.way_up.flip(1), home))
        self.leg = torch.zeros(b, dtype=torch.int64, device=device)
        self.clock = torch.zeros(b, dtype=torch.float64, device=device)
        self.blind = type(policy) is Planned
        policy.goes = torch.zeros_like(self.clock)

    def __call__(self, observation: Observation) -> Float32[Tensor, "b a"]:
        env, q = self.env, observation["q"]
        phase = observation["phase"].to(torch.int64)
        legs = self._postures()
        row = torch.arange(len(q), dtype=torch.int64, device=q.device)
        # a leg is over when the arm is where it ends; closing when the gripper holds
        ends = torch.stack([leg[1] for leg in legs], 1)[row, self.leg.clamp(max=3)]
        there = (q - ends).abs().amax(1) <= THERE_RAD
        over = torch.where(self.leg == 2, phase >= int(Phase.LIFTS), there)
        over &= self.found.picked & (self.leg < 4) & (env.ends == int(End.RUNNING))
        self.leg = self.leg + over.long()
        self.clock = torch.where(over, 0.0, self.clock)
        room = (observation["gap"].double() - STOP_M) / (SLOW_M - STOP_M)
        pace = torch.ones_like(room) if self.blind else room.clamp(0.0, 1.0)
        self.clock = self.clock + env.step_s * pace
        own = torch.stack([leg[0] for leg in self._postures()], 1)[row, self.leg.clamp(max=3)]
        goes = self.leg == 4
        self.policy.goes = goes.double()
        asked = self.policy(observation)
        if self.action == "velocity":
            own = (own.double() - q.double()).div(env.step_s).float()
        arm = torch.where(goes[:, None], asked, own)
        closes = torch.where(self.leg == 2, -1.0, 0.0).to(arm.dtype)
        return torch.cat([arm, closes[:, None]], 1)

    def _postures(self) -> list[tuple[Tensor, Tensor]]:
        """Postures of each leg: the one at its clock, and the last one."""
        first = self.to_grasp
        last = first.path[:, -1]
        grasp = self.way_in.path[:, -1]
        return [
            (first.posture(self.clock), last),
            (self.way_in.posture(self.clock), grasp),
            (grasp, grasp),
            (self.way_up.posture(self.clock), self.way_up.path[:, -1]),
        ]


class _Straight:
    """Ways of postures that follow each other closely, from rest to rest."""

    def __init__(self, env: TableHandoverEnv, path: Float32[Tensor, "b w j"]) -> None:
        self.path = path
        turns = (path[:, 1:].double() - path[:, :-1].double()).abs()
        self.along = torch.nn.functional.pad((turns * env.weight).amax(2).cumsum(1), (1, 0))
        self.length = self.along[:, -1]
        # as fast as the joints may go, and no faster than the gripper should
        self.speed = (self.length * (STRAIGHT_M_S / 0.1)).clamp(min=1e-6, max=env.speed)
        self.acceleration = torch.minimum(
            2.0 * self.speed, torch.full_like(self.speed, 0.5 * env.acceleration)
        )

    def posture(self, time_s: Float64[Tensor, " b"]) -> Float32[Tensor, "b j"]:
        """Postures (rad) at a time of each row's own (s)."""
        v, a, whole = self.speed, self.acceleration, self.length
        ramp = torch.minimum(v / a, (whole / a).sqrt())  # no longer than half of the way
        top = a * ramp
        total = torch.where(top > 0, whole / top.clamp(min=1e-12) + ramp, 0.0)
        left = (total - time_s).clamp(min=0)
        begins = 0.5 * a * time_s.clamp(min=0) ** 2
        ends = whole - 0.5 * a * left**2
        steady = top * (time_s - 0.5 * ramp)
        gone = torch.where(time_s < ramp, begins, torch.where(left < ramp, ends, steady))
        gone = torch.where(time_s >= total, whole, gone)
        k = (self.along[:, 1:] <= gone[:, None]).sum(1).clamp(max=self.path.shape[1] - 2)
        row = torch.arange(len(k), dtype=torch.int64, device=k.device)
        first, second = self.along[row, k], self.along[row, k + 1]
        share = ((gone - first) / (second - first).clamp(min=1e-12)).clamp(0.0, 1.0)[:, None]
        p, q = self.path[row, k].double(), self.path[row, k + 1].double()
        at_end = (time_s >= total)[:, None]
        return torch.where(at_end, self.path[:, -1].double(), p + share * (q - p)).float()
