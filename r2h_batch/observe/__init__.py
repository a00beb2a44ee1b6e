"""Depth cameras in the cell: the moment that they see, rigs, images, clouds."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.observe.moment import moments
    from r2h_batch.observe.rig import Rig, load_rig
    from r2h_batch.observe.seeing import look, observe, whole_images
    from r2h_batch.observe.seen import LABELS, Images, Observation

__all__ = [
    "LABELS",
    "Images",
    "Observation",
    "Rig",
    "load_rig",
    "look",
    "moments",
    "observe",
    "whole_images",
]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Images": "seen",
            "LABELS": "seen",
            "Observation": "seen",
            "Rig": "rig",
            "load_rig": "rig",
            "look": "seeing",
            "moments": "moment",
            "observe": "seeing",
            "whole_images": "seeing",
        },
    )
