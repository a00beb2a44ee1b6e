"""Split S1's hand tools (millimetres; x along the tool, its business end at +x)."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.shapes import (
    Parts,
    Spec,
    along_x,
    box,
    cylinder,
    extrude,
    loft,
    oval,
    revolve,
    spline,
    sweep,
    union,
)


def hammer(part: Parts) -> Manifold:
    grip = along_x(
        [
            (-165, 13, 9.5),
            (-160, 17.5, 13),
            (-150, 18.5, 13.5),
            (-120, 15.5, 11.5),
            (-80, 17, 12.5),
            (-45, 15, 11.5),
            (-30, 14, 10.5),
        ],
        40,
    )
    shaft = along_x([(-40, 10.5, 8), (0, 9.5, 7.5), (60, 10, 7.5), (110, 11, 8), (160, 11.5, 8.5)], 30)
    cheek = loft(
        [
            np.column_stack([oval(w, h, 24, 5) + (144, 0), np.full(24, y)])[:, [0, 2, 1]]
            for y, w, h in ((-16, 13, 13), (-10, 15, 15.5), (10, 15, 15.5), (18, 12, 12))
        ]
    )
    neck = cylinder((144, 14, 0), (144, 36, 0), 11.5)
    face = (
        revolve([(0, 0), (12, 0), (15.5, 4), (16, 6), (16, 18), (14.5, 20), (0, 20.6)], 40)
        .rotate((-90, 0, 0))
        .translate((144, 34, 0))
    )
    top = spline([(156, -8), (158, -30), (152, -52), (139, -71.5)], 14)
    low = spline([(136.5, -69.5), (141, -52), (136, -30), (131, -8)], 14)
    claw = extrude(np.concatenate([top, low]), -15, 15)
    notch = Manifold.batch_hull(
        [
            cylinder((100, -36, 0), (200, -36, 0), 1.2),
            cylinder((100, -80, 4.6), (200, -80, 4.6), 1.0),
            cylinder((100, -80, -4.6), (200, -80, -4.6), 1.0),
        ]
    )
    return (
        part("grip", grip)
        + part("shaft", shaft)
        + (part("head", cheek + neck) + part("face", face) + part("claw", claw))
        - part("claw", notch)
    )


def pliers(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        arm = spline([(12, 2, 0), (0, -3, 0), (-14, -10, 0), (-40, -17.5, 0), (-80, -21, 0), (-112, -19.5, 0)], 44)
        arm[:, 1] *= s
        steel = sweep(arm[:16], [oval(w, 4.6, 20, 3.2) for w in np.linspace(7.5, 5.5, 16)])
        u = np.linspace(0, 1, 34)
        sleeve = sweep(
            arm[10:], [oval(6.0 + 0.9 * np.sin(np.pi * t) - 1.5 * t**6, 5.8 - 0.8 * t**6, 20, 2.4) for t in u]
        )
        total += part("jaw", steel) + part("handle", sleeve)
    nose = Manifold()
    for s in (-1, 1):
        outline = np.array(
            [
                (-8, 0.5),
                (-9, 6),
                (-4, 12.0),
                (8, 13.0),
                (22, 10.5),
                (44, 7.0),
                (66, 4.2),
                (68, 2.8),
                (68, 0.7),
                (30, 0.7),
                (24, 2.4),
                (16, 2.4),
                (10, 0.7),
            ]
        )
        outline[:, 1] *= s
        half = extrude(outline, -4.8, 4.8)
        wedge = extrude([(-20, 4.8), (10, 4.8), (69, 3.0), (69, -3.0), (10, -4.8), (-20, -4.8)], -20, 20).rotate(
            (90, 0, 0)
        )
        teeth = union(cylinder((x, s * 0.4, -6), (x, s * 0.4, 6), 1.0, n=8) for x in np.arange(33, 66, 3.2))
        nose += part("jaw", half ^ wedge) - part("jaw", teeth)
    pivot = cylinder((0, 0, -6), (0, 0, 6), 8.0, n=32)
    return total + nose + part("pivot", cylinder((0, 0, -5), (0, 0, 5), 12.5, n=36)) + part("pivot", pivot)


def knife(part: Parts) -> Manifold:
    outline = spline(
        [
            (-77, -6),
            (-74, 8),
            (-60, 15.5),
            (-30, 15.5),
            (10, 13.5),
            (40, 14),
            (50, 9),
            (52, 0),
            (46, -9),
            (30, -14),
            (5, -13.5),
            (-30, -15.5),
            (-62, -18.5),
            (-74, -15),
        ],
        60,
        closed=True,
    )
    z = np.array([-9.0, -8.2, -6, 6, 8.2, 9.0])
    inset = np.array([0.86, 0.95, 1.0, 1.0, 0.95, 0.86])
    center = np.array([-12, -1])
    body = loft(
        [np.column_stack([(outline - center) * (1 - (1 - k) * 0.6) + center, np.full(60, h)]) for h, k in zip(z, inset)]
    )
    blade = extrude([(30, -8), (30, 9), (56, 9), (78, -7), (78, -8)], -0.8, 0.8)
    collar = box(12, 20, 10, 2, (48, 0.5, 0))
    slider = box(20, 5, 8, 1.8, (22, 14.5, 0)) + union(box(1.6, 3, 8, 0, (16 + 4 * i, 17, 0)) for i in range(4))
    screw = cylinder((-20, 0, -9.4), (-20, 0, 9.4), 4.5, n=24)
    return (
        part("body", body)
        + part("collar", collar)
        + part("blade", blade)
        + part("slider", slider)
        + part("handle", screw)
    )


def toothbrush(part: Parts) -> Manifold:
    s = spline(
        [
            (-82.5, 0.5, 3, 2),
            (-80, 0.6, 4.6, 3.2),
            (-62, 0, 5.4, 4.4),
            (-30, -0.8, 5.6, 4.2),
            (-8, 0, 5.5, 4.3),
            (12, 1.2, 4.4, 3.4),
            (36, 1.2, 3.1, 2.6),
            (52, 0.4, 3.4, 2.4),
        ],
        60,
    )
    handle = loft([np.column_stack([np.full(20, x), oval(a, b, 20, 2.4) + (0, z)]) for x, z, a, b in s])
    head = extrude(oval(16.5, 5.9, 40, 2.8) + (66, 0), -1.8, 2.6)
    rows = Manifold()
    for k in range(6):
        x = 54.4 + 4.65 * k
        w = 8.2 if k in (0, 5) else 10.2
        rows += box(3.2, w, 16 - (k % 2) * 1.6, 0, (x, 0, 1.5 + 8 - (k % 2) * 0.8))
    grip = Manifold()
    for x in (-52, -44, -36, -28, -20):
        grip += box(3.4, 6.2, 3, 1.2, (x, 0, 3.4 + 0.0 * x), n=8)
    return part("handle", handle) + part("grip", grip) + part("head", head) + part("bristles", rows)


def screwdriver(part: Parts) -> Manifold:
    n = 48
    t = 2 * np.pi * np.arange(n) / n
    rings = []
    for x, r, flute in spline(
        [
            (-108, 9.5, 0),
            (-106, 13, 0),
            (-101, 15.4, 0),
            (-94, 16.5, 0.02),
            (-82, 16.5, 0.10),
            (-48, 16.5, 0.10),
            (-36, 15.0, 0.04),
            (-28, 11.8, 0),
            (-22, 11.2, 0),
            (-14, 13.2, 0),
            (-10, 13, 0),
            (-8, 11.5, 0),
        ],
        52,
    ):
        rho = r * (1 - max(flute, 0) * (1 - np.cos(6 * t)))
        rings.append(np.column_stack([np.full(n, x), rho * np.cos(t), rho * np.sin(t)]))
    shaft = cylinder((-14, 0, 0), (96, 0, 0), 3.2, n=14)
    tip = loft(
        [
            np.column_stack([np.full(20, x), oval(a, b, 20, p)])
            for x, a, b, p in ((90, 2.9, 2.9, 2), (96, 3.5, 2.6, 2.3), (102, 3.8, 1.5, 4), (108, 3.4, 0.8, 6))
        ]
    )
    return part("handle", loft(rings)) + part("shaft", shaft) + part("tip", tip)


def scissors(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        blade = np.array(
            [
                (98, 1.2),
                (97, -0.6),
                (0, -3.5),
                (-12, -7),
                (-30, -9.5),
                (-36, -3),
                (-14, 5),
                (-2, 8.5),
                (20, 9.5),
                (60, 6.8),
            ]
        )
        turn = np.radians(6.5)
        rot = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        shape = blade @ rot.T * (1, s)
        z0, z1 = (-2.6, 0.2) if s > 0 else (-0.2, 2.6)
        steel = extrude(shape, z0, z1)
        shank = np.array([(-14, -2.5, 0), (-28, -7.5, 0), (-40, -14, 0), (-50, -19, 0)]) * (1, s, 1)
        loop = spline(
            np.array(
                [(-40, -13), (-55, -11), (-75, -12.5), (-91, -20), (-93, -32), (-80, -38.5), (-60, -36), (-44, -26)]
            )
            * (1, s),
            44,
            closed=True,
        )
        ring = sweep(np.column_stack([loop, 0 * loop[:, 0]]), [oval(4.4, 7.3, 16, 2.3)], closed=True)
        neck = sweep(
            spline(shank, 12), [oval(a, b, 16, 2.4) for a, b in zip(np.linspace(5, 6, 12), np.linspace(4.5, 6.5, 12))]
        )
        total += part("blade", steel) + part("loop", ring) + part("shank", neck)
    return total + part("pivot", cylinder((0, 0, -4), (0, 0, 4), 5.0, n=28))


SPECS = (
    Spec("hammer", "S1", (330, 126, 32), 0.665, 4.0, ("grip", "shaft", "head", "face", "claw"), hammer,
         fine=(("head", 3.2), ("face", 3.2), ("claw", 3.2)), receiver=("grip",), take="handle",
         frame="x from the handle to the head, y to the striking face"),
    Spec("pliers", "S1", (180, 55, 12), 0.2, 2.8, ("handle", "jaw", "pivot"), pliers,
         receiver=("handle",), take="handles", frame="x from the handles to the jaws, z along the pivot"),
    Spec("knife", "S1", (155, 35, 18), 0.08, 2.6, ("body", "handle", "collar", "blade", "slider"), knife,
         cuts=(("body", ((-1, 0, 0), 12), "handle"),), receiver=("handle",), take="handle",
         frame="x to the blade's tip, y to the blade's back, z across"),
    Spec("toothbrush", "S1", (165, 23, 12), 0.018, 2.0, ("handle", "neck", "grip", "head", "bristles"), toothbrush,
         cuts=(("handle", ((1, 0, 0), -10), "neck"),), receiver=("handle", "grip"), take="handle",
         frame="x to the head, z to the bristles"),
    Spec("screwdriver", "S1", (216, 34, 33), 0.097, 2.9, ("handle", "shaft", "tip"), screwdriver,
         fine=(("tip", 1.6), ("shaft", 1.6)), receiver=("handle",), take="handle", frame="x to the tip"),
    Spec("scissors", "S1", (198, 88, 15), 0.082, 2.8, ("blade", "shank", "loop", "pivot"), scissors,
         receiver=("loop",), take="loops", frame="x to the blades' tips, z along the pivot"),
)  # fmt: skip
