"""Receivers of r2h-v1: people with arm and torso, whose hand stands where an arm that reaches for
something brings it.

A trial has its person: sex, standing or seated, lengths. A proposal is a place beyond the table's
front edge and a posture of the arm: the wrist in the comfortable part of its reach, elbow, forearm
and wrist within joint ranges. The hand follows from these; its roll is never free. Every constant
names its source; [choice] marks a value without one.

Only +, -, *, / and sqrt: sine, cosine and the normal quantile are polynomials and a rational
function of this file, so that a person is the same on every machine (r2h_batch.base.rng).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng, se3

Array = NDArray[np.float64]

# men: mean, sd, correlation with stature; women: the same. ANSUR II, the 2012 survey of U.S. Army
# personnel (Gordon et al. 2014, NATICK/TR-15/007), n = 4,082 and 1,986: younger and fitter than the
# population. Half of the people are women [choice].
LENGTHS_MM = {
    "acromial_height": (1440.7, 63.3, 0.97, 1335.1, 58.1, 0.97),
    "biacromial_breadth": (415.7, 19.2, 0.53, 365.3, 18.3, 0.57),
    "acromion_radiale": (335.2, 17.5, 0.80, 311.2, 17.2, 0.79),
    "radiale_stylion": (267.9, 15.4, 0.71, 241.3, 15.2, 0.69),
    "chest_depth": (253.8, 26.2, 0.22, 247.4, 27.3, 0.23),
    "chest_breadth": (289.4, 18.3, 0.34, 269.3, 18.6, 0.35),
    "biceps_circumference": (358.1, 34.6, 0.19, 305.6, 30.8, 0.25),
    "forearm_circumference": (310.1, 22.0, 0.30, 264.1, 18.5, 0.36),
    "wrist_circumference": (175.9, 9.0, 0.49, 154.8, 7.8, 0.54),
    "iliac_height": (1061.6, 52.0, 0.91, 995.7, 49.7, 0.92),
    "popliteal_height": (429.8, 24.8, 0.84, 388.2, 23.6, 0.81),
    # elbow rest height + shoulder-elbow length
    "seated_shoulder": (608.8, 31.6, 0.63, 566.7, 28.3, 0.61),
}
PERCENTILES = (0.05, 0.95)
SHOES_M = 0.025
"""Pheasant (from memory)."""
JOINT_BELOW_ACROMION = 0.104
"""Share of the acromion-radiale length by which the shoulder's joint centre lies below the acromion:
de Leva 1996 (from memory)."""

TABLE_HEIGHT_M = 0.74
"""Above the floor: EN 527-1 (from memory)."""
SEATED = 0.25
"""Share that sits [choice]."""
GAP_M = (0.05, 0.40)
"""Between the table's front edge and the chest [choice]."""
SIDEWAYS_M = 0.40
FACING_DEG = 20.0
"""Largest angles and shifts from facing the robot [choice]."""
ELBOW_DEG = (30.0, 100.0)
"""Flexion. 100: RULA's neutral range (McAtamney and Corlett 1993, from memory); 30 [choice]."""
ACROSS_DEG, OUTWARDS_DEG = 45.0, 30.0
"""Direction from shoulder to wrist, seen from above: across the chest, and away from it [choice]."""
DOWN_DEG = (0.0, 75.0)
SWIVEL_DEG = (0.0, 45.0)
"""Range of the elbow about that line, outwards from hanging [choice]."""
PRONATED_DEG, SUPINATED_DEG = 20.0, 80.0
"""Range of the forearm, 0: thumb up. 80: AAOS; 20 [choice]."""
WRIST_BENT_DEG, WRIST_ASIDE_DEG = 40.0, 20.0
"""Flexion and deviation, sums of two uniform numbers: Ryu et al. 1991, J. Hand Surg. 16A (abstract)."""

OF_PERSON, OF_POSTURE = len(LENGTHS_MM) + 3, 12
"""How many uniform numbers each takes."""
_POSE, _PERSON = 1, 2  # purposes of the random counters
_RAD = 0.017453292519943295
AT_ONCE = 4096
"""Proposals looked at together."""
POINTS = 9  # along each limb, at which its clearance is checked


@dataclass(frozen=True)
class Person:
    """n people, world frame, metres. `out`: sideways, to the side of the arm; `hand`, `palm`: unit
    vectors of the hand."""

    shoulder: Array  # (n, 3)
    elbow: Array
    wrist: Array
    hand: Array  # (n, 3) from the wrist along the hand
    palm: Array  # (n, 3) out of the palm
    radius: Array  # (n, 2) of upper arm and forearm
    torso: Array  # (n, 3) its middle
    facing: Array  # (n, 2) unit, horizontal
    torso_half: Array  # (n, 3) along facing, sideways, up

    def rows(self, kept: NDArray[np.int64]) -> "Person":
        """The selected people."""
        return Person(*(getattr(self, name)[kept] for name in Person.__dataclass_fields__))

    def table(self) -> NDArray[np.float32]:
        """(n, 5, 4) as `Trials.receiver` holds them."""
        n = len(self.shoulder)
        out = np.zeros((n, 5, 4), np.float32)
        out[:, 0, :3], out[:, 0, 3] = self.shoulder, self.radius[:, 0]
        out[:, 1, :3], out[:, 1, 3] = self.elbow, self.radius[:, 1]
        out[:, 2, :3] = self.wrist
        out[:, 3, :3] = self.torso
        out[:, 3, 3], out[:, 4, 3] = self.facing[:, 0], self.facing[:, 1]
        out[:, 4, :3] = self.torso_half
        return out


def draw_receivers(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    side: NDArray[np.int64],
    place_hand: "PlaceHand",
    table_edge_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """T_world_hand (n, 4, 4) and receivers (n, 5, 4) of trials: the first proposal of each that is
    accepted.

    `side` (n,): 0 right, 1 left. `place_hand(people, rows, number)`: whether these proposals of
    trials `rows`, the `number`-th of each, are kept, the poses (k, 4, 4) of the k that are, and the
    people, whose arms it may move.
    """

    person = rng.uniforms(key, ids, OF_PERSON, purpose=_PERSON)

    def reaching(rows: NDArray[np.int64], v: Array) -> Person:
        return propose(person[:, rows], v, side[rows], table_edge_m)

    T_world_hand, receiver, left, tried = first_fitting(key, ids, reaching, place_hand)
    if len(left):
        raise rng.NothingFits(
            f"trial {ids[left[0]]} has no acceptable posture in {tried} proposals"
        )
    return T_world_hand, receiver


Reaching = Callable[[NDArray[np.int64], Array], Person]
"""The people of trials (rows), each in the posture that uniform numbers (OF_POSTURE, n) give."""
PlaceHand = Callable[
    [Person, NDArray[np.int64], NDArray[np.int64]],
    tuple[NDArray[np.bool_], NDArray[np.float32], Person],
]


def first_fitting(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    reaching: Reaching,
    place_hand: PlaceHand,
    *,
    before: int = 0,
    most: int = 0,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], int]:
    """Each trial's first proposal that is accepted.

    Args:
        key: of the random counters.
        ids: (n,) trials.
        reaching: the people of some trials.
        place_hand: as in `draw_receivers`.
        before: counters that earlier calls have used up.
        most: proposals of a trial; 0: as many as `rng.MAX_ATTEMPTS`, fewer where no trial fits.

    Returns:
        T_world_hand (n, 4, 4), receivers (n, 5, 4), the trials for which nothing fitted, and how many proposals these
        had.
    """
    T_world_hand = np.zeros((len(ids), 4, 4), np.float32)
    receiver = np.zeros((len(ids), 5, 4), np.float32)
    todo, tried = np.arange(len(ids)), 0
    while len(todo) and tried < (most or rng.MAX_ATTEMPTS):
        # the few that are left try many proposals at once; the first that fits is taken, as
        # one after the other
        turns = max(1, AT_ONCE // len(todo))
        turns = min(turns, most - tried) if most else turns
        rows = np.repeat(todo, turns)
        number = tried + np.tile(np.arange(turns), len(todo))
        v = rng.uniforms(key, ids[rows], OF_POSTURE, purpose=_POSE, attempt=before + number)
        people = reaching(rows, v)
        fits, T, people = place_hand(people, rows, number)
        kept = np.flatnonzero(fits)
        done, first = np.unique(rows[kept], return_index=True)
        T_world_hand[done], receiver[done] = T[first], people.rows(kept[first]).table()
        todo, tried = np.setdiff1d(todo, done), tried + turns
        if not most and len(todo) == len(ids) and tried * len(ids) >= rng.HOPELESS:
            break
    return T_world_hand, receiver, todo, tried


def propose(u: Array, v: Array, side: NDArray[np.int64], table_edge_m: float) -> Person:
    """People from uniform numbers: who they are, u (OF_PERSON, n); where they stand and how they
    reach, v (OF_POSTURE, n)."""
    woman, seated = u[0] < 0.5, u[1] < SEATED
    return reach(seated, _lengths(woman, u[2:]), v, side, table_edge_m)


def reach(
    seated: NDArray[np.bool_],
    size: Mapping[str, Array],
    v: Array,
    side: NDArray[np.int64],
    table_edge_m: float,
) -> Person:
    """People of these lengths (m, by the names of LENGTHS_MM) who stand or sit where uniform numbers v (OF_POSTURE, n)
    say, and reach."""
    outwards = np.where(side == 0, -1.0, 1.0)  # the right arm's side is -left

    # where the chest stands and looks
    floor = -TABLE_HEIGHT_M + SHOES_M
    hips = np.where(seated, floor + size["popliteal_height"], floor + size["iliac_height"])
    acromion = np.where(
        seated,
        floor + size["popliteal_height"] + size["seated_shoulder"],
        floor + size["acromial_height"],
    )
    x = table_edge_m + GAP_M[0] + (GAP_M[1] - GAP_M[0]) * v[0] + 0.5 * size["chest_depth"]
    y = SIDEWAYS_M * (2.0 * v[1] - 1.0)
    distance = np.sqrt(x * x + y * y)
    s, c = sine_cosine(FACING_DEG * (2.0 * v[2] - 1.0))
    toward_x, toward_y = -x / distance, -y / distance
    forward = np.stack([c * toward_x - s * toward_y, s * toward_x + c * toward_y, 0.0 * x], 1)
    out = outwards[:, None] * np.stack([-forward[:, 1], forward[:, 0], 0.0 * x], 1)
    up = np.stack([0.0 * x, 0.0 * x, 0.0 * x + 1.0], 1)
    joint = acromion - JOINT_BELOW_ACROMION * size["acromion_radiale"]
    shoulder = np.stack([x, y, joint], 1) + (0.5 * size["biacromial_breadth"])[:, None] * out

    # the wrist in the reach, the elbow beside the line to it
    upper, lower = (1.0 - JOINT_BELOW_ACROMION) * size["acromion_radiale"], size["radiale_stylion"]
    _, bent = sine_cosine(_between(v[3], *ELBOW_DEG))
    reach = np.sqrt(upper * upper + lower * lower + 2.0 * upper * lower * bent)
    s_az, c_az = sine_cosine(_between(v[4], -ACROSS_DEG, OUTWARDS_DEG))
    s_el, c_el = sine_cosine(_between(v[5], *DOWN_DEG))
    to_wrist = (c_el * c_az)[:, None] * forward + (c_el * s_az)[:, None] * out - s_el[:, None] * up
    along = (upper * upper - lower * lower + reach * reach) / (2.0 * reach)
    offset = np.sqrt(np.maximum(upper * upper - along * along, 0.0))
    hanging = _unit(-up - se3.dot(-up, to_wrist)[:, None] * to_wrist)
    aside = outwards[:, None] * np.cross(to_wrist, hanging)
    s_sw, c_sw = sine_cosine(_between(v[6], *SWIVEL_DEG))
    elbow_way = c_sw[:, None] * hanging + s_sw[:, None] * aside
    elbow = shoulder + along[:, None] * to_wrist + offset[:, None] * elbow_way
    wrist = shoulder + reach[:, None] * to_wrist

    hand, palm = _hand_axes(shoulder, elbow, wrist, outwards, v[7:])
    radius = np.stack(
        [
            size["biceps_circumference"],
            0.5 * (size["forearm_circumference"] + size["wrist_circumference"]),
        ]
    )
    torso = np.stack([x, y, 0.5 * (hips + acromion)], 1)
    half = 0.5 * np.stack([size["chest_depth"], size["chest_breadth"], acromion - hips], 1)
    radius = radius.T / (2.0 * 3.141592653589793)
    return Person(shoulder, elbow, wrist, hand, palm, radius, torso, forward[:, :2], half)


def _lengths(woman: NDArray[np.bool_], u: Array) -> dict[str, Array]:
    """Lengths (n,) in metres: a person's stature and what else varies, each between its 5th and
    95th percentile."""
    low, high = PERCENTILES
    stature = normal_quantile(low + (high - low) * u[0])
    most = float(normal_quantile(np.array([high]))[0])
    out = {}
    for (name, row), part in zip(LENGTHS_MM.items(), u[1:], strict=True):
        mean, sd, r = (np.where(woman, row[3 + k], row[k]) for k in range(3))
        independent = normal_quantile(low + (high - low) * part)
        z = np.clip(r * stature + np.sqrt(1.0 - r * r) * independent, -most, most)
        out[name] = 0.001 * (mean + sd * z)
    return out


def _hand_axes(
    shoulder: Array, elbow: Array, wrist: Array, outwards: Array, v: Array
) -> tuple[Array, Array]:
    """Where the hand points and its palm faces, (n, 3) each: forearm turned, wrist bent and
    aside."""
    forearm, thumb, inwards = arm_axes(shoulder, elbow, wrist, outwards)
    s, c = sine_cosine(_between(v[0], -PRONATED_DEG, SUPINATED_DEG))
    palm = c[:, None] * inwards + s[:, None] * thumb
    thumb = c[:, None] * thumb - s[:, None] * inwards
    # two uniform numbers: most often straight
    s, c = sine_cosine(WRIST_BENT_DEG * (v[1] + v[2] - 1.0))
    hand = c[:, None] * forearm + s[:, None] * palm
    palm = c[:, None] * palm - s[:, None] * forearm
    s, c = sine_cosine(WRIST_ASIDE_DEG * (v[3] + v[4] - 1.0))
    return c[:, None] * hand - s[:, None] * thumb, palm


def arm_axes(
    shoulder: Array, elbow: Array, wrist: Array, outwards: Array
) -> tuple[Array, Array, Array]:
    """Unit vectors (n, 3): along the forearm, and where thumb and palm of a hand in neutral are:
    away from the upper arm, and towards the chest. `outwards` (n,): -1 of right arms, 1 of
    left ones."""
    upper, forearm = _unit(elbow - shoulder), _unit(wrist - elbow)
    thumb = _unit(se3.dot(upper, forearm)[:, None] * forearm - upper)
    return forearm, thumb, -outwards[:, None] * np.cross(thumb, forearm)


def limbs(people: Person) -> list[tuple[Array, Array]]:
    """Upper arm and forearm as points (n, POINTS, 3) along them, and their radii (n,)."""
    t = np.arange(POINTS, dtype=np.float64)[None, :, None] / (POINTS - 1)
    ends = ((people.shoulder, people.elbow), (people.elbow, people.wrist))
    return [
        (a[:, None] + t * (b - a)[:, None], people.radius[:, k]) for k, (a, b) in enumerate(ends)
    ]


def clear_of_torso(people: Person) -> NDArray[np.bool_]:
    """Whether no point along the forearm, the elbow included, lies in the torso's box."""
    (_, _), (points, _) = limbs(people)
    clear = np.ones(len(points), bool)
    for k in range(points.shape[1]):
        d = points[:, k] - people.torso
        ahead = d[:, 0] * people.facing[:, 0] + d[:, 1] * people.facing[:, 1]
        aside = d[:, 1] * people.facing[:, 0] - d[:, 0] * people.facing[:, 1]
        inside = np.abs(np.stack([ahead, aside, d[:, 2]], 1)) < people.torso_half
        clear &= ~(inside[:, 0] & inside[:, 1] & inside[:, 2])
    return clear


def sine_cosine(degrees: Array) -> tuple[Array, Array]:
    """Sine and cosine of angles up to 180 degrees by their Taylor series about 0: within 1e-12, the
    same everywhere."""
    x = degrees * _RAD
    square = x * x
    s, c = np.ones_like(x), np.ones_like(x)
    for k in range(14, 0, -1):  # nested from the highest power down
        s = 1.0 - s * square / float(2 * k * (2 * k + 1))
        c = 1.0 - c * square / float(2 * k * (2 * k - 1))
    return x * s, c


_P = (
    -39.69683028665376, 220.9460984245205, -275.9285104469687, 138.3577518672690, -30.66479806614716,
    2.506628277459239,
)  # fmt: skip
_Q = (
    -54.47609879822406, 161.5858368580409, -155.6989798598866, 66.80131188771972, -13.28068155288572,
)  # fmt: skip


def normal_quantile(p: Array) -> Array:
    """z with Phi(z) = p for 0.025 <= p <= 0.975: Acklam's rational approximation (2003), relative
    error 1.2e-9."""
    q = p - 0.5
    r = q * q
    numerator, denominator = np.full_like(r, _P[0]), np.full_like(r, _Q[0])
    for a in _P[1:]:
        numerator = numerator * r + a
    for b in _Q[1:]:
        denominator = denominator * r + b
    return np.asarray(numerator * q / (denominator * r + 1.0))


def _between(u: Array, low: float, high: float) -> Array:
    return low + (high - low) * u


def _unit(a: Array) -> Array:
    return np.asarray(a / np.sqrt(se3.dot(a, a))[:, None])
