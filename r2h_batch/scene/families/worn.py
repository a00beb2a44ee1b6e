"""Things that people wear or play with: eyeglasses, headphones, game controllers (millimetres, z up)."""

from __future__ import annotations

from typing import Any

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.family import Draw, Shape, family
from r2h_batch.scene.families.shapes import (
    Parts,
    box,
    capsule,
    chain,
    cylinder,
    extrude,
    oval,
    revolve,
    spline,
    sweep,
    union,
)


@family(
    "eyeglasses",
    "S0",
    parts=("temple", "rim", "lens", "bridge", "nose_pad", "hinge"),
    rests=("upright", "upright", "over"),
)
def eyeglasses(draw: Draw, part: Parts) -> Shape:
    """x the direction of sight. Lens, bridge and temple lengths are the numbers stamped on a frame: 44 to 58, 14
    to 22 and 130 to 150 mm."""
    lens, tall = draw("lens", 44, 58) / 2, draw("lens_height", 30, 46) / 2
    bridge, temple = draw("bridge", 14, 22), draw("temple", 130, 150)
    rim, square = draw("rim", 1.5, 2.8), draw("squareness", 2.0, 4.0)
    wrap, hook = draw("wrap_per_m", 1.2, 3.0) / 1000, draw("hook", 22, 34)
    side = draw("temple_height", 1.8, 4.2)
    middle = bridge / 2 + lens
    outline = oval(lens, tall, 36, square)
    edge = middle + lens

    def front(y: Any) -> Any:
        """x of the frame, bent around the face."""
        return 8 - wrap * np.square(y)

    total = Manifold()
    for s in (-1, 1):
        path = np.column_stack(
            [front(outline[:, 0] + s * middle), outline[:, 0] + s * middle, outline[:, 1]]
        )
        total += part(
            "rim", sweep(path, [oval(rim, rim * 1.15, 12, 2.6)], up=(1, 0, 0), closed=True)
        )
        disc = extrude(outline, -0.9, 0.9).refine_to_length(5.0)
        disc = disc.warp_batch(
            lambda p, s=s: np.column_stack(
                [p[:, 2] + front(p[:, 0] + s * middle), p[:, 0] + s * middle, p[:, 1]]
            )
        )
        total += part("lens", disc)
        pad = s * (bridge / 2 - 1.5)
        total += part(
            "nose_pad",
            capsule((4, pad, -5), (1, pad + s * 2, -12), 2.0, 2.2, 12)
            + capsule(
                (float(front(bridge / 2)), s * (bridge / 2 + 0.5 * rim), 0),
                (4, pad, -6),
                1.55,
                1.4,
                12,
            ),
        )
        x0, out = float(front(edge)), edge + rim + 1.5
        total += part("hinge", box(9, 7, 7, 1.8, (x0 - 2.5, s * (out - 1.5), 0.35 * tall)))
        bend = x0 - temple + hook
        arm = spline(
            [(x0, s * out, 0.35 * tall), (x0 - 0.4 * temple, s * (out + 2), 0.35 * tall), (bend, s * (out + 1), 0.3 * tall),
             (bend - 0.6 * hook, s * out, 0.3 * tall - 0.4 * hook), (bend - 0.85 * hook, s * (out - 1), 0.3 * tall - hook)], 30,
        )  # fmt: skip
        total += part(
            "temple",
            sweep(
                arm,
                [
                    oval(1.7, b, 12, 2.6)
                    for b in np.interp(
                        np.arange(30), [0, 6, 20, 29], [side + 0.8, side, side * 0.9, side + 0.6]
                    )
                ],
            ),
        )
    z, half = 0.3 * tall, bridge / 2 + rim
    curve = spline(
        [
            (float(front(half)) - 0.5, -half, z),
            (9, -half / 2, z + 2.5),
            (9.3, 0, z + 3.2),
            (9, half / 2, z + 2.5),
            (float(front(half)) - 0.5, half, z),
        ],
        13,
    )
    total += part("bridge", sweep(curve, [oval(rim * 0.95, rim, 12, 2.6)], up=(0, 0, 1)))
    return Shape(
        total,
        dict.fromkeys(("rim", "nose_pad", "hinge", "temple", "bridge"), 1300.0) | {"lens": 1200.0},
    )


@family(
    "headphones",
    "S0",
    parts=("band", "padding", "slider", "cup", "cushion"),
    rests=("face", "back"),
)
def headphones(draw: Draw, part: Parts) -> Shape:
    """Over-ear or on-ear; y from ear to ear, z to the band."""
    kind = draw.choice("kind", ("over-ear", "over-ear", "on-ear"))
    half, rise = draw("half_width", 66, 80), draw("rise", 74, 95)
    cup_r = draw("cup_radius", 36, 45) if kind == "over-ear" else draw("cup_radius", 27, 34)
    oval_, deep = draw("cup_oval", 0.78, 1.0), draw("cup_depth", 16, 26)
    cushion, band = draw("cushion", 12, 20), draw("band_width", 9, 17)
    thick, pad = draw("band_thickness", 2.4, 4.0), draw("padding", 3.0, 6.0)
    t = np.linspace(np.radians(-6), np.radians(186), 37)
    arc = np.column_stack([np.zeros_like(t), half * np.cos(t), 26 + rise * np.sin(t)])
    width = band + 4 * np.sin(np.clip(t, 0, np.pi)) ** 2
    total = part("band", sweep(arc, [oval(thick, w, 18, 3.0) for w in width], up=(1, 0, 0)))
    inner = t[8:29]
    lining = np.column_stack(
        [0 * inner, (half - pad) * np.cos(inner), 26 + (rise - pad) * np.sin(inner)]
    )
    total += part("padding", sweep(lining, [oval(pad, band * 1.05, 18, 3.0)], up=(1, 0, 0)))
    low = -cup_r * 0.9
    for s in (-1, 1):
        total += part(
            "slider", box(12, 5.5, 62 + low * -0.3, 2.2, (0, s * (half + 1.5), 6 + low * 0.15))
        )
        shell = revolve(
            [
                (0, 0),
                (cup_r - 2, 0),
                (cup_r, 3),
                (cup_r, 0.5 * deep),
                (0.8 * cup_r, 0.85 * deep),
                (0.4 * cup_r, deep),
                (0, deep),
            ],
            36,
        )
        ring = revolve(
            [
                (0, 3),
                (0.45 * cup_r, 3),
                (0.46 * cup_r, 2 - 0.5 * cushion),
                (0.6 * cup_r, -cushion),
                (0.85 * cup_r, -cushion),
                (0.98 * cup_r, -0.4 * cushion),
                (0.98 * cup_r, 3),
            ],
            36,
        )
        turn, at = (90 if s < 0 else -90, 0, 0), (0, s * (half - 0.35 * deep), low)
        shell, ring = (m.scale((oval_, 1, 1)).rotate(turn).translate(at) for m in (shell, ring))
        total += part("cup", shell) + part("cushion", ring)
    return Shape(
        total,
        {"band": 900.0, "padding": 250.0, "slider": 1400.0, "cup": 650.0, "cushion": 200.0},
    )


@family(
    "game_controller",
    "S0",
    parts=("body", "grip", "stick", "dpad", "button", "trigger"),
    rests=("upright", "upright", "over"),
)
def game_controller(draw: Draw, part: Parts) -> Shape:
    """x to its right, y away from the player: a body of overlapping rounded solids with two handles."""
    span, deep, tall = draw("span", 88, 106), draw("depth", 52, 68), draw("height", 27, 35)
    grip, spread, drop = (
        draw("grip_length", 34, 50),
        draw("grip_spread", 4, 22),
        draw("grip_drop", 2, 12),
    )
    r0, r1 = draw("grip_radius", 19, 24), draw("grip_end", 13, 17)
    stick_y, stick_x = draw("stick_y", -10, 4), draw("stick_x", 20, 30)
    low = draw.choice("left_stick", ("low", "high"))
    body = box(span, deep, tall, 0.42 * tall, (0, 12, 0), n=20)
    handles = Manifold()
    for s in (-1, 1):
        handles += chain(
            [
                (s * 0.45 * span, 20, -1),
                (s * (0.45 * span + 0.4 * spread), -6, -3),
                (s * (0.45 * span + spread), 20 - grip - 10, -1 - drop),
            ],
            [r0 * 0.85, r0 * 0.92, r1],
            20,
        )
    handles = handles.trim_by_plane((0, 0, -1), -(tall / 2 - 0.5))
    top = tall / 2
    sticks = Manifold()
    for s in (-1, 1):
        y = stick_y + (26 if s < 0 and low == "high" else 0)
        x = s * (stick_x + (16 if s < 0 and low == "high" else 0))
        sticks += cylinder((x, y, top - 6), (x, y, top + 6), 4.5, n=20)
        sticks += revolve(
            [(0, 0), (6.5, 0), (8.5, 2), (8.5, 5), (6.5, 6.5), (0, 5.5)], 24
        ).translate((x, y, top + 5))
    dx, dy = (-stick_x, stick_y) if low == "high" else (-0.45 * span, 24)
    pad = box(22, 7.5, 8, 1.5, (dx, dy, top - 1)) + box(7.5, 22, 8, 1.5, (dx, dy, top - 1))
    buttons = union(
        capsule((0.45 * span + a, 24 + b, top - 4), (0.45 * span + a, 24 + b, top - 2), 5, 5, 16)
        for a, b in ((9.5, 0), (-9.5, 0), (0, 9.5), (0, -9.5))
    )
    back = 12 + deep / 2
    triggers = union(
        box(28, 13, h, 4, (s * 0.42 * span, back + 1, z), n=16)
        for s in (-1, 1)
        for z, h in ((0.2 * tall, 9), (-0.22 * tall, 12))
    )
    solid = (
        part("body", body)
        + part("grip", handles)
        + part("stick", sticks)
        + part("dpad", pad)
        + part("button", buttons)
        + part("trigger", triggers)
    )
    return Shape(
        solid,
        dict.fromkeys(("body", "grip", "stick", "dpad", "button", "trigger"), 620.0),
    )
