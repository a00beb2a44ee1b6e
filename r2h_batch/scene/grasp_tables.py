"""Tables for closing the gripper: every object's surface and receiver region, and the gripper, as
tables on a device."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from r2h_batch.base.launch import init_warp
from r2h_batch.kernels.geometry.lanes import LANES, LEAF_ROWS, NODE_ROWS, TRIANGLE_ROWS
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.robot.gripper import Gripper
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import MOTIONS, Robot

_NODE_TRIANGLES, _LEAF_TRIANGLES = 64, 8


@dataclass(frozen=True, eq=False)
class GraspTables:
    """N objects' surfaces and receiver regions (surface N + i) and the gripper, on one device."""

    surfaces: Surfaces
    gripper: Gripper
    objects: int
    volumes: bool  # whether some region is boxes: closed, where others are parts of a surface
    every: int  # bit masks of gripper primitives: all of them,
    moving: int  # all but coupling and palm,
    behind_pads: int  # all but the pads
    open_gap_m: float
    closed_gap_m: float
    device: str


@dataclass(frozen=True, eq=False)
class Regions:
    """Parts of the surfaces of N objects on one device: object i's is surface `offset` + i, which
    has no triangle where there is none."""

    surfaces: Surfaces
    offset: int
    mesh_ids: wp.array  # (N,) the same triangles for Warp's mesh queries; 0: no triangle


def grasp_tables(objects: Sequence[ObjectModel], robot: Robot, device: str = "cpu") -> GraspTables:
    """The tables that every function here reads: built once per scene."""
    init_warp()
    if len(robot.gripper_part) > 31:
        raise ValueError(
            f"the gripper has {len(robot.gripper_part)} primitives; the kernels' bit masks hold 31"
        )
    return GraspTables(
        surfaces=_on_device(_surfaces_of(tuple(objects)), device),
        gripper=gripper_tables(robot, device),
        objects=len(objects),
        volumes=any(o.receiver_boxes is not None for o in objects),
        every=(1 << len(robot.gripper_part)) - 1,
        moving=sum(1 << i for i, motion in enumerate(robot.gripper_motion) if motion != "fixed"),
        behind_pads=sum(1 << i for i, part in enumerate(robot.gripper_part) if part != "pad"),
        open_gap_m=robot.open_gap_m,
        closed_gap_m=robot.closed_gap_m,
        device=device,
    )


@lru_cache(maxsize=4)
def gripper_tables(robot: Robot, device: str = "cpu") -> Gripper:
    """The robot's gripper for the kernels: linkage, and the primitives at drive angle 0 in
    the ee frame."""
    init_warp()
    link, prims = robot.linkage, robot.gripper
    T_ee_gripper = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
    T = T_ee_gripper @ prims.T_link_prim
    g = Gripper()
    g.driver_pivot_y, g.driver_pivot_z = link.driver_pivot_yz
    g.pin_y, g.pin_z = link.pin_from_driver_yz
    g.inner_knuckle_pivot_y, g.inner_knuckle_pivot_z = link.inner_knuckle_pivot_yz
    g.gap_offset = link.gap_offset_m
    g.z_ee_gripper = T_ee_gripper[2, 3]
    # without a linkage its pivots are 0
    g.pad_z = link.driver_pivot_yz[1] + link.pad_from_pin_yz[1] + T_ee_gripper[2, 3]
    g.drive_lower, g.drive_upper = link.drive_lower, link.drive_upper
    table = np.zeros((1, 1, 3)) if link.table is None else link.table
    g.samples = 0 if link.table is None else table.shape[1]
    g.table_gap = robot.closed_gap_m
    g.table_step = (robot.open_gap_m - robot.closed_gap_m) / max(table.shape[1] - 1, 1)
    g.table = wp.array(table.astype(np.float32), dtype=wp.vec3, device=device)
    g.pad_half_x, g.pad_half_z = link.pad_half_size[0], link.pad_half_size[2]
    g.kind = wp.array(prims.kind, dtype=wp.int32, device=device)
    g.size = wp.array(prims.size.astype(np.float32), dtype=wp.vec3, device=device)
    g.motion = wp.array(
        [MOTIONS.index(m) for m in robot.gripper_motion], dtype=wp.int32, device=device
    )
    g.side = wp.array(robot.gripper_side.astype(np.float32), dtype=wp.float32, device=device)
    g.R = wp.array(T[:, :3, :3].astype(np.float32), dtype=wp.mat33, device=device)
    g.p = wp.array(T[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    return g


def _sides(boxes: NDArray[np.float64]) -> NDArray[np.float32]:
    """The triangles of boxes (`ObjectModel.receiver_boxes`)."""
    import trimesh  # 0.3 s: only regions in boxes need it

    cube = trimesh.creation.box((2.0, 2.0, 2.0)).triangles.reshape(-1, 3)
    corners = boxes[:, :1] + (cube * boxes[:, 1:2]) @ boxes[:, 2:].transpose(0, 2, 1)
    return corners.astype(np.float32).reshape(-1, 3, 3)


@lru_cache(maxsize=2)
def _surfaces_of(objects: tuple[ObjectModel, ...]) -> dict[str, tuple[Any, Any]]:
    """Surfaces of objects and of their receivers' regions: the same in every scene."""
    triangles = [o.vertices[o.faces] for o in objects]
    regions = [
        t[o.receiver_face] if o.receiver_boxes is None else _sides(o.receiver_boxes)
        for t, o in zip(triangles, objects, strict=True)
    ]
    volumes = [o.receiver_boxes is not None for o in objects]
    return surface_tables(triangles + regions, [True] * len(objects) + volumes)


def _on_device(tables: dict[str, tuple[Any, Any]], device: str) -> Surfaces:
    """The kernels' struct of `surface_tables`."""
    out = Surfaces()
    for name, (value, dtype) in tables.items():
        setattr(out, name, wp.array(value, dtype=dtype, device=device))
    return out


def surfaces_on(
    device: str, surfaces: Sequence[NDArray[np.float32]], closed: Sequence[bool]
) -> Surfaces:
    """`surface_tables` as the kernels read them."""
    return _on_device(surface_tables(surfaces, closed), device)


def surface_tables(
    surfaces: Sequence[NDArray[np.float32]], closed: Sequence[bool]
) -> dict[str, tuple[Any, Any]]:
    """Values and types of the fields of `Surfaces`.

    Surfaces, each a (T, 3, 3) array of triangles, are sorted into nodes of 64 and leaves of 8 with
    bounding spheres. Those that are not `closed` get an empty bounding box: nothing lies inside."""
    every = np.concatenate([*surfaces, np.zeros((0, 3, 3), np.float32)]).astype(np.float32)
    centers = (every[:, 0] + every[:, 1] + every[:, 2]) / np.float32(3)
    surface_start = np.cumsum([0] + [len(triangles) for triangles in surfaces])
    rows, node_start = _split(centers, np.arange(len(every)), surface_start, _NODE_TRIANGLES)
    rows, leaf_start = _split(centers, rows, node_start, _LEAF_TRIANGLES)
    surface_first = np.searchsorted(node_start, surface_start).tolist()
    node_first = np.searchsorted(leaf_start, node_start).tolist()
    leaf_first = leaf_start.tolist()
    flat = every[rows].reshape(-1, 3)
    leaf_points = [3 * i for i in leaf_first]
    node_points = [leaf_points[i] for i in node_first]
    nothing = np.zeros((1, 3), np.float32)
    corners = [t.reshape(-1, 3) if c and len(t) else nothing for t, c in zip(surfaces, closed)]
    (node_sphere, node_half) = _bounds(flat, node_points)
    (leaf_sphere, leaf_half) = _bounds(flat, leaf_points)
    of_node = np.concatenate(
        [node_sphere[:, :3], node_half, node_sphere[:, 3:], flat[node_points[:-1]]], 1
    )
    of_leaf = np.concatenate([leaf_sphere[:, :3], leaf_half, leaf_sphere[:, 3:]], 1)
    group_first, group_nodes = _groups(surface_first)
    assert of_node.shape[1] == int(NODE_ROWS) and of_leaf.shape[1] == int(LEAF_ROWS)
    return {
        "surface_first": (surface_first, wp.int32),
        "node_first": (node_first, wp.int32),
        "leaf_first": (leaf_first, wp.int32),
        "node_sphere": (node_sphere, wp.vec4),
        "leaf_sphere": (leaf_sphere, wp.vec4),
        "leaf_half": (leaf_half, wp.vec3),
        "points": (flat, wp.vec3),
        "group_first": (group_first, wp.int32),
        "node_lanes": (_lanes(of_node, group_nodes), wp.float32),
        "leaf_lanes": (_lanes(of_leaf, node_first), wp.float32),
        "triangle_lanes": (_lanes(flat.reshape(-1, int(TRIANGLE_ROWS)), leaf_first), wp.float32),
        "low": (np.array([c.min(axis=0) for c in corners], np.float32), wp.vec3),
        "high": (np.array([c.max(axis=0) for c in corners], np.float32), wp.vec3),
    }


def _groups(first: list[int]) -> tuple[list[int], list[int]]:
    """Which groups each surface has, and which nodes each group: up to eight, never of two
    surfaces."""
    of_surface, of_group = [0], [0]
    for a, b in pairwise(first):
        of_group += [*range(a + LANES, b, LANES), b] if b > a else []
        of_surface.append(len(of_group) - 1)
    return of_surface, of_group


def _lanes(rows: NDArray[np.float32], first: list[int]) -> NDArray[np.float32]:
    """Rows first[i] .. first[i + 1] - 1 side by side, flat (groups, columns, 8): the last row
    repeated up to eight."""
    most = np.maximum(np.array(first[1:], np.int64) - 1, 0)
    index = np.minimum(np.array(first[:-1], np.int64)[:, None] + np.arange(LANES), most[:, None])
    if len(index) and int(np.diff(first).max()) > LANES:
        raise ValueError(
            f"a group has {int(np.diff(first).max())} rows; {LANES} is all that it can hold"
        )
    lanes = rows[index].transpose(0, 2, 1).ravel() if len(rows) else np.zeros(0)
    return np.ascontiguousarray(lanes, dtype=np.float32)


def _split(
    centers: NDArray[np.float32], rows: NDArray[np.intp], start: NDArray[np.intp], most: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Groups of at most `most` rows: halves along the longest side, again and again, all groups of
    a round at once. Group k is rows[start[k] : start[k + 1]], as it is in what comes back."""
    start = np.unique(start)  # a surface without a triangle has no group
    while (np.diff(start) > most).any():
        size = np.diff(start)
        # NumPy sorts numbers of 16 bits in linear time
        groups = np.arange(len(size), dtype=np.min_scalar_type(len(size)))
        owner = np.repeat(groups, size)
        at = centers[rows]
        side = np.maximum.reduceat(at, start[:-1]) - np.minimum.reduceat(at, start[:-1])
        along = at[np.arange(len(at)), side.argmax(1)[owner]]
        along[(size <= most)[owner]] = 0.0  # done: its rows keep their order
        first = _order(along)
        rows = rows[first[np.argsort(owner[first], kind="stable")]]
        half = np.where(size > 2 * most, -(-size // most // 2) * most, size // 2)
        start = np.union1d(start, (start[:-1] + half)[size > most])
    return rows, start


def _order(values: NDArray[np.float32]) -> NDArray[np.int64]:
    """The order of a stable sort, in half the time: the bits of a number, turned over if it is negative, sort as the
    number does, and its place behind them makes them unique."""
    bits = (values + np.float32(0)).view(np.int32)  # one zero
    keys = ((bits ^ ((bits >> 31) & 0x7FFFFFFF)).astype(np.int64) << 32) | np.arange(len(bits))
    keys.sort()
    return keys & 0xFFFFFFFF


def _bounds(
    points: NDArray[np.float32], first: list[int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Spheres (x, y, z, radius) around each group's points, half sides of boxes about their
    centres; rounded up."""
    count = np.diff(first)
    if not len(count):
        return np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32)
    # (3, points): NumPy works on contiguous coordinates in half the time
    exact, start = points.T.astype(np.float64, order="C"), np.array(first[:-1])
    low, high = (f.reduceat(exact, start, axis=1) for f in (np.minimum, np.maximum))
    center = ((low + high) / 2).astype(np.float32)
    x, y, z = away = exact - np.repeat(center, count, axis=1)
    radius = np.maximum.reduceat(np.sqrt(x * x + y * y + z * z), start) + 1e-6
    half = np.maximum.reduceat(np.abs(away), start, axis=1) + 1e-7
    sphere = np.stack([*center, radius], 1)
    return sphere.astype(np.float32), np.ascontiguousarray(half.T, dtype=np.float32)
