"""Margins that can be differentiated: the evaluator's own numbers forward, first-order changes at
the witnesses backward.

Where margins have kinks: docs/gradients.md. A witness attains a margin, and its motion gives the change
to first order (Danskin):

    Stability, width      the two outermost points of material between the pads; on a wall of the pads'
                          prism, where that wall cuts the surface. Of T_obj_ee; the opening is the
                          fixed point of width and pad height
    Stability, clearance  the object's point nearest to, or deepest in, a primitive of the open gripper
    Reach                 the object's point nearest to c_h. Of both poses, and how closing shifts the object
    Affordance            nearest points of finger and receiver's region. Of T_obj_ee, shift and opening
    Plan, goal            the nearest pair at the goal and its separating direction. Object and gripper
                          move with the ee frame, arm links with the inverse Jacobian of the branch, or
                          the pseudo-inverse
    Plan, unreachable     the residual in closed form: wrist centre out of reach, or too near to the
                          base's axis. Arms without a closed form: what the nearest posture misses
    Plan, start           the nearest pair at home. Of T_obj_ee
    Safe                  nearest points of the hand's mesh and a robot primitive at the goal; as Plan
    any other criterion   torch follows the poses through its function in judge/metrics.py
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.soft import with_gradient
from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig, Thresholds
from r2h_batch.judge import metrics
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.grasp import CUT_CAP_M
from r2h_batch.judge.ik import ROTATION_LEVER_M
from r2h_batch.scene.robot import ee_pose, ur_lengths
from r2h_batch.scene.scene import Scene
from r2h_batch.training import first_order, witnesses
from r2h_batch.types import CRITERIA, CollidingPair, PlanReason, Scores


def differentiable(
    scene: Scene,
    config: EvalConfig,
    scores: Scores,
    poses: tuple[Float[Tensor, "b 4 4"], Float[Tensor, "b 4 4"]],
    held: AttachedBatch,
    goal: Goal,
    nearest: NearestApproach,
) -> Scores:
    """`scores` of stages="pose", bit for bit, with margins that lead back to the two poses; rows
    that are no poses do not.

    `poses`: T_obj_ee and T_world_ee as they were given, with their history.
    """
    changes = MarginChanges(scene, config, scores, held, goal, nearest)
    first_order_only = [FirstOrderOnly.apply(T) for T in poses]
    return replace(scores, margin=with_gradient(scores.margin, changes(*first_order_only)))


class FirstOrderOnly(torch.autograd.Function):
    """The same poses, with a gradient that cannot be differentiated again.

    `changes` is right to first order only: of its own second derivatives one would learn nothing
    about the margins. (`once_differentiable` would let them pass where the incoming gradient is a
    constant.)
    """

    @staticmethod
    def forward(ctx: Any, T: Tensor) -> Tensor:
        ctx.save_for_backward(T)
        return T.view_as(T)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return gradient[0]
        refusing: Tensor = _Refusing.apply(gradient[0], *ctx.saved_tensors)
        return refusing


class _Refusing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradient: Tensor, T: Tensor) -> Tensor:
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor, Tensor]:
        raise RuntimeError(
            "margins have first derivatives only: score without create_graph, or by finite differences"
        )


HELD_M = 3e-5
"""Fingers that overlap the region by their squeeze, give or take this, hold it."""


class MarginChanges:
    """The first-order change of all margins (B, C) as a function of the poses; finding the
    witnesses is done once."""

    def __init__(
        self,
        scene: Scene,
        config: EvalConfig,
        scores: Scores,
        held: AttachedBatch,
        goal: Goal,
        nearest: NearestApproach,
    ) -> None:
        self.held, self.goal, self.evaluated = held, goal, scores.evaluated
        thresholds = config.thresholds
        slip_m = scores.slip_m.double() if config.stability == "physics" else None
        self.evidence = metrics.Evidence(
            scene,
            config,
            held,
            goal.free,
            held.active,
            goal.clearance_m,
            goal.reason,
            nearest,
            slip_m,
        )
        margin = scores.margin.detach()
        by_name = dict(zip(CRITERIA, margin.unbind(1), strict=True))
        self.robot = scene.robot
        self._find_on_object(scene, thresholds, by_name)
        safe_m = by_name["safe"] + thresholds.safe_margin_m
        self._find_between_bodies(scene, scores, safe_m)

    def _find_on_object(
        self, scene: Scene, thresholds: Thresholds, margin: dict[str, Tensor]
    ) -> None:
        """Stability, Reach, Affordance: which points of the object decide them."""
        held, grasp = self.held, self.held.grasp
        stability, affordance = margin["stability"], margin["affordance"]
        self.closing = witnesses.closing(
            scene, held.T_obj_ee, held.objects, grasp.width_m, grasp.opening_m
        )

        # Stability: the open gripper's clearance, or the material, too wide or too thin: whichever
        # the margin says. A clearance at its cap is a bound that does not move.
        self.cuts = held.active & (grasp.cut_m < CUT_CAP_M) & (stability == grasp.cut_m)
        holds = held.active & ~self.cuts & ~grasp.empty
        wider, thinner = thresholds.w_max_m - grasp.width_m, grasp.width_m - thresholds.w_min_m
        self.material = torch.where(holds & (stability == wider), -1.0, 0.0)
        self.material = torch.where(holds & (stability == thinner), 1.0, self.material)
        opened = torch.full_like(grasp.opening_m, scene.robot.open_gap_m)
        self.cut = witnesses.fingers(
            scene, held.T_obj_ee, held.objects, opened, grasp.cut_m, self.cuts, region=False
        )

        # nothing between the pads: the number says no more, the way to the nearest material does
        self.empty = held.active & ~self.cuts & grasp.empty
        self.to_material = witnesses.nearest_to_point(
            scene,
            se3.inverse(held.T_obj_ee),
            torch.zeros_like(held.T_obj_ee[:, :3, 3]),
            held.objects,
            scene.object_mesh_ids,
        )

        T_world_obj = se3.matmul(held.T_world_ee, se3.inverse(held.attached))
        _, _, ball = scene.palm(held.hands, held.T_world_hand)
        self.to_palm = witnesses.nearest_to_point(
            scene, T_world_obj, ball, held.objects, scene.reach_mesh_ids
        )

        evaluated = self.evaluated[:, CRITERIA.index("affordance")]
        near = evaluated & (affordance < CLEARANCE_CAP_M)
        self.region = witnesses.fingers(
            scene, held.attached, held.objects, held.squeezed_m, affordance, near, region=True
        )

        # fingers that hold the region overlap it by their squeeze, wherever they go along it: the
        # way to what is not region
        squeeze = 0.5 * thresholds.pad_squeeze_m
        holds = near & (affordance < 0) & ((affordance + squeeze).abs() < HELD_M)
        self.free = witnesses.off_region(scene, held.T_obj_ee, held.objects, holds)

    def _find_between_bodies(self, scene: Scene, scores: Scores, safe_m: Tensor) -> None:
        """Safe and Plan: which bodies, what carries them, how fingers move there. `safe_m`: from
        hand to robot."""
        held, goal, opening_m = self.held, self.goal, self.held.grasp.opening_m
        self.unreachable = (goal.reason == int(PlanReason.IK_UNREACHABLE)) | (
            goal.reason == int(PlanReason.IK_NOT_FOUND)
        )
        self.start = goal.reason == int(PlanReason.START_IN_COLLISION)
        n_arm, n_robot = scene.world.n_arm, scene.world.n_robot
        body = torch.where(held.active & ~self.unreachable, scores.witness_part[:, 1], -1)
        found, self.hand_point, normal = witnesses.hand_contact(
            scene, held.body_poses, goal.q, body, safe_m
        )
        self.hand_normal = torch.where(found[:, None], normal, 0.0)
        links, q_home, T_home = _tables(scene, str(body.device))
        with_robot = (goal.nearest_pair == int(CollidingPair.SELF)) | (
            goal.nearest_pair == int(CollidingPair.OBJECT_ROBOT)
        )
        self.body, self.other = (
            self._carrier(x, links, n_robot)
            for x in (goal.body, torch.where(with_robot, goal.other, -1))
        )
        self.safe_body = self._carrier(body, links, n_robot)
        self.T_world_ee_0 = torch.where(self.start[:, None, None], T_home, held.T_world_ee)
        self.arm = witnesses.arm_at(
            scene, torch.where(self.start[:, None] | ~held.active[:, None], q_home, goal.q)
        )
        self.safe_arm = witnesses.arm_at(scene, torch.where(held.active[:, None], goal.q, q_home))
        self.fingers, self.safe_fingers = (
            witnesses.finger_motion(
                scene, torch.where(x < n_robot, x - n_arm, -1).clamp(min=-1), opening_m,
                se3.apply(se3.inverse(T), point)
            )
            for x, T, point in (
                (goal.body, self.T_world_ee_0, goal.point), (body, held.T_world_ee, self.hand_point)
            )
        )  # fmt: skip

    def __call__(self, T_obj_ee: Tensor, T_world_ee: Tensor) -> Float[Tensor, "b c"]:
        held, active = self.held, self.held.active[:, None, None]
        zero = torch.zeros_like(held.grasp.opening_m, dtype=T_obj_ee.dtype)
        T_obj_ee = torch.where(active, T_obj_ee, held.T_obj_ee)
        T_world_ee = torch.where(active, T_world_ee, held.T_world_ee)
        change = first_order.closed(T_obj_ee, self.closing)
        attached = first_order.attached(T_obj_ee, held.grasp.shift_m, change)
        poses = first_order.Poses0(
            T_world_ee, held.T_world_ee, attached, held.attached, change.opening
        )

        cut = first_order.separation(T_obj_ee, held.T_obj_ee, zero, self.cut)
        material, towards = self.to_material
        missing = se3.apply(se3.inverse(T_obj_ee), material) - se3.apply(
            se3.inverse(held.T_obj_ee), material
        )
        stability = torch.where(self.cuts, cut, self.material * change.width)
        stability = torch.where(self.empty, -se3.dot(towards, missing), stability)
        nearest, away = self.to_palm
        reach = -first_order.receded(nearest, away, poses)
        free, towards = self.free
        aside = se3.apply(se3.inverse(T_obj_ee), free) - se3.apply(se3.inverse(held.T_obj_ee), free)
        affordance = first_order.separation(attached, held.attached, change.opening, self.region)
        affordance = affordance - se3.dot(towards, aside)

        safe = -se3.dot(
            self.hand_normal,
            first_order.carried(
                self.hand_point, self.safe_body, self.safe_fingers, poses, self.safe_arm
            ),
        )
        at_home = replace(
            poses,
            T_world_ee=torch.where(self.start[:, None, None], self.T_world_ee_0, T_world_ee),
            T_world_ee_0=self.T_world_ee_0,
        )
        point, no_fingers = self.goal.point, torch.zeros_like(self.fingers)
        apart = first_order.carried(
            point, self.body, self.fingers, at_home, self.arm
        ) - first_order.carried(point, self.other, no_fingers, at_home, self.arm)
        missed = -self._missed(T_world_ee)
        plan = torch.where(self.unreachable, missed, se3.dot(self.goal.push, apart))
        changes = {"stability": stability, "plan": plan, "reach": reach}
        changes |= {"affordance": affordance, "safe": safe}
        moved = replace(held, T_obj_ee=T_obj_ee, T_world_ee=T_world_ee, attached=attached)
        others = [name for name in CRITERIA if name not in changes]
        changes |= {name: self._followed(name, moved) for name in others}
        out = torch.stack([changes[name] for name in CRITERIA], 1)
        return torch.where(self.evaluated, out, torch.zeros_like(out))

    def _followed(self, name: str, held: AttachedBatch) -> Float[Tensor, " b"]:
        """The margin of a criterion without witnesses here, as its own function computes it: torch
        follows the poses through it, and through no Warp kernel."""
        return metrics.margin_of(name, replace(self.evidence, held=held))

    def _missed(self, T_world_ee: Tensor) -> Float[Tensor, " b"]:
        """By how much the arm misses the poses that it does not reach; without a closed form, by
        how much the posture that came nearest does."""
        if self.robot.family == "ur":
            return first_order.missed(T_world_ee, ur_lengths(self.robot))
        return first_order.missed_by(T_world_ee, self.safe_arm.T_world_ee, ROTATION_LEVER_M)

    def _carrier(self, body: Tensor, links: Tensor, n_robot: int) -> Tensor:
        """The link that carries a robot body (`Scene.part_names`), as a code of first_order.py."""
        link = links[body.clamp(min=0, max=n_robot - 1).long()].long()
        held = len(self.robot.joints) + 2
        return torch.where(body < 0, first_order.FIXED, torch.where(body >= n_robot, held, link))


@lru_cache(maxsize=4)
def _tables(scene: Scene, device: str) -> tuple[Tensor, Tensor, Tensor]:
    """Links of the robot's bodies, home's joint angles and its ee pose, on a device."""
    T_home = torch.from_numpy(ee_pose(scene.robot, scene.config.workplace.home_q)).float()
    return (
        torch.from_numpy(scene.body_links).to(device),
        torch.tensor(scene.config.workplace.home_q, dtype=torch.float32, device=device),
        T_home.to(device),
    )
