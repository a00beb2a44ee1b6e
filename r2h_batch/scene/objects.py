"""The objects of the benchmark, and a user's own mesh through the same build.

Every object lives in its own frame ``obj``, in metres. For the 16 built-in objects the origin is
the centre of the bounding box; a user's mesh keeps the frame of its file, so that grasps predicted
in that frame stay valid.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from r2h_batch.base.errors import nearest
from r2h_batch.base.io.cache import is_cached
from r2h_batch.base.io.read import printable
from r2h_batch.base.validate import describe_value
from r2h_batch.scene import mesh_import
from r2h_batch.scene.arrays import stored_arrays
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.mesh_import.cache import kept_with_warnings, key_of
from r2h_batch.scene.mesh_import.limits import ObjectMeshError
from r2h_batch.scene.solid import sample_surface, solid_occupancy
from r2h_batch.scene.vocabulary import S0_ROLES, SHARP, THINGS, VESSELS, Thing

if TYPE_CHECKING:  # trimesh takes 0.3 s, and stored objects are read without it
    import trimesh

    from r2h_batch.scene.mesh_import import Repair

S0_NAMES = ("game_controller", "bowl", "headphones", "eyeglasses", "cup", "wineglass")
S1_NAMES = (
    "hammer", "pliers", "knife", "toothbrush", "screwdriver",
    "scissors", "power_drill", "binoculars", "bottle", "trigger_sprayer",
)  # fmt: skip
OBJECT_NAMES = S0_NAMES + S1_NAMES
"""The 16 objects of r2h-v0 and r2h-v1, in their order."""
MORE_NAMES = ("can", "dispenser")
"""Objects that only r2h-release has."""
BUILT_IN_NAMES = OBJECT_NAMES + MORE_NAMES
SHIPPED_INSTANCES = 6
"""Instances of each family that are shipped."""
INSTANCE_NAMES = tuple(f"{name}_{i:02d}" for name in OBJECT_NAMES for i in range(SHIPPED_INSTANCES))
"""The 96 objects of r2h-v2: category first, instance second (`families`)."""

POINTS = 2048
VOXELS = 64
DEFAULT_DENSITY = 600.0  # kg/m^3 for a user's mesh without a mass: between wood and plastic shells


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One rigid object in its frame ``obj``; lengths in metres, arrays read-only. V vertices, F
    faces, P pieces."""

    name: str
    """what trials and tables call it"""
    split: str
    """``"S0"`` (free handover) or ``"S1"`` (functional: ``receiver_face`` is not empty)."""
    instruction: str
    """what the robot is told"""
    vertices: NDArray[np.float32]
    """(V, 3) corners of the closed mesh, m"""
    faces: NDArray[np.int32]
    """(F, 3) watertight, counter-clockwise seen from outside"""
    face_part: NDArray[np.uint8]
    """(F,) index into ``part_names``"""
    part_names: tuple[str, ...]
    """names of its parts"""
    receiver_face: NDArray[np.bool_]
    """(F,) which faces are the receiver's region G_O^H; none in S0"""
    hull_vertices: NDArray[np.float32]
    """the convex hull of ``vertices``, all of its vertices"""
    hull_faces: NDArray[np.int32]
    """triangles of the hull"""
    piece_vertices: NDArray[np.float32]
    """vertices of all convex pieces; piece k has rows
    ``piece_vertex_offsets[k]:piece_vertex_offsets[k + 1]``"""
    piece_faces: NDArray[np.int32]
    """triangles of all pieces, indices local to the piece"""
    piece_vertex_offsets: NDArray[np.int32]
    """(P + 1,) first vertex of each piece"""
    piece_face_offsets: NDArray[np.int32]
    """(P + 1,) first triangle of each piece"""
    points: NDArray[np.float32]
    """(2048, 3) points on the surface, area-weighted, m"""
    normals: NDArray[np.float32]
    """(2048, 3) outward unit normals of the faces that the points lie on"""
    point_part: NDArray[np.uint8]
    """(2048,) the part that each point lies on"""
    point_face: NDArray[np.int32]
    """(2048,) the face that each point lies on"""
    voxels: NDArray[np.uint8]
    """packed bits of the (64, 64, 64) occupancy, C order; see :attr:`occupancy`"""
    voxel_origin: NDArray[np.float64]
    """(3,) the grid's lowest corner; the centre of voxel (i, j, k) is ``voxel_origin + (ijk + 0.5)
    * voxel_pitch``"""
    voxel_pitch: float
    """side of a voxel, m"""
    mass: float
    """kg"""
    com: NDArray[np.float64]
    """(3,) centre of mass, m"""
    inertia: NDArray[np.float64]
    """(3, 3) about the centre of mass, axes of ``obj``, uniform density, kg m^2"""
    grasps: GraspSet | None = None
    """a user's grasps: what methods choose from instead of our candidates"""
    roles: Mapping[str, str] | None = None
    """part -> function, grasp or wrap, where a benchmark says so (`r2h_batch.methods.part_roles`)"""
    words: Thing | None = None
    """how people ask for it, where a benchmark says so (`r2h_batch.trials.holding.instructions`)"""
    repair: Repair | None = None
    """what was done to a user's mesh, and what came of it"""

    def __repr__(self) -> str:  # one line: a dataclass would print its arrays
        parts = ", ".join(self.part_names)
        size = f"{len(self.vertices):,} vertices, {len(self.faces):,} faces"
        return f"ObjectModel({self.name}, {self.split}: {size}, {1000 * self.mass:.0f} g, parts {parts})"

    receiver_boxes: NDArray[np.float64] | None = None
    """(N, 5, 3) the receiver's region as volumes, where a user gave boxes: centre, half sides, the
    rows of R_obj_box. Affordance asks them instead of ``receiver_face``, the faces in them"""

    category: str | None = None
    """the family that it was made by; `who` has it of any object"""

    turn: Turn | None = None
    """which object was turned to make this one (`turned`): its grasps are that one's, turned"""

    sharp: tuple[str, ...] = ()
    """parts that a hand should not come to first: blades, tips, bits (`judge.presented`)"""

    up: NDArray[np.float64] | None = None
    """(3,) unit vector from a vessel's bottom to its opening; None: it is no open vessel"""

    @cached_property
    def who(self) -> Who:
        """Who it is, whatever it is called and however it lies: what is shipped of it, its family, and its own frame."""
        by_words = (name for name, thing in THINGS.items() if self.words == thing)
        return Who(self, _stored_name(self), self.category or next(by_words, None), self.turn)

    @property
    def sharp_face(self) -> NDArray[np.bool_]:
        """(F,) the faces of the sharp parts."""
        return np.isin(self.face_part, [self.part_names.index(name) for name in self.sharp])

    @property
    def occupancy(self) -> NDArray[np.bool_]:
        """(64, 64, 64) bool: a voxel is full when its centre is inside the solid or the surface
        passes through it."""
        return np.unpackbits(self.voxels, count=VOXELS**3).astype(bool).reshape((VOXELS,) * 3)

    @property
    def pieces(self) -> list[tuple[NDArray[np.float32], NDArray[np.int32]]]:
        """(vertices, faces) of every convex piece."""
        v, f = self.piece_vertex_offsets, self.piece_face_offsets
        return [
            (self.piece_vertices[v[k] : v[k + 1]], self.piece_faces[f[k] : f[k + 1]])
            for k in range(len(v) - 1)
        ]

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The surface as a trimesh (a copy, float64)."""
        import trimesh

        return trimesh.Trimesh(self.vertices.astype(np.float64), self.faces, process=False)


@dataclass(frozen=True, eq=False)
class Who:
    """Who an object is.

    Attributes:
        model: the object.
        key: the name by which its grasps and receiving hands are shipped; None: it is no built-in one. An object of S1 in
            split S0 has others: `NAME_S0`.
        category: the family that it is an instance of; None for an object of no family.
        turn: how it came from another object; None: it lies in its own frame.
    """

    model: ObjectModel
    key: str | None
    category: str | None
    turn: Turn | None

    @property
    def own(self) -> ObjectModel:
        """The object in its own frame."""
        return self.model if self.turn is None else self.turn.own

    @property
    def has_frozen_frame(self) -> bool:
        """Whether it is, turned or not, one of r2h-v1 and r2h-release: how their meshes lie belongs to these protocols, and
        methods may use it. The frame of any other object says nothing about it."""
        return self.own.name in BUILT_IN_NAMES and self.own.who.key is not None


@dataclass(frozen=True, eq=False)
class Turn:
    """How an object came from another one."""

    own: ObjectModel
    R_new_own: NDArray[np.float64]
    """(3, 3)"""

    def poses(self, T: NDArray[np.float32]) -> NDArray[np.float32]:
        """Poses (N, 4, 4) in the own object's frame, in the turned one's."""
        found = T.astype(np.float64)
        found[:, :3] = self.R_new_own @ found[:, :3]
        return found.astype(np.float32)


def load_objects(names: Sequence[str] | None = None) -> tuple[ObjectModel, ...]:
    """The 16 objects of r2h-v0 and r2h-v1 in their order (the position is ``object_index``), or
    those of `BUILT_IN_NAMES` and `INSTANCE_NAMES` that are named."""
    wanted = OBJECT_NAMES if names is None else tuple(names)
    unknown = [n for n in wanted if n not in BUILT_IN_NAMES and n not in INSTANCE_NAMES]
    if unknown:
        allowed = f"the built-in objects are {', '.join(BUILT_IN_NAMES)}, and {INSTANCE_NAMES[0]} to {INSTANCE_NAMES[-1]}"
        if hint := nearest(unknown[0], (*BUILT_IN_NAMES, *INSTANCE_NAMES)):
            allowed = "r2h-batch ls objects lists them"
        raise ValueError(f"unknown object {unknown[0]!r}{hint}; {allowed} (r2h-batch ls families)")
    return tuple(_stored_object(n) for n in wanted)


@lru_cache(maxsize=len(INSTANCE_NAMES) + len(BUILT_IN_NAMES))
def _stored_object(name: str) -> ObjectModel:
    """A stored object; an instance of a family has its category's words and roles."""
    if name in BUILT_IN_NAMES:
        model = read_object(str(resources.files("r2h_batch.assets.objects") / f"{name}.npz"))
        return replace(model, sharp=SHARP.get(name, ()), up=up_of(model, VESSELS.get(name)))
    model = read_object(str(resources.files("r2h_batch.assets.families") / f"{name}.npz"))
    return with_words(model, name.rpartition("_")[0])


def with_words(model: ObjectModel, category: str) -> ObjectModel:
    """The object with the words and roles of a built-in one, as an instance of its family."""
    return replace(
        model, words=THINGS[category], roles=S0_ROLES.get(category), category=category, sharp=SHARP.get(category, ()),
        up=up_of(model, VESSELS.get(category)),
    )  # fmt: skip


def up_of(model: ObjectModel, parts: tuple[str, str] | None) -> NDArray[np.float64] | None:
    """The direction (3,) from the middle of one part's surface to that of another, as `ObjectModel.up`; None for None.

    Args:
        model: any object.
        parts: a vessel's lowest part and the one around its opening.
    """
    if parts is None:
        return None
    triangles = model.vertices.astype(np.float64)[model.faces]
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    of = [model.face_part == model.part_names.index(name) for name in parts]
    low, high = (np.average(triangles[f].mean(1), axis=0, weights=area[f]) for f in of)
    up: NDArray[np.float64] = (high - low) / np.linalg.norm(high - low)
    up.flags.writeable = False
    return up


def stored_arrays_of(file: str, built_in: str) -> dict[str, NDArray[Any]]:
    """OBJECT/FIELD -> array of a stored file: that of the built-in objects in assets/`built_in`, and the families'."""
    return {**stored_arrays(built_in, file), **stored_arrays("families", file)}


def checked_objects(objects: Sequence[ObjectModel] | None) -> tuple[ObjectModel, ...]:
    """The given objects, the built-in ones for None; no two of one name: rows name their object,
    and statistics go by it."""
    if objects is None:
        return load_objects()
    if isinstance(objects, (str, ObjectModel)) or not isinstance(objects, Iterable):
        what = repr(objects.name) if isinstance(objects, ObjectModel) else describe_value(objects)
        raise TypeError(f"objects is {what}; need ObjectModels, such as load_objects(['cup'])")
    found = tuple(objects)
    for i, o in enumerate(found):
        if not isinstance(o, ObjectModel):
            raise TypeError(
                f"objects[{i}] is {describe_value(o)}; it must be an ObjectModel, such as load_objects(['cup'])[0]"
            )
    names = [o.name for o in found]
    if twice := [n for n in names if names.count(n) > 1]:
        raise ValueError(f"two objects are called {twice[0]!r}; give each its own name")
    return found


def without_region(model: ObjectModel) -> ObjectModel:
    """The object in split S0: nothing of it is the receiver's, and its instruction names it whole."""
    if model.split == "S0":
        return model
    region = np.zeros_like(model.receiver_face)
    region.flags.writeable = False
    words = f"hand over the {model.name.replace('_', ' ')} to human"
    return replace(model, split="S0", receiver_face=region, receiver_boxes=None, instruction=words)


def turned(model: ObjectModel, R: NDArray[np.float64]) -> ObjectModel:
    """The same object with another frame: all that is known of it, turned; the voxels made anew.

    A trial of it has the same answer as one of `model` if a method does not depend on how a mesh lies.

    Args:
        model: any object.
        R: (3, 3) R_new_old.
    """

    def spun(values: NDArray[Any]) -> NDArray[Any]:
        return (values.astype(np.float64) @ R.T).astype(values.dtype)

    mesh = model.mesh
    mesh.vertices = mesh.vertices @ R.T
    occupied, origin, pitch = solid_occupancy(mesh, VOXELS)
    boxes = model.receiver_boxes
    if boxes is not None:
        boxes = np.concatenate([boxes[:, :1] @ R.T, boxes[:, 1:2], R @ boxes[:, 2:]], 1)
    grasps = None if model.grasps is None else model.grasps.turned(R)
    return _frozen(
        replace(
            model, vertices=spun(model.vertices), hull_vertices=spun(model.hull_vertices),
            piece_vertices=spun(model.piece_vertices), points=spun(model.points), normals=spun(model.normals),
            com=spun(model.com), inertia=R @ model.inertia @ R.T,
            voxels=np.packbits(occupied.reshape(-1)), voxel_origin=origin, voxel_pitch=pitch, receiver_boxes=boxes,
            grasps=grasps, turn=Turn(model, R), up=None if model.up is None else R @ model.up,
        )
    )  # fmt: skip


def stored_objects() -> dict[str, ObjectModel]:
    """`Who.key` -> object: everything that grasps and receiving hands are shipped of."""
    (bottle,) = load_objects(["bottle"])
    free = {"bottle_S0": without_region(bottle)}  # r2h-release hands it over freely
    return {o.name: o for o in load_objects(BUILT_IN_NAMES)} | free


def _stored_name(model: ObjectModel) -> str | None:
    """The name by which grasps and receiving hands of an object are stored: its shape decides, for a user's file may be called
    the same."""
    if model.name not in BUILT_IN_NAMES and model.name not in INSTANCE_NAMES:
        return None
    (own,) = load_objects([model.name])
    shape = ("vertices", "faces", "face_part", "receiver_face")

    def is_shape_of(stored: ObjectModel) -> bool:
        return all(np.array_equal(getattr(model, k), getattr(stored, k)) for k in shape)

    if model is own or is_shape_of(own):
        return model.name
    if model.name in BUILT_IN_NAMES and is_shape_of(without_region(own)):
        return f"{model.name}_S0"
    return None


def object_digest(objects: ObjectModel | Sequence[ObjectModel]) -> str:
    """sha256 (hex) over names, dtypes, shapes and bytes of every field, in order: same geometry,
    same digest. What is sharp and where a vessel opens is not part of it: only a benchmark that asks for Presented, whose
    digest has it, judges by it."""
    digest = hashlib.sha256()
    for model in [objects] if isinstance(objects, ObjectModel) else objects:
        for f in fields(model):
            value = getattr(model, f.name)
            if f.name in (
                "repair",
                "category",
                "sharp",
                "up",
            ):  # the geometry and the words say the first two
                continue
            if f.name in SAID:
                digest.update(b"" if value is None else _said(value).encode())
                continue
            data = np.ascontiguousarray(value) if isinstance(value, np.ndarray) else np.array(value)
            digest.update(f"{f.name}:{data.dtype.str}:{data.shape}:".encode())
            digest.update(data.tobytes())
    return digest.hexdigest()


SAID = ("grasps", "roles", "words", "repair", "receiver_boxes", "category", "turn", "sharp", "up")
"""Fields that only a benchmark or a user fills: nothing of them is stored with an object."""


def _said(value: GraspSet | Turn | Mapping[str, str] | Thing | NDArray[np.float64]) -> str:
    """Arrays of a filled field that enter the digest."""
    if isinstance(value, GraspSet):
        return value.digest
    if isinstance(value, Turn):
        return object_digest(value.own)
    if isinstance(value, np.ndarray):
        return json.dumps(value.tolist())
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
    pieces: bool | Literal["fine"] = True,
) -> ObjectModel:
    """An :class:`ObjectModel` from a file (OBJ, STL, PLY, OFF, GLB ...) or a trimesh in metres, in
    the file's frame.

    A mesh that is not a closed solid is repaired, and a warning says what was done; what cannot be
    repaired raises :class:`ObjectMeshError`. ``scale`` multiplies the coordinates (0.001 for
    millimetres). Without ``mass`` (kg) the density is 600 kg/m^3. ``face_part`` (one index into
    ``part_names`` for each face of the file) labels the faces; without it the named groups of an
    OBJ or GLB do. An S1 object needs its receiver's region: ``receiver`` is the name of a part
    (``"handle"``, ``"handle,guard"``), ``"z<0.3"`` (axis, comparison, fraction of the bounding box
    from its low side), or one bool per face of the file, indices of its faces, or boxes
    (`ObjectModel.receiver_boxes`), as array or ``.npy`` file. Nothing is
    guessed: half of an object is the wrong end too often. Labels and faces are carried over to a
    repaired mesh. ``pieces=False`` skips the convex decomposition (half a second): the hull is then
    the only piece. ``"fine"`` is CoACD's, as of the built-in objects: a minute and more.

    What is built of a file is kept on disk (`files.kept`), named by the file's content, the options
    and the code.
    """
    _check_build(split, receiver is not None, mass)
    options = _options(
        mesh, name=name, split=split, receiver=receiver, scale=scale, mass=mass, instruction=instruction,
        face_part=face_part, part_names=part_names, pieces=pieces,
    )  # fmt: skip
    model = _kept_or_built(mesh, options)
    boxes = mesh_import.region_boxes(receiver, model.part_names, model.name)
    return model if boxes is None else _frozen(replace(model, receiver_boxes=boxes))


def _kept_or_built(mesh: str | Path | trimesh.Trimesh, options: Mapping[str, Any]) -> ObjectModel:
    """The object of all options of a build, from disk where its mesh is one file."""
    key = key_of(mesh, options)
    build = partial(_built, mesh, **options)
    # OpenBLAS' idle threads spin: a fifth of a build's CPU time
    with threadpool_limits(1, user_api="blas"):
        return build() if key is None else kept_object(key, build)


def _options(mesh: str | Path | trimesh.Trimesh, **given: Any) -> dict[str, Any]:
    """All options of a build, the defaults of `build_object` for those that are not given."""
    defaults = {
        k: p.default for k, p in inspect.signature(build_object).parameters.items() if k != "mesh"
    }
    options = {**defaults, **given}
    label = options["name"] or (Path(mesh).stem if isinstance(mesh, (str, Path)) else "object")
    labels = options["face_part"]
    return {
        **options, "name": printable(label), "part_names": tuple(options["part_names"]),
        "face_part": None if labels is None else np.asarray(labels),
    }  # fmt: skip


def is_built(mesh: str | Path | trimesh.Trimesh, **given: Any) -> bool:
    """Whether what `build_object` would build of these arguments is kept on disk."""
    key = key_of(mesh, _options(mesh, **given))
    return key is not None and is_cached("objects", key)


def _built(
    mesh: str | Path | trimesh.Trimesh,
    *,
    name: str,
    split: str,
    receiver: str | Path | NDArray[np.generic] | None,
    scale: float,
    mass: float | None,
    instruction: str | None,
    face_part: NDArray[np.integer] | None,
    part_names: Sequence[str],
    pieces: bool | Literal["fine"],
) -> ObjectModel:
    """`build_object` without the disk."""
    import trimesh

    closed = mesh_import.closed_mesh(mesh, name, scale)
    if face_part is None and (groups := mesh_import.labels_of(closed.source)) is not None:
        face_part, part_names = groups
    surface = closed.mesh
    vertices, faces = surface.vertices.astype(np.float32), surface.faces.astype(np.int32)
    solid = trimesh.Trimesh(vertices.astype(np.float64), faces, process=False)
    parts = mesh_import.part_of_faces(face_part, part_names, closed, name)
    region = np.zeros(len(faces), bool)
    if split == "S1":
        region = mesh_import.receiver_region(solid, receiver, closed, parts, part_names, name)
    hull = mesh_import.convex_hull(solid.vertices)
    points, point_face = sample_surface(solid, POINTS)
    occupied, origin, pitch = solid_occupancy(solid, VOXELS)
    return _frozen(
        ObjectModel(
            name=name,
            split=split,
            instruction=instruction or f"hand over the {name.replace('_', ' ')} to human",
            vertices=vertices,
            faces=faces,
            face_part=parts,
            part_names=tuple(part_names),
            receiver_face=region,
            hull_vertices=hull[0],
            hull_faces=hull[1],
            **_packed(
                mesh_import.convex_pieces(solid, name, fine=pieces == "fine") if pieces else [hull]
            ),
            points=points.astype(np.float32),
            normals=solid.face_normals[point_face].astype(np.float32),
            point_part=parts[point_face],
            point_face=point_face.astype(np.int32),
            voxels=np.packbits(occupied.reshape(-1)),
            voxel_origin=origin,
            voxel_pitch=pitch,
            **_inertial(solid, mass),
            repair=closed.repair if closed.repair.steps else None,
        )
    )


def kept_object(key: str, make: Callable[[], ObjectModel]) -> ObjectModel:
    """The object of a key: read from disk, else made and kept there. What only a benchmark or a user fills (`SAID`) is not
    kept.

    Args:
        key: hex; it must cover everything that the object depends on, with the code.
        make: makes the object.
    """
    return _from_arrays(kept_with_warnings(key, lambda: _as_arrays(make()), _from_arrays))


def _as_arrays(model: ObjectModel) -> dict[str, Any]:
    """Stored arrays of a built object."""
    arrays = {
        f.name: np.asarray(getattr(model, f.name)) for f in fields(model) if f.name not in SAID
    }
    repair = np.array(json.dumps(asdict(model.repair) if model.repair else None))
    return {**arrays, "repair": repair}


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
        raise ValueError(
            f"split is {split!r}; it must be 'S0' (free) or 'S1' (functional, with a receiver's region)"
        )
    if split == "S0" and with_receiver:
        raise ValueError(
            "an S0 object has no receiver region; use split='S1', or leave the region out"
        )
    if mass is not None and not (np.isfinite(mass) and mass > 0):
        raise ValueError(f"mass is {mass}; it must be a positive number of kilograms")


def object_from_argument(argument: str, *, pieces: bool = True) -> ObjectModel:
    """The object of the command line's ``FILE[:S0|S1[:RECEIVER]]``, e.g. ``mug.obj``,
    ``saw.stl:S1:x<0.4``."""
    return build_object(**call_of(argument, pieces=pieces))


def call_of(argument: str, *, pieces: bool = True) -> dict[str, Any]:
    """The arguments of `build_object` that such a text means."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", argument):
        raise ObjectMeshError(
            f"object mesh {printable(argument)[:200]!r}: is an address; save the file and give its path"
        )
    shown = printable(argument)[:200]
    if any(c in argument for c in "\r\n\0"):
        raise ObjectMeshError(f"object mesh {shown!r}: has a line end in its name; rename the file")
    match = re.fullmatch(r"(?P<file>.+?)(?::(?P<split>S\d+)(?::(?P<receiver>.+))?)?", argument)
    endings = "|".join(e[1:] for e in mesh_import.SUFFIXES)
    said = re.fullmatch(rf"(.+?\.(?:{endings})):(.*)", argument, re.IGNORECASE)
    if match is None or (said and match["file"] == argument and not os.path.lexists(argument)):
        found = (
            f" what stands behind {printable(said[1])[:200]} is {printable(said[2])[:40]!r};"
            if said
            else ""
        )
        raise ObjectMeshError(
            f"object mesh {shown!r}:{found} expected FILE, FILE:S0, FILE:S1 or FILE:S1:RECEIVER, e.g. saw.stl:S1:x<0.4"
        )
    return {
        "mesh": match["file"],
        "split": match["split"] or "S0",
        "receiver": match["receiver"],
        "pieces": pieces,
    }


def check_call(call: Mapping[str, Any]) -> None:
    """Raises what `build_object` raises for such arguments where words and names are enough to tell."""
    label = printable(Path(call["mesh"]).stem)
    _check_build(call["split"], call["receiver"] is not None, None)
    mesh_import.check_name(Path(call["mesh"]), label)
    if call["split"] == "S1" and call["receiver"] is None:
        raise mesh_import.no_region(label)


@lru_cache(maxsize=128)
def read_object(path: str) -> ObjectModel:
    """The object stored in one ``.npz`` of assets/objects' format."""
    with np.load(path, allow_pickle=False) as data:
        names = (f.name for f in fields(ObjectModel) if f.name not in SAID)
        return _from_arrays({name: data[name] for name in names})


def _from_arrays(arrays: Mapping[str, NDArray[Any]]) -> ObjectModel:
    values: dict[str, Any] = dict(arrays)
    for key in ("name", "split", "instruction"):
        values[key] = str(values[key])
    values["part_names"] = tuple(str(n) for n in np.atleast_1d(np.asarray(values["part_names"])))
    for key in ("mass", "voxel_pitch"):
        values[key] = float(np.asarray(values[key]))
    repair = json.loads(str(values.pop("repair", "null")))
    values["repair"] = (
        mesh_import.Repair(**{**repair, "steps": tuple(repair["steps"])}) if repair else None
    )
    return _frozen(ObjectModel(**values))


def _frozen(model: ObjectModel) -> ObjectModel:
    for f in fields(model):
        value = getattr(model, f.name)
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return model
