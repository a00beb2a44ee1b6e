"""OakInk-Shape's objects (Yang et al. 2022) with OakBase's parts, as a folder with a
benchmark.yaml.

As its own tools read them: shape/metaV2/{object_id,virtual_object_id}.json say {ID: {"name":
NAME}}; a mesh is the one .obj or .ply in OakInkObjectsV2/NAME/align_ds (else align), virtual ones
in OakInkVirtualObjectsV2; its loader moves the middle of the bounding box to the origin, and hands
are given in that frame. OakBase describes parts as part_*.ply with part_*.json {name, attr: [...]}
in a folder called after the object; a part with the attribute `held_by_hand` is one that people
hold: the receiver's region. An object with such a part, and another, is S1, any other S0.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.bodies.mesh_import.closed import check_mesh
from r2h_batch.bodies.mesh_import.file import load_mesh_file
from r2h_batch.bodies.mesh_import.limits import ObjectMeshError
from r2h_batch.bodies.solid import Surface
from r2h_batch.importers.sequences import files_below
from r2h_batch.io.read import FileError, path_within, printable, read_file

__all__ = ["OakObject", "collect", "write"]

META = {"object_id.json": "OakInkObjectsV2", "virtual_object_id.json": "OakInkVirtualObjectsV2"}
MAX_META_BYTES, MAX_PART_BYTES = 16 << 20, 64 << 10
HELD, MOST_PARTS = "held_by_hand", 64
ON_PART = 0.02
"""A face farther from every part than this share of the object's largest side is on none of them:
these parts are not of this mesh, or not in its frame."""


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
    """(ID, name, the folder of its meshes' folders) of every object that the meta files name and
    that is here."""
    found, missing = [], 0
    for meta in files_below(folder, "**/metaV2/*object_id.json"):
        base = meta.parent.parent
        for oid, entry in _dictionary(meta, MAX_META_BYTES).items():
            name = entry.get("name") if isinstance(entry, dict) else None
            if not isinstance(name, str) or meta.name not in META:
                raise FileError(f"{printable(meta)}: {printable(oid)[:40]} has no name")
            at = path_within(base / META[meta.name], name)
            if at.is_dir():
                found.append((oid, name, at))
            else:
                missing += 1
    if not found:
        raise FileError(
            f"{printable(folder)}: of {missing} objects in metaV2 no folder OakInkObjectsV2/NAME is here"
        )
    return sorted(found)


def read(oid: str, name: str, at: Path, parts: dict[str, list[Path]]) -> OakObject:
    """The object in a folder; `parts`: what `part_files` found. Raises `FileError` or
    `ObjectMeshError`."""
    files = [p for kind in ("align_ds", "align") for p in _meshes(at / kind)]
    if not files:
        raise FileError(f"{printable(at)}: no .obj or .ply in align_ds or align")
    mesh = load_mesh_file(files[0], printable(name))
    label, names, held = _labels(mesh, parts.get(name) or parts.get(oid) or [], printable(name))
    middle = mesh.bounds.mean(axis=0)
    made = trimesh.Trimesh(mesh.vertices - middle, mesh.faces, process=False)
    check_mesh(made.vertices, made.faces, printable(name))
    return OakObject(_name(name), made, label, names, held if 0 < len(held) < len(names) else ())


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
    names, held, distance = [], [], []
    for file in files:
        said = _dictionary(file, MAX_PART_BYTES)
        attributes = said.get("attr", [])
        name = said.get("name")
        name = name[0] if isinstance(name, list) and name else name
        if not isinstance(name, str) or not isinstance(attributes, list):
            raise FileError(f"{printable(file)}: needs name and attr")
        part = load_mesh_file(file.with_suffix(".ply"), label)
        names.append(_name(name))
        if HELD in attributes:
            held.append(names[-1])
        distance.append(Surface(part).within(mesh.triangles_center, 10.0)[0])
    nearest = np.stack(distance)
    off = float(np.quantile(nearest.min(axis=0), 0.95))
    if off > ON_PART * float(mesh.extents.max()):
        raise FileError(
            f"{label}: its parts are {1e3 * off:.1f} mm from its mesh; are both in one frame?"
        )
    kept = tuple(dict.fromkeys(names))
    number = np.array([kept.index(n) for n in names])
    return number[nearest.argmin(axis=0)], kept, tuple(dict.fromkeys(held))


def write(out: Path, objects: list[OakObject]) -> None:
    """The folder: meshes/NAME.ply, meshes/NAME_parts.npy, benchmark.yaml."""
    (out / "meshes").mkdir(parents=True, exist_ok=True)
    lines = ["objects:"]
    for o in objects:
        (out / "meshes" / f"{o.name}.ply").write_bytes(trimesh.exchange.ply.export_ply(o.mesh))
        lines += [
            f"- file: meshes/{o.name}.ply",
            f'  name: "{o.name}"',
            f"  split: {'S1' if o.held else 'S0'}",
        ]
        if len(o.part_names) > 1:
            np.save(out / "meshes" / f"{o.name}_parts.npy", o.part.astype(np.uint8))
            lines.append(f"  parts: meshes/{o.name}_parts.npy")
            lines.append(f"  part_names: [{', '.join(json.dumps(n) for n in o.part_names)}]")
        if o.held:
            lines.append(f'  receiver: "{",".join(o.held)}"')
    (out / "benchmark.yaml").write_text("\n".join(lines) + "\n")


def _meshes(folder: Path) -> Iterator[Path]:
    if folder.is_dir() and not folder.is_symlink():
        yield from sorted(
            p for p in folder.iterdir() if p.suffix in (".obj", ".ply") and not p.is_symlink()
        )


def _dictionary(path: Path, most: int) -> dict[str, Any]:
    try:
        data = json.loads(read_file(path, most))
    except (ValueError, RecursionError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{printable(path)}: no readable JSON ({printable(error)[:100]})") from None
    if not isinstance(data, dict):
        raise FileError(f"{printable(path)}: holds a {type(data).__name__}; need fields")
    return data


def _name(text: str) -> str:
    """A name that a benchmark file allows."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", text.strip())[:64]
    return name if re.match(r"[A-Za-z0-9_]", name) else f"_{name}"[:64]


def collect(folder: Path) -> Iterator[tuple[str, OakObject | FileError | ObjectMeshError]]:
    """Every object, or why it is left out, by its name; two of one name get their number too."""
    parts, seen = part_files(folder), set()
    for oid, name, at in find(folder):
        try:
            made = read(oid, name, at, parts)
        except (FileError, ObjectMeshError) as error:
            yield name, error
            continue
        if made.name in seen:
            made = OakObject(
                _name(f"{made.name}_{oid}"), made.mesh, made.part, made.part_names, made.held
            )
        seen.add(made.name)
        yield name, made
