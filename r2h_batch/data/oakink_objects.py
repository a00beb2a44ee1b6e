"""OakInk's objects (Yang et al. 2022) with OakBase's parts, as a folder with a benchmark.yaml.

As its own tools read them: OakInk-Shape lists objects in metaV2 (`data_sets.oakink_objects`); a mesh
is the one .obj or .ply in NAME/align_ds (else align), of several the one with "align" in its name.
OakInk-Image has image/obj/ID.obj. Both loaders move the middle of the bounding box to the origin, and
hands are given in that frame. OakBase describes parts as part_*.ply (meshes or point clouds) with
part_*.json {name, attr: [...]} in a folder called after the object; a part with the attribute
`held_by_hand` is one that people hold: the receiver's region. An object with such a part, and another,
is S1, any other S0.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable, read_json
from r2h_batch.base.io.write import write_npz
from r2h_batch.data.arrays import files_below, numbers
from r2h_batch.data.data_sets import name_of, oakink_objects
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.mesh_import.closed import check_mesh
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.mesh_import.limits import ObjectMeshError
from r2h_batch.scene.solid import Surface

MESHES = (".obj", ".ply")
MAX_PART_BYTES = 64 << 10
HELD, MOST_PARTS = "held_by_hand", 64
ON_PART = 0.05
"""A face farther from every part than this share of the object's largest side is on none of them:
these parts are not of this mesh, or not in its frame. From a cloud it may be farther by the gaps
between the cloud's points."""
CLOUD_GAP = 2.1
"""Gap of points that are spread evenly on a surface: the distance that 95 % of the surface keep to
the nearest point, over the median distance between nearest points."""


@dataclass(frozen=True, eq=False)
class OakObject:
    """One object in its loader's frame."""

    name: str
    mesh: trimesh.Trimesh
    part: NDArray[np.int64]
    """(F,) index into `part_names`"""
    part_names: tuple[str, ...]
    held: tuple[str, ...]
    """the parts that are the receiver's region; none: S0"""


def find(folder: Path) -> list[tuple[str, str, Path]]:
    """(ID, name, mesh or the folder of its folders) of every object of the folder."""
    found, missing = [], 0
    metas = list(folder.glob("**/metaV2/*.json")) if folder.is_dir() else []
    for meta in files_below(folder, "**/metaV2/*obj*_id.json") if metas else []:
        for oid, (name, at) in oakink_objects(meta).items():
            if at.is_dir():
                found.append((oid, name, at))
            else:
                missing += 1
    if not found and not missing:
        found = [
            (p.stem, p.stem, p)
            for p in files_below(folder, "**/image/obj/*.*")
            if p.suffix in MESHES
        ]
    if not found:
        raise FileError(
            f"{printable(folder)}: of {missing} objects in metaV2 no folder OakInkObjectsV2/NAME is here"
        )
    return sorted(found)


def read(oid: str, name: str, at: Path, parts: dict[str, list[Path]]) -> OakObject:
    """The object in a folder; `parts`: what `part_files` found. Raises `FileError` or
    `ObjectMeshError`."""
    kinds = ("align_ds", "align")
    files = [at] if at.is_file() else next(filter(None, (_meshes(at / k) for k in kinds)), [])
    if len(files) > 1:
        files = [p for p in files if "align" in p.name]
    if len(files) != 1:
        raise FileError(
            f"{printable(at)}: align_ds or align needs one .obj or .ply, or one with align in its name"
        )
    mesh = load_mesh_file(files[0], printable(name))
    label, names, held = _labels(mesh, parts.get(name) or parts.get(oid) or [], printable(name))
    middle = mesh.bounds.mean(axis=0)
    made = trimesh.Trimesh(mesh.vertices - middle, mesh.faces, process=False)
    check_mesh(made.vertices, made.faces, printable(name))
    return OakObject(name_of(name), made, label, names, held if 0 < len(held) < len(names) else ())


def part_files(folder: Path) -> dict[str, list[Path]]:
    """Folder name -> its part_*.json, everywhere below."""
    found: dict[str, list[Path]] = {}
    try:
        files = files_below(folder, "**/part_*.json")
    except FileError:
        return {}
    for path in files:
        found.setdefault(path.parent.name, []).append(path)
    return found


def _labels(
    mesh: trimesh.Trimesh, files: list[Path], label: str
) -> tuple[NDArray[np.int64], tuple[str, ...], tuple[str, ...]]:
    """The part of each face: the one whose mesh is nearest to it; the names; those that are
    held."""
    if not files:
        return np.zeros(len(mesh.faces), np.int64), ("body",), ()
    if len(files) > MOST_PARTS:
        raise FileError(f"{label}: {len(files)} parts; at most {MOST_PARTS} are allowed")
    names, held, distance, gaps = [], [], [], []
    for file in files:
        part = read_json(file, most=MAX_PART_BYTES)
        if not isinstance(part, dict):
            raise FileError(f"{printable(file)}: holds a {type(part).__name__}; need fields")
        attributes = part.get("attr", [])
        name = part.get("name")
        name = name[0] if isinstance(name, list) and name else name
        if not isinstance(name, str) or not isinstance(attributes, list):
            raise FileError(f"{printable(file)}: needs name and attr")
        names.append(name_of(name))
        if HELD in attributes:
            held.append(names[-1])
        away, gap = _distance(file.with_suffix(".ply"), mesh.triangles_center, label)
        distance.append(away)
        gaps.append(gap)
    nearest = np.stack(distance)
    most = ON_PART * float(mesh.extents.max())
    off = float(np.quantile((nearest - np.minimum(gaps, most)[:, None]).min(axis=0), 0.95))
    if off > most:
        raise FileError(
            f"{label}: its parts are {1e3 * off:.1f} mm from its mesh; is the frame the same?"
        )
    kept = tuple(dict.fromkeys(names))
    number = np.array([kept.index(n) for n in names])
    return number[nearest.argmin(axis=0)], kept, tuple(dict.fromkeys(held))


def write(
    out: Path,
    objects: list[OakObject],
    grasps: Mapping[str, GraspSet] = MappingProxyType({}),
    hands: int | None = None,
) -> None:
    """The folder: meshes/NAME.ply, meshes/NAME_parts.npy, meshes/NAME_grasps.npz, benchmark.yaml.

    Args:
        out: the folder.
        objects: what it holds.
        grasps: candidates of objects, by name.
        hands: number of hands a side that the benchmark takes of hands.npz, on hand.npz.
    """
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    lines = ["objects:"]
    if hands is not None:
        entry = f"- {{file: hands.npz, count: {hands}}}"
        lines = ["hand_model: hand.npz", "hand_set:", entry, *lines]
    for o in objects:
        (out / "meshes" / f"{o.name}.ply").write_bytes(trimesh.exchange.ply.export_ply(o.mesh))
        lines += [f"- file: meshes/{o.name}.ply", f'  name: "{o.name}"']
        lines.append(f"  split: {'S1' if o.held else 'S0'}")
        if len(o.part_names) > 1:
            np.save(out / "meshes" / f"{o.name}_parts.npy", o.part.astype(np.uint8))
            lines.append(f"  parts: meshes/{o.name}_parts.npy")
            lines.append(f"  part_names: [{', '.join(json.dumps(n) for n in o.part_names)}]")
        if o.name in grasps:
            own = grasps[o.name]
            at = f"meshes/{o.name}_grasps.npz"
            write_npz(out / at, {**own.arrays(), "gripper": np.array(own.gripper)})
            lines.append(f"  grasps: {at}")
        if o.held:
            lines.append(f'  receiver: "{",".join(o.held)}"')
    (out / "benchmark.yaml").write_text("\n".join(lines) + "\n")


def _distance(
    file: Path, points: NDArray[np.float64], label: str
) -> tuple[NDArray[np.float64], float]:
    """How far points are from a part: from its surface, or from a cloud's nearest point; and how far
    a point of the surface may be from a cloud that is sparse."""
    part = load_mesh_file(file, label, points=True)
    if len(part.faces):
        return Surface(part).within(points, 10.0)[0], 0.0
    vertices = numbers(np.asarray(part.vertices), (None, 3), printable(file), most=1e3)
    tree = cKDTree(vertices)
    apart = tree.query(vertices, k=2)[0][:, 1] if len(vertices) > 1 else np.zeros(1)
    return np.asarray(tree.query(points)[0]), CLOUD_GAP * float(np.median(apart))


def _meshes(folder: Path) -> list[Path]:
    if not folder.is_dir() or folder.is_symlink():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix in MESHES and not p.is_symlink())


def collect(
    folder: Path, only: Sequence[str] = ()
) -> Iterator[tuple[str, OakObject | FileError | ObjectMeshError]]:
    """Every object (`only`: of these names or IDs), or why it is left out, by its name; two of one
    name get their number too."""
    parts, seen = part_files(folder), set()
    known = find(folder)
    every = {n for oid, name, _ in known for n in (oid, name, name_of(name))}
    if missing := [n for n in only if n not in every]:
        there = printable(", ".join(sorted(every)[:20]))
        hint = nearest(missing[0], sorted(every)) or f"; there are {there}"
        raise FileError(f"{printable(folder)}: no object is called {printable(missing[0])!r}{hint}")
    for oid, name, at in known:
        if only and not {oid, name, name_of(name)} & set(only):
            continue
        try:
            made = read(oid, name, at, parts)
        except (FileError, ObjectMeshError) as error:
            yield name, error
            continue
        if made.name in seen:
            made = replace(made, name=name_of(f"{made.name}_{oid}"))
        seen.add(made.name)
        yield name, made
