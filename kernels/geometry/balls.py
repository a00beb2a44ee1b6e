"""Up to 64 balls or capsules at a time: which of them may be near a body, as one bit for each.

The functions are written in C++ (native/lanes.h), which also has the derivations. Bit i of a result belongs to ball first + i;
`count` (1 to 64) says how many there are. A bit that is not set is certain, a bit that is set may be wrong.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func_native("return r2h::lowest_bit(bits);")
def lowest_bit(bits: wp.uint64) -> int:
    """The number of the lowest bit that is set; `bits` is not 0."""
    ...


@wp.func_native("return r2h::balls_within(centers.data + first, radii.data + first, count, c0, c1, radius, cutoff);")
def balls_within(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, cutoff: float,
) -> wp.uint64:  # fmt: skip
    """Balls that may be within `cutoff` (m) of the capsule c0-c1 with `radius`."""
    ...


@wp.func_native("return r2h::capsules_within(ends0.data, ends1.data, radii.data, count, c0, c1, radius, cutoff);")
def capsules_within(
    ends0: wp.array(dtype=wp.vec3), ends1: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, cutoff: float,
) -> wp.uint64:  # fmt: skip
    """Capsules that may be within `cutoff` (m) of the capsule c0-c1 with `radius`."""
    ...


@wp.func_native(
    "return r2h::balls_near(centers.data + first, radii.data + first, count, c0, c1, radius, travel, w, v, a, b,"
    " second, third, moving, target, tolerance);"
)
def balls_near(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, travel: float,
    w: wp.vec3, v: wp.vec3, a: wp.vec3, b: wp.vec3, second: float, third: float, moving: int,
    target: float, tolerance: float,
) -> wp.uint64:  # fmt: skip
    """Balls that may come nearer than `target` (m) to the moving capsule c0-c1 over an interval q + s d, -1 <= s <= 1.

    The capsule and its motion are those of a `MovingBody` (plan/obstacles.py). A ball that is within target + tolerance in the
    interval's middle keeps its bit unless `travel` alone settles it.
    """
    ...


@wp.func_native(
    "return r2h::balls_in_reach(balls.data + first, count, kind, size, radius, R, p, limit, n, beyond, known);"
)
def balls_in_reach(
    balls: wp.array(dtype=wp.vec4), first: int, count: int, kind: int, size: wp.vec3, radius: float, R: wp.mat33,
    p: wp.vec3, limit: float, n: wp.vec3, beyond: float, known: float,
) -> wp.uint64:  # fmt: skip
    """Balls (centre, radius) that may be within `limit` (m) of a primitive at R, p and have points n . x > beyond - known.

    kind, size, radius: those of a `Shape` that is not a hull (shape.py).
    """
    ...


@wp.func_native("return r2h::nearest_ball(centers.data + first, radii.data + first, count, c0, c1);")
def nearest_ball(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int, c0: wp.vec3, c1: wp.vec3
) -> wp.vec2:  # fmt: skip
    """The least distance of `count` balls from the segment c0-c1 (m, negative where it enters one), and that ball's number."""
    ...


@wp.func_native("return r2h::nearest_center(balls.data + first, count, kind, size, R, p);")
def nearest_center(
    balls: wp.array(dtype=wp.vec4), first: int, count: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3
) -> int:
    """The number of the ball whose centre is nearest to the core of a primitive at R, p; kind, size: those of its `Shape`."""
    ...
