"""A robot out of a URDF: the arm's chain and masses, collision bodies fitted to its visual meshes,
the pairs of links that are checked, a posture to start from.

The gripper is the 2F-85, or two jaws on slides of the same URDF.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import qmc

from r2h_batch.bodies.robot import (
    DEFAULT_ROBOT,
    MAX_BODIES,
    Kind,
    Linkage,
    Primitives,
    Robot,
    check_robot,
    ee_pose,
    frozen,
    hull_size,
    load_robot,
    part_names,
    robot_file,
)
from r2h_batch.bodies.robot_visuals import ARM_LINKS, visual_triangles
from r2h_batch.importers.robot_fit import (
    BOX,
    Shape,
    box_of,
    mouths_for,
    target,
)
from r2h_batch.importers.robot_hulls import Hull, boxes_of, fit_hulls
from r2h_batch.importers.robot_pairs import contact_rates, touching
from r2h_batch.importers.urdf import Chain, Jaws, Link, read_chain, read_jaws
from r2h_batch.io.read import FileError, printable

__all__ = ["import_robot"]

Array = NDArray[np.float64]

LEAST_JOINTS, MOST_JOINTS = 6, 7
"""Of an arm: the kernels take any number, these have been tried."""
MOST_OVERSHOOT_MM = 3.0
"""Mean distance from a link's bodies to its mesh above which it gets one body more."""
MOST_HULLS = 6
"""Of a link, as long as each link after it can have one of the bodies that the kernels hold."""
PALM_BOXES = 8
"""Of a gripper that is imported: no hulls, as closing it asks how deep its bodies are met."""
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
    fingers: tuple[str, str] | None = None,
    visuals: str = "",
) -> tuple[Robot, dict[str, Any]]:
    """A robot with a gripper at its flange, and the figures of its import.

    Args:
        path: the URDF.
        name: of the robot, in rows and tables.
        base: the link that stands on the table.
        flange: the link that carries the gripper.
        packages: folder of each `package://NAME/`.
        fingers: the links of the URDF's own gripper that slide apart; None: a 2F-85.
        visuals: the arm of airo-models whose meshes show it.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    chain = read_chain(path, base, flange, packages, bare=fingers is not None)
    shown, n = printable(path), len(chain.joints)
    if not LEAST_JOINTS <= n <= MOST_JOINTS:
        raise FileError(
            f"{shown}: {n} joints move {flange}; {LEAST_JOINTS} to {MOST_JOINTS} are allowed"
        )
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
    palm: dict[str, Any] = {}
    if fingers is not None:
        gripper, palm = _jaws(read_jaws(path, flange, fingers, packages), n, shown)
        bare = replace(bare, **gripper)
    names: tuple[str, ...] = tuple(part.name for part in chain.links)
    mouths: list[list[Array]] = [[]] * (n + 1)
    if bare.family == "ur":
        home = np.array(bare.home_q)  # before the minutes that fitting takes
        limits = {"lower": np.minimum(bare.lower, home), "upper": np.maximum(bare.upper, home)}
        _check(replace(bare, **limits), shown)
        names = ARM_LINKS
        mouths = [_mouths(*pair) for pair in zip(chain.links, names, strict=True)]
    else:
        bare = replace(
            bare,
            links=(*names, bare.links[-1]),
            object_pairs=frozen(np.arange(n + 1), np.int32),
        )
    hulls: list[Hull] = []
    where: list[int] = []
    links: dict[str, Any] = {}
    for k, link in enumerate(chain.links):
        found, links[names[k]] = _hulls(link, mouths[k], MAX_BODIES - len(hulls) - (n - k))
        hulls, where = [*hulls, *found], [*where, *[k] * len(found)]
    numbered = [f"{names[k]}_{where[:i].count(k)}" for i, k in enumerate(where)]
    arm = _primitives_of(hulls, where, numbered)
    bare = replace(bare, arm=arm, dynamics=_dynamics(chain, bare, shown))
    robot = replace(bare, home_q=_home(bare))
    pairs = _checked_pairs(robot)
    checked = [[robot.links.index(x) for x in pair] for pair, say in pairs.items() if say[0]]
    robot = replace(robot, self_pairs=frozen(checked, np.int32), digest=f"{name}, with pairs")
    if met := touching(robot, np.array(robot.home_q)):
        raise FileError(f"{shown}: {', '.join(met)} overlap at home, {list(robot.home_q)} rad")
    _check(robot, shown)
    report = {
        "links": links | palm,
        "pairs": {f"{a} - {b}": says for (a, b), (_, says) in pairs.items()},
        "home_rad": list(robot.home_q),
        "inverse_kinematics": robot.family,
        "reach_m": robot.reach_m,
    }
    return robot, report


def _check(robot: Robot, shown: str) -> None:
    """Refuses what no robot file may hold."""
    try:
        robot_file(robot)
        check_robot(robot)
    except ValueError as error:
        raise FileError(f"{shown}: {' '.join(str(error).split())[:200]}") from None


def _mouths(link: Link, like: str) -> list[Array]:
    """What the next links close in the sleeves of a UR's link, which are the UR5e's at other lengths."""
    return mouths_for(like, box_of(visual_triangles(like)), box_of(link.triangles))


def _hulls(link: Link, mouths: list[Array], most: int) -> tuple[list[Hull], dict[str, Any]]:
    """As few hulls of a link as overshoot it little enough, and its figures."""
    mesh = target(link.triangles, mouths)
    found = fit_hulls(
        mesh, lambda h: mesh.mean_overshoot_mm(h) < MOST_OVERSHOOT_MM, min(most, MOST_HULLS)
    )
    return found, mesh.report(found)


def _primitives_of(
    shapes: Sequence[Shape | Hull], link: Sequence[int], names: Sequence[str]
) -> Primitives:
    T, size = np.tile(np.eye(4), (len(shapes), 1, 1)), np.zeros((len(shapes), 3))
    corners = [np.zeros((0, 3))] * len(shapes)
    for i, s in enumerate(shapes):
        if isinstance(s, Hull):
            T[i, :3, :3], T[i, :3, 3] = s.frame()
            corners[i] = frozen((s.points - T[i, :3, 3]) @ T[i, :3, :3])
            size[i] = hull_size(corners[i])
        else:
            T[i, :3, :3], T[i, :3, 3], size[i, : len(s.size)] = s.R, s.pos, s.size
    kind = [Kind[s.kind.upper()] for s in shapes]
    any_hull = any(map(len, corners))
    return Primitives(
        tuple(names), frozen(link, np.int32), frozen(kind, np.int32), frozen(T), frozen(size),
        tuple(corners) if any_hull else (),
    )  # fmt: skip


def _jaws(jaws: Jaws, joints: int, shown: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The fields of a `Robot` that its gripper fills, and the palm's figures.

    z of the gripper is the flange's, +y the way in which the first jaw opens. The box of a jaw that
    reaches farthest along z is its pad.
    """
    y, z = jaws.opens[0], np.array([0.0, 0.0, 1.0])
    if abs(y @ z) > 1e-6:
        raise FileError(f"{shown}: the jaws must open across the flange's z")
    T_flange_gripper = np.eye(4)
    T_flange_gripper[:3, :3] = np.stack([np.cross(y, z), y, z], 1)
    turned = replace(jaws.palm, triangles=jaws.palm.triangles @ T_flange_gripper[:3, :3])
    shapes = boxes_of(turned.triangles, PALM_BOXES)
    report = {jaws.palm.name: target(turned.triangles, []).report(shapes)}
    part, side = ["body"] * len(shapes), [0] * len(shapes)
    faces, pads = [], []
    for sign, boxes in zip((1, -1), jaws.jaws, strict=True):
        placed = [(T_flange_gripper.T @ T, half) for T, half in boxes]  # it only turns
        square = [b for b in placed if np.abs(np.abs(b[0][:3, :3]) - np.eye(3)).max() < 1e-6]
        if not square:
            raise FileError(f"{shown}: a finger has no box along the gripper's axes for a pad")
        pad = max(square, key=lambda b: float(b[0][2, 3] + b[1][2]))
        pads.append(pad)
        faces.append(float(sign * pad[0][1, 3] - pad[1][1]))
        for T, half in placed:  # drive 0 has the pads' faces at y = 0
            at = T[:3, 3] - [0.0, sign * faces[-1], 0.0]
            shapes.append(Shape(BOX, at, T[:3, :3], half))
            part.append("pad" if T is pad[0] else "finger")
            side.append(sign)
    half, pad_z = pads[0][1], float(pads[0][0][2, 3])
    if abs(faces[0] - faces[1]) > 1e-4 or np.abs(half - pads[1][1]).max() > 1e-6:
        raise FileError(f"{shown}: the two pads must be mirror images")
    closed, opened = (max(2 * (travel + max(faces)), 0.0) for travel in jaws.travel)
    T_flange_ee = T_flange_gripper.copy()
    T_flange_ee[2, 3] = pad_z
    none = frozen(np.zeros(2))
    names = part_names(part, side)
    return {
        "open_gap_m": opened,
        "T_flange_ee": frozen(T_flange_ee),
        "T_flange_gripper": frozen(T_flange_gripper),
        "gripper": _primitives_of(shapes, [joints + 1] * len(shapes), names),
        "gripper_part": tuple(part),
        "gripper_motion": tuple("slide" if s else "fixed" for s in side),
        "gripper_side": frozen(side, np.int32),
        "linkage": Linkage(
            none, none, none, frozen([half[1], pad_z]), frozen(half), -opened / 2, -closed / 2,
            slide=True, mass_kg=jaws.palm.mass + 2 * jaws.mass, jaw_mass_kg=jaws.mass,
        ),
    }, report  # fmt: skip


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

    if robot.family != "ur":
        return _middle_home(robot, off)
    found = least_squares(off, usual.home_q, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    if np.abs(off(found.x)).max() > 1e-6:
        raise FileError(
            f"{robot.name}: no posture puts the gripper where trials start, the UR5e's place times the ratio of the reaches"
        )
    return tuple(np.round(found.x, 4).tolist())


def _middle_home(robot: Robot, off: Callable[[Array], Array]) -> tuple[float, ...]:
    """Of the postures that 64 starts lead to the one that is nearest to the middle of its limits."""
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    starts = qmc.Halton(len(lower), scramble=False).random(65)[1:]
    best, least = None, np.inf
    for start in lower + (upper - lower) * starts:
        found = least_squares(
            off, start, bounds=(lower - 1e-9, upper + 1e-9), xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        away = float(np.square((found.x - (lower + upper) / 2) / (upper - lower)).sum())
        if np.abs(off(found.x)).max() < 1e-6 and away < least:
            best, least = found.x, away
    if best is None:
        raise FileError(f"{robot.name}: no posture puts the gripper where trials start")
    return tuple(np.round(best, 4).tolist())


def _checked_pairs(robot: Robot) -> dict[tuple[str, str], tuple[bool, str]]:
    """Whether each pair of links is checked, and why."""
    found = {}
    for (a, b), (rate, nearest) in contact_rates(robot, POSTURES).items():
        first, last = robot.links.index(a), robot.links.index(b)
        joints = min(last, len(robot.joints)) - first
        if last - first == 1:
            found[a, b] = False, "neighbours"
        elif rate == 1:
            found[a, b] = False, "always in contact"
        elif rate == 0 and nearest > NEAR_M and joints <= DENSE_JOINTS:
            found[a, b] = False, f"never nearer than {1e3 * nearest:.0f} mm"
        else:
            found[a, b] = True, f"in contact in {100 * rate:.1f} % of postures"
    return found
