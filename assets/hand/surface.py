"""The default right hand's skeleton and skin as an implicit surface. Millimetres; axes as MANO's right hand.

Flat hand, palm down: fingers along -x, back of the hand +y, thumb side +z, the wrist joint at the origin.
Lengths are scene.md's male hand; the distance from a finger's last length to its fingertip is skin and pulp.
"""

from __future__ import annotations

import numpy as np

# MANO's order: wrist, index1-3, middle1-3, pinky1-3, ring1-3, thumb1-3.
DIGITS = ("index", "middle", "pinky", "ring", "thumb")
PARENTS = np.array([-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14])
LENGTHS = {
    "index": (45.0, 24.0, 12.0),
    "middle": (47.0, 27.0, 12.0),
    "pinky": (35.0, 20.0, 12.0),
    "ring": (43.0, 27.0, 12.0),
    "thumb": (33.0, 34.0, 15.0),
}
PULP = {"index": 10.0, "middle": 11.0, "pinky": 9.0, "ring": 10.0, "thumb": 11.0}
METACARPAL_BASE = {
    "index": (-26.0, 0.0, 15.0),
    "middle": (-26.0, 1.5, 4.0),
    "ring": (-26.0, 0.5, -8.0),
    "pinky": (-32.0, -2.0, -18.0),
}
ROOT = {
    "index": (-86.0, 0.0, 24.0),
    "middle": (-89.0, 1.0, 2.5),
    "ring": (-84.0, 0.0, -17.5),
    "pinky": (-71.5, -2.5, -34.5),
    "thumb": (-23.0, -10.0, 21.0),
}
AZIMUTH_DEG = {
    "index": (5, 4, 3),
    "middle": (0, 0, 0),
    "ring": (-6, -5, -4),
    "pinky": (-14, -11, -9),
    "thumb": (47, 37, 32),
}
ELEVATION_DEG = {"index": (0, 0, 0), "middle": (0, 0, 0), "ring": (0, 0, 0), "pinky": (0, 0, 0), "thumb": (-14, -8, -6)}
# Skin radius at the three joints and at the centre of the fingertip's ball.
RADII = {
    "index": (10.3, 9.0, 7.9, 6.7),
    "middle": (10.5, 9.2, 8.0, 6.8),
    "ring": (10.0, 8.7, 7.6, 6.5),
    "pinky": (9.0, 7.8, 6.8, 5.8),
    "thumb": (13.5, 10.6, 9.7, 8.2),
}
THUMB_ROLL_DEG = 42.0


def direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit vector: azimuth from -x towards +z, elevation towards +y."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([-np.cos(a) * np.cos(e), np.sin(e), np.sin(a) * np.cos(e)])


def skeleton() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """joints (16,3), tips (5,3) in DIGITS order, axes (16,3,3): columns flexion, abduction, along the bone.

    A positive turn about the flexion axis bends towards the palm, about the abduction axis turns towards the thumb's
    side. The thumb's axes are rolled by THUMB_ROLL_DEG about its bones, so that it bends across the palm.
    """
    joints, tips, axes = np.zeros((16, 3)), np.zeros((5, 3)), np.zeros((16, 3, 3))
    axes[0] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]).T
    for d, name in enumerate(DIGITS):
        p = np.array(ROOT[name])
        for k in range(3):
            j = 1 + 3 * d + k
            bone = direction(AZIMUTH_DEG[name][k], ELEVATION_DEG[name][k])
            dorsal = np.array([0.0, 1.0, 0.0])
            if name == "thumb":
                az, roll = np.radians([AZIMUTH_DEG[name][k], THUMB_ROLL_DEG])
                dorsal = np.cos(roll) * dorsal + np.sin(roll) * np.array([np.sin(az), 0.0, np.cos(az)])
            dorsal = dorsal - (dorsal @ bone) * bone
            dorsal /= np.linalg.norm(dorsal)
            joints[j] = p
            axes[j] = np.stack([np.cross(dorsal, bone), dorsal, bone], axis=1)
            p = p + LENGTHS[name][k] * bone
        tips[d] = p + PULP[name] * bone
    return joints, tips, axes


JOINTS, TIPS, AXES = skeleton()


def cone(
    p: np.ndarray, a: np.ndarray, b: np.ndarray, ra: float, rb: float, squash: np.ndarray | None = None
) -> np.ndarray:
    """Signed distance to two balls and the cone around them; with ``squash`` (3,3) space is stretched about a first."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    if squash is not None:
        p, b = a + (p - a) @ squash.T, a + (b - a) @ squash.T
    ba = b - a
    l2 = ba @ ba
    rr = ra - rb
    a2, il2 = l2 - rr * rr, 1.0 / l2
    pa = p - a
    y = pa @ ba
    z = y - l2
    x2 = np.sum((pa * l2 - y[:, None] * ba) ** 2, axis=1)
    y2, z2 = y * y * l2, z * z * l2
    k = np.sign(rr) * rr * rr * x2
    side = (np.sqrt(x2 * a2 * il2) + y * rr) * il2 - ra
    side = np.where(np.sign(y) * a2 * y2 < k, np.sqrt(x2 + y2) * il2 - ra, side)
    return np.where(np.sign(z) * a2 * z2 > k, np.sqrt(x2 + z2) * il2 - rb, side)


def smooth_union(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * h * k / 6.0


def digit_field(p: np.ndarray, d: int) -> np.ndarray:
    """Signed distance to digit d, from its root to the fingertip."""
    name = DIGITS[d]
    j, r = 1 + 3 * d, RADII[name]
    bone, dorsal = AXES[j + 2][:, 2], AXES[j + 2][:, 1]
    ball = TIPS[d] - r[3] * bone - 0.4 * dorsal
    field = cone(p, JOINTS[j], JOINTS[j + 1], r[0], r[1] * 0.97)
    field = smooth_union(field, cone(p, JOINTS[j + 1], JOINTS[j + 2], r[1], r[2] * 0.98), 2.0)
    # The last phalanx is a little wider than thick, and its pulp sits on the palm side.
    wide = np.eye(3) + 0.10 * np.outer(dorsal, dorsal)
    field = smooth_union(field, cone(p, JOINTS[j + 2], ball, r[2], r[3], wide), 2.0)
    pulp = JOINTS[j + 2] + 0.55 * (TIPS[d] - JOINTS[j + 2]) - 0.12 * r[3] * dorsal
    field = smooth_union(field, np.linalg.norm(p - pulp, axis=1) - r[3] * 1.02, 3.0)
    for k, bulge in ((1, 0.97), (2, 0.97)) if name != "thumb" else ((2, 0.98),):
        knuckle = JOINTS[j + k] + 0.06 * r[k] * AXES[j + k][:, 1]
        field = smooth_union(field, np.linalg.norm(p - knuckle, axis=1) - bulge * r[k], 2.5)
    return field


def palm_field(p: np.ndarray) -> np.ndarray:
    """Signed distance to palm, thumb and little finger muscles, webs and wrist stump."""
    m = {name: np.array(v) for name, v in METACARPAL_BASE.items()}
    root = {name: np.array(v) for name, v in ROOT.items()}
    down = np.array([0.0, -1.0, 0.0])
    thumb_mcp = JOINTS[14]
    parts: list[tuple[np.ndarray, np.ndarray, float, float]] = []
    knuckles: list[np.ndarray] = []
    for name, r in (("index", 11.8), ("middle", 11.5), ("ring", 11.0), ("pinky", 10.7)):
        parts.append((m[name] + 0.5 * down, root[name], 11.5, r))
        parts.append((m[name] + 4.0 * down, root[name] + 4.6 * down, 11.0, r - 0.6))
        knuckles.append(root[name] + [1.0, 3.4, 0.0])
    parts += [
        (np.array([16.0, -1, 11]), np.array([-26.0, -1, 12]), 16.5, 13.0),
        (np.array([16.0, -1, -11]), np.array([-30.0, -2, -14]), 16.5, 13.0),
        (np.array([16.0, -1, 0]), np.array([-26.0, -2, 0]), 18.0, 13.0),
        (np.array([-16.0, -10, 14]), np.array([-46.0, -13, 30]), 12.5, 11.5),  # thenar
        (np.array([-20.0, -8, 20]), thumb_mcp, 13.0, 10.6),
        (np.array([-14.0, -8, -15]), np.array([-56.0, -7, -31]), 12.5, 10.0),  # hypothenar
        (np.array([-40.0, -10, 27]), np.array([-64.0, -4, 27]), 9.5, 7.5),  # first web
        (np.array([-36.0, -11, 33]), np.array([-54.0, -9, 34]), 8.0, 5.5),
    ]
    field = np.full(len(p), 1e3)
    for a, b, ra, rb in parts:
        field = smooth_union(field, cone(p, a, b, ra, rb), 9.0)
    for centre, radius in zip(knuckles, (9.6, 9.8, 9.3, 8.2)):
        field = smooth_union(field, np.linalg.norm(p - centre, axis=1) - radius, 4.0)
    return field


def skin(p: np.ndarray) -> np.ndarray:
    """Signed field of the whole hand, negative inside, in millimetres near the surface."""
    palm = palm_field(p)
    field = np.full(len(p), 1e3)
    for d, name in enumerate(DIGITS):
        field = smooth_union(field, smooth_union(palm, digit_field(p, d), 9.0 if name == "thumb" else 6.0), 1.5)
    for a, b in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        ends = []
        for name in (a, b):
            j = 1 + 3 * DIGITS.index(name)
            ends.append(JOINTS[j] + 0.30 * (JOINTS[j + 1] - JOINTS[j]) + [0.0, -2.0, 0.0])
        field = smooth_union(field, cone(p, ends[0], ends[1], 6.5, 6.0), 5.0)
    stump = p[:, 0] - 17.0
    return -smooth_union(-field, -stump, 18.0)
