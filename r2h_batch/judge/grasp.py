"""Closing the gripper: material between the pads, the opening that results, cuts, and the fingers'
volume."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import Thresholds
from r2h_batch.kernels.grasp import region as region_kernels
from r2h_batch.kernels.grasp import way_in as way_kernels
from r2h_batch.kernels.grasp import width as width_kernels
from r2h_batch.kernels.robot import gripper as gripper_kernels
from r2h_batch.scene.grasp_tables import GraspTables, gripper_tables
from r2h_batch.scene.robot import Robot

CUT_CAP_M = 0.01
"""Clearances of the open gripper are exact below this and a lower bound above it: so are
Stability's margins."""


@dataclass(frozen=True)
class Grasp:
    """Result of closing the gripper in B trials, in metres. `cut_m` is the open gripper's
    clearance, at most `CUT_CAP_M`.

    Nothing between the pads (`empty`): width NaN. Empty or too wide for the gripper: it stays open,
    shift 0.
    """

    width_m: Float32[Tensor, " b"]
    opening_m: Float32[Tensor, " b"]
    shift_m: Float32[Tensor, " b"]
    empty: Bool[Tensor, " b"]
    cut_m: Float32[Tensor, " b"]
    margin_m: Float32[Tensor, " b"]


def close_gripper(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    w_max: float | None = None,
    w_min: float | None = None,
    mode: Literal["pads", "whole"] = "pads",
) -> Grasp:
    """Width, opening, shift and cut of each grasp `T_obj_ee` (ee in the object's frame) of object
    `object_index`.

    The Stability margin is the smallest of `w_max - w`, `w - w_min` and the open gripper's
    clearance to the object, which counts `CUT_CAP_M` at most; `-w_max` at least when nothing lies
    between the pads. 0 passes (touching). `w_max`, `w_min` are the gripper's own gaps by default.
    """
    w_max = tables.open_gap_m if w_max is None else w_max
    w_min = tables.closed_gap_m if w_min is None else w_min
    width, opening, shift, empty = close_pads(tables, T_obj_ee, object_index, mode=mode)
    # What closes on nothing holds nothing: as far below 0 as the widest graspable object is above
    # it. Lengths of different things are not added: the worst one decides, on the passing side too.
    cut, _ = open_clearance(tables, T_obj_ee, object_index, cap_m=CUT_CAP_M)
    material = torch.where(empty, -w_max, torch.minimum(w_max - width, width - w_min))
    margin = torch.minimum(material, cut)
    return Grasp(width, opening, shift, empty, cut, margin)


def close_pads(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    mode: Literal["pads", "whole"] = "pads",
) -> tuple[Float32[Tensor, " b"], Float32[Tensor, " b"], Float32[Tensor, " b"], Bool[Tensor, " b"]]:
    """Width, opening, shift and emptiness of `close_gripper`, without looking at what the open
    gripper cuts.

    Args:
        tables: of the scene.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        object_index: (B,) int32.
        mode: material between the pads, or the whole object.

    Returns:
        (B,) each, m, and bool.
    """
    made = over_trials(width_kernels.close_gripper, len(T_obj_ee), tables.device)(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        open_gap=tables.open_gap_m,
        whole=int(mode == "whole"),
        T_obj_ee=T_obj_ee,
        object_index=object_index,
    )
    return made["width"], made["opening"], made["shift"], made["empty"]


def attach(
    T_obj_ee: Float32[Tensor, "b 4 4"], shift_m: Float32[Tensor, " b"]
) -> Float32[Tensor, "b 4 4"]:
    """The grasp after the pads have met the object, which moves by -shift along the closing axis.

    Args:
        T_obj_ee: (B, 4, 4) grasps, m.
        shift_m: (B,) `Grasp.shift_m`.
    """
    T = T_obj_ee.clone()
    T[:, :3, 3] += T_obj_ee[:, :3, 1] * shift_m[:, None]
    return T


def open_clearance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    cap_m: float,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Clearance of the open gripper to the object's solid, and the primitive that has it.

    Args:
        tables: of the scene.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        object_index: (B,) int32.
        cap_m: clearances count this at most, m.

    Returns:
        (B,) m, negative: depth; (B,) row of `Robot.gripper`.
    """
    opening = _open_gaps(tables.open_gap_m, len(T_obj_ee), tables.device)
    return _clearance(tables, T_obj_ee, object_index, opening, 0, tables.every, True, cap_m)


@lru_cache(maxsize=16)
def _open_gaps(open_gap_m: float, n: int, device: str) -> Float32[Tensor, " b"]:
    """The gap of the open gripper, n times."""
    return torch.full((n,), open_gap_m, dtype=torch.float32, device=device)


def open_is_clear(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    *,
    clearance_m: float,
) -> Bool[Tensor, " b"]:
    """Whether `open_clearance` is `clearance_m` or more, without measuring how deep it cuts where
    it is not.

    Args:
        tables: of the scene.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        object_index: (B,) int32.
        clearance_m: m.
    """
    opening = _open_gaps(tables.open_gap_m, len(T_obj_ee), tables.device)
    cap, used = 1.5 * clearance_m, tables.every
    found = _clearance(tables, T_obj_ee, object_index, opening, 0, used, True, cap, clearance_m)[0]
    return found >= clearance_m


def closed_clearance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    *,
    cap_m: float,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """As `open_clearance`, of what is behind the pads of a gripper that stands at `opening_m`."""
    return _clearance(tables, T_obj_ee, object_index, opening_m, 0, tables.behind_pads, True, cap_m)


def region_distance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    *,
    cap_m: float = 0.05,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Distance (m) of the fingers at `opening_m` to the receiver's region, and the primitive (as in
    `Robot.gripper`).

    Exact below `cap_m`, `cap_m` beyond; negative: minus the depth of the region's deepest point in
    a finger, or minus a finger's inner radius where it lies in a region of boxes. NaN and -1 for an
    object without a region. `T_obj_ee` is the attachment (`attach`). All that moves counts, the
    palm does not.
    """
    # In the table of surfaces the regions stand behind the objects, in their order: index +
    # tables.objects
    return _clearance(
        tables,
        T_obj_ee,
        object_index,
        opening_m,
        tables.objects,
        tables.moving,
        tables.volumes,
        cap_m,
    )


def way_in_clearance(
    tables: GraspTables,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    cap_m: Float32[Tensor, " b"],
    *,
    way_m: float,
    tolerance_m: float,
    share: float,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Smallest clearance of the open gripper to the object's solid on its straight way in, and the primitive that has it.

    Args:
        tables: of the scene.
        T_obj_ee: (B, 4, 4) float32 grasps, m; the way ends there.
        object_index: (B,) int32.
        cap_m: (B,) what clearances count at most, m.
        way_m: length of the way along the gripper's axis.
        tolerance_m: how exact the clearance is, or
        share: this share of it, if that is more.

    Returns:
        (B,) m, negative: depth, the cap where nothing is nearer; (B,) row of `Robot.gripper`, -1 there.
    """
    count = tables.gripper.kind.shape[0]
    sizes = {"R": count, "p": count}
    made = over_trials(
        way_kernels.way_in_clearance,
        len(T_obj_ee),
        tables.device,
        sizes=sizes,
        chunk=8,
        uneven=True,
    )(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        used=tables.every,
        way=way_m,
        opening=tables.open_gap_m,
        tolerance=tolerance_m,
        share=share,
        T_obj_ee=T_obj_ee.contiguous(),
        object_index=object_index.contiguous(),
        cap=cap_m.contiguous(),
    )
    return made["clearance"], made["witness"]


def _clearance(
    tables: GraspTables,
    T_obj_ee: Tensor,
    object_index: Tensor,
    opening_m: Tensor,
    surface_offset: int,
    used: int,
    solid: bool,
    cap_m: float,
    enough_m: float = -1e30,
) -> tuple[Tensor, Tensor]:
    kernel, count = region_kernels.primitives_clearance, tables.gripper.kind.shape[0]
    made = over_trials(kernel, len(T_obj_ee), tables.device, sizes={"R": count, "p": count})(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        surface_offset=surface_offset,
        used=used,
        solid=int(solid),
        cap=cap_m,
        enough=enough_m,
        T_obj_ee=T_obj_ee,
        object_index=object_index,
        opening=opening_m,
    )
    return made["clearance"], made["witness"]


def gripper_poses(
    robot: Robot, opening_m: Float32[Tensor, " b"]
) -> tuple[Float32[Tensor, "b g 3 3"], Float32[Tensor, "b g 3"]]:
    """Where the G gripper primitives (order of `Robot.gripper`) are in the ee frame.

    Args:
        robot: whose gripper.
        opening_m: (B,) float32, gap between the pads.

    Returns:
        R (B, G, 3, 3) and p (B, G, 3), m.
    """
    device = str(opening_m.device)
    g = gripper_tables(robot, device)
    sizes = dict.fromkeys(("R", "p"), g.kind.shape[0])
    kernel = gripper_kernels.gripper_poses
    made = over_trials(kernel, len(opening_m), device, sizes=sizes)(gripper=g, opening=opening_m)
    return made["R"], made["p"]


def squeezed(grasp: Grasp, thresholds: Thresholds) -> Float32[Tensor, " b"]:
    """The opening of fingers that hold: `pad_squeeze_m` tighter than the material between them.

    Args:
        grasp: of B trials.
        thresholds: with `pad_squeeze_m`.

    Returns:
        (B,) m.
    """
    held = grasp.width_m <= thresholds.w_max_m
    return torch.where(held, grasp.opening_m - thresholds.pad_squeeze_m, grasp.opening_m).clamp(
        min=0.0
    )
