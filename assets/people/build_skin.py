"""Makes skin.npz, the bodies that pictures draw: ``python -m r2h_batch.assets.people.build_skin``. Deterministic.

After build_people, whose people they are; needs the same packages. Two CPU minutes besides Anny's first construction.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.people.bodies import ABOVE_JOINT, GROUPS, Bodies, Model, lengths
from r2h_batch.assets.people.proportions import proportioned
from r2h_batch.data.people import LENGTHS_M
from r2h_batch.scene.arrays import read_arrays
from r2h_batch.view.skin import BONES, GEOMS, JOINTS, SIZES

F64 = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
FACES = 8000
"""Faces of the body with both hands and without the eyes, of 26,692."""
COMPONENTS = 16
EYE_FACES = 140
RAYS, SHUT = 500, 0.99
"""Ways out of a face that are looked along, and the share of them that meet the body where nobody sees the face; of seen faces
it is below 0.9."""

HAND = ("wrist.", "finger", "metacarpal")
HEADS = {
    "shoulder": "upperarm01.R", "elbow": "lowerarm01.R", "wrist": "wrist.R", "index": "finger2-1.R", "pinky": "finger5-1.R",
    "other_shoulder": "upperarm01.L", "other_elbow": "lowerarm01.L", "other_wrist": "wrist.L",
    "hip": "upperleg01.R", "knee": "lowerleg01.R", "other_hip": "upperleg01.L", "other_knee": "lowerleg01.L",
}  # fmt: skip
"""Joint -> the bone that begins there. The index finger's is its knuckle."""


@dataclass(frozen=True)
class Coarse:
    """The surface that is kept: each vertex as a point of a triangle of Anny's."""

    corners: NDArray[np.int64]  # (V, 3)
    share: F64  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3)

    def of(self, values: F64) -> F64:
        """(..., V, k) of values (..., Anny's vertices, k)."""
        return np.asarray(np.einsum("...vck,vc->...vk", values[..., self.corners, :], self.share))


def coarse(mean: F64, faces: NDArray[np.int64]) -> Coarse:
    """The mean body with fewer faces, chosen by the quadric error, and its eyes."""
    whole = trimesh.Trimesh(mean, faces, process=False)
    part = trimesh.graph.connected_component_labels(whole.face_adjacency, node_count=len(faces))
    count = np.bincount(part)
    body, eyes = faces[part == count.argmax()], faces[count[part] == EYE_FACES]
    used, place = np.unique(body, return_inverse=True)
    vertices, kept, *_ = igl.qslim(mean[used], place.reshape(-1, 3), FACES)
    surface = trimesh.Trimesh(mean[used], place.reshape(-1, 3), process=False)
    near, _, face = trimesh.proximity.closest_point(surface, vertices)
    share = trimesh.triangles.points_to_barycentric(surface.triangles[face], near)
    eye, there = np.unique(eyes, return_inverse=True)
    return Coarse(
        np.concatenate([used[surface.faces[face]], np.repeat(eye[:, None], 3, 1)]),
        np.concatenate([share, np.eye(3)[np.zeros(len(eye), int)]]),
        np.concatenate([kept.astype(np.int64), len(vertices) + there.reshape(-1, 3)]),
    )


def bone_weights(model: Model) -> F64:
    """(Anny's vertices, bones) by `view.skin.BONES`."""
    beginnings = {
        "upper": ("upperarm",), "fore": ("lowerarm", *HAND), "thigh": ("upperleg",), "shin": ("lowerleg", "foot", "toe"),
    }  # fmt: skip
    table = np.zeros((len(model.weights), len(BONES)))
    for k, bone in enumerate(model.bones):
        side = {".R": "", ".L": "other_"}.get(bone[-2:], "")
        own = next((side + name for name, some in beginnings.items() if bone.startswith(some)), "trunk")
        table[:, BONES.index(own)] += model.weights[:, k]
    return table


def stood(bodies: Bodies, points: F64, shoulder: F64) -> F64:
    """Points (n, m, 3) of Anny's frame in that of `view.skin.Skins`: on the floor below the middle of the box, ahead is x."""
    floor = bodies.vertices[:, :, 2].min(1)
    ahead, left, up = -points[..., 1], points[..., 0], points[..., 2]
    return np.stack([ahead + shoulder[:, None, 1], left, up - floor[:, None]], -1)


def sizes(length: dict[str, F64]) -> F64:
    """(n, 10) by `SIZES`."""
    found = {
        "upper": (1.0 - ABOVE_JOINT) * length["acromion_radiale"],
        "fore": length["radiale_stylion"],
        "upper_radius": length["biceps_circumference"] / (2 * np.pi),
        "fore_radius": 0.5 * (length["forearm_circumference"] + length["wrist_circumference"]) / (2 * np.pi),
        "chest_depth": 0.5 * length["chest_depth"],
        "chest_breadth": 0.5 * length["chest_breadth"],
    }
    return np.stack([(length | found)[name] for name in SIZES], 1)


def main() -> None:
    """Writes the file and prints how far its skins are from Anny's."""
    torch.set_num_threads(1)
    model = Model()
    drawn = {group: proportioned(model, model.draw(group)) for group in GROUPS}
    table = read_arrays(HERE / "people.npz")
    if not all(
        np.allclose(table["stature"][table["group"] == k], lengths(model, people)["stature"], atol=1e-5)
        for k, people in enumerate(drawn.values())
    ):
        raise SystemExit("people.npz has other people; run build_people first")
    kept = coarse(drawn["adults"].vertices.mean(0), model.faces)
    skin, joints = [], []
    for people in drawn.values():
        shoulder = model.head(people, "upperarm01.R")
        heads = np.stack([model.head(people, HEADS[name]) for name in JOINTS], 1)
        skin.append(stood(people, kept.of(people.vertices), shoulder))
        joints.append(stood(people, heads, shoulder))
    weights = kept.of(bone_weights(model))
    every = np.concatenate([np.concatenate(skin), np.concatenate(joints)], 1)
    made = arrays(every, weights, kept, model)
    made["sizes"] = sizes({name: table[name].astype(np.float64) for name in LENGTHS_M}).astype(np.float32)
    made["sex"] = table["sex"]
    write_npz(HERE / "skin.npz", made)
    basis = made["basis"] * made["scale"].astype(np.float64)[:, None, None]
    again = made["points"] + np.tensordot(made["person"].astype(np.float64), basis, 1)
    off = np.linalg.norm(again - every, axis=2)
    report = {
        "vertices": len(kept.share), "faces": len(made["faces"]), "components": COMPONENTS,
        "off_mean_mm": round(1000 * float(off.mean()), 2), "off_p95_mm": round(1000 * float(np.quantile(off, 0.95)), 2),
        "joint_off_max_mm": round(1000 * float(off[:, -len(JOINTS) :].max()), 2),
        "bytes": (HERE / "skin.npz").stat().st_size,
    }  # fmt: skip
    print(json.dumps(report, indent=1))


def arrays(every: F64, weights: F64, kept: Coarse, model: Model) -> dict[str, NDArray[Any]]:
    """Mean and components of the people's points (P, V + joints, 3), and the surface without the reaching hand."""
    mean = every.mean(0)
    flat = (every - mean).reshape(len(every), -1)
    values, ways = np.linalg.eigh(flat @ flat.T)
    person = ways[:, ::-1][:, :COMPONENTS] * np.sqrt(values[::-1][:COMPONENTS])
    # signs are arbitrary: the largest number of each is positive
    person *= np.sign(person[np.abs(person).argmax(0), np.arange(COMPONENTS)])
    person /= person.std(0)
    basis = np.linalg.lstsq(person, flat, rcond=None)[0].reshape(COMPONENTS, *mean.shape)
    scale = np.abs(basis).max((1, 2)) / 127
    geom, gone = geoms(weights, kept, model)
    gone |= unseen(mean[: -len(JOINTS)], kept.faces)
    return {
        "points": mean.astype(np.float32),
        "basis": np.round(basis / scale[:, None, None]).astype(np.int8),
        "scale": scale.astype(np.float32),
        "person": person.astype(np.float16),
        "weights": np.round(255 * weights).astype(np.uint8),
        "faces": kept.faces[~gone].astype(np.uint16),
        "geom": geom[~gone],
    }


def unseen(points: F64, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(F,) faces that nobody sees from outside: the back of the eyes, their sockets, the mouth. A person who is drawn clear
    would show them."""
    corners = points[faces]
    out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    above = corners.mean(1) + 1e-4 * out
    shut = igl.ambient_occlusion(points, faces.astype(np.int32), above, out, RAYS).ravel()
    return np.asarray(shut > SHUT)


def geoms(weights: F64, kept: Coarse, model: Model) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """(F,) the part of `GEOMS` that a face belongs to, and whether it is the reaching hand's."""

    def mine(*names: str) -> NDArray[np.bool_]:
        columns = [i for i, bone in enumerate(model.bones) if bone.startswith(names)]
        share = kept.of(model.weights[:, columns].sum(1)[:, None])[:, 0]
        return np.asarray(share[kept.faces].mean(1) > 0.5)

    hand = [bone for bone in model.bones if bone.startswith(HAND)]
    head = mine("neck", "head", "eye") | mine("lowerarm01.L", "lowerarm02.L", *(b for b in hand if b.endswith(".L")))
    found = np.zeros(len(kept.faces), np.int8)
    for part, rows in (
        ("upper_arm", mine("upperarm01.R", "upperarm02.R")),
        ("forearm", mine("lowerarm01.R", "lowerarm02.R")),
        ("head", head),
    ):
        found[rows] = GEOMS.index(part)
    return found, mine(*(b for b in hand if b.endswith(".R")))


if __name__ == "__main__":
    main()
