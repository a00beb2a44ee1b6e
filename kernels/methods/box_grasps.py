"""Top-down grasps of a labelled point cloud with a gripper of three boxes: any point inside a box is a collision.

Frame of a grasp: z = -z of the object (down onto it as it lies), y at the azimuth in the object's xy plane, origin at a
seed point plus `depth` along z. Boxes are given in that frame; the second finger is the first, mirrored in y.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.struct
class Boxes:
    """The open gripper (m): one finger (at +y) and everything behind the fingers."""

    finger_low: wp.vec3
    finger_high: wp.vec3
    chassis_low: wp.vec3
    chassis_high: wp.vec3


@wp.kernel
def voxel_means(
    first: int,
    # tables
    points: wp.array2d(dtype=wp.vec3),  # (O, P)
    order: wp.array2d(dtype=int),  # (O, P) points voxel by voxel
    voxel_start: wp.array2d(dtype=int),  # (O, S + 1)
    avoid: int,
    # trials
    object_in: wp.array(dtype=int),
    role_in: wp.array2d(dtype=wp.uint8),  # (B, P)
    # out
    seed_out: wp.array2d(dtype=wp.vec3), used_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Mean of the points of each voxel whose role is not `avoid`; used_out says where there are any."""
    i, voxel = wp.tid()
    trial = first + i
    o = object_in[trial]
    total = wp.vec3(0.0, 0.0, 0.0)
    count = int(0)
    for k in range(voxel_start[o, voxel], voxel_start[o, voxel + 1]):
        p = order[o, k]
        if int(role_in[trial, p]) != avoid:
            total = total + points[o, p]
            count += 1
    seed_out[trial, voxel] = total / wp.max(float(count), 1.0)
    used_out[trial, voxel] = wp.where(count > 0, wp.uint8(1), wp.uint8(0))


@wp.func
def in_box(x: float, y: float, z: float, low: wp.vec3, high: wp.vec3):
    return x >= low[0] and x <= high[0] and y >= low[1] and y <= high[1] and z >= low[2] and z <= high[2]


@wp.func
def collides(boxes: Boxes, x: float, y: float, z: float):
    """Whether a point in the grasp's frame lies in one of the three boxes."""
    return (
        in_box(x, y, z, boxes.finger_low, boxes.finger_high)
        or in_box(x, -y, z, boxes.finger_low, boxes.finger_high)
        or in_box(x, y, z, boxes.chassis_low, boxes.chassis_high)
    )


@wp.func
def finger_room(
    boxes: Boxes, seeds: wp.array2d(dtype=wp.vec3), used: wp.array2d(dtype=wp.uint8), trial: int, number: int,
    turn: wp.vec2, depth: float, most: float,
):  # fmt: skip
    """Distance (m, at most `most`) from the nearer finger's centre to the nearest other seed."""
    seed = seeds[trial, number]
    middle = 0.5 * (boxes.finger_low + boxes.finger_high)
    down = wp.vec3(0.0, 0.0, -(middle[2] + depth))
    side = middle[1] * wp.vec3(turn[0], turn[1], 0.0)
    left = seed + side + down
    right = seed - side + down
    nearest = float(most * most)
    for j in range(seeds.shape[1]):
        if j != number and used[trial, j] != wp.uint8(0):
            nearest = wp.min(
                nearest, wp.min(wp.length_sq(seeds[trial, j] - left), wp.length_sq(seeds[trial, j] - right))
            )
    return wp.sqrt(nearest)


@wp.func
def azimuths_hit(
    boxes: Boxes, points: wp.array2d(dtype=wp.vec3), turns: wp.array(dtype=wp.vec2), crop: float, o: int, seed: wp.vec3
):
    """Bits of the azimuths at which the gripper at depth 0 over a seed meets a point of object o within `crop` of it."""
    count = turns.shape[0]
    everything = (1 << count) - 1
    hit = int(0)
    for k in range(points.shape[1]):
        d = points[o, k] - seed
        if wp.abs(d[0]) < crop and wp.abs(d[1]) < crop and wp.abs(d[2]) < crop and hit != everything:
            z = -d[2]
            if z <= boxes.finger_high[2]:
                for a in range(count):
                    if (hit >> a) & 1 == 0:
                        t = turns[a]
                        if collides(boxes, t[0] * d[1] - t[1] * d[0], t[0] * d[0] + t[1] * d[1], z):
                            hit = hit | (1 << a)
    return hit


@wp.func
def free_depths(
    boxes: Boxes, points: wp.array2d(dtype=wp.vec3), depths: wp.array(dtype=float), crop: float, o: int,
    seed: wp.vec3, t: wp.vec2,
):  # fmt: skip
    """How many of the depths, from the first on, the gripper reaches at one azimuth without meeting a point."""
    free = int(depths.shape[0])
    for k in range(points.shape[1]):
        d = points[o, k] - seed
        if wp.abs(d[0]) < crop and wp.abs(d[1]) < crop and wp.abs(d[2]) < crop:
            x = t[0] * d[1] - t[1] * d[0]
            y = t[0] * d[0] + t[1] * d[1]
            for j in range(free):
                if j < free and collides(boxes, x, y, -d[2] - depths[j]):
                    free = j
    return free


@wp.kernel
def top_down_grasps(
    first: int,
    # tables
    boxes: Boxes,
    points: wp.array2d(dtype=wp.vec3),  # (O, P)
    turns: wp.array(dtype=wp.vec2),  # (A,) cos, sin of the azimuths; at most 31
    depths: wp.array(dtype=float),  # (D,) ascending
    crop: float,
    # trials
    object_in: wp.array(dtype=int),
    seed_in: wp.array2d(dtype=wp.vec3),  # (B, S)
    used_in: wp.array2d(dtype=wp.uint8),
    # out
    score_out: wp.array2d(dtype=float), turn_out: wp.array2d(dtype=int), depth_out: wp.array2d(dtype=int),
):  # fmt: skip
    """For each seed: the free azimuth with most finger room, its feasible depths, their summed finger room as score.

    depth_out is the middle of the feasible depths; score -1 where nothing is feasible.
    """
    i, number = wp.tid()
    trial = first + i
    o = object_in[trial]
    score_out[trial, number] = -1.0
    turn_out[trial, number] = 0
    depth_out[trial, number] = 0
    if used_in[trial, number] == wp.uint8(0):
        return
    seed = seed_in[trial, number]
    hit = azimuths_hit(boxes, points, turns, crop, o, seed)
    count = turns.shape[0]
    if hit == (1 << count) - 1:
        return
    best = float(-1.0)
    turn = int(-1)
    for a in range(count):
        if (hit >> a) & 1 == 0:
            room = finger_room(boxes, seed_in, used_in, trial, number, turns[a], 0.0, crop)
            if room > best:
                best = room
                turn = a
    t = turns[turn]
    free = free_depths(boxes, points, depths, crop, o, seed, t)
    if free == 0:
        return
    total = float(0.0)
    for j in range(free):
        total += finger_room(boxes, seed_in, used_in, trial, number, t, depths[j], crop)
    score_out[trial, number] = total
    turn_out[trial, number] = turn
    depth_out[trial, number] = free // 2
