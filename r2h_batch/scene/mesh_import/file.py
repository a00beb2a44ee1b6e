"""A mesh file read as triangles, in a process of its own: readers of other people's files may take
any time and memory.

The child gets the opened file as its stdin and answers with two arrays. Materials and textures are
never loaded; buffers that a glTF names are, from the file's own folder. `python -m
r2h_batch.scene.mesh_import.file` is the child.
"""

from __future__ import annotations

import importlib.util
import io
import os
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import answer_parent, read_in_child, temporary_file
from r2h_batch.base.io.read import open_file, path_within, printable, read_file
from r2h_batch.scene.mesh_import.limits import MOST_BYTES, MOST_SECONDS, ObjectMeshError

SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")
ROBOT_SUFFIXES = (*SUFFIXES, ".dae")
"""Formats of meshes of a robot's links."""


def load_mesh_file(path: str | Path, label: str, *, points: bool = False) -> trimesh.Trimesh:
    """The triangles of a mesh file as it stands, with `points` also the vertices of a file without
    any; each fault of it is one `ObjectMeshError`."""
    (mesh,) = _load([Path(path)], printable(label), SUFFIXES, points=points)
    return mesh


def load_robot_meshes(paths: Sequence[Path], label: str) -> list[trimesh.Trimesh]:
    """The triangles of mesh files, read by one process; COLLADA's in metres, its up axis ignored, as
    RViz reads them. Whatever is wrong with one is one `ObjectMeshError`."""
    if not paths:
        return []
    try:
        return _load(list(paths), printable(label), ROBOT_SUFFIXES)
    except ObjectMeshError:
        if len(paths) == 1:
            raise
        # each alone: one that ends its reader, or takes too long, is named
        return [_load([path], printable(label), ROBOT_SUFFIXES)[0] for path in paths]


def check_name(path: Path, label: str, suffixes: Sequence[str] = SUFFIXES) -> None:
    """Raises `ObjectMeshError` where a path names no mesh file, before it is read.

    Args:
        path: of the file.
        label: the object's name in errors.
        suffixes: allowed endings.
    """
    shown = printable(path)
    if path.suffix.lower() not in suffixes:
        raise ObjectMeshError(f"{label}: {shown} is not one of {', '.join(suffixes)}; convert it")
    if not os.path.exists(path):  # also of a name that is too long
        raise ObjectMeshError(f"{label}: no file {shown}; give a mesh ({', '.join(suffixes)})")


def _load(
    paths: list[Path], label: str, suffixes: Sequence[str], *, points: bool = False
) -> list[trimesh.Trimesh]:
    for path in paths:
        check_name(path, label, suffixes)
    what = paths[0].name if len(paths) == 1 else f"{len(paths)} meshes"
    shown = printable(paths[0])
    try:
        with temporary_file() as joined:
            files = []
            for path in paths:
                with open_file(path, MOST_BYTES) as file:
                    size = os.fstat(file.fileno()).st_size
                    if size == 0:
                        empty = f"{printable(path)} is empty (0 bytes); export the mesh again"
                        raise ObjectMeshError(f"{label}: {empty}")
                    shutil.copyfileobj(file, joined)
                folder = str(path.parent.resolve())
                files.append({"type": path.suffix[1:].lower(), "folder": folder, "size": size})
            joined.flush()
            joined.seek(0)
            try:
                answers = read_in_child(
                    "r2h_batch.scene.mesh_import.file",
                    joined,
                    {"files": files, "points": points},
                    count=4 * len(paths),
                    seconds=MOST_SECONDS,
                    doing=f"{label}: reading {what}",
                )
            except FileError as error:
                how = "" if ";" in str(error) else "; export it as a plain STL or OBJ"
                raise FileError(f"{shown} {error}{how}") from None
    except FileError as error:
        raise ObjectMeshError(f"{label}: {error}") from None
    found = []
    for i, path in enumerate(paths):
        vertices, faces, part, names = answers[4 * i : 4 * i + 4]
        if len(faces) == 0 and not (points and len(vertices)):
            raise ObjectMeshError(f"{label}: {printable(path)} {_no_triangles(path)}")
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        if len(names) > 1:
            mesh.metadata[LABELS] = (part, tuple(str(n) for n in names))
        found.append(mesh)
    return found


def _no_triangles(path: Path) -> str:
    """Why a file that was read has no triangles, and what to do."""
    with open_file(path, MOST_BYTES) as file:
        head = file.read(4096)
    if head.startswith(b"version https://git-lfs"):
        return "is a pointer of Git LFS, not the mesh; run git lfs pull"
    if path.suffix.lower() == ".stl" and b"\0" not in head and b"facet" not in head.lower():
        how = "rename it .obj" if re.search(rb"^v[ \t]", head, re.MULTILINE) else "export it as STL"
        return f"is text without a facet, so no STL; {how}"
    return "is empty: no triangles in it; export a triangle mesh"


def labels_of(mesh: trimesh.Trimesh) -> tuple[NDArray[np.int64], tuple[str, ...]] | None:
    """(F,) part of each face and the parts' names, as the named groups of its file said; None where
    they said none.

    Args:
        mesh: as read from its file, before it is closed.
    """
    return mesh.metadata.get(LABELS)


LABELS = "r2h_batch part labels"
FROM_END = re.compile(rb"^f\s(?:.*\s)?-\d", re.MULTILINE)
MOST_GROUPS = 64
"""Named groups of a file that are parts: more are something else, smoothing or materials."""


class _Beside(trimesh.resolvers.Resolver):
    """Files that a glTF names as its buffers: beside it or below, nowhere else."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def get(self, name: str) -> bytes:
        return read_file(path_within(self.folder, name), MOST_BYTES)

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: object) -> None:
        raise FileError(f"{name}: nothing is written")

    def namespaced(self, namespace: str) -> trimesh.resolvers.Resolver:
        return self


def _read_grouped(
    data: io.BytesIO, kind: str, resolver: _Beside
) -> tuple[Any, NDArray[np.int64], list[str]]:
    """The mesh, (F,) the named group of each face, the groups' names (none where there are fewer
    than two)."""
    options: dict[str, Any] = {"process": False, "maintain_order": True, "skip_materials": True}
    none: tuple[NDArray[np.int64], list[str]] = (np.zeros(0, np.int64), [])
    if kind == "obj":
        text = _plain_obj(data.getvalue())
        if (found := _obj_groups(text)) is not None:
            return found
        mesh = trimesh.load_mesh(io.BytesIO(text), file_type=kind, resolver=resolver, **options)
        if (told := _told_faces(text)) and len(getattr(mesh, "faces", ())) != told:
            mesh = _obj_triangles(text.decode("utf-8", "replace").splitlines(), "g")[0]
        return mesh, *none
    if kind not in ("glb", "gltf", "dae"):
        return trimesh.load_mesh(data, file_type=kind, resolver=resolver, **options), *none
    scene = trimesh.load_scene(data, file_type=kind, resolver=resolver, **options)
    vertices, faces, part, count = [], [], [], 0
    names: list[str] = []
    for node in scene.graph.nodes_geometry:
        T, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        scale = 1.0
        if kind == "dae":  # "0.01 * meters", "meters"
            number = str(mesh.metadata.get("units", "")).partition(" ")[0]
            scale = float(number) if number[:1].isdigit() else 1.0
        vertices.append(scale * trimesh.transform_points(mesh.vertices, T))
        turned = np.linalg.det(T[:3, :3]) < 0  # a mirrored node
        faces.append((mesh.faces[:, ::-1] if turned else mesh.faces) + count)
        part.append(np.full(len(mesh.faces), len(names)))
        names.append(_word(str(node)))
        count += len(mesh.vertices)
    if not vertices:
        return trimesh.Trimesh(), *none
    made = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    if not 2 <= len(set(names)) <= MOST_GROUPS:
        return made, *none
    return made, *_numbered(np.concatenate(part), names)


def _plain_obj(text: bytes) -> bytes:
    """An OBJ with one blank between two words and none before the first: trimesh leaves out lines with tabs or indents."""
    text = re.sub(rb"\\[ \t]*\r?\n", b" ", text)  # a line that goes on
    if not re.search(rb"\t|^ ", text, re.MULTILINE):
        return text
    return b"\n".join(b" ".join(line.split()) for line in text.splitlines()) + b"\n"


def _told_faces(text: bytes) -> int:
    """How many triangles the `f` lines of an OBJ make."""
    return sum(len(line.split()) - 3 for line in text.splitlines() if line[:2] == b"f ")


def _obj_groups(text: bytes) -> tuple[Any, NDArray[np.int64], list[str]] | None:
    """An OBJ's triangles by its `g` or `o` lines; None where these name fewer than two groups of
    faces, or too many, and trimesh reads it as well (it counts indices from the end through
    vertices that come later)."""
    lines = text.decode("utf-8", "replace").splitlines()
    for kind in ("g", "o"):
        names = {line.strip() for line in lines if line.startswith((f"{kind} ", f"{kind}\t"))}
        if 2 <= len(names) <= MOST_GROUPS:
            mesh, part, kept = _obj_triangles(lines, kind)
            if len(kept) > 1:
                return mesh, part, kept
    if FROM_END.search(text):
        return _obj_triangles(lines, "g")[0], np.zeros(0, np.int64), []
    return None


def _obj_triangles(lines: list[str], kind: str) -> tuple[Any, NDArray[np.int64], list[str]]:
    """Triangles of the `f` lines as fans, the group of each, the groups' names."""
    corners: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    part: list[int] = []
    seen, now = ["body"], 0
    for line in lines:
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            corners.append([float(x) for x in words[1:4]])
        elif words[0] == kind:
            name = _word(" ".join(words[1:]))
            if name not in seen:
                seen.append(name)
            now = seen.index(name)
        elif words[0] == "f":
            index = [int(w.partition("/")[0]) for w in words[1:]]
            index = [i - 1 if i > 0 else len(corners) + i for i in index]
            if min(index, default=0) < 0:
                raise ValueError(f"a face names vertex {min(index)}")
            faces += [(index[0], index[k], index[k + 1]) for k in range(1, len(index) - 1)]
            part += [now] * (len(index) - 2)
    arrays = np.array(corners).reshape(-1, 3), np.array(faces).reshape(-1, 3)
    return trimesh.Trimesh(*arrays, process=False), *_numbered(np.array(part, np.int64), seen)


def _numbered(part: NDArray[np.int64], names: list[str]) -> tuple[NDArray[np.int64], list[str]]:
    """Labels counted through the names that faces have, equal names as one."""
    kept = list(dict.fromkeys(names[k] for k in np.unique(part)))
    lookup = np.array([kept.index(n) if n in kept else 0 for n in names], np.int64)
    return lookup[part], kept


def _word(name: str) -> str:
    """A name fit for a part's: letters, digits, `_`, `-`, `.` and blanks, at most 64."""
    return re.sub(r"[^A-Za-z0-9_. -]+", "_", name.strip())[:64].strip() or "part"


def _child(data: bytes, options: dict[str, Any]) -> list[Any]:
    """For each file vertices, faces, the part of each face, the parts' names."""
    answers, at = [], 0
    for file in options["files"]:
        answers += _arrays_of(data[at : at + file["size"]], file, options["points"])
        at += file["size"]
    return answers


def _arrays_of(data: bytes, file: dict[str, Any], points: bool) -> list[Any]:
    kind, resolver = file["type"], _Beside(file["folder"])
    if kind == "dae":
        _check_collada(data)
    mesh, part, names = _read_grouped(io.BytesIO(data), kind, resolver)
    if points and not len(getattr(mesh, "faces", ())):
        mesh = trimesh.load(io.BytesIO(data), file_type=kind, process=False)
        found = np.asarray(getattr(mesh, "vertices", np.zeros((0, 3))), np.float64)
        return [found, np.zeros((0, 3), np.int64), part, np.array([], dtype="U64")]
    if not isinstance(mesh, trimesh.Trimesh):
        raise FileError(f"holds a {type(mesh).__name__}, no triangles; export a triangle mesh")
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return [vertices, faces, part, np.array(names, dtype="U64")]


def _check_collada(data: bytes) -> None:
    if re.search(rb"<!\s*(doctype|entity)", data, re.IGNORECASE):
        raise FileError("declares a document type; remove it, a mesh needs none")
    if not reads_collada():
        raise FileError("is COLLADA; pip install 'r2h_batch[import]', or convert it to STL")


def reads_collada() -> bool:
    """Whether this environment can read .dae files."""
    return importlib.util.find_spec("collada") is not None


if __name__ == "__main__":
    sys.exit(answer_parent(_child))
