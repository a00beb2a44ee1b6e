"""Scenes and selections of the authors' method (GitHub Hanxin-Zhang/intent-handover) as trials of
their release: `handover.scene.v1` says object, hand and grasps, `handover.selection.v1` which grasp
a mode chose, `handover.experiment.v1` which files belong together.

A scene is in the object's frame. Its `target_T_world_object` puts it into the world.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from r2h_batch.importers.release_files import (
    MAX_BYTES,
    NO_BOXES,
    BoxList,
    Entry,
    GraspContract,
    Id,
    Mesh,
    Name,
    Opening,
    Pose,
    Receiver,
    TrialFile,
    Vector,
    transform_points,
    validated,
)
from r2h_batch.io.read import FileError, path_within, printable, read_json

PALM_NORMAL = [1.0, 0.0, 0.0]
"""Of a scene that names none, in the object's frame."""


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
            selection = validated(
                read_json(chosen, most=MAX_BYTES), printable(chosen), SelectionFile
            )
            if selection.mode != mode:
                raise FileError(
                    f"{printable(chosen)}: mode is {selection.mode}; {where} says {mode}"
                )
            trial = _trial(scene, selection, printable(chosen))
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
            raise FileError(
                f"{where}: object.id {scene.object.id} has two scenes; name an experiment"
            )
        by_object[scene.object.id] = scene
    found, none = [], 0
    for data, where in selections:
        selection = validated(data, where, SelectionFile)
        if selection.object_id not in by_object:
            raise FileError(
                f"{where}: object_id {selection.object_id} has no handover.scene.v1 beside it"
            )
        trial = _trial(by_object[selection.object_id], selection, where)
        found += [] if trial is None else [trial]
        none += trial is None
    return found, none


def _trial(scene: SceneFile, selection: SelectionFile, where: str) -> TrialFile | None:
    """The selection as a trial; None where no grasp was feasible."""
    if selection.object_id != scene.object.id:
        raise FileError(
            f"{where}: object_id is {selection.object_id}, the scene's is {scene.object.id}"
        )
    if selection.status != "ok":
        return None
    grasps = {
        g.id: g.T_object_gripper
        for g in (*scene.candidates, *selection.candidates)
        if g.T_object_gripper is not None
    }
    if selection.selected not in grasps:
        raise FileError(
            f"{where}: selected is {selection.selected}; no candidate of this id has T_object_gripper"
        )
    T_world_object, T_object_gripper = scene.target_T_world_object, grasps[selection.selected]
    hand, receiver = scene.receiving_hand, scene.receiver
    palm = transform_points(T_world_object, np.array([hand.center]))[0]
    normal = T_world_object[:3, :3] @ hand.palm_normal
    mesh = None
    if hand.mesh is not None:
        mesh = hand.mesh.model_copy(
            update={"vertices": transform_points(T_world_object, hand.mesh.vertices)}
        )
    if receiver is not None:
        palm, normal = receiver.T_world_hand[:3, 3], receiver.T_world_hand[:3, 2]
    region = scene.object.usage_regions.get(scene.intent.human_region, NO_BOXES)
    name = f"{scene.object.id}_{selection.mode}" + (
        f"_{receiver.id}" if receiver and receiver.id else ""
    )
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
