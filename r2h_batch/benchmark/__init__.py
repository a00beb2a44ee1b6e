"""A benchmark as one file: objects, hands, grasps, thresholds, table and home. `r2h-batch benchmark
--help`."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.benchmark.benchmark import Benchmark, built_in
    from r2h_batch.benchmark.build import read_benchmark

__all__ = ["Benchmark", "built_in", "read_benchmark"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Benchmark": "benchmark",
            "built_in": "benchmark",
            "read_benchmark": "build",
        },
    )
