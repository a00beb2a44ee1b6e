"""A user's object made fit for judging: its mesh closed, its labels carried over, its build
kept."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.scene.mesh_import.closed import Repair, closed_mesh
    from r2h_batch.scene.mesh_import.file import SUFFIXES, check_name, labels_of
    from r2h_batch.scene.mesh_import.pieces import convex_hull, convex_pieces
    from r2h_batch.scene.mesh_import.region import (
        no_region,
        part_of_faces,
        receiver_region,
        region_boxes,
    )

__all__ = [
    "SUFFIXES",
    "Repair",
    "check_name",
    "closed_mesh",
    "convex_hull",
    "convex_pieces",
    "labels_of",
    "no_region",
    "part_of_faces",
    "receiver_region",
    "region_boxes",
]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            **dict.fromkeys(("Repair", "closed_mesh"), "closed"),
            **dict.fromkeys(("SUFFIXES", "check_name", "labels_of"), "file"),
            **dict.fromkeys(("convex_hull", "convex_pieces"), "pieces"),
            **dict.fromkeys(
                ("no_region", "part_of_faces", "receiver_region", "region_boxes"), "region"
            ),
        },
    )
