"""Files of the authors' release (GitHub robot-future/r2handoversim 0.11.0): the fields that decide what
is judged, with their types and bounds."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
)

from r2h_batch.io.read import FileError, printable
from r2h_batch.validate import rule_of

__all__ = [
    "MAX_BYTES", "RIGID", "Box", "Entry", "GraspContract", "Id", "Mesh", "Metres", "Name", "Opening",
    "Own", "Pose", "Receiver", "TrialFile", "Vector", "validated",
]  # fmt: skip

Array = NDArray[np.float64]

MAX_BYTES = 256 << 20
RIGID = 1e-6

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,200}$")]
Name = Annotated[str, Field(min_length=1, max_length=64)]
Opening = Annotated[float, Field(gt=0, le=0.085)]
Metres = Annotated[float, Field(ge=-10, le=10)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]
Vector = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]


def _rows(columns: int, low: float, high: float, *, least: int = 0, whole: bool = False) -> Any:
    """A long list of rows of numbers, checked as one array: pydantic takes a second for each million."""

    def check(value: Any) -> Any:
        try:
            a = np.array(value)
        except ValueError:
            raise ValueError(f"rows must have {columns} numbers each") from None
        if not isinstance(value, list) or len(value) < least:
            raise ValueError(f"must be a list of {least} or more rows")
        if not len(value):
            return np.zeros((0, columns))
        if a.ndim != 2 or a.shape[1] != columns:
            raise ValueError(f"rows must have {columns} numbers each")
        if a.dtype.kind not in ("iu" if whole else "iuf"):
            raise ValueError(f"must hold {'whole ' if whole else ''}numbers")
        wrong = ~((a >= low) & (a <= high)).all(1)
        if wrong.any():
            row = int(wrong.argmax())
            raise ValueError(f"row {row} is {a[row].tolist()}; {low:g} to {high:g} is allowed")
        return a

    return PlainValidator(check)


Joints = Annotated[Array, _rows(6, -6.2832, 6.2832)]
NO_JOINTS = np.zeros((0, 6))


def _is_rigid(T: list[list[float]]) -> list[list[float]]:
    a = np.array(T)
    R = a[:3, :3]
    wrong = np.abs(a[3] - [0, 0, 0, 1]).max() > 1e-7 or np.abs(R.T @ R - np.eye(3)).max() > RIGID
    if wrong or abs(np.linalg.det(R) - 1) > RIGID:
        raise ValueError("must be a rigid pose, 4 x 4, row by row")
    if np.abs(a[:3, 3]).max() > 10:
        raise ValueError("must lie within 10 m")
    return T


Pose = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_is_rigid)]


class Entry(BaseModel):
    """Fields that decide nothing here (provenance, displays) may stand beside those that are named."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class Box(Entry):
    """A box in any frame, m."""

    center: Vector
    half_extents: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=3, max_length=3)]
    rotation: Annotated[list[Vector], Field(min_length=3, max_length=3)] = [
        [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0],
    ]  # fmt: skip

    def pose(self, field: str, k: int) -> Array:
        """T of the box, the k-th of a field, in its frame."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation, self.center
        try:
            _is_rigid(T.tolist())
        except ValueError:
            raise FileError(f"{field}.{k}.rotation is no rotation, 3 x 3, row by row") from None
        return T


class Mesh(Entry):
    """A triangle mesh, m."""

    vertices: Annotated[Array, _rows(3, -10, 10, least=4)]
    faces: Annotated[NDArray[np.int64], _rows(3, 0, 1 << 31, least=4, whole=True)]


class Receiver(Entry):
    """Where the hand stands; `T_world_hand` is the palm's frame."""

    side: Literal["left", "right"]
    T_world_hand: Pose
    id: str = ""


class Own(Entry):
    """What our own exporter adds to a trial."""

    pose: Annotated[list[Angle], Field(min_length=48, max_length=48)]
    shape: Annotated[list[Metres], Field(min_length=10, max_length=10)]
    T_world_hand: Pose
    T_world_palm: (
        Pose  # as in `receiver` when it was written: a hand that was moved since is theirs
    )
    receiver_faces: list[Annotated[int, Field(ge=0)]]


def _own(provenance: Any) -> Any:
    """What our own exporter wrote into a trial's provenance, which may be anything; else None."""
    written = provenance.get("r2h_batch") if isinstance(provenance, dict) else None
    if not isinstance(written, dict) or "pose" not in written:
        return None
    return Own.model_validate(written)


class Planning(Entry):
    """What the release's planner, or another one, said."""

    status: Literal["succeeded", "failed"] = "succeeded"


class GraspContract(Entry):
    """How the release measured the grasp's width."""

    width_policy: str = ""


class TrialFile(Entry):
    """The fields of `handover.trial.v1` that decide what is judged."""

    schema_version: Literal["handover.trial.v1"]
    units: Literal["m"]
    id: Id
    object_id: Name
    variant: Annotated[str, Field(max_length=100)] = ""
    split: Literal["S0", "S1"]
    T_object_gripper: Pose
    target_T_world_gripper: Pose
    object_boxes: Annotated[list[Box], Field(min_length=1)]
    usage_boxes: list[Box] = []
    object_mesh_object: Mesh | None = None
    hand_boxes_world: Annotated[list[Box], Field(min_length=1, max_length=1000)]
    hand_mesh_world: Mesh | None = None
    obstacle_boxes_world: list[Box] | None = None
    palm_position_world: Vector
    palm_normal_world: Vector
    receiver: Receiver | None = None
    reach_offset_m: Annotated[float, Field(gt=0, le=1)] = 0.12
    reach_radius_m: Annotated[float, Field(gt=0, le=2)] = 0.10
    max_opening_m: Opening = 0.085
    dt_s: Annotated[float, Field(gt=0, le=1)] = 1 / 60
    planned_joints: Joints = NO_JOINTS
    executed_joints: Joints = NO_JOINTS
    T_tcp_asset_tool: Pose = np.eye(4).tolist()
    grasp_contract: GraspContract = GraspContract()
    planning: Planning = Planning()
    method_geometry_invalidated: bool = False
    own: Annotated[Any, AfterValidator(_own)] = Field(default=None, alias="provenance")


Kind = TypeVar("Kind", bound=BaseModel)


def validated(row: Any, where: str, kind: type[Kind]) -> Kind:
    try:
        return kind.model_validate(row)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    field = ".".join(printable(p)[:60] for p in first["loc"]) or "the file"
    found = "is missing" if first["type"] == "missing" else f"is {printable(first['input'])[:60]}"
    raise FileError(f"{where}: {field} {found}; {rule_of(first)}")
