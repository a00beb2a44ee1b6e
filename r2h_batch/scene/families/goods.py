"""Larger goods of split S1: power drill, binoculars, bottle, trigger sprayer (millimetres; frames in each docstring)."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.family import WATER, Draw, Shape, family
from r2h_batch.scene.families.shapes import (
    Parts,
    along_x,
    box,
    cylinder,
    extrude,
    loft,
    oval,
    revolve,
    spline,
    sweep,
)

TO_X = (0, 90, 0)


@family(
    "power_drill",
    "S1",
    parts=("body", "grip", "battery", "chuck", "bit", "trigger"),
    rests=("left", "right", "upright"),
    receiver=("grip", "trigger"),
    take="grip",
)
def power_drill(draw: Draw, part: Parts) -> Shape:
    """x to the bit, z up, the grip down: pistol grip with a slide-on or stick battery."""
    r, back, front = (
        draw("barrel_radius", 23, 32),
        draw("barrel_back", 60, 95),
        draw("barrel_front", 22, 42),
    )
    chuck, chuck_l, bit, bit_r = (
        draw("chuck_radius", 16, 22),
        draw("chuck_length", 32, 45),
        draw("bit", 18, 70),
        draw("bit_radius", 2.2, 4.0),
    )
    grip_l, a, b = (
        draw("grip_length", 88, 118),
        draw("grip_depth", 18, 24),
        draw("grip_width", 14, 19),
    )
    rake, at = draw("rake", 3, 18), draw("grip_at", -52, -24)
    battery = draw.choice("battery", ("block", "block", "stick"))
    block_l, block_w, block_h = (
        draw("block_length", 70, 118),
        draw("block_width", 50, 78),
        draw("block_height", 24, 52),
    )
    z = grip_l * 0.62
    barrel = along_x(
        [
            (-back, 0.5 * r, 0.5 * r),
            (3 - back, 0.8 * r, 0.82 * r),
            (12 - back, 0.95 * r, 0.97 * r),
            (-0.4 * back, r, 1.04 * r),
            (0.4 * front, 0.98 * r, 1.0 * r),
            (front, 0.8 * r, 0.8 * r),
        ],
        30,
        2.5,
        28,
    ).translate((0, 0, z))
    low = z - grip_l
    stations = spline(
        [
            (at, 1.2 * a, 1.05 * b, z - 12),
            (at - 0.15 * rake, 1.06 * a, b, z - 0.3 * grip_l),
            (at - 0.5 * rake, 0.98 * a, 0.97 * b, z - 0.55 * grip_l),
            (at - 0.8 * rake, a, b, z - 0.8 * grip_l),
            (at - rake, 1.25 * a, 1.2 * b, low),
        ],
        22,
    )
    grip = loft(
        [np.column_stack([oval(p, q, 26, 2.5) + (x, 0), np.full(26, h)]) for x, p, q, h in stations]
    )
    if battery == "block":
        foot = box(
            block_l,
            block_w,
            block_h,
            5,
            (at - rake + 0.12 * block_l, 0, low - block_h / 2 + 6),
            n=16,
        )
    else:
        foot = box(
            2.6 * a, 2.6 * b, 0.6 * block_h, 5, (at - rake, 0, low - 0.3 * block_h + 6), n=16
        )
    hold = cylinder((front - 6, 0, z), (front + 8, 0, z), 0.85 * r, 0.75 * r, n=36)
    jaws = cylinder((front + 6, 0, z), (front + 0.75 * chuck_l, 0, z), chuck, n=30) + cylinder(
        (front + 0.75 * chuck_l, 0, z), (front + chuck_l, 0, z), chuck, 0.45 * chuck, n=30
    )
    steel = cylinder((front + chuck_l - 3, 0, z), (front + chuck_l + bit, 0, z), bit_r, n=14)
    x0 = at + 0.8 * a
    lever = (
        extrude(
            np.vstack(
                [
                    spline([(x0, -30), (x0 + 12, -28), (x0 + 9, -16), (x0 + 10, -4), (x0, -2)], 12),
                    [(x0 - 12, -2), (x0 - 12, -30)],
                ]
            ),
            -7,
            7,
        )
        .rotate((90, 0, 0))
        .translate((0, 0, z - 0.8 * r + 14))
    )
    solid = (
        part("body", barrel)
        + part("grip", grip)
        + part("battery", foot)
        + part("chuck", hold + jaws)
        + part("bit", steel)
        + part("trigger", lever)
    )
    return Shape(
        solid,
        {
            "body": 1350.0,
            "grip": 700.0,
            "battery": 1700.0,
            "chuck": 4500.0,
            "bit": 7800.0,
            "trigger": 1100.0,
        },
    )


@family(
    "binoculars",
    "S1",
    parts=("barrel", "right_barrel", "eyecup", "right_eyecup", "bridge", "focus_wheel"),
    rests=("upright", "upright", "over"),
    receiver=("right_barrel", "right_eyecup"),
    take="right barrel",
)
def binoculars(draw: Draw, part: Parts) -> Shape:
    """x the direction of sight, y to the left barrel, z up: roof prisms (straight tubes) of 8 x 21 to 10 x 50."""
    lens, length = draw("objective", 13, 29), draw("length", 90, 165)
    eye, gap = draw("eyecup", 13, 19), draw("pupil_distance", 56, 72) / 2
    waist, flare, cup = (
        draw("waist", 0.74, 0.95),
        draw("flare", 0.55, 0.85),
        draw("eyecup_length", 14, 24),
    )
    shift, wheel = draw("bridge_at", -0.22, 0.1), draw("wheel", 8, 12)
    gap = max(gap, lens + 4)
    h, mid = length / 2, max(eye, lens * waist)
    total = Manifold()
    for s in (-1, 1):
        tube = revolve(
            [
                (0, cup - h),
                (eye - 1, cup - h),
                (eye + 0.5, cup - h + 3),
                (mid, -0.25 * h),
                (mid, 0.2 * h),
                (0.5 * (mid + lens), flare * h),
                (lens, 0.92 * h),
                (lens, h),
                (lens - 2, h),
                (lens - 3, h - 5),
                (0, h - 6),
            ],
            32,
        )
        ring = revolve(
            [
                (0, cup - h + 2),
                (eye - 1, cup - h + 2),
                (eye, cup - h - 2),
                (eye, 4 - h),
                (eye - 1, 1 - h),
                (eye - 4, -h),
                (eye - 5, 6 - h),
                (0, 7 - h),
            ],
            32,
        )
        right = "right_" if s < 0 else ""
        total += part(f"{right}barrel", tube.rotate(TO_X).translate((0, s * gap, 0)))
        total += part(f"{right}eyecup", ring.rotate(TO_X).translate((0, s * gap, 0)))
    x0 = shift * length
    bridge = box(0.32 * length, 2 * gap - 0.8 * mid, 14, 3.5, (x0, 0, 1)) + cylinder(
        (x0 - 0.24 * length, 0, 3), (x0 + 0.24 * length, 0, 3), 6.5, n=24
    )
    focus = cylinder((x0 - 0.1 * length, 0, 3), (x0 + 0.06 * length, 0, 3), wheel, n=28)
    return Shape(
        total + part("bridge", bridge) + part("focus_wheel", focus),
        dict.fromkeys(("barrel", "right_barrel"), 950.0)
        | dict.fromkeys(("eyecup", "right_eyecup"), 700.0)
        | {"bridge": 1600.0, "focus_wheel": 1300.0},
    )


@family(
    "bottle",
    "S1",
    parts=("body", "base", "neck", "cap"),
    rests=("upright", "upright", "upright", "side", "side"),
    receiver=("base",),
    take="body",
)
def bottle(draw: Draw, part: Parts) -> Shape:
    """z to the cap: water, oil or shampoo bottle, round or oval, partly filled. The region is the lower part of the
    body, as on the built-in bottle."""
    height, r, round_ = (
        draw("height", 165, 290),
        draw("radius", 28, 46),
        draw.choice("section", ("round", "round", "oval")),
    )
    flat, share, waist = (
        draw("oval", 0.55, 0.95),
        draw("shoulder", 0.55, 0.8),
        draw("waist", 0, 0.12),
    )
    neck, neck_l, cap, wide, power = (
        draw("neck", 10, 15),
        draw("neck_length", 10, 40),
        draw("cap", 14, 30),
        draw("cap_width", 1.08, 1.35),
        draw("squareness", 2, 3.2),
    )
    filled = draw("filled", 0.2, 1.0)
    r = min(r, 0.22 * height)
    flat, power = (1.0, 2.0) if round_ == "round" else (flat, power)
    z_neck = height - cap - neck_l
    z_s = share * z_neck
    stations = [
        (0, 0.9),
        (3, 0.97),
        (8, 1.0),
        (0.3 * z_s, 1 - 0.6 * waist),
        (0.55 * z_s, 1 - waist),
        (0.8 * z_s, 1 - 0.5 * waist),
        (z_s, 1.0),
    ]
    rings = [(z, r * w, r * w * flat) for z, w in stations]
    for v in np.linspace(0.2, 1, 6):
        e = 0.5 * (1 - np.cos(np.pi * v))
        rings.append(
            (z_s + (z_neck - z_s) * v, r + (neck - r) * e, r * flat + (neck - r * flat) * e)
        )
    rings.append((height - cap + 3, neck, neck))
    body = loft(
        [
            np.column_stack(
                [
                    oval(
                        a,
                        b,
                        40,
                        power + (2 - power) * min(1.0, max(0.0, (z - z_s) / (z_neck - z_s))),
                    ),
                    np.full(40, z),
                ]
            )
            for z, a, b in rings
        ]
    )
    top = cylinder((0, 0, height - cap), (0, 0, height), neck * wide, 0.94 * neck * wide, n=32)
    solid = part.divided(
        "body", body, ("base", (0, 0, -1), -0.38 * height), ("neck", (0, 0, 1), z_s)
    )
    return Shape(
        solid + part("cap", top),
        dict.fromkeys(("body", "base", "neck"), WATER * filled) | {"cap": 900.0},
        ("body", filled),
    )


@family(
    "trigger_sprayer",
    "S1",
    parts=("bottle", "neck", "collar", "head", "nozzle", "trigger"),
    rests=("upright", "upright", "left"),
    receiver=("neck", "collar", "head", "trigger"),
    take="grip",
)
def trigger_sprayer(draw: Draw, part: Parts) -> Shape:
    """x to the nozzle, z up: a bottle, round or oval, under a spray head."""
    tall, a, flat = (
        draw("bottle", 130, 205),
        draw("half_width", 34, 48),
        draw("flatness", 0.68, 1.0),
    )
    shoulder, neck, filled = (
        draw("shoulder", 0.55, 0.78),
        draw("neck", 12, 15.5),
        draw("filled", 0.2, 0.9),
    )
    head, reach, rise = (
        draw("head_length", 82, 112),
        draw("reach", 0.5, 0.64),
        draw("head_rise", 48, 68),
    )
    lever, wide, power = (
        draw("lever", 52, 72),
        draw("head_half_width", 11, 15),
        draw("squareness", 2.0, 2.8),
    )
    b = a * flat
    z_s = shoulder * tall
    rows = spline(
        [
            (0, 0.86 * a, 0.86 * b),
            (3, 0.97 * a, 0.97 * b),
            (12, a, b),
            (0.55 * z_s, a, b),
            (z_s, 0.96 * a, 0.97 * b),
            (0.8 * (tall - z_s) + z_s, 0.5 * a + 0.4 * neck, 0.5 * b + 0.4 * neck),
            (tall, neck, neck),
        ],
        34,
    )
    body = loft([np.column_stack([oval(p, q, 34, power), np.full(34, z)]) for z, p, q in rows])
    collar = cylinder((0, 0, tall - 8), (0, 0, tall + 14), neck + 4, neck + 3, n=32) + cylinder(
        (0, 0, tall + 12), (0, 0, tall + 40), 0.7 * neck, n=24
    )
    z0 = tall + 26
    f, k = reach * head, rise / 72
    outline = spline(
        [
            (f, z0 + 48 * k),
            (0.65 * f, z0 + 60 * k),
            (0.1 * f, z0 + 71 * k),
            (f - 0.76 * head, z0 + 72 * k),
            (f - 0.96 * head, z0 + 64 * k),
            (f - head, z0 + 46 * k),
            (f - 0.9 * head, z0 + 32 * k),
            (f - 0.7 * head, z0 + 22 * k),
            (-14, z0 + 6),
            (-9, z0 - 4),
            (9, z0 - 4),
            (12, z0 + 22 * k),
            (0.65 * f, z0 + 32 * k),
        ],
        52,
        closed=True,
    )
    middle = np.array([outline[:, 0].mean(), z0 + 40 * k])
    shell = loft(
        [
            np.column_stack(
                [
                    (outline[:, 0] - middle[0]) * q + middle[0],
                    np.full(52, y),
                    (outline[:, 1] - middle[1]) * q + middle[1],
                ]
            )
            for y, q in (
                (-wide, 0.8),
                (-0.86 * wide, 0.93),
                (-0.55 * wide, 1),
                (0.55 * wide, 1),
                (0.86 * wide, 0.93),
                (wide, 0.8),
            )
        ]
    )
    zn = z0 + 47 * k
    nozzle = cylinder((f - 8, 0, zn), (f + 5, 0, zn), 9, n=24) + cylinder(
        (f + 2, 0, zn), (f + 9, 0, zn), 6, 5, n=20
    )
    x = 0.55 * f
    trigger = sweep(
        spline(
            [
                (x, 0, z0 + 40 * k),
                (x + 4, 0, z0 + 40 * k - 0.25 * lever),
                (x + 1, 0, z0 + 40 * k - 0.5 * lever),
                (x + 2, 0, z0 + 40 * k - 0.78 * lever),
                (x + 8, 0, z0 + 40 * k - lever),
            ],
            20,
        ),
        [oval(7.2, 3.5, 18, 2.6)],
        up=(1, 0, 0),
    )
    solid = (
        part.divided("bottle", body, ("neck", (0, 0, 1), 0.5 * (z_s + tall)))
        + part("collar", collar)
        + part("head", shell)
        + part("nozzle", nozzle)
        + part("trigger", trigger)
    )
    return Shape(
        solid,
        {
            "bottle": WATER * filled,
            "neck": WATER * filled,
            "collar": 700.0,
            "head": 520.0,
            "nozzle": 700.0,
            "trigger": 900.0,
        },
        ("bottle", filled),
    )
