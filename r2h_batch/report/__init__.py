"""Tables, charts, pages of a run folder. `python -m r2h_batch.report --help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.report.table import render, table_of

__all__ = ["render", "table_of"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "render": "table",
            "table_of": "table",
        },
    )
