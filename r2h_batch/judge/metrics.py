"""The five criteria of the paper (Sec. Evaluation Metrics): one function per equation, each a
signed margin in metres."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, FARTHEST_M, Thresholds
from r2h_batch.judge.grasp import Grasp, region_distance
from r2h_batch.judge.grasp_physics import DROPPED_M, close_in_physics
from r2h_batch.judge.plan import Plan
from r2h_batch.judge.wave.safe import SafeWaves
from r2h_batch.judge.wave.waves import in_waves
from r2h_batch.kernels.judge import reach as reach_kernels
from r2h_batch.kernels.judge import safe as safe_kernels
from r2h_batch.kernels.judge.overlap import hand_overlap
from r2h_batch.launch import launch_trials
from r2h_batch.motion.execute import Executed
from r2h_batch.scene.scene import BodyPoses, Scene

SAFE_TOLERANCE_M = 2e-5
"""How exactly the smallest distance over time is located."""


@dataclass(frozen=True)
class Criterion:
    """One criterion of B handovers. A criterion that was not evaluated has no margin and does not
    pass."""

    margin: Float32[Tensor, " b"]  # m; NaN where not evaluated
    passed: Bool[Tensor, " b"]
    evaluated: Bool[Tensor, " b"]

    @staticmethod
    def of(
        margin: Float32[Tensor, " b"], evaluated: Bool[Tensor, " b"], *, touching_passes: bool
    ) -> "Criterion":
        """The criterion that passes at a margin above 0, and at 0 where `touching_passes`.

        An evaluated row whose margin is NaN fails: NaN is neither above 0 nor equal to it.
        """
        passed = (margin >= 0) if touching_passes else (margin > 0)
        return Criterion(torch.where(evaluated, margin, torch.nan), passed & evaluated, evaluated)


def stability(grasp: Grasp, active: Bool[Tensor, " b"]) -> Criterion:
    """Stability(g) <=> w_O(g) <= w_max, and something is held that the open gripper does not cut
    into.

    Margin: the smallest of w_max - w, w - w_min and the open gripper's clearance to the object,
    which counts 1 cm at most.
    """
    return Criterion.of(grasp.margin_m, active, touching_passes=True)


def stability_in_physics(
    scene: Scene,
    grasp: Grasp,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    active: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Criterion, Float32[Tensor, " b"]]:
    """Stability(g) as above, and the friction grasp holds the object through its weight and a shake
    along three axes.

    Margin: the smaller of the above and 2 cm - slip. Second: the slip, m; NaN where nothing was
    shaken. `T_obj_ee` after closing. The shake is simulated on the CPU.
    """
    geometric = stability(grasp, active)
    rows = torch.nonzero(geometric.passed).flatten()
    # Seconds a grasp: only those that geometry lets through are shaken, (k,) of B rows
    closed = close_in_physics(
        scene.objects,
        object_index[rows].cpu().numpy(),
        T_obj_ee[rows].double().cpu().numpy(),
        shake=True,
        threads=threads,
    )
    left = torch.from_numpy(np.nan_to_num(DROPPED_M - closed.slip_m, nan=-np.inf))
    margin = geometric.margin.clone()
    margin[rows] = torch.minimum(margin[rows], left.to(margin))
    slip = torch.full_like(margin, torch.nan)
    slip[rows] = torch.from_numpy(closed.slip_m).to(slip)
    return Criterion.of(margin, active, touching_passes=True), slip


def plan(planned: Plan, executed: Executed, active: Bool[Tensor, " b"]) -> Criterion:
    """Plan(g, h) <=> h in S_plan(g): margin is the smallest clearance along the path.

    -inf when there is none, or when the arm did not come to rest at its end.
    """
    # A clear path that the arm did not follow to its end is no plan: the pose was never presented
    found = (planned.length > 0) & executed.settled
    criterion = Criterion.of(
        torch.where(found, planned.clearance_m, -torch.inf), active, touching_passes=False
    )
    return Criterion(criterion.margin, found & active, active)


def reach(
    scene: Scene,
    ball_center: Float32[Tensor, "b 3"],
    object_index: Int32[Tensor, " b"],
    active: Bool[Tensor, " b"],
    thresholds: Thresholds,
    *,
    threads: int | None = None,
) -> Criterion:
    """Reach(g, h) <=> V_O(g, h) meets the ball B_h: margin r_h - dist(c_h, object solid). Touching
    passes.

    `ball_center`: c_h in the object's frame, where the mesh's tree stands: the ball moves, not the
    object.
    """
    distance = torch.empty_like(ball_center[:, 0])
    nearest = torch.empty_like(ball_center)
    launch_trials(
        reach_kernels.point_to_object,
        len(active),
        inputs={
            "cap": FARTHEST_M,
            "mesh": scene.object_mesh_ids,
            "low": scene.grasp_tables.surfaces.low,
            "high": scene.grasp_tables.surfaces.high,
            "object": object_index,
            "point": ball_center,
        },
        outputs={"distance": distance, "nearest": nearest},
        device=scene.device,
        threads=threads,
        chunk=64,
    )
    return Criterion.of(thresholds.reach_radius_m - distance, active, touching_passes=True)


def affordance(
    scene: Scene,
    attached: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    active: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> Criterion:
    """Affordance(g) <=> V_grip(g) does not meet G_O^H(g): margin is the fingers' distance to the
    region. S1 only.

    `opening_m`: of the fingers, `squeezed`, so that those which hold the region itself meet it
    clearly and not within rounding. `attached`: `T_obj_ee` once the pads have met the object
    (`attach`): the region moves with the object, which they have shifted.
    """
    distance, _ = region_distance(
        scene.grasp_tables,
        attached,
        object_index,
        opening_m,
        cap_m=CLEARANCE_CAP_M,
        known=True,
        threads=threads,
    )
    return Criterion.of(distance, active & ~torch.isnan(distance), touching_passes=False)


def squeezed(grasp: Grasp, thresholds: Thresholds) -> Float32[Tensor, " b"]:
    """The opening (m) of fingers that hold: `pad_squeeze_m` tighter than the material between
    them."""
    held = grasp.width_m <= thresholds.w_max_m
    return torch.where(held, grasp.opening_m - thresholds.pad_squeeze_m, grasp.opening_m).clamp(
        min=0.0
    )


@dataclass(frozen=True)
class Touch:
    """Where the robot is nearest to the hand: robot body (Scene.part_names), path segment and
    fraction, hand point (world)."""

    body: Int32[Tensor, " b"]
    segment: Int32[Tensor, " b"]
    fraction: Float32[Tensor, " b"]
    point: Float32[Tensor, "b 3"]


def safe(
    scene: Scene,
    body_poses: BodyPoses,
    executed: Executed,
    active: Bool[Tensor, " b"],
    thresholds: Thresholds,
    *,
    threads: int | None = None,
) -> tuple[Criterion, Touch]:
    """Safe(g, h) <=> M_hand does not meet M_robot(g, h) over the motion: margin is the smallest
    distance over time.

    Exact hand mesh against the robot's primitives, without the object; exact below 5 cm, a lower
    bound above, below 0 minus the depth of the hand's deepest point in a primitive. All less what
    the motion may have been off the lines between its samples. Defined where there is a motion.
    Touching fails.
    """
    b, device = len(active), active.device
    distance, fraction = torch.zeros((2, b), dtype=torch.float32, device=device).unbind(0)
    body, segment = torch.full((2, b), -1, dtype=torch.int32, device=device).unbind(0)
    point = torch.zeros((b, 3), dtype=torch.float32, device=device)
    found = {
        "distance": distance,
        "body": body,
        "segment": segment,
        "fraction": fraction,
        "point": point,
    }
    tables = {"world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies}
    motion = {"path": executed.path, "length": executed.length}
    moves = (executed.length > 0) & active
    on: dict[str, Any] = {"device": scene.device, "threads": threads}
    if in_waves(scene.device):
        waves = SafeWaves(scene, body_poses, **motion, tolerance=SAFE_TOLERANCE_M)
        waves(found)
        meets = waves.rows_where(moves & (distance < 0))
    else:
        asked = {"cap": CLEARANCE_CAP_M, "tolerance": SAFE_TOLERANCE_M, **tables, **motion}
        launch_trials(
            safe_kernels.safe_distance, b, inputs=asked, outputs=found, chunk=16, uneven=True, **on
        )
        meets = torch.nonzero(moves & (distance < 0)).flatten().to(torch.int32)
    # The search for the smallest distance stops asking how deep once bodies meet
    launch_trials(
        hand_overlap,
        len(meets),
        inputs={**tables, "row": meets, **motion},
        outputs=found,
        chunk=1,
        **on,
    )
    # Between two samples the arm may be off the line by slack_m, so the distance along the lines is
    # taken less that
    defined = active & (executed.length > 0)
    criterion = Criterion.of(
        distance - executed.slack_m - thresholds.safe_margin_m, defined, touching_passes=False
    )
    return criterion, Touch(torch.where(defined, body, -1), segment, fraction, point)
