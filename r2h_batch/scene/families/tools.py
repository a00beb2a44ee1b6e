"""Hand tools and a toothbrush (millimetres; x along the tool, its business end at +x)."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.family import PLASTIC, RUBBER, STEEL, WOOD, Draw, Shape, family
from r2h_batch.scene.families.shapes import (
    Parts,
    along_x,
    box,
    cylinder,
    extrude,
    loft,
    oval,
    spline,
    sweep,
    union,
)


@family(
    "hammer",
    "S1",
    parts=("grip", "shaft", "head", "face", "claw"),
    rests=("upright", "over"),
    receiver=("grip",),
    take="handle",
)
def hammer(draw: Draw, part: Parts) -> Shape:
    """Claw, ball-peen, cross-peen hammer or mallet; y to the striking face."""
    kind = draw.choice("kind", ("claw", "claw", "ball", "cross", "mallet"))
    length, share = draw("length", 240, 360), draw("grip_share", 0.42, 0.68)
    a, flat, swell = (
        draw("grip_radius", 12, 18),
        draw("flatness", 0.65, 0.9),
        draw("swell", 0.9, 1.2),
    )
    slim = draw("shaft_slimness", 0.55, 0.85)
    r = draw("head_radius", 24, 34) if kind == "mallet" else draw("head_radius", 11, 16.5)
    head_length, setback, back = (
        draw("head_length", 85, 140),
        draw("setback", 0.55, 1.0),
        draw("peen_share", 0.35, 0.6),
    )
    bend = draw("claw_bend", 5, 18)
    b, g = a * flat, share * length
    grip = along_x(
        [
            (0, 0.75 * a, 0.75 * b),
            (5, a * swell, b * swell),
            (0.3 * g, 0.92 * a, 0.92 * b),
            (0.7 * g, a, b),
            (g, 0.88 * a, 0.88 * b),
        ],
        26,
    )
    shaft = along_x(
        [
            (g - 12, a * slim, b * slim),
            (0.8 * length, 0.95 * a * slim, 0.95 * b * slim),
            (length, a * slim, b * slim),
        ],
        16,
    )
    x, rear = length - r * setback, back * head_length
    front = head_length - rear
    solid = part("grip", grip) + part("shaft", shaft)
    if kind == "mallet":
        head = cylinder((x, -rear, 0), (x, front - 8, 0), r, n=36)
        solid += part("head", head) + part(
            "face", cylinder((x, front - 8, 0), (x, front, 0), r, 0.95 * r, n=36)
        )
        density = {"head": float(RUBBER), "face": float(RUBBER)}
    else:
        eye = box(2.2 * r, 0.4 * head_length, 2.1 * r, 3, (x, 0, 0)) + cylinder(
            (x, 0, 0), (x, front - 12, 0), 0.85 * r, n=28
        )
        solid += part("head", eye) + part(
            "face", cylinder((x, front - 14, 0), (x, front, 0), r, n=32)
        )
        if kind == "ball":
            peen = cylinder((x, 0.6 * r - rear, 0), (x, 0, 0), 0.6 * r, 0.8 * r) + Manifold.sphere(
                0.85 * r, 28
            ).translate((x, 0.85 * r - rear, 0))
        elif kind == "cross":
            peen = Manifold.batch_hull(
                [
                    box(1.8 * r, 4, 1.8 * r, 1, (x, -0.1 * head_length, 0)),
                    box(3, 3, 1.7 * r, 1, (x, -rear, 0)),
                ]
            )
        else:
            top = spline(
                [
                    (x + 0.9 * r, -0.1 * head_length),
                    (x + 0.7 * r - 0.2 * bend, -0.6 * rear),
                    (x - bend, -rear),
                ],
                12,
            )
            low = spline(
                [
                    (x - bend - 3, 3 - rear),
                    (x - 0.35 * r - 0.2 * bend, -0.6 * rear),
                    (x - 0.9 * r, -0.1 * head_length),
                ],
                12,
            )
            slot = Manifold.batch_hull(
                [
                    cylinder((x - 60, y, z), (x + 60, y, z), 1, n=8)
                    for y, z in ((-0.45 * rear, 0), (-rear - 9, 5), (-rear - 9, -5))
                ]
            )
            peen = extrude(np.concatenate([top, low]), -0.9 * r, 0.9 * r) - slot
        solid += part("claw", peen)
        density = dict.fromkeys(("head", "face", "claw"), float(STEEL))
    return Shape(solid, {"grip": 900.0, "shaft": float(WOOD), **density})


@family(
    "pliers",
    "S1",
    parts=("handle", "jaw", "pivot"),
    rests=("upright", "over"),
    receiver=("handle",),
    take="handles",
)
def pliers(draw: Draw, part: Parts) -> Shape:
    """Needle-nose, combination or wide-jawed pliers, nearly closed; z along the pivot."""
    kind = draw.choice("kind", ("needle", "combination", "combination"))
    handle, open_ = draw("handle", 90, 135), draw("handle_spread", 16, 26)
    nose = draw("nose", 50, 78) if kind == "needle" else draw("nose", 30, 46)
    root = draw("jaw_width", 10, 15)
    tip = (
        draw("tip_share", 0.25, 0.42) * root
        if kind == "needle"
        else draw("tip_share", 0.6, 0.85) * root
    )
    steel, sleeve, bow = draw("jaw_thickness", 8, 13), draw("sleeve", 5.2, 8), draw("bow", 0.0, 4.0)
    arms = Manifold()
    for s in (-1, 1):
        path = spline(
            [
                (12, 2, 0),
                (0, -3, 0),
                (-14, -0.5 * open_, 0),
                (-0.38 * handle, -0.85 * open_ - bow, 0),
                (-0.72 * handle, -open_ - bow, 0),
                (-handle, -0.9 * open_, 0),
            ],
            36,
        )
        path[:, 1] *= s
        u = np.linspace(0, 1, 28)
        grip = sweep(
            path[8:],
            [
                oval(
                    sleeve + 0.8 * np.sin(np.pi * t) - 1.5 * t**6,
                    0.95 * sleeve - 0.8 * t**6,
                    18,
                    2.4,
                )
                for t in u
            ],
        )
        arms += part(
            "jaw",
            sweep(path[:13], [oval(w, 0.48 * steel, 18, 3.2) for w in np.linspace(7.5, 5.5, 13)]),
        ) + part("handle", grip)
    jaws = Manifold()
    for s in (-1, 1):
        outline = np.array(
            [
                (-8, 0.5),
                (-9, 6),
                (-4, root * 0.95),
                (8, root),
                (0.4 * nose, 0.5 * (root + tip) + 0.4),
                (nose - 2, tip),
                (nose, 0.7 * tip),
                (nose, 0.6),
                (10, 0.6),
            ]
        )
        outline[:, 1] *= s
        half = extrude(outline, -steel / 2, steel / 2)
        end = 0.62 if kind == "needle" else 0.95
        wedge = extrude(
            [
                (-20, steel / 2),
                (10, steel / 2),
                (nose + 1, end * steel / 2),
                (nose + 1, -end * steel / 2),
                (10, -steel / 2),
                (-20, -steel / 2),
            ],
            -20,
            20,
        ).rotate((90, 0, 0))
        jaws += part("jaw", half ^ wedge)
    pivot = cylinder((0, 0, -steel / 2 - 1), (0, 0, steel / 2 + 1), 0.62 * root, n=28)
    boss = cylinder((0, 0, -steel / 2), (0, 0, steel / 2), 0.98 * root, n=32)
    return Shape(
        arms + jaws + part("pivot", boss) + part("pivot", pivot),
        {"handle": 3200.0, "jaw": float(STEEL), "pivot": float(STEEL)},
    )


@family(
    "knife",
    "S1",
    parts=("handle", "blade"),
    rests=("upright", "over"),
    receiver=("handle",),
    take="handle",
)
def knife(draw: Draw, part: Parts) -> Shape:
    """A kitchen knife, from paring to chef's; y to the blade's back."""
    handle, h, w = (
        draw("handle", 85, 130),
        draw("handle_height", 9.5, 16),
        draw("handle_width", 6.5, 11.5),
    )
    blade, tall, thick = (
        draw("blade", 60, 205),
        draw("blade_height", 13, 46),
        draw("blade_thickness", 1.4, 3.0),
    )
    curve, power = draw("curvature", -4, 5), draw("squareness", 2.2, 4)
    waist, butt = draw("waist", 0.8, 1.0), draw("front", 0.75, 1.0)
    drop, belly, top_share = (
        draw("point_drop", 0, 0.7),
        draw("belly", 0.25, 0.6),
        draw("blade_top", 0.3, 0.9),
    )
    count = 26
    x = np.linspace(0, handle, count)
    size = np.interp(
        x, np.array([0, 6 / handle, 0.35, 0.65, 0.93, 1]) * handle, [0.8, 1, 0.95, 1.0, waist, butt]
    )
    bend = curve * np.sin(np.pi * x / handle)
    scales = loft(
        [
            np.column_stack(
                [
                    np.full(22, x[i]),
                    oval(h * size[i], w * min(1.0, 1.02 * size[i]), 22, power) + (bend[i], 0),
                ]
            )
            for i in range(count)
        ]
    )
    top = top_share * h
    spine = [
        (handle - 8 + u * (blade + 8), top - 0.6 * drop * tall * max(0.0, (u - 0.55) / 0.45) ** 2)
        for u in np.linspace(0, 1, 12)
    ]
    tip = spine[-1][1]
    edge = [
        (handle + blade * (1 - v), top - tall + (tip - top + tall) * (1 - min(1.0, v / belly)) ** 2)
        for v in np.linspace(0.02, 1, 14)
    ]
    steel = extrude(
        np.array([*spine, *edge, (handle + 1, -0.3 * h), (handle - 8, -0.3 * h)]),
        -thick / 2,
        thick / 2,
    )
    return Shape(
        part("handle", scales) + part("blade", steel),
        {"handle": 1200.0, "blade": float(STEEL)},
    )


@family(
    "toothbrush",
    "S1",
    parts=("handle", "neck", "grip", "head", "bristles"),
    rests=("upright", "over", "roll"),
    receiver=("handle", "grip"),
    take="handle",
)
def toothbrush(draw: Draw, part: Parts) -> Shape:
    """A manual toothbrush; z to the bristles."""
    length, head = draw("length", 150, 195), draw("head", 22, 33)
    thick, wide = draw("handle_thickness", 3.6, 6.2), draw("handle_width", 4.6, 7.6)
    neck, bend, tufts = draw("neck", 2.3, 3.4), draw("bend", -2.5, 3.5), draw("bristles", 9, 13)
    head_w, swell = draw("head_width", 4.8, 6.8), draw("swell", 0.8, 1.15)
    end = length - head
    stations = spline(
        [
            (0, 0, 0.55 * wide, 0.5 * thick), (3, 0.2, 0.85 * wide, 0.8 * thick), (0.16 * end, 0, wide, thick),
            (0.42 * end, -0.4, wide * swell, thick), (0.62 * end, 0.3 * bend, wide * 0.95, 0.95 * thick),
            (0.78 * end, 0.7 * bend, 1.25 * neck, 1.15 * neck), (0.92 * end, bend, neck, 0.9 * neck),
            (end + 6, bend, neck, 0.75 * neck),
        ], 48,
    )  # fmt: skip
    handle = loft(
        [np.column_stack([np.full(18, x), oval(a, b, 18, 2.4) + (0, z)]) for x, z, a, b in stations]
    )
    plate = extrude(
        oval(head / 2 + 2, head_w, 32, 2.8) + (end + head / 2, 0), bend - 2.0, bend + 2.4
    )
    rows = Manifold()
    count = int(head // 4.6)
    for k in range(count):
        x = end + 3.5 + (head - 7) * k / (count - 1)
        rows += box(
            3.0,
            1.55 * head_w if k in (0, count - 1) else 1.8 * head_w,
            tufts,
            0,
            (x, 0, bend + 1.5 + tufts / 2),
        )
    pads = union(
        box(3.2, 1.15 * wide, 3, 1.2, (x, 0, 0.8 * thick - 0.2), n=8)
        for x in np.linspace(0.18, 0.45, 5) * end
    )
    solid = (
        part.divided("handle", handle, ("neck", (1, 0, 0), 0.6 * end))
        + part("grip", pads)
        + part("head", plate)
        + part("bristles", rows)
    )
    return Shape(
        solid,
        {
            "handle": 1050.0,
            "neck": 1050.0,
            "grip": float(RUBBER),
            "head": 1050.0,
            "bristles": 450.0,
        },
    )


@family(
    "screwdriver",
    "S1",
    parts=("handle", "shaft", "tip"),
    rests=("roll",),
    receiver=("handle",),
    take="handle",
)
def screwdriver(draw: Draw, part: Parts) -> Shape:
    """A fluted handle with a flat or cross tip, stubby to long."""
    handle, r, flutes = (
        draw("handle", 70, 125),
        draw("handle_radius", 9.5, 18),
        int(draw.choice("flutes", ("3", "6", "8"))),
    )
    depth, neck, shaft, s, bulge = (
        draw("flute_depth", 0, 0.13),
        draw("neck", 0.6, 0.85),
        draw("shaft", 50, 200),
        draw("shaft_radius", 2.2, 4.5),
        draw("bulge", 0, 1),
    )
    t = 2 * np.pi * np.arange(44) / 44
    profile = spline(
        [
            (0, 0.55 * r, 0), (2.5, 0.8 * r, 0), (0.08 * handle, 0.97 * r, 0.1 * depth), (0.2 * handle, r, depth),
            (0.62 * handle, r * (1 - 0.15 * bulge), depth), (0.75 * handle, r * (neck + 0.1), 0.3 * depth),
            (0.84 * handle, r * neck, 0), (0.93 * handle, r * (neck + 0.08), 0), (handle, 0.6 * r, 0),
        ], 34,
    )  # fmt: skip
    rings = []
    for x, radius, flute in profile:
        rho = radius * (1 - max(flute, 0) * (1 - np.cos(flutes * t)))
        rings.append(np.column_stack([np.full(44, x), rho * np.cos(t), rho * np.sin(t)]))
    end = handle + shaft
    if draw.choice("tip", ("flat", "cross")) == "flat":
        tip = loft(
            [
                np.column_stack([np.full(20, end + x - 1), oval(a * s, b * s, 20, p)])
                for x, a, b, p in ((0, 0.95, 0.95, 2), (6, 1.3, 0.7, 3), (10, 1.2, 0.25, 5))
            ]
        )
    else:
        tip = cylinder((end - 1, 0, 0), (end + 7, 0, 0), s, 0.25 * s, n=16)
    solid = (
        part("handle", loft(rings))
        + part("shaft", cylinder((handle - 8, 0, 0), (end, 0, 0), s, n=16))
        + part("tip", tip)
    )
    return Shape(
        solid,
        {"handle": float(PLASTIC) * 1.1, "shaft": float(STEEL), "tip": float(STEEL)},
    )


@family(
    "scissors",
    "S1",
    parts=("blade", "shank", "loop", "pivot"),
    rests=("upright", "over"),
    receiver=("loop",),
    take="loops",
)
def scissors(draw: Draw, part: Parts) -> Shape:
    """Household or tailor's scissors, nearly closed, with equal or unequal loops; z along the pivot."""
    blade, width, steel = (
        draw("blade", 60, 130),
        draw("blade_width", 7, 13),
        draw("blade_thickness", 2.0, 3.2),
    )
    shank, loop, round_ = (
        draw("shank", 22, 40),
        draw("loop_length", 36, 62),
        draw("loop_roundness", 0.46, 0.72),
    )
    thick, uneven, turn = (
        draw("loop_thickness", 3.6, 5.4),
        draw("uneven", 1.0, 1.35),
        np.radians(draw("opening", 2.5, 7)),
    )
    total = Manifold()
    for s in (-1, 1):
        outline = np.array(
            [
                (blade, 1.2),
                (blade - 1, -0.6),
                (0, -0.3 * width),
                (-12, -0.7 * width),
                (-30, -0.8 * width),
                (-36, -3),
                (-14, 0.5 * width),
                (-2, 0.9 * width),
                (0.2 * blade, width),
                (0.62 * blade, 0.72 * width),
            ]
        )
        c, sn = np.cos(turn), np.sin(turn)
        outline = outline @ np.array([[c, sn], [-sn, c]]) * (1, s)
        low = -steel if s > 0 else -0.2
        total += part("blade", extrude(outline, low, low + steel + 0.2))
        long = loop * (uneven if s > 0 else 1.0)
        wide, x0, y0 = round_ * long, -14 - shank, -(0.9 * width + 8)
        ring = oval(long / 2, wide / 2, 40, 2.2) + (x0 - 0.46 * long, y0 - 0.36 * wide)
        ring = ring * (1, s)
        neck = spline(
            [
                (-12, -0.3 * width * s, 0),
                (-14 - 0.5 * shank, -(0.55 * width + 4) * s, 0),
                (x0 - 0.04 * long, (y0 - 0.1 * wide) * s, 0),
            ],
            10,
        )
        total += part(
            "loop",
            sweep(
                np.column_stack([ring, 0 * ring[:, 0]]),
                [oval(thick * 0.85, 1.3 * thick, 14, 2.3)],
                closed=True,
            ),
        )
        total += part(
            "shank",
            sweep(
                neck,
                [
                    oval(a, b, 16, 2.4)
                    for a, b in zip(np.linspace(5, 6, 10), np.linspace(4.5, 6, 10))
                ],
            ),
        )
    pin = part("pivot", cylinder((0, 0, -steel - 1), (0, 0, steel + 1), 5.0, n=24))
    return Shape(
        total + pin,
        {"blade": float(STEEL), "loop": 1200.0, "shank": 1200.0, "pivot": float(STEEL)},
    )
