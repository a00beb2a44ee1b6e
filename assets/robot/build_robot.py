"""Writes robot.json and report.json: kinematics from airo-models' URDFs, primitives fitted to its visual meshes.

    python -m r2h_batch.assets.robot.build_robot [--keep-fit]

`--keep-fit` takes the primitives from the committed robot.json and renews everything else, report.json included.
The search is seeded and needs about two minutes; another processor's rounding may give other last digits.

Overshoot of a link: points are spread over the outer surface of the union of its primitives (1 mm apart, each weighted
by the area it stands for; what lies inside another primitive of the link does not count), and the distance of each to
the link's visual mesh is taken. Mean, 95th percentile and maximum are over that area; the mean over links is weighted
by it. Where the mesh is an open or recessed sleeve into which the next link is plugged (`MOUTHS`), a flat disc closes
it first: the neighbour fills it. `mouth_share` is the share of the area nearest to such a disc, and
`mean_without_mouths_mm` the mean to the bare mesh.
Protrusion: the largest signed distance of any face sample (lattice <= 0.4 mm, every corner included) to the union: negative
means that all are inside. The fit itself sees one sample per cubic half millimetre: what lies between may stay outside.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from r2h_batch.assets.robot.fitting import (
    BOX,
    CAPSULE,
    CYLINDER,
    Array,
    Shape,
    Target,
    cmaes,
    cost,
    covered,
    disc,
    thinned,
    union_distance,
)
from r2h_batch.bodies import robot_visuals as visuals

HERE = Path(__file__).resolve().parent
EE_OFFSET_M = 0.153203152  # flange to the pads' centre at half stroke
MOTION = {
    "body": "fixed",
    "outer_knuckle": "driver",
    "outer_finger": "driver",
    "inner_finger": "pin",
    "pad": "pin",
    "inner_knuckle": "inner_knuckle",
}

# Sleeves of the visual meshes that the next link closes: centre, normal, radius in the link frame.
MOUTHS: dict[str, list[tuple[tuple[float, float, float], tuple[float, float, float], float]]] = {
    "upper_arm": [((-0.425, 0.0, 0.0602), (0.0, 0.0, 1.0), 0.058)],
    "forearm": [((0.0, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.058), ((-0.3922, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.0375)],
    "wrist_1": [((0.0, 0.0, -0.0736), (0.0, 0.0, 1.0), 0.0375), ((0.0, -0.0536, 0.0), (0.0, 1.0, 0.0), 0.0375)],
    "wrist_2": [((0.0, 0.0, -0.0461), (0.0, 0.0, 1.0), 0.0375), ((0.0, 0.0531, 0.0), (0.0, 1.0, 0.0), 0.0375)],
    "wrist_3": [((0.0, 0.0, -0.0458), (0.0, 0.0, 1.0), 0.0375)],
}

# Links checked against each other: those that self_pairs.py finds in contact in some but not in all configurations.
# Neighbours are in each other's sockets: each pair of their primitives touches always or never. Others that never
# touch: base - upper_arm, forearm - wrist_2, wrist_1 - wrist_3, wrist_1 - gripper, wrist_2 - gripper (all of them with
# at most two joints in between, so that the tests can scan them densely).
SELF_PAIRS = (
    ("base", "forearm"),
    ("base", "wrist_1"),
    ("base", "wrist_2"),
    ("base", "wrist_3"),
    ("base", "gripper"),
    ("shoulder", "forearm"),
    ("shoulder", "wrist_1"),
    ("shoulder", "wrist_2"),
    ("shoulder", "wrist_3"),
    ("shoulder", "gripper"),
    ("upper_arm", "wrist_1"),
    ("upper_arm", "wrist_2"),
    ("upper_arm", "wrist_3"),
    ("upper_arm", "gripper"),
    ("forearm", "wrist_3"),
    ("forearm", "gripper"),
)
# An attached object is checked against the whole arm; wrist_3 carries it, so that pair is the same all along a path.
OBJECT_PAIRS = visuals.ARM_LINKS

# Where the search starts, per link: the normal of the link's mirror plane, in which all axes stay, and one row a
# primitive: kind, (u, v) of its centre in the plane (the two other axes in order), angle of its own z axis from u to v
# in rad, size (round: radius, half length; box: half sides along normal, across, along z); a fifth entry makes it a
# mirrored pair at +- that distance from the plane.
UP = np.pi / 2
Row = tuple[Any, ...]
RECIPES: dict[str, tuple[str, list[Row]]] = {
    "base": ("x", [
        (CYLINDER, (0.0, 0.0190), UP, (0.0755, 0.0191)),
        (CYLINDER, (0.0, 0.0341), UP, (0.0698, 0.0340)),
        (CYLINDER, (0.0, 0.0598), UP, (0.0603, 0.0394)),
    ]),
    "shoulder": ("x", [
        (CYLINDER, (-0.0002, -0.0016), UP, (0.0603, 0.0626)),
        (CYLINDER, (-0.0314, -0.0001), 0.0, (0.0590, 0.0432)),
        (CYLINDER, (-0.0134, 0.0170), 1.44, (0.0543, 0.0490)),
    ]),
    "upper_arm": ("y", [
        (CYLINDER, (-0.0004, 0.1407), UP - 0.025, (0.0608, 0.0679)),
        (CYLINDER, (-0.4236, 0.1342), UP + 0.016, (0.0606, 0.0750)),
        (CYLINDER, (-0.2092, 0.1379), 0.0, (0.0431, 0.2088)),
        (CAPSULE, (-0.0282, 0.1421), 0.20, (0.0636, 0.0221)),
        (CAPSULE, (-0.3979, 0.1323), 0.17, (0.0607, 0.0323)),
    ]),
    "forearm": ("y", [
        (CYLINDER, (-0.0011, 0.0389), UP - 0.010, (0.0597, 0.0223)),
        (CYLINDER, (-0.3919, 0.0057), UP + 0.006, (0.0394, 0.0554)),
        (CYLINDER, (-0.1950, 0.0064), 0.0, (0.0380, 0.2030)),
        (CAPSULE, (-0.0321, 0.0149), 0.27, (0.0528, 0.0280)),
    ]),
    "wrist_1": ("x", [
        (CYLINDER, (0.0011, -0.0007), 0.0, (0.0395, 0.0553)),
        (CYLINDER, (0.0002, -0.0322), UP, (0.0378, 0.0419)),
    ]),
    "wrist_2": ("x", [
        (CYLINDER, (-0.0015, -0.0003), 0.0, (0.0394, 0.0553)),
        (CYLINDER, (-0.0005, -0.0196), UP, (0.0379, 0.0266)),
    ]),
    "wrist_3": ("x", [
        (CYLINDER, (0.0006, -0.0229), UP, (0.0377, 0.0229)),
        (CAPSULE, (-0.0371, -0.0315), 0.0, (0.0060, 0.0046)),
    ]),
    "body": ("x", [  # the coupling is part of it
        (CYLINDER, (0.0, 0.0120), UP, (0.0396, 0.0231)),
        (CAPSULE, (0.0, 0.0375), 0.0, (0.0360, 0.0064)),
        (CAPSULE, (0.0, 0.0526), 0.0, (0.0212, 0.0236)),
        (CAPSULE, (0.0, 0.0718), 0.0, (0.0217, 0.0146)),
    ]),
    "outer_knuckle": ("x", [
        (BOX, (0.0157, 0.0011), 0.014, (0.0055, 0.0114, 0.0232)),
        (BOX, (0.0246, 0.0084), 0.036, (0.0120, 0.0044, 0.0024)),
    ]),
    "outer_finger": ("x", [(BOX, (0.0031, 0.0236), UP - 0.129, (0.0135, 0.0060, 0.0298))]),
    "inner_finger": ("x", [
        (BOX, (-0.0097, 0.0041), -0.361, (0.0075, 0.0066, 0.0166)),
        (BOX, (-0.0151, 0.0251), UP + 0.034, (0.0072, 0.0042, 0.0198)),
    ]),
    "inner_knuckle": ("x", [
        (BOX, (0.0109, 0.0128), 0.864, (0.0041, 0.0061, 0.0229), 0.0155),
        (BOX, (0.0300, 0.0351), 0.864, (0.0136, 0.0061, 0.0170)),
    ]),
}  # fmt: skip


def target(name: str) -> Target:
    """The mesh of a link or gripper part, ready to be covered."""
    triangles = visuals.visual_triangles(name)
    mouths = [disc(np.array(c), np.array(n), r, 4.0e-4) for c, n, r in MOUTHS.get(name, [])]
    return Target(triangles, mouths, float(trimesh.triangles.area(triangles).sum()))


def start(name: str) -> tuple[Array, Array]:
    """The recipe's numbers as one vector, and the first step of the search in each."""
    length = 1.5e-3 if name in visuals.ARM_LINKS else 0.7e-3
    numbers, steps = [], []
    for _, (u, v), angle, *rest in RECIPES[name][1]:
        sizes = [*rest[0], *rest[1:]]
        numbers += [u, v, angle, *sizes]
        steps += [length, length, 0.05, *[length] * len(sizes)]
    return np.array(numbers), np.array(steps)


def shapes_of(name: str, numbers: Array) -> list[Shape]:
    """The primitives that a vector stands for."""
    normal, rows = RECIPES[name]
    n = "xyz".index(normal)
    across, u_axis, v_axis = np.eye(3)[n], *np.delete(np.eye(3), n, axis=0)
    shapes, at = [], 0
    for kind, _, _, size, *pair in rows:
        u, v, angle = numbers[at : at + 3]
        sizes = np.abs(numbers[at + 3 : at + 3 + len(size)])
        along = np.cos(angle) * u_axis + np.sin(angle) * v_axis
        R = np.stack([across, np.cross(along, across), along], axis=1)
        at += 3 + len(size) + len(pair)
        for offset in (-numbers[at - 1], numbers[at - 1]) if pair else (0.0,):
            shapes.append(Shape(kind, u * u_axis + v * v_axis + offset * across, R, sizes))
    return shapes


def fit(name: str, mesh: Target) -> list[Shape]:
    """The primitives of one link: least overshoot from the recipe on, then grown until every face sample is inside."""
    numbers, steps = start(name)
    samples = mesh.coarse
    for seed, (scale, rounds) in enumerate([(1.0, 150), (0.3, 60), (0.1, 60)]):
        numbers, _ = cmaes(lambda x: cost(mesh, shapes_of(name, x), samples), numbers, scale * steps, rounds, seed)  # noqa: B023
        missed = mesh.dense[union_distance(shapes_of(name, numbers), mesh.dense) > 1e-4]
        samples = np.concatenate([samples, thinned(missed, 1.5e-3)])
    # Written numbers are rounded, so it is the rounded shapes that are grown (and then rounded up).
    return [rounded(s) for s in covered(mesh, [rounded(s) for s in shapes_of(name, numbers)], margin=2e-6)]


def rounded(shape: Shape) -> Shape:
    """The shape that robot.json's digits stand for: micrometres, sizes rounded up."""
    return read(write(shape))


def write(shape: Shape) -> dict[str, Any]:
    quat_wxyz = Rotation.from_matrix(shape.R).as_quat(canonical=True, scalar_first=True)
    return {
        "kind": shape.kind,
        "pos": (np.round(shape.pos, 6) + 0.0).tolist(),
        "quat_wxyz": (np.round(quat_wxyz, 9) + 0.0).tolist(),
        "size": (np.ceil(shape.size * 1e6 - 1e-3) / 1e6).tolist(),
    }


def read(row: dict[str, Any]) -> Shape:
    R = Rotation.from_quat(row["quat_wxyz"], scalar_first=True).as_matrix()
    return Shape(row["kind"], np.array(row["pos"]), R, np.array(row["size"]))


def gripper_rows(parts: dict[str, list[Shape]], half_pad: Array) -> list[dict[str, Any]]:
    """Rows of `gripper_primitives`: parts placed in the gripper frame, the left finger turned by half a turn."""
    rows = [
        {"name": f"body_{i}", "part": "body", "side": "none", "motion": "fixed", **write(s)}
        for i, s in enumerate(parts["body"])
    ]
    pad = [Shape(BOX, np.zeros(3), np.eye(3), half_pad)]
    for side, turn in (("left", np.diag([-1.0, -1.0, 1.0])), ("right", np.eye(3))):
        for part in (*visuals.FINGER_PARTS, "pad"):
            for i, s in enumerate(pad if part == "pad" else parts[part]):
                body_poses = Shape(s.kind, turn @ (s.pos + visuals.part_origin(part)), turn @ s.R, s.size)
                name = f"{side}_pad" if part == "pad" else f"{side}_{part}_{i}"
                row = {"name": name, "part": part, "side": side, "motion": MOTION[part], **write(body_poses)}
                if part == "pad":  # exact, not rounded
                    row |= {"pos": (body_poses.pos + 0.0).tolist(), "size": half_pad.tolist()}
                rows.append(row)
    return rows


def robot_data(fitted: dict[str, list[Shape]]) -> dict[str, Any]:
    """The whole of robot.json."""
    joints, T_wrist3_flange = visuals.joint_rows()
    T_flange_ee, T_flange_gripper = np.eye(4), np.eye(4)
    T_flange_ee[2, 3], T_flange_gripper[2, 3] = EE_OFFSET_M, visuals.GRIPPER_OFFSET_M
    linkage = visuals.linkage()
    return {
        "format": 1,
        "links": [*visuals.ARM_LINKS, "gripper"],
        "joints": joints,
        "T_wrist3_flange": visuals.exact(T_wrist3_flange),
        "T_flange_ee": T_flange_ee.tolist(),
        "T_flange_gripper": T_flange_gripper.tolist(),
        "arm_primitives": [
            {"name": f"{link}_{i}", "link": link, **write(s)}
            for link in visuals.ARM_LINKS
            for i, s in enumerate(fitted[link])
        ],
        "gripper_primitives": gripper_rows(fitted, np.array(linkage["pad_half_size"])),
        "linkage": linkage,
        "self_pairs": SELF_PAIRS,
        "object_pairs": OBJECT_PAIRS,
    }


def read_fitted(data: dict[str, Any]) -> dict[str, list[Shape]]:
    """The shapes of a robot.json per link and part, in the frames of their meshes."""
    fitted: dict[str, list[Shape]] = {}
    for row in data["arm_primitives"]:
        fitted.setdefault(row["link"], []).append(read(row))
    for row in data["gripper_primitives"]:
        if row["side"] != "left" and row["part"] != "pad":
            shape = read(row)
            home = visuals.part_origin(row["part"]) if row["part"] != "body" else 0.0
            fitted.setdefault(row["part"], []).append(Shape(shape.kind, shape.pos - home, shape.R, shape.size))
    return fitted


def summary(links: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Figures over all links; both fingers count."""
    weight = {n: r["surface_m2"] * (2 if n in visuals.FINGER_PARTS else 1) for n, r in links.items()}
    arm = {n: weight[n] for n in visuals.ARM_LINKS}
    means = {n: r["mean_mm"] for n, r in links.items()}
    return {
        "mean_mm": sum(means[n] * w for n, w in weight.items()) / sum(weight.values()),
        "arm_mean_mm": sum(means[n] * w for n, w in arm.items()) / sum(arm.values()),
        **{k: max(r[k] for r in links.values()) for k in ("p95_mm", "max_mm", "worst_protrusion_mm")},
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Fit the robot's collision primitives and write robot.json, report.json."
    )
    parser.add_argument("--keep-fit", action="store_true", help="keep the committed primitives, renew the rest")
    keep = parser.parse_args().keep_fit
    meshes = {name: target(name) for name in RECIPES}
    if keep:
        fitted = read_fitted(json.loads((HERE / "robot.json").read_text()))
    else:
        fitted = {name: fit(name, mesh) for name, mesh in meshes.items()}
    (HERE / "robot.json").write_text(json.dumps(robot_data(fitted), indent=1) + "\n")
    links = {name: mesh.report(fitted[name]) for name, mesh in meshes.items()}
    report = {"links": links, "all": summary(links)}
    (HERE / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    for name, row in {**links, "all": report["all"]}.items():
        print(name, " ".join(f"{k} {v:.3g}" for k, v in row.items()))


if __name__ == "__main__":
    main()
