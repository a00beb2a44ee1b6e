"""The bodies as which the links of an imported arm collide: fitted once for each mesh, kept by its digest."""

import hashlib
import json
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.data.robot_links import Link
from r2h_batch.data.robot_shapes import Hull, Shape, Target, fit_hulls

Array = NDArray[np.float64]

MOST_OVERSHOOT_MM = 3.0
"""Mean distance from a link's bodies to its mesh above which it gets one body more."""
MOST_OUTSIDE_MM = 0.1
"""How much of a link's mesh the file's own shapes may leave outside."""
MOST_HULLS = 6
"""Most hulls of a link, as long as each link after it can have one of the bodies that the kernels
hold."""
MOST_CUT_S = 20.0
"""Processor seconds of a link after which it gets no further body."""
FORM = {
    "corners": ArraySpec("float64", ("corners", 3)),
    "count": ArraySpec("int64", ("hulls",)),
    "row": ArraySpec("text"),
}
CODE = ("r2h_batch.data.robot_shapes", "r2h_batch.data.robot_bodies")


def bodies_of(
    link: Link, mouths: list[Array], most: int
) -> tuple[list[Shape | Hull], dict[str, Any]]:
    """The file's own cylinders, boxes and capsules where they are the link, or cover its mesh as hulls
    must; else as few hulls of its mesh as overshoot it little enough. And its figures.

    Args:
        link: how it looks and collides.
        mouths: points (P, 3) in sleeves that the next link closes.
        most: bodies that it may have.
    """
    shapes = list(link.shapes)
    if shapes and link.meshed == 0 and len(shapes) <= most:
        row = {"primitives": len(shapes), "mean_mm": 0.0, "worst_protrusion_mm": 0.0}
        return [*shapes], row | {"from": "shapes of the file"}
    apart = bool(link.meshed) and len(shapes) < min(most, MOST_HULLS)
    triangles = link.triangles[: link.meshed] if apart else link.triangles
    shapes = shapes if apart else []
    more: dict[str, Any] = {}
    began = time.process_time()
    mesh: Target | None = None
    if link.collides and not shapes:
        given = list(link.collides)
        mesh = Target(triangles, mouths)
        over, outside = mesh.mean_overshoot_mm(given), 1e3 * mesh.protrusion(given)
        if over <= MOST_OVERSHOOT_MM and outside <= MOST_OUTSIDE_MM and len(given) <= most:
            return [*given], mesh.report(given) | {"from": "collision shapes of the file"}
        words = f"{len(given)} collision shapes overshoot by {over:.1f} mm and leave {outside:.1f} mm of the mesh outside"
        more = {"not_used": words}
    room = min(most, MOST_HULLS) - len(shapes)

    def made() -> dict[str, NDArray[Any]]:
        target = mesh or Target(triangles, mouths)
        hulls = fit_hulls(
            target,
            lambda h: (
                target.mean_overshoot_mm(h) < MOST_OVERSHOOT_MM
                or time.process_time() - began > MOST_CUT_S
            ),
            room,
        )
        return {
            "corners": np.concatenate([hull.points for hull in hulls]),
            "count": np.array([len(hull.points) for hull in hulls], np.int64),
            "row": np.array(json.dumps(target.report(hulls))),
        }

    key = hashlib.sha256(f"{code_digest(CODE, ('scipy', 'numpy', 'trimesh'))} {room}".encode())
    for array in (triangles, *mouths):
        key.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    kept = cached("robot-links", key.hexdigest(), made, FORM)
    parts = np.split(kept["corners"], np.cumsum(kept["count"])[:-1])
    hulls = [Hull(part) for part in parts]
    row = json.loads(str(kept["row"]))
    return [*hulls, *shapes], row | {"primitives": len(hulls) + len(shapes)} | more
