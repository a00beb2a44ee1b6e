"""Methods paired on the trials that they share. `python -m r2h_batch.compare --help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.compare.command import main
    from r2h_batch.compare.text import render
    from r2h_batch.statistics.paired import compare

__all__ = ["compare", "main", "render"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "compare": ".statistics.paired",
            "main": "command",
            "render": "text",
        },
    )
