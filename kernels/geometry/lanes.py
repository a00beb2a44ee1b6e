"""Eight boxes, points or triangles of a surface at a time: the bits of those that may be near something.

A CPU handles eight numbers at once when they lie side by side. `Surfaces` therefore stores bounds and corners a second time,
in groups of eight: row k of a group holds one number of each of its members. Short groups repeat their last member.

    node_lanes      NODE_ROWS rows for each group of eight nodes of a surface (`group_first`)
    leaf_lanes      LEAF_ROWS rows for each node's leaves
    triangle_lanes  TRIANGLE_ROWS rows for each leaf's triangles

The functions are written in C++ (native/lanes.h), which also has the derivations. In all of them `lanes[8 * row]` is a group's
first number, `count` says how many of its members count, and bit k of the result belongs to member k. R, t take the frame of
the surface to the other frame. Scratch arrays (`span`, `corners`, `cut`, `near`) hold rows of eight as well.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

LANES = wp.constant(8)
NODE_ROWS = wp.constant(10)
"""Centre x, y, z; half sides of the box about it x, y, z; the ball's radius; a point of it x, y, z."""
LEAF_ROWS = wp.constant(7)
"""Centre x, y, z; half sides x, y, z; the ball's radius."""
TRIANGLE_ROWS = wp.constant(9)
"""x, y, z of the first corner, of the second, of the third."""
BOX_M = wp.constant(1.0e-6)
"""Rounding of a box's place in another frame."""


@wp.func_native("return r2h::first_lane(bits);")
def first_lane(bits: int) -> int:
    """The number of the lowest bit that is set; `bits` is not 0."""
    ...


@wp.func_native("return r2h::lane_point(lanes.data + 8 * row, lane);")
def lane_point(lanes: wp.array(dtype=float), row: int, lane: int) -> wp.vec3:
    """The point of one lane in rows row .. row + 2."""
    ...


@wp.func_native(
    "return r2h::boxes_near(lanes.data + 8 * row, count, R, t, cutoff, low.data, high.data, used, near.data);"
)
def boxes_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, cutoff: float,
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), used: int, near: wp.array(dtype=int),
) -> int:  # fmt: skip
    """Boxes that may be within `cutoff` of some box [low[i], high[i]], i in the bits of `used`.

    `near` (8,): for each lane the bits of these i. Add what rounding may take off to `cutoff`.
    """
    ...


@wp.func_native(
    "return r2h::points_near(lanes.data + 8 * row, count, R, t, cutoff, low.data, high.data, used, near.data);"
)
def points_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, cutoff: float,
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), used: int, near: wp.array(dtype=int),
) -> int:  # fmt: skip
    """As `boxes_near`, for points in rows row .. row + 2."""
    ...


@wp.func_native("return r2h::triangles_near(lanes.data + 8 * row, count, R, t, half, cutoff);")
def triangles_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, half: wp.vec3, cutoff: float
) -> int:
    """Triangles whose box, along the axes of the frame R, t, is within `cutoff` of the box |x| <= half there."""
    ...


# The prism of the finger pads runs along y of the ee frame; rx, ry, rz are the rows of R, tx, ty, tz the entries of t.


@wp.func_native("return r2h::boxes_in_prism(lanes.data + 8 * row, count, rx, rz, tx, tz, x, half_x, z, half_z);")
def boxes_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, rx: wp.vec3, rz: wp.vec3, tx: float, tz: float,
    x: float, half_x: float, z: float, half_z: float,
) -> int:  # fmt: skip
    """Boxes that may meet the prism |X - x| <= half_x, |Z - z| <= half_z."""
    ...


@wp.func_native("r2h::boxes_along(lanes.data + 8 * row, ry, ty, span.data);")
def boxes_along(lanes: wp.array(dtype=float), row: int, ry: wp.vec3, ty: float, span: wp.array(dtype=float)):
    """Writes the lowest and highest y of eight boxes to `span` (2 rows)."""
    ...


@wp.func_native(
    "return r2h::triangles_in_prism(lanes.data + 8 * row, count, rx, rz, tx, tz, x_low, x_high, z_low, z_high);"
)
def triangles_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, rx: wp.vec3, rz: wp.vec3, tx: float, tz: float,
    x_low: float, x_high: float, z_low: float, z_high: float,
) -> int:  # fmt: skip
    """Triangles whose bounding rectangle in x and z meets the prism's; bits 8 .. 15: those that stick out of it."""
    ...


@wp.func_native(
    "return r2h::leaf_in_prism(lanes.data + 8 * row, count, R, t, half_x, z_low, z_high, corners.data, span.data);"
)
def leaf_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3,
    half_x: float, z_low: float, z_high: float, corners: wp.array(dtype=float), span: wp.array(dtype=float),
) -> int:  # fmt: skip
    """As `triangles_in_prism`; also writes `corners` (9 rows) in the ee frame and `span` (2 rows), lowest and highest y."""
    ...


@wp.func_native("return r2h::outside_runs(span.data, near, slack, run_low.data, run_high.data, n);")
def outside_runs(
    span: wp.array(dtype=float), near: int, slack: float,
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), n: int,
) -> int:  # fmt: skip
    """The lanes of `near` whose `span` lies in none of n intervals, each of them `slack` longer at both ends."""
    ...


@wp.func_native("return r2h::cut_to_prism(corners.data, lanes, half_x, z_low, z_high, cut.data);")
def cut_to_prism(
    corners: wp.array(dtype=float), lanes: int, half_x: float, z_low: float, z_high: float, cut: wp.array(dtype=float)
) -> int:
    """Writes to `cut` (2 rows) the lowest and highest y of eight triangles' edges inside the prism; low > high: none.

    Bits 8 i .. 8 i + 7 of the result: the triangles of `lanes` that may hold a point of the prism's corner line i = 0 .. 3
    (`corner`).
    """
    ...


@wp.func_native("return r2h::add_run(low.data, high.data, n, a, b);")
def add_run(low: wp.array(dtype=float), high: wp.array(dtype=float), n: int, a: float, b: float) -> int:
    """Joins [a, b] to the n runs that it meets, in place; the new number of runs. Without room the nearest takes it in."""
    ...


@wp.func_native("return r2h::add_lanes(near, sticking, span.data, cut.data, slack, run_low.data, run_high.data, n);")
def add_lanes(
    near: int, sticking: int, span: wp.array(dtype=float), cut: wp.array(dtype=float), slack: float,
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), n: int,
) -> int:  # fmt: skip
    """As `add_run`, of each lane of `near`, lowest first.

    A lane's range of y is its `cut` where it is in `sticking`, else its `span`. An empty range adds nothing, nor does a lane
    whose span lies in a run, `slack` longer.
    """
    ...


@wp.func_native("return r2h::boxes_within(lanes.data + 8 * row, count, x, within2, far2.data);")
def boxes_within(
    lanes: wp.array(dtype=float), row: int, count: int, x: wp.vec3, within2: float, far2: wp.array(dtype=float)
) -> int:
    """Boxes that may be within sqrt(within2) of x; `far2` (8,): their squared distances, or a little less."""
    ...


@wp.func_native("return r2h::least_lane(row.data, bits);")
def least_lane(row: wp.array(dtype=float), bits: int) -> int:
    """The lane of `bits` with the least number in `row` (8,); `bits` is not 0."""
    ...


@wp.func_native("return r2h::nearest_triangle(lanes.data + 8 * row, count, x, best.data);")
def nearest_triangle(
    lanes: wp.array(dtype=float), row: int, count: int, x: wp.vec3, best: wp.array(dtype=float)
) -> int:
    """The triangle nearest to x, -1: none is nearer than `best`.

    `best` (5,): squared distance, weights of the second and third corner, squared distance of their point, and 1 where another
    triangle is as near but for rounding and gives another distance.
    """
    ...
