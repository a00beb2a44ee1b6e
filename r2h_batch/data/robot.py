"""A robot out of a URDF or MJCF: the arm's chain and masses, collision bodies fitted to its visual meshes,
the pairs of links that are checked, a posture to start from.

The gripper is the 2F-85, or that of the same URDF.
"""

import re
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.config import Workplace
from r2h_batch.data.robot_bodies import bodies_of
from r2h_batch.data.robot_chain import (
    HELD_KG,
    LEAST_NM,
    Box,
    Chain,
    Fingers,
    Part,
    at_flange,
    read_chain,
    read_fingers,
)
from r2h_batch.data.robot_home import (
    NO_TURN,
    check_clear_of_table,
    first_home,
    free_home,
    homes,
    no_home,
    turn_of,
    turned,
)
from r2h_batch.data.robot_links import Link, Meshes, check_meshes, files_of, link_of
from r2h_batch.data.robot_masses import FLAT_M, check_masses, dynamics_of, weighed
from r2h_batch.data.robot_model import Geom, read_model
from r2h_batch.data.robot_pads import Window, find_pads
from r2h_batch.data.robot_pairs import Touching, checked_pairs, contact_rates, touching
from r2h_batch.data.robot_shapes import (
    BOX,
    CAPSULE,
    Hull,
    Shape,
    Target,
    box_of,
    boxes_of,
    mouths_for,
)
from r2h_batch.data.robot_srdf import compared, home_of, read_srdf
from r2h_batch.scene.robot import (
    Primitives,
    Robot,
    ShapeKind,
    frozen,
    hull_size,
    slide_table,
    table_linkage,
    table_motions,
)
from r2h_batch.scene.robot_file import (
    DEFAULT_ROBOT,
    MAX_BODIES,
    check_robot,
    load_robot,
    part_names,
    robot_file,
)
from r2h_batch.scene.robot_visuals import ARM_LINKS, visual_triangles

__all__ = ["gripper_of", "import_robot"]

Array = NDArray[np.float64]

LEAST_JOINTS, MOST_JOINTS = 6, 7
"""Number of an arm's joints: the kernels take any number, these have been tried."""
PALM_BOXES = 8
"""Most boxes of an imported gripper's palm: no hulls, as closing needs the depth of overlaps."""
FINGER_BOXES, MAX_PARTS = 3, 31
"""Most boxes of a finger's mesh, and most parts of a whole gripper, as the kernels hold them."""
TABLE_SAMPLES = 65
"""Gaps at which the fingers' places are stored."""
SYMMETRIC_M, PARALLEL_RAD = 1e-4, 5e-3
"""By how much the fingers may close differently, and the pads turn."""
MOST_TURN_RAD = np.radians(2.0)
"""By how much the pads of a linkage may turn that is parallel in the data sheet and not quite in the file."""
BALL_M = 1e-3
"""Radius of a last link of which the file shows nothing: the gripper hides it."""
BONE_M = 1e-3
"""Radius of the rods that stand for the links before their meshes are read."""
POSTURES = 8000
"""Random postures in which links are looked for in contact."""


class Imported(NamedTuple):
    """A robot, the figures of its import, and what the file shows of it."""

    robot: Robot
    report: dict[str, Any]
    seen: tuple[Array, ...]
    """triangles (F, 3, 3) of each link in its frame; of the file's own gripper, open, in the flange's"""


def import_robot(
    path: Path,
    *,
    name: str,
    base: str,
    flange: str,
    packages: Mapping[str, Path],
    fingers: tuple[str, str] | None = None,
    visuals: str = "",
    srdf: Path | None = None,
    home: Sequence[float] | str = (),
    offset: Array | None = None,
    pads: Window | None = None,
    turn: bool = False,
    folders: Sequence[Path] = (),
) -> Imported:
    """A robot with a gripper at its flange, and the figures of its import.

    Args:
        path: the URDF or MJCF.
        name: of the robot, in rows and tables.
        base: the link that stands on the table.
        flange: the link or site that carries the gripper.
        packages: folder of each `package://NAME/`.
        fingers: the two links of the URDF's own gripper that grasp; None: a 2F-85.
        visuals: the arm of airo-models whose meshes show it.
        srdf: the file whose pairs are compared with those that are checked.
        home: the posture at the start, rad, or the name of a state of the SRDF; by default it is chosen.
        offset: (4, 4) the flange in the frame of that link or site; None: there.
        pads: where the pads are on the meshes of the fingers; None: boxes of the file, or flats that are found.
        turn: turn a flange whose z does not point away from the arm, where no `offset` is given.
        folders: where meshes and includes may lie besides the file's folder and those of `packages`.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    read = None if srdf is None else read_srdf(srdf)
    model = read_model(path, [*packages.values(), *folders])
    own = fingers is not None
    flange_given = flange
    model, flange = at_flange(model, flange, np.eye(4) if offset is None else offset, bare=own)
    chain = read_chain(model, base, flange, bare=own)
    shown, n = model.shown, len(chain.joints)
    if not LEAST_JOINTS <= n <= MOST_JOINTS:
        raise FileError(
            f"{shown}: {n} joints move {flange}; allowed are {LEAST_JOINTS} or {MOST_JOINTS}"
        )
    for k in (0, n):  # of others something is missing
        if chain.links[k].geoms:
            continue
        name_of, how = printable(chain.links[k].name), "it collides as a ball of 1 mm at its joint"
        warnings.warn(f"{shown}: the file shows nothing of link {name_of}: {how}", stacklevel=2)
        ball = Geom("sphere", np.array([BALL_M, 0.0, 0.0]), np.eye(4), seen=True)
        balls = [replace(x, geoms=(ball,)) if i == k else x for i, x in enumerate(chain.links)]
        chain = replace(chain, links=tuple(balls))
    if chain.assumed:
        what = f"{shown}: no torque limit of {printable(', '.join(chain.assumed))[:120]}"
        how = f"twice what holds the stretched arm with {HELD_KG:g} kg, at least {LEAST_NM:g} N m"
        warnings.warn(f"{what}: {how}; edit max_torque_nm of robot.yaml", stacklevel=2)
    start = home_of(read, home, chain.joints) if isinstance(home, str) else tuple(home)
    if start and len(start) != n:
        raise FileError(f"--home has {len(start)} numbers; {shown} has {n} joints")
    if start and not ((chain.lower <= start) & (start <= chain.upper)).all():
        raise FileError(f"{shown}: home {list(start)} rad is outside the joint limits")
    bare = replace(
        load_robot(DEFAULT_ROBOT),
        name=name,
        visuals=visuals,
        joints=tuple(map(_word, chain.joints)),
        T_parent_joint=frozen(chain.T_parent_joint),
        T_wrist3_flange=frozen(chain.T_last_flange),
        lower=frozen(chain.lower),
        upper=frozen(chain.upper),
        max_velocity=frozen(chain.velocity),
        max_torque=frozen(chain.effort),
        digest=f"{name}, being imported",
    )
    chain = check_masses(chain, shown)
    names: tuple[str, ...] = tuple(_word(part.name) for part in chain.links)
    named = _with_links(bare, names)
    table = Workplace().scaled(named.reach_m / load_robot(DEFAULT_ROBOT).reach_m)
    check_clear_of_table(_bones(named), table, shown)  # before any search for a posture
    if offset is None and (way := _turn(bare, chain, names, start, shown)):
        across = f"{shown}: the z of --flange {printable(flange)} does not point away from the arm"
        if not turn:
            how = f"--offset={way} turns it there, --yes takes that, --offset={NO_TURN} keeps it"
            raise FileError(f"{across}: {how}")
        LOG.info(f"{across}: taken with --offset={way}")
        again = import_robot(
            path, name=name, base=base, flange=flange_given, packages=packages, fingers=fingers, visuals=visuals,
            srdf=srdf, home=home, offset=turned(way), pads=pads, folders=folders,
        )  # fmt: skip
        return again._replace(report=again.report | {"offset": way})
    hand = None if fingers is None else read_fingers(model, flange, fingers)
    parts = chain.links if hand is None else (*chain.links, hand.palm)
    moving = () if hand is None else hand.parts
    meshed = [p for p in moving if not p.boxes or (pads is not None and p.name in (fingers or ()))]
    check_meshes(parts, meshed, shown)
    geoms = [*(g for part in parts for g in files_of(part)), *(g for p in meshed for g in p.shown)]
    meshes = Meshes(model, geoms, packages)
    links = [link_of(part, meshes) for part in chain.links]
    chain, got = weighed(chain, links, shown)
    bare = replace(bare, dynamics=dynamics_of(chain, bare), max_torque=frozen(chain.effort))
    palm: dict[str, Any] = {}
    told: dict[str, Any] = {}
    if fingers is not None and hand is not None:
        gripper, palm, told = gripper_of(hand, fingers, n, meshes, pads)
        bare = replace(bare, **gripper)
    mouths: list[list[Array]] = [[]] * (n + 1)
    if bare.family == "ur":
        usual = np.array(bare.home_q)  # before the minutes that fitting takes
        lower, upper = np.minimum(bare.lower, usual), np.maximum(bare.upper, usual)
        _check(replace(bare, lower=lower, upper=upper), shown)
        names = ARM_LINKS
        # what the next links close in the sleeves: those of the UR5e at other lengths
        mouths = [
            mouths_for(like, box_of(visual_triangles(like)), box_of(link.triangles))
            for link, like in zip(links, names, strict=True)
        ]
    else:
        bare = _with_links(bare, names)
    first_q = start or first_home(bare, shown)  # before the minutes that fitting takes
    if bare.family != "ur":
        _check(replace(_bones(bare), home_q=first_q), shown)
    if not start:
        free_home(_bones(bare), table, shown, [link.triangles for link in links])
        _check_wrist(bare, links, mouths, table, shown)
    hulls: list[Shape | Hull] = []
    where: list[int] = []
    rows: dict[str, Any] = {}
    for k, link in enumerate(links):
        LOG.info(f"{name}: link {k + 1} of {n + 1}: {printable(link.name)}")
        began = time.perf_counter()
        found, row = bodies_of(link, mouths[k], MAX_BODIES - len(hulls) - (n - k))
        rows[names[k]] = row
        took = f"overshoot {row['mean_mm']:.1f} mm, {time.perf_counter() - began:.1f} s"
        LOG.info(f"{name}: link {k + 1} of {n + 1}: {len(found)} bodies, {took}")
        hulls, where = [*hulls, *found], [*where, *[k] * len(found)]
    numbered = [f"{names[k]}_{where[:i].count(k)}" for i, k in enumerate(where)]
    arm = _primitives_of(hulls, where, numbered)
    robot = replace(bare, arm=arm, home_q=first_q)
    pairs = checked_pairs(robot, POSTURES)
    checked = [[robot.links.index(x) for x in pair] for pair, say in pairs.items() if say[0]]
    robot = replace(robot, self_pairs=frozen(checked, np.int32), digest=f"{name}, with pairs")
    if not start:
        robot = replace(robot, home_q=free_home(robot, table, shown))
    elif met := touching(robot, np.array(robot.home_q), table):
        how = "give another posture with --home, or none: one is looked for"
        raise FileError(f"{shown}: {', '.join(met)} overlap at {list(robot.home_q)} rad; {how}")
    _check(robot, shown)
    of_joints = (robot.lower, robot.upper, robot.max_velocity, robot.max_torque)
    report = {
        "links": rows | palm,
        "pairs": {f"{a} - {b}": says for (a, b), (_, says) in pairs.items()},
        "home_rad": list(robot.home_q),
        "inverse_kinematics": robot.family,
        "reach_m": robot.reach_m,
        "joints": {
            joint: {"lower_rad": a, "upper_rad": b, "speed_rad_s": v, "torque_nm": t}
            for joint, a, b, v, t in zip(
                chain.joints, *map(np.ndarray.tolist, of_joints), strict=True
            )
        },
    }
    if told:
        report["pads"] = told
    if chain.assumed:
        report["assumed_torque"] = list(chain.assumed)
    if chain.assumed_speed:
        report["assumed_speed"] = list(chain.assumed_speed)
    if got:
        report["assumed_mass_kg"] = {names[k]: chain.links[k].mass for k in got}
    if read is not None:
        report["srdf"] = compared(read, chain, robot.links, pairs) | {"states": sorted(read.states)}
    seen = [link.triangles for link in links]
    if hand is not None:
        seen.append(_opened(hand, {p.name for p in meshed}, meshes))
    return Imported(robot, report, tuple(seen))


def _turn(
    bare: Robot, chain: Chain, names: tuple[str, ...], start: tuple[float, ...], shown: str
) -> str:
    """The `--offset` that the flange needs; "": none, or none helps. With the gripper that a robot has by default."""
    bare = _with_links(bare, names)
    none = not start and next(homes(bare), None) is None
    way = turn_of(bare, chain, any_way=none)
    if none and not way:
        raise no_home(bare, shown)
    return way


def _with_links(bare: Robot, names: tuple[str, ...]) -> Robot:
    """The robot with an arm of these links; a UR's are those that it has by default."""
    if bare.family == "ur":
        return bare
    every = frozen(np.arange(len(names)), np.int32)
    return replace(bare, links=(*names, bare.links[-1]), object_pairs=every)


def _bones(robot: Robot) -> Robot:
    """The arm as thin rods from joint to joint, of which the table alone is asked for: what its links cannot keep clear
    of, no body can."""
    found = _rods(robot)
    where = range(len(found))
    arm = _primitives_of(found, [*where], [f"rod_{k}" for k in where])
    none = frozen(np.zeros((0, 2)), np.int32)
    return replace(robot, arm=arm, self_pairs=none, digest=f"{robot.digest}, rods")


def _rods(robot: Robot) -> list[Shape | Hull]:
    """A rod of each link, from its joint to the next or to the flange."""
    found: list[Shape | Hull] = []
    for T in (*robot.T_parent_joint, robot.T_wrist3_flange):
        way = T[:3, 3]
        length = float(np.linalg.norm(way))
        z = way / length if length > BONE_M else np.array([0.0, 0.0, 1.0])
        x = np.linalg.svd(z[None])[2][1]
        R = np.stack([x, np.cross(z, x), z], 1)
        found.append(Shape(CAPSULE, way / 2, R, np.array([BONE_M, max(length / 2, 1e-4)])))
    return found


def _check_wrist(
    bare: Robot, links: Sequence[Link], mouths: Sequence[list[Array]], table: Workplace, shown: str
) -> None:
    """Refuse an arm of which one link meets the gripper in each posture to start from. Only links whose convex hulls do so
    are fitted for it, so this is said before the minutes that fitting all takes.

    Raises:
        FileError: it names the pair, as `free_home` does.
    """
    n, gripper = len(links) - 1, len(bare.links) - 1
    rods = _rods(bare)

    def alone(found: Mapping[int, Sequence[Shape | Hull]]) -> Robot:
        """The robot with bodies of some links, of which the gripper alone is asked for, and rods in place of the others."""
        every = [found.get(k, [rod]) for k, rod in enumerate(rods)]
        where = [k for k, bodies in enumerate(every) for _ in bodies]
        names = [f"{bare.links[k]}_{i}" for i, k in enumerate(where)]
        arm = _primitives_of([body for bodies in every for body in bodies], where, names)
        pairs = frozen([(k, gripper) for k in found], np.int32)
        return replace(
            bare, arm=arm, self_pairs=pairs, digest=f"{bare.digest}, wrist of {[*found]}"
        )

    corners = [link.triangles.reshape(-1, 3) for link in links[:n]]
    solid = {
        k: [Hull(x[ConvexHull(x).vertices])]
        for k, x in enumerate(corners)
        if np.ptp(x, 0).min() > FLAT_M
    }
    look, near = Touching(alone(solid)), [*solid]
    for home in homes(bare):
        met = {pair.split(" and ")[0] for pair in look(np.array(home))}
        near = [k for k in near if bare.links[k] in met]
        if not near:
            return
    robot = alone({k: bodies_of(links[k], mouths[k], MAX_BODIES - n)[0] for k in near})
    rates = contact_rates(robot, POSTURES)
    apart = [(k, gripper) for k in near if rates[bare.links[k], bare.links[gripper]][0] < 1]
    if apart:  # a pair that always touches is not checked
        free_home(replace(robot, self_pairs=frozen(apart, np.int32)), table, shown)


def _word(name: str) -> str:
    """A name of the file as a robot file may hold it; pairs of links are named LINK/BODY."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:64]


def _check(robot: Robot, shown: str) -> None:
    """Refuses what no robot file may hold."""
    try:
        robot_file(robot)
        check_robot(robot)
    except ValueError as error:
        raise FileError(f"{shown}: {' '.join(str(error).split())[:200]}") from None


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
    kind = [ShapeKind[s.kind.upper()] for s in shapes]
    any_hull = any(map(len, corners))
    return Primitives(
        tuple(names), frozen(link, np.int32), frozen(kind, np.int32), frozen(T), frozen(size),
        tuple(corners) if any_hull else (),
    )  # fmt: skip


def gripper_of(
    fingers: Fingers,
    pads: tuple[str, str],
    joints: int,
    meshes: Meshes,
    window: Window | None = None,
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The fields of a `Robot` that its gripper fills, the palm's figures, and what to tell of the pads.

    z of the gripper is the flange's, +y the way in which one of the fingers opens. The box of a pad's
    link that reaches farthest along z is the pad, or the flat of its mesh that faces the other finger.

    Args:
        fingers: what the URDF has.
        pads: the two links that grasp.
        joints: of the arm.
        meshes: those of palm and fingers.
        window: where on the fingers' meshes the pads are, in place of the file's boxes.

    Raises:
        FileError: fingers that do not close symmetrically, with pads that stay parallel.
    """
    shown = meshes.shown
    named = [next(part for part in fingers.parts if part.name == pad) for pad in pads]
    way = [part.T[-1, :3, 3] - part.T[0, :3, 3] for part in named]
    opens = (way[0] - way[1]) / 2
    if opens[1] < -1e-6:  # the closed form of a UR wants the flange's axes
        named, opens = named[::-1], -opens
    if np.linalg.norm(opens) < 1e-3 or abs(opens[2]) > 1e-3 * np.linalg.norm(opens):
        raise FileError(f"{shown}: the two fingers must open apart, across the flange's z")
    y = np.array([opens[0], opens[1], 0.0]) / np.hypot(*opens[:2])
    T_flange_gripper = np.eye(4)
    T_flange_gripper[:3, :3] = np.stack([np.cross(y, [0.0, 0.0, 1.0]), y, [0.0, 0.0, 1.0]], 1)
    turned = link_of(fingers.palm, meshes).triangles @ T_flange_gripper[:3, :3]
    shapes = boxes_of(turned, PALM_BOXES)
    report = {fingers.palm.name: Target(turned, []).report(shapes)}
    moves = {p.name: T_flange_gripper.T @ p.T for p in fingers.parts}  # it only turns
    boxes = [_pad_boxes(one, moves[one.name]) for one in named]
    flats: dict[str, Box] = {}
    told: dict[str, Any] = {}
    if window is not None or not all(boxes):
        flats, told = _flats(named, moves, meshes, window)
        boxes = [[(moves[n] @ box.T, box.half)] for n, box in flats.items()]
    pad, faces, turned_by = [], [], 0.0
    for sign, found in zip((1, -1), boxes, strict=True):
        pad.append(max(found, key=lambda b: float(b[0][0, 2, 3] + b[1][2])))
        faces.append(sign * pad[-1][0][:, 1, 3] - pad[-1][1][1])
        turns = Rotation.from_matrix(pad[-1][0][0, :3, :3].T @ pad[-1][0][:, :3, :3]).magnitude()
        turned_by = max(turned_by, float(turns.max()))
    degrees = f"{np.degrees(turned_by):.1f} degrees as the gripper closes"
    if turned_by > MOST_TURN_RAD:
        raise FileError(f"{shown}: the pads turn by {degrees}; they must stay parallel")
    if turned_by > PARALLEL_RAD:
        told["turn"] = f"{degrees}: here they stay parallel"
    half, gap = pad[0][1], faces[0] + faces[1]
    heights = [p[0][:, 2, 3] for p in pad]
    uneven = max(np.abs(x[0] - x[1]).max() for x in (faces, heights))
    if uneven > SYMMETRIC_M or np.abs(half - pad[1][1]).max() > 1e-6:
        raise FileError(f"{shown}: the two pads must be mirror images, {1e3 * uneven:.2f} mm off")
    if (np.diff(gap) <= 0).any() or gap[-1] <= 0:
        raise FileError(f"{shown}: the pads do not come apart all the way as the gripper opens")
    closed, opened = max(float(gap[0]), 0.0), float(gap[-1])
    gaps = np.linspace(closed, opened, TABLE_SAMPLES)
    T_flange_ee = T_flange_gripper.copy()
    T_flange_ee[2, 3] = np.interp(opened / 2, gap, heights[0])
    tool = T_flange_ee[:3, 3]

    def row_of(part: str, sign: int) -> Array:
        """(TABLE_SAMPLES, 3) of the table, mirrored to the +y finger."""
        T = moves[part] @ np.linalg.inv(moves[part][0])
        shift = T[:, :3, :3] @ tool + T[:, :3, 3] - tool
        if max(np.abs(T[:, 0, 0] - 1).max(), np.abs(shift[:, 0]).max()) > SYMMETRIC_M:
            raise FileError(f"{shown}: {printable(part)} leaves the plane of the closing gripper")
        turn = np.unwrap(np.arctan2(T[:, 2, 1], T[:, 1, 1]))
        columns = (sign * shift[:, 1], shift[:, 2], sign * turn)
        return np.stack([np.interp(gaps, gap, x) for x in columns], 1)

    rows, used = [row_of(named[0].name, 1)], {(0, 1)}
    part, side, motion = ["body"] * len(shapes), [0] * len(shapes), [0] * len(shapes)
    room = (MAX_PARTS - len(shapes) - sum(len(p.boxes) for p in fingers.parts)) // max(
        sum(bool(p.shown) and not p.boxes for p in fingers.parts), 1
    )
    mass = {1: 0.0, -1: 0.0}
    for p in fingers.parts:
        if not p.boxes and not p.shown:
            continue
        bodies = list(p.boxes) or [
            Box(_frame(s), s.size)
            for s in _close_boxes(
                np.concatenate([meshes.triangles(g) for g in p.shown]), min(room, FINGER_BOXES)
            )
        ]
        bodies += [flats[p.name]] if p.name in flats else []
        placed = [(moves[p.name][0] @ T, h) for T, h in bodies]
        sign = 1 if np.mean([(moves[p.name][-1] @ T)[1, 3] for T, _ in bodies]) > 0 else -1
        mass[sign] += p.mass
        moved = row_of(p.name, sign)
        k = next(
            (i for i, r in enumerate(rows) if np.abs(r - moved).max() < SYMMETRIC_M), len(rows)
        )
        rows += [moved] if k == len(rows) else []
        used.add((k, sign))
        for i, (T, h) in enumerate(placed):
            # of the rows the first alone moves as the gap does; where the pads meet it is 0
            at = T[:3, 3] - [0.0, sign * gap[0] / 2 if k == 0 else 0.0, 0.0]
            shapes.append(Shape(BOX, at, T[:3, :3], h))
            here = next((x for n, x in zip(named, pad, strict=True) if n is p), None)
            whose = here is not None and np.allclose(here[0][0], moves[p.name][0] @ bodies[i][0])
            part.append("pad" if whose else "finger")
            side.append(sign)
            motion.append(k)
    if {k for k, s in used if s == 1} != {k for k, s in used if s == -1}:
        raise FileError(f"{shown}: the two fingers must close symmetrically, part by part")
    rows[0] = (rows[0] + [gap[0] / 2, 0.0, 0.0]) * [1.0, 1.0, turned_by <= PARALLEL_RAD]
    if not np.isclose(mass[1], mass[-1], rtol=1e-3) or mass[1] <= 0:
        what = f"{mass[1]:g} and {mass[-1]:g} kg"
        raise FileError(f"{shown}: the gripper's fingers have {what}; they need equal masses")
    table, slides = np.array(rows), slide_table(closed, opened)
    if (
        len(rows) == 1
        and np.abs(table[0] - np.linspace(slides[0, 0], slides[0, 1], TABLE_SAMPLES)).max() < 1e-6
    ):
        table = slides
    return {
        "open_gap_m": opened,
        "T_flange_ee": frozen(T_flange_ee),
        "T_flange_gripper": frozen(T_flange_gripper),
        "gripper": _primitives_of(shapes, [joints + 1] * len(shapes), part_names(part, side)),
        "gripper_part": tuple(part),
        "gripper_motion": table_motions(motion, side),
        "gripper_side": frozen(side, np.int32),
        "linkage": table_linkage(
            table, closed, opened, half, T_flange_ee[2, 3], fingers.palm.mass + 2 * mass[1], mass[1]
        ),
    }, report, told  # fmt: skip


def _opened(hand: Fingers, meshed: set[str], meshes: Meshes) -> Array:
    """Triangles (F, 3, 3) of an open gripper, flange frame: its meshes, and boxes of parts without."""
    found = [link_of(hand.palm, meshes).triangles]
    for part in hand.parts:
        T = part.T[-1]
        own = [meshes.triangles(g) for g in part.shown] if part.name in meshed else [
            Shape(BOX, b.T[:3, 3], b.T[:3, :3], b.half).triangles() for b in part.boxes
        ]  # fmt: skip
        found += [x @ T[:3, :3].T + T[:3, 3] for x in own]
    return np.concatenate(found)


def _pad_boxes(one: Part, T: Array) -> list[tuple[Array, Array]]:
    """The boxes of a finger along the gripper's axes: frames (S, 4, 4) and half sides."""
    found = []
    for box in one.boxes:
        frames = T @ box.T
        R = frames[:, :3, :3]
        off = np.abs(R - R.round()).max((1, 2))
        if off.min() < 2e-3:
            best = R[int(off.argmin())].round()
            found.append((frames, np.abs(best) @ box.half))
    return found


def _flats(
    named: Sequence[Part], moves: Mapping[str, Array], meshes: Meshes, window: Window | None
) -> tuple[dict[str, Box], dict[str, Any]]:
    """The pads of two fingers as boxes in the fingers' frames, and what is told of them."""
    fingers = []
    for one in named:
        geoms = [g for g in one.shown if g.kind == "mesh"]
        if not geoms or (one.boxes and window is None):
            what = "needs a box along the gripper's axes, or a mesh and --pads"
            raise FileError(f"{meshes.shown}: {printable(one.name)} {what}")
        T = moves[one.name][0]
        triangles = np.concatenate([meshes.triangles(g) for g in geoms])
        fingers.append(triangles @ T[:3, :3].T + T[:3, 3])
    found = find_pads((fingers[0], fingers[1]), window, meshes.shown)
    boxes = {}
    for sign, one in zip((1, -1), named, strict=True):
        T = np.eye(4)
        T[:3, 3] = [0.0, sign * (found.face + found.half[1]), found.height]
        boxes[one.name] = Box(np.linalg.inv(moves[one.name][0]) @ T, found.half)
    low, high = found.height - found.half[2], found.height + found.half[2]
    row = {
        "from": "flats of the meshes" if window is None else "--pads",
        "low_m": float(low), "high_m": float(high), "width_m": float(2 * found.half[0]),
        "proud_mm": float(1e3 * found.proud),
    }  # fmt: skip
    return boxes, row


def _close_boxes(triangles: Array, most: int) -> list[Shape]:
    """Boxes that hold a finger's mesh, along the axes of its frame or along its own, whichever are
    smaller together."""
    points = triangles.reshape(-1, 3)
    own = np.linalg.svd(points - points.mean(0), full_matrices=False)[2].T
    own[:, 2] *= np.sign(np.linalg.det(own))
    found = []
    for R in (np.eye(3), own):
        boxes = boxes_of(triangles @ R, max(most, 1))
        turned = [replace(s, pos=R @ s.pos, R=R) for s in boxes]
        found.append((sum(float(np.prod(s.size)) for s in boxes), turned))
    return min(found, key=lambda x: x[0])[1]


def _frame(shape: Shape) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = shape.R, shape.pos
    return T
