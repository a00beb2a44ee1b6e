"""Split S1's larger goods (millimetres; frames in SPECS)."""

from __future__ import annotations

import numpy as np
from manifold3d import CrossSection, Manifold

from r2h_batch.scene.families.shapes import (
    Parts,
    Spec,
    along_x,
    box,
    cylinder,
    loft,
    oval,
    revolve,
    spline,
    sweep,
    union,
)

TO_X = (0, 90, 0)


def _section(outline: np.ndarray) -> CrossSection:
    x, y = outline.T
    return CrossSection(
        [outline if float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) > 0 else outline[::-1].copy()]
    )


def power_drill(part: Parts) -> Manifold:
    barrel = along_x(
        [(-92, 14, 14), (-89, 22, 23), (-80, 26.5, 28), (-40, 28.5, 30), (0, 28, 29.5), (22, 26.5, 27.5), (30, 22, 22)],
        40,
        2.6,
        32,
    ).translate((0, 0, 62))
    grip = loft(
        [
            np.column_stack([oval(a, b, 28, 2.5) + (x, 0), np.full(28, z)])
            for x, a, b, z in spline(
                [
                    (-38, 25, 18, 50),
                    (-41, 21.5, 16.5, 30),
                    (-44, 20, 16, 5),
                    (-47, 20.5, 16.5, -25),
                    (-48, 24, 19, -48),
                    (-47, 28, 22, -60),
                ],
                30,
            )
        ]
    )
    foot = box(78, 56, 30, 6, (-40, 0, -77), n=16) + box(70, 50, 12, 4, (-40, 0, -60), n=16)
    collar = cylinder((26, 0, 62), (36, 0, 62), 24, 22, n=40)
    n = 32
    t = 2 * np.pi * np.arange(n) / n
    rings = []
    for x, r, ridge in ((34, 19, 0), (36, 20, 0.06), (58, 20, 0.06), (59, 18, 0), (62, 18, 0), (70, 11, 0), (73, 8, 0)):
        rho = r * (1 - ridge * (np.arange(n) % 4 >= 2))
        rings.append(np.column_stack([np.full(n, x), rho * np.cos(t), 62 + rho * np.sin(t)]))
    chuck = loft(rings)
    twist = []
    for k, x in enumerate(np.linspace(70, 91, 22)):
        a = oval(3.2, 2.2, 16, 2.0)
        w = 0.30 * k
        twist.append(
            np.column_stack([np.full(16, x), a @ np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]) + (0, 62)])
        )
    bit = loft(twist + [np.column_stack([np.full(16, 94.0), 0.25 * (twist[-1][:, 1:] - (0, 62)) + (0, 62)])])
    trigger = spline([(-22, 28), (-12, 26), (-15, 14), (-14, 2), (-24, 0)], 14)
    lever = (
        Manifold.extrude(_section(np.vstack([trigger, [(-34, 0), (-34, 28)]])), 14)
        .translate((0, 0, -7))
        .rotate((90, 0, 0))
    )
    vents = union(
        box(4, 80, 16, 0, (-78 + 8 * i, 0, 66)) - box(8, 51.5 + 1.4 * i, 18, 0, (-78 + 8 * i, 0, 66)) for i in range(4)
    )
    body = part("body", barrel) - part("body", vents)
    return (
        body
        + part("grip", grip)
        + part("battery", foot)
        + part("chuck", collar + chuck)
        + part("bit", bit)
        + part("trigger", lever)
    )


def binoculars(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        tube = revolve(
            [
                (0, -52),
                (16, -52),
                (18.5, -48),
                (19.5, -30),
                (22.4, -18),
                (22.4, 18),
                (20.6, 26),
                (21.2, 46),
                (23.4, 58),
                (24, 62),
                (24, 70),
                (21.5, 70),
                (20.5, 64),
                (0, 63),
            ],
            36,
        )
        cup = revolve([(0, -50), (16, -50), (18, -54), (18.6, -70), (17.6, -72), (14, -72), (12, -66), (0, -65)], 36)
        total += part("barrel", tube.rotate(TO_X).translate((0, s * 30.5, 0)))
        total += part("eyecup", cup.rotate(TO_X).translate((0, s * 30.5, 0)))
    bridge = box(20, 34, 15, 3.5, (-20, 0, 2)) + box(16, 34, 15, 3.5, (24, 0, 2))
    hinge = cylinder((-34, 0, 4), (36, 0, 4), 6.5, n=28)
    wheel = union([cylinder((-10, 0, 4), (10, 0, 4), 10.5, n=28), cylinder((-40, 0, 4), (-30, 0, 4), 8.5, n=28)])
    return total + part("bridge", bridge + hinge) + part("focus_wheel", wheel)


def bottle(part: Parts) -> Manifold:
    shoulder = spline([(37.5, 130), (36.8, 150), (31, 172), (21, 190), (14.5, 204), (13.2, 216)], 16)
    profile = [
        (0, 4),
        (22, 3),
        (27, 0),
        (33, 0),
        (36.6, 3),
        (37.5, 8),
        (37.5, 34),
        (35.8, 38),
        (35.8, 92),
        (37.5, 96),
        *shoulder,
        (13.2, 228),
        (16.5, 228.5),
        (16.5, 231),
        (13.2, 231.5),
        (13.2, 236),
        (0, 236),
    ]
    n = 64
    t = 2 * np.pi * np.arange(n) / n
    rings = []
    for z, r, ridge in ((232, 15.0, 0), (233, 15.6, 0.05), (247, 15.6, 0.05), (249, 14.6, 0), (250, 13.5, 0)):
        rho = r * (1 - ridge * (np.arange(n) % 4 >= 2))
        rings.append(np.column_stack([rho * np.cos(t), rho * np.sin(t), np.full(n, z)]))
    return part("body", revolve(profile, 44)) + part("cap", loft(rings))


def trigger_sprayer(part: Parts) -> Manifold:
    stations = spline(
        [
            (0, 40, 33, 2),
            (3, 45, 36.5, 6),
            (12, 46.5, 37.5, 12),
            (70, 46.5, 37.5, 70),
            (110, 44, 36.5, 110),
            (135, 36, 31, 135),
            (155, 24, 23, 155),
            (172, 15, 15, 172),
            (186, 14, 14, 186),
        ],
        48,
    )
    body = loft([np.column_stack([oval(a, b, 36, 2.3) + (-1, 0), np.full(36, z - 2)]) for z, a, b, _ in stations])
    collar = cylinder((-1, 0, 176), (-1, 0, 198), 18, 17, n=36) + cylinder((-1, 0, 196), (-1, 0, 222), 10.5, 10.5, n=28)
    ridges = union(
        box(3, 3, 18, 0, (-1 + 17.5 * np.cos(a), 17.5 * np.sin(a), 187)).translate((0, 0, 0))
        for a in 2 * np.pi * np.arange(12) / 12
    )
    outline = spline(
        [
            (46, 262),
            (30, 274),
            (5, 285),
            (-25, 288),
            (-44, 280),
            (-50, 262),
            (-40, 246),
            (-22, 238),
            (-14, 225),
            (-10, 214),
            (8, 214),
            (12, 236),
            (30, 246),
        ],
        60,
        closed=True,
    )
    shell = loft(
        [
            np.column_stack([(outline[:, 0] + 5) * k - 5, np.full(60, y), (outline[:, 1] - 255) * k + 255])
            for y, k in ((-14, 0.80), (-12, 0.93), (-8, 1), (8, 1), (12, 0.93), (14, 0.80))
        ]
    )
    nozzle = cylinder((38, 0, 262), (50, 0, 262), 9, 9, n=28) + cylinder((46, 0, 262), (54, 0, 262), 6, 5, n=24)
    lever = sweep(
        spline([(26, 0, 254), (29, 0, 240), (26, 0, 224), (27, 0, 208), (33, 0, 194)], 24),
        [oval(7.5, 3.6, 20, 2.6)],
        up=(1, 0, 0),
    )
    return (
        part("bottle", body)
        + part("collar", collar + ridges)
        + part("head", shell)
        + part("nozzle", nozzle)
        + part("trigger", lever)
    )


SPECS = (
    Spec("power_drill", "S1", (186, 184, 57), 0.895, 4.8, ("body", "grip", "battery", "chuck", "bit", "trigger"),
         power_drill,
         fine=(("chuck", 3.8), ("bit", 2.0), ("trigger", 3.4)), receiver=("grip", "trigger"), take="grip",
         frame="x to the bit, z up, the grip down"),
    Spec("binoculars", "S1", (142, 109, 48), 0.35, 4.3,
         ("barrel", "right_barrel", "eyecup", "right_eyecup", "bridge", "focus_wheel"),
         binoculars, cuts=(("barrel", ((0, -1, 0), 0), "right_barrel"), ("eyecup", ((0, -1, 0), 0), "right_eyecup")),
         fine=(("bridge", 2.8), ("focus_wheel", 2.5)), receiver=("right_barrel", "right_eyecup"), take="right barrel",
         frame="x the direction of sight, y to the left barrel, z up"),
    Spec("bottle", "S1", (250, 75, 75), 0.6, 4.8, ("body", "base", "neck", "cap"), bottle,
         cuts=(("body", ((0, 0, -1), -96), "base"), ("body", ((0, 0, 1), 196), "neck")), fine=(("cap", 2.6),),
         receiver=("base",), take="body",
         frame="z to the cap"),
    Spec("trigger_sprayer", "S1", (290, 100, 75), 0.55, 5.6,
         ("bottle", "neck", "collar", "head", "nozzle", "trigger"), trigger_sprayer,
         cuts=(("bottle", ((0, 0, 1), 142), "neck"),),
         fine=(("collar", 3.2), ("nozzle", 2.8), ("trigger", 3.0), ("head", 4.2)),
         receiver=("neck", "collar", "head", "trigger"), take="grip",
         frame="x to the nozzle, z up"),
)  # fmt: skip
