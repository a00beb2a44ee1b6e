"""Writes robot.json and report.json: kinematics from airo-models' URDFs, primitives fitted to its visual meshes.

    python -m r2h_batch.assets.robot.build_robot [--keep-fit]

`--keep-fit` takes the primitives from the committed robot.json and renews everything else, report.json included.
The search is seeded and needs some minutes; another processor's rounding may lead to other primitives that cover as closely.

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

from r2h_batch.assets.robot.primitive_search import ARM_STEP_M, RECIPES, SearchTarget, fit, read, write
from r2h_batch.data.robot_shapes import BOX, Array, Shape, box_of, mouths_for
from r2h_batch.scene import robot_visuals as visuals

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
    meshes = {}
    for name in RECIPES:
        triangles = visuals.visual_triangles(name)
        box = box_of(triangles)
        meshes[name] = SearchTarget(triangles, mouths_for(name, box, box))
    if keep:
        fitted = read_fitted(json.loads((HERE / "robot.json").read_text()))
    else:
        fitted = {
            name: fit(RECIPES[name], mesh, ARM_STEP_M if name in visuals.ARM_LINKS else 0.7e-3)
            for name, mesh in meshes.items()
        }
    (HERE / "robot.json").write_text(json.dumps(robot_data(fitted), indent=1) + "\n")
    links = {name: mesh.report(fitted[name]) for name, mesh in meshes.items()}
    report = {"links": links, "all": summary(links)}
    (HERE / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    for name, row in {**links, "all": report["all"]}.items():
        print(name, " ".join(f"{k} {v:.3g}" for k, v in row.items()))


if __name__ == "__main__":
    main()
