"""Bodies of Anny (Apache-2.0; its data is MakeHuman's, CC0) and the lengths that the benchmark takes from them.

Needs `pip install 'r2h_batch[build]'`. Only the MakeHuman topology is used: Anny's SMPL topologies fetch files under a
non-commercial licence. Anny's frame: z up, the chest faces -y, the right arm lies at -x, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import anny
import numpy as np
import torch
from anny.shape_distribution import SimpleShapeDistribution
from numpy.typing import NDArray

F64 = NDArray[np.float64]

GROUPS = {"adults": (18.0, 65.0, 1000), "children": (6.0, 12.0, 500), "elderly": (70.0, 90.0, 500)}
"""Ages in years, uniform [choice], and how many people the table has."""
SEED = 41
AT_ONCE = 50

ABOVE_JOINT = 0.104
"""Share of acromion to radiale by which the acromion lies above the shoulder's joint, as in `trials/draw/receivers.py`."""
ILIAC, POPLITEAL, SEAT = 1.16, 0.80, 0.051
"""Iliac crest / hip joint and hollow of the knee / knee joint, heights above the floor; height of the hip joint above
the seat / stature. Fitted by hand to the medians of ANSUR II's iliac height, popliteal height and seated shoulder, so a
comparison of these three lengths with ANSUR II shows the fit and validates nothing."""
HELD = 0.98
"""Share of the skin that capsules and box hold: the last hundredths are the shoulder's cap, breasts and buttocks, and
would make the shapes thicker by centimetres everywhere (report.json has what stands out, and by how much)."""
TAKEN = 0.5
"""A vertex belongs to a limb if its bones have more than this share of the vertex's weight."""


@dataclass(frozen=True)
class Bodies:
    """n bodies in the rest pose. `sex`: 0 man, 1 woman; `age` in years."""

    sex: NDArray[np.int8]
    age: F64
    vertices: F64  # (n, V, 3)
    heads: F64  # (n, bones, 3)


class Model:
    """Anny with its skin weights as a dense table."""

    def __init__(self) -> None:
        self.anny = anny.Anny().to(dtype=torch.float32)
        self.bones: list[str] = list(self.anny.bone_labels)
        weights = torch.zeros(len(self.anny.template_vertices), len(self.bones))
        weights.scatter_add_(1, self.anny.vertex_bone_indices.long(), self.anny.vertex_bone_weights.float())
        self.weights: F64 = weights.double().numpy()
        self.faces: NDArray[np.int64] = self.anny.faces.numpy().astype(np.int64)

    def draw(self, group: str) -> Bodies:
        """The people of a group: heights by WHO's distribution for their age, as Anny ships it."""
        youngest, oldest, count = GROUPS[group]
        torch.manual_seed(SEED + list(GROUPS).index(group))
        ages = torch.distributions.Uniform(torch.tensor(youngest), torch.tensor(oldest))
        age, drawn = SimpleShapeDistribution(self.anny, morphological_age_distribution=ages).sample(count)
        phenotype = {k: v.float() for k, v in drawn.items()}
        phenotype["gender"] = (phenotype["gender"] > 0.5).float()  # a man or a woman, none between
        return self.bodies(age.double().numpy(), phenotype)

    def bodies(self, age: F64, phenotype: dict[str, torch.Tensor]) -> Bodies:
        """The bodies of Anny's parameters (n,)."""
        vertices, heads = [], []
        for first in range(0, len(age), AT_ONCE):
            part = {k: v[first : first + AT_ONCE] for k, v in phenotype.items()}
            rest = torch.eye(4)[None, None].repeat(len(part["gender"]), len(self.bones), 1, 1)
            with torch.no_grad():
                out = self.anny(pose_parameters=rest, phenotype_kwargs=part)
            vertices.append(out["rest_vertices"].double().numpy())
            heads.append(out["rest_bone_heads"].double().numpy())
        sex = phenotype["gender"].numpy().astype(np.int8)
        return Bodies(sex, age, np.concatenate(vertices), np.concatenate(heads))

    def belongs(self, *names: str) -> NDArray[np.bool_]:
        """(V,) the vertices that bones with these beginnings move."""
        columns = [i for i, bone in enumerate(self.bones) if bone.startswith(names)]
        return np.asarray(self.weights[:, columns].sum(1) > TAKEN)

    def head(self, bodies: Bodies, bone: str) -> F64:
        """(n, 3) the joint at which a bone begins."""
        return np.asarray(bodies.heads[:, self.bones.index(bone)])


@dataclass(frozen=True)
class Limb:
    """A capsule's axis and the skin that it must hold."""

    start: F64  # (n, 3)
    end: F64
    skin: NDArray[np.bool_]  # (V,)

    def distance(self, bodies: Bodies) -> F64:
        """(n, v) of its skin from its axis, m."""
        skin = bodies.vertices[:, self.skin]
        way = self.end - self.start
        along = np.einsum("nvk,nk->nv", skin - self.start[:, None], way) / (way * way).sum(1)[:, None]
        nearest = self.start[:, None] + np.clip(along, 0.0, 1.0)[..., None] * way[:, None]
        return np.asarray(np.linalg.norm(skin - nearest, axis=2))

    def radius(self, bodies: Bodies) -> F64:
        """(n,) of the capsule that holds HELD of its skin, m."""
        return np.asarray(np.quantile(self.distance(bodies), HELD, axis=1))

    def girth(self, bodies: Bodies, share: float) -> F64:
        """(n,) the tape's circumference at this share of the limb: of the mean circle about its axis."""
        skin = bodies.vertices[:, self.skin]
        way = self.end - self.start
        along = np.einsum("nvk,nk->nv", skin - self.start[:, None], way) / (way * way).sum(1)[:, None]
        near = np.abs(along - share) < 0.12
        distance = np.where(near, self.distance(bodies), np.nan)
        return np.asarray(2 * np.pi * np.nanmean(distance, axis=1))


def limbs(model: Model, bodies: Bodies) -> tuple[Limb, Limb]:
    """The right upper arm and forearm."""
    shoulder, elbow, wrist = (model.head(bodies, f"{bone}.R") for bone in ("upperarm01", "lowerarm01", "wrist"))
    upper = model.belongs("upperarm01.R", "upperarm02.R")
    fore = model.belongs("lowerarm01.R", "lowerarm02.R")
    return Limb(shoulder, elbow, upper), Limb(elbow, wrist, fore)


def trunk_skin(model: Model, bodies: Bodies, low: F64, high: F64) -> NDArray[np.bool_]:
    """(n, V) the skin of chest, belly and hips between two heights (n,): without shoulders, arms, neck and legs."""
    z = bodies.vertices[:, :, 2]
    inside = (z >= low[:, None]) & (z <= high[:, None])
    return np.asarray(model.belongs("spine", "pelvis", "root", "breast")[None] & inside)


def lengths(model: Model, bodies: Bodies) -> dict[str, F64]:
    """Lengths (n,) in m by the names of `trials/draw/receivers.LENGTHS_MM`.

    Circumferences, chest_depth and chest_breadth are those of the capsules and of the box that hold the body, and so
    larger than a tape's.
    """
    floor = bodies.vertices[:, :, 2].min(1)
    stature = bodies.vertices[:, :, 2].max(1) - floor
    upper, fore = limbs(model, bodies)
    arm = np.linalg.norm(upper.end - upper.start, axis=1) / (1.0 - ABOVE_JOINT)
    acromion = upper.start[:, 2] - floor + ABOVE_JOINT * arm
    hip = model.head(bodies, "upperleg01.R")[:, 2] - floor
    knee = model.head(bodies, "lowerleg01.R")[:, 2] - floor
    held = trunk_skin(model, bodies, floor + ILIAC * hip, floor + acromion)
    ahead = np.abs(bodies.vertices[:, :, 1] - upper.start[:, 1, None])
    aside = np.abs(bodies.vertices[:, :, 0])
    around = 2 * np.pi * fore.radius(bodies)
    other = model.head(bodies, "upperarm01.L")
    return {
        "stature": stature,
        "acromial_height": acromion,
        "biacromial_breadth": np.abs(upper.start[:, 0] - other[:, 0]),
        "acromion_radiale": arm,
        "radiale_stylion": np.linalg.norm(fore.end - fore.start, axis=1),
        "chest_depth": 2 * np.nanquantile(np.where(held, ahead, np.nan), HELD, axis=1),
        "chest_breadth": 2 * np.nanquantile(np.where(held, aside, np.nan), HELD, axis=1),
        "biceps_circumference": 2 * np.pi * upper.radius(bodies),
        "forearm_circumference": around,
        "wrist_circumference": around,
        "iliac_height": ILIAC * hip,
        "popliteal_height": POPLITEAL * knee,
        "seated_shoulder": acromion - hip + SEAT * stature,
    }
