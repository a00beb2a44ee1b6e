"""Depth as a stereo camera measures it, and labels as a segmenter gives them, from exact images.

Random numbers are Philox4x32-10 (Salmon et al. 2011) of (key of camera and seed; trial id, pixel of the sensor, purpose): a
pixel has the same error alone, in any batch and order, and in every window that shows it. Normal numbers are sums of
independent 16-bit ones, so that no library function decides a bit.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

PLACE = wp.constant(wp.uint32(0))
FATE = wp.constant(wp.uint32(1))
STEREO = wp.constant(wp.uint32(2))
MASK = wp.constant(wp.uint32(3))
# Philox4x32's multipliers and the steps of its keys; a literal in a kernel is an int32, and the compiler would warn of these
TIMES_A, TIMES_C = (wp.constant(wp.uint32(x)) for x in (0xD2511F53, 0xCD9E8D57))
STEP_0, STEP_1 = (wp.constant(wp.uint32(x)) for x in (0x9E3779B9, 0xBB67AE85))
LOW = wp.constant(wp.uint64(0xFFFFFFFF))
HALF = wp.constant(wp.uint32(0xFFFF))
OF_FOUR = wp.constant(float(1.0 / 37837.2271))  # 1 / deviation of a sum of four: 65536 sqrt(4 / 12)
OF_EIGHT = wp.constant(float(1.0 / 53509.9196))  # of eight


@wp.struct
class Words:
    """A block of four random words."""

    a: wp.uint32
    b: wp.uint32
    c: wp.uint32
    d: wp.uint32


@wp.struct
class Sensor:
    """Errors of a depth camera, times the factor on its noise."""

    stereo: float  # deviation of the depth z is stereo z^2, 1/m
    stereo_px: int  # side of the square of pixels with one such error
    lateral: float  # deviation of where a pixel looks, pixels each way
    edge: float  # a step of this within a pixel's eight neighbours is an edge, m
    edge_lost: float  # shares of the pixels at edges
    flying: float
    facing: float  # below this |cosine| to the normal nothing is measured
    lost: float  # share of all pixels
    rounding: float  # step of the output, m


@wp.func
def random_words(k0: wp.uint32, k1: wp.uint32, trial: wp.int64, pixel: int, purpose: wp.uint32):
    """Ten rounds of Philox4x32."""
    t = wp.uint64(trial)
    a = wp.uint32(t & LOW)
    b = wp.uint32(t >> wp.uint64(32))
    c = wp.uint32(pixel)
    d = purpose << wp.uint32(16)
    for _i in range(10):
        p = wp.uint64(TIMES_A) * wp.uint64(a)
        q = wp.uint64(TIMES_C) * wp.uint64(c)
        a = wp.uint32(q >> wp.uint64(32)) ^ b ^ k0
        b = wp.uint32(q & LOW)
        c = wp.uint32(p >> wp.uint64(32)) ^ d ^ k1
        d = wp.uint32(p & LOW)
        k0 = k0 + STEP_0
        k1 = k1 + STEP_1
    found = Words()
    found.a = a
    found.b = b
    found.c = c
    found.d = d
    return found


@wp.func
def halves(w: wp.uint32):
    """The sum of a word's two 16-bit numbers."""
    return int(w & HALF) + int(w >> wp.uint32(16))


@wp.func
def normal_of_two(a: wp.uint32, b: wp.uint32):
    """A nearly normal number of two words, at most 3.5."""
    return float(halves(a) + halves(b) - 131070) * OF_FOUR


@wp.func
def normal_of_four(w: Words):
    """A nearly normal number of four words, at most 4.9."""
    return float(halves(w.a) + halves(w.b) + halves(w.c) + halves(w.d) - 262140) * OF_EIGHT


@wp.func
def uniform(w: wp.uint32):
    """A number in (0, 1): the middle of one of 2^23 cells, which float32 has exactly."""
    return (float(w >> wp.uint32(9)) + 0.5) * wp.static(2.0**-23)


@wp.kernel
def measure(
    first: int, cameras: int, columns: int, rows: int, width: int, sensor: Sensor,
    key_in: wp.array2d(dtype=int),  # (cameras, 2) the bits of two unsigned words
    trial_in: wp.array(dtype=wp.int64),
    corner_in: wp.array2d(dtype=wp.vec2i),  # (n, cameras) the window's first pixel on the sensor
    exact_in: wp.array2d(dtype=float), facing_in: wp.array2d(dtype=float),  # as kernels/observe/rays.py gives them
    depth_out: wp.array2d(dtype=float),
):  # fmt: skip
    """The depth that is measured, m; 0 where nothing is. `width`: columns of the sensor. Pixels as in `cast`."""
    i, p = wp.tid()
    i += first
    pixels = columns * rows
    c = p / pixels
    u = (p % pixels) % columns
    v = (p % pixels) / columns
    start = c * pixels
    x = u + corner_in[i, c][0]
    y = v + corner_in[i, c][1]
    depth_out[i, p] = 0.0
    if x < 0 or y < 0 or x >= width:
        return
    k0 = wp.uint32(key_in[c, 0])
    k1 = wp.uint32(key_in[c, 1])
    trial = trial_in[i]
    fate = random_words(k0, k1, trial, y * width + x, FATE)
    if uniform(fate.a) < sensor.lost:
        return
    place = random_words(k0, k1, trial, y * width + x, PLACE)
    across = int(wp.floor(sensor.lateral * normal_of_two(place.a, place.b) + 0.5))
    down = int(wp.floor(sensor.lateral * normal_of_two(place.c, place.d) + 0.5))
    read = start + wp.clamp(v + down, 0, rows - 1) * columns + wp.clamp(u + across, 0, columns - 1)
    z = exact_in[i, read]
    steep = facing_in[i, read] < sensor.facing
    near = float(1.0e6)
    far = float(0.0)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            if v + dv >= 0 and v + dv < rows and u + du >= 0 and u + du < columns:
                d = exact_in[i, start + (v + dv) * columns + u + du]
                if d > 0.0:
                    near = wp.min(near, d)
                    far = wp.max(far, d)
    if far - near > sensor.edge:
        at = uniform(fate.b)
        if at < sensor.edge_lost:
            return
        if at < sensor.edge_lost + sensor.flying:
            z = near + (far - near) * uniform(fate.c)
            steep = bool(False)
    if z <= 0.0 or steep:
        return
    side = sensor.stereo_px
    z += sensor.stereo * z * z * normal_of_four(random_words(k0, k1, trial, y / side * width + x / side, STEREO))
    depth_out[i, p] = wp.max(wp.floor(z / sensor.rounding + 0.5), 0.0) * sensor.rounding


@wp.kernel
def segment(
    first: int, cameras: int, columns: int, rows: int, grown: int, missed: float, things: wp.vec2i,
    key_in: wp.array2d(dtype=int), trial_in: wp.array(dtype=wp.int64),
    exact_in: wp.array2d(dtype=wp.uint8),
    label_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Labels with errors of the masks of two things.

    A mask grows by so many pixels (a square about each), or shrinks where the number is negative; what leaves it shows
    nothing. With the share `missed` a camera's mask of a trial is not there.
    """
    i, p = wp.tid()
    i += first
    pixels = columns * rows
    c = p / pixels
    u = (p % pixels) % columns
    v = (p % pixels) / columns
    start = c * pixels
    own = int(exact_in[i, p])
    shown = own
    reach = wp.abs(grown)
    for k in range(2):
        thing = things[k]
        some = bool(False)
        all_of = bool(True)
        for dv in range(-reach, reach + 1):
            for du in range(-reach, reach + 1):
                if v + dv >= 0 and v + dv < rows and u + du >= 0 and u + du < columns:
                    if int(exact_in[i, start + (v + dv) * columns + u + du]) == thing:
                        some = bool(True)
                    else:
                        all_of = bool(False)
        inside = own == thing
        if grown > 0:
            inside = some
        if grown < 0:
            inside = all_of
        found = random_words(wp.uint32(key_in[c, 0]), wp.uint32(key_in[c, 1]), trial_in[i], thing, MASK)
        if uniform(found.a) < missed:
            inside = bool(False)
        if inside:
            shown = thing
        elif own == thing and shown == thing:
            shown = 0
    label_out[i, p] = wp.uint8(shown)
