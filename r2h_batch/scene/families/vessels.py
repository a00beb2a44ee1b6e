"""Cups, bowls and wine glasses (millimetres, z out of the opening)."""

from __future__ import annotations

import numpy as np

from r2h_batch.scene.families.family import (
    CERAMIC,
    GLASS,
    PLASTIC,
    STEEL,
    WOOD,
    Draw,
    Shape,
    family,
)
from r2h_batch.scene.families.shapes import Parts, oval, revolve, spline, sweep

MATERIALS = {
    "ceramic": CERAMIC,
    "steel": STEEL,
    "plastic": PLASTIC,
    "wood": WOOD,
    "glass": GLASS,
}

BOARD_KG_M2 = 0.45
"""Paper cups with a double wall: two layers of board of 210 g/m^2 (paxlander.com, "Which is the best disposable paper cup"),
each with 10 to 20 micrometres of polyethylene (paperjoypaper.com). Their walls of 1.8 to 3 mm are mostly air [choice]."""


@family(
    "cup",
    "S0",
    parts=("wall", "rim", "base", "handle"),
    rests=("upright", "upright", "upright", "upright", "side"),
)
def cup(draw: Draw, part: Parts) -> Shape:
    """A mug with a handle, or a tumbler or paper cup without one."""
    kind = draw.choice("kind", ("mug", "mug", "tumbler", "paper cup"))
    mug = kind == "mug"
    height = draw("height", 78, 118) if mug else draw("height", 85, 150)
    top = draw("radius", 35, 47) if mug else draw("radius", 34, 44)
    low = top * (draw("taper", 0.80, 1.0) if mug else draw("taper", 0.66, 0.92))
    wall = draw("wall", 2.8, 5.0) if mug else draw("wall", 1.8, 3.0)
    bulge = draw("bulge", -0.03, 0.05) * top
    floor = draw("floor", 4, 8)
    material = draw.choice(
        "material",
        {"mug": ("ceramic",), "tumbler": ("plastic", "glass", "steel"), "paper cup": ("paper",)}[
            kind
        ],
    )

    def outer(z: float) -> float:
        t = z / height
        return low + (top - low) * t + bulge * np.sin(np.pi * t)

    heights = np.linspace(0, height, 15)
    side = [(outer(z), z) for z in heights if 3 < z < height - 2]
    lip = [(top, height - 1.2), (top - wall / 2, height), (top - wall, height - 1.2)]
    hollow = [(outer(z) - wall, z) for z in heights[::-1] if floor + 2 < z < height - 3]
    profile = [
        (0, 0),
        (low - 2.5, 0),
        (low, 2.5),
        *side,
        *lip,
        *hollow,
        (outer(floor) - wall - 2, floor),
        (0, floor),
    ]
    rim, base = ("rim", (0, 0, 1), height - 8), ("base", (0, 0, -1), -6)
    solid = part.divided("wall", revolve(profile, 44), rim, base)
    if mug:
        tall, middle = (
            draw("handle_height", 0.5, 0.78) * height,
            draw("handle_at", 0.46, 0.56) * height,
        )
        out, droop = draw("handle_projection", 24, 40), draw("handle_droop", 0.35, 0.95)
        thick, wide = draw("handle_thickness", 3.5, 7), draw("handle_width", 4.5, 9)
        z0, z1 = middle - tall / 2, middle + tall / 2
        x0, x1 = outer(z0) - 0.6 * wall, outer(z1) - 0.6 * wall
        path = spline(
            [(x1, 0, z1), (x1 + 0.55 * out, 0, z1 + 2 * droop), (top + out, 0, middle + 0.28 * tall * droop),
             (top + 0.92 * out, 0, middle - 0.2 * tall * droop), (x0 + 0.5 * out, 0, z0 - 1), (x0, 0, z0)], 32,
        )  # fmt: skip
        inside = [(outer(z) - wall, z) for z in heights if floor + 2 < z < height - 3]
        hole = revolve(
            [
                (0, floor),
                (outer(floor) - wall - 2, floor),
                *inside,
                (top - wall, height + 9),
                (0, height + 9),
            ],
            40,
        )
        handle = sweep(path, [oval(wide, thick, 18, 2.6)], up=(0, 1, 0))
        solid += part("handle", handle) - part.hole("handle", hole)
    density = 1000 * BOARD_KG_M2 / wall if material == "paper" else MATERIALS[material]
    return Shape(solid, dict.fromkeys(("wall", "rim", "base", "handle"), density))


@family(
    "bowl", "S0", parts=("wall", "rim", "foot"), rests=("upright", "upright", "upright", "over")
)
def bowl(draw: Draw, part: Parts) -> Shape:
    """A cereal, soup or serving bowl with a foot ring."""
    radius, height = draw("radius", 58, 92), draw("height", 42, 80)
    foot, wall = draw("foot_share", 0.36, 0.55) * radius, draw("wall", 2.6, 5)
    round_ = draw("roundness", 0.8, 1.35)
    lip = draw("lip", 0, 6)
    material = draw.choice("material", ("ceramic", "ceramic", "wood", "steel"))
    t = np.linspace(0, 1, 13)
    outer = np.column_stack(
        [
            foot + 2 + (radius - foot - 2) * np.sin(t * np.pi / 2) ** round_,
            4 + (height - 4) * (1 - np.cos(t * np.pi / 2)) ** 0.9,
        ]
    )
    outer[-1, 0] += lip
    normal = np.column_stack([np.gradient(outer[:, 1]), -np.gradient(outer[:, 0])])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inner = outer - wall * normal
    inner[-1] = outer[-1] + (-wall, 0)
    inner[:, 1] = np.minimum(inner[:, 1], height)
    inner = inner[inner[:, 0] > 6]
    profile = [
        (0, 4),
        (foot - 4, 4),
        (foot - 3, 0),
        (foot, 0),
        *outer,
        *inner[::-1],
        (0, float(inner[0, 1])),
    ]
    solid = part.divided(
        "wall", revolve(profile, 52), ("rim", (0, 0, 1), height - 6), ("foot", (0, 0, -1), -4)
    )
    return Shape(solid, dict.fromkeys(("wall", "rim", "foot"), MATERIALS[material]))


@family(
    "wineglass",
    "S0",
    parts=("bowl", "rim", "stem", "foot"),
    rests=("upright", "upright", "upright", "upright", "over"),
)
def wineglass(draw: Draw, part: Parts) -> Shape:
    """A stemmed glass: red, white or sparkling wine."""
    kind = draw.choice("kind", ("red", "white", "flute"))
    belly = {"red": (36, 48), "white": (31, 39), "flute": (22, 28)}[kind]
    wide, mouth = draw("belly", *belly), draw("mouth", 0.68, 0.92)
    bowl_height = draw(
        "bowl_height", *{"red": (85, 115), "white": (78, 105), "flute": (110, 150)}[kind]
    )
    stem, thick = draw("stem", 55, 100), draw("stem_radius", 3.2, 4.6)
    foot, wall = draw("foot", 31, 41), draw("wall", 1.3, 2.0)
    full = draw("belly_at", 0.32, 0.48)
    z0 = 10 + stem
    height = z0 + bowl_height
    shape = [
        (0.12, 0.0),
        (0.55, 0.1),
        (0.9, 0.55 * full),
        (1.0, full),
        (0.5 + 0.5 * mouth, 0.75),
        (mouth, 1.0),
    ]
    outer = spline([(max(thick + 0.4, wide * r), z0 + bowl_height * z) for r, z in shape], 18)
    lift = np.array([0, 4.0])
    inner = spline(
        [(max(0.6, wide * r - wall * 1.1 if i else 0.6), z0 + bowl_height * z + (lift[1] if z < 0.2 else 0))
         for i, (r, z) in enumerate(shape)], 18,
    )[::-1]  # fmt: skip
    base = [
        (0, 0),
        (foot - 0.5, 0),
        (foot, 1.2),
        (foot - 2, 2.4),
        (0.55 * foot, 4),
        (0.26 * foot, 7),
        (thick + 0.8, 13),
    ]
    profile = [*base, (thick, 20), (thick, z0 - 12), *outer, *inner, (0, float(inner[-1, 1]))]
    rim, foot_, stem_ = (
        ("rim", (0, 0, 1), height - 8),
        ("foot", (0, 0, -1), -10),
        ("stem", (0, 0, -1), -z0),
    )
    solid = part.divided("bowl", revolve(profile, 36), rim, foot_, stem_)
    return Shape(solid, dict.fromkeys(("bowl", "rim", "stem", "foot"), float(GLASS)))
