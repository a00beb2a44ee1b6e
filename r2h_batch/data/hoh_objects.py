"""HOH's objects (Wiederhold et al. 2023) with the region that its receivers took, and their comfort ratings.

As its owners' own tools read them (repositories of HOH and HOH-Grasps): meshes in millimetres are
HOH_Objects/simplified/ID_simplified.obj, else full/ID_cleaned.obj. A handover is in HOH, or in HOH-Grasps, or in both:

| file | holds |
|---|---|
| CAPTURE/reference/CAPTURE.json | by handover: objects_used, keyframes {o,g,t}_frame_index, giver_receiver_comfort_ratings |
| CAPTURE/3dModelAlignments/CAPTURE_I_transformations.json | 3dm_to_O, O_G (frame numbers), then K_K+1: 4 x 4 of the object, mm |
| CAPTURE/PCFiltered/I/receiver_frameT.ply | the receiver's hand at the transfer, mm |
| scenes/CAPTURE_I_ID/*_transforms.json, *_hand_receiver_t.ply (HOH-Grasps) | obj_to_t and the same hand, m |

A face is taken in a handover where the receiver's hand comes within `TOUCH_M` of its middle. The region is the faces that
more than half as many receivers took as took the most popular face. HOH-Grasps' labels of grasps are GraspNet's
(`grasp_files.graspnet`), in the frame of these meshes.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_json
from r2h_batch.base.io.write import csv_cell
from r2h_batch.data.arrays import files_below, numbers
from r2h_batch.data.oakink_objects import OakObject
from r2h_batch.scene.mesh_import.closed import check_mesh
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.mesh_import.limits import ObjectMeshError

F64 = NDArray[np.float64]
TOUCH_M = 0.01
"""Distance at which a hand of a cloud takes a face: the clouds of depth cameras are some millimetres off."""
SHARE = 0.5
"""Share of the receivers who took the most popular face, above which a face is in the region."""
MODELS = (("simplified", "_simplified"), ("full", "_cleaned"))
MM = 0.001
MAX_JSON = 64 << 20
RIGID = 1e-3
_SCENE = re.compile(r"(?P<capture>[^_]+)_(?P<number>\d+)_(?P<object>\w+)")


@dataclass(frozen=True, eq=False)
class Handover:
    """One handover of an object between two people.

    Attributes:
        capture: name of the session.
        number: of the handover in it.
        object: ID of the object.
        hand: (N, 3) the receiver's hand at the transfer, in the frame of the object's mesh, m; None without a cloud.
        comfort: ratings of giver and receiver as they stand in the file; None where it has none.
    """

    capture: str
    number: int
    object: str
    hand: F64 | None
    comfort: tuple[Any, Any] | None


def _below(folder: Path, pattern: str) -> list[Path]:
    """Files of the pattern below the folder, none that a link leads out of it; empty where there is none."""
    try:
        return files_below(folder, pattern)
    except FileError:
        return []


def meshes(folder: Path) -> dict[str, Path]:
    """ID -> mesh of every object; the simplified one where there are both."""
    found: dict[str, Path] = {}
    for kind, end in MODELS:
        for path in _below(folder, f"**/{kind}/*{end}.obj"):
            found.setdefault(path.stem.removesuffix(end), path)
    if not found:
        raise FileError(
            f"{printable(folder)}: no HOH_Objects/simplified/ID_simplified.obj or full/ID_cleaned.obj below it"
        )
    return dict(sorted(found.items()))


def handovers(folder: Path) -> Iterator[Handover | FileError]:
    """Every handover of HOH and of HOH-Grasps below a folder; one that is in both comes from HOH-Grasps, with HOH's ratings."""
    scenes: dict[tuple[str, int], Path] = {}
    for path in _below(folder, "**/scenes/*/*_transforms.json"):
        if part := _SCENE.fullmatch(path.parent.name):
            scenes[part["capture"], int(part["number"])] = path
    for path in _below(folder, "**/reference/*.json"):
        try:
            listed = _captured(path)
        except FileError as error:
            yield error
            continue
        for number, (name, keyframes, comfort) in enumerate(listed):
            scene = scenes.pop((path.stem, number), None)
            try:
                hand = (
                    _of_scene(scene)
                    if scene
                    else _of_capture(path.parent.parent, number, keyframes)
                )
                yield Handover(path.stem, number, name, hand, comfort)
            except (FileError, ObjectMeshError) as error:
                yield FileError(f"{path.stem} {number}: {error}")
    for (capture, number), path in sorted(scenes.items()):
        name = path.parent.name.rpartition("_")[2]
        try:
            yield Handover(capture, number, name, _of_scene(path), None)
        except (FileError, ObjectMeshError) as error:
            yield FileError(f"{path.parent.name}: {error}")


def _captured(path: Path) -> list[tuple[str, dict[str, Any], tuple[Any, Any] | None]]:
    """(object, keyframes, comfort ratings) of each handover of a session."""
    data, where = read_json(path, most=MAX_JSON), printable(path)
    if not isinstance(data, dict):
        raise FileError(f"{where}: holds a {type(data).__name__}; need fields")
    objects, keyframes = data.get("objects_used"), data.get("keyframes")
    ratings = data.get("giver_receiver_comfort_ratings")
    if (
        not isinstance(objects, list)
        or not isinstance(keyframes, list)
        or len(objects) != len(keyframes)
    ):
        raise FileError(f"{where}: needs objects_used and keyframes, a list each of one length")
    known = (
        ratings
        if isinstance(ratings, list) and len(ratings) == len(objects)
        else [None] * len(objects)
    )
    found = []
    for i, (name, frames, rating) in enumerate(zip(objects, keyframes, known, strict=True)):
        if not isinstance(frames, dict) or not isinstance(name, (str, int)):
            raise FileError(f"{where}: handover {i} needs an object and keyframes")
        pair = (rating[0], rating[1]) if isinstance(rating, list) and len(rating) == 2 else None
        found.append((str(name), frames, pair))
    return found


def _of_capture(folder: Path, number: int, keyframes: Mapping[str, Any]) -> F64 | None:
    """The receiver's hand of a handover of HOH, in the object's frame; None without a cloud."""
    frame = {k: keyframes.get(f"{k}_frame_index") for k in "ogt"}
    if any(not isinstance(value, int) for value in frame.values()):
        raise FileError("keyframes need o_frame_index, g_frame_index and t_frame_index")
    o, g, t = (int(frame[k]) for k in "ogt")  # type: ignore[arg-type]
    if not 0 <= t - g <= 10_000:
        raise FileError(f"the transfer is {t - g} frames after the grasp; 0 to 10,000 are allowed")
    cloud = folder / "PCFiltered" / str(number) / f"receiver_frame{t}.ply"
    file = folder / "3dModelAlignments" / f"{folder.name}_{number}_transformations.json"
    if not cloud.is_file() or not file.is_file():
        return None
    steps = read_json(file, most=MAX_JSON)
    if not isinstance(steps, dict):
        raise FileError(f"{printable(file)}: holds a {type(steps).__name__}; need fields")
    T = np.eye(4)
    for name in ("3dm_to_O", f"{o}_{g}", *(f"{k}_{k + 1}" for k in range(g, t))):
        T = _pose(steps.get(name), f"{printable(file)} {name}") @ T
    return MM * _moved(np.linalg.inv(T).astype(np.float64), _cloud(cloud))


def _of_scene(path: Path) -> F64 | None:
    """The receiver's hand of a scene of HOH-Grasps, in the object's frame; None without a cloud."""
    cloud = path.with_name(f"{path.parent.name}_hand_receiver_t.ply")
    if not cloud.is_file():
        return None
    data = read_json(path, most=MAX_JSON)
    T = _pose(
        data.get("obj_to_t") if isinstance(data, dict) else None, f"{printable(path)} obj_to_t"
    )
    return _moved(np.linalg.inv(T).astype(np.float64), _cloud(cloud))


def _pose(value: Any, what: str) -> F64:
    T = numbers(value, (4, 4), what)
    R = T[:3, :3]
    if (
        np.abs(R @ R.T - np.eye(3)).max() > RIGID
        or np.linalg.det(R) < 0
        or np.abs(T[3] - [0, 0, 0, 1]).max() > RIGID
    ):
        raise FileError(f"{what} is no rigid pose")
    return T


def _cloud(path: Path) -> F64:
    points = np.asarray(load_mesh_file(path, path.name, points=True).vertices)
    return numbers(points, (None, 3), printable(path))


def _moved(T: F64, points: F64) -> F64:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def taken(mesh: trimesh.Trimesh, hands: Sequence[F64]) -> F64:
    """(F,) share of the hands that take each face of a mesh, in m."""
    count = np.zeros(len(mesh.faces))
    for hand in hands:
        if len(hand):
            count += (
                cKDTree(hand).query(mesh.triangles_center, distance_upper_bound=TOUCH_M)[0]
                <= TOUCH_M
            )
    return count / max(len(hands), 1)


def read(name: str, path: Path, hands: Sequence[F64]) -> tuple[OakObject, F64]:
    """An object in the frame of its mesh, m, with the region that its receivers took; and the share of them for each face.

    Raises:
        FileError, ObjectMeshError: the mesh is invalid.
    """
    mesh = load_mesh_file(path, printable(name))
    made = trimesh.Trimesh(MM * np.asarray(mesh.vertices, np.float64), mesh.faces, process=False)
    check_mesh(made.vertices, made.faces, printable(name))
    share = taken(made, hands)
    region = share > SHARE * share.max(initial=0.0)
    one = region.any() and not region.all()
    parts, held = (("rest", "taken"), ("taken",)) if one else (("body",), ())
    return OakObject(object_name(name), made, region.astype(np.int64) * one, parts, held), share


def object_name(identity: str) -> str:
    """The name of an object in benchmarks: HOH's are numbers."""
    return f"hoh_{identity}"


def grasp_files(folder: Path) -> dict[str, Path]:
    """Object -> its labels of grasps in HOH-Grasps (object_grasp_labels/graspnet/ID_labels.npz)."""
    return {
        object_name(p.stem.removesuffix("_labels")): p for p in _below(folder, "**/*_labels.npz")
    }


@dataclass(frozen=True, eq=False)
class Collected:
    """The content of a folder of HOH.

    Attributes:
        objects: with their regions.
        shares: object -> (F,) share of the receivers who took each face.
        handovers: that name one of the objects.
        skipped: name and reason of what could not be read.
    """

    objects: list[OakObject]
    shares: dict[str, F64]
    handovers: list[Handover]
    skipped: list[tuple[str, str]]


def collect(folder: Path, only: Sequence[str] = ()) -> Collected:
    """Every object of a folder (`only`: of these IDs or names), with the region that its receivers took.

    Raises:
        FileError: there is no mesh, or none of a name in `only`.
    """
    known = meshes(folder)
    names = {word: identity for identity in known for word in (identity, object_name(identity))}
    if missing := [word for word in only if word not in names]:
        there = printable(", ".join(list(known)[:20]))
        raise FileError(
            f"{printable(folder)}: no object is called {printable(missing[0])!r}; there are {there}"
        )
    chosen = {names[word] for word in only} or set(known)
    found = Collected([], {}, [], [])
    for one in handovers(folder):
        if isinstance(one, FileError):
            found.skipped.append(("a handover", str(one)))
        elif one.object in chosen:
            found.handovers.append(one)
    for identity in (i for i in known if i in chosen):
        hands = [h.hand for h in found.handovers if h.object == identity and h.hand is not None]
        try:
            made, share = read(identity, known[identity], hands)
        except (FileError, ObjectMeshError) as error:
            found.skipped.append((identity, str(error)))
            continue
        found.objects.append(made)
        found.shares[made.name] = share
    return found


def write_more(out: Path, found: Collected) -> None:
    """meshes/NAME_taken.npy, the shares of `taken`, and comfort.csv, beside what `oakink_objects.write` makes."""
    for name, share in found.shares.items():
        np.save(out / "meshes" / f"{name}_taken.npy", share.astype(np.float32))
    with (out / "comfort.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["object", "capture", "handover", "giver", "receiver"])
        for one in found.handovers:
            if one.comfort is not None:
                cells = (object_name(one.object), one.capture, one.number, *one.comfort)
                rows.writerow([csv_cell(cell) for cell in cells])
