"""The exact surfaces of the receiver hands: closed triangle meshes whose faces are grouped by convex piece."""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.struct
class HandMesh:
    """The exact surfaces of H posed hands (hand frame): F faces each, every face in exactly one convex piece."""

    n_vertices: int
    n_faces: int
    vertices: wp.array(dtype=wp.vec3)  # (H * V,)
    faces: wp.array2d(dtype=int)  # (F, 3) grouped by piece; winding does not matter here
    piece_face: wp.array(dtype=int)  # (n_pieces + 1,) first face of each piece
    face_ball: wp.array(dtype=wp.vec4)  # (H * F,) bounding ball: centre, radius


@wp.func
def triangle_points(mesh: HandMesh, hand: int, face: int, tri: wp.array(dtype=wp.vec3)):
    """Writes a face's corners."""
    base = hand * mesh.n_vertices
    for k in range(3):
        tri[k] = mesh.vertices[base + mesh.faces[face, k]]


@wp.func
def inside_mesh(mesh: HandMesh, hand: int, x: wp.vec3, tri: wp.array(dtype=wp.vec3)):
    """Whether x is inside the hand's closed surface: winding number by solid angles (van Oosterom and Strackee 1983)."""
    total = float(0.0)
    for face in range(mesh.n_faces):
        triangle_points(mesh, hand, face, tri)
        a = tri[0] - x
        b = tri[1] - x
        c = tri[2] - x
        # tan(solid angle / 2); the halves add up to 2 pi inside and 0 outside
        la = wp.length(a)
        lb = wp.length(b)
        lc = wp.length(c)
        total += angle_of(
            wp.dot(a, wp.cross(b, c)), la * lb * lc + wp.dot(a, b) * lc + wp.dot(b, c) * la + wp.dot(c, a) * lb
        )
    return wp.abs(total) > 3.14159265
