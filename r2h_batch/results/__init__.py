"""Stored rows checked, judged again and counted again."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.results.reevaluation import Difference, Judge, Reevaluation, reevaluate
    from r2h_batch.runs.store import Run, load_run

__all__ = ["Difference", "Judge", "Reevaluation", "Run", "load_run", "reevaluate"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Difference": "reevaluation",
            "Judge": "reevaluation",
            "Reevaluation": "reevaluation",
            "Run": ".runs.store",
            "load_run": ".runs.store",
            "reevaluate": "reevaluation",
        },
    )
