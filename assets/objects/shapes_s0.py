"""The objects of split S0 (millimetres; z up): the six of r2h-v0 and r2h-v1, and two more of r2h-release."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.shapes import (
    Parts,
    Spec,
    box,
    capsule,
    cylinder,
    extrude,
    loft,
    oval,
    revolve,
    round_box,
    round_cone,
    smooth_min,
    spline,
    sweep,
    union,
)


def level_set_solid(
    inside: Callable[[np.ndarray], np.ndarray],
    bounds: Sequence[float],
    edge: float,
) -> Manifold:
    """manifold3d's solid where a vectorised field (N, 3) -> (N,) is positive: the grid is recorded
    first, then used."""
    seen: list[tuple[float, float, float]] = []

    def record(x: float, y: float, z: float) -> float:
        seen.append((x, y, z))
        return -1.0

    Manifold.level_set(record, bounds, edge)
    value = dict(zip(seen, inside(np.array(seen)).tolist(), strict=True))
    return Manifold.level_set(lambda x, y, z: value[x, y, z], bounds, edge)


def game_controller(part: Parts) -> Manifold:
    def inside(p: np.ndarray) -> np.ndarray:
        d = round_box(p, (0, 12, 0), (52, 30, 17), 14)
        for s in (-1, 1):
            d = smooth_min(d, round_cone(p, (s * 47, 18, -1), (s * 60, -34, -9), 22, 14.5), 14)
        d = np.maximum(d, p[:, 2] - 15.5)
        return -smooth_min(d, round_box(p, (0, 22, 4), (30, 18, 11), 4), 6)

    body = part("body", level_set_solid(inside, (-82, -56, -30, 82, 52, 24), 5.0))
    sticks = []
    for x, y in ((-24, 3), (24, 3)):
        sticks.append(cylinder((x, y, 8), (x, y, 17), 12.5, 11))
        sticks.append(cylinder((x, y, 15), (x, y, 23), 4.5))
        sticks.append(
            revolve([(0, 22), (6.5, 22), (8.5, 24), (8.5, 27), (6.5, 28.5), (0, 27.5)], 28).translate((x, y, 0))
        )
    pad = union([box(24, 8, 10, 1.5, (-47, 22, 14.5)), box(8, 24, 10, 1.5, (-47, 22, 14.5))])
    buttons = [
        capsule((47 + dx, 22 + dy, 12), (47 + dx, 22 + dy, 14.8), 5, 5, 20)
        for dx, dy in ((10, 0), (-10, 0), (0, 10), (0, -10))
    ]
    small = [box(9, 4, 8, 1.8, (s * 20, 26, 14)) for s in (-1, 1)]
    triggers = [box(30, 12, 9, 4, (s * 47, 42, 6)) for s in (-1, 1)] + [
        box(26, 14, 12, 5, (s * 47, 41, -6)) for s in (-1, 1)
    ]
    return (
        body
        + part("stick", union(sticks))
        + part("dpad", pad)
        + part("button", union(buttons + small))
        + part("trigger", union(triggers))
    ).scale((1.04, 1.035, 1.045))


def bowl(part: Parts) -> Manifold:
    t = np.linspace(0, 1, 15)
    outer = np.stack([30 + 50 * np.sin(t * np.pi / 2) ** 1.1, 4 + 51 * (1 - np.cos(t * np.pi / 2)) ** 0.9], axis=1)
    normal = np.stack([np.gradient(outer[:, 1]), -np.gradient(outer[:, 0])], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inner = outer - 2.8 * normal
    inner[-1] = outer[-1] + (-2.8, 0)
    inner[:, 1] = np.minimum(inner[:, 1], 55)
    profile = [(0, 4), (25, 4), (26, 0), (29.5, 0), *outer, *inner[::-1], (0, 7)]
    return part("wall", revolve(profile, 64).scale((1.006, 1.0, 1.0)))


def headphones(part: Parts) -> Manifold:
    t = np.linspace(np.radians(-8), np.radians(188), 41)
    arc = np.stack([np.zeros_like(t), 73 * np.cos(t), 28 + 86 * np.sin(t)], axis=1)
    width = 12 + 5 * np.sin(np.clip(t, 0, np.pi)) ** 2
    band = sweep(arc, [oval(3.4, w, 20, 3.0) for w in width], up=(1, 0, 0))
    inner = t[8:33]
    pad_arc = np.stack([0 * inner, 69 * np.cos(inner), 28 + 82 * np.sin(inner)], axis=1)
    pad = sweep(pad_arc, [oval(4.2, 14, 20, 3.0)], up=(1, 0, 0))
    total = part("band", band) + part("padding", pad)
    for s in (-1, 1):
        arm = box(15, 6.5, 52, 2.5, (0, s * 75.5, 4))
        cup = revolve(
            [(0, 0), (34, 0), (36.5, 3), (37.5, 8), (36, 14), (29, 18.5), (18, 20), (17, 21.5), (0, 21.5)], 40
        )
        cushion = revolve(
            [(0, 3.5), (16, 3.5), (16.5, -4), (19, -9), (24, -12), (29, -12), (34, -9), (36, -4), (36, 3.5)], 40
        )
        turn = (90 if s < 0 else -90, 0, 0)
        total += part("slider", arm)
        total += part("cup", cup.rotate(turn).translate((0, s * 63.5, -39)))
        total += part("cushion", cushion.rotate(turn).translate((0, s * 63.5, -39)))
    return total


def eyeglasses(part: Parts) -> Manifold:
    total = Manifold()
    outline = oval(24.5, 18.5, 40, 2.8)
    for s in (-1, 1):
        path = np.stack([-0.0022 * (outline[:, 0] + s * 34) ** 2 + 8, outline[:, 0] + s * 34.5, outline[:, 1]], axis=1)
        total += part("rim", sweep(path, [oval(1.9, 2.4, 12, 2.6)], up=(1, 0, 0), closed=True))
        lens = extrude(oval(24.5, 18.5, 40, 2.8), -0.9, 0.9).refine_to_length(4.0)
        lens = lens.warp_batch(
            lambda p, s=s: np.stack(
                [p[:, 2] - 0.0022 * (p[:, 0] + s * 34) ** 2 + 8, p[:, 0] + s * 34.5, p[:, 1]], axis=1
            )
        )
        total += part("lens", lens)
        total += part(
            "nose_pad",
            capsule((3, s * 8.6, -5), (0, s * 10.8, -11), 2.0, 2.2, 12)
            + capsule((6, s * 11.4, -4), (3, s * 8.6, -6), 1.4, 1.4, 12),
        )
        hinge = box(9, 9, 8, 1.8, (-2.5, s * 62.5, 9.5))
        temple = spline(
            [
                (0, s * 65.5, 9.5),
                (-50, s * 66.5, 9.5),
                (-95, s * 66, 8.5),
                (-112, s * 65, 4),
                (-125, s * 64, -6),
                (-134, s * 63, -19),
            ],
            45,
        )
        w = np.interp(np.arange(45), [0, 8, 30, 44], [3.6, 2.6, 2.4, 3.4])
        total += part("hinge", hinge)
        total += part("temple", sweep(temple, [oval(1.8, b, 12, 2.6) for b in w]))
    bridge = spline([(7, -11.5, 6), (8.5, -6, 9), (8.8, 0, 10), (8.5, 6, 9), (7, 11.5, 6)], 15)
    whole = total + part("bridge", sweep(bridge, [oval(1.9, 2.3, 12, 2.6)], up=(0, 0, 1)))
    return whole.scale((0.985, 1.02, 1.09))


def cup(part: Parts) -> Manifold:
    outer = [(26.5, 0), (28, 0), (30, 24), (31.5, 26), (33.3, 48), (34.6, 50), (37.4, 92)]
    lip = [(38.2, 95), (39.7, 96), (40, 98), (39, 100), (36.6, 100), (35.4, 98)]
    inner = [(34.9, 92), (32.1, 50.4), (30.9, 48.4), (29.1, 26.4), (27.6, 24.4), (25.8, 6)]
    profile = [(0, 2.5), (24.5, 2.5), *outer, *lip, *inner, (24.4, 5), (0, 5)]
    return part("wall", revolve(profile, 48))


def wineglass(part: Parts) -> Manifold:
    outer = spline([(4.2, 78), (16, 84), (29, 98), (35.5, 119), (34.5, 145), (30.5, 172)], 22)
    inner = spline([(29.0, 172), (32.4, 145), (33.2, 119), (27, 100.5), (15.5, 88.5), (0.6, 85.5)], 22)
    foot = [(0, 0), (34.5, 0), (35, 1.4), (33, 2.6), (20, 4), (9, 7), (5, 12), (3.9, 20), (3.7, 45), (3.8, 66)]
    profile = [*foot, *outer, *inner, (0, 85.5)]
    return part("bowl", revolve(profile, 48))


def can(part: Parts) -> Manifold:
    """A food can of 73 x 110 mm (400 g) with its seams and ring pull."""
    outer = [(34.5, 0), (36.8, 0), (37.6, 0.8), (37.6, 2.6), (36.8, 3.4), (36.5, 8), (36.5, 102)]
    seam = [(36.5, 106.6), (37.6, 107.4), (37.6, 109.2), (36.8, 110), (35.4, 110), (34.6, 109.2)]
    lid = [(34.4, 105), (32.5, 104.4), (31, 106), (27, 106), (26, 105), (0, 105)]
    body = part("body", revolve([(0, 3), (31, 3), (33, 1.4), *outer, *seam, *lid], 56))
    ring = revolve([(6.4, -0.9), (9.6, -0.9), (10.4, 0), (9.6, 0.9), (6.4, 0.9), (5.6, 0)], 32).translate(
        (0, 18, 106.2)
    )
    tab = box(9, 14, 1.8, 0.8, (0, 7.5, 106.2)) + cylinder((0, 3, 104), (0, 3, 107.2), 2.4, n=20)
    return body + part("tab", ring + tab)


def dispenser(part: Parts) -> Manifold:
    """A soap dispenser: a round bottle with a screwed pump, its head pressed with the palm or thumb."""
    profile = [(0, 2), (28, 2), (31, 0), (34, 0), (36.4, 3), (37, 9), (37, 92)]
    shoulder = spline([(37, 92), (36.2, 103), (31, 114), (22, 121), (17, 126)], 14)[1:]
    bottle = part("bottle", revolve([*profile, *shoulder, (17, 132), (0, 132)], 52))
    t = 2 * np.pi * np.arange(32) / 32
    rings = []
    for z, r, ridge in ((129, 18.2, 0), (130, 19.2, 0.05), (143, 19.2, 0.05), (145, 17.8, 0), (147, 11, 0)):
        rho = r * (1 - ridge * (np.arange(32) % 4 >= 2))
        rings.append(np.column_stack([rho * np.cos(t), rho * np.sin(t), np.full(32, z)]))
    pump = cylinder((0, 0, 140), (0, 0, 170), 6.5, n=28)
    head = revolve([(0, 164), (11, 164), (13.5, 166), (14, 176), (12.5, 180), (7, 182), (0, 182.4)], 36)
    spout = sweep(
        spline([(0, 0, 173), (18, 0, 174), (32, 0, 172.5), (42, 0, 167)], 20),
        [oval(a, b, 20, 2.6) for a, b in np.linspace((8, 5), (5, 3.6), 20)],
    )
    return bottle + part("collar", loft(rings)) + part("pump", pump + head) + part("nozzle", spout)


SPECS = (
    Spec("game_controller", "S0", (155, 100, 55), 0.25, 4.2, ("body", "grip", "stick", "dpad", "button", "trigger"),
         game_controller, cuts=(("body", ((0.8, -0.6, 0), 38), "grip"), ("body", ((-0.8, -0.6, 0), 38), "grip")),
         fine=(("stick", 2.6), ("dpad", 2.6), ("button", 2.2), ("trigger", 3.2)), frame="x to its right, y away from the player"),
    Spec("bowl", "S0", (161, 160, 55), 0.147, 4.6, ("wall", "rim", "foot"), bowl,
         cuts=(("wall", ((0, 0, 1), 50), "rim"), ("wall", ((0, 0, -1), -4.0), "foot")), frame="z out of the opening"),
    Spec("headphones", "S0", (190, 170, 75), 0.25, 4.8, ("band", "padding", "slider", "cup", "cushion"), headphones,
         fine=(("slider", 3.0),), frame="y from ear to ear, z to the band"),
    Spec("eyeglasses", "S0", (140, 145, 45), 0.03, 2.9, ("temple", "rim", "lens", "bridge", "nose_pad", "hinge"),
         eyeglasses, frame="x the direction of sight, y to the left, z up"),
    Spec("cup", "S0", (100, 80, 80), 0.04, 4.0, ("wall", "rim", "base"), cup,
         cuts=(("wall", ((0, 0, 1), 92), "rim"), ("wall", ((0, 0, -1), -6), "base")), frame="z out of the opening"),
    Spec("wineglass", "S0", (172, 71, 71), 0.15, 4.7, ("bowl", "rim", "stem", "foot"), wineglass, fine=(("stem", 3.4),),
         cuts=(("bowl", ((0, 0, 1), 164), "rim"), ("bowl", ((0, 0, -1), -78), "stem"), ("stem", ((0, 0, -1), -10), "foot")),
         frame="z out of the opening"),
    Spec("can", "S0", (110, 75, 75), 0.455, 4.4, ("body", "lid", "base", "tab"), can, fine=(("tab", 2.2), ("lid", 3.0)),
         cuts=(("body", ((0, 0, 1), 103.5), "lid"), ("body", ((0, 0, -1), -4), "base")), frame="z to the lid, y to the pull"),
    Spec("dispenser", "S0", (182, 84, 74), 0.33, 4.6, ("bottle", "base", "collar", "pump", "nozzle"), dispenser,
         cuts=(("bottle", ((0, 0, -1), -8), "base"),), fine=(("collar", 3.0), ("pump", 2.8), ("nozzle", 2.6)),
         frame="z to the pump, x to the nozzle"),
)  # fmt: skip
