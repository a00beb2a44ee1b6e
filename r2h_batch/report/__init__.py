"""Tables, charts, pages, statistics and comparisons of run folders."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.report.compare.stored import load_baselines

__all__ = ["load_baselines"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(__name__, {"load_baselines": "compare.stored"})
