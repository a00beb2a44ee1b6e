"""Draws instances of families: a number in, an object out, the same on every machine of one kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.scene.families.answer import check_surface, shape_of
from r2h_batch.scene.families.family import (
    FAMILIES,
    TURNS,
    WATER,
    Draw,
    Family,
    FamilyError,
    Shape,
)
from r2h_batch.scene.families.remesh import Surface, heights, imprint, without_slivers
from r2h_batch.scene.families.shapes import Parts
from r2h_batch.scene.objects import ObjectModel, build_object, up_of

SHIPPED, TRAINING = 0, 1
"""Series of the test instances in assets/families, and of those that predictors learn from."""

SMOOTH_MM, EDGE_MM, SNAP_MM = 0.05, 18.0, 0.4
"""Triangles are merged where the surface moves by less than the first, and divided until no edge is longer than
the second. Corners nearer to a cut than the third lie on it."""

SLIVER_M, CLEARED_MM, NEEDLE_MM = 1e-8, 1e-4, 0.01
"""A triangle lower than the first, as it is stored, is a sliver (trimesh's `nondegenerate_faces`). An instance that has one
gets rid of the triangles lower than the second; sides shorter than the third are collapsed. In about one of 50 instances
one or two stay, which cannot be removed without a fold; none of the shipped ones has any."""
HALVINGS = 40
"""A water level is searched in so many halves: to its last bits."""

Vec = NDArray[np.float64]


@dataclass(frozen=True)
class Instance:
    """A drawn instance, before what an `ObjectModel` derives from it."""

    name: str
    family: Family
    vertices: NDArray[np.float64]
    """(V, 3), m, in the frame it rests in: z up, any yaw, the origin in the middle of its box"""
    faces: NDArray[np.int32]
    face_part: NDArray[np.uint8]
    mass: float
    com: Vec
    inertia: Vec
    rest: str
    parameters: dict[str, float | str]

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The surface as a trimesh."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def draw_instance(
    family: Family | str, series: int, index: int, *, standing: bool = False
) -> Instance:
    """Instance `index` of a series of a family.

    Args:
        family: itself, or a name of `FAMILIES`.
        series: 0 for the shipped test instances, 1 for training, others for users (`--seed`).
        index: 0, 1, 2, ...
        standing: fillings stand at the bottom of the upright vessel. False: they are smeared over it, as in the shipped
            instances, so that a vessel that is 30 % full has its centre of mass at half its height.

    Raises:
        FamilyError: one line that names the family: what its generator answers wrongly.
    """
    family = FAMILIES[family] if isinstance(family, str) else family
    draw, parts = Draw(family.category, series, index), Parts()
    tag = {SHIPPED: "", TRAINING: "t"}.get(series, f"s{series}_")
    name = f"{family.category}_{tag}{index:02d}"
    shape = shape_of(family, name, draw, parts)
    solid = shape.solid.simplify(SMOOTH_MM).refine_to_length(EDGE_MM)
    found = solid.to_mesh64()
    vertices = np.asarray(found.vert_properties)[:, :3]
    faces = np.asarray(found.tri_verts).astype(np.int32)
    label = np.zeros(len(faces), np.uint8)
    bounds = np.asarray(found.run_index) // 3
    for k, original in enumerate(found.run_original_id):
        label[bounds[k] : bounds[k + 1]] = family.parts.index(parts.names[int(original)])
    vertices, faces, label = _divided(vertices, faces, label, family, parts)
    mass, com, inertia = _inertial(_weighed(parts, shape, standing), float(solid.volume()))
    rest, R = _resting(family, name, vertices, com, draw)
    turned = vertices @ R.T
    middle = (turned.min(0) + turned.max(0)) / 2
    placed, faces, label = _without_slivers((turned - middle) / 1000, faces, label)
    return Instance(
        name, family, placed, faces, label,
        round(1e-9 * mass, 4), (R @ com - middle) / 1000, 1e-15 * (R @ inertia @ R.T), rest, draw.parameters,
    )  # fmt: skip


def _divided(
    vertices: Vec, faces: NDArray[np.int32], label: NDArray[np.uint8], family: Family, parts: Parts
) -> tuple[Vec, NDArray[np.int32], NDArray[np.uint8]]:
    """The surface with an edge along every cut, and what lies beyond each under its new name."""
    surface = Surface(vertices, faces.astype(np.int64), label.astype(np.int64))
    for source, normal, offset, new in parts.cuts:
        x, y, z = normal
        imprint(surface, lambda p: p[0] * x + p[1] * y + p[2] * z - offset, SNAP_MM)  # noqa: B023
        old = family.parts.index(source)
        for k, face in enumerate(surface.f):
            if face is not None and surface.label[k] == old:
                height = np.mean([surface.v[a] for a in face], axis=0) @ np.array(normal) - offset
                surface.label[k] = family.parts.index(new) if height > 0 else old
    vertices, found, names = surface.arrays()
    return vertices, found.astype(np.int32), names.astype(np.uint8)


def _without_slivers(
    vertices: Vec, faces: NDArray[np.int32], label: NDArray[np.uint8]
) -> tuple[Vec, NDArray[np.int32], NDArray[np.uint8]]:
    """The surface (m) as it is, or without the slivers that can be removed where it has some in single precision."""
    if heights(vertices.astype(np.float32), faces).min() >= SLIVER_M:
        return vertices, faces, label
    surface = Surface(1000 * vertices, faces.astype(np.int64), label.astype(np.int64))
    without_slivers(surface, CLEARED_MM, NEEDLE_MM)
    found, left, names = surface.arrays()
    return found / 1000, left.astype(np.int32), names.astype(np.uint8)


Weighed: TypeAlias = tuple[Manifold, float, float | None]
"""A solid, its density, kg/m^3, and the volume that it takes up of the whole, mm^3; None: its own."""


def _weighed(parts: Parts, shape: Shape, standing: bool) -> list[Weighed]:
    """The parts' own solids; of a vessel with a standing filling the water in it."""
    found: list[Weighed] = []
    for name, solid in parts.solids:
        if standing and shape.filling is not None and name == shape.filling[0]:
            found.append((filled_to(solid, shape.filling[1]), WATER, float(solid.volume())))
        else:
            found.append((solid, shape.density[name], None))
    return found


def filled_to(solid: Manifold, share: float) -> Manifold:
    """The lowest part of a solid, by z, that has this share of its volume.

    Args:
        solid: z up.
        share: 0 to 1.
    """
    _, _, low, _, _, high = solid.bounding_box()
    wanted = share * float(solid.volume())
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        below = float(solid.trim_by_plane((0.0, 0.0, -1.0), -middle).volume())
        low, high = (middle, high) if below < wanted else (low, middle)
    return solid.trim_by_plane((0.0, 0.0, -1.0), -high)


def _inertial(weighed: Sequence[Weighed], volume: float) -> tuple[float, Vec, Vec]:
    """Mass (mm^3 kg/m^3), centre (mm) and inertia about it, of the parts' own solids at their densities. Where solids
    overlap both count, so all are scaled to the volume of the whole."""
    mass, moment, second, own = 0.0, np.zeros(3), np.zeros((3, 3)), 0.0
    for solid, density, takes in weighed:
        mesh = solid.to_mesh64()
        body = trimesh.Trimesh(
            np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False
        )
        m, c = density * body.volume, np.asarray(body.center_mass)
        own += body.volume if takes is None else takes
        mass, moment = mass + m, moment + m * c
        second += density * body.moment_inertia + m * ((c @ c) * np.eye(3) - np.outer(c, c))
    com = moment / mass
    inertia = second - mass * ((com @ com) * np.eye(3) - np.outer(com, com))
    share = volume / own
    return mass * share, com, inertia * share


def _resting(family: Family, name: str, vertices: Vec, com: Vec, draw: Draw) -> tuple[str, Vec]:
    """How the instance lies, and its turn: the drawn way, brought to the nearest stable one, at any yaw."""
    word, R = draw.choice("rest", family.rests), np.eye(3)
    for axis, angle in TURNS[word]:
        turn = draw("roll", 0, 360) if angle is None else angle
        R = Rotation.from_euler(axis, turn, degrees=True).as_matrix() @ R
    settled = _settled(trimesh.convex.convex_hull(vertices), com, R)
    if settled is None:
        raise FamilyError(
            f"family {family.category}, instance {name}: its centre of mass lies outside of its hull, so it rests on no side;"
            " does the solid intersect itself?"
        )
    R = settled
    return word, Rotation.from_euler("z", draw("yaw", 0, 360), degrees=True).as_matrix() @ R


def _settled(hull: trimesh.Trimesh, com: Vec, R: Vec) -> Vec | None:
    """The least further turn that sets the hull on a face over which the centre of mass stands; None: there is no such face."""
    corner = hull.triangles
    foot = (
        com
        - np.einsum("ij,ij->i", com - corner[:, 0], hull.face_normals)[:, None] * hull.face_normals
    )
    weight = trimesh.triangles.points_to_barycentric(corner, foot)
    down = hull.face_normals @ R.T
    stable = np.flatnonzero((weight > -1e-9).all(1))
    if not len(stable):
        return None
    best = stable[np.argmin(down[stable, 2])]
    turn, _ = Rotation.align_vectors(np.array([[0.0, 0.0, -1.0]]), down[best : best + 1])
    return np.asarray(turn.as_matrix() @ R)


def model_of(instance: Instance) -> ObjectModel:
    """The object that an evaluator judges, with its category's words and roles."""
    family = instance.family
    region = np.isin(instance.face_part, [family.parts.index(p) for p in family.receiver])
    if family.split == "S1" and not 0 < region.sum() < len(region):
        raise FamilyError(
            f"family {family.category}, instance {instance.name}: {'all' if region.any() else 'nothing'} of its surface is of"
            f" the receiver's parts, {', '.join(family.receiver)}; the robot needs a part to hold, and the receiver one to take"
        )
    built = build_object(
        instance.mesh, instance.name, family.split, receiver=region if family.split == "S1" else None,
        mass=instance.mass, instruction=family.instruction, face_part=instance.face_part, part_names=family.parts,
    )  # fmt: skip
    check_surface(family, instance.name, built.mesh)
    return with_family(replace(built, com=instance.com, inertia=instance.inertia), family)


def with_family(model: ObjectModel, family: Family) -> ObjectModel:
    """The object with what its family says of all its instances.

    Args:
        model: an instance.
        family: whose instance.
    """
    return replace(
        model, words=family.words, roles=family.roles, category=family.category, sharp=family.sharp,
        up=up_of(model, family.vessel),
    )  # fmt: skip
