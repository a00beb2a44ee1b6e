"""A mesh file read as triangles, in a process of its own: readers of other people's files may take any time and memory.

The child gets the opened file as its stdin and answers with two arrays. Materials and textures are never loaded;
buffers that a glTF names are, from the file's own folder. `python -m r2h_batch.bodies.mesh_file` is the child.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import BinaryIO

import numpy as np
import trimesh

from r2h_batch.bodies.mesh_limits import MOST_BYTES, MOST_SECONDS, SILENT_SECONDS, ObjectMeshError
from r2h_batch.command_line import tell
from r2h_batch.files import FileError, open_file, path_within, printable, read_file

__all__ = ["load_mesh_file"]

SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")
MOST_WAITS = 10
"""The child may wait this many times longer than it may work: for a busy machine, not for ever."""
MEMORY_BYTES = 8 << 30
MEMORY_PER_BYTE = 40
"""The child's address space: some for the libraries, and some for each byte of the file (text takes most)."""


def load_mesh_file(path: str | Path, label: str) -> trimesh.Trimesh:
    """The triangles of a mesh file as it stands; whatever is wrong with it is one `ObjectMeshError`."""
    path, label = Path(path), printable(label)
    shown = printable(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ObjectMeshError(f"{label}: {shown} is not one of {', '.join(SUFFIXES)}; convert it to one of them")
    if not os.path.exists(path):  # also of a name that is too long
        raise ObjectMeshError(f"{label}: no file {shown}; give the path of a mesh ({', '.join(SUFFIXES)})")
    try:
        with open_file(path, MOST_BYTES) as file, tempfile.TemporaryFile() as answer:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise ObjectMeshError(f"{label}: {shown} is empty (0 bytes); export the mesh again")
            said = _read_in_child(file, answer, path, size, label)
            if said:
                raise ObjectMeshError(f"{label}: {shown} {said}")
            answer.seek(0)
            vertices, faces = (np.load(answer, allow_pickle=False) for _ in range(2))
    except FileError as error:
        raise ObjectMeshError(f"{label}: {error}") from None
    if len(faces) == 0:
        raise ObjectMeshError(f"{label}: {shown} is empty: no triangles in it; export a triangle mesh")
    return trimesh.Trimesh(vertices, faces, process=False)


def _read_in_child(file: BinaryIO, answer: BinaryIO, path: Path, size: int, label: str) -> str:
    """What the child says is wrong ("" if nothing); its arrays are in `answer`."""
    options = {
        "type": path.suffix[1:].lower(),
        "folder": str(path.parent.resolve()),
        "bytes": size,
        "seconds": MOST_SECONDS,
    }
    # modules from where this process has them, and from nowhere else: the folder may be the mesh's, with a numpy.py in it
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p or os.getcwd() for p in sys.path)}
    child = subprocess.Popen(
        [sys.executable, "-P", "-m", "r2h_batch.bodies.mesh_file", json.dumps(options)],
        stdin=file,
        stdout=answer,
        stderr=subprocess.PIPE,
        env=environment,
    )
    start = time.monotonic()
    try:
        while True:
            try:
                _, said = child.communicate(timeout=SILENT_SECONDS)
                break
            except subprocess.TimeoutExpired:
                waited = time.monotonic() - start
                if waited > MOST_WAITS * MOST_SECONDS:
                    return f"is not read after {waited:.0f} s; export it as a plain STL or OBJ"
                tell(f"{label}: reading {path.name}, {waited:.0f} s")
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
    if child.returncode == 0:
        return ""
    if child.returncode == REFUSED:
        return said.decode("utf-8", "replace").strip().rpartition("\n")[2]
    if child.returncode < 0:
        return (
            f"takes more than {MOST_SECONDS:g} s of CPU time to read, or ends its reader ({-child.returncode}); "
            "export it as a plain STL or OBJ"
        )
    return "cannot be read as a mesh: its reader ended with an error; export it as a plain STL or OBJ"


REFUSED = 3
"""The child's exit code when the last line of its stderr says what is wrong with the file."""


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


def _limit(size: int, seconds: int) -> None:
    """CPU time and address space of this process, where the system has such limits."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    memory = MEMORY_BYTES + MEMORY_PER_BYTE * size
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (memory if hard == resource.RLIM_INFINITY else min(memory, hard), hard))


def child(options: str) -> int:
    """Exit code of the child: 0 with the vertices and faces on stdout, or `REFUSED` with one line on stderr."""
    given = json.loads(options)
    _limit(given["bytes"], int(given["seconds"]))
    data = io.BytesIO(sys.stdin.buffer.read())
    answer, sys.stdout = sys.stdout.buffer, sys.stderr  # whatever a reader prints is no answer
    try:
        mesh = trimesh.load_mesh(
            data,
            file_type=given["type"],
            resolver=_Beside(given["folder"]),
            process=False,
            maintain_order=True,
            skip_materials=True,
        )
        if not isinstance(mesh, trimesh.Trimesh):
            said = f"holds a {type(mesh).__name__}, no triangles; export a triangle mesh"
        else:
            np.save(answer, np.asarray(mesh.vertices, np.float64))
            np.save(answer, np.asarray(mesh.faces, np.int64))
            answer.flush()
            return 0
    except MemoryError:
        said = "asks for more memory than any mesh of its size needs; export it as a plain STL or OBJ"
    except Exception as error:  # trimesh's readers raise whatever their parser meets
        said = f"cannot be read as a mesh: {type(error).__name__}: {printable(error)[:300]}"
    sys.stderr.write(f"\n{said}")
    return REFUSED


if __name__ == "__main__":
    sys.exit(child(sys.argv[1]))
