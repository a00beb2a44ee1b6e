"""A made arm of seven joints: the UR5e with one more joint in its forearm, about the forearm's axis."""

from dataclasses import replace

import numpy as np

from r2h_batch.scene.robot import (
    Primitives,
    Robot,
    ShapeKind,
    drive_from_gap,
    finger_motion,
    frozen,
    hull_size,
    pad_center_z,
    slide_table,
    table_linkage,
    table_motions,
)
from r2h_batch.scene.robot_file import load_robot, part_names

AXIS = np.array([[0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Takes z to the forearm's axis, -x of its link."""


def seven_joints() -> Robot:
    """At 0 the joint that is more (the fourth, +-2 rad) leaves the UR5e as it is. It moves half of the forearm's bodies."""
    ur = load_robot()
    wrist = ur.T_parent_joint[3]
    T = [*ur.T_parent_joint[:3], AXIS, np.linalg.inv(AXIS) @ wrist, *ur.T_parent_joint[4:]]
    on = ur.arm.link
    forearm = np.flatnonzero(on == 3)
    half = forearm[ur.arm.T_link_prim[forearm, 0, 3] < -0.19]
    assert 0 < len(half) < len(forearm)
    link = on + (on > 3)
    link[half] = 4
    T_link_prim = ur.arm.T_link_prim.copy()
    T_link_prim[half] = np.linalg.inv(AXIS) @ T_link_prim[half]

    def wider(x: np.ndarray, fourth: float) -> np.ndarray:
        return frozen(np.insert(x, 3, fourth, axis=0))

    def renumbered(pairs: np.ndarray) -> np.ndarray:
        return pairs + (pairs > 3)

    links = (*ur.links[:4], "forearm_turned", *ur.links[4:])
    names = tuple(f"{links[k]}_{np.sum(link[:i] == k)}" for i, k in enumerate(link))
    pairs = renumbered(ur.self_pairs).tolist()
    more = [sorted((4, b if a == 3 else a)) for a, b in pairs if 3 in (a, b)]
    more = [p for p in more if p[1] - p[0] > 1]
    own = ur.dynamics
    return replace(
        ur,
        name="seven",
        home_q=(*ur.home_q[:3], 0.0, *ur.home_q[3:]),
        links=links,
        joints=(*ur.joints[:3], "forearm_turn", *ur.joints[3:]),
        T_parent_joint=frozen(np.array(T)),
        lower=wider(ur.lower, -2.0),
        upper=wider(ur.upper, 2.0),
        max_velocity=wider(ur.max_velocity, np.pi),
        max_torque=wider(ur.max_torque, 28.0),
        dynamics=replace(
            own, mass=wider(own.mass, 0.5), com=wider(own.com, 0.0), inertia=wider(own.inertia, 0.0) + 1e-4 * np.eye(3),
            stiffness=wider(own.stiffness, 2000.0),
        ),
        arm=replace(ur.arm, names=names, link=frozen(link, np.int32), T_link_prim=frozen(T_link_prim)),
        self_pairs=frozen(np.array(pairs + more), np.int32),
        object_pairs=frozen(np.append(renumbered(ur.object_pairs), 4), np.int32),
        visuals="",
        digest="seven joints",
    )  # fmt: skip


def with_boxes(robot: Robot) -> Robot:
    """The same arm with a box about each primitive."""
    r, half = robot.arm.size[:, 0], robot.arm.size[:, 1] + robot.arm.size[:, 0] * (robot.arm.kind == ShapeKind.CAPSULE)
    size = np.where((robot.arm.kind == ShapeKind.BOX)[:, None], robot.arm.size, np.stack([r, r, half], 1))
    arm = replace(robot.arm, kind=frozen(np.full(len(size), ShapeKind.BOX), np.int32), size=frozen(size))
    return replace(robot, name=f"{robot.name}_boxes", arm=arm, digest=f"{robot.digest}, boxes", visuals="")


def with_hulls(robot: Robot) -> Robot:
    """The same arm with hulls in place of its primitives: a box's corners, twelve-sided prisms in cylinders and capsules."""
    around = np.arange(12) * np.pi / 6
    ring, corners = np.stack([np.cos(around), np.sin(around)], 1), []
    for kind, size in zip(robot.arm.kind, robot.arm.size, strict=True):
        if kind == ShapeKind.BOX:
            corners.append(np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3) * size)
        else:
            corners.append(np.concatenate([np.c_[size[0] * ring, np.full(12, s * size[1])] for s in (-1, 1)]))
    arm = replace(
        robot.arm, kind=frozen(np.full(len(corners), ShapeKind.HULL), np.int32), corners=tuple(map(frozen, corners)),
        size=frozen([hull_size(x) for x in corners]),
    )  # fmt: skip
    return replace(robot, name=f"{robot.name}_hulls", arm=arm, digest=f"{robot.digest}, hulls", visuals="")


def with_jaws(robot: Robot) -> Robot:
    """The same arm with a made gripper: a palm, and two jaws of two boxes, 0 to 80 mm apart. Its y is the flange's x."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    T_ee = T.copy()
    T_ee[2, 3] = 0.1
    rows = [("body", 0, (0.0, 0.0, 0.03), (0.03, 0.1, 0.03))]
    for side in (1, -1):
        rows.append(("finger", side, (0.0, side * 0.012, 0.075), (0.01, 0.012, 0.015)))
        rows.append(("pad", side, (0.0, side * 0.007, 0.1), (0.009, 0.007, 0.01)))
    place = np.tile(np.eye(4), (len(rows), 1, 1))
    place[:, :3, 3] = [at for *_, at, _ in rows]
    side = np.array([s for _, s, *_ in rows], np.int32)
    names = tuple(part_names([part for part, *_ in rows], side))
    return replace(
        robot, name=f"{robot.name}_jaws", digest=f"{robot.digest}, jaws", open_gap_m=0.08, T_flange_ee=frozen(T_ee),
        T_flange_gripper=frozen(T), gripper_part=tuple(part for part, *_ in rows),
        gripper_motion=table_motions(0 * side, side), gripper_side=frozen(side, np.int32),
        gripper=Primitives(
            names, frozen(np.full(len(rows), len(robot.joints) + 1), np.int32), frozen([ShapeKind.BOX] * len(rows), np.int32),
            frozen(place), frozen([half for *_, half in rows]),
        ),
        linkage=table_linkage(slide_table(0.0, 0.08), 0.0, 0.08, [0.009, 0.007, 0.01], 0.1, 1.05, 0.1),
    )  # fmt: skip


def with_table(robot: Robot, samples: int = 65) -> Robot:
    """A robot with the 2F-85, whose linkage is sampled into a table."""
    link, rows = robot.linkage, ("pin", "driver", "inner_knuckle")
    tool = (np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee)[:3, 3]
    gaps = np.linspace(robot.closed_gap_m, robot.open_gap_m, samples)
    T = np.stack([finger_motion(robot, motion, 1, drive_from_gap(robot, gaps)) for motion in rows])
    moved = T[..., :3, :3] @ tool + T[..., :3, 3] - tool
    table = np.stack([moved[..., 1], moved[..., 2], np.arctan2(T[..., 2, 1], T[..., 1, 1])], -1)
    assert np.isclose(float(pad_center_z(robot, drive_from_gap(robot, robot.open_gap_m / 2))), tool[2], atol=1e-6)
    on_gripper = np.full(len(robot.gripper_part), len(robot.joints) + 1)
    parts = tuple(part if part in ("body", "pad") else "finger" for part in robot.gripper_part)
    return replace(
        robot, name=f"{robot.name}_table", digest=f"{robot.digest}, table of {samples}", visuals="",
        gripper_part=parts,
        gripper=replace(robot.gripper, names=tuple(part_names(parts, robot.gripper_side)), link=frozen(on_gripper, np.int32)),
        gripper_motion=tuple(f"table_{rows.index(m)}" if m != "fixed" else m for m in robot.gripper_motion),
        linkage=table_linkage(
            table, robot.closed_gap_m, robot.open_gap_m, link.pad_half_size, tool[2], link.mass_kg, 0.07
        ),
    )  # fmt: skip
