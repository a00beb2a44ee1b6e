"""Which of an object's points may lie in a posed hand: in what bounds its convex pieces, and away from its skin."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.kernel
def may_be_in_hand(
    first: int,
    # tables
    direction: wp.array(dtype=wp.vec3),  # (D)
    low: wp.array2d(dtype=float),  # (pieces, D) how far each piece reaches along the directions
    high: wp.array2d(dtype=float),
    box_low: wp.vec3,
    box_high: wp.vec3,
    skin: wp.array(dtype=wp.vec3),
    off_skin: float,
    # trials
    point_in: wp.array(dtype=wp.vec3),
    # out
    inside_out: wp.array(dtype=wp.bool),
):
    """Whether a point lies between all planes about one of the pieces and is `off_skin` or more from every skin vertex.

    Pieces hold the skin: what is in none of them is outside. A vertex is of the skin, which is as near as it or nearer.
    """
    i = first + wp.tid()
    p = point_in[i]
    inside_out[i] = False
    for k in range(3):
        if p[k] < box_low[k] or p[k] > box_high[k]:
            return
    within = bool(False)
    for piece in range(low.shape[0]):
        if not within:
            between = bool(True)
            d = int(0)
            while between and d < direction.shape[0]:
                along = wp.dot(direction[d], p)
                between = along >= low[piece, d] and along <= high[piece, d]
                d += 1
            within = between
    if within:
        for v in range(skin.shape[0]):
            if wp.length_sq(p - skin[v]) < off_skin * off_skin:
                return
        inside_out[i] = True
