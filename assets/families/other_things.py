"""Things outside of the sixteen categories, for networks that learn where people hold what they take (millimetres).

Each is a family, drawn as those of `r2h_batch.scene.families`, with the part that a person takes: a handle where there is one
that a hand closes around, else the body of a container, else a half of a flat thing. None is judged in a protocol.
``--objects "families:r2h_batch.assets.families.other_things:kettle x 3"`` judges a method on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from manifold3d import Manifold

from r2h_batch.scene.families.family import (
    CERAMIC,
    PLASTIC,
    STEEL,
    WOOD,
    Draw,
    Family,
    Shape,
    family,
)
from r2h_batch.scene.families.shapes import (
    Parts,
    along_x,
    box,
    capsule,
    chain,
    cylinder,
    extrude,
    loft,
    oval,
    revolve,
    spline,
    sweep,
)

Make = Callable[[Draw, Parts], Shape]
FLAT = ("upright", "over")
STANDS = ("upright", "upright", "side")


def thing(
    category: str, parts: Sequence[str], take: str, *more: str, rests: Sequence[str] = FLAT
) -> Callable[[Make], Family]:
    """A family of S1 whose receiver takes the part `take` (and `more`)."""
    return family(
        category, "S1", parts=tuple(parts), rests=tuple(rests), receiver=(take, *more), take=take.replace("_", " "),
        listed=False,
    )  # fmt: skip


def grip(
    draw: Draw, part: Parts, long: tuple[float, float], thick: tuple[float, float], *, name: str = "handle"
) -> tuple[Manifold, float]:
    """A straight handle along x that ends at x = 4; the solid, and the radius of its front end."""
    length, r = draw("grip_length", *long), draw("grip_radius", *thick)
    flat, swell, end = draw("grip_flatness", 0.6, 1.0), draw("grip_swell", 0.85, 1.15), draw("grip_end", 0.7, 1.1)
    front = draw("grip_front", 0.6, 1.0) * r
    solid = along_x(
        [
            (-length, 0.6 * r * end, 0.6 * r * flat * end), (6 - length, r * end, r * flat * end),
            (-0.7 * length, r, r * flat), (-0.35 * length, r * swell, r * flat * swell), (4, front, front * flat),
        ], 22, draw("grip_squareness", 2.0, 3.6),
    )  # fmt: skip
    return part(name, solid), front * flat


def rod(part: Parts, name: str, x: float, r: float) -> Manifold:
    """A rod from the handle's front to x."""
    return part(name, cylinder((-6, 0, 0), (x, 0, 0), r, n=20))


def loop(part: Parts, points: Sequence[Sequence[float]], wide: float, thick: float) -> Manifold:
    """A bent handle through these points of the xz plane."""
    path = spline([(x, 0, z) for x, z in points], 26)
    return part("handle", sweep(path, [oval(wide, thick, 16, 2.6)], up=(0, 1, 0)))


def hollow(profile: Sequence[tuple[float, float]], wall: float, floor: float) -> Manifold:
    """The inside of a turned vessel whose outer (r, z) profile goes upwards."""
    inner = [(max(1.0, r - wall), z) for r, z in profile if z > floor]
    top = profile[-1]
    return revolve([(0, floor), (inner[0][0], floor), *inner, (top[0] - wall, top[1] + 5), (0, top[1] + 5)], 36)


def of(parts: Sequence[str], density: float, **others: float) -> dict[str, float]:
    """Densities: one for all parts, and those that differ."""
    return dict.fromkeys(parts, float(density)) | others


# Containers: a person takes the body, or a handle where there is one.


@thing("jar", ("body", "lid"), "body", rests=STANDS)
def jar(draw: Draw, part: Parts) -> Shape:
    """A jam jar or a canister with a lid."""
    r, h, lid = draw("radius", 26, 44), draw("height", 70, 150), draw("lid", 10, 26)
    e = draw("edge", 2, 10)
    body = revolve([(0, 0), (r - e, 0), (r, e), (r, h - e), (r - e, h), (0, h)])
    top = part("lid", cylinder((0, 0, h - 4), (0, 0, h + lid), draw("lid_share", 0.75, 1.03) * r, n=40))
    return Shape(part("body", body) + top, of(("body", "lid"), 1200))


@thing("spray_can", ("body", "neck", "cap"), "body", rests=STANDS)
def spray_can(draw: Draw, part: Parts) -> Shape:
    """An aerosol with a cap or a button."""
    r, h, cap = draw("radius", 20, 33), draw("height", 110, 210), draw("cap", 10, 45)
    w = draw("cap_share", 0.25, 0.95) * r
    body = revolve([(0, 0), (r - 2, 0), (r, 2), (r, h - 12), (0.8 * r, h - 3), (0.75 * r, h), (0, h)])
    top = part("cap", cylinder((0, 0, h - 4), (0, 0, h + cap), w, 0.95 * w, n=32))
    split = ("neck", (0, 0, 1), draw("held", 0.5, 0.8) * h)
    return Shape(part.divided("body", body, split) + top, of(("body", "neck", "cap"), 700))


@thing("carton", ("body", "top", "cap"), "body", rests=STANDS)
def carton(draw: Draw, part: Parts) -> Shape:
    """A milk or juice carton with a gable or a flat top."""
    a, b, h, gable = draw("width", 55, 80), draw("depth", 45, 80), draw("height", 110, 220), draw("gable", 0, 45)
    low = box(a, b, h, 2, (0, 0, h / 2))
    roof = Manifold.batch_hull([box(a, b, 2, 0, (0, 0, h - 3)), box(a, 3, 2, 0, (0, 0, h + gable))])
    cap = part("cap", cylinder((0, 0.2 * b, h - 5), (0, 0.2 * b, h + 0.6 * gable + 14), draw("cap", 8, 14), n=24))
    split = ("top", (0, 0, 1), draw("held", 0.5, 0.8) * h)
    return Shape(part.divided("body", low, split) + part("top", roof) + cap, of(("body", "top", "cap"), 900))


@thing("thermos", ("body", "shoulder", "lid"), "body", rests=STANDS)
def thermos(draw: Draw, part: Parts) -> Shape:
    """A vacuum flask with a cup as its lid."""
    r, h, lid = draw("radius", 28, 42), draw("height", 150, 240), draw("lid", 40, 75)
    n = draw("lid_share", 0.65, 1.0) * r
    body = revolve([(0, 0), (r - 3, 0), (r, 3), (r, 0.82 * h), (n, h), (0, h)])
    top = part("lid", cylinder((0, 0, h - 3), (0, 0, h + lid), n, 0.85 * n, n=36))
    split = ("shoulder", (0, 0, 1), draw("held", 0.5, 0.8) * h)
    return Shape(part.divided("body", body, split) + top, of(("body", "shoulder", "lid"), 900))


@thing("pump_dispenser", ("body", "shoulder", "pump"), "body", rests=STANDS)
def pump_dispenser(draw: Draw, part: Parts) -> Shape:
    """A soap dispenser with a pump and its spout."""
    a, b, h = draw("radius", 28, 42), draw("flatness", 0.6, 1.0), draw("height", 85, 165)
    q = draw("squareness", 2, 4)
    rings = [(0, 0.95), (4, 1), (0.75 * h, 1), (0.92 * h, 0.8), (h, 0.35)]
    body = loft([np.column_stack([oval(a * w, a * b * w, 32, q), np.full(32, z)]) for z, w in rings])
    z = h + draw("stem", 18, 40)
    pump = cylinder((0, 0, h - 4), (0, 0, h + 12), 13, n=28) + cylinder((0, 0, h), (0, 0, z), 5, n=18)
    pump += cylinder((0, 0, z - 3), (0, 0, z + 8), 10, n=24)
    pump += cylinder((0, 0, z + 3), (draw("spout", 25, 50), 0, z), 5, 3.5, n=16)
    split = ("shoulder", (0, 0, 1), draw("held", 0.5, 0.8) * h)
    return Shape(part.divided("body", body, split) + part("pump", pump), of(("body", "shoulder", "pump"), 800))


@thing("tube", ("body", "top", "cap"), "body", rests=("upright", "left", "right"))
def tube(draw: Draw, part: Parts) -> Shape:
    """A tube of toothpaste or cream: round at its cap, flat at its end."""
    r, h, cap = draw("radius", 15, 26), draw("height", 95, 165), draw("cap", 12, 28)
    rings = [(0, 1.45, 0.1), (10, 1.42, 0.16), (0.5 * h, 1.2, 0.65), (0.93 * h, 1, 1), (h, 0.5, 0.5)]
    body = loft([np.column_stack([oval(r * a, r * b, 32), np.full(32, z)]) for z, a, b in rings])
    top = part("cap", cylinder((0, 0, h - 3), (0, 0, h + cap), draw("cap_share", 0.45, 0.95) * r, n=28))
    split = ("top", (0, 0, 1), draw("held", 0.5, 0.8) * h)
    return Shape(part.divided("body", body, split) + top, of(("body", "top", "cap"), 1100))


@thing("pitcher", ("body", "handle", "lip"), "handle", rests=STANDS)
def pitcher(draw: Draw, part: Parts) -> Shape:
    """A jug with a handle at its side, full depth."""
    h, r, top = draw("height", 120, 220), draw("radius", 40, 62), draw("top", 0.65, 1.0)
    side = [(0.75 * r, 0.0), (r, 0.3 * h), (0.9 * r, 0.6 * h), (top * r, h)]
    curve = [(float(a), float(z)) for a, z in spline(side, 14)]
    out, wide = draw("projection", 32, 55), draw("handle_width", 7, 12)
    shell = part("body", revolve([(0, 0), *curve, (0, h)])) - part.hole("body", hollow(curve, 4, 6))
    x = 0.85 * r
    bent = loop(
        part,
        [(top * r - 3, 0.9 * h), (x + 0.7 * out, 0.93 * h), (r + out, 0.68 * h), (r + 0.8 * out, 0.38 * h), (0.95 * r, 0.2 * h)],
        wide, draw("handle_thickness", 4, 8),
    )  # fmt: skip
    return Shape(shell + (bent - part.hole("handle", hollow(curve, 4, 6))), of(("body", "handle", "lip"), PLASTIC))


@thing("kettle", ("body", "handle", "spout", "lid"), "handle", rests=("upright",))
def kettle(draw: Draw, part: Parts) -> Shape:
    """A kettle or teapot: its handle at the side or above."""
    r, h = draw("radius", 55, 80), draw("height", 75, 140)
    side = [(0.8 * r, 0.0), (r, 0.3 * h), (0.85 * r, 0.7 * h), (0.5 * r, h)]
    curve = [(float(a), float(z)) for a, z in spline(side, 14)]
    body = part("body", revolve([(0, 0), *curve, (0, h)]))
    z = 0.45 * h
    spout = part("spout", cylinder((-0.7 * r, 0, z), (-1.35 * r, 0, z + 0.5 * h), 0.22 * r, 0.13 * r, n=24))
    lid = part("lid", Manifold.sphere(draw("knob", 8, 14), 20).translate((0, 0, h + 6)))
    out, wide, thick = draw("projection", 36, 58), draw("handle_width", 7, 12), draw("handle_thickness", 5, 9)
    if draw.choice("at", ("side", "above")) == "side":
        points = [
            (0.75 * r, 0.85 * h),
            (r + 0.6 * out, 0.95 * h),
            (r + out, 0.6 * h),
            (r + 0.7 * out, 0.25 * h),
            (0.92 * r, 0.15 * h),
        ]
    else:
        up = h + out + 8
        points = [(-0.75 * r, 0.7 * h), (-0.7 * r, 0.8 * up), (0, up), (0.7 * r, 0.8 * up), (0.75 * r, 0.7 * h)]
    return Shape(body + spout + lid + loop(part, points, wide, thick), of(("body", "handle", "spout", "lid"), 500))


@thing("watering_can", ("body", "handle", "spout"), "handle", rests=("upright",))
def watering_can(draw: Draw, part: Parts) -> Shape:
    """A small can with a long spout."""
    r, h = draw("radius", 42, 62), draw("height", 85, 130)
    body = part("body", cylinder((0, 0, 0), (0, 0, h), r, draw("taper", 0.75, 1.0) * r, n=40))
    far, up = draw("spout", 1.7, 2.4) * r, draw("rise", 0.8, 1.3) * h
    spout = part("spout", cylinder((-0.5 * r, 0, 0.2 * h), (-far, 0, up), 10, 6, n=20))
    rose = part("spout", cylinder((-far, 0, up), (-far - 12, 0, up + 9), 7, draw("rose", 8, 20), n=24))
    out = draw("projection", 38, 60)
    points = [(0.4 * r, h - 4), (0.8 * r, h + 0.5 * out), (r + 0.8 * out, h), (r + out, 0.5 * h), (0.8 * r, 0.15 * h)]
    bent = loop(part, points, draw("handle_width", 6, 11), draw("handle_thickness", 5, 9))
    return Shape(body + spout + rose + bent, of(("body", "handle", "spout"), 450))


@thing("bucket", ("body", "handle"), "handle", rests=("upright",))
def bucket(draw: Draw, part: Parts) -> Shape:
    """A pail, a basket or a lantern: the handle stands above."""
    r, h, up = draw("radius", 45, 75), draw("height", 70, 120), draw("arch", 50, 90)
    low = draw("taper", 0.65, 1.0) * r
    body = part("body", revolve([(0, 0), (low, 0), (r, h), (0, h)]))
    points = [(-r + 4, h - 12), (-0.9 * r, h + 0.6 * up), (0, h + up), (0.9 * r, h + 0.6 * up), (r - 4, h - 12)]
    return Shape(
        body + loop(part, points, draw("handle_width", 6, 12), draw("thickness", 5, 10)), of(("body", "handle"), 500)
    )


@thing("extinguisher", ("body", "head", "hose"), "head", rests=STANDS)
def extinguisher(draw: Draw, part: Parts) -> Shape:
    """A pressure bottle or siphon that is held by its neck and lever."""
    r, h = draw("radius", 28, 44), draw("height", 130, 210)
    side = spline([(r, 4.0), (r, 0.7 * h), (0.8 * r, 0.88 * h), (13, h)], 14)
    body = part("body", revolve([(0, 0), (r - 4, 0), *side, (0, h)]))
    neck, long = draw("neck", 13, 18), draw("neck_length", 40, 75)
    head = part("head", cylinder((0, 0, h - 4), (0, 0, h + long), neck, n=28))
    far = draw("lever", 55, 85)
    top = part("head", capsule((-12, 0, h + long - 6), (far, 0, h + long - draw("droop", 0, 18)), 7, 5))
    low = part("head", capsule((0, 0, h + 0.4 * long), (0.8 * far, 0, h + 0.4 * long - 4), 6, 5))
    horn = part("hose", cylinder((0, 0, h + 0.7 * long), (-draw("nozzle", 25, 50), 0, h + 0.7 * long), 6, 9, n=20))
    return Shape(body + head + top + low + horn, of(("body", "head", "hose"), 900))


@thing("decanter", ("body", "neck"), "neck", rests=("upright",))
def decanter(draw: Draw, part: Parts) -> Shape:
    """A carafe or vase with a wide belly: a hand closes around the neck alone."""
    r, h, n = draw("radius", 56, 80), draw("belly", 80, 120), draw("neck", 15, 21)
    long = draw("neck_length", 85, 130)
    side = spline(
        [(0.7 * r, 0.0), (r, 0.35 * h), (0.75 * r, 0.72 * h), (n, h), (0.95 * n, h + 0.5 * long), (1.25 * n, h + long)],
        22,
    )
    body = revolve([(0, 0), *side, (0, h + long)])
    return Shape(part.divided("body", body, ("neck", (0, 0, 1), h)), of(("body", "neck"), 1200))


@thing("spice_mill", ("body", "head"), "body", rests=STANDS)
def spice_mill(draw: Draw, part: Parts) -> Shape:
    """A pepper mill: a turned body with a head."""
    r, h = draw("radius", 22, 31), draw("height", 100, 180)
    w = draw("waist", 0.65, 1.0)
    side = spline([(r, 4.0), (0.95 * r, 0.15 * h), (w * r, 0.5 * h), (0.9 * r, 0.85 * h), (0.8 * r, h)], 16)
    body = part("body", revolve([(0, 0), (r - 2, 0), *side, (0, h)]))
    ball = part("head", Manifold.sphere(draw("head", 0.75, 1.05) * r, 28).translate((0, 0, h + 0.5 * r)))
    return Shape(body + ball, of(("body", "head"), WOOD))


# Kitchen and table: a handle, and what it carries.


@thing("pan", ("handle", "body"), "handle", rests=("upright",))
def pan(draw: Draw, part: Parts) -> Shape:
    """A frying pan or saucepan."""
    solid, r = grip(draw, part, (95, 160), (8, 14))
    wide, deep, tilt = draw("radius", 62, 100), draw("depth", 26, 85), draw("rise", 0.8, 1.0)
    side = [(tilt * wide + (1 - tilt) * wide * u, u * deep) for u in np.linspace(0, 1, 8).tolist()]
    body = part("body", revolve([(0, 0), *side, (0, deep)])) - part.hole("body", hollow(side, 3.5, 4))
    arm = rod(part, "body", 20, 0.8 * r)
    cup = body.translate((wide + 12, 0, 6 - deep))
    inside = part.hole("body", hollow(side, 3.5, 4).translate((wide + 12, 0, 6 - deep)))
    return Shape(solid + (arm - inside) + cup, of(("handle", "body"), 1100, body=2600.0))


@thing("spatula", ("handle", "shaft", "blade"), "handle")
def spatula(draw: Draw, part: Parts) -> Shape:
    """A turner, pastry scraper or fly swatter."""
    solid, r = grip(draw, part, (90, 140), (7, 13))
    shaft, a, b = draw("shaft", 40, 130), draw("blade", 60, 110), draw("blade_width", 40, 85)
    plate = part("blade", box(a, b, draw("thickness", 2.2, 4), 1, (shaft + a / 2 - 4, 0, 0)))
    return Shape(
        solid + rod(part, "shaft", shaft, min(r, draw("rod", 3, 5))) + plate, of(("handle", "shaft", "blade"), 1000)
    )


@thing("ladle", ("handle", "shaft", "bowl"), "handle")
def ladle(draw: Draw, part: Parts) -> Shape:
    """A ladle, spoon or ice-cream scoop."""
    solid, r = grip(draw, part, (80, 130), (6, 13))
    shaft, ball = draw("shaft", 25, 140), draw("bowl", 18, 44)
    deep = draw("depth", 0.45, 0.95)
    at = (shaft + 0.9 * ball, 0, 0)
    outer = Manifold.sphere(ball, 32).scale((1.15, 1, deep)).translate(at)
    inner = Manifold.sphere(ball - 2.5, 32).scale((1.15, 1, deep)).translate((at[0], 0, 2.5))
    lid = box(4 * ball, 4 * ball, 4 * ball, 0, (at[0], 0, 2 * ball + 3))
    bowl = part("bowl", outer) - part.hole("bowl", inner) - part.hole("bowl", lid)
    return Shape(
        solid + rod(part, "shaft", shaft, min(r, draw("rod", 3, 5))) + bowl, of(("handle", "shaft", "bowl"), 2000)
    )


@thing("fork", ("handle", "neck", "tines"), "handle")
def fork(draw: Draw, part: Parts) -> Shape:
    """A carving fork, garden fork or rake."""
    solid, r = grip(draw, part, (85, 130), (7, 14))
    neck, wide, long = draw("neck", 25, 90), draw("width", 18, 60), draw("tines", 45, 90)
    many = int(draw("count", 2, 5.99))
    bar = part("tines", box(8, wide + 6, 5, 1, (neck, 0, 0)))
    tines = Manifold()
    for y in np.linspace(-wide / 2, wide / 2, many):
        tines += part("tines", capsule((neck, y, 0), (neck + long, y, draw("curl", -6, 6)), 2.4, 1.3, 10))
    return Shape(solid + rod(part, "neck", neck + 2, min(r, 4.5)) + bar + tines, of(("handle", "neck", "tines"), 3000))


@thing("whisk", ("handle", "wires"), "handle")
def whisk(draw: Draw, part: Parts) -> Shape:
    """A whisk, or a rattle."""
    solid, r = grip(draw, part, (90, 135), (9, 15))
    long, wide = draw("wires", 80, 150), draw("width", 22, 38)
    wires = Manifold()
    for k in range(4):
        turn = k * np.pi / 4
        path = spline(
            [
                (-4, 0.3 * r),
                (0.4 * long, 0.7 * wide),
                (0.8 * long, wide),
                (long, 0),
                (0.8 * long, -wide),
                (0.4 * long, -0.7 * wide),
                (-4, -0.3 * r),
            ],
            22,
        )
        wires += part("wires", chain([(x, y * np.cos(turn), y * np.sin(turn)) for x, y in path], 1.6, 8))
    return Shape(solid + wires, of(("handle", "wires"), 1200, wires=5000.0))


@thing("rolling_pin", ("barrel", "handle", "far_handle"), "handle", rests=("roll",))
def rolling_pin(draw: Draw, part: Parts) -> Shape:
    """A rolling pin: one of its handles."""
    solid, r = grip(draw, part, (70, 105), (10, 15))
    long, thick = draw("barrel", 110, 190), draw("barrel_radius", 20, 29)
    far = along_x([(long - 4, 0.8 * r, 0.8 * r), (long + 40, 12, 12), (long + draw("far", 60, 95), 7, 7)], 12)
    barrel = part("barrel", cylinder((0, 0, 0), (long, 0, 0), thick, n=36))
    return Shape(solid + barrel + part("far_handle", far), of(("barrel", "handle", "far_handle"), WOOD))


@thing("peeler", ("handle", "fork", "blade"), "handle")
def peeler(draw: Draw, part: Parts) -> Shape:
    """A peeler or a safety razor: a bar across the end."""
    solid, r = grip(draw, part, (75, 120), (6, 12))
    neck, wide = draw("neck", 10, 35), draw("width", 34, 62)
    bar = part("blade", box(draw("bar", 7, 14), wide, draw("thickness", 4, 9), 1.5, (neck, 0, draw("lift", 0, 6))))
    return Shape(solid + rod(part, "fork", neck, min(r, 4)) + bar, of(("handle", "fork", "blade"), 1300))


@thing("masher", ("handle", "stem", "plate"), "handle")
def masher(draw: Draw, part: Parts) -> Shape:
    """A potato masher, stamp, plunger or door bell: a plate or cup at the end of a stem."""
    solid, r = grip(draw, part, (85, 125), (11, 17))
    stem, wide = draw("stem", 15, 90), draw("plate", 28, 55)
    plate = part(
        "plate",
        cylinder((stem - 4, 0, 0), (stem + draw("thickness", 5, 45), 0, 0), draw("cone", 0.4, 1.0) * wide, wide, n=36),
    )
    return Shape(
        solid + rod(part, "stem", stem, min(r, draw("rod", 5, 9))) + plate, of(("handle", "stem", "plate"), 1400)
    )


# Tools, brushes and sport.


@thing("brush", ("handle", "ferrule", "bristles"), "handle")
def brush(draw: Draw, part: Parts) -> Shape:
    """A paint brush, pastry brush or shaving brush: as wide as it is thick, or flat."""
    solid, r = grip(draw, part, (70, 140), (7, 15))
    wide, thick = draw("width", 14, 42), draw("thickness", 6, 14)
    metal, hair = draw("ferrule", 15, 40), draw("bristles", 25, 65)
    a = part("ferrule", along_x([(-2, r, r), (0.5 * metal, 0.9 * wide, thick), (metal, wide, thick)], 12, 3))
    b = part(
        "bristles",
        along_x(
            [(metal - 3, wide, thick), (metal + 0.6 * hair, 1.05 * wide, thick), (metal + hair, wide, 0.4 * thick)],
            10,
            3,
        ),
    )
    return Shape(solid + a + b, of(("handle", "ferrule", "bristles"), WOOD, ferrule=3000.0))


@thing("hairbrush", ("handle", "head", "bristles"), "handle", rests=("upright", "over", "left"))
def hairbrush(draw: Draw, part: Parts) -> Shape:
    """A hairbrush, scrubbing brush or shower brush."""
    solid, r = grip(draw, part, (85, 130), (8, 14))
    long, wide, thick = draw("head", 70, 120), draw("width", 16, 36), draw("thickness", 6, 12)
    head = part(
        "head",
        along_x(
            [(-3, r, r), (0.2 * long, 0.8 * wide, thick), (0.6 * long, wide, thick), (long, 0.5 * wide, 0.7 * thick)],
            18,
            2.6,
        ),
    )
    tall = draw("bristles", 8, 22)
    field = part("bristles", box(0.62 * long, 1.2 * wide, tall, 1, (0.52 * long, 0, 0.4 * thick + tall / 2)))
    return Shape(solid + head + field, of(("handle", "head", "bristles"), 800))


@thing("trowel", ("handle", "neck", "blade"), "handle")
def trowel(draw: Draw, part: Parts) -> Shape:
    """A trowel, putty knife or small shovel."""
    solid, r = grip(draw, part, (95, 135), (11, 17))
    neck, long, wide, lift = draw("neck", 20, 60), draw("blade", 90, 160), draw("width", 30, 52), draw("lift", -20, 0)
    tip = draw("tip", 0.0, 0.9)
    outline = [
        (neck - 8, 0.35 * wide),
        (neck + 0.2 * long, wide),
        (neck + 0.7 * long, (0.6 + 0.4 * tip) * wide),
        (neck + long, tip * wide + 1),
    ]
    plate = extrude([*outline, *[(x, -y) for x, y in outline[::-1]]], lift - 1.3, lift + 1.3)
    bend = part("neck", chain([(-6, 0, 0), (0.5 * neck, 0, 0), (neck, 0, lift)], min(r, 5)))
    return Shape(solid + bend + part("blade", plate), of(("handle", "neck", "blade"), 1000, blade=7800.0))


@thing("saw", ("handle", "blade"), "handle")
def saw(draw: Draw, part: Parts) -> Shape:
    """A hand saw or hacksaw: a grip across its end."""
    tall, r, long = draw("grip", 90, 120), draw("grip_radius", 10, 15), draw("blade", 140, 240)
    lean = draw("lean", -25, 25)
    bar = part("handle", chain([(-lean, -tall / 2, 0), (-8, 0, 0), (lean, tall / 2, 0)], r, 16))
    front = part("handle", box(24, draw("web", 30, 60), 1.4 * r, 3, (4, 0, 0)))
    top, low = draw("height", 30, 60), draw("tip", 14, 28)
    blade = extrude([(0, -0.5 * top), (long, -0.5 * top), (long, low - 0.5 * top), (0, 0.5 * top)], -1.2, 1.2)
    return Shape(bar + front + part("blade", blade), of(("handle", "blade"), WOOD, blade=7800.0))


@thing("wrench", ("handle", "neck", "jaw"), "handle")
def wrench(draw: Draw, part: Parts) -> Shape:
    """An open or ring spanner: flat, with a wide end."""
    long, wide, thick = draw("length", 140, 230), draw("width", 7, 12), draw("thickness", 4, 8)
    head = draw("head", 1.5, 2.1) * wide
    bar = part.divided(
        "handle",
        along_x(
            [(0, 0.8 * wide, thick), (8, wide, thick), (0.5 * long, 0.9 * wide, 0.8 * thick), (long, wide, thick)],
            16,
            4,
        ),
        ("neck", (1, 0, 0), draw("held", 0.55, 0.75) * long),
    )
    end = cylinder((long + 0.5 * head, 0, -thick), (long + 0.5 * head, 0, thick), head, n=36)
    if draw.choice("kind", ("ring", "open")) == "ring":
        gap = cylinder((long + 0.5 * head, 0, -20), (long + 0.5 * head, 0, 20), 0.6 * head, n=6)
    else:
        gap = box(2 * head, 0.95 * head, 40, 0, (long + 1.4 * head, 0, 0))
    gap = part.hole("jaw", gap)
    return Shape((bar - gap) + (part("jaw", end) - gap), of(("handle", "neck", "jaw"), STEEL))


@thing("axe", ("handle", "shaft", "head"), "handle")
def axe(draw: Draw, part: Parts) -> Shape:
    """A hatchet, pickaxe, ice axe or hoe: a blade to one side or both."""
    solid, r = grip(draw, part, (110, 160), (11, 17))
    shaft, thick = draw("shaft", 80, 170), draw("thickness", 8, 14)
    bar = part("shaft", along_x([(-6, 0.9 * r, 0.9 * r), (shaft, 0.9 * r, 0.9 * r)], 6))
    far, edge, back = draw("blade", 55, 95), draw("edge", 20, 50), draw("back", 12, 60)
    head = Manifold.batch_hull(
        [box(2.6 * r, 12, 2 * thick, 2, (shaft - 14, 0, 0)), box(2 * edge, 3, 3, 0, (shaft - 14, far, 0))]
    )
    head += Manifold.batch_hull(
        [box(2.6 * r, 12, 2 * thick, 2, (shaft - 14, 0, 0)), box(12, 6, 12, 1, (shaft - 14, -back, 0))]
    )
    return Shape(solid + bar + part("head", head), of(("handle", "shaft", "head"), WOOD, head=7800.0))


@thing("file", ("handle", "blade"), "handle", rests=("roll",))
def file(draw: Draw, part: Parts) -> Shape:
    """A file, chisel, awl or soldering iron."""
    solid, r = grip(draw, part, (75, 120), (10, 17))
    a, b, long = draw("width", 3, 14), draw("thickness", 1.6, 5), draw("blade", 70, 180)
    blade = along_x([(-10, min(a, r), b), (0.9 * long, a, b), (long, draw("tip", 0.2, 1.0) * a, 0.6 * b)], 10, 4)
    return Shape(solid + part("blade", blade), of(("handle", "blade"), WOOD, blade=7800.0))


@thing("torch", ("handle", "head"), "handle", rests=("roll",))
def torch(draw: Draw, part: Parts) -> Shape:
    """A flashlight, microphone, shower head or maraca: a wider end."""
    solid, r = grip(draw, part, (85, 150), (11, 17))
    wide, long = draw("head_radius", 20, 34), draw("head", 25, 65)
    head = part(
        "head",
        along_x(
            [
                (-3, r, r),
                (0.5 * long, wide, wide),
                (0.9 * long, wide, wide),
                (long, draw("front", 0.5, 0.98) * wide, 0.9 * wide),
            ],
            16,
            2,
        ),
    )
    return Shape(solid + head, of(("handle", "head"), 1300))


@thing("magnifier", ("handle", "ring"), "handle")
def magnifier(draw: Draw, part: Parts) -> Shape:
    """A magnifying glass, hand mirror or table-tennis bat."""
    solid, _ = grip(draw, part, (80, 125), (8, 14))
    wide, thick = draw("ring", 32, 78), draw("thickness", 3, 7)
    disc = part("ring", extrude(oval(draw("oval", 0.9, 1.25) * wide, wide, 44) + (0.95 * wide, 0), -thick, thick))
    if draw.choice("kind", ("glass", "bat")) == "glass":
        disc -= part.hole("ring", cylinder((0.95 * wide, 0, 0.4 * thick), (0.95 * wide, 0, 40), 0.85 * wide, n=40))
    return Shape(solid + disc, of(("handle", "ring"), 800))


@thing("racket", ("handle", "shaft", "frame"), "handle")
def racket(draw: Draw, part: Parts) -> Shape:
    """A badminton or squash racket, a carpet beater, a tennis racket for children."""
    solid, r = grip(draw, part, (85, 125), (11, 16))
    shaft, a, b = draw("shaft", 30, 110), draw("head", 55, 90), draw("head_width", 40, 70)
    t = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    ring = sweep(np.column_stack([shaft + a * (1 - np.cos(t)), b * np.sin(t), 0 * t]), [oval(5, 5, 12)], closed=True)
    net = extrude(oval(a, b, 40) + (shaft + a, 0), -1, 1)
    return Shape(
        solid + rod(part, "shaft", shaft + 3, min(r, 6)) + part("frame", ring) + part("frame", net),
        of(("handle", "shaft", "frame"), 600),
    )


@thing("paint_roller", ("handle", "frame", "roller"), "handle")
def paint_roller(draw: Draw, part: Parts) -> Shape:
    """A roller across the end of a bent rod; a squeegee."""
    solid, _ = grip(draw, part, (100, 140), (11, 16))
    far, wide, r = draw("rod", 55, 120), draw("roller", 80, 150), draw("roller_radius", 12, 25)
    side = wide / 2 + 14
    frame = chain([(-6, 0, 0), (0.5 * far, 0, 0), (0.6 * far, side, 0), (far, side, 0), (far, 0, 0)], 3.5, 10)
    roll = cylinder((far, -wide / 2, 0), (far, wide / 2, 0), r, n=30)
    return Shape(solid + part("frame", frame) + part("roller", roll), of(("handle", "frame", "roller"), 700))


@thing("dumbbell", ("handle", "weight"), "handle", rests=("roll",))
def dumbbell(draw: Draw, part: Parts) -> Shape:
    """A dumbbell or spool: the bar between two weights."""
    long, r, wide, deep = (
        draw("grip", 95, 130),
        draw("grip_radius", 11, 17),
        draw("weight", 26, 45),
        draw("depth", 25, 60),
    )
    bar = part("handle", cylinder((-long / 2 - 4, 0, 0), (long / 2 + 4, 0, 0), r, n=28))
    ends = part("weight", cylinder((long / 2, 0, 0), (long / 2 + deep, 0, 0), wide, n=int(draw("sides", 6, 30))))
    ends += part("weight", cylinder((-long / 2 - deep, 0, 0), (-long / 2, 0, 0), wide, n=30))
    return Shape(bar + ends, of(("handle", "weight"), 900))


@thing("kettlebell", ("handle", "body"), "handle", rests=("upright",))
def kettlebell(draw: Draw, part: Parts) -> Shape:
    """A weight, padlock or iron: a bow on a block."""
    r, up = draw("radius", 34, 60), draw("arch", 42, 65)
    ball = Manifold.sphere(r, 36) - box(3 * r, 3 * r, r, 0, (0, 0, -1.25 * r))
    block = box(2 * r, 1.4 * r, draw("block", 0.6, 1.4) * r, 6)
    body = part("body", ball if draw.choice("kind", ("ball", "block")) == "ball" else block)
    w = draw("span", 0.6, 0.85) * r
    points = [
        (-w, 0.1 * r),
        (-1.05 * w, 0.7 * r + 0.4 * up),
        (0, 0.7 * r + up),
        (1.05 * w, 0.7 * r + 0.4 * up),
        (w, 0.1 * r),
    ]
    return Shape(
        body + loop(part, points, draw("handle_width", 8, 14), draw("thickness", 7, 12)), of(("handle", "body"), 900)
    )


@thing("iron", ("handle", "sole", "post"), "handle", rests=("upright",))
def iron(draw: Draw, part: Parts) -> Shape:
    """A flat iron, plane, trowel of a plasterer or stapler press: a bar above a plate, on one or two posts."""
    long, wide, thick = draw("length", 130, 210), draw("width", 35, 55), draw("sole", 10, 35)
    tip = draw("tip", 0.1, 1.0) * wide
    sole = part(
        "sole",
        extrude(
            [
                (-long / 2, -wide),
                (0.1 * long, -wide),
                (long / 2, -tip),
                (long / 2, tip),
                (0.1 * long, wide),
                (-long / 2, wide),
            ],
            0,
            thick,
        ),
    )
    z, r, half = thick + draw("gap", 36, 55), draw("grip_radius", 11, 16), draw("grip", 48, 62)
    bar = part("handle", capsule((-half, 0, z), (half, 0, z + draw("rise", -5, 12)), r))
    posts = part("post", cylinder((-half + 4, 0, thick - 3), (-half + 4, 0, z), 0.8 * r, n=20))
    if draw.choice("posts", ("one", "two")) == "two":
        posts += part("post", cylinder((half - 4, 0, thick - 3), (half - 4, 0, z), 0.8 * r, n=20))
    return Shape(sole + bar + posts, of(("handle", "sole", "post"), 900))


@thing("umbrella", ("handle", "canopy", "tip"), "handle", rests=("roll",))
def umbrella(draw: Draw, part: Parts) -> Shape:
    """A folded umbrella, or a bat: a slim grip, a thicker rest."""
    solid, r = grip(draw, part, (80, 110), (10, 15))
    long, wide = draw("canopy", 140, 200), draw("canopy_radius", 19, 30)
    rest = along_x(
        [
            (-4, r, r),
            (0.25 * long, 0.8 * wide, 0.8 * wide),
            (0.6 * long, wide, wide),
            (long, draw("end", 0.3, 0.9) * wide, 0.5 * wide),
        ],
        16,
        2.2,
    )
    return Shape(
        solid
        + part("canopy", rest)
        + part("tip", cylinder((long - 4, 0, 0), (long + draw("tip", 5, 40), 0, 0), 5, n=16)),
        of(("handle", "canopy", "tip"), 500),
    )


@thing("tongs", ("handle", "arm"), "handle")
def tongs(draw: Draw, part: Parts) -> Shape:
    """Tongs or tweezers: two arms from one end, held near the bend."""
    long, gap, wide = draw("length", 150, 240), draw("gap", 14, 30), draw("width", 6, 12)
    solid = Manifold()
    for s in (-1, 1):
        path = spline(
            [(0, 0, 0), (0.15 * long, 0.7 * s * gap, 0), (0.5 * long, s * gap, 0), (long, 0.45 * s * gap, 0)], 22
        )
        arm = sweep(path, [oval(2.6, wide, 16, 3)], up=(0, 0, 1))
        cut = ("handle", (-1, 0, 0), -draw(f"held_{s}", 0.5, 0.51) * long)
        solid += part.divided("arm", arm, cut) if s < 0 else part("arm", arm)
    return Shape(solid + part("handle", box(10, 8, 2 * wide, 2, (1, 0, 0))), of(("handle", "arm"), 4000))


@thing("corkscrew", ("handle", "shaft"), "handle")
def corkscrew(draw: Draw, part: Parts) -> Shape:
    """A corkscrew, gimlet or tap key: a bar across a rod."""
    half, r, long = draw("grip", 42, 58), draw("grip_radius", 9, 14), draw("rod", 70, 140)
    bar = part(
        "handle",
        along_x(
            [
                (-half, 0.6 * r, 0.6 * r),
                (-0.6 * half, r, r),
                (0, 0.9 * r, 0.9 * r),
                (0.6 * half, r, r),
                (half, 0.6 * r, 0.6 * r),
            ],
            18,
        ),
    )
    shaft = part("shaft", cylinder((0, 0, 0), (0, 0, -long), draw("rod_radius", 3, 6), 2, n=14))
    ring = part("shaft", cylinder((0, 0, -r), (0, 0, -r - draw("bell", 2, 40)), draw("bell_radius", 6, 15), n=24))
    return Shape(bar + shaft + ring, of(("handle", "shaft"), 2000))


# Two arms about a pivot, and rings that a hand goes through.


def arms(draw: Draw, part: Parts, long: tuple[float, float], thick: tuple[float, float]) -> tuple[Manifold, float]:
    """Two handles from a pivot at the origin towards -x, and the half width at the pivot."""
    length, gap, r = draw("handle_length", *long), draw("handle_gap", 14, 34), draw("handle_radius", *thick)
    root, flat = draw("root", 6, 12), draw("handle_flatness", 0.6, 1.0)
    solid = Manifold()
    for s in (-1, 1):
        path = spline(
            [
                (8, s * 2, 0),
                (-0.15 * length, s * 0.6 * gap, 0),
                (-0.5 * length, s * gap, 0),
                (-length, s * draw(f"end_{s}", 0.7, 1.1) * gap, 0),
            ],
            22,
        )
        solid += part(
            "handle", sweep(path, [oval(r * w, r * flat * w, 16, 2.4) for w in np.linspace(1.0, 0.8, 22)[::-1]])
        )
    return solid, root


@thing("lopper", ("handle", "jaw"), "handle")
def lopper(draw: Draw, part: Parts) -> Shape:
    """Loppers, a bolt cutter or a wire stripper: long arms, short jaws."""
    solid, root = arms(draw, part, (140, 250), (6, 11))
    nose, thick = draw("jaw", 28, 60), draw("thickness", 8, 16)
    jaw = extrude(
        [
            (-14, -root),
            (-14, root),
            (0, 1.4 * root),
            (nose, draw("tip", 0.4, 1.2) * root),
            (nose, -root * 0.6),
            (0, -1.4 * root),
        ],
        -thick / 2,
        thick / 2,
    )
    return Shape(solid + part("jaw", jaw), of(("handle", "jaw"), 1500, jaw=7800.0))


@thing("secateurs", ("handle", "blade"), "handle")
def secateurs(draw: Draw, part: Parts) -> Shape:
    """Garden shears with a hooked blade."""
    solid, root = arms(draw, part, (95, 130), (6, 10))
    nose, hook = draw("blade", 38, 80), draw("hook", 8, 22)
    top = spline([(-10, root), (0.4 * nose, 1.2 * hook), (nose, 0.2 * hook)], 10)
    low = spline([(nose - 3, -0.1 * hook), (0.4 * nose, -0.9 * hook), (-10, -root)], 10)
    blade = extrude(np.concatenate([top, low]), -2.5, 2.5)
    boss = cylinder((0, 0, -6), (0, 0, 6), root + 3, n=24)
    return Shape(solid + part("blade", blade) + part("blade", boss), of(("handle", "blade"), 1500, blade=7800.0))


@thing("garlic_press", ("handle", "chamber"), "handle")
def garlic_press(draw: Draw, part: Parts) -> Shape:
    """A garlic press, nutcracker or punch: a block between the arms' ends."""
    solid, _ = arms(draw, part, (95, 150), (5, 9))
    a, b, c = draw("length", 28, 48), draw("width", 22, 40), draw("height", 18, 40)
    return Shape(solid + part("chamber", box(a, b, c, 3, (0.4 * a, 0, 0))), of(("handle", "chamber"), 2700))


@thing("callipers", ("handle", "leg"), "handle")
def callipers(draw: Draw, part: Parts) -> Shape:
    """Compasses or callipers: a knob above two thin legs."""
    tall, r, long, open_ = (
        draw("knob", 35, 60),
        draw("knob_radius", 8, 14),
        draw("legs", 110, 180),
        draw("open", 10, 40),
    )
    solid = part(
        "handle", along_x([(-tall, 0.7 * r, 0.7 * r), (-0.5 * tall, r, r), (0, r, r), (8, 0.8 * r, 0.8 * r)], 14)
    )
    bow = draw("bow", 0, 30)
    for s in (-1, 1):
        path = [(0, s * 3, 0), (0.5 * long, s * (0.6 * open_ + bow), 0), (long, s * open_, 0)]
        solid += part("leg", chain(spline(path, 9), np.linspace(3.6, 1.6, 9), 10))
    return Shape(solid, of(("handle", "leg"), 3000))


def ring(draw: Draw, part: Parts) -> tuple[Manifold, float]:
    """A closed loop as a handle on the side of -x, and its thickness."""
    a, b, r = draw("ring_length", 22, 60), draw("ring_width", 16, 55), draw("ring_thickness", 3.5, 9)
    t = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    path = np.column_stack([-a + a * np.cos(t), b * np.sin(t), 0 * t])
    return part("handle", sweep(path, [oval(r, r * draw("ring_flatness", 0.6, 1.0), 14)], closed=True)), r


@thing("spade", ("handle", "shaft", "blade"), "handle")
def spade(draw: Draw, part: Parts) -> Shape:
    """A toy spade, oar or snow shovel with a closed grip."""
    solid, r = ring(draw, part)
    shaft, long, wide = draw("shaft", 60, 160), draw("blade", 60, 120), draw("blade_width", 22, 50)
    bar = part("shaft", cylinder((-0.5 * r, 0, 0), (shaft, 0, 0), max(r, 5.0), n=20))
    plate = part(
        "blade",
        extrude(
            [
                (shaft - 6, -wide),
                (shaft + 0.6 * long, -wide),
                (shaft + long, 0),
                (shaft + 0.6 * long, wide),
                (shaft - 6, wide),
            ],
            -2,
            2,
        ),
    )
    return Shape(solid + bar + plate, of(("handle", "shaft", "blade"), 900))


@thing("key", ("handle", "shaft", "bit"), "handle")
def key(draw: Draw, part: Parts) -> Shape:
    """A large key, a hoof pick, a bottle opener, a poker: a ring, a rod and a small end."""
    solid, r = ring(draw, part)
    shaft, bit = draw("shaft", 70, 170), draw("bit", 8, 32)
    bar = part("shaft", cylinder((-0.5 * r, 0, 0), (shaft, 0, 0), max(0.8 * r, 3.5), n=16))
    end = part("bit", box(draw("bit_length", 8, 30), bit, draw("bit_thickness", 3, 8), 1, (shaft - 6, 0.4 * bit, 0)))
    return Shape(solid + bar + end, of(("handle", "shaft", "bit"), 5000))


@thing("scraper", ("handle", "blade"), "handle")
def scraper(draw: Draw, part: Parts) -> Shape:
    """A plasterer's float, pizza wheel or chopping knife: a closed grip along a blade."""
    solid, r = ring(draw, part)
    long, wide = draw("blade", 45, 110), draw("blade_width", 35, 75)
    plate = extrude(oval(0.5 * long, wide, 40, draw("squareness", 2, 6)) + (0.5 * long - 2, 0), -1.6, 1.6)
    web = cylinder((-0.5 * r, 0, 0), (0.3 * long, 0, 0), max(r, 4.0), n=16)
    return Shape(solid + part("blade", web) + part("blade", plate), of(("handle", "blade"), 1500, blade=7000.0))


@thing("bell", ("handle", "body"), "handle", rests=("upright", "side"))
def bell(draw: Draw, part: Parts) -> Shape:
    """A hand bell, funnel, bottle brush or pestle with a wide end below a slim grip."""
    solid, r = grip(draw, part, (75, 115), (8, 14))
    long, wide = draw("bell", 45, 110), draw("mouth", 28, 60)
    a = draw("waist", 0.3, 0.9)
    rings = [(-3, r), (0.35 * long, a * wide), (0.8 * long, 0.85 * wide), (long, wide)]
    return Shape(solid + part("body", along_x([(x, q, q) for x, q in rings], 16, 2)), of(("handle", "body"), 2500))


# Pistol grips.


@thing("hair_dryer", ("handle", "body", "nozzle"), "handle", rests=("left", "right"))
def hair_dryer(draw: Draw, part: Parts) -> Shape:
    """A hair dryer: a thick pipe across a handle."""
    r, back, front = draw("radius", 28, 42), draw("back", 30, 80), draw("front", 45, 110)
    barrel = part("body", cylinder((-back, 0, 0), (front, 0, 0), r, draw("taper", 0.6, 0.9) * r, n=36))
    mouth = part("nozzle", box(draw("nozzle", 10, 40), 1.5 * r, 0.7 * r, 3, (front + 2, 0, 0)))
    long, lean = draw("handle", 95, 135), draw("lean", -25, 25)
    bar = part(
        "handle", capsule((0, 0, -0.6 * r), (-lean, 0, -0.6 * r - long), draw("grip", 15, 21), draw("grip_end", 13, 20))
    )
    return Shape(barrel + mouth + bar, of(("handle", "body", "nozzle"), 600))


@thing("glue_gun", ("handle", "body", "tip"), "handle", rests=("left", "right"))
def glue_gun(draw: Draw, part: Parts) -> Shape:
    """A glue gun, scanner or water pistol: a slim body with a tip above a raked grip."""
    long, tall, wide = draw("body", 100, 170), draw("height", 30, 52), draw("width", 20, 34)
    body = part("body", box(long, wide, tall, 6, (0.15 * long, 0, 0)))
    tip = part(
        "tip",
        cylinder(
            (0.6 * long, 0, 0), (0.65 * long + draw("tip", 10, 50), 0, 0), 0.3 * tall, draw("tip_end", 3, 10), n=20
        ),
    )
    grip_l, rake, a, b = draw("grip", 85, 115), draw("rake", 5, 40), draw("depth", 17, 24), draw("thickness", 11, 16)
    at = -draw("grip_at", 0.0, 0.2) * long
    stations = [
        (at, 1.1 * a, b, -0.3 * tall),
        (at - 0.5 * rake, a, b, -0.5 * grip_l),
        (at - rake, 1.1 * a, 1.1 * b, -0.4 * tall - grip_l),
    ]
    bar = loft([np.column_stack([oval(p, q, 24, 2.5) + (x, 0), np.full(24, z)]) for x, p, q, z in spline(stations, 12)])
    return Shape(body + tip + part("handle", bar), of(("handle", "body", "tip"), 800))


@thing("cordless_vacuum", ("handle", "body", "tank"), "handle", rests=("left", "right", "upright"))
def cordless_vacuum(draw: Draw, part: Parts) -> Shape:
    """A hand vacuum, jigsaw or circular saw: a bow over a thick body."""
    r, long = draw("radius", 30, 46), draw("length", 130, 220)
    body = part(
        "body",
        along_x(
            [
                (-0.5 * long, 0.7 * r, 0.7 * r),
                (-0.3 * long, r, r),
                (0.2 * long, r, r),
                (0.5 * long, 0.5 * r, draw("mouth", 0.3, 0.9) * r),
            ],
            18,
            2.6,
        ),
    )
    up, a, b = draw("gap", 42, 60), -0.42 * long, draw("bow_end", 0.0, 0.2) * long
    points = [(a, 0.5 * r), (a - 5, r + 0.7 * up), (0.5 * (a + b), r + up), (b + 5, r + 0.8 * up), (b, 0.6 * r)]
    bow = loop(part, points, draw("handle_width", 9, 14), draw("handle_thickness", 9, 14))
    return Shape(body + bow, of(("handle", "body", "tank"), 600))


# Flat and thick things: a person takes one half, or nearly all of it.


def halved(category: str, low: Sequence[float], high: Sequence[float], edge: float) -> Family:
    """A box whose receiver takes what lies before a cut across its length."""

    @thing(category, ("half", "rest"), "half")
    def make(draw: Draw, part: Parts) -> Shape:
        """A box of sides between `low` and `high`."""
        a, b, c = (draw(k, p, q) for k, p, q in zip(("length", "width", "height"), low, high, strict=True))
        solid = box(a, b, c, min(edge, 0.45 * c), n=16)
        cut = ("rest", (1, 0, 0), draw("held", -0.15, 0.25) * a)
        return Shape(part.divided("half", solid, cut), of(("half", "rest"), 700))

    return make


book = halved("book", (150, 105, 12), (230, 160, 40), 1)
phone = halved("phone", (110, 55, 8), (170, 85, 14), 6)
remote = halved("remote", (120, 34, 14), (210, 52, 26), 8)
packet = halved("packet", (90, 50, 30), (170, 80, 60), 3)


@thing("plate", ("half", "rest"), "half", rests=("upright",))
def plate(draw: Draw, part: Parts) -> Shape:
    """A plate, pan lid or frisbee."""
    r, h = draw("radius", 70, 120), draw("height", 12, 28)
    side = [
        (0.55 * r, 0),
        (0.65 * r, 2),
        (0.8 * r, 0.5 * h),
        (r, h),
        (r, h + 3),
        (0.78 * r, 0.5 * h + 4),
        (0.6 * r, 5),
        (0, 5),
    ]
    cut = ("rest", (1, 0, 0), draw("held", -0.3, 0.3) * r)
    return Shape(part.divided("half", revolve([(0, 0), *side]), cut), of(("half", "rest"), CERAMIC))


@thing("stapler", ("half", "rest"), "half")
def stapler(draw: Draw, part: Parts) -> Shape:
    """A stapler, a bar of soap, a computer mouse: a loaf."""
    long, wide, tall = draw("length", 95, 165), draw("width", 14, 30), draw("height", 14, 30)
    front = draw("front", 0.5, 1.0)
    loaf = along_x(
        [
            (0, 0.7 * wide, 0.7 * tall),
            (0.2 * long, wide, tall),
            (0.7 * long, 0.95 * wide, 0.9 * tall),
            (long, front * wide, 0.5 * tall),
        ],
        18,
        draw("squareness", 2.2, 4),
    )
    return Shape(
        part.divided("half", loaf, ("rest", (1, 0, 0), draw("held", 0.4, 0.7) * long)), of(("half", "rest"), 900)
    )


@thing("camera", ("grip", "body", "lens"), "grip")
def camera(draw: Draw, part: Parts) -> Shape:
    """A camera: the side away from the lens."""
    a, b, c = draw("width", 100, 145), draw("height", 60, 95), draw("depth", 28, 45)
    solid = box(a, b, c, 6, n=16)
    lens = part(
        "lens",
        cylinder(
            (draw("lens_at", -0.15, 0.0) * a, 0, 0),
            (-0.1 * a, 0, c / 2 + draw("lens", 15, 80)),
            draw("lens_radius", 20, 0.42 * b),
            n=36,
        ),
    )
    cut = ("grip", (1, 0, 0), draw("held", 0.18, 0.26) * a)
    return Shape(part.divided("body", solid, cut) + lens, of(("grip", "body", "lens"), 900))


@thing("light_bulb", ("bulb", "socket"), "bulb", rests=("side",))
def light_bulb(draw: Draw, part: Parts) -> Shape:
    """A bulb, pear or bell: the round end."""
    r, long = draw("radius", 24, 42), draw("socket", 22, 40)
    ball = Manifold.sphere(r, 36)
    neck = cylinder((0, 0, -0.7 * r), (0, 0, -1.5 * r), 0.7 * r, 13, n=32)
    socket = part("socket", cylinder((0, 0, -1.4 * r), (0, 0, -1.4 * r - long), 13, n=28))
    return Shape(part("bulb", ball + neck) + socket, of(("bulb", "socket"), 500))


THINGS: dict[str, Family] = {
    thing.category: thing
    for thing in (
        jar,
        spray_can,
        carton,
        thermos,
        pump_dispenser,
        tube,
        pitcher,
        kettle,
        watering_can,
        bucket,
        extinguisher,
        decanter,
        spice_mill,
        pan,
        spatula,
        ladle,
        fork,
        whisk,
        rolling_pin,
        peeler,
        masher,
        brush,
        hairbrush,
        trowel,
        saw,
        wrench,
        axe,
        file,
        torch,
        magnifier,
        racket,
        paint_roller,
        dumbbell,
        kettlebell,
        iron,
        umbrella,
        tongs,
        corkscrew,
        hair_dryer,
        glue_gun,
        cordless_vacuum,
        book,
        phone,
        remote,
        packet,
        plate,
        stapler,
        camera,
        light_bulb,
        lopper,
        secateurs,
        garlic_press,
        callipers,
        spade,
        key,
        scraper,
        bell,
    )
}
"""By their names."""

LIKE = {
    "hammer": ("axe", "masher"),
    "bottle": ("thermos", "spray_can", "pump_dispenser", "jar", "carton", "spice_mill"),
    "toothbrush": ("peeler", "brush", "hairbrush"),
    "screwdriver": ("file",),
    "scissors": ("lopper", "secateurs", "tongs", "key"),
    "pliers": ("lopper", "secateurs", "garlic_press", "tongs"),
    "knife": ("trowel", "spatula", "saw", "scraper"),
    "power_drill": ("hair_dryer", "glue_gun"),
    "trigger_sprayer": ("extinguisher", "pump_dispenser", "spray_can"),
}
"""Category of the sixteen -> things that look or are held like it."""
