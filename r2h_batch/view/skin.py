"""The skin of a trial's person, only to be seen: planning and Safe ask capsules and box (`Trials.receiver`).

The body is that of the built-in person (`assets/people/skin.npz`) whose judged arm and chest are nearest to the trial's,
scaled to these and bent at shoulder, elbow, hip and knee. The reaching arm ends at the wrist: the trial's own hand is
drawn there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from r2h_batch.scene.arrays import asset, read_arrays
from r2h_batch.scene.tables import MIDDLE_ROOT
from r2h_batch.trials.draw.receivers import SHOES_M, TABLE_HEIGHT_M

Array = NDArray[np.float64]

GEOMS = ("torso", "upper_arm", "forearm", "head")
"""Surfaces that are drawn apart: trunk, legs and the other sleeve; sleeve and forearm of the reaching arm; head, and the
other forearm with its hand."""
CLOTHED = ("torso", "upper_arm")
BONES = (
    "trunk",
    "upper",
    "fore",
    "other_upper",
    "other_fore",
    "thigh",
    "shin",
    "other_thigh",
    "other_shin",
)
JOINTS = (
    *(
        "shoulder",
        "elbow",
        "wrist",
        "index",
        "pinky",
        "other_shoulder",
        "other_elbow",
        "other_wrist",
    ),
    *("hip", "knee", "other_hip", "other_knee"),
)
SIZES = (
    *("upper", "fore", "upper_radius", "fore_radius", "chest_depth", "chest_breadth"),
    *("acromial_height", "iliac_height", "popliteal_height", "seated_shoulder"),
)
"""Lengths of a built-in person, m. The first six are read from a trial's receiver too: lengths and radii of the
capsules, half sides of the box."""
READ = 6
HANGING, HANGING_FORE = (0.06, 0.16, -1.0), (0.30, 0.04, -0.95)
RESTING, RESTING_FORE = (0.12, 0.12, -0.98), (0.86, -0.12, -0.42)
"""The other arm of who stands or sits: ahead, outwards, up [choice]."""
CHAIR_DEEP_M, CHAIR_BACK_M, CHAIR_WIDER_M = 0.44, 0.24, 0.05
CHAIR_THICK_M, CHAIR_LEG_M = 0.018, 0.018
"""The chair of who sits: depth of its seat, half the height of its back, how much wider than the box on each side, half the
thickness of seat and back, half that of its legs [choice]."""
BORDER_M = 0.05
"""How far from a border between clothes and skin its plane decides what is clothed [choice]: its teeth are shorter."""
CUFF_M = 0.006
"""How far ahead of its wrist the drawn hand begins [choice]: behind it lies skin that does not bend with the wrist."""
HARMONICS = 2
"""Waves of the line at which the drawn hand ends [choice]: an egg, without the fold of a bent wrist."""
BELOW, UNDER_M, WRIST_M = 0.97, 0.004, 0.06
"""The forearm's end in the hand: its radii over those of the hand's end, how far inside it lies, and how much of the forearm
bends towards it [choice]."""
MOST_TWIST = 2.6
"""Largest twist of the forearm, rad: a hand of another make may point anywhere."""


@dataclass(frozen=True, eq=False)
class Skins:
    """The bodies of P people: V vertices and the joints of `JOINTS`, in the frame of a person who stands at 0, looks along x,
    and whose left is y; the right arm reaches."""

    points: Array  # (V + joints, 3) of the mean person, m
    basis: Array  # (K, V + joints, 3)
    person: Array  # (P, K)
    sizes: Array  # (P, 10) by `SIZES`
    sex: NDArray[np.int8]  # (P,)
    weights: Array  # (V, 9) by `BONES`, sums 1
    faces: NDArray[np.int64]  # (F, 3)
    geom: NDArray[np.int8]  # (F,) index into `GEOMS`
    end: NDArray[np.int64]  # (E,) vertices at which the reaching forearm ends

    def nearest(self, sizes: Array, sex: int | None) -> int:
        """The person whose first sizes (READ,) are nearest, of a sex or of either."""
        off = np.linalg.norm(self.sizes[:, :READ] - sizes, axis=1)
        return int(np.where((self.sex == sex) | (sex is None), off, np.inf).argmin())

    def body(self, who: int) -> tuple[Array, dict[str, Array]]:
        """Vertices (V, 3) and joints of a person."""
        made = self.points + np.tensordot(self.person[who], self.basis, 1)
        return made[: -len(JOINTS)], dict(zip(JOINTS, made[-len(JOINTS) :], strict=True))


@lru_cache(maxsize=1)
def skins() -> Skins:
    """The built-in people's, with smooth borders between clothes and skin."""
    a = read_arrays(asset("people", "skin.npz"))
    weights, n = a["weights"].astype(np.float64), len(JOINTS)
    weights /= weights.sum(1, keepdims=True)
    cut, geom = smooth_borders(
        a["faces"].astype(np.int64), a["geom"], a["points"].astype(np.float64)[:-n]
    )
    points = a["points"].astype(np.float64)
    basis = a["basis"] * a["scale"].astype(np.float64)[:, None, None]

    joints = dict(zip(JOINTS, points[-n:], strict=True))
    wrist = end_of(cut.faces, points[:-n], joints["wrist"])
    along = joints["wrist"] - joints["elbow"]
    along /= np.linalg.norm(along)
    own = np.unique(cut.faces[geom == GEOMS.index("forearm")])
    own = own[own < len(weights)]
    beyond = own[(points[own] - points[wrist].mean(0)) @ along > 0]  # between the teeth of the edge

    flat = np.union1d(wrist, beyond)
    radial = points[flat] - joints["wrist"]
    radius = np.linalg.norm(radial - np.outer(radial @ along, along), axis=1)
    width = np.minimum(1.0, np.median(radius) / radius)[
        :, None
    ]  # what lies at the thumb's root comes in

    def extended(rows: Array) -> Array:
        """The vertices' rows with those of the borders."""
        return np.concatenate([rows, cut.mixed(rows)])

    def ended(rows: Array) -> Array:
        """Rows of vertices and joints: with the borders, the forearm's end in a plane across it, as round as the arm."""
        found = np.concatenate([extended(rows[:-n]), rows[-n:]])
        middle = rows[JOINTS.index("wrist") - n]
        from_middle = found[flat] - middle
        ahead = (found[wrist] - middle).mean(0) @ along
        aside = from_middle - np.outer(from_middle @ along, along)
        found[flat] = middle + ahead * along + width * aside
        return found

    return Skins(
        ended(points),
        np.stack([ended(b) for b in basis]),
        a["person"].astype(np.float64),
        a["sizes"].astype(np.float64),
        a["sex"],
        extended(weights),
        cut.faces,
        geom,
        wrist,
    )


def end_of(faces: NDArray[np.int64], points: Array, joint: Array) -> NDArray[np.int64]:
    """The vertices (E,) of the open edge that is nearest to a joint: where the hand, a mesh of its own, begins.

    Args:
        faces: (F, 3) of the points and of vertices beyond them, which are on no open edge.
        points: (V, 3) m.
        joint: (3,) m.
    """
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    edges, times = np.unique(ends, axis=0, return_counts=True)
    alone = edges[(times == 1) & (edges < len(points)).all(1)]
    graph = coo_array((np.ones(len(alone)), alone.T), shape=(len(points), len(points)))
    part = connected_components(graph, directed=False)[1]
    near = np.unique(alone)
    nearest = near[np.linalg.norm(points[near] - joint, axis=1).argmin()]
    return near[part[near] == part[nearest]]


@dataclass(frozen=True, eq=False)
class Cut:
    """Faces that are cut along a line: B vertices more, each on an edge."""

    edges: NDArray[np.int64]  # (B, 2)
    share: Array  # (B,) of the edge's second end
    faces: NDArray[np.int64]  # (F, 3)

    def mixed(self, rows: Array) -> Array:
        """Rows of the new vertices, from rows (V, k) of the old ones."""
        a, b = (rows[self.edges[:, k]] for k in (0, 1))
        return np.asarray(a + self.share[:, None] * (b - a))


def smooth_borders(
    faces: NDArray[np.int64], geom: NDArray[np.int8], points: Array
) -> tuple[Cut, NDArray[np.int8]]:
    """The surface cut by a plane at each border between clothes and skin, and not along the edges of its faces.

    Args:
        faces: (F, 3) of V points.
        geom: (F,) index into `GEOMS`.
        points: (V, 3) m.

    Returns:
        The cut, and of each of its faces the index into `GEOMS`.
    """
    n = len(points)
    clothed = np.isin(geom, [GEOMS.index(name) for name in CLOTHED])
    corners = faces.ravel()
    share = np.bincount(corners, np.repeat(clothed, 3), n) / np.bincount(corners, minlength=n).clip(
        1
    )
    above = share - 0.5
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    edges, which, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    border = edges[(np.bincount(which, np.tile(clothed, 3)) == 1) & (times == 2)]
    graph = coo_array((np.ones(len(border)), border.T), shape=(n, n))
    part = connected_components(graph, directed=False)[1]
    on = np.unique(border)
    far, nearest = cKDTree(points[on]).query(points)
    for loop in np.unique(part[on]):
        own = points[on[part[on] == loop]]
        middle = own.mean(0)
        normal = np.linalg.svd(own - middle)[2][2]
        near = (part[on[nearest]] == loop) & (far < BORDER_M)
        side = (points[near] - middle) @ normal
        above[near] = side if side @ above[near] > 0 else -side
    cut, old, inside = cut_at(faces, above)
    skin_of_cloth = {GEOMS.index("torso"): "head", GEOMS.index("upper_arm"): "forearm"}
    cloth_of_skin = {GEOMS.index("head"): "torso", GEOMS.index("forearm"): "upper_arm"}
    labels = []
    for label, cloth in zip(geom[old].tolist(), inside.tolist(), strict=True):
        other = (cloth_of_skin if cloth else skin_of_cloth).get(label)
        labels.append(label if other is None else GEOMS.index(other))
    return cut, np.array(labels, np.int8)


def cut_at(
    faces: NDArray[np.int64], above: Array
) -> tuple[Cut, NDArray[np.int64], NDArray[np.bool_]]:
    """A surface cut where a value of its V vertices is 0.

    Args:
        faces: (F, 3).
        above: (V,).

    Returns:
        The cut; of each of its faces the face that it is a part of, and whether the value is positive there.
    """
    n = len(above)
    above = np.where(above == 0, 1e-9, above)
    inside = above > 0
    new: dict[tuple[int, int], int] = {}

    def between(a: int, b: int) -> int:
        return new.setdefault((min(a, b), max(a, b)), n + len(new))

    made, of, sides = [], [], []
    for i, face in enumerate(faces.tolist()):
        own = inside[face]
        if own.all() or not own.any():
            made.append(face)
            of.append(i)
            sides.append(bool(own[0]))
            continue
        k = int(np.flatnonzero(own == (own.sum() == 1))[0])  # the corner that is alone
        a, b, c = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
        p, q = between(a, b), between(a, c)
        made += [[a, p, q], [p, b, c], [p, c, q]]
        of += [i] * 3
        sides += [bool(inside[a]), *[bool(inside[b])] * 2]
    edges = np.array(sorted(new, key=lambda edge: new[edge]), np.int64).reshape(-1, 2)
    a, b = above[edges[:, 0]], above[edges[:, 1]]
    cut = Cut(edges, a / (a - b), np.array(made, np.int64))
    return cut, np.array(of, np.int64), np.array(sides, np.bool_)


def drawn_hand(
    vertices: Array, faces: NDArray[np.int64], joints: Array
) -> tuple[Array, NDArray[np.int64], Array]:
    """A hand in front of its wrist alone, and the line at which it ends: the forearm's skin begins there.

    Args:
        vertices: (V, 3) m, in any frame.
        faces: (F, 3).
        joints: (16, 3) as in `scene.hand`: the wrist, and the root of the middle finger.

    Returns:
        Vertices, faces, and the points (E, 3) of the end; none where the hand has nothing behind its wrist.
    """
    wrist, ahead = joints[0], joints[MIDDLE_ROOT] - joints[0]
    ahead = ahead / np.linalg.norm(ahead)
    cut, _, inside = cut_at(faces, (vertices - wrist) @ ahead - CUFF_M)
    new = _rounded(cut.mixed(vertices), ahead)
    return np.concatenate([vertices, new]), cut.faces[inside], new


def _rounded(end: Array, ahead: Array) -> Array:
    """The points (E, 3) of a hand's end on a smooth line about it: a bent wrist folds the skin at the thumb's root.

    Args:
        end: in the plane across `ahead`, m.
        ahead: (3,) unit.
    """
    if len(end) < 4 * HARMONICS:
        return end
    x = np.linalg.svd(np.eye(3) - np.outer(ahead, ahead))[0][:, 0]
    y = np.cross(ahead, x)
    middle = 0.5 * (end.min(0) + end.max(0))
    off = end - middle
    radius, angle = np.hypot(off @ x, off @ y), np.arctan2(off @ y, off @ x)
    turns = np.outer(angle, np.arange(1, HARMONICS + 1))
    waves = np.concatenate([np.ones((len(end), 1)), np.cos(turns), np.sin(turns)], 1)
    smooth = waves @ np.linalg.lstsq(waves, radius, rcond=None)[0]
    return np.asarray(
        end + ((smooth - radius) / radius)[:, None] * (off - np.outer(off @ ahead, ahead))
    )


@dataclass(frozen=True)
class Placed:
    """A receiver in the frame of `Skins`: a left arm as a right one."""

    origin: Array  # world, on the floor
    axes: Array  # (3, 3) columns: ahead, left (of who reaches with the left arm: right), up
    shoulder: Array
    elbow: Array
    wrist: Array
    sizes: Array  # (READ,)
    hips: float  # height of the box's underside above the floor

    @classmethod
    def of(cls, receiver: Array, left: bool) -> Placed:
        """From a row of `Trials.receiver` (5, 4)."""
        ahead = np.array([receiver[3, 3], receiver[4, 3], 0.0])
        aside = np.array([-ahead[1], ahead[0], 0.0]) * (-1.0 if left else 1.0)
        axes = np.stack([ahead, aside, [0.0, 0.0, 1.0]], 1)
        middle, half = receiver[3, :3], receiver[4, :3]
        floor = SHOES_M - TABLE_HEIGHT_M
        origin = np.array([middle[0], middle[1], floor])
        shoulder, elbow, wrist = (receiver[:3, :3] - origin) @ axes
        arm = (np.linalg.norm(elbow - shoulder), np.linalg.norm(wrist - elbow))
        sizes = np.array([*arm, receiver[0, 3], receiver[1, 3], half[0], half[1]])
        return cls(origin, axes, shoulder, elbow, wrist, sizes, float(middle[2] - half[2] - floor))


def skin_of(
    receiver: Array, *, left: bool, palm: Array | None = None, sex: int | None = None,
    cuff: Array | None = None,
) -> dict[str, tuple[Array, NDArray[np.int64]]]:  # fmt: skip
    """The skin of a person as surfaces: vertices (V, 3), world, m, and faces, by the names of `GEOMS`.

    Args:
        receiver: (5, 4) as in `Trials.receiver`.
        left: whether the left arm reaches.
        palm: (3,) unit normal out of the receiving hand's palm, world: the forearm turns with it. None: it does not.
        sex: 0 male, 1 female; None: that of the nearest person.
        cuff: (E, 3) where the drawn hand ends (`drawn_hand`), world, m: the forearm ends below it. None or no points: the
            forearm ends at the wrist.
    """
    every, at = skins(), Placed.of(np.asarray(receiver, np.float64), left)
    who = every.nearest(at.sizes, sex)
    rest, joints = every.body(who)
    normal = None if palm is None else np.asarray(palm, np.float64) @ at.axes
    own = dict(zip(SIZES, every.sizes[who], strict=True))
    moved = _moved(rest, joints, own, at, normal)
    local = np.einsum("vb,bvk->vk", every.weights, np.stack([moved[b] for b in BONES]))
    world = at.origin + local @ at.axes.T
    if cuff is not None and len(cuff):
        fore = np.unique(every.faces[every.geom == GEOMS.index("forearm")])
        world[fore] = _below(world[fore], np.isin(fore, every.end), cuff, receiver[1:3, :3])
    faces = every.faces[:, ::-1] if left else every.faces
    return {name: (world, faces[every.geom == k]) for k, name in enumerate(GEOMS)}


def _below(fore: Array, end: NDArray[np.bool_], cuff: Array, bone: Array) -> Array:
    """The forearm's vertices (V, 3) with its end below the end of the drawn hand: those near the wrist go with it.

    Args:
        fore: (V, 3) world, m.
        end: (V,) which of them are its end.
        cuff: (E, 3) the end of the hand.
        bone: (2, 3) elbow and wrist.
    """
    along = (bone[1] - bone[0]) / np.linalg.norm(bone[1] - bone[0])
    normal = np.linalg.svd(cuff - cuff.mean(0))[2][2]
    normal *= np.sign(normal @ along)
    middle = 0.5 * (cuff.min(0) + cuff.max(0))
    x = np.linalg.svd(np.eye(3) - np.outer(along, along))[0][:, 0]
    y = np.cross(along, x)

    def angle(points: Array, about: Array) -> Array:
        return np.asarray(np.arctan2((points - about) @ y, (points - about) @ x))

    around = angle(cuff, middle)
    order = np.argsort(around)
    inner = middle + BELOW * (cuff[order] - middle) + UNDER_M * normal
    now = angle(fore, fore[end].mean(0))
    there = _periodic(now[end], around[order], inner)
    by = np.argsort(now[end])
    off = _periodic(now, now[end][by], (there - fore[end])[by])
    behind = np.clip((fore[end] @ along).min() - fore @ along, 0.0, WRIST_M) / WRIST_M
    share = np.where(end, 1.0, (1.0 - behind) ** 2 * (1.0 + 2.0 * behind))
    return np.asarray(fore + share[:, None] * off)


def _periodic(at: Array, angles: Array, rows: Array) -> Array:
    """Rows (A, 3) at sorted angles (A,) interpolated at other angles, rad."""
    return np.stack([np.interp(at, angles, column, period=2 * np.pi) for column in rows.T], 1)


def sits(at: Placed, own: dict[str, float]) -> bool:
    """Whether the box's underside is nearer to the height of a seat than to that of the hips of who stands."""
    return abs(at.hips - own["popliteal_height"]) < abs(at.hips - own["iliac_height"])


def chair_of(
    receiver: Array, *, left: bool, sex: int | None = None
) -> list[tuple[Array, Array, Array]]:
    """The chair of who sits, as boxes: middle (3,), half sides (3,) and rotation (3, 3), world, m; none of who stands.

    Args:
        receiver: (5, 4) as in `Trials.receiver`.
        left: whether the left arm reaches.
        sex: 0 male, 1 female; None: that of the nearest person.
    """
    every, at = skins(), Placed.of(np.asarray(receiver, np.float64), left)
    who = every.nearest(at.sizes, sex)
    if not sits(at, dict(zip(SIZES, every.sizes[who], strict=True))):
        return []
    deep, wide = at.sizes[4], at.sizes[5] + CHAIR_WIDER_M
    seat, half, leg = at.hips - CHAIR_THICK_M, CHAIR_THICK_M, CHAIR_LEG_M
    back, front = -deep - 2 * half, CHAIR_DEEP_M - deep
    middle = 0.5 * (back + front)
    boxes = [((middle, 0.0, seat), (0.5 * (front - back), wide, half))]
    boxes.append(((back, 0.0, seat + CHAIR_BACK_M), (half, wide, CHAIR_BACK_M)))
    boxes += [
        ((x, y, 0.5 * seat), (leg, leg, 0.5 * seat))
        for x in (back + leg, front - leg)
        for y in (leg - wide, wide - leg)
    ]
    turn = at.axes if np.linalg.det(at.axes) > 0 else at.axes * [1.0, -1.0, 1.0]
    return [(at.origin + at.axes @ np.array(p), np.array(h), turn) for p, h in boxes]


def _moved(
    rest: Array, joints: dict[str, Array], own: dict[str, float], at: Placed, palm: Array | None
) -> dict[str, Array]:
    """Bone -> all vertices (V, 3) as it moves them."""
    seated = sits(at, own)
    # the height that stays: the floor, or the seat
    before = own["acromial_height"] - own["seated_shoulder"] if seated else 0.0
    now = at.hips if seated else 0.0
    wide = at.shoulder[1] / joints["shoulder"][1]
    deep = at.sizes[4] / own["chest_depth"]
    tall = (at.shoulder[2] - now) / (joints["shoulder"][2] - before)
    scale, lift = np.array([deep, wide, tall]), np.array([0.0, 0.0, now - tall * before])

    def trunk(points: Array) -> Array:
        return points * scale + lift

    there = {name: trunk(p) for name, p in joints.items()}
    moved = {"trunk": trunk(rest)}
    arm = ("shoulder", "elbow", "wrist")
    reach = np.stack([at.shoulder, at.elbow, at.wrist])
    wider = at.sizes[2:4] / [own["upper_radius"], own["fore_radius"]]
    across = _across(joints)
    moved["upper"], moved["fore"] = _arm(
        rest, np.stack([joints[k] for k in arm]), reach, wider, across, palm
    )
    other = np.stack([joints[f"other_{k}"] for k in arm])
    ways = np.array([RESTING, RESTING_FORE] if seated else [HANGING, HANGING_FORE])
    ways *= tall * np.linalg.norm(np.diff(other, axis=0), axis=1)[:, None] / _norm(ways)
    hanging = there["other_shoulder"] + np.cumsum([np.zeros(3), *ways], axis=0)
    flip = np.array([1.0, -1.0, 1.0])
    made = _arm(rest * flip, other * flip, hanging * flip, np.full(2, tall), None, None)
    moved["other_upper"], moved["other_fore"] = (part * flip for part in made)
    for side in ("", "other_"):
        thigh, shin = f"{side}thigh", f"{side}shin"
        if not seated:
            moved[thigh] = moved[shin] = moved["trunk"]
            continue
        hip, knee = joints[f"{side}hip"], joints[f"{side}knee"]
        start = there[f"{side}hip"]
        length = np.linalg.norm(knee - hip)
        rise = now + knee[2] - own["popliteal_height"] - start[2]
        ahead = np.sqrt(max(length**2 - rise**2, 0.0))
        end = start + np.array([ahead, 0.0, rise])
        turn = least_turn(knee - hip, end - start)
        moved[thigh] = start + (rest - hip) @ turn.T
        moved[shin] = end + (rest - knee)
    return moved


class _Bone(NamedTuple):
    """A bone at rest (`0`) and where it is."""

    start0: Array
    along0: Array
    """(3,) its direction"""
    long0: float
    """m"""
    start: Array
    along: Array
    long: float
    turn: Array
    """(3, 3) of its start"""
    twist: float
    """by how much more its end is turned about it, rad"""


def _arm(
    rest: Array, before: Array, now: Array, wider: Array, across: Array | None, palm: Array | None
) -> tuple[Array, Array]:
    """The vertices as an upper arm and a forearm move them: stretched along the bones and widened about them.

    Args:
        rest: (V, 3) at rest.
        before: (3, 3) shoulder, elbow, wrist at rest.
        now: (3, 3) where these are.
        wider: (2,) radii over those at rest, of upper arm and forearm.
        across: (3,) out of the palm at rest; None: the forearm does not turn.
        palm: (3,) the same now.
    """
    upper, fore = _bones(before, now, across, palm)
    return _carried(rest, upper, wider[0]), _carried(rest, fore, wider[1])


def _bones(
    before: Array, now: Array, across: Array | None, palm: Array | None
) -> tuple[_Bone, _Bone]:
    """How upper arm and forearm move; arguments as of `_arm`."""
    (up0, low0), (up, low) = (np.diff(p, axis=0) / _norm(np.diff(p, axis=0)) for p in (before, now))
    long0, long = (_norm(np.diff(p, axis=0))[:, 0] for p in (before, now))
    hinge0, hinge = np.cross(up0, low0), np.cross(up, low)
    plain = least_turn(up0, up)
    fore = _frame(low, hinge) @ _frame(low0, hinge0).T
    # the upper arm is turned at the elbow and not at the shoulder
    roll = _angle(plain @ hinge0, hinge, up)
    twist = 0.0
    if across is not None and palm is not None:
        twist = float(np.clip(_angle(fore @ across, palm, low), -MOST_TWIST, MOST_TWIST))
    return (
        _Bone(before[0], up0, long0[0], now[0], up, long[0], plain, roll),
        _Bone(before[1], low0, long0[1], now[1], low, long[1], fore, twist),
    )


def _carried(rest: Array, bone: _Bone, wider: float) -> Array:
    """The vertices (V, 3) as a bone moves them: stretched along it and widened about it."""
    t = (rest - bone.start0) @ bone.along0
    off = (rest - bone.start0 - t[:, None] * bone.along0) @ bone.turn.T
    share = np.clip(t / bone.long0, 0.0, 1.0)
    off = Rotation.from_rotvec(bone.twist * share[:, None] * bone.along).apply(off)
    return np.asarray(bone.start + (t * bone.long / bone.long0)[:, None] * bone.along + wider * off)


def _across(joints: dict[str, Array]) -> Array:
    """Out of the palm of the reaching hand at rest, as `scene.hand.palm_frame` of a right hand."""
    a, b = (joints[k] - joints["wrist"] for k in ("index", "pinky"))
    return np.cross(a, b)


def _norm(rows: Array) -> Array:
    return np.asarray(np.linalg.norm(rows, axis=1, keepdims=True))


def least_turn(a: Array, b: Array) -> Array:
    """The least rotation (3, 3) that takes the direction of a to that of b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    turn: Array = Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
    return turn


def _frame(along: Array, hinge: Array) -> Array:
    """Columns: along a bone, the hinge's axis made perpendicular to it, and the third."""
    y = hinge - (hinge @ along) * along
    y /= np.linalg.norm(y)
    return np.stack([along, y, np.cross(along, y)], 1)


def _angle(a: Array, b: Array, about: Array) -> float:
    """From a to b about a unit axis, rad."""
    a, b = (v - (v @ about) * about for v in (a, b))
    return float(np.arctan2(np.cross(a, b) @ about, a @ b))
