"""Makes hand.npz, people.npz, postures.npz and report.json: ``python -m r2h_batch.assets.people.build_people``. Deterministic.

`--only table` makes people.npz anew for the stored hand, for which receiving grasps were sampled: the last bits of a hand
differ between processors.

Needs `pip install 'r2h_batch[build]'` (anny, roma). Anny's first construction takes one to two minutes and leaves a
cache of 790 MB (ANNY_CACHE_DIR, else ~/.cache/anny); delete it afterwards. The rest takes two CPU minutes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.hand.build_handset import (
    MEASURE_EVERY,
    Judge,
    angles_from_pose,
    mirrored,
    pose_from_angles,
)
from r2h_batch.assets.hand.measure import hull_planes, self_cut
from r2h_batch.assets.people import bodies as anny_bodies
from r2h_batch.assets.people import hands as anny_hands
from r2h_batch.assets.people.bodies import GROUPS, Bodies, Model, lengths, limbs, trunk_skin
from r2h_batch.assets.people.proportions import proportioned
from r2h_batch.scene.arrays import arrays_digest, asset, read_arrays
from r2h_batch.scene.hand import HandModel, load_hand
from r2h_batch.scene.hand_pieces import hulls_of

F64 = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
MEASURED = 40
"""People of each group whose capsules and box are measured against their skin."""
SURFACE = 4000
"""Points on each shape."""


def percentiles(values: F64) -> list[int]:
    """5th, 50th and 95th, in mm."""
    return [round(1000 * float(x)) for x in np.percentile(values, [5, 50, 95])]


def capsule_surface(rng: np.random.Generator, a: F64, b: F64, radius: float) -> F64:
    """Points spread by area over the side of a capsule: its round ends lie in the torso and in the hand."""
    way = (b - a) / np.linalg.norm(b - a)
    across = rng.standard_normal((SURFACE, 3))
    across -= (across @ way)[:, None] * way
    across /= np.linalg.norm(across, axis=1)[:, None]
    return np.asarray(a + rng.random((SURFACE, 1)) * (b - a) + radius * across)


def box_surface(rng: np.random.Generator, center: F64, half: F64) -> F64:
    """Points spread by area over the four upright sides of a box."""
    u, v, z = rng.uniform(-1.0, 1.0, (3, SURFACE))
    front = rng.random(SURFACE) < half[0] / (half[0] + half[1])
    x = np.where(front, u, np.sign(u))
    y = np.where(front, np.sign(v), v)
    return np.asarray(center + np.stack([x, y, z], 1) * half)


def overshoot(model: Model, people: Bodies, length: dict[str, F64]) -> dict[str, dict[str, float]]:
    """How far the judged shapes stand out of the skin, mm: from points of their surface to the nearest vertex of the
    body; the share of the skin that they hold, and how far the rest stands out of them."""
    rng = np.random.default_rng(anny_bodies.SEED)
    shoulder = model.head(people, "upperarm01.R")
    floor = people.vertices[:, :, 2].min(1)
    low, high = floor + length["iliac_height"], floor + length["acromial_height"]
    held = trunk_skin(model, people, low, high)
    found: dict[str, list[F64]] = {"upper_arm": [], "forearm": [], "torso": []}
    out: dict[str, list[F64]] = {name: [] for name in found}
    step = max(1, len(people.age) // MEASURED)
    for i in range(0, len(people.age), step):
        tree = cKDTree(people.vertices[i])
        one = Bodies(people.sex[i : i + 1], people.age[i : i + 1], people.vertices[i : i + 1], people.heads[i : i + 1])
        for name, limb, girth in zip(
            found, limbs(model, one), ("biceps_circumference", "forearm_circumference"), strict=False
        ):
            radius = float(length[girth][i] / (2 * np.pi))
            found[name].append(tree.query(capsule_surface(rng, limb.start[0], limb.end[0], radius))[0])
            out[name].append(limb.distance(one)[0] - radius)
        half = 0.5 * np.array([length["chest_breadth"][i], length["chest_depth"][i], high[i] - low[i]])
        center = np.array([0.0, shoulder[i, 1], 0.5 * (low[i] + high[i])])
        found["torso"].append(tree.query(box_surface(rng, center, half))[0])
        skin = people.vertices[i, held[i]]
        out["torso"].append((np.abs(skin - center) - half)[:, :2].max(1))
    return {
        name: {
            "skin_held_share": round(float((np.concatenate(out[name]) <= 0).mean()), 4),
            "skin_outside_max_mm": round(1000 * float(np.concatenate(out[name]).max()), 1),
            "overshoot_mean_mm": round(1000 * float(np.concatenate(d).mean()), 1),
            "overshoot_p95_mm": round(1000 * float(np.percentile(np.concatenate(d), 95)), 1),
            "overshoot_max_mm": round(1000 * float(np.concatenate(d).max()), 1),
        }
        for name, d in found.items()
    }


def tape(model: Model, people: Bodies, length: dict[str, F64]) -> dict[str, F64]:
    """Lengths as a tape measures them, where the table's are those of the shapes that hold the body."""
    upper, fore = limbs(model, people)
    shown = ("stature", "acromial_height", "biacromial_breadth", "acromion_radiale", "radiale_stylion")
    return {
        **{name: length[name] for name in (*shown, "iliac_height", "popliteal_height", "seated_shoulder")},
        "biceps_circumference": upper.girth(people, 0.6),
        "forearm_circumference": fore.girth(people, 0.3),
        "wrist_circumference": fore.girth(people, 0.95),
    }


def main() -> None:
    """Writes the files and prints the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("table",), help="keep hand.npz, postures.npz and whose hand is which")
    only = parser.parse_args().only
    begin = time.process_time()
    torch.set_num_threads(1)
    model = Model()
    own = {group: model.draw(group) for group in GROUPS}
    drawn = {group: proportioned(model, people) for group, people in own.items()}
    measured = {group: lengths(model, people) for group, people in drawn.items()}
    group_of = np.repeat(np.arange(len(GROUPS)), [len(p.age) for p in drawn.values()]).astype(np.int8)
    made, hands, figures = stored_hands() if only else new_hands(model, own, group_of)
    table: dict[str, NDArray[Any]] = {
        "group": group_of,
        "sex": np.concatenate([p.sex for p in drawn.values()]),
        "age": np.asarray(np.concatenate([p.age for p in drawn.values()]), np.float32),
        **hands,
    }
    for name in measured["adults"]:
        table[name] = np.asarray(np.concatenate([m[name] for m in measured.values()]), np.float32)
    write_npz(HERE / "people.npz", table)

    hand = HandModel.from_arrays(made)
    postures = dict(read_arrays(HERE / "postures.npz")) if only else same_angles(hand)
    if not only:
        write_npz(HERE / "hand.npz", made)
        write_npz(HERE / "postures.npz", postures)
    report: dict[str, Any] = {
        "anny": "0.6.2",
        "digests": {"hand": arrays_digest(made), "people": arrays_digest(table), "postures": arrays_digest(postures)},
        "hand": {"vertices": len(made["vertices"]), "faces": len(made["faces"])} | figures | checked(hand, table),
        "postures": self_cuts(hand, postures),
        "groups": {},
        "shapes": {g: overshoot(model, drawn[g], measured[g]) for g in GROUPS},
    }
    for k, (group, people) in enumerate(drawn.items()):
        shown = tape(model, people, measured[group]) | {
            "hand_length": table["hand_length"][group_of == k].astype(float)
        }
        for sex, word in enumerate(("men", "women") if group != "children" else ("boys", "girls")):
            rows = people.sex == sex
            figures_of = {name: percentiles(values[rows]) for name, values in shown.items()}
            report["groups"][f"{group}, {word}"] = {"people": int(rows.sum())} | figures_of
    report["cpu_s"] = round(time.process_time() - begin)
    (HERE / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))


def new_hands(
    model: Model, own: dict[str, Bodies], group_of: NDArray[np.int8]
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]], dict[str, float]]:
    """The hand model of these bodies, the columns of the table that say whose hand is which, and how well it fits."""
    piece = anny_hands.cut(model, own["adults"])
    hands = [anny_hands.hands_of(piece, people, load_hand()) for people in own.values()]
    every = anny_hands.Hands(*(np.concatenate([getattr(h, k) for h in hands]) for k in ("skin", "joints")))
    made, shape, figures = anny_hands.arrays(piece, every, group_of == 0, load_hand())
    length, shape = np.asarray(every.length(piece), np.float32), np.asarray(shape, np.float16)
    return made, {"hand_length": length, "hand_shape": shape}, figures


def stored_hands() -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]], dict[str, float]]:
    """As `new_hands`, from the files."""
    table, report = read_arrays(HERE / "people.npz"), json.loads((HERE / "report.json").read_text())
    fits = ("residual_mean_mm", "residual_max_mm", "first_component_share", "largest_shape_number")
    figures = {name: report["hand"][name] for name in fits}
    return dict(read_arrays(HERE / "hand.npz")), {k: table[k] for k in ("hand_length", "hand_shape")}, figures


def same_angles(hand: HandModel) -> dict[str, NDArray[Any]]:
    """The 400 receiving postures of the stand-in hand, as turns of this hand's bones by the same joint angles."""
    stored, like = read_arrays(asset("hand", "handset.npz")), load_hand().joint_axes.double().numpy()
    axes, pose = hand.joint_axes.double().numpy(), []
    for turns, side in zip(stored["pose"].astype(np.float64), stored["side"], strict=True):
        right = mirrored(turns) if side else turns
        own = pose_from_angles(angles_from_pose(right, like), axes)
        pose.append(mirrored(own) if side else own)
    return {"pose": np.asarray(pose, np.float32), "side": stored["side"], "posture": stored["posture"]}


def self_cuts(hand: HandModel, postures: dict[str, NDArray[Any]]) -> dict[str, float]:
    """How deep the hand cuts into itself, in every MEASURE_EVERY-th posture, mm."""
    judge, cuts = Judge(hand), []
    for i in range(0, len(postures["side"]), MEASURE_EVERY):
        pose = mirrored(postures["pose"][i]) if postures["side"][i] else postures["pose"][i]
        skin = judge.vertices(np.asarray(pose, np.float32), np.zeros(10, np.float32), 0)
        cuts.append(self_cut(skin, judge.faces, [hull_planes(skin[p]) for p in judge.pieces], judge.pieces))
    return {
        "hands_measured": len(cuts),
        "self_cut_mean_mm": round(1000 * float(np.mean(cuts)), 2),
        "self_cut_max_mm": round(1000 * float(np.max(cuts)), 2),
    }


def checked(hand: HandModel, table: dict[str, NDArray[Any]]) -> dict[str, float]:
    """The hands of all people in the rest posture: their skins lie in their convex pieces, and enclose a volume."""
    shape = torch.from_numpy(table["hand_shape"].astype(np.float32))
    skin = hand.pose(torch.zeros(len(shape), 48), shape).vertices.double().numpy()
    order = np.argsort(table["hand_length"])[:: len(shape) // 20]
    hulls_of(skin[order], [p.numpy() for p in hand.pieces], hand.piece_names)
    corners = skin[:, hand.faces.numpy()]
    volume = np.einsum("nfk,nfk->n", corners[:, :, 0], np.cross(corners[:, :, 1], corners[:, :, 2])) / 6
    return {
        "volume_least_cm3": round(1e6 * float(volume.min()), 1),
        "volume_most_cm3": round(1e6 * float(volume.max()), 1),
    }


if __name__ == "__main__":
    main()
