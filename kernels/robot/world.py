"""Inputs of every collision kernel: robot, hands, objects, table, and where each trial's bodies sit.

All work is done in the trial's *hand frame*: forward kinematics starts from T_hand_world, so the hand's pieces need no
transform at all. Bodies are numbered: arm primitives, gripper primitives, then the attached object's hulls.
Links are numbered 0 base ... JOINTS the last of the arm, then gripper and object, which ride on it (`wrist` in names here).
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import sin_cos
from r2h_batch.kernels.geometry.shape import BLOCKS, CELLS, Shape
from r2h_batch.kernels.options import OPTIONS

from .joints import CHANGES, JOINTS, LAST_LINK, vecq

wp.set_module_options(OPTIONS)


@wp.struct
class World:
    """Constant over trials. Capsules bound a body: two end points in its frame, and a radius (m)."""

    joint_R: wp.array(dtype=wp.mat33)  # (JOINTS,) parent link to joint at q = 0; the joint turns about its z
    joint_p: wp.array(dtype=wp.vec3)
    lower: wp.array(dtype=float)  # (JOINTS,) joint limits, rad
    upper: wp.array(dtype=float)
    n_arm: int
    n_robot: int  # arm and gripper primitives
    body_link: wp.array(dtype=int)  # (n_robot,)
    kind: wp.array(dtype=int)
    size: wp.array(dtype=wp.vec3)
    radius: wp.array(dtype=float)  # capsules and spheres: the core's growth
    body_start: wp.array(dtype=int)  # hulls (BLOCKS): the first row of their points, and how many blocks
    body_blocks: wp.array(dtype=int)
    cap_radius: wp.array(dtype=float)  # bounding capsule
    cap_axis: wp.array(dtype=wp.vec3)  # from its middle to one end, in the body frame
    body_R: wp.array(dtype=wp.mat33)  # (n_arm,) in the link frame
    body_p: wp.array(dtype=wp.vec3)
    # (n_robot, JOINTS) largest distance of a body's points from each joint's axis, any posture
    motion_radius: wp.array2d(dtype=float)
    link_first: wp.array(dtype=int)  # (LINKS,) bodies of link k: link_first[k] .. link_first[k + 1], k below LINKS - 1
    # (LINKS - 1,) bounding capsule of the whole link (the gripper in the last link's frame)
    link_c0: wp.array(dtype=wp.vec3)
    link_c1: wp.array(dtype=wp.vec3)
    link_radius: wp.array(dtype=float)
    link_motion_radius: wp.array2d(dtype=float)  # (LINKS - 1, JOINTS)
    # (LINKS,) bit k of entry l: link l is checked against link k < l (the last: the object)
    self_links: wp.array(dtype=int)
    table_from: int  # bodies from this one on are checked against the table: base and shoulder stand on it
    table_center: wp.vec3  # world frame
    table_half: wp.vec3
    # hull points of all hands' pieces (hand frame, in blocks) and all objects (object frame)
    points: wp.array(dtype=wp.vec3)
    # points of the pieces that a batch brings along: the bodies of its receivers, objects that rest
    own_points: wp.array(dtype=wp.vec3)
    n_pieces: int
    # (H * n_pieces,) first row of each piece's blocks of points (geometry/shape.py, BLOCKS); -1 - row: of `own_points`
    piece_start: wp.array(dtype=int)
    piece_blocks: wp.array(dtype=int)  # how many blocks these are
    # the piece is its points' hull grown by this (m): a hand's 0, an arm's its radius
    piece_round: wp.array(dtype=float)
    piece_center: wp.array(dtype=wp.vec3)
    piece_radius: wp.array(dtype=float)
    hand_center: wp.array(dtype=wp.vec3)  # (H,)
    hand_radius: wp.array(dtype=float)
    hull_first: wp.array(dtype=int)  # (O + 1,) hulls of object o: hull_first[o] .. hull_first[o + 1]
    hull_start: wp.array(dtype=int)  # (hulls + 1,)
    hull_cells: wp.array(dtype=int)  # (hulls,) the same hulls' points by direction (geometry/shape.py, CELLS)
    hull_c0: wp.array(dtype=wp.vec3)
    hull_c1: wp.array(dtype=wp.vec3)
    hull_radius: wp.array(dtype=float)


@wp.struct
class TrialBodies:
    """Per trial: which hand and object, and where things sit."""

    hand: wp.array(dtype=int)
    object: wp.array(dtype=int)
    R_hand_world: wp.array(dtype=wp.mat33)
    p_hand_world: wp.array(dtype=wp.vec3)
    R_wrist_grip: wp.array2d(dtype=wp.mat33)  # (B, n_robot - n_arm) gripper primitives in the last link's frame
    p_wrist_grip: wp.array2d(dtype=wp.vec3)
    R_wrist_obj: wp.array(dtype=wp.mat33)
    p_wrist_obj: wp.array(dtype=wp.vec3)
    object_motion_radius: wp.array2d(dtype=float)  # (B, JOINTS)


@wp.func(inline=False)
def child_frame(R: wp.mat33, p: wp.vec3, joint_R: wp.mat33, joint_p: wp.vec3, q: float):
    """R, p of a joint's child link, from its parent's: to the joint's frame, then by q (rad) about its z."""
    s, c = sin_cos(q)
    return R * joint_R * wp.mat33(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0), R * joint_p + p


@wp.func
def forward_kinematics(
    world: World, R_hand_world: wp.mat33, p_hand_world: wp.vec3, q: vecq, R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Writes the frames of the arm's links in the hand frame."""
    Rk = R_hand_world
    pk = p_hand_world
    R[0] = Rk
    p[0] = pk
    for i in range(JOINTS):
        Rk, pk = child_frame(Rk, pk, world.joint_R[i], world.joint_p[i], q[i])
        R[i + 1] = Rk
        p[i + 1] = pk


@wp.func
def link_frame(link: int):
    """The link whose frame carries this one."""
    return wp.min(link, LAST_LINK)


@wp.func
def body_pose(
    world: World, bodies: TrialBodies, trial: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), body: int
):
    """Pose of a robot body or of the object (any body >= n_robot), in the hand frame."""
    Rk = R[LAST_LINK]
    pk = p[LAST_LINK]
    Rb = bodies.R_wrist_obj[trial]
    pb = bodies.p_wrist_obj[trial]
    if body < world.n_arm:
        k = world.body_link[body]
        Rk = R[k]
        pk = p[k]
        Rb = world.body_R[body]
        pb = world.body_p[body]
    elif body < world.n_robot:
        Rb = bodies.R_wrist_grip[trial, body - world.n_arm]
        pb = bodies.p_wrist_grip[trial, body - world.n_arm]
    return Rk * Rb, Rk * pb + pk


@wp.func
def robot_shape(world: World, body: int):
    """The shape of a robot body."""
    b = Shape()
    b.kind = world.kind[body]
    b.size = world.size[body]
    b.radius = world.radius[body]
    if b.kind == BLOCKS:
        b.start = world.body_start[body]
        b.count = world.body_blocks[body]
    return b


@wp.func
def piece_shape(world: World, piece: int):
    """A piece of a hand as a shape."""
    b = Shape()
    b.kind = BLOCKS
    b.start = world.piece_start[piece]
    b.count = world.piece_blocks[piece]
    b.radius = world.piece_round[piece]
    return b


@wp.func
def points_of(world: World, shape: Shape):
    """The table that an obstacle's points stand in."""
    return wp.where(shape.start < 0, world.own_points, world.points)


@wp.func
def object_shape(world: World, hull: int):
    """One hull of an object as a shape."""
    b = Shape()
    b.kind = CELLS
    b.start = world.hull_cells[hull]
    return b


@wp.func_native(
    "return r2h::motion((const float*)((const char*)motion_radius.data + row * motion_radius.strides[0]), first_joint, d.c);"
)
def motion(motion_radius: wp.array2d(dtype=float), row: int, first_joint: int, d: vecq) -> float:
    """How far a body's points can move when the joints from `first_joint` on turn by d (rad): sum of |d_j| motion_radius_j."""
    ...


@wp.func_native(
    "return r2h::bends((const float*)((const char*)motion_radius.data + row * motion_radius.strides[0]), first_joint, d.c);"
)
def _bends(motion_radius: wp.array2d(dtype=float), row: int, first_joint: int, d: vecq) -> wp.vec2: ...


@wp.func
def bends(motion_radius: wp.array2d(dtype=float), row: int, first_joint: int, d: vecq):
    """Bounds on the second and on the third derivative of a body's points along q + s d, joints from `first_joint` on.

    |d^2 x / dq_i dq_j| = |z_i x (z_j x (x - o_j))| for i <= j is at most the distance to the outer joint's axis,
    r_j = motion_radius_j; the same holds for three joints. With S_j = |d_0| + .. + |d_j| the pairs whose outer joint is j
    weigh S_j^2 - S_(j-1)^2, the triples S_j^3 - S_(j-1)^3.
    """
    found = _bends(motion_radius, row, first_joint, d)
    return found[0], found[1]


@wp.func(inline=False)
def twists(
    d: vecq, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Writes each link's fields of velocity v + w x and acceleration b + a x + w (w x) when the joints turn at rates d.

    Hand frame; x: cross product with the point. Rows 0 to JOINTS: w and v; from CHANGES on: a in `w`, b in `v`.
    """
    wk = wp.vec3(0.0, 0.0, 0.0)
    vk = wp.vec3(0.0, 0.0, 0.0)
    ak = wp.vec3(0.0, 0.0, 0.0)
    uk = wp.vec3(0.0, 0.0, 0.0)  # how v changes
    w[0] = wk
    v[0] = vk
    w[CHANGES] = wk
    v[CHANGES] = vk
    for j in range(JOINTS):
        Rj = R[j + 1]
        # a turn at rate d_j about an axis z through o has the field z x (x - o) = z x x + o x z; the link before carries both
        z = d[j] * wp.vec3(Rj[0, 2], Rj[1, 2], Rj[2, 2])
        o = p[j + 1]
        dz = wp.cross(wk, z)
        ak = ak + dz
        uk = uk + wp.cross(vk + wp.cross(wk, o), z) + wp.cross(o, dz)
        wk = wk + z
        vk = vk + wp.cross(o, z)
        w[j + 1] = wk
        v[j + 1] = vk
        w[CHANGES + j + 1] = ak
        v[CHANGES + j + 1] = uk + wp.cross(wk, vk)


@wp.func(inline=False)
def acceleration_along(n: wp.vec3, w: wp.vec3, a: wp.vec3, b: wp.vec3):
    """g and c: along n a point x of a link accelerates by c + g . x (`twists`)."""
    return wp.cross(n, a) + wp.cross(wp.cross(n, w), w), wp.dot(n, b)


@wp.func(inline=False)
def relative_acceleration(
    n: wp.vec3, w: wp.vec3, v: wp.vec3, a: wp.vec3, b: wp.vec3, other: int,
    of_w: wp.array(dtype=wp.vec3), of_v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The same as the link `other` sees it, with which n turns; `of_w`, `of_v`: as `twists` writes them.

    In its frame the acceleration is less by that of its own point there, and by 2 w_other x (relative velocity).
    """
    g, c = acceleration_along(n, w, a, b)
    wo = of_w[other]
    go, co = acceleration_along(n, wo, of_w[CHANGES + other], of_v[CHANGES + other])
    turn = 2.0 * wp.cross(n, wo)
    return g - go - wp.cross(turn, w - wo), c - co - wp.dot(turn, v - of_v[other])
