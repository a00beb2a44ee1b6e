"""Used by every room: files, launches, checks, command lines, frames."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.base import rng, se3, soft, twist
    from r2h_batch.base.loggers import LOGGERS, Logger

__all__ = ["LOGGERS", "Logger", "rng", "se3", "soft", "twist"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "LOGGERS": "loggers",
            "Logger": "loggers",
            "rng": "rng",
            "se3": "se3",
            "soft": "soft",
            "twist": "twist",
        },
    )
