"""Palms of protocol r2h-release: where the authors' public release puts its receivers
(docs/release.md).

A palm is drawn in a box of positions and of rotations. It is kept if the arm reaches the pose of
the tool that a reference grasp asks for, with the object's centre 15 cm above the palm; collisions
do not count. Numbers are the release's, turned into our frame: its arm reaches to -x and its base
is 0.75 m high. Only +, -, *, / and sqrt: a palm is the same on every machine (r2h_batch.base.rng).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import rng, se3
from r2h_batch.scene.arrays import stored_arrays
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot
from r2h_batch.trials.draw.receivers import sine_cosine
from r2h_batch.trials.draw.rule import POSE, Batch, Placed

Array = NDArray[np.float64]

LOW_M, HIGH_M = (0.60, 0.30, 0.13), (0.72, 0.45, 0.23)
"""Box of the palm's position: theirs is x -0.72 to -0.60, y -0.45 to -0.30, z 0.88 to 0.98."""
LOW_DEG, HIGH_DEG = (-25.0, -25.0, 30.0), (25.0, 25.0, 130.0)
"""Turns about the world's x, then y, then z; theirs about z is -150 to -50."""
HEIGHT_M = 0.15
"""Height of the object's centre above the palm, along its normal."""

SHOULDER_M, UPPER_M, FOREARM_M = 0.1625, 0.425, 0.3922
D4_M, D5_M, D6_M = 0.1333, 0.0997, 0.0996
"""The UR5e's nominal lengths (Denavit and Hartenberg): d1, -a2, -a3, d4, d5, d6."""


def place_palms(batch: Batch) -> Placed:
    """Hands whose palms lie in the release's box."""
    objects, hands, hand = batch.given.objects, batch.hands, batch.hand_index
    offset = np.array([reference_offset(o) for o in objects])[batch.object_index]
    world, palm = draw_palms(batch.key, batch.trial_id, offset)
    n, a = hands.palm_normal[hand], hands.along[hand]
    R = se3.from_frames(world, np.stack([a, np.cross(n, a), n], 2))
    T = np.zeros((len(hand), 4, 4), np.float32)
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    T[:, :3, 3] = palm - se3.rotate(R, hands.palm_point[hand])
    return Placed(T)


def draw_palms(key: tuple[int, int], ids: NDArray[np.int64], offset: Array) -> tuple[Array, Array]:
    """Palm frames of trials: the first proposal of each whose reference grasp the arm reaches.

    Args:
        key: of the random counters.
        ids: (n,) trials.
        offset: (n, 3) from the object's centre to the TCP of the reference grasp, tool frame, m.

    Returns:
        Rotations (n, 3, 3), columns along the fingers, across, out of the palm; positions (n, 3),
        m.
    """
    R, p = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))

    def propose(
        rows: NDArray[np.int64], attempt: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], tuple[Array, Array]]:
        u = rng.uniforms(key, ids[rows], 6, purpose=POSE, attempt=attempt)
        low, high = np.array([*LOW_M, *LOW_DEG]), np.array([*HIGH_M, *HIGH_DEG])
        drawn = low + (high - low) * u.T
        turned, palm = _rotation(drawn[:, 3:]), drawn[:, :3]
        tool = tool_rotation(turned)
        target = palm + HEIGHT_M * turned[:, :, 2] + se3.rotate(tool, offset[rows])
        fits = is_reachable(tool, target)
        return fits, (turned[fits], palm[fits])

    rng.accepted(len(ids), propose, R, p)
    return R, p


def tool_rotation(R_world_palm: Array) -> Array:
    """(n, 3, 3) how the release turns the tool: z against the palm's normal, x along the fingers."""
    x, z = R_world_palm[:, :, 0], -R_world_palm[:, :, 2]
    return np.stack([x, np.cross(z, x), z], 2)


@lru_cache(maxsize=256)
def reference_offset(model: ObjectModel) -> tuple[float, float, float]:
    """From the centre of the object's bounding box to the TCP of its first candidate, tool frame,
    m; 0 for an object without stored or given candidates."""
    if model.who.turn is not None:  # the tool's frame turns with the object
        return reference_offset(model.who.own)
    key, stored = model.who.key, stored_arrays("objects", "grasps.npz")
    if model.grasps is not None and len(model.grasps):
        T = np.asarray(model.grasps.T_obj_ee[0], np.float64)
    elif f"{key}/T_obj_ee" in stored:
        T = stored[f"{key}/T_obj_ee"][0].astype(np.float64)
    else:
        return 0.0, 0.0, 0.0
    center = (model.vertices.min(0).astype(np.float64) + model.vertices.max(0)) / 2
    x, y, z = se3.rotate(T[:3, :3].T, T[:3, 3] - center)
    return float(x), float(y), float(z)


def is_reachable(R_world_ee: Array, p_world_ee: Array) -> NDArray[np.bool_]:
    """Whether an inverse-kinematics branch of the UR5e exists for tool poses (n, 3, 3), (n, 3).

    Each of two shoulders and two wrists leaves a distance from shoulder to wrist, which the two
    long links reach or not. Collisions are not checked.
    """
    T = load_robot(DEFAULT_ROBOT).T_wrist3_ee
    back = np.round(np.linalg.inv(T), 12)  # ee to wrist 3; rounded: an inverse has other last bits
    R = np.stack(
        [se3.rotate(R_world_ee, np.tile(back[:3, k], (len(R_world_ee), 1))) for k in range(3)], 2
    )
    wrist = p_world_ee + se3.rotate(R_world_ee, np.tile(back[:3, 3], (len(R_world_ee), 1)))
    z6 = R[:, :, 2]
    p5 = wrist - D6_M * z6
    x, y = p5[:, 0], p5[:, 1]
    square = x * x + y * y
    beyond = square < D4_M**2
    h = np.sqrt(np.where(beyond, 0.0, square - D4_M**2))
    found = np.zeros(len(R), bool)
    for sign in (1.0, -1.0):
        # axis of joints 2, 3, 4: horizontal, and D4 from the vertical line through p5
        nx, ny = (x * D4_M + sign * y * h) / square, (y * D4_M - sign * x * h) / square
        axis = np.stack([nx, ny, np.zeros_like(nx)], 1)
        c = np.stack([ny * z6[:, 2], -nx * z6[:, 2], nx * z6[:, 1] - ny * z6[:, 0]], 1)
        length = np.sqrt(c[:, 0] ** 2 + c[:, 1] ** 2 + c[:, 2] ** 2)
        singular = length < 1e-9  # q5 = 0 or pi: the last link may lie anywhere; take none
        z5 = c / np.where(singular, 1.0, length)[:, None]
        for side in (1.0, -1.0):
            d = p5 - D4_M * axis - side * D5_M * z5 - np.array([0.0, 0.0, SHOULDER_M])
            far = d[:, 0] ** 2 + d[:, 1] ** 2 + d[:, 2] ** 2
            reached = (far <= (UPPER_M + FOREARM_M) ** 2) & (far >= (UPPER_M - FOREARM_M) ** 2)
            found |= reached & ~beyond & ~singular
    return found


def _rotation(degrees: Array) -> Array:
    """(n, 3, 3) turns about the fixed axes x, y, z in this order, from angles (n, 3)."""
    (sa, ca), (sb, cb), (sc, cc) = (sine_cosine(degrees[:, k]) for k in range(3))
    rows = (
        (cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa),
        (sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa),
        (-sb, cb * sa, cb * ca),
    )
    return np.stack([np.stack(row, 1) for row in rows], 1)
