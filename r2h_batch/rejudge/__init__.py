"""Stored rows judged again from their stored poses: `r2h-batch results verify RUN --rejudge
200`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.rejudge.again import Difference, Judge, Rejudged, rejudge

__all__ = ["Difference", "Judge", "Rejudged", "rejudge"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(__name__, dict.fromkeys(__all__, "again"))
