"""Bodies of the kernels as python-fcl has them, for distances and touches by other code."""

import fcl
import numpy as np
from scipy.spatial import ConvexHull

from r2h_batch.scene.robot import ShapeKind


def primitive(kind: int, size: np.ndarray, T: np.ndarray) -> fcl.CollisionObject:
    """A primitive of the kernels, sizes as in `ShapeKind`, at the pose T."""
    size = np.asarray(size, dtype=float)
    if kind == ShapeKind.BOX:
        shape = fcl.Box(*(2 * size))
    else:
        shape = (fcl.Cylinder if kind == ShapeKind.CYLINDER else fcl.Capsule)(size[0], 2 * size[1])
    return fcl.CollisionObject(shape, fcl.Transform(T[:3, :3], T[:3, 3]))


def hull(points: np.ndarray) -> fcl.CollisionObject:
    """The convex hull of points."""
    found = ConvexHull(points)
    at = np.full(len(points), -1)
    at[found.vertices] = np.arange(len(found.vertices))
    # qhull's triangles turn either way: outwards is the side of the facet's normal
    corners = points[found.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("ij,ij->i", normals, found.equations[:, :3]) < 0
    faces = np.where(inwards[:, None], found.simplices[:, ::-1], found.simplices)
    flat = np.concatenate([np.full((len(faces), 1), 3), at[faces]], axis=1).ravel()
    return fcl.CollisionObject(fcl.Convex(points[found.vertices], len(faces), flat))


def surface(triangles: np.ndarray) -> fcl.CollisionObject:
    """A surface of triangles, corners (3 N, 3) or (N, 3, 3); what lies wholly inside does not touch it."""
    corners = triangles.reshape(-1, 3)
    model = fcl.BVHModel()
    model.beginModel(len(corners), len(corners) // 3)
    model.addSubModel(corners, np.arange(len(corners)).reshape(-1, 3))
    model.endModel()
    return fcl.CollisionObject(model)


def touch(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    """Whether two bodies meet."""
    return fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()) > 0


def distance(a: fcl.CollisionObject, b: fcl.CollisionObject) -> float:
    """Distance of two bodies, m; 0 where they meet."""
    result = fcl.DistanceResult()
    fcl.distance(a, b, fcl.DistanceRequest(), result)
    return max(result.min_distance, 0.0)
