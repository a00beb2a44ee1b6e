"""The ten objects of split S1 (millimetres; x along the tool, its business end at +x, unless the frame says otherwise)."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from r2h_batch.assets.objects.shapes import (
    Parts,
    Spec,
    box,
    capsule,
    cylinder,
    extrude,
    loft,
    oval,
    revolve,
    spline,
    sweep,
    union,
)

TO_X = (0, 90, 0)


def along_x(stations: list[tuple[float, float, float]], count: int, power: float = 2.4, n: int = 24) -> Manifold:
    """A straight loft: (x, half width y, half height z) stations, smoothed."""
    x, a, b = spline(stations, count).T
    return loft([np.column_stack([np.full(n, x[i]), oval(a[i], b[i], n, power)]) for i in range(count)])


def hammer(part: Parts) -> Manifold:
    grip = along_x([(-165, 13, 9.5), (-160, 17.5, 13), (-150, 18.5, 13.5), (-120, 15.5, 11.5), (-80, 17, 12.5), (-45, 15, 11.5), (-30, 14, 10.5)], 40)
    shaft = along_x([(-40, 10.5, 8), (0, 9.5, 7.5), (60, 10, 7.5), (110, 11, 8), (160, 11.5, 8.5)], 30)
    cheek = loft([np.column_stack([oval(w, h, 24, 5) + (144, 0), np.full(24, y)])[:, [0, 2, 1]] for y, w, h in
                  ((-16, 13, 13), (-10, 15, 15.5), (10, 15, 15.5), (18, 12, 12))])
    neck = cylinder((144, 14, 0), (144, 36, 0), 11.5)
    face = revolve([(0, 0), (12, 0), (15.5, 4), (16, 6), (16, 18), (14.5, 20), (0, 20.6)], 40).rotate((-90, 0, 0)).translate((144, 34, 0))
    top = spline([(156, -8), (158, -30), (152, -52), (139, -71.5)], 14)
    low = spline([(136.5, -69.5), (141, -52), (136, -30), (131, -8)], 14)
    claw = extrude(np.concatenate([top, low]), -15, 15)
    notch = Manifold.batch_hull([cylinder((100, -36, 0), (200, -36, 0), 1.2), cylinder((100, -80, 4.6), (200, -80, 4.6), 1.0), cylinder((100, -80, -4.6), (200, -80, -4.6), 1.0)])
    return (
        part("grip", grip) + part("shaft", shaft)
        + (part("head", cheek + neck) + part("face", face) + part("claw", claw)) - part("claw", notch)
    )


def pliers(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        arm = spline([(12, 2, 0), (0, -3, 0), (-14, -10, 0), (-40, -17.5, 0), (-80, -21, 0), (-112, -19.5, 0)], 44)
        arm[:, 1] *= s
        steel = sweep(arm[:16], [oval(w, 4.6, 20, 3.2) for w in np.linspace(7.5, 5.5, 16)])
        u = np.linspace(0, 1, 34)
        sleeve = sweep(arm[10:], [oval(6.0 + 0.9 * np.sin(np.pi * t) - 1.5 * t**6, 5.8 - 0.8 * t**6, 20, 2.4) for t in u])
        total += part("jaw", steel) + part("handle", sleeve)
    nose = Manifold()
    for s in (-1, 1):
        outline = np.array([(-8, 0.5), (-9, 6), (-4, 12.0), (8, 13.0), (22, 10.5), (44, 7.0), (66, 4.2), (68, 2.8), (68, 0.7), (30, 0.7), (24, 2.4), (16, 2.4), (10, 0.7)])
        outline[:, 1] *= s
        half = extrude(outline, -4.8, 4.8)
        wedge = extrude([(-20, 4.8), (10, 4.8), (69, 3.0), (69, -3.0), (10, -4.8), (-20, -4.8)], -20, 20).rotate((90, 0, 0))
        teeth = union(cylinder((x, s * 0.4, -6), (x, s * 0.4, 6), 1.0, n=8) for x in np.arange(33, 66, 3.2))
        nose += part("jaw", half ^ wedge) - part("jaw", teeth)
    pivot = cylinder((0, 0, -6), (0, 0, 6), 8.0, n=32)
    return total + nose + part("pivot", cylinder((0, 0, -5), (0, 0, 5), 12.5, n=36)) + part("pivot", pivot)


def knife(part: Parts) -> Manifold:
    outline = spline([(-77, -6), (-74, 8), (-60, 15.5), (-30, 15.5), (10, 13.5), (40, 14), (50, 9), (52, 0), (46, -9), (30, -14), (5, -13.5), (-30, -15.5), (-62, -18.5), (-74, -15)], 60, closed=True)
    z = np.array([-9.0, -8.2, -6, 6, 8.2, 9.0])
    inset = np.array([0.86, 0.95, 1.0, 1.0, 0.95, 0.86])
    center = np.array([-12, -1])
    body = loft([np.column_stack([(outline - center) * (1 - (1 - k) * 0.6) + center, np.full(60, h)]) for h, k in zip(z, inset)])
    blade = extrude([(30, -8), (30, 9), (56, 9), (78, -7), (78, -8)], -0.8, 0.8)
    collar = box(12, 20, 10, 2, (48, 0.5, 0))
    slider = box(20, 5, 8, 1.8, (22, 14.5, 0)) + union(box(1.6, 3, 8, 0, (16 + 4 * i, 17, 0)) for i in range(4))
    screw = cylinder((-20, 0, -9.4), (-20, 0, 9.4), 4.5, n=24)
    return part("body", body) + part("collar", collar) + part("blade", blade) + part("slider", slider) + part("handle", screw)


def toothbrush(part: Parts) -> Manifold:
    s = spline([(-82.5, 0.5, 3, 2), (-80, 0.6, 4.6, 3.2), (-62, 0, 5.4, 4.4), (-30, -0.8, 5.6, 4.2), (-8, 0, 5.5, 4.3), (12, 1.2, 4.4, 3.4), (36, 1.2, 3.1, 2.6), (52, 0.4, 3.4, 2.4)], 60)
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
    for x, r, flute in spline([(-108, 9.5, 0), (-106, 13, 0), (-101, 15.4, 0), (-94, 16.5, 0.02), (-82, 16.5, 0.10), (-48, 16.5, 0.10), (-36, 15.0, 0.04), (-28, 11.8, 0), (-22, 11.2, 0), (-14, 13.2, 0), (-10, 13, 0), (-8, 11.5, 0)], 52):
        rho = r * (1 - max(flute, 0) * (1 - np.cos(6 * t)))
        rings.append(np.column_stack([np.full(n, x), rho * np.cos(t), rho * np.sin(t)]))
    shaft = cylinder((-14, 0, 0), (96, 0, 0), 3.2, n=20)
    tip = loft([np.column_stack([np.full(20, x), oval(a, b, 20, p)]) for x, a, b, p in ((90, 2.9, 2.9, 2), (96, 3.5, 2.6, 2.3), (102, 3.8, 1.5, 4), (108, 3.4, 0.8, 6))])
    return part("handle", loft(rings)) + part("shaft", shaft) + part("tip", tip)


def scissors(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        blade = np.array([(98, 1.2), (97, -0.6), (0, -3.5), (-12, -7), (-30, -9.5), (-36, -3), (-14, 5), (-2, 8.5), (20, 9.5), (60, 6.8)])
        turn = np.radians(6.5)
        rot = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        shape = blade @ rot.T * (1, s)
        z0, z1 = (-2.6, 0.2) if s > 0 else (-0.2, 2.6)
        steel = extrude(shape, z0, z1)
        shank = np.array([(-14, -2.5, 0), (-28, -7.5, 0), (-40, -14, 0), (-50, -19, 0)]) * (1, s, 1)
        loop = spline(np.array([(-40, -13), (-55, -11), (-75, -12.5), (-91, -20), (-93, -32), (-80, -38.5), (-60, -36), (-44, -26)]) * (1, s), 44, closed=True)
        ring = sweep(np.column_stack([loop, 0 * loop[:, 0]]), [oval(4.4, 7.3, 16, 2.3)], closed=True)
        neck = sweep(spline(shank, 12), [oval(a, b, 16, 2.4) for a, b in zip(np.linspace(5, 6, 12), np.linspace(4.5, 6.5, 12))])
        total += part("blade", steel) + part("loop", ring) + part("shank", neck)
    return total + part("pivot", cylinder((0, 0, -4), (0, 0, 4), 5.0, n=28))


def power_drill(part: Parts) -> Manifold:
    barrel = along_x([(-92, 14, 14), (-89, 22, 23), (-80, 26.5, 28), (-40, 28.5, 30), (0, 28, 29.5), (22, 26.5, 27.5), (30, 22, 22)], 40, 2.6, 32).translate((0, 0, 62))
    grip = loft([np.column_stack([oval(a, b, 28, 2.5) + (x, 0), np.full(28, z)]) for x, a, b, z in
                 spline([(-38, 25, 18, 50), (-41, 21.5, 16.5, 30), (-44, 20, 16, 5), (-47, 20.5, 16.5, -25), (-48, 24, 19, -48), (-47, 28, 22, -60)], 30)])
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
        twist.append(np.column_stack([np.full(16, x), a @ np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]) + (0, 62)]))
    bit = loft(twist + [np.column_stack([np.full(16, 94.0), 0.25 * (twist[-1][:, 1:] - (0, 62)) + (0, 62)])])
    trigger = spline([(-22, 28), (-12, 26), (-15, 14), (-14, 2), (-24, 0)], 14)
    lever = Manifold.extrude(_section(np.vstack([trigger, [(-34, 0), (-34, 28)]])), 14).translate((0, 0, -7)).rotate((90, 0, 0))
    vents = union(box(4, 80, 16, 0, (-78 + 8 * i, 0, 66)) - box(8, 51.5 + 1.4 * i, 18, 0, (-78 + 8 * i, 0, 66)) for i in range(4))
    body = part("body", barrel) - part("body", vents)
    return body + part("grip", grip) + part("battery", foot) + part("chuck", collar + chuck) + part("bit", bit) + part("trigger", lever)


def binoculars(part: Parts) -> Manifold:
    total = Manifold()
    for s in (-1, 1):
        tube = revolve([(0, -52), (16, -52), (18.5, -48), (19.5, -30), (22.4, -18), (22.4, 18), (20.6, 26), (21.2, 46), (23.4, 58), (24, 62), (24, 70), (21.5, 70), (20.5, 64), (0, 63)], 36)
        cup = revolve([(0, -50), (16, -50), (18, -54), (18.6, -70), (17.6, -72), (14, -72), (12, -66), (0, -65)], 36)
        total += part("barrel", tube.rotate(TO_X).translate((0, s * 30.5, 0)))
        total += part("eyecup", cup.rotate(TO_X).translate((0, s * 30.5, 0)))
    bridge = box(20, 34, 15, 3.5, (-20, 0, 2)) + box(16, 34, 15, 3.5, (24, 0, 2))
    hinge = cylinder((-34, 0, 4), (36, 0, 4), 6.5, n=28)
    wheel = union([cylinder((-10, 0, 4), (10, 0, 4), 10.5, n=28), cylinder((-40, 0, 4), (-30, 0, 4), 8.5, n=28)])
    return total + part("bridge", bridge + hinge) + part("focus_wheel", wheel)


def _section(outline: np.ndarray) -> object:
    from manifold3d import CrossSection

    x, y = outline.T
    return CrossSection([outline if float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) > 0 else outline[::-1].copy()])


def bottle(part: Parts) -> Manifold:
    shoulder = spline([(37.5, 130), (36.8, 150), (31, 172), (21, 190), (14.5, 204), (13.2, 216)], 16)
    profile = [(0, 4), (22, 3), (27, 0), (33, 0), (36.6, 3), (37.5, 8), (37.5, 34), (35.8, 38), (35.8, 92), (37.5, 96), *shoulder, (13.2, 228), (16.5, 228.5), (16.5, 231), (13.2, 231.5), (13.2, 236), (0, 236)]
    n = 64
    t = 2 * np.pi * np.arange(n) / n
    rings = []
    for z, r, ridge in ((232, 15.0, 0), (233, 15.6, 0.05), (247, 15.6, 0.05), (249, 14.6, 0), (250, 13.5, 0)):
        rho = r * (1 - ridge * (np.arange(n) % 4 >= 2))
        rings.append(np.column_stack([rho * np.cos(t), rho * np.sin(t), np.full(n, z)]))
    return part("body", revolve(profile, 44)) + part("cap", loft(rings))


def trigger_sprayer(part: Parts) -> Manifold:
    stations = spline([(0, 40, 33, 2), (3, 45, 36.5, 6), (12, 46.5, 37.5, 12), (70, 46.5, 37.5, 70), (110, 44, 36.5, 110), (135, 36, 31, 135), (155, 24, 23, 155), (172, 15, 15, 172), (186, 14, 14, 186)], 48)
    body = loft([np.column_stack([oval(a, b, 36, 2.3) + (-1, 0), np.full(36, z - 2)]) for z, a, b, _ in stations])
    collar = cylinder((-1, 0, 176), (-1, 0, 198), 18, 17, n=36) + cylinder((-1, 0, 196), (-1, 0, 222), 10.5, 10.5, n=28)
    ridges = union(box(3, 3, 18, 0, (-1 + 17.5 * np.cos(a), 17.5 * np.sin(a), 187)).translate((0, 0, 0)) for a in 2 * np.pi * np.arange(12) / 12)
    outline = spline([(46, 262), (30, 274), (5, 285), (-25, 288), (-44, 280), (-50, 262), (-40, 246), (-22, 238), (-14, 225), (-10, 214), (8, 214), (12, 236), (30, 246)], 60, closed=True)
    shell = loft([np.column_stack([(outline[:, 0] + 5) * k - 5, np.full(60, y), (outline[:, 1] - 255) * k + 255]) for y, k in ((-14, 0.80), (-12, 0.93), (-8, 1), (8, 1), (12, 0.93), (14, 0.80))])
    nozzle = cylinder((38, 0, 262), (50, 0, 262), 9, 9, n=28) + cylinder((46, 0, 262), (54, 0, 262), 6, 5, n=24)
    lever = sweep(spline([(26, 0, 254), (29, 0, 240), (26, 0, 224), (27, 0, 208), (33, 0, 194)], 24), [oval(7.5, 3.6, 20, 2.6)], up=(1, 0, 0))
    return part("bottle", body) + part("collar", collar + ridges) + part("head", shell) + part("nozzle", nozzle) + part("trigger", lever)


SPECS = (
    Spec("hammer", "S1", (330, 126, 32), 0.665, 4.0, ("grip", "shaft", "head", "face", "claw"), hammer,
         fine=(("head", 3.2), ("face", 3.2), ("claw", 3.2)), receiver=("grip",), take="handle", frame="x from the handle to the head, y to the striking face"),
    Spec("pliers", "S1", (180, 55, 12), 0.2, 2.8, ("handle", "jaw", "pivot"), pliers,
         receiver=("handle",), take="handles", frame="x from the handles to the jaws, z along the pivot"),
    Spec("knife", "S1", (155, 35, 18), 0.08, 2.6, ("body", "handle", "collar", "blade", "slider"), knife,
         cuts=(("body", ((-1, 0, 0), 12), "handle"),), receiver=("handle",), take="handle",
         frame="x to the blade's tip, y to the blade's back, z across"),
    Spec("toothbrush", "S1", (165, 23, 12), 0.018, 2.0, ("handle", "neck", "grip", "head", "bristles"), toothbrush,
         cuts=(("handle", ((1, 0, 0), -10), "neck"),), receiver=("handle", "grip"), take="handle",
         frame="x to the head, z to the bristles"),
    Spec("screwdriver", "S1", (216, 34, 33), 0.097, 2.9, ("handle", "shaft", "tip"), screwdriver,
         fine=(("tip", 1.6), ("shaft", 2.2)), receiver=("handle",), take="handle", frame="x to the tip"),
    Spec("scissors", "S1", (198, 88, 15), 0.082, 2.8, ("blade", "shank", "loop", "pivot"), scissors,
         receiver=("loop",), take="loops", frame="x to the blades' tips, z along the pivot"),
    Spec("power_drill", "S1", (186, 184, 57), 0.895, 4.6, ("body", "grip", "battery", "chuck", "bit", "trigger"), power_drill,
         fine=(("chuck", 3.4), ("bit", 1.8), ("trigger", 3.2), ("battery", 4.0)), receiver=("grip", "trigger"), take="grip", frame="x to the bit, z up, the grip down"),
    Spec("binoculars", "S1", (142, 109, 48), 0.35, 4.3, ("barrel", "right_barrel", "eyecup", "right_eyecup", "bridge", "focus_wheel"),
         binoculars, cuts=(("barrel", ((0, -1, 0), 0), "right_barrel"), ("eyecup", ((0, -1, 0), 0), "right_eyecup")),
         fine=(("bridge", 2.8), ("focus_wheel", 2.5)), receiver=("right_barrel", "right_eyecup"), take="right barrel",
         frame="x the direction of sight, y to the left barrel, z up"),
    Spec("bottle", "S1", (250, 75, 75), 0.6, 4.8, ("body", "base", "neck", "cap"), bottle,
         cuts=(("body", ((0, 0, -1), -96), "base"), ("body", ((0, 0, 1), 196), "neck")), fine=(("cap", 2.6),), receiver=("base",), take="body",
         frame="z to the cap"),
    Spec("trigger_sprayer", "S1", (290, 100, 75), 0.55, 5.2, ("bottle", "neck", "collar", "head", "nozzle", "trigger"), trigger_sprayer,
         cuts=(("bottle", ((0, 0, 1), 142), "neck"),),
         fine=(("collar", 2.8), ("nozzle", 2.8), ("trigger", 3.0), ("head", 4.2)), receiver=("neck", "collar", "head", "trigger"), take="grip",
         frame="x to the nozzle, z up"),
)  # fmt: skip
