"""A robot out of a URDF: the arm's chain and masses, collision bodies fitted to its visual meshes,
the pairs of links that are checked, a posture to start from.

The arm is of a UR's structure, which has a closed form for its inverse kinematics. The gripper is
the 2F-85. Each link of a UR has the shape of the UR5e's at another length, so the search for its
primitives starts from the UR5e's, stretched to the box of the mesh.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from r2h_batch.bodies.robot import (
    DEFAULT_ROBOT,
    JOINTS,
    Kind,
    Primitives,
    Robot,
    check_robot,
    ee_pose,
    frozen,
    load_robot,
    robot_file,
    ur_lengths,
)
from r2h_batch.bodies.robot_visuals import ARM_LINKS, visual_triangles
from r2h_batch.importers.robot_fit import (
    ARM_STEP_M,
    Shape,
    box_of,
    fit,
    mouths_for,
    recipe_for,
    split_longest,
    target,
)
from r2h_batch.importers.robot_pairs import contact_rates
from r2h_batch.importers.urdf import Chain, Link, read_chain
from r2h_batch.io.read import FileError, printable

__all__ = ["import_robot"]

Array = NDArray[np.float64]

MOST_OVERSHOOT_MM = 3.0
"""Mean distance from a link's bodies to its mesh above which it gets one body more."""
NEAR_M = 0.010
"""Links that never touch and never come this near are not checked against each other."""
DENSE_JOINTS = 2
"""Joints between two links up to which random postures lie close enough to each other to say so."""
POSTURES = 8000
"""Random postures in which links are looked for in contact."""
SMALL_EFFORT_NM, STIFF, SOFT = 40.0, 10_000.0, 2_000.0
"""Servos below this effort are soft, N m/rad: the UR5e's rule [choice]."""


def import_robot(
    path: Path,
    *,
    name: str,
    base: str,
    flange: str,
    packages: Mapping[str, Path],
    visuals: str = "",
) -> tuple[Robot, dict[str, Any]]:
    """A robot with a 2F-85 at its flange, and the figures of its import.

    Args:
        path: the URDF.
        name: of the robot, in rows and tables.
        base: the link that stands on the table.
        flange: the link that carries the gripper.
        packages: folder of each `package://NAME/`.
        visuals: the arm of airo-models whose meshes show it.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    chain, shown = read_chain(path, base, flange, packages), printable(path)
    if len(chain.joints) != len(ARM_LINKS) - 1:
        raise FileError(f"{shown}: {len(chain.joints)} joints move {flange}; arms of 6 are allowed")
    bare = replace(
        load_robot(DEFAULT_ROBOT),
        name=name,
        visuals=visuals,
        joints=chain.joints,
        T_parent_joint=frozen(chain.T_parent_joint),
        T_wrist3_flange=frozen(chain.T_last_flange),
        lower=frozen(chain.lower),
        upper=frozen(chain.upper),
        max_velocity=frozen(chain.velocity),
        max_torque=frozen(chain.effort),
        digest=f"{name}, being imported",
    )
    try:
        ur_lengths(bare)
    except ValueError as error:
        raise FileError(f"{shown}: {error}; arms of a UR's structure are allowed") from None
    try:  # before the minutes that fitting takes
        robot_file(bare)
        check_robot(
            replace(
                bare,
                lower=np.minimum(bare.lower, bare.home_q),
                upper=np.maximum(bare.upper, bare.home_q),
            )
        )
    except ValueError as error:
        raise FileError(f"{shown}: {' '.join(str(error).split())[:200]}") from None
    arm, links = _primitives(chain.links)
    robot = replace(bare, arm=arm, dynamics=_dynamics(chain, bare, shown), home_q=_home(bare))
    pairs = _checked_pairs(robot)
    checked = [[robot.links.index(x) for x in pair] for pair, say in pairs.items() if say[0]]
    robot = replace(robot, self_pairs=frozen(checked, np.int32), digest=f"{name}, with pairs")
    report = {
        "links": links,
        "pairs": {f"{a} - {b}": says for (a, b), (_, says) in pairs.items()},
        "home_rad": list(robot.home_q),
        "reach_m": robot.reach_m,
    }
    return robot, report


def _primitives(links: tuple[Link, ...]) -> tuple[Primitives, dict[str, Any]]:
    """The arm's bodies, and each link's figures."""
    shapes: list[tuple[int, Shape]] = []
    report = {}
    for k, (link, like) in enumerate(zip(links, ARM_LINKS, strict=True)):
        own, other = box_of(visual_triangles(like)), box_of(link.triangles)
        mesh = target(link.triangles, mouths_for(like, own, other))
        recipe = recipe_for(like, own, other)
        found = fit(recipe, mesh, ARM_STEP_M)
        report[like] = mesh.report(found)
        if report[like]["mean_mm"] > MOST_OVERSHOOT_MM:
            found = fit(split_longest(recipe), mesh, ARM_STEP_M)
            report[like] = mesh.report(found)
        shapes += [(k, s) for s in found]
    T, size = np.tile(np.eye(4), (len(shapes), 1, 1)), np.zeros((len(shapes), 3))
    for i, (_, s) in enumerate(shapes):
        T[i, :3, :3], T[i, :3, 3], size[i, : len(s.size)] = s.R, s.pos, s.size
    where = [k for k, _ in shapes]
    names = [f"{ARM_LINKS[k]}_{where[:i].count(k)}" for i, k in enumerate(where)]
    kind = [Kind[s.kind.upper()] for _, s in shapes]
    arm = Primitives(
        tuple(names), frozen(where, np.int32), frozen(kind, np.int32), frozen(T), frozen(size)
    )
    return arm, report


def _dynamics(chain: Chain, robot: Robot, shown: str) -> Any:
    """Masses from the URDF; servos by the UR5e's rule."""
    moving = chain.links[1:]
    for link in moving:
        moments = np.linalg.eigvalsh(link.inertia)
        if link.mass <= 0 or moments[0] <= 0 or moments[2] > 1.001 * (moments[0] + moments[1]):
            what = f"mass {link.mass:g} kg, moments {moments} kg m^2"
            raise FileError(f"{shown}: link {printable(link.name)} is no body: {what}")
    return replace(
        robot.dynamics,
        mass=frozen([link.mass for link in moving]),
        com=frozen([link.com for link in moving]),
        inertia=frozen([link.inertia for link in moving]),
        stiffness=frozen(np.where(chain.effort < SMALL_EFFORT_NM, SOFT, STIFF)),
    )


def _home(robot: Robot) -> tuple[float, ...]:
    """The UR5e's posture at the start with the TCP moved in and down, or out and up, as the reach
    differs; the gripper points straight down."""
    usual = load_robot(DEFAULT_ROBOT)
    goal = ee_pose(usual, usual.home_q)
    goal[:3, 3] *= robot.reach_m / usual.reach_m

    def off(q: Array) -> Array:
        return np.asarray((ee_pose(robot, q) - goal)[:3].ravel())

    found = least_squares(off, usual.home_q, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    if np.abs(off(found.x)).max() > 1e-6:
        raise FileError(
            f"{robot.name}: no posture puts the gripper where trials start, the UR5e's place times the ratio of the reaches"
        )
    return tuple(np.round(found.x, 4).tolist())


def _checked_pairs(robot: Robot) -> dict[tuple[str, str], tuple[bool, str]]:
    """Whether each pair of links is checked, and why."""
    found = {}
    for (a, b), (rate, nearest) in contact_rates(robot, POSTURES).items():
        first, last = robot.links.index(a), robot.links.index(b)
        joints = min(last, JOINTS) - first
        if last - first == 1:
            found[a, b] = False, "neighbours"
        elif rate == 1:
            found[a, b] = False, "always in contact"
        elif rate == 0 and nearest > NEAR_M and joints <= DENSE_JOINTS:
            found[a, b] = False, f"never nearer than {1e3 * nearest:.0f} mm"
        else:
            found[a, b] = True, f"in contact in {100 * rate:.1f} % of postures"
    return found
