"""Questions about meshes answered another way."""

import numpy as np


def winding_number(mesh, points):
    """Sum of solid angles over 4 pi, float64 (van Oosterom and Strackee): independent of the voxels' columns."""
    total = np.zeros(len(points))
    for i, p in enumerate(points):
        a, b, c = (mesh.triangles - p).transpose(1, 0, 2)
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        dot = lambda u, v: np.einsum("ij,ij->i", u, v)  # noqa: E731
        bottom = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        total[i] = 2 * np.arctan2(top, bottom).sum() / (4 * np.pi)
    return total
