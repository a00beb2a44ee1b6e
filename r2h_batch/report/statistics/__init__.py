"""Rates, intervals, paired tests, other thresholds."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.report.statistics.aggregate import wilson_interval

__all__ = ["wilson_interval"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(__name__, {"wilson_interval": "aggregate"})
