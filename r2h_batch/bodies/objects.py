"""The objects of the benchmark, and a user's own mesh through the same build.

Every object lives in its own frame ``obj``, in metres. For the 16 built-in objects the origin is the centre of the
bounding box; a user's mesh keeps the frame of its file, so that grasps predicted in that frame stay valid.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.bodies.grasp_set import GraspSet
from r2h_batch.bodies.object_mesh import ObjectMeshError, closed_mesh
from r2h_batch.bodies.solid import sample_surface, solid_occupancy
from r2h_batch.files import FileError, printable, read_file

if TYPE_CHECKING:
    from r2h_batch.benchmark.words import Thing

__all__ = [
    "OBJECT_NAMES",
    "S0_NAMES",
    "S1_NAMES",
    "ObjectMeshError",
    "ObjectModel",
    "build_object",
    "is_built_in",
    "load_objects",
    "object_digest",
    "object_from_argument",
    "read_object",
]

MAX_REGION_BYTES = 64 << 20
"""Of a file that says which faces the receiver's region has: eight bytes for each of millions."""

S0_NAMES = ("game_controller", "bowl", "headphones", "eyeglasses", "cup", "wineglass")
S1_NAMES = (
    "hammer", "pliers", "knife", "toothbrush", "screwdriver",
    "scissors", "power_drill", "binoculars", "bottle", "trigger_sprayer",
)  # fmt: skip
OBJECT_NAMES = S0_NAMES + S1_NAMES

POINTS = 2048
VOXELS = 64
MAX_PIECES = 16
MAX_HULL_VERTICES = 256
DEFAULT_DENSITY = 600.0  # kg/m^3 for a user's mesh without a mass: between wood and plastic shells


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One rigid object in its frame ``obj``; lengths in metres, arrays read-only. V vertices, F faces, P pieces."""

    name: str
    split: str
    """``"S0"`` (free handover) or ``"S1"`` (functional: ``receiver_face`` is not empty)."""
    instruction: str
    vertices: NDArray[np.float32]
    """(V, 3)"""
    faces: NDArray[np.int32]
    """(F, 3) watertight, counter-clockwise seen from outside"""
    face_part: NDArray[np.uint8]
    """(F,) index into ``part_names``"""
    part_names: tuple[str, ...]
    receiver_face: NDArray[np.bool_]
    """(F,) the faces of the receiver's region G_O^H"""
    hull_vertices: NDArray[np.float32]
    """the convex hull; where that has more than 256 vertices, a convex body of about 256 that encloses it closely"""
    hull_faces: NDArray[np.int32]
    piece_vertices: NDArray[np.float32]
    """vertices of all convex pieces; piece k has rows ``piece_vertex_offsets[k]:piece_vertex_offsets[k + 1]``"""
    piece_faces: NDArray[np.int32]
    """triangles of all pieces, indices local to the piece"""
    piece_vertex_offsets: NDArray[np.int32]
    piece_face_offsets: NDArray[np.int32]
    points: NDArray[np.float32]
    """(2048, 3) on the surface, area-weighted"""
    normals: NDArray[np.float32]
    """(2048, 3) outward unit normals of the faces that the points lie on"""
    point_part: NDArray[np.uint8]
    point_face: NDArray[np.int32]
    voxels: NDArray[np.uint8]
    """packed bits of the (64, 64, 64) occupancy, C order; see :attr:`occupancy`"""
    voxel_origin: NDArray[np.float64]
    """(3,) the grid's lowest corner; the centre of voxel (i, j, k) is ``voxel_origin + (ijk + 0.5) * voxel_pitch``"""
    voxel_pitch: float
    mass: float
    com: NDArray[np.float64]
    inertia: NDArray[np.float64]
    """(3, 3) about the centre of mass, axes of ``obj``, uniform density, kg m^2"""
    grasps: GraspSet | None = None
    """a user's grasps: what methods choose from instead of our candidates"""
    roles: Mapping[str, str] | None = None
    """part -> function, grasp or wrap, where a benchmark says so (`methods.part_roles`)"""
    words: Thing | None = None
    """how people ask for it, where a benchmark says so (`receiver.instructions`)"""

    @property
    def occupancy(self) -> NDArray[np.bool_]:
        """(64, 64, 64) bool: a voxel is full when its centre is inside the solid or the surface passes through it."""
        return np.unpackbits(self.voxels, count=VOXELS**3).astype(bool).reshape(VOXELS, VOXELS, VOXELS)

    @property
    def pieces(self) -> list[tuple[NDArray[np.float32], NDArray[np.int32]]]:
        """(vertices, faces) of every convex piece."""
        v, f = self.piece_vertex_offsets, self.piece_face_offsets
        return [(self.piece_vertices[v[k] : v[k + 1]], self.piece_faces[f[k] : f[k + 1]]) for k in range(len(v) - 1)]

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The surface as a trimesh (a copy, float64)."""
        return trimesh.Trimesh(self.vertices.astype(np.float64), self.faces, process=False)


def load_objects(names: Sequence[str] | None = None) -> tuple[ObjectModel, ...]:
    """The built-in objects: all 16 in benchmark order (their position is ``object_index``), or those named."""
    wanted = OBJECT_NAMES if names is None else tuple(names)
    unknown = [n for n in wanted if n not in OBJECT_NAMES]
    if unknown:
        raise ValueError(f"unknown object {unknown[0]!r}; the built-in objects are {', '.join(OBJECT_NAMES)}")
    return tuple(_load(n) for n in wanted)


def is_built_in(model: ObjectModel) -> bool:
    """Whether this is the built-in object of its name, and not a user's file that is called the same."""
    if model.name not in OBJECT_NAMES:
        return False
    (own,) = load_objects([model.name])
    shape = ("vertices", "faces", "face_part", "receiver_face")
    return model is own or all(np.array_equal(getattr(model, k), getattr(own, k)) for k in shape)


def object_digest(objects: ObjectModel | Sequence[ObjectModel]) -> str:
    """sha256 (hex) over names, dtypes, shapes and bytes of every field, in order: same geometry, same digest."""
    digest = hashlib.sha256()
    for model in [objects] if isinstance(objects, ObjectModel) else objects:
        for f in fields(model):
            value = getattr(model, f.name)
            if f.name in SAID:
                digest.update(b"" if value is None else _said(value).encode())
                continue
            data = np.ascontiguousarray(value) if isinstance(value, np.ndarray) else np.array(value)
            digest.update(f"{f.name}:{data.dtype.str}:{data.shape}:".encode())
            digest.update(data.tobytes())
    return digest.hexdigest()


SAID = ("grasps", "roles", "words")
"""Fields that only a benchmark or a user fills: nothing of them is stored with an object."""


def _said(value: GraspSet | Mapping[str, str] | Thing) -> str:
    """What the digest takes of a field that somebody filled."""
    if isinstance(value, GraspSet):
        return value.digest
    return json.dumps(dict(value) if isinstance(value, Mapping) else asdict(value), sort_keys=True)


def build_object(
    mesh: str | Path | trimesh.Trimesh,
    name: str | None = None,
    split: str = "S0",
    *,
    receiver: str | Path | NDArray[np.generic] | None = None,
    scale: float = 1.0,
    mass: float | None = None,
    instruction: str | None = None,
    face_part: NDArray[np.integer] | None = None,
    part_names: Sequence[str] = ("body",),
    pieces: bool = True,
) -> ObjectModel:
    """An :class:`ObjectModel` from a file (OBJ, STL, PLY, OFF, GLB ...) or a trimesh in metres, in the file's frame.

    A mesh that is not a closed solid is repaired, and a warning says what was done; what cannot be repaired raises
    :class:`ObjectMeshError`. ``scale`` multiplies the coordinates (0.001 for millimetres). Without ``mass``
    (kg) the density is 600 kg/m^3. An S1 object needs its receiver's region: ``receiver`` is either ``"z<0.3"``
    (axis, comparison, fraction of the bounding box from its low side), or one bool per face or face indices (array,
    or ``.npy`` file) of a mesh that needs no repair; without it, S1 takes the lighter half of the longest
    axis, with a warning. ``face_part`` labels the faces of a mesh that needs no repair. ``pieces=False`` skips the convex
    decomposition (seconds to a minute): the hull is then the only piece.
    """
    _check_build(split, receiver is not None, mass)
    label = printable(name or (Path(mesh).stem if isinstance(mesh, (str, Path)) else "object"))
    closed = closed_mesh(mesh, label, scale)
    surface, changed = closed.mesh, not closed.same
    vertices = surface.vertices.astype(np.float32)
    faces = surface.faces.astype(np.int32)
    solid = trimesh.Trimesh(vertices.astype(np.float64), faces, process=False)
    parts = _part_of_faces(face_part, len(faces), label, changed)
    region = np.zeros(len(faces), bool) if split == "S0" else _receiver_region(solid, receiver, label, changed)
    hull_vertices, hull_faces = _convex_hull(solid.vertices, MAX_HULL_VERTICES)
    convex = _convex_pieces(solid, label) if pieces else [(hull_vertices, hull_faces)]
    points, point_face = sample_surface(solid, POINTS)
    occupied, origin, pitch = solid_occupancy(solid, VOXELS)
    return _frozen(
        ObjectModel(
            name=label,
            split=split,
            instruction=instruction or f"hand over the {label.replace('_', ' ')} to human",
            vertices=vertices,
            faces=faces,
            face_part=parts,
            part_names=tuple(part_names),
            receiver_face=region,
            hull_vertices=hull_vertices,
            hull_faces=hull_faces,
            **_packed(convex),
            points=points.astype(np.float32),
            normals=solid.face_normals[point_face].astype(np.float32),
            point_part=parts[point_face],
            point_face=point_face.astype(np.int32),
            voxels=np.packbits(occupied.reshape(-1)),
            voxel_origin=origin,
            voxel_pitch=pitch,
            **_inertial(solid, mass),
        )
    )


def _packed(convex: Sequence[tuple[NDArray[np.float32], NDArray[np.int32]]]) -> dict[str, Any]:
    """The convex pieces as they are stored: one after the other, and where each begins."""
    return {
        "piece_vertices": np.concatenate([v for v, _ in convex]).astype(np.float32),
        "piece_faces": np.concatenate([f for _, f in convex]).astype(np.int32),
        "piece_vertex_offsets": np.cumsum([0] + [len(v) for v, _ in convex]).astype(np.int32),
        "piece_face_offsets": np.cumsum([0] + [len(f) for _, f in convex]).astype(np.int32),
    }


def _inertial(solid: trimesh.Trimesh, mass: float | None) -> dict[str, Any]:
    """Mass, centre of mass and inertia at uniform density."""
    mass = DEFAULT_DENSITY * float(solid.volume) if mass is None else mass
    props = solid.mass_properties
    return {
        "mass": float(mass),
        "com": np.asarray(props.center_mass, np.float64),
        "inertia": np.asarray(props.inertia, np.float64) * (mass / float(solid.volume)),
    }


def _check_build(split: str, with_receiver: bool, mass: float | None) -> None:
    """Raises ValueError for arguments of `build_object` that do not go together."""
    if split not in ("S0", "S1"):
        raise ValueError(f"split is {split!r}; it must be 'S0' (free) or 'S1' (functional, with a receiver's region)")
    if split == "S0" and with_receiver:
        raise ValueError("a receiver region was given for an S0 object; use split='S1', or leave the region out")
    if mass is not None and not (np.isfinite(mass) and mass > 0):
        raise ValueError(f"mass is {mass}; it must be a positive number of kilograms")


def object_from_argument(argument: str, *, pieces: bool = True) -> ObjectModel:
    """The object of the command line's ``FILE[:S0|S1[:RECEIVER]]``, e.g. ``mug.obj``, ``saw.stl:S1:x<0.4``."""
    match = re.fullmatch(r"(?P<file>.+?)(?::(?P<split>S\d+)(?::(?P<receiver>.+))?)?", argument)
    if match is None:
        raise ObjectMeshError(f"object mesh {argument!r}: expected FILE[:S0|S1[:RECEIVER]], e.g. saw.stl:S1:x<0.4")
    return build_object(match["file"], split=match["split"] or "S0", receiver=match["receiver"], pieces=pieces)


def _load(name: str) -> ObjectModel:
    return read_object(str(resources.files("r2h_batch.assets.objects").joinpath(f"{name}.npz")))


@lru_cache(maxsize=64)
def read_object(path: str) -> ObjectModel:
    """The object stored in one ``.npz`` of assets/objects' format."""
    with np.load(path, allow_pickle=False) as data:
        values: dict[str, object] = {f.name: data[f.name] for f in fields(ObjectModel) if f.name not in SAID}
    for key in ("name", "split", "instruction"):
        values[key] = str(values[key])
    values["part_names"] = tuple(str(n) for n in np.atleast_1d(np.asarray(values["part_names"])))
    for key in ("mass", "voxel_pitch"):
        values[key] = float(np.asarray(values[key]))
    return _frozen(ObjectModel(**values))  # type: ignore[arg-type]


def _frozen(model: ObjectModel) -> ObjectModel:
    for f in fields(model):
        value = getattr(model, f.name)
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return model


def _part_of_faces(face_part: NDArray[np.integer] | None, count: int, label: str, changed: bool) -> NDArray[np.uint8]:
    """(F,) labels of the faces, all 0 where none were given."""
    if face_part is None:
        return np.zeros(count, np.uint8)
    if changed or len(face_part) != count:
        raise ObjectMeshError(
            f"{label}: {len(face_part)} part labels for a mesh that has {count} faces"
            f"{' after repair' if changed else ''}; labels need one entry per face of a mesh that needs no repair"
        )
    return np.asarray(face_part).astype(np.uint8)


def _receiver_region(
    solid: trimesh.Trimesh, receiver: str | Path | NDArray[np.generic] | None, label: str, changed: bool
) -> NDArray[np.bool_]:
    """(F,) bool: the faces of the region."""
    low, high = solid.bounds
    centers = solid.triangles_center
    if receiver is None:
        axis = int(np.argmax(high - low))
        middle = (low[axis] + high[axis]) / 2
        below = solid.center_mass[axis] > middle
        receiver = f"{'xyz'[axis]}{'<' if below else '>'}0.5"
        warnings.warn(
            f"{label}: no receiver region given for an S1 object; taking {receiver!r}, the half of the longest axis "
            "farther from the centre of mass. Give receiver='AXIS<FRACTION' (FILE:S1:AXIS<FRACTION) to choose",
            stacklevel=3,
        )
    if isinstance(receiver, str) and (match := re.fullmatch(r"\s*([xyz])\s*([<>])\s*([0-9.]+)\s*", receiver)):
        axis, fraction = "xyz".index(match[1]), float(match[3])
        position = (centers[:, axis] - low[axis]) / (high[axis] - low[axis])
        region = position < fraction if match[2] == "<" else position > fraction
    else:
        if isinstance(receiver, (str, Path)):
            if Path(receiver).suffix != ".npy" or not Path(receiver).exists():
                raise ObjectMeshError(
                    f"{label}: receiver {str(receiver)!r} is neither an existing .npy file nor 'AXIS<FRACTION' "
                    "such as 'z<0.3' (axis x, y or z; < or >; fraction of the bounding box from its low side)"
                )
            try:
                receiver = np.asarray(np.load(io.BytesIO(read_file(receiver, MAX_REGION_BYTES)), allow_pickle=False))
            except FileError as error:
                raise ObjectMeshError(f"{label}: receiver {error}") from None
            except Exception as error:  # numpy's reader parses Python text and raises whatever that meets
                raise ObjectMeshError(
                    f"{label}: receiver {receiver} is not a plain .npy array ({printable(error)[:200]})"
                ) from error
        if changed:
            raise ObjectMeshError(
                f"{label}: receiver faces refer to the file's faces, but the mesh had to be repaired; "
                "give the region as 'AXIS<FRACTION', or the labels for the repaired mesh"
            )
        chosen = np.asarray(receiver)
        region = np.zeros(len(solid.faces), bool)
        if chosen.dtype == bool and chosen.shape == region.shape:
            region |= chosen
        elif chosen.ndim == 1 and chosen.dtype.kind in "iu" and np.isin(chosen, np.arange(len(region))).all():
            region[chosen] = True
        else:
            raise ObjectMeshError(
                f"{label}: receiver array is {chosen.dtype} {chosen.shape}; expected bool ({len(region)},) or face "
                f"indices below {len(region)}"
            )
    if not region.any() or region.all():
        raise ObjectMeshError(
            f"{label}: the receiver region {'is empty' if not region.any() else 'is the whole object'}; "
            "the robot needs a part to hold and the receiver a part to take"
        )
    return region


def _convex_hull(points: NDArray[np.float64], most: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The convex hull; where it has more than ``most`` vertices, a convex body of about that many that encloses it."""
    hull = trimesh.convex.convex_hull(points)
    if len(hull.vertices) > most:
        hull = _enclosing_body(hull.vertices, most)
    hull = trimesh.convex.convex_hull(hull.vertices.astype(np.float32).astype(np.float64))
    return hull.vertices.astype(np.float32), hull.faces.astype(np.int32)


def _enclosing_body(points: NDArray[np.float64], most: int) -> trimesh.Trimesh:
    """The hull of well spread extreme points, its vertices pushed outwards until nothing is left outside."""
    step = np.arange(most // 2) + 0.5
    z, turn = 1 - 2 * step / len(step), np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - z**2)
    spread = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    kept = {int(k) for k in np.argmax(points @ np.concatenate([spread, np.eye(3), -np.eye(3)]).T, axis=0)}
    body = trimesh.convex.convex_hull(points[sorted(kept)])
    while len(kept) < most:
        outside = points @ body.face_normals.T - _offsets(body)
        worst = np.argmax(outside, axis=0)
        for f in np.argsort(-outside.max(axis=0), kind="stable")[: max(1, (most - len(kept)) // 4)]:
            kept.add(int(worst[f]))
        body = trimesh.convex.convex_hull(points[sorted(kept)])
    for _ in range(50):
        excess = (points @ body.face_normals.T - _offsets(body)).max(axis=0)
        if excess.max() <= -1e-8:
            break
        along = np.einsum("fi,fki->fk", body.face_normals, body.vertex_normals[body.faces])
        push = np.zeros(len(body.vertices))
        np.maximum.at(push, body.faces, (excess[:, None] + 5e-8).clip(0) / along.clip(0.2))
        body = trimesh.convex.convex_hull(body.vertices + push[:, None] * body.vertex_normals)
    return body


def _offsets(body: trimesh.Trimesh) -> NDArray[np.float64]:
    return np.asarray(np.einsum("ij,ij->i", body.face_normals, body.triangles[:, 0]))


def _convex_pieces(solid: trimesh.Trimesh, label: str) -> list[tuple[NDArray[np.float32], NDArray[np.int32]]]:
    """Convex pieces by CoACD (fixed seed), at most 16; the hull as a single piece where coacd is not installed."""
    try:
        import coacd
    except ImportError:
        warnings.warn(
            f"{label}: coacd is not installed, so the convex pieces are the hull alone; "
            "`pip install r2h_batch[build]` for a convex decomposition",
            stacklevel=3,
        )
        return [_convex_hull(solid.vertices, MAX_HULL_VERTICES)]
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(solid.vertices, solid.faces),
        threshold=0.04,
        max_convex_hull=MAX_PIECES,
        preprocess_mode="off",
        max_ch_vertex=64,
        mcts_iterations=40,
        mcts_nodes=10,
        mcts_max_depth=2,
        seed=0,
    )
    return [_convex_hull(np.asarray(vertices), MAX_HULL_VERTICES) for vertices, _ in found]
