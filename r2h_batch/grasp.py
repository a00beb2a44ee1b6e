"""Closing the gripper: material between the pads, the opening that results, cuts, and the fingers' volume."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.kernels import gripper as gripper_kernels
from r2h_batch.kernels import region as region_kernels
from r2h_batch.kernels import width as width_kernels
from r2h_batch.kernels.gripper import Gripper
from r2h_batch.kernels.surface import Surfaces
from r2h_batch.launch import init_warp, launch_trials
from r2h_batch.objects import ObjectModel
from r2h_batch.robot import load_robot

__all__ = [
    "OPEN_GAP_M",
    "Grasp",
    "GraspTables",
    "attach",
    "close_gripper",
    "closed_clearance",
    "grasp_tables",
    "gripper_poses",
    "gripper_tables",
    "open_clearance",
    "region_distance",
]

OPEN_GAP_M = 0.085
"""Gap of the open gripper: the published stroke of the 2F-85."""

CUT_CAP_M = 0.001
"""Clearances of the open gripper are exact below this: enough to see whether a trial is near the threshold."""

_MOTION = {"fixed": 0, "driver": 1, "pin": 2, "inner_knuckle": 3}
_NODE_TRIANGLES, _LEAF_TRIANGLES = 64, 8


@dataclass(frozen=True, eq=False)
class GraspTables:
    """N objects' surfaces and receiver regions (surface N + i) and the gripper, on one device."""

    surfaces: Surfaces
    gripper: Gripper
    objects: int
    has_region: Bool[Tensor, " n"]
    every: int  # bit masks of gripper primitives: all of them,
    moving: int  # all but coupling and palm,
    behind_pads: int  # all but the pads
    device: str


@dataclass(frozen=True)
class Grasp:
    """What closing does to B trials, in metres. `cut_m` is the open gripper's clearance, at most `cut_cap_m`.

    Nothing between the pads (`empty`): width NaN. Empty or too wide for the gripper: it stays open, shift 0.
    """

    width_m: Float32[Tensor, " b"]
    opening_m: Float32[Tensor, " b"]
    shift_m: Float32[Tensor, " b"]
    empty: Bool[Tensor, " b"]
    cut_m: Float32[Tensor, " b"]
    margin_m: Float32[Tensor, " b"]
    cut_part: Int32[Tensor, " b"]
    """the gripper primitive (order of `Robot.gripper`) nearest to the object, -1 beyond the cap"""


def grasp_tables(objects: Sequence[ObjectModel], device: str = "cpu") -> GraspTables:
    """The tables that every function here reads: built once per scene."""
    init_warp()
    triangles = [o.vertices[o.faces] for o in objects]
    regions = [t[o.receiver_face] for t, o in zip(triangles, objects, strict=True)]
    robot = load_robot()
    if len(robot.gripper_part) > 31:
        raise ValueError(f"the gripper has {len(robot.gripper_part)} primitives; the kernels' bit masks hold 31")
    return GraspTables(
        surfaces=surface_tables(triangles + regions, device),
        gripper=gripper_tables(device),
        objects=len(objects),
        has_region=torch.tensor([len(r) > 0 for r in regions], dtype=torch.bool, device=device),
        every=(1 << len(robot.gripper_part)) - 1,
        moving=sum(1 << i for i, motion in enumerate(robot.gripper_motion) if motion != "fixed"),
        behind_pads=sum(1 << i for i, part in enumerate(robot.gripper_part) if part != "pad"),
        device=device,
    )


def close_gripper(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    w_max: float = OPEN_GAP_M,
    mode: Literal["pads", "whole"] = "pads",
    cut_cap_m: float = CUT_CAP_M,
    threads: int | None = None,
) -> Grasp:
    """Width, opening, shift and cut of each grasp `T_obj_ee` (ee in the object's frame) of object `object_index`.

    The Stability margin is `w_max - w`, or the cut when the open gripper cuts deeper into the object than that leaves;
    `-w_max` at least when nothing lies between the pads. 0 passes (touching).
    """
    if mode not in ("pads", "whole"):
        raise ValueError(f"mode is {mode!r}; allowed are 'pads' (what lies between the pads) and 'whole' (the object)")
    n = _checked(tables, T_obj_ee, object_index)
    width, opening, shift = (torch.empty(n, dtype=torch.float32, device=tables.device) for _ in range(3))
    empty = torch.empty(n, dtype=torch.bool, device=tables.device)
    steps = torch.empty(n, dtype=torch.int32, device=tables.device)
    launch_trials(
        width_kernels.close_gripper,
        n,
        [tables.gripper, tables.surfaces, OPEN_GAP_M, int(mode == "whole"), *_poses(T_obj_ee, object_index)]
        + [wp.from_torch(x) for x in (width, opening, shift, empty, steps)],
        device=tables.device,
        threads=threads,
    )
    cut, cut_part = open_clearance(tables, T_obj_ee, object_index, cap_m=cut_cap_m, threads=threads)
    material = torch.where(empty, torch.full_like(width, -w_max), w_max - width)
    margin = torch.where(cut < 0, torch.minimum(material, cut), material)
    return Grasp(width, opening, shift, empty, cut, margin, cut_part)


def attach(T_obj_ee: Float32[Tensor, "b 4 4"], shift_m: Float32[Tensor, " b"]) -> Float32[Tensor, "b 4 4"]:
    """`T_obj_ee` after the pads have met the object: it has moved by -shift along the closing axis."""
    T = T_obj_ee.clone()
    T[:, :3, 3] += T_obj_ee[:, :3, 1] * shift_m[:, None]
    return T


def open_clearance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    cap_m: float,
    threads: int | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Clearance of the open gripper to the object's solid (m, at most `cap_m`; negative: depth) and the primitive."""
    opening = torch.full((len(T_obj_ee),), OPEN_GAP_M, dtype=torch.float32, device=tables.device)
    return _clearance(tables, T_obj_ee, object_index, opening, 0, tables.every, True, cap_m, threads)


def closed_clearance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    *,
    cap_m: float,
    threads: int | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """As `open_clearance`, of what is behind the pads of a gripper that stands at `opening_m`."""
    return _clearance(tables, T_obj_ee, object_index, opening_m, 0, tables.behind_pads, True, cap_m, threads)


def region_distance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    *,
    cap_m: float = 0.05,
    threads: int | None = None,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Distance (m) of the fingers at `opening_m` to the receiver's region, and the primitive (as in `Robot.gripper`).

    Exact below `cap_m`, `cap_m` beyond; negative: minus the depth of the region's deepest point in a finger. NaN and -1
    for an object without a region. `T_obj_ee` is the attachment (`attach`). All that moves counts, the palm does not.
    """
    distance, part = _clearance(
        tables, T_obj_ee, object_index, opening_m, tables.objects, tables.moving, False, cap_m, threads
    )
    none = ~tables.has_region[object_index.long()]
    return torch.where(none, torch.full_like(distance, torch.nan), distance), part


def _clearance(
    tables: GraspTables,
    T_obj_ee: Tensor,
    object_index: Tensor,
    opening_m: Tensor,
    surface_offset: int,
    used: int,
    solid: bool,
    cap_m: float,
    threads: int | None,
) -> tuple[Tensor, Tensor]:
    n = _checked(tables, T_obj_ee, object_index)
    count = tables.gripper.kind.shape[0]
    R, p = _empty_poses(n, count, tables.device)
    distance = torch.empty(n, dtype=torch.float32, device=tables.device)
    part = torch.empty(n, dtype=torch.int32, device=tables.device)
    launch_trials(
        region_kernels.primitives_clearance,
        n,
        [tables.gripper, tables.surfaces, surface_offset, used, int(solid), cap_m, *_poses(T_obj_ee, object_index)]
        + [wp.from_torch(opening_m), wp.from_torch(R, dtype=wp.mat33), wp.from_torch(p, dtype=wp.vec3)]
        + [wp.from_torch(distance), wp.from_torch(part)],
        device=tables.device,
        threads=threads,
    )
    return distance, part


def gripper_poses(
    opening_m: Float32[Tensor, " b"], *, threads: int | None = None
) -> tuple[Float32[Tensor, "b g 3 3"], Float32[Tensor, "b g 3"]]:
    """R, p of the G gripper primitives (order of `Robot.gripper`) in the ee frame at each opening (m)."""
    device = str(opening_m.device)
    g = gripper_tables(device)
    R, p = _empty_poses(len(opening_m), g.kind.shape[0], device)
    out = [wp.from_torch(R, dtype=wp.mat33), wp.from_torch(p, dtype=wp.vec3)]
    launch_trials(
        gripper_kernels.gripper_poses,
        len(opening_m),
        [g, wp.from_torch(opening_m), *out],
        device=device,
        threads=threads,
    )
    return R, p


@lru_cache(maxsize=4)
def gripper_tables(device: str = "cpu") -> Gripper:
    """The gripper of robot.json for the kernels: linkage, and the primitives at drive angle 0 in the ee frame."""
    init_warp()
    robot = load_robot()
    link, prims = robot.linkage, robot.gripper
    T_ee_gripper = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
    T = T_ee_gripper @ prims.T_link_prim
    g = Gripper()
    g.driver_pivot_y, g.driver_pivot_z = link.driver_pivot_yz
    g.pin_y, g.pin_z = link.pin_from_driver_yz
    g.inner_knuckle_pivot_y, g.inner_knuckle_pivot_z = link.inner_knuckle_pivot_yz
    g.gap_offset = link.gap_offset_m
    g.z_ee_gripper = T_ee_gripper[2, 3]
    g.pad_z = link.driver_pivot_yz[1] + link.pad_from_pin_yz[1] + T_ee_gripper[2, 3]
    g.drive_lower, g.drive_upper = link.drive_lower, link.drive_upper
    g.pad_half_x, g.pad_half_z = link.pad_half_size[0], link.pad_half_size[2]
    g.kind = wp.array(prims.kind, dtype=wp.int32, device=device)
    g.size = wp.array(prims.size.astype(np.float32), dtype=wp.vec3, device=device)
    g.motion = wp.array([_MOTION[m] for m in robot.gripper_motion], dtype=wp.int32, device=device)
    g.side = wp.array(robot.gripper_side.astype(np.float32), dtype=wp.float32, device=device)
    g.R = wp.array(T[:, :3, :3].astype(np.float32), dtype=wp.mat33, device=device)
    g.p = wp.array(T[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    return g


def surface_tables(surfaces: Sequence[NDArray[np.float32]], device: str) -> Surfaces:
    """Surfaces, each a (T, 3, 3) array of triangles, sorted into nodes of 64 and leaves of 8 with bounding spheres."""
    points: list[NDArray[np.float32]] = []
    leaf_first, node_first, surface_first = [0], [0], [0]
    for triangles in surfaces:
        centers = triangles.mean(axis=1)
        for node in _split(centers, np.arange(len(triangles)), _NODE_TRIANGLES):
            for leaf in _split(centers, node, _LEAF_TRIANGLES):
                points.append(triangles[leaf].reshape(-1, 3))
                leaf_first.append(leaf_first[-1] + len(leaf))
            node_first.append(len(leaf_first) - 1)
        surface_first.append(len(node_first) - 1)
    flat = np.concatenate([*points, np.zeros((0, 3), np.float32)]).astype(np.float32)
    leaf_points = [3 * i for i in leaf_first]
    node_points = [leaf_points[i] for i in node_first]
    corners = [t.reshape(-1, 3) if len(t) else np.zeros((1, 3), np.float32) for t in surfaces]
    out = Surfaces()
    for name, value, dtype in (
        ("surface_first", surface_first, wp.int32),
        ("node_first", node_first, wp.int32),
        ("leaf_first", leaf_first, wp.int32),
        ("node_sphere", _bounds(flat, node_points)[0], wp.vec4),
        ("leaf_sphere", _bounds(flat, leaf_points)[0], wp.vec4),
        ("leaf_half", _bounds(flat, leaf_points)[1], wp.vec3),
        ("points", flat, wp.vec3),
        ("low", np.array([c.min(axis=0) for c in corners], np.float32), wp.vec3),
        ("high", np.array([c.max(axis=0) for c in corners], np.float32), wp.vec3),
    ):
        array: Any = wp.array(value, dtype=dtype, device=device)
        setattr(out, name, array)
    return out


def _split(centers: NDArray[np.float32], rows: NDArray[np.intp], most: int) -> list[NDArray[np.intp]]:
    """Groups of at most `most` rows: halves along the longest side, again and again."""
    if len(rows) <= most:
        return [rows] if len(rows) else []
    at = centers[rows]
    order = rows[np.argsort(at[:, np.argmax(np.ptp(at, axis=0))], kind="stable")]
    half = -(-len(rows) // most // 2) * most if len(rows) > 2 * most else len(rows) // 2
    return _split(centers, order[:half], most) + _split(centers, order[half:], most)


def _bounds(points: NDArray[np.float32], first: list[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Spheres (x, y, z, radius) around each group's points, half sides of boxes about their centres; rounded up."""
    spheres, halves = np.zeros((len(first) - 1, 4), np.float32), np.zeros((len(first) - 1, 3), np.float32)
    for i, (a, b) in enumerate(pairwise(first)):
        group = points[a:b].astype(np.float64)
        center = ((group.min(axis=0) + group.max(axis=0)) / 2).astype(np.float32)
        spheres[i, :3] = center
        spheres[i, 3] = np.linalg.norm(group - center, axis=1).max() + 1e-6
        halves[i] = np.abs(group - center).max(axis=0) + 1e-7
    return spheres, halves


def _empty_poses(n: int, count: int, device: str) -> tuple[Tensor, Tensor]:
    R = torch.empty((n, count, 3, 3), dtype=torch.float32, device=device)
    return R, torch.empty((n, count, 3), dtype=torch.float32, device=device)


def _poses(T_obj_ee: Tensor, object_index: Tensor) -> list[Any]:
    if len(T_obj_ee) == 0:  # Warp refuses the strides that torch gives some empty tensors
        T_obj_ee = torch.empty((0, 4, 4), dtype=torch.float32, device=T_obj_ee.device)
    return [wp.from_torch(T_obj_ee, dtype=wp.mat44), wp.from_torch(object_index)]


def _checked(tables: GraspTables, T_obj_ee: Tensor, object_index: Tensor) -> int:
    """The batch size, after shape, dtype, device and index have been looked at."""
    n = len(T_obj_ee)
    for name, value, shape, dtype in (
        ("T_obj_ee", T_obj_ee, (n, 4, 4), torch.float32),
        ("object_index", object_index, (n,), torch.int32),
    ):
        right = tuple(value.shape) == shape and value.dtype == dtype and str(value.device) == tables.device
        if not (right and value.is_contiguous()):
            raise ValueError(
                f"{name} is {value.dtype} {tuple(value.shape)} on {value.device}; "
                f"expected contiguous {dtype} {shape} on {tables.device}"
            )
    # on CUDA looking at them would wait for the device: there the caller vouches for them
    if n and tables.device == "cpu" and (int(object_index.min()) < 0 or int(object_index.max()) >= tables.objects):
        given = f"[{int(object_index.min())}, {int(object_index.max())}]"
        raise ValueError(f"object_index lies in {given}; allowed is [0, {tables.objects - 1}]: the tables' objects")
    return n
