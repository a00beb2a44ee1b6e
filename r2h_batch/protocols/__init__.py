"""Benchmarks: the value, one file for each named one, those of files and commands, and how trials are drawn (`draw/`)."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.protocols.benchmark import Benchmark
    from r2h_batch.protocols.draw.rule import Batch, Placed, Rule
    from r2h_batch.protocols.load import load_benchmark

__all__ = ["Batch", "Benchmark", "Placed", "Rule", "load_benchmark"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Batch": "draw.rule",
            "Benchmark": "benchmark",
            "Placed": "draw.rule",
            "Rule": "draw.rule",
            "load_benchmark": "load",
        },
    )
