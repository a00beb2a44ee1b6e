"""Columns, rows, shards, provenance: what is stored."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run, load_run

__all__ = ["Run", "load_run"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(__name__, {"Run": "store", "load_run": "store"})
