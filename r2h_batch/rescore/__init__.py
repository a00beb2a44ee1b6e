"""Other thresholds without simulating again. `python -m r2h_batch.rescore --help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.rescore.command import main, run, values

__all__ = ["main", "run", "values"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "main": "command",
            "run": "command",
            "values": "command",
        },
    )
