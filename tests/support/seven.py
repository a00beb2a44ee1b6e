"""A made arm of seven joints: the UR5e with one more joint in its forearm, about the forearm's axis."""

from dataclasses import replace

import numpy as np

from r2h_batch.bodies.robot import Robot, frozen, load_robot

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

    pairs = renumbered(ur.self_pairs).tolist()
    more = [sorted((4, b if a == 3 else a)) for a, b in pairs if 3 in (a, b)]
    more = [p for p in more if p[1] - p[0] > 1]
    own = ur.dynamics
    return replace(
        ur,
        name="seven",
        home_q=(*ur.home_q[:3], 0.0, *ur.home_q[3:]),
        links=(*ur.links[:4], "forearm_turned", *ur.links[4:]),
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
        arm=replace(ur.arm, link=frozen(link, np.int32), T_link_prim=frozen(T_link_prim)),
        self_pairs=frozen(np.array(pairs + more), np.int32),
        object_pairs=frozen(np.append(renumbered(ur.object_pairs), 4), np.int32),
        visuals="",
        digest="seven joints",
    )  # fmt: skip
