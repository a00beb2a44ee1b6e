"""Depth as a stereo camera measures it, and labels as a segmenter gives them, from exact images.

Random numbers are Philox4x32-10 (Salmon et al. 2011) of (key of camera and seed; trial id, pixel of the sensor, purpose): a
pixel has the same error alone, in any batch and order, and in every window that shows it. Normal numbers are sums of
independent 16-bit ones, so that no library function decides a bit.
"""

import warp as wp

from r2h_batch.kernels.options import with_header

wp.set_module_options(with_header("philox.h"))

PLACE = wp.constant(wp.uint32(0))
FATE = wp.constant(wp.uint32(1))
STEREO = wp.constant(wp.uint32(2))
MASK = wp.constant(wp.uint32(3))
FAR_M = wp.constant(1.0e6)
NOWHERE = wp.constant(-1000000)  # no column of a window
HALF = wp.constant(wp.uint32(0xFFFF))
OF_FOUR = wp.constant(float(1.0 / 37837.2271))  # 1 / deviation of a sum of four: 65536 sqrt(4 / 12)
OF_EIGHT = wp.constant(float(1.0 / 53509.9196))  # of eight


Words = wp.types.matrix(shape=(4, 8), dtype=wp.uint32)


@wp.struct
class Sensor:
    """Errors of a depth camera, times the factor on its noise."""

    stereo: float  # deviation of the depth z is stereo z^2, 1/m
    stereo_px: int  # side of the square of pixels with one such error
    lateral: float  # deviation of where a pixel looks, pixels each way
    reach: int  # pixels that a pixel's depth comes from are within this, each way
    edge: float  # a step of this within a pixel's eight neighbours is an edge, m
    edge_lost: float  # shares of the pixels at edges
    flying: float
    facing: float  # below this |cosine| to the normal nothing is measured
    lost: float  # share of all pixels
    rounding: float  # step of the output, m


@wp.func_native("return r2h::philox<wp::mat_t<4, 8, wp::uint32>>(key_0, key_1, trial, first_pixel, purpose);")
def draw(key_0: wp.uint32, key_1: wp.uint32, trial: wp.int64, first_pixel: int, purpose: wp.uint32) -> Words:
    """Random words of `blocks()` neighbouring pixels: entry (w, k) is word w of pixel `first_pixel` + k."""
    ...


@wp.func_native("return r2h::philox_blocks();")
def blocks() -> int:
    """Pixels of one `draw`: eight where a CPU's vectors take them at once, one on CUDA."""
    ...


@wp.func
def halves(w: wp.uint32):
    """The sum of a word's two 16-bit numbers."""
    return int(w & HALF) + int(w >> wp.uint32(16))


@wp.func
def normal_of_two(a: wp.uint32, b: wp.uint32):
    """A nearly normal number of two words, at most 3.47."""
    return float(halves(a) + halves(b) - 131070) * OF_FOUR


@wp.func
def normal_of_four(a: wp.uint32, b: wp.uint32, c: wp.uint32, d: wp.uint32):
    """A nearly normal number of four words, at most 4.9."""
    return float(halves(a) + halves(b) + halves(c) + halves(d) - 262140) * OF_EIGHT


@wp.func
def uniform(w: wp.uint32):
    """A number in (0, 1): the middle of one of 2^23 cells, which float32 has exactly."""
    return (float(w >> wp.uint32(9)) + 0.5) * wp.static(2.0**-23)


@wp.func
def shows(exact: wp.array(dtype=float), start: int, columns: int, rows: int, u: int, several: int, v: int, reach: int):
    """Whether a pixel of a window within `reach` of the pixels u .. u + several - 1 of row v has a depth."""
    for b in range(wp.max(v - reach, 0), wp.min(v + reach, rows - 1) + 1):
        for a in range(wp.max(u - reach, 0), wp.min(u + several - 1 + reach, columns - 1) + 1):
            if exact[start + b * columns + a] > 0.0:
                return True
    return False


@wp.func
def span(exact: wp.array(dtype=float), above: int, own: int, below: int, u: int):
    """The nearest and the farthest depth of column u in three rows that begin at these entries; (FAR_M, 0): none."""
    a = exact[above + u]
    b = exact[own + u]
    c = exact[below + u]
    near = wp.min(wp.where(a > 0.0, a, FAR_M), wp.min(wp.where(b > 0.0, b, FAR_M), wp.where(c > 0.0, c, FAR_M)))
    return wp.vec2(near, wp.max(a, wp.max(b, c)))


@wp.kernel
def measure(
    first: int, cameras: int, columns: int, rows: int, width: int, sensor: Sensor,
    several: int,  # neighbouring columns that a thread takes
    key_in: wp.array2d(dtype=int),  # (cameras, 2) the bits of two unsigned words
    trial_in: wp.array(dtype=wp.int64),
    corner_in: wp.array2d(dtype=wp.vec2i),  # (n, cameras) the window's first pixel on the sensor
    exact_in: wp.array2d(dtype=float), facing_in: wp.array2d(dtype=float),  # as kernels/observe/rays.py gives them
    depth_out: wp.array2d(dtype=float),
):  # fmt: skip
    """The depth that is measured, m; 0 where nothing is. `width`: columns of the sensor. Pixels as in `cast`."""
    i, part = wp.tid()
    i += first
    parts = columns / several
    c = part / (parts * rows)
    v = part / parts % rows
    begin = part % parts * several
    start = c * columns * rows
    own = start + v * columns
    above = start + wp.max(v - 1, 0) * columns
    below = start + wp.min(v + 1, rows - 1) * columns
    corner = corner_in[i, c]
    y = v + corner[1]
    key_0 = wp.uint32(key_in[c, 0])
    key_1 = wp.uint32(key_in[c, 1])
    trial = trial_in[i]
    exact = exact_in[i]
    facing = facing_in[i]
    depth = depth_out[i]
    side = sensor.stereo_px
    for group in range((several + blocks() - 1) / blocks()):
        at = begin + group * blocks()
        x = at + corner[0]
        if y < 0 or not shows(exact, start, columns, rows, at, blocks(), v, sensor.reach):
            for u in range(at, wp.min(at + blocks(), begin + several)):
                depth[own + u] = 0.0
            continue
        fate = draw(key_0, key_1, trial, y * width + x, FATE)
        place = draw(key_0, key_1, trial, y * width + x, PLACE)
        square = x / side
        stereo = draw(key_0, key_1, trial, y / side * width + square, STEREO)
        left = span(exact, above, own, below, wp.max(at - 1, 0))
        middle = span(exact, above, own, below, at)
        for k in range(blocks()):
            u = at + k
            if u >= begin + several:
                break
            depth[own + u] = 0.0
            right = span(exact, above, own, below, wp.min(u + 1, columns - 1))
            near = wp.min(left[0], wp.min(middle[0], right[0]))
            far = wp.max(left[1], wp.max(middle[1], right[1]))
            left = middle
            middle = right
            if x + k < 0 or x + k >= width or uniform(fate[0, k]) < sensor.lost:
                continue
            across = int(wp.floor(sensor.lateral * normal_of_two(place[0, k], place[1, k]) + 0.5))
            down = int(wp.floor(sensor.lateral * normal_of_two(place[2, k], place[3, k]) + 0.5))
            read = start + wp.clamp(v + down, 0, rows - 1) * columns + wp.clamp(u + across, 0, columns - 1)
            z = exact[read]
            steep = facing[read] < sensor.facing
            if far - near > sensor.edge:
                turn = uniform(fate[1, k])
                if turn < sensor.edge_lost:
                    continue
                if turn < sensor.edge_lost + sensor.flying:
                    z = near + (far - near) * uniform(fate[2, k])
                    steep = bool(False)
            if z <= 0.0 or steep:
                continue
            s = (x + k) / side - square
            z += sensor.stereo * z * z * normal_of_four(stereo[0, s], stereo[1, s], stereo[2, s], stereo[3, s])
            depth[own + u] = wp.max(wp.floor(z / sensor.rounding + 0.5), 0.0) * sensor.rounding


@wp.kernel
def segment(
    first: int, cameras: int, columns: int, rows: int, grown: int, missed: float, things: wp.vec2i,
    several: int,  # neighbouring columns that a thread takes
    key_in: wp.array2d(dtype=int), trial_in: wp.array(dtype=wp.int64),
    exact_in: wp.array2d(dtype=wp.uint8),
    label_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Labels with errors of the masks of two things.

    A mask grows by so many pixels (a square about each), or shrinks where the number is negative; what leaves it shows
    nothing. With the share `missed` a camera's mask of a trial is not there.
    """
    i, part = wp.tid()
    i += first
    parts = columns / several
    c = part / (parts * rows)
    v = part / parts % rows
    begin = part % parts * several
    start = c * columns * rows
    exact = exact_in[i]
    reach = wp.abs(grown)
    low = wp.max(v - reach, 0)
    high = wp.min(v + reach, rows - 1) + 1
    gone = wp.vec2i(0, 0)
    if missed > 0.0:
        for k in range(2):
            words = draw(wp.uint32(key_in[c, 0]), wp.uint32(key_in[c, 1]), trial_in[i], things[k], MASK)
            if uniform(words[0, 0]) < missed:
                gone[k] = 1
    # the last column, of those in reach, with a pixel of a thing; with one of anything else
    some = wp.vec2i(NOWHERE, NOWHERE)
    other = wp.vec2i(NOWHERE, NOWHERE)
    for a in range(begin - reach, begin + several + reach):
        if a >= 0 and a < columns:
            for b in range(low, high):
                what = int(exact[start + b * columns + a])
                for k in range(2):
                    if what == things[k]:
                        some[k] = a
                    else:
                        other[k] = a
        u = a - reach
        if u < begin:
            continue
        own = int(exact[start + v * columns + u])
        shown = own
        for k in range(2):
            inside = own == things[k]
            if grown > 0:
                inside = some[k] >= u - reach
            if grown < 0:
                inside = other[k] < u - reach
            if gone[k] == 1:
                inside = bool(False)
            if inside:
                shown = things[k]
            elif own == things[k] and shown == things[k]:
                shown = 0
        label_out[i, start + v * columns + u] = wp.uint8(shown)
