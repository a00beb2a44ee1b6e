"""The chain of joints of a robot's file between two links, and the fingers of its gripper."""

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.data.robot_model import Body, Geom, Joint, Loop, Model, moved

Array = NDArray[np.float64]

SAMPLES = 513
"""Samples of a gripper's way from closed to open."""
GRAVITY_M_S2, HELD_KG, LEAST_NM = 9.81, 2.0, 10.0
"""A joint without a limit of torque gets twice the torque that holds the stretched arm with this mass at its flange, and
at least the last of these [choice]."""
SPEED_RAD_S = 2.0
"""Speed limit of a joint whose file says none, as no MJCF does [choice]."""
LIMIT_TURNS, MOST_DEGREES = 4, 720.0
"""No joint turns farther; limits between the two are degrees, larger ones say that there is no limit [choice]."""
MOST_RAD_S, MOST_NM = 100.0, 1e5
"""Files write 1e9 where a joint has no limit. More than this limits no arm, so the file says no limit [choice]."""
MOST_TURNS = 60
CLOSED_M = 1e-4
"""By how much a loop of a gripper may stay open."""


class Box(NamedTuple):
    """A box that collides: its frame and its half sides."""

    T: Array
    half: Array


@dataclass(frozen=True)
class Rigid:
    """A rigid part: its own link and what is fixed to it, in the frame of the joint that moves it."""

    name: str
    geoms: tuple[Geom, ...]
    mass: float
    com: Array  # (3,)
    inertia: Array  # (3, 3) about com
    members: tuple[str, ...]
    """the links of the file that are this part"""


@dataclass(frozen=True)
class Part:
    """A link of a gripper that moves."""

    name: str
    boxes: tuple[Box, ...]
    """what it collides as, in its frame"""
    shown: tuple[Geom, ...]
    """the meshes that are seen of it, else those that it collides as"""
    mass: float
    T: Array
    """(SAMPLES, 4, 4) in the flange's frame, from closed to open in even steps of what drives it"""


@dataclass(frozen=True)
class Fingers:
    """A gripper: what stands still, flange frame, and what moves."""

    palm: Rigid
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class Chain:
    """N joints from base to flange, each about z of its frame, and the N + 1 rigid parts."""

    joints: tuple[str, ...]
    T_parent_joint: Array  # (N, 4, 4)
    T_last_flange: Array
    lower: Array  # (N,) rad
    upper: Array
    velocity: Array
    effort: Array
    links: tuple[Rigid, ...]
    beyond: frozenset[str]
    """the flange and the links of the file that it carries"""
    assumed: tuple[str, ...]
    """joints whose torque the file does not say"""
    assumed_speed: tuple[str, ...]
    """joints whose speed it does not say"""
    replaced: tuple[str, ...]
    """links that are left out, with what they carry: `grippers_at`"""


def at_flange(model: Model, name: str, offset: Array, *, bare: bool) -> tuple[Model, str]:
    """The file with a link of its own as the flange, and that link's name.

    Args:
        model: the robot's file.
        name: a link, or a site.
        offset: (4, 4) the flange in the frame of that link or site.
        bare: the gripper at the flange is the file's: it carries what the link carries.

    Raises:
        FileError: the file has no link or site of this name.
    """
    if name not in model.links and name not in model.sites:
        found = ", ".join(printable(n)[:40] for n in [*model.links, *model.sites][-12:])
        raise FileError(
            f"{model.shown}: --flange {printable(name)} is not a link or site; the last are {found}"
        )
    link, T = (name, np.eye(4)) if name in model.links else model.sites[name]
    T = T @ offset
    moves = model.links[link].joint is not None
    if name in model.links and np.array_equal(T, np.eye(4)) and not (bare and moves):
        return model, name
    own = f"flange at {name}"
    flange = Body(own, link, T, None, 0.0, np.zeros(3), np.zeros((3, 3)), ())
    links: dict[str, Body] = {}
    for body in model.links.values():
        if bare and body.parent == link:
            T_child = np.linalg.inv(T) @ body.T_parent
            body = replace(body, parent=own, T_parent=T_child)
        links[body.name] = body
        if body.name == link:
            links[own] = flange
    return replace(model, links=links), own


def read_chain(model: Model, base: str, flange: str, *, bare: bool = False) -> Chain:
    """The chain between two links.

    Args:
        model: the robot's file.
        base: the link that stands still.
        flange: the link that carries the gripper.
        bare: without what is fixed to the flange; else without a gripper of the file alone (`grippers_at`).

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    shown, links = model.shown, model.links
    for flag, name in (("--base", base), ("--flange", flange)):
        if name not in links:
            found = ", ".join(printable(n)[:40] for n in list(links)[:12])
            raise FileError(f"{shown}: {flag} {printable(name)} is not a link; it has {found}")
    way, at = [], flange
    while at != base:
        if not at:
            raise FileError(f"{shown}: no chain of joints leads from {base} to {flange}")
        way.append(links[at])
        at = links[at].parent
    way.reverse()
    moving, carried, back = [], [base], [np.eye(4)]
    T_before, frames = np.eye(4), []
    for link in way:
        T_before = T_before @ link.T_parent
        if link.joint is None:
            continue
        if link.joint.kind != "revolute" or link.joint.follows is not None:
            kind = link.joint.kind if link.joint.follows is None else "a mimic joint"
            what = f"{printable(link.joint.name)} is {kind}; the arm's joints must be revolute"
            raise FileError(f"{shown}: joint {what}")
        turn = _to_axis(link.joint)
        frames.append(T_before @ turn)
        T_before = turn.T
        moving.append(link.joint)
        carried.append(link.name)
        back.append(turn.T)
    replaced = [] if bare else grippers_at(model, carried[-1], flange)
    ends = {*carried, flange} if bare else {*carried, *replaced}
    if replaced:
        left_out = printable(", ".join(sorted(replaced)))[:120]
        how = "the 2F-85 replaces it; --fingers keeps it"
        warnings.warn(f"{shown}: without {left_out} and what it carries: {how}", stacklevel=2)
    parts = [_rigid(model, name, T, ends) for name, T in zip(carried, back, strict=True)]
    T_joints, T_flange = _exact(np.array(frames).reshape(-1, 4, 4)), _exact(T_before)
    low, high = np.array([_range(joint, shown) for joint in moving]).reshape(-1, 2).T
    said = [_speed(joint, shown) for joint in moving]
    speed = np.array([given or SPEED_RAD_S for given in said])
    effort = np.array([joint.effort for joint in moving])
    missing = (effort <= 0) | (effort > MOST_NM)
    effort = np.where(missing, holding_torque(T_joints, T_flange, parts), effort)
    beyond, todo = {flange}, [flange]
    while todo:
        new = {link.name for link in model.below(todo.pop())}
        beyond |= new
        todo += new
    return Chain(
        tuple(joint.name for joint in moving), T_joints, T_flange, low, high, speed, effort,
        tuple(parts), frozenset(beyond), tuple(j.name for j, no in zip(moving, missing, strict=True) if no),
        tuple(joint.name for joint, given in zip(moving, said, strict=True) if not given), tuple(replaced),
    )  # fmt: skip


def grippers_at(model: Model, last: str, flange: str) -> list[str]:
    """The file's own grippers at the end of an arm, which another one replaces: links that stand still beside the last moving
    link and carry joints, themselves or by what is fixed to them, but the flange and what lies before it."""
    before, at = {flange}, flange
    while at != last:
        at = model.links[at].parent
        before.add(at)

    def moves(link: Body) -> bool:
        return any(x.joint is not None or moves(x) for x in model.below(link.name))

    found = []
    for name in before:
        fixed = [
            link for link in model.below(name) if link.joint is None and link.name not in before
        ]
        found += [link.name for link in fixed if moves(link)]
    return found


def read_fingers(model: Model, flange: str, pads: tuple[str, str]) -> Fingers:
    """The gripper at a flange, moved from where the two `pads` are nearest to each other.

    Args:
        model: the robot's file.
        flange: the link that carries the gripper.
        pads: two links that grasp. A joint that mimics no other runs through its limits, others
            follow it.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    shown, links = model.shown, model.links
    below: dict[str, Body] = {}
    todo = [flange]
    while todo:
        new = {link.name: link for link in model.below(todo.pop(0))}
        below |= new
        todo += new
    moving = {link.joint.name: link.joint for link in below.values() if link.joint is not None}
    carried = {name for name, link in below.items() if link.joint is not None}
    carrier: dict[str, str] = {}  # the moving link that a link is fixed to, or is
    for name, link in below.items():
        carrier[name] = name if name in carried else carrier.get(link.parent, "")
    for pad in pads:
        if not carrier.get(pad):
            what = f"is not a link that a joint of the gripper at {flange} moves"
            raise FileError(f"{shown}: --fingers {printable(pad)} {what}")
    loops = [loop for loop in model.loops if set(loop.links) <= below.keys() | {flange}]
    passive = _passive(loops, below, shown)
    roots = sorted({_root(joint, moving, shown)[0] for joint in moving.values()} - set(passive))
    if len(roots) > 2:
        raise FileError(
            f"{shown}: {len(roots)} joints of the gripper move by themselves ({printable(', '.join(roots))[:80]});"
            " one, or one of each finger, is allowed, the others mimic them"
        )

    def placed(opened: Mapping[str, Array]) -> dict[str, Array]:
        """Frames (S, 4, 4) of all links with these joints at positions (S,)."""
        frames = {flange: np.tile(np.eye(4), (SAMPLES, 1, 1))}
        for name, link in below.items():
            T = frames[link.parent] @ link.T_parent
            if link.joint is not None:
                root, factor, offset = _root(link.joint, moving, shown)
                T = T @ moved(link.joint, factor * opened[root] + offset)
            frames[name] = T
        return frames

    def closing(opened: Mapping[str, Array]) -> dict[str, Array]:
        """The frames in which the loops are closed."""
        joints = [moving[name] for name in passive]
        solved = (
            opened if not loops else {**opened, **_closed(joints, loops, opened, placed, shown)}
        )
        return placed(solved)

    ends = {name: np.linspace(*_range(moving[name], shown), SAMPLES) for name in roots}
    ways = []
    for turns in itertools.product((1, -1), repeat=max(len(roots) - 1, 0)):
        one = closing({n: ends[n][::t] for n, t in zip(roots, (1, *turns), strict=True)})
        ways += [one, {n: T[::-1] for n, T in one.items()}]
    middle = [np.mean([b.T[:3, 3] for b in _boxes(links[pad])] or [np.zeros(3)], 0) for pad in pads]

    def apart(frames: Mapping[str, Array], at: int) -> float:
        one, two = (
            frames[pad][at, :3, :3] @ x + frames[pad][at, :3, 3]
            for pad, x in zip(pads, middle, strict=True)
        )
        return float(np.linalg.norm(one - two))

    frames = max(ways, key=lambda f: apart(f, -1))
    palm = _rigid(model, flange, np.eye(4), carried)
    parts: list[Part] = []
    for name, link in below.items():
        if not carrier[name]:
            continue
        boxes = _boxes(link)
        meshes = [g for g in link.geoms if g.file]
        shown_as = tuple([g for g in meshes if g.seen] or meshes)
        if not boxes and not shown_as and (name in pads or not all(g.seen for g in link.geoms)):
            what = "has neither boxes to collide nor a mesh"
            raise FileError(f"{shown}: {printable(name)} of the gripper {what}")
        parts.append(Part(name, boxes, shown_as, link.mass, frames[name]))
    if palm.mass <= 0:
        raise FileError(f"{shown}: the gripper's palm has {palm.mass:g} kg; it needs a mass")
    return Fingers(palm, tuple(parts))


def _passive(loops: list[Loop], below: Mapping[str, Body], shown: str) -> list[str]:
    """The joints that loops move: those of theirs without a motor or a line with another joint."""
    lined = {joint.follows[0] for b in below.values() if (joint := b.joint) and joint.follows}
    found: dict[str, None] = {}
    for loop in loops:
        ways = []
        for link in loop.links:
            way = []
            while link in below:
                way.append(link)
                link = below[link].parent
            ways.append(way)
        joints = [j for b in below if (b in ways[0]) != (b in ways[1]) and (j := below[b].joint)]
        free = [j.name for j in joints if not (j.follows or j.driven or j.name in lined)]
        if not free or len(free) == len(joints):
            both = " and ".join(printable(link)[:40] for link in loop.links)
            what = "one joint of it needs a motor, or an equality with the other finger's"
            raise FileError(f"{shown}: the loop that {both} close: {what}")
        found |= dict.fromkeys(free)
    return list(found)


def _closed(
    joints: list[Joint],
    loops: list[Loop],
    opened: Mapping[str, Array],
    placed: Callable[[Mapping[str, Array]], Mapping[str, Array]],
    shown: str,
) -> dict[str, Array]:
    """Positions (S,) of joints at which loops close: within their limits, where springs pull least.

    Gauss-Newton in all samples at once; a joint that a spring presses against its limit stays there.
    """
    low = np.array([-np.inf if np.isnan(j.lower) else j.lower for j in joints])
    high = np.array([np.inf if np.isnan(j.upper) else j.upper for j in joints])
    pull, rest = np.array([j.spring for j in joints]).T
    weight = 1e-4 * np.sqrt(pull / max(pull.max(), 1e-12)) + 1e-7

    def gaps(x: Array) -> Array:
        """(S, 3 loops) m."""
        frames = placed({**opened, **{j.name: x[:, k] for k, j in enumerate(joints)}})
        ends = [
            [
                frames[link][:, :3, :3] @ p + frames[link][:, :3, 3]
                for link, p in zip(*loop, strict=True)
            ]
            for loop in loops
        ]
        return np.concatenate([one - other for one, other in ends], 1)

    x = np.tile(np.clip(0.0, low, high), (SAMPLES, 1))
    eye, step = np.eye(len(joints)), 1e-6
    for turn in range(MOST_TURNS):
        springs = (
            weight if turn < MOST_TURNS - 8 else 0 * weight
        )  # the last turns close the loops alone
        r = gaps(x)
        J = np.stack([(gaps(x + step * e) - gaps(x - step * e)) / (2 * step) for e in eye], 2)
        slope = np.einsum("srk,sr->sk", J, r) + springs**2 * (x - rest)
        held = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        if turn >= MOST_TURNS - 8:
            held = (x <= low) | (x >= high)
        J = J * ~held[:, None]
        H = np.einsum("srk,srl->skl", J, J) + (springs**2 + 1e-12) * eye
        slope = np.where(held, 0.0, slope)
        dx = -np.linalg.solve(H, slope[..., None])[..., 0]
        x = np.clip(x + np.clip(dx, -0.2, 0.2), low, high)
    if (most := np.abs(gaps(x)).max()) > CLOSED_M:
        names = printable(", ".join(f"{a} and {b}" for (a, b), _ in loops))[:80]
        raise FileError(f"{shown}: the loops of {names} stay open by {1e3 * most:.2f} mm")
    return {joint.name: x[:, k] for k, joint in enumerate(joints)}


def _root(joint: Joint, moving: Mapping[str, Joint], shown: str) -> tuple[str, float, float]:
    """The joint that a moving joint follows (itself), and by what factor and offset."""
    name, factor, offset = joint.name, 1.0, 0.0
    for _ in range(len(moving) + 1):
        if joint.kind not in ("revolute", "prismatic"):
            what = f"joint {printable(joint.name)} is {joint.kind}; a gripper's turn or slide"
            raise FileError(f"{shown}: {what}")
        if joint.follows is None:
            return joint.name, factor, offset
        like, times, more = joint.follows
        if like not in moving:
            what = f"{printable(like)[:40]!r}, which is not a joint that moves the gripper"
            raise FileError(f"{shown}: a mimic joint follows {what}")
        offset += factor * more
        factor *= times
        joint = moving[like]
    raise FileError(f"{shown}: joint {printable(name)} follows itself")


def _boxes(link: Body) -> tuple[Box, ...]:
    """Collision boxes of a link whose geometry is boxes alone; else empty."""
    solid = [g for g in link.geoms if not g.seen]
    plain = all(g.kind == "box" and not g.fitted for g in solid)
    return tuple(Box(g.T, g.size) for g in solid) if plain else ()


def _to_axis(joint: Joint) -> Array:
    """The turn (4, 4) that takes z to the joint's axis."""
    T = np.eye(4)
    if not np.array_equal(joint.axis, [0, 0, 1]):
        T[:3, :3] = Rotation.align_vectors(joint.axis[None], [[0, 0, 1]])[0].as_matrix()
    return T


def _range(joint: Joint, shown: str) -> tuple[float, float]:
    """Lower and upper limit, rad or m; a joint that turns farther, or endlessly, gets one turn each way."""
    low, high = joint.lower, joint.upper
    if joint.kind == "revolute":
        turn = 2 * np.pi
        most = max(abs(low), abs(high))
        if LIMIT_TURNS * turn < most <= MOST_DEGREES:
            raise FileError(
                f"{shown}: joint {printable(joint.name)}: limits {low:g} {high:g} rad are {most / turn:.0f} turns. Are they in"
                ' degrees? A URDF has radians; write type="continuous" for a joint that turns endlessly'
            )
        low, high = (-turn, turn) if np.isnan(low) else (max(low, -turn), min(high, turn))
    if not low < high:
        where = f"{shown}: joint {printable(joint.name)}"
        raise FileError(f"{where}: limits {low:g} {high:g}; it needs lower < upper")
    return low, high


def _speed(joint: Joint, shown: str) -> float:
    """rad/s; 0: the file does not say, or says a number that limits nothing."""
    if not joint.speed >= 0:
        where = f"{shown}: joint {printable(joint.name)}: velocity {joint.speed:g}"
        raise FileError(f"{where}; it must be above 0, or left out for {SPEED_RAD_S:g} rad/s")
    return joint.speed if joint.speed <= MOST_RAD_S else 0.0


def holding_torque(T_joints: Array, T_flange: Array, parts: Sequence[Rigid]) -> Array:
    """(N,) N m for joints whose file does not say theirs.

    Args:
        T_joints: (N, 4, 4) each joint in the frame of the one before.
        T_flange: (4, 4) the flange in the last joint's frame.
        parts: the N + 1 rigid parts.
    """
    lengths = np.linalg.norm(T_joints[1:, :3, 3], axis=1)
    found = np.zeros(len(T_joints))
    for j in range(len(found)):
        along = np.concatenate([[0.0], np.cumsum(lengths[j:])])  # from joint j to each after it
        held = sum(
            part.mass * (way + np.linalg.norm(part.com))
            for part, way in zip(parts[j + 1 :], along, strict=True)
        )
        held += HELD_KG * (along[-1] + np.linalg.norm(T_flange[:3, 3]))
        found[j] = max(2 * GRAVITY_M_S2 * held, LEAST_NM)
    return found


def _exact(T: Array) -> Array:
    """Entries rounded to 1e-9: 1.570796327 becomes a quarter turn, 1e-11 m become 0."""
    return np.round(T, 9) + 0.0


def _rigid(model: Model, name: str, T: Array, ends: set[str]) -> Rigid:
    """A link and all that is fixed to it; T: the link in the frame of the joint that moves it."""
    geoms: list[Geom] = []
    bodies, members, todo = [], {name}, [(model.links[name], T)]
    while todo:
        link, T_at = todo.pop()
        geoms += [g._replace(T=T_at @ g.T) for g in link.geoms]
        R = T_at[:3, :3]
        bodies.append((link.mass, R @ link.com + T_at[:3, 3], R @ link.inertia @ R.T))
        for child in model.below(link.name):
            if child.joint is None and child.name not in ends:
                members.add(child.name)
                todo.append((child, T_at @ child.T_parent))
    mass = sum(m for m, _, _ in bodies)
    com = sum((m * c for m, c, _ in bodies), np.zeros(3)) / (mass or 1.0)
    about = np.zeros((3, 3))
    for m, c, inertia in bodies:  # the parallel axis theorem
        d = c - com
        about += inertia + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    return Rigid(name, tuple(geoms), mass, com, about, tuple(sorted(members)))
