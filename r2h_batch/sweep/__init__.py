"""Joins the two towers: trials, methods, verdicts, stored rows. `python -m r2h_batch.sweep
--help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.sweep.command import main, run
    from r2h_batch.sweep.options import METHODS, Options, UsageError, parse

__all__ = ["METHODS", "Options", "UsageError", "main", "parse", "run"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "METHODS": "options",
            "Options": "options",
            "UsageError": "options",
            "main": "command",
            "parse": "options",
            "run": "command",
        },
    )
