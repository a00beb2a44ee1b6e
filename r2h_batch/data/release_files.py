"""Files of the authors' release (GitHub robot-future/r2handoversim 0.11.0): the fields that decide what
is judged, with their types and bounds. Scenes and selections of their method (GitHub
Hanxin-Zhang/intent-handover) become trials: `handover.scene.v1` says object, hand and grasps,
`handover.selection.v1` which grasp a mode chose, `handover.experiment.v1` which files belong together.

A scene is in the object's frame. Its `target_T_world_object` puts it into the world.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, ValidationError

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import path_within, printable, read_json
from r2h_batch.base.validate import rule_of

Array = NDArray[np.float64]

MAX_BYTES = 256 << 20
RIGID = 1e-6

Id = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,200}$")]
Name = Annotated[str, Field(min_length=1, max_length=64)]
Opening = Annotated[float, Field(gt=0, le=0.085)]
Metres = Annotated[float, Field(ge=-10, le=10)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]
Vector = Annotated[list[Metres], Field(min_length=3, max_length=3)]


def _array(value: Any, shape: tuple[int, ...], low: float, high: float, kinds: str = "iuf") -> Any:
    """A list of rows of this shape as one array: pydantic takes a second for each million numbers."""
    form = " x ".join(map(str, shape))
    try:
        a = np.array(value)
    except ValueError:
        raise ValueError(f"rows must have {form} numbers each") from None
    if not isinstance(value, list):
        raise ValueError("must be a list of rows")
    if not len(value):
        return np.zeros((0, *shape))
    if a.shape[1:] != shape:
        raise ValueError(f"rows must have {form} numbers each")
    if a.dtype.kind not in kinds:
        raise ValueError(f"must hold {'' if 'f' in kinds else 'whole '}numbers")
    wrong = ~((a >= low) & (a <= high)).reshape(len(a), -1).all(1)
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"row {row} is {a[row].tolist()}; {low:g} to {high:g} is allowed")
    return a


def _rows(columns: int, low: float, high: float, least: int = 0, kinds: str = "iuf") -> Any:
    """A field that is a long list of rows of numbers."""

    def check(value: Any) -> Any:
        a = _array(value, (columns,), low, high, kinds)
        if len(a) < least:
            raise ValueError(f"must be a list of {least} or more rows")
        return a

    return PlainValidator(check)


Joints = Annotated[Array, _rows(6, -6.2832, 6.2832)]
NO_JOINTS = np.zeros((0, 6))


def _are_rotations(R: Array) -> NDArray[np.bool_]:
    """Which of (..., 3, 3) are, to `RIGID`."""
    turned = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max((-1, -2))
    return np.asarray((turned <= RIGID) & (np.abs(np.linalg.det(R) - 1) <= RIGID))


def _pose(value: Any) -> Any:
    a = _array(value, (4,), -10, 10).astype(np.float64)
    rigid = a.shape == (4, 4) and np.abs(a[3] - [0, 0, 0, 1]).max() <= 1e-7
    if not rigid or not _are_rotations(a[:3, :3]):
        raise ValueError("must be a rigid pose, 4 x 4, row by row")
    return a


Pose = Annotated[Array, PlainValidator(_pose)]


@dataclass(frozen=True, eq=False)
class Boxes:
    """n boxes in any frame, m."""

    T: Array
    """(n, 4, 4) poses of their middles"""
    half: Array
    """(n, 3) half sides"""

    def __len__(self) -> int:
        return len(self.T)

    def moved(self, T: NDArray[np.floating[Any]]) -> Boxes:
        """The same boxes in the frame in which theirs has the pose T."""
        return Boxes(np.asarray(T @ self.T), self.half)

    def corners(self) -> Array:
        """(n, 8, 3) in the order of `CORNERS`."""
        return transform_points(self.T, CORNERS * self.half[:, None])


CORNERS = trimesh.creation.box((2.0, 2.0, 2.0)).vertices.view(np.ndarray)


def box_faces(n: int) -> NDArray[np.int32]:
    """Faces of n boxes, whose corners follow each other."""
    one = trimesh.creation.box((2.0, 2.0, 2.0)).faces.view(np.ndarray)
    return np.asarray(one + 8 * np.arange(n)[:, None, None], np.int32).reshape(-1, 3)


def transform_points(T: NDArray[np.floating[Any]], points: Array) -> Array:
    """Points (..., k, 3) moved by poses (..., 4, 4)."""
    return np.asarray(points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])


BOX = (
    ("center", (3,), -10.0, None),
    ("half_extents", (3,), 1e-9, None),
    ("rotation", (3, 3), -10.0, np.eye(3).tolist()),
)
"""Fields of a box: shape, least number, what stands for a missing one."""


def _boxes(value: Any) -> Any:
    if isinstance(value, Boxes):  # of a scene, checked there
        return value
    if not isinstance(value, list) or not all(isinstance(b, dict) for b in value):
        raise ValueError("must be a list of boxes")
    parts = {}
    for name, shape, low, usual in BOX:
        try:
            parts[name] = _array([b.get(name, usual) for b in value], shape, low, 10.0)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    T = np.tile(np.eye(4), (len(value), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = parts["rotation"], parts["center"]
    if not (right := _are_rotations(T[:, :3, :3])).all():
        raise ValueError(f"rotation: row {right.argmin()} is not a rotation, 3 x 3")
    return Boxes(T, parts["half_extents"].astype(np.float64))


BoxList = Annotated[Boxes, PlainValidator(_boxes)]
NO_BOXES = Boxes(np.zeros((0, 4, 4)), np.zeros((0, 3)))


class Entry(BaseModel):
    """Fields that decide nothing here (provenance, displays) may stand beside those that are named."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class Mesh(Entry):
    """A triangle mesh, m."""

    vertices: Annotated[Array, _rows(3, -10, 10, least=4)]
    faces: Annotated[NDArray[np.int64], _rows(3, 0, 1 << 31, least=4, kinds="iu")]
    source_path: str = ""
    source_sha256: Annotated[str, Field(pattern="^([0-9a-f]{64})?$")] = ""


class Receiver(Entry):
    """Where the hand stands; `T_world_hand` is the palm's frame."""

    side: Literal["left", "right"]
    T_world_hand: Pose
    id: str = ""


class Own(Entry):
    """Fields that our own exporter adds to a trial."""

    pose: Annotated[list[Angle], Field(min_length=48, max_length=48)]
    shape: Annotated[list[Metres], Field(min_length=10, max_length=10)]
    T_world_hand: Pose
    T_world_palm: (
        Pose  # as in `receiver` when it was written: a hand that was moved since is theirs
    )
    receiver_faces: (
        Annotated[Array, PlainValidator(lambda x: _array(x, (), 0, 1 << 31, "iu").astype(np.int64))]
        | None
    ) = None
    """None: the region is the usage boxes"""


def _own(provenance: Any) -> Any:
    """Provenance that our own exporter wrote into a trial; None if another program wrote it."""
    written = provenance.get("r2h_batch") if isinstance(provenance, dict) else None
    if not isinstance(written, dict) or "pose" not in written:
        return None
    return Own.model_validate(written)


class Planning(Entry):
    """Result of the release's planner, or of another one."""

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
    object_boxes: Annotated[BoxList, Field(min_length=1)]
    usage_boxes: BoxList = NO_BOXES
    object_mesh_object: Mesh | None = None
    hand_boxes_world: Annotated[BoxList, Field(min_length=1, max_length=1000)]
    hand_mesh_world: Mesh | None = None
    obstacle_boxes_world: BoxList | None = None
    palm_position_world: Vector
    palm_normal_world: Vector
    receiver: Receiver | None = None
    reach_offset_m: Annotated[float, Field(gt=0, le=1)] = 0.12
    reach_radius_m: Annotated[float, Field(gt=0, le=2)] = 0.10
    max_opening_m: Opening = 0.085
    dt_s: Annotated[float, Field(gt=0, le=1)] = 1 / 60
    planned_joints: Joints = NO_JOINTS
    executed_joints: Joints = NO_JOINTS
    T_tcp_asset_tool: Pose = np.eye(4)
    grasp_contract: GraspContract = GraspContract()
    planning: Planning = Planning()
    method_geometry_invalidated: bool = False
    own: Annotated[Any, AfterValidator(_own)] = Field(default=None, alias="provenance")


Model = TypeVar("Model", bound=BaseModel)


def validated(row: Any, where: str, kind: type[Model]) -> Model:
    try:
        return kind.model_validate(row)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    field = ".".join(printable(p)[:60] for p in first["loc"]) or "the file"
    found = "is missing" if first["type"] == "missing" else f"is {printable(first['input'])[:60]}"
    raise FileError(f"{where}: {field} {found}; {rule_of(first)}")


PALM_NORMAL = [1.0, 0.0, 0.0]
"""Palm normal of a scene that names none, in the object's frame."""


class _Object(Entry):
    id: Name
    boxes: BoxList
    usage_regions: dict[str, BoxList] = Field(default={})
    mesh: Mesh | None = None


class _Intent(Entry):
    human_region: str = ""


class _Hand(Entry):
    center: Vector
    palm_normal: Vector = PALM_NORMAL
    boxes: BoxList
    mesh: Mesh | None = None


class _Gripper(Entry):
    max_opening_m: Opening = 0.085
    width_policy: str = ""


class _Grasp(Entry):
    id: str
    T_object_gripper: Pose | None = None


class SceneFile(Entry):
    """The fields of `handover.scene.v1` that decide what is judged."""

    schema_version: Literal["handover.scene.v1"]
    units: Literal["m"]
    object: _Object
    intent: _Intent = _Intent()
    receiving_hand: _Hand
    gripper: _Gripper = _Gripper()
    candidates: list[_Grasp] = Field(default=[])
    evaluation_split: Literal["S0", "S1"]
    receiver: Receiver | None = None
    target_T_world_object: Pose


class SelectionFile(Entry):
    """The fields of `handover.selection.v1` that decide what is judged."""

    schema_version: Literal["handover.selection.v1"]
    object_id: Name
    mode: Id
    status: Literal["ok", "no_feasible_grasp"]
    selected: str | None = None
    candidates: list[_Grasp] = Field(default=[])


class _Batch(Entry):
    object_id: Name
    scene: str
    selections: dict[str, str]


class ExperimentFile(Entry):
    """The files of `handover.experiment.v1`, beside it or below."""

    schema_version: Literal["handover.experiment.v1"]
    objects: list[_Batch]


def experiment_trials(data: Any, file: Path) -> tuple[list[TrialFile], int]:
    """The trials of an experiment, and how many of its selections chose no grasp."""
    where = printable(file)
    experiment = validated(data, where, ExperimentFile)
    found, none = [], 0
    for batch in experiment.objects:
        scene_file = path_within(file.parent, batch.scene)
        scene = validated(read_json(scene_file, most=MAX_BYTES), printable(scene_file), SceneFile)
        for mode, name in batch.selections.items():
            chosen = path_within(file.parent, name)
            shown = printable(chosen)
            selection = validated(read_json(chosen, most=MAX_BYTES), shown, SelectionFile)
            if selection.mode != mode:
                raise FileError(f"{shown}: mode is {selection.mode}; {where} says {mode}")
            trial = _trial(scene, selection, shown)
            found += [] if trial is None else [trial]
            none += trial is None
    return found, none


def paired_trials(
    scenes: Sequence[tuple[Any, str]], selections: Sequence[tuple[Any, str]]
) -> tuple[list[TrialFile], int]:
    """The trials of selections, each with the scene of its object; (data, name of the file) of both.
    And how many selections chose no grasp."""
    by_object: dict[str, SceneFile] = {}
    for data, where in scenes:
        scene = validated(data, where, SceneFile)
        if scene.object.id in by_object:
            raise FileError(f"{where}: object.id {scene.object.id} has two scenes; give one")
        by_object[scene.object.id] = scene
    found, none = [], 0
    for data, where in selections:
        selection = validated(data, where, SelectionFile)
        if selection.object_id not in by_object:
            what = f"object_id {selection.object_id} has no handover.scene.v1 beside it"
            raise FileError(f"{where}: {what}")
        trial = _trial(by_object[selection.object_id], selection, where)
        found += [] if trial is None else [trial]
        none += trial is None
    return found, none


def _trial(scene: SceneFile, selection: SelectionFile, where: str) -> TrialFile | None:
    """The selection as a trial; None where no grasp was feasible."""
    if selection.object_id != scene.object.id:
        raise FileError(f"{where}: object_id is {selection.object_id}, not {scene.object.id}")
    if selection.status != "ok":
        return None
    every = (*scene.candidates, *selection.candidates)
    grasps = {g.id: g.T_object_gripper for g in every if g.T_object_gripper is not None}
    if selection.selected not in grasps:
        raise FileError(
            f"{where}: selected is {selection.selected}; none such has T_object_gripper"
        )
    T_world_object, T_object_gripper = scene.target_T_world_object, grasps[selection.selected]
    hand, receiver = scene.receiving_hand, scene.receiver
    palm = transform_points(T_world_object, np.array([hand.center]))[0]
    normal = T_world_object[:3, :3] @ hand.palm_normal
    mesh = None
    if hand.mesh is not None:
        moved = transform_points(T_world_object, hand.mesh.vertices)
        mesh = hand.mesh.model_copy(update={"vertices": moved})
    if receiver is not None:
        palm, normal = receiver.T_world_hand[:3, 3], receiver.T_world_hand[:3, 2]
    region = scene.object.usage_regions.get(scene.intent.human_region, NO_BOXES)
    name = f"{scene.object.id}_{selection.mode}"
    name += f"_{receiver.id}" if receiver and receiver.id else ""
    trial: Mapping[str, Any] = {
        "schema_version": "handover.trial.v1",
        "units": "m",
        "id": name,
        "object_id": scene.object.id,
        "variant": selection.mode,
        "split": scene.evaluation_split,
        "T_object_gripper": T_object_gripper.tolist(),
        "target_T_world_gripper": (T_world_object @ T_object_gripper).tolist(),
        "object_boxes": scene.object.boxes,
        "object_mesh_object": scene.object.mesh,
        "usage_boxes": region if scene.evaluation_split == "S1" else NO_BOXES,
        "hand_boxes_world": hand.boxes.moved(T_world_object),
        "hand_mesh_world": mesh,
        "palm_position_world": palm.tolist(),
        "palm_normal_world": normal.tolist(),
        "receiver": receiver,
        "max_opening_m": scene.gripper.max_opening_m,
        "grasp_contract": GraspContract(width_policy=scene.gripper.width_policy),
    }
    return validated(trial, where, TrialFile)
