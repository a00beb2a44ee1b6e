"""Depth, labels and how a surface faces the ray, by rays on the meshes of a scene; which body a point is near to.

The bodies of a trial: table (box), robot at home (one mesh), object and hand (a mesh each), forearm, upper arm and head
(capsules), torso (a box that stands upright). Frames: world, object, hand. Labels: `LABELS` of observe/seen.py.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

FAR_M = wp.constant(1.0e6)
TABLE = wp.constant(1)
ROBOT = wp.constant(2)
OBJECT = wp.constant(3)
HAND = wp.constant(4)
FOREARM = wp.constant(5)
UPPER_ARM = wp.constant(6)
TORSO = wp.constant(7)
HEAD = wp.constant(8)
TILES = wp.constant(16)
CELL = wp.constant(2)  # rays of a cell each way
FACES = wp.constant(64)  # of a mesh that a thread looks at
SLACK_PX = wp.constant(0.25)
NEAREST_M = wp.constant(0.05)


@wp.struct
class Bodies:
    """All that stands in the cell. A ball (centre, radius) holds each mesh."""

    table_center: wp.vec3
    table_half: wp.vec3
    robot: wp.uint64
    object_mesh: wp.array(dtype=wp.uint64)
    object_ball: wp.array(dtype=wp.vec4)
    hand_mesh: wp.array(dtype=wp.uint64)
    hand_ball: wp.array(dtype=wp.vec4)
    person: wp.int32  # whether trials have a person


@wp.func
def first_three(v: wp.vec4):
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def rotation(T: wp.mat44):
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def origin(T: wp.mat44):
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def into(T: wp.mat44, p: wp.vec3):
    """A point of the world in the frame of T."""
    return wp.transpose(rotation(T)) * (p - origin(T))


@wp.func
def misses_ball(o: wp.vec3, d: wp.vec3, ball: wp.vec4, best: float):
    """Whether a ray (unit direction) passes a ball, or meets it behind `best`."""
    m = first_three(ball) - o
    t = wp.dot(m, d)
    r = ball[3]
    return wp.dot(m, m) - t * t > r * r or t + r < 0.0 or t - r > best


@wp.func
def mesh_met(T: wp.mat44, mesh: wp.uint64, ball: wp.vec4, o: wp.vec3, d: wp.vec3, best: float):
    """How far along a ray a mesh in the frame of T is met before `best`, and |cosine| of the ray's angle to its normal
    there; FAR_M where it is not."""
    lo = into(T, o)
    ld = wp.transpose(rotation(T)) * d
    found = wp.vec2(FAR_M, 0.0)
    if not misses_ball(lo, ld, ball, best):
        met = wp.mesh_query_ray(mesh, lo, ld, best)
        if met.result:
            found = wp.vec2(met.t, wp.abs(wp.dot(ld, met.normal)))
    return found


@wp.func
def box_hit(o: wp.vec3, d: wp.vec3, half: wp.vec3):
    """How far along a ray a box about the origin begins; FAR_M where it is missed."""
    near = float(0.0)
    far = float(FAR_M)
    for k in range(3):
        if wp.abs(d[k]) < 1.0e-12:
            if wp.abs(o[k]) > half[k]:
                near = 2.0 * FAR_M
        else:
            a = (-half[k] - o[k]) / d[k]
            b = (half[k] - o[k]) / d[k]
            near = wp.max(near, wp.min(a, b))
            far = wp.min(far, wp.max(a, b))
    return wp.where(near <= far and near > 0.0, near, FAR_M)


@wp.func
def box_facing(p: wp.vec3, d: wp.vec3, half: wp.vec3):
    """|cosine| of a ray's angle to the normal of the side of a box about the origin on which p lies."""
    k = int(0)
    if wp.abs(wp.abs(p[1]) - half[1]) < wp.abs(wp.abs(p[0]) - half[0]):
        k = 1
    if wp.abs(wp.abs(p[2]) - half[2]) < wp.abs(wp.abs(p[k]) - half[k]):
        k = 2
    return wp.abs(d[k])


@wp.func
def ball_hit(o: wp.vec3, d: wp.vec3, c: wp.vec3, r: float):
    """The same of a ball. From the ray's point nearest to the centre, so that no large squares cancel."""
    m = c - o
    t = wp.dot(m, d)
    across = m - t * d
    h = r * r - wp.dot(across, across)
    if h < 0.0:
        return FAR_M
    t = t - wp.sqrt(h)
    return wp.where(t > 0.0, t, FAR_M)


@wp.func
def capsule_hit(o: wp.vec3, d: wp.vec3, a: wp.vec3, b: wp.vec3, r: float):
    """The same of the points within r of the segment from a to b."""
    t = wp.min(ball_hit(o, d, a, r), ball_hit(o, d, b, r))
    length = wp.length(b - a)
    if length < 1.0e-9:
        return t
    axis = (b - a) / length
    # across the axis: a circle
    across_d = d - wp.dot(d, axis) * axis
    across_o = a - o - wp.dot(a - o, axis) * axis
    dd = wp.dot(across_d, across_d)
    if dd < 1.0e-12:
        return t
    middle = wp.dot(across_o, across_d) / dd
    off = across_o - middle * across_d
    h = r * r - wp.dot(off, off)
    if h >= 0.0:
        s = middle - wp.sqrt(h / dd)
        along = wp.dot(o + s * d - a, axis)
        if s > 0.0 and along > 0.0 and along < length:
            t = wp.min(t, s)
    return t


@wp.func
def capsule_facing(p: wp.vec3, d: wp.vec3, a: wp.vec3, b: wp.vec3, r: float):
    """The same of a capsule on whose surface p lies."""
    along = b - a
    t = wp.clamp(wp.dot(p - a, along) / wp.max(wp.dot(along, along), 1.0e-12), 0.0, 1.0)
    return wp.abs(wp.dot(p - a - t * along, d)) / r


@wp.func
def upright(p: wp.vec3, x: float, y: float):
    """A vector in axes turned about z, the first along (x, y)."""
    return wp.vec3(x * p[0] + y * p[1], -y * p[0] + x * p[1], p[2])


@wp.func
def ray_of(T: wp.mat44, x: float, y: float, principal: wp.vec2, focal: float):
    """The direction of the ray of a place on the sensor, and the share of its length that is depth."""
    ray = wp.vec3((x - principal[0]) / focal, (y - principal[1]) / focal, 1.0)
    scale = 1.0 / wp.length(ray)
    return rotation(T) * (ray * scale), scale


@wp.func
def fixed_met(bodies: Bodies, robot: bool, o: wp.vec3, d: wp.vec3, far: float):
    """How far along a ray table or robot are met before `far`, and |cosine| of the ray's angle to the normal there; which one
    it is, 0: none."""
    best = far
    what = int(0)
    facing = float(0.0)
    t = box_hit(o - bodies.table_center, d, bodies.table_half)
    if t < best:
        best = t
        what = TABLE
        facing = box_facing(o + t * d - bodies.table_center, d, bodies.table_half)
    if robot:
        met = wp.mesh_query_ray(bodies.robot, o, d, best)
        if met.result:
            best = met.t
            what = ROBOT
            facing = wp.abs(wp.dot(d, met.normal))
    return wp.vec2(best, facing), what


@wp.kernel
def background(
    first: int, columns: int, focal: float, principal: wp.vec2, far: float,
    bodies: Bodies,
    camera_in: wp.array(dtype=wp.mat44),
    t_out: wp.array2d(dtype=float), label_out: wp.array2d(dtype=wp.uint8), facing_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Table and robot for each pixel of each camera's sensor: how far along the ray (`far`: nothing), which of them, |cosine|."""
    i, p = wp.tid()
    i += first
    T = camera_in[i]
    d, _scale = ray_of(T, float(p % columns) + 0.5, float(p / columns) + 0.5, principal, focal)
    met, what = fixed_met(bodies, True, origin(T), d, far)
    t_out[i, p] = met[0]
    label_out[i, p] = wp.uint8(what)
    facing_out[i, p] = met[1]


@wp.kernel
def cover(
    first: int, cameras: int, blocks: int, columns: int, rows: int, stride: int, focal: float, principal: wp.vec2,
    camera_in: wp.array(dtype=wp.mat44),
    corner_in: wp.array2d(dtype=wp.vec2i),  # (n, cameras)
    mesh_in: wp.array(dtype=wp.uint64), row_in: wp.array(dtype=int), T_in: wp.array(dtype=wp.mat44),  # (n,) which mesh, where
    cell_out: wp.array2d(dtype=wp.uint8),  # (n, cameras * cells)
):  # fmt: skip
    """Cells of windows (`CELL` x `CELL` rays) that the rectangle of a face's projection meets become 1: no ray of another cell
    meets the mesh. Pixels as in `cast`."""
    i, p = wp.tid()
    i += first
    c = p / blocks
    mesh = wp.mesh_get(mesh_in[row_in[i]])
    begin = (p % blocks) * FACES
    end = wp.min(begin + FACES, mesh.indices.shape[0] / 3)
    if begin >= end:
        return
    T_camera = camera_in[c]
    R = wp.transpose(rotation(T_camera)) * rotation(T_in[i])
    t = into(T_camera, origin(T_in[i]))
    wide = (columns + CELL - 1) / CELL
    high = (rows + CELL - 1) / CELL
    start = c * wide * high
    left = float(corner_in[i, c][0])
    top = float(corner_in[i, c][1])
    step = 1.0 / float(stride)
    for f in range(begin, end):
        low_u = float(1.0e9)
        low_v = float(1.0e9)
        high_u = float(-1.0e9)
        high_v = float(-1.0e9)
        anywhere = bool(False)
        for k in range(3):
            q = R * mesh.points[mesh.indices[3 * f + k]] + t
            if q[2] < NEAREST_M:
                anywhere = bool(True)
            else:
                s = focal / q[2]
                low_u = wp.min(low_u, q[0] * s)
                high_u = wp.max(high_u, q[0] * s)
                low_v = wp.min(low_v, q[1] * s)
                high_v = wp.max(high_v, q[1] * s)
        # rays whose middles are inside, a little more
        a = (low_u + principal[0] - left - SLACK_PX) * step - 0.5
        b = (high_u + principal[0] - left + SLACK_PX) * step - 0.5
        d = (low_v + principal[1] - top - SLACK_PX) * step - 0.5
        e = (high_v + principal[1] - top + SLACK_PX) * step - 0.5
        if anywhere:
            a = 0.0
            d = 0.0
            b = float(columns)
            e = float(rows)
        if b >= 0.0 and e >= 0.0 and a <= float(columns) and d <= float(rows):
            u0 = int(wp.ceil(wp.max(a, 0.0)))
            v0 = int(wp.ceil(wp.max(d, 0.0)))
            u1 = int(wp.min(b, float(columns - 1)))
            v1 = int(wp.min(e, float(rows - 1)))
            if u0 <= u1 and v0 <= v1:
                for v in range(v0 / CELL, v1 / CELL + 1):
                    for u in range(u0 / CELL, u1 / CELL + 1):
                        cell_out[i, start + v * wide + u] = wp.uint8(1)


@wp.kernel
def cast(
    first: int, cameras: int, columns: int, rows: int, stride: int, focal: float, principal: wp.vec2, far: float,
    several: int,  # neighbouring columns that a thread takes
    bodies: Bodies,
    camera_in: wp.array(dtype=wp.mat44),  # one a camera, OpenCV axes
    corner_in: wp.array2d(dtype=wp.vec2i),  # (n, cameras) the window's lowest pixel on the sensor
    sensor: wp.vec2i,  # its columns and rows
    tile_in: wp.array3d(dtype=int),  # (n, cameras, TILES^2) of the tiles of the window: bits of the labels that a ray may meet
    object_cell_in: wp.array2d(dtype=wp.uint8), hand_cell_in: wp.array2d(dtype=wp.uint8),  # as `cover` gives them
    object_in: wp.array(dtype=int), T_world_obj_in: wp.array(dtype=wp.mat44),
    hand_in: wp.array(dtype=int), T_world_hand_in: wp.array(dtype=wp.mat44),
    receiver_in: wp.array2d(dtype=wp.vec4),  # (n, 5) `Trials.receiver`
    head_in: wp.array2d(dtype=wp.vec4),  # (n, 2) `heads_of`
    known: int,  # whether the next three are there, of each pixel of the sensors (`background`); stride 1
    fixed_t_in: wp.array2d(dtype=float), fixed_label_in: wp.array2d(dtype=wp.uint8), fixed_facing_in: wp.array2d(dtype=float),
    depth_out: wp.array2d(dtype=float), label_out: wp.array2d(dtype=wp.uint8), facing_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Depth along the camera's z axis (m), what is seen, and |cosine| of the ray's angle to the surface's normal, of each
    pixel's middle; 0 for nothing.

    A row of the output is a trial: its cameras one after the other, each `rows` x `columns` rays, `stride` pixels apart.
    """
    i, part = wp.tid()
    i += first
    parts = columns / several
    c = part / (parts * rows)
    v = part / parts % rows
    begin = part % parts * several
    T = camera_in[c]
    o = origin(T)
    corner = corner_in[i, c]
    y = float(v * stride + corner[1]) + 0.5 * float(stride)
    wide = (columns + CELL - 1) / CELL
    cells = (c * ((rows + CELL - 1) / CELL) + v / CELL) * wide
    tiles = (v * TILES / rows) * TILES
    if y < 0.0 or y > float(sensor[1]):
        return
    for u in range(begin, begin + several):
        p = (c * rows + v) * columns + u
        x = float(u * stride + corner[0]) + 0.5 * float(stride)
        if x < 0.0 or x > float(sensor[0]):
            continue
        here = tile_in[i, c, tiles + u * TILES / columns]
        cell = cells + u / CELL
        here += (int(object_cell_in[i, cell]) << OBJECT) + (int(hand_cell_in[i, cell]) << HAND)
        met = wp.vec2(far, 0.0)
        what = int(0)
        at = int(y) * sensor[0] + int(x)
        if known == 1:
            what = int(fixed_label_in[c, at])
            if what + (here >> OBJECT) == 0:
                continue  # nothing is there
            met = wp.vec2(fixed_t_in[c, at], fixed_facing_in[c, at])
        d, scale = ray_of(T, x, y, principal, focal)
        if known == 0:
            met, what = fixed_met(bodies, here >> ROBOT & 1 == 1, o, d, far)
        best = met[0]
        facing = met[1]
        if here >> OBJECT & 1 == 1:
            k = object_in[i]
            hit = mesh_met(T_world_obj_in[i], bodies.object_mesh[k], bodies.object_ball[k], o, d, best)
            if hit[0] < best:
                best = hit[0]
                what = OBJECT
                facing = hit[1]
        if here >> HAND & 1 == 1:
            k = hand_in[i]
            hit = mesh_met(T_world_hand_in[i], bodies.hand_mesh[k], bodies.hand_ball[k], o, d, best)
            if hit[0] < best:
                best = hit[0]
                what = HAND
                facing = hit[1]
        if here >> FOREARM > 0:
            for k in range(2):  # from the wrist up: FOREARM, UPPER_ARM
                if here >> (FOREARM + k) & 1 == 1:
                    upper = first_three(receiver_in[i, 1 - k])
                    lower = first_three(receiver_in[i, 2 - k])
                    radius = receiver_in[i, 1 - k][3]
                    t = capsule_hit(o, d, upper, lower, radius)
                    if t < best:
                        best = t
                        what = FOREARM + k
                        facing = capsule_facing(o + t * d, d, upper, lower, radius)
        if here >> TORSO & 1 == 1:
            fx = receiver_in[i, 3][3]
            fy = receiver_in[i, 4][3]
            from_middle = upright(o - first_three(receiver_in[i, 3]), fx, fy)
            ahead = upright(d, fx, fy)
            half = first_three(receiver_in[i, 4])
            t = box_hit(from_middle, ahead, half)
            if t < best:
                best = t
                what = TORSO
                facing = box_facing(from_middle + t * ahead, ahead, half)
        if here >> HEAD & 1 == 1:
            chin = first_three(head_in[i, 0])
            crown = first_three(head_in[i, 1])
            t = capsule_hit(o, d, chin, crown, head_in[i, 0][3])
            if t < best:
                best = t
                what = HEAD
                facing = capsule_facing(o + t * d, d, chin, crown, head_in[i, 0][3])
        if what > 0:
            depth_out[i, p] = best * scale
            label_out[i, p] = wp.uint8(what)
            facing_out[i, p] = facing


@wp.func
def to_box(p: wp.vec3, half: wp.vec3):
    """Distance to a box about the origin; 0 inside."""
    away = wp.vec3(
        wp.max(wp.abs(p[0]) - half[0], 0.0), wp.max(wp.abs(p[1]) - half[1], 0.0), wp.max(wp.abs(p[2]) - half[2], 0.0)
    )
    return wp.length(away)


@wp.func
def to_capsule(p: wp.vec3, a: wp.vec3, b: wp.vec3, r: float):
    """Distance to a capsule; 0 or less inside."""
    along = b - a
    t = wp.clamp(wp.dot(p - a, along) / wp.max(wp.dot(along, along), 1.0e-12), 0.0, 1.0)
    return wp.length(p - a - t * along) - r


@wp.func
def mesh_near(mesh: wp.uint64, ball: wp.vec4, p: wp.vec3, within: float):
    """Whether a mesh's surface is within this of a point."""
    if wp.length(p - first_three(ball)) > ball[3] + within:
        return False
    return wp.mesh_query_point_no_sign(mesh, p, within).result


@wp.kernel
def near(
    first: int, within: float, resting: int,
    bodies: Bodies,
    object_in: wp.array(dtype=int), T_world_obj_in: wp.array(dtype=wp.mat44),
    hand_in: wp.array(dtype=int), T_world_hand_in: wp.array(dtype=wp.mat44),
    receiver_in: wp.array2d(dtype=wp.vec4), head_in: wp.array2d(dtype=wp.vec4),
    points_in: wp.array2d(dtype=wp.vec3),  # (n, k) world
    label_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """A body that is within this (m) of each point; 0: none is. `resting`: points of the object, which touches the table."""
    i, j = wp.tid()
    i += first
    p = points_in[i, j]
    found = int(0)
    if resting == 0:
        if to_box(p - bodies.table_center, bodies.table_half) <= within:
            found = TABLE
        if mesh_near(
            bodies.object_mesh[object_in[i]], bodies.object_ball[object_in[i]], into(T_world_obj_in[i], p), within
        ):
            found = OBJECT
    if wp.mesh_query_point_no_sign(bodies.robot, p, within).result:
        found = ROBOT
    if mesh_near(bodies.hand_mesh[hand_in[i]], bodies.hand_ball[hand_in[i]], into(T_world_hand_in[i], p), within):
        found = HAND
    if bodies.person == 1:
        shoulder = first_three(receiver_in[i, 0])
        elbow = first_three(receiver_in[i, 1])
        if to_capsule(p, elbow, first_three(receiver_in[i, 2]), receiver_in[i, 1][3]) <= within:
            found = FOREARM
        if to_capsule(p, shoulder, elbow, receiver_in[i, 0][3]) <= within:
            found = UPPER_ARM
        from_middle = upright(p - first_three(receiver_in[i, 3]), receiver_in[i, 3][3], receiver_in[i, 4][3])
        if to_box(from_middle, first_three(receiver_in[i, 4])) <= within:
            found = TORSO
        if to_capsule(p, first_three(head_in[i, 0]), first_three(head_in[i, 1]), head_in[i, 0][3]) <= within:
            found = HEAD
    label_out[i, j] = wp.uint8(found)
