"""The criteria of the paper (Sec. Evaluation Metrics): one function per equation, each a signed
margin in metres.

A criterion is a function of this file and the entry of the same name in `verdicts.REGISTRY`.
`judge` calls the functions in the order of the registry. Stored columns, rates, tables and charts
derive from the registry.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float32, Float64, Int8, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import CLEARANCE_CAP_M, FARTHEST_M, EvalConfig
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.distance import NearestApproach
from r2h_batch.judge.grasp import CUT_CAP_M, region_distance
from r2h_batch.judge.grasp_physics import DROPPED_M
from r2h_batch.kernels.judge import reach as reach_kernels
from r2h_batch.scene.scene import Scene
from r2h_batch.verdicts import REGISTRY, MarginKind, PlanReason

KINDS = (MarginKind.CAP, MarginKind.BOUND, MarginKind.DISTANCE, MarginKind.CAP)
_TOUCHING_PASSES = {entry.name: entry.touching_passes for entry in REGISTRY}


@dataclass(frozen=True)
class Criterion:
    """One criterion of B handovers. Where it was not evaluated, `margin`, `passed` and `kind` mean
    nothing (`judge.scores.verdict` takes them out, of all criteria at once)."""

    margin: Float32[Tensor, " b"]  # m
    passed: Bool[Tensor, " b"]
    evaluated: Bool[Tensor, " b"]
    kind: Int8[Tensor, " b"]  # MarginKind

    @staticmethod
    def of(
        name: str,
        margin: Float32[Tensor, " b"],
        evaluated: Bool[Tensor, " b"],
        kind: Int8[Tensor, " b"] | None = None,
    ) -> "Criterion":
        """The criterion `name`, which passes at a margin above 0; without `kind` it is a distance.

        At 0 it passes where the registry says that touching passes. An evaluated row whose margin
        is NaN fails: NaN is neither above 0 nor equal to it.
        """
        passed = (margin >= 0) if _TOUCHING_PASSES[name] else (margin > 0)
        if kind is None:
            kind = torch.full_like(margin, int(MarginKind.DISTANCE), dtype=torch.int8)
        return Criterion(margin, passed, evaluated, kind)


@lru_cache(maxsize=256)
def constants(device: torch.device, dtype: torch.dtype, *values: float) -> Tensor:
    """These numbers (n,), filled in on the device: a GPU would wait for a copy from the host. Each
    is made once: a small call is all overhead."""
    out = torch.empty(len(values), dtype=dtype, device=device)
    for i, value in enumerate(values):
        out[i].fill_(value)
    return out


def kind_of(clearance_m: Float32[Tensor, " b"], cap_m: float) -> Int8[Tensor, " b"]:
    """MarginKind of clearances: CAP at -inf, BOUND below 0, CAP from the cap on.

    Args:
        clearance_m: (B,) m.
        cap_m: they count up to here.
    """
    lowest = torch.finfo(torch.float32).min
    edges = constants(clearance_m.device, torch.float32, lowest, 0.0, cap_m)
    kinds = constants(clearance_m.device, torch.int8, *KINDS)
    return kinds[torch.bucketize(clearance_m, edges, right=True)]


@dataclass(frozen=True)
class Evidence:
    """Results of the stages for B handovers: all that a criterion may use."""

    scene: Scene
    config: EvalConfig
    held: AttachedBatch  # poses, the grasp, where bodies are
    goal_reached: Bool[
        Tensor, " b"
    ]  # the arm came to rest at the end of a path, or the posture is free
    moves: Bool[Tensor, " b"]  # active, and with a motion; in stages="pose": active
    clearance_m: Float32[Tensor, " b"]  # of the path; without one, or without motion, of a posture
    reason: Int32[Tensor, " b"]  # PlanReason
    nearest: NearestApproach  # of the robot to the receiver
    slip_m: Float64[Tensor, " b"] | None  # in the shake, NaN where it failed; None: not shaken


def judge(evidence: Evidence) -> list[Criterion]:
    """All criteria, in the order of the registry."""
    functions = globals()
    return [functions[entry.name](evidence) for entry in REGISTRY]


def margin_of(name: str, evidence: Evidence) -> Float32[Tensor, " b"]:
    """The margin of one criterion, m."""
    margin: Tensor = globals()[name](evidence).margin
    return margin


def stability(e: Evidence) -> Criterion:
    """Stability(g) <=> w_O(g) <= w_max, and something is held that the open gripper does not cut
    into.

    Margin: the smallest of w_max - w, w - w_min and the clearance of the open gripper from the
    object, which counts 1 cm at most. With `stability="physics"` also 2 cm - slip: the friction
    grasp has to hold the object through its weight and a shake along three axes.
    """
    grasp = e.held.grasp
    device = grasp.empty.device
    cap, distance = (
        constants(device, torch.int8, kind) for kind in (MarginKind.CAP, MarginKind.DISTANCE)
    )
    held = torch.where(grasp.empty, cap, distance)
    cuts = grasp.margin_m == grasp.cut_m
    kind = torch.where(cuts, kind_of(grasp.cut_m, CUT_CAP_M), held)
    geometric = Criterion.of("stability", grasp.margin_m, e.held.active, kind)
    if e.slip_m is None:
        return geometric
    left = torch.where(e.slip_m.isnan(), -torch.inf, DROPPED_M - e.slip_m).float()
    margin = torch.minimum(geometric.margin, left)
    # only grasps that pass geometrically were shaken
    margin = torch.where(geometric.passed, margin, geometric.margin)
    kind = torch.where(margin < geometric.margin, torch.where(left.isinf(), cap, distance), kind)
    return Criterion.of("stability", margin, e.held.active, kind)


def plan(e: Evidence) -> Criterion:
    """Plan(g, h) <=> h in S_plan(g). Margin: the smallest clearance along the path.

    Without a path: minus what the start, or the best branch, lacks to be free, or the target to be
    reached (`judge.goal.Goal.clearance_m`). -inf where a search found nothing, or where the arm did
    not come to rest at its goal: no length says by how much. A path that was found passes, also
    where its clearance was only sampled.
    """
    missed = e.reason == int(PlanReason.IK_UNREACHABLE)  # by how far
    tried = e.reason == int(PlanReason.IK_NOT_FOUND)  # by no more than the best try
    distance, cap = (
        constants(missed.device, torch.int8, x) for x in (MarginKind.DISTANCE, MarginKind.CAP)
    )
    kind = torch.where(missed, distance, kind_of(e.clearance_m, CLEARANCE_CAP_M))
    kind = torch.where(tried, cap, kind)
    return Criterion(e.clearance_m, e.goal_reached, e.held.active, kind)


def reach(e: Evidence) -> Criterion:
    """Reach(g, h) <=> V_O(g, h) meets the ball B_h. Margin: r_h - dist(c_h, solid of the object,
    or its convex hull with `reach="hull"`).

    The mesh's tree stands in the object's frame: the ball is moved there, not the object.
    """
    held = e.held
    distance = reach_distance(e.scene, held.objects, held.ball)
    return Criterion.of("reach", e.config.thresholds.reach_radius_m - distance, held.active)


def reach_distance(
    scene: Scene,
    objects: Int32[Tensor, " b"],
    point: Float32[Tensor, "b 3"],
) -> Float32[Tensor, " b"]:
    """Distance of points from what Reach measures of their objects, 0 inside.

    Args:
        scene: with the objects' meshes.
        objects: (B,) int32 rows of `Scene.objects`.
        point: (B, 3) float32, object frame, m.

    Returns:
        (B,) m.
    """
    surfaces = scene.grasp_tables.surfaces
    made = over_trials(reach_kernels.point_to_object, len(point), scene.device, chunk=64)(
        cap=FARTHEST_M,
        mesh=scene.reach_mesh_ids,
        low=surfaces.low,
        high=surfaces.high,
        object=objects,
        point=point,
    )
    return made["distance"]


def affordance(e: Evidence) -> Criterion:
    """Affordance(g) <=> V_grip(g) does not meet G_O^H(g). Margin: the distance of the fingers from
    the receiver's region. S1 only.

    The region moves with the object, which closing has shifted (`attached`). The fingers are
    `squeezed`: those that hold the region itself overlap it by more than rounding.
    """
    held = e.held
    distance, _ = region_distance(
        e.scene.grasp_tables,
        held.attached,
        held.objects,
        held.squeezed_m,
        cap_m=CLEARANCE_CAP_M,
        known=True,
    )
    kind = kind_of(distance, CLEARANCE_CAP_M)
    return Criterion.of("affordance", distance, held.active & ~torch.isnan(distance), kind)


def safe(e: Evidence) -> Criterion:
    """Safe(g, h) <=> M_hand does not meet M_robot(g, h) over the motion. Margin: the smallest
    distance over time, less `safe_margin_m`.

    With `receiver="body"` arm and torso of the receiver count as the hand does.
    """
    distance, cap_m = e.nearest.distance_m, CLEARANCE_CAP_M
    far = constants(distance.device, torch.float32, cap_m)
    kind = kind_of(torch.where(e.nearest.body < 0, far, distance), cap_m)
    return Criterion.of("safe", distance - e.config.thresholds.safe_margin_m, e.moves, kind)
