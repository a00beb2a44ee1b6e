"""The named benchmarks: ours, one file each, and those of other packages (`r2h_batch.plugins`).

@BENCHMARK("r2h-v9")          # in a file of its own, r2h_v9, with an entry in `BENCHMARKS` of base/registry.py
def r2h_v9() -> Benchmark: ...

[project.entry-points."r2h_batch.plugins"]
"benchmark.mine" = "their_package.task:mine"
"""

from collections.abc import Callable
from functools import cache

from r2h_batch.base.registry import BENCHMARK_NAMES
from r2h_batch.plugins import Registry
from r2h_batch.trials.benchmark import Benchmark

BENCHMARK: Registry[Callable[[], Benchmark]] = Registry(
    "benchmark",
    modules=[f"r2h_batch.trials.{name.replace('-', '_')}" for name in BENCHMARK_NAMES],
    names=BENCHMARK_NAMES,
)
"""Name -> the function without arguments that makes it."""


@cache
def named_benchmark(name: str) -> Benchmark:
    """The benchmark of a name, made once in a process.

    Raises:
        PluginError: there is none of this name.
    """
    return BENCHMARK[name]()
