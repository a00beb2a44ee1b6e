"""Simulation against people: the kit of the user study. `python -m r2h_batch.study --help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.study.command import main

__all__ = ["main"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "main": "command",
        },
    )
