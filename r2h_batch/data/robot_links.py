"""The shape of a robot's links: triangles of their meshes, shapes of the file as bodies."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import path_within, printable
from r2h_batch.data.robot_chain import Part, Rigid
from r2h_batch.data.robot_model import Geom, Model, beside, frame
from r2h_batch.data.robot_shapes import BOX, CAPSULE, CYLINDER, Shape
from r2h_batch.scene.mesh_import.file import load_robot_meshes, reads_collada

Array = NDArray[np.float64]

MAX_MESHES = 32
"""Most meshes of a link, and of all fingers."""
MAX_NAME = 1000
LONGEST_M = 3.0
"""Longest link: a mesh that is longer is in millimetres, and would be covered point by point."""


@dataclass(frozen=True)
class Link:
    """How a rigid part looks and collides, in the frame of the joint that moves it."""

    name: str
    triangles: Array  # (F, 3, 3) of what is seen, m: of meshes first
    meshed: int
    """how many of the triangles are of meshes"""
    shapes: tuple[Shape, ...]
    """what is seen besides: cylinders, spheres, boxes, capsules"""
    collides: tuple[Shape, ...]
    """what it collides as, if that is such shapes alone"""


class Meshes:
    """The mesh files that geoms of a robot's file name."""

    def __init__(self, model: Model, geoms: Iterable[Geom], packages: Mapping[str, Path]) -> None:
        """Reads them.

        Args:
            model: the robot's file: meshes lie in its folder.
            geoms: those whose meshes are asked for.
            packages: folder of each package that `package://NAME/` names.

        Raises:
            FileError: one line that says which file is missing, elsewhere or no mesh.
        """
        self.shown = model.shown
        names = dict.fromkeys(g.file for g in geoms if g.kind == "mesh" or g.fitted)
        if odd := [name for name in names if not name or len(name) > MAX_NAME]:
            raise FileError(
                f"{self.shown}: a mesh's file is called {printable(odd[0])[:40]!r}; give a name of 1 to"
                f" {MAX_NAME} characters"
            )
        files = {name: _file_of(model, name, packages) for name in names}
        collada = [name for name in names if name.lower().endswith(".dae")]
        if collada and not reads_collada():
            how = "pip install 'r2h_batch[import]', or convert it"
            raise FileError(
                f"{self.shown}: {printable(collada[0])[:120]}: COLLADA needs an extra; {how}"
            )
        try:
            meshes = load_robot_meshes(list(files.values()), "the robot's meshes")
        except ValueError as error:
            raise FileError(f"{self.shown}: {error}") from None
        self._loaded = dict(zip(files, meshes, strict=True))

    def fitted(self, geom: Geom) -> Geom:
        """A shape whose size the file leaves to its mesh, as MuJoCo fits it; others as they are.

        Raises:
            FileError: MuJoCo fits nothing to this mesh.
        """
        if not geom.fitted:
            return geom
        mesh, spec = self._loaded[geom.file], mujoco.MjSpec()
        corners = np.asarray(mesh.vertices, np.float64) * geom.size
        spec.compiler.fitaabb = geom.fitted == "aabb"
        spec.add_mesh(
            name="fitted", uservert=corners.ravel(), userface=np.asarray(mesh.faces).ravel()
        )
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{geom.kind.upper()}")
        spec.worldbody.add_geom(type=kind, meshname="fitted")
        try:
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            why = printable(" ".join(str(error).split()))[:120]
            raise FileError(f"{self.shown}: a {geom.kind} fitted to {geom.file}: {why}") from None
        T = geom.T @ frame(model.geom_pos[0], model.geom_quat[0])
        return Geom(geom.kind, np.array(model.geom_size[0]), T, geom.seen)

    def triangles(self, geom: Geom) -> Array:
        """(F, 3, 3) of a mesh in its link's frame."""
        mesh, T = self._loaded[geom.file], geom.T
        corners = np.asarray(mesh.vertices, np.float64) * geom.size
        return np.asarray((corners @ T[:3, :3].T + T[:3, 3])[mesh.faces])


def seen_of(part: Rigid) -> list[Geom]:
    """Visual geoms of a part; its collision geoms where the file shows nothing else that can be read."""
    seen, solid = [g for g in part.geoms if g.seen], [g for g in part.geoms if not g.seen]
    if solid and not reads_collada() and any(g.file.lower().endswith(".dae") for g in seen):
        return solid
    return seen or solid


def files_of(part: Rigid) -> list[Geom]:
    """The geoms of a part whose meshes are asked for."""
    return [*seen_of(part), *(g for g in part.geoms if g.fitted)]


def check_meshes(parts: Sequence[Rigid], fingers: Sequence[Part], shown: str) -> None:
    """Refuses parts that nothing shows, or more meshes than are read.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    for part in parts:
        where, seen = f"{shown}: link {printable(part.name)}", seen_of(part)
        if not seen:
            raise FileError(f"{where} has no visual mesh or shape")
        if sum(g.kind == "mesh" for g in seen) > MAX_MESHES:
            raise FileError(f"{where} has more than {MAX_MESHES} visual meshes; join them into one")
    if (many := sum(len(part.shown) for part in fingers)) > MAX_MESHES:
        what = f"the gripper's fingers have {many} visual meshes; {MAX_MESHES} are allowed"
        raise FileError(f"{shown}: {what}")


def link_of(part: Rigid, meshes: Meshes) -> Link:
    """The shape of a part.

    Raises:
        FileError: it is in millimetres, or has shapes that are not read.
    """
    where, seen = f"{meshes.shown}: link {printable(part.name)}", seen_of(part)
    triangles = [meshes.triangles(g) for g in seen if g.kind == "mesh"]
    meshed = sum(map(len, triangles))
    shapes = _shapes([meshes.fitted(g) for g in seen if g.kind != "mesh"], where)
    triangles += [shape.triangles() for shape in shapes]
    if not sum(map(len, triangles)):
        raise FileError(f"{where} has no visual mesh or shape")
    faces = np.concatenate(triangles)
    size = float(np.ptp(faces.reshape(-1, 3), axis=0).max())
    if not 1e-3 <= size <= LONGEST_M:
        how = f"1 mm to {LONGEST_M:g} m are allowed; correct the scale of its meshes"
        raise FileError(f"{where} is {size:g} m long; {how}")
    solid = [meshes.fitted(g) for g in part.geoms if not g.seen]
    plain = len(solid) < len(part.geoms) and not any(g.kind == "mesh" for g in solid)
    return Link(part.name, faces, meshed, shapes, _shapes(solid, where) if plain else ())


def _shapes(geoms: list[Geom], where: str) -> tuple[Shape, ...]:
    """Shapes as bodies: a cylinder between two spheres of its radius is a capsule, another sphere a capsule
    0.2 mm longer than it."""
    found: list[Shape] = []
    balls: list[Shape] = []
    capped: set[int] = set()
    for geom in geoms:
        kind = geom.kind
        if kind not in (BOX, CYLINDER, CAPSULE, "sphere"):
            allowed = "a mesh, box, cylinder, sphere or capsule is"
            raise FileError(f"{where}: a <{printable(kind)[:40]}> is not read; {allowed}")
        size = {BOX: geom.size, "sphere": np.append(geom.size[:1], 1e-4)}.get(kind, geom.size[:2])
        if not 1e-4 <= size.min() <= size.max() <= LONGEST_M:
            raise FileError(
                f"{where}: a {kind} of {size} m; radii and half sides of 0.1 mm to {LONGEST_M:g} m are allowed"
            )
        shape = Shape(CAPSULE if kind == "sphere" else kind, geom.T[:3, 3], geom.T[:3, :3], size)
        (balls if kind == "sphere" else found).append(shape)
    for i, shape in enumerate(found):
        ends = [shape.pos + s * shape.size[1] * shape.R[:, 2] for s in (1, -1)]
        caps = [
            {
                k
                for k, b in enumerate(balls)
                if np.abs([*b.pos - end, b.size[0] - shape.size[0]]).max() < 1e-5
            }
            for end in ends
        ]
        if shape.kind == CYLINDER and all(caps):
            found[i] = Shape(CAPSULE, shape.pos, shape.R, shape.size)
            capped |= caps[0] | caps[1]
    return (*found, *(b for k, b in enumerate(balls) if k not in capped))


def _file_of(model: Model, name: str, packages: Mapping[str, Path]) -> Path:
    name, given_name = unquote(name) if "://" in name else name, name
    if name.startswith("file://") and not name.startswith("file:///"):
        inside = name.removeprefix("file://").removeprefix("localhost")
        if not inside.startswith("/"):  # of the file's own folder, as nobody's host has such a name
            return beside(model.path, inside, model.folders)
        name = f"file://{inside}"
    if name.startswith("file://"):  # as xacro writes $(find NAME)
        path = Path("/", name.removeprefix("file://").lstrip("/")).resolve()
        for within in (model.path.resolve().parent, *(p.resolve() for p in packages.values())):
            if path.is_relative_to(within):
                return path_within(within, str(path.relative_to(within)))
        how = "give the folder above it with --package NAME=FOLDER"
        raise FileError(f"{model.shown}: {printable(name)[:120]} is outside its folder; {how}")
    scheme = next((s for s in ("package://", "model://") if name.startswith(s)), "")  # ROS, Gazebo
    if not scheme:
        at = beside(model.path, name, model.folders)
        # "%20" may be a blank that a program wrote so, or stand in the file's name
        return (
            at
            if at.exists() or "%" not in name
            else beside(model.path, unquote(name), model.folders)
        )
    package, _, inside = name.removeprefix(scheme).partition("/")
    given = (*packages.values(), *model.folders)
    folder = packages.get(package) or _package_around(model.path, package, given)
    if folder is None and (folder := _folder_with(model.path, package, inside, given)) is not None:
        what = f"{model.shown}: {scheme}{printable(package)[:60]} is the folder {folder.name}"
        warnings.warn(f"{what}, which holds what it names", stacklevel=2)
    if folder is None:
        how = f"give --package {printable(package)}=FOLDER"
        raise FileError(f"{model.shown}: {printable(given_name)[:120]}: {how}")
    return path_within(folder, inside)


def _folder_with(path: Path, package: str, inside: str, within: Iterable[Path]) -> Path | None:
    """The nearest folder above the file, within one of `within`, that holds a file of this name: who packs a ROS package may
    give its folder another name."""
    parts = PurePosixPath(inside.replace("\\", "/")).parts
    if package in ("", ".", "..") or not parts or ".." in parts:
        return None
    whole = [folder.resolve() for folder in within]
    above = [f for f in path.resolve().parents if any(f.is_relative_to(w) for w in whole)]
    return next((folder for folder in above if (folder / inside).is_file()), None)


def _package_around(path: Path, package: str, within: Iterable[Path]) -> Path | None:
    """The folder of this name in which the file lies, as ROS has a package; or that lies beside the file, or beside a folder
    that holds the file below one of `within`."""
    if package in ("", ".", ".."):
        return None
    above = path.resolve().parents
    if found := next((folder for folder in above if folder.name == package), None):
        return found
    whole = [folder.resolve() for folder in within]
    known = [f for f in above if f == above[0] or any(f.is_relative_to(w) for w in whole)]
    return next((f / package for f in known if (f / package).is_dir()), None)
