"""The named benchmarks: ours, one file each, and those of other packages (`r2h_batch.plugins`).

@BENCHMARK("r2h-v9")          # in a file of its own, r2h_v9, with an entry in `BENCHMARKS` of base/registry.py
def r2h_v9() -> Benchmark: ...

[project.entry-points."r2h_batch.plugins"]
"benchmark.mine" = "their_package.task:mine"
"""

from collections.abc import Callable
from functools import cache

from r2h_batch.base.errors import UserError
from r2h_batch.base.gone import gone
from r2h_batch.base.registry import BENCHMARK_NAMES
from r2h_batch.base.user_code import raised
from r2h_batch.plugins import PackageError, PluginError, Registry
from r2h_batch.strangers import stranger
from r2h_batch.trials.benchmark import Benchmark

BENCHMARK: Registry[Callable[[], Benchmark]] = Registry(
    "benchmark",
    modules=[f"r2h_batch.trials.{name.replace('-', '_')}" for name in BENCHMARK_NAMES],
    names=BENCHMARK_NAMES,
    wrong=lambda name, thing: (
        ""
        if callable(thing)
        else f"is {thing!r:.100}; it must be a function that returns a Benchmark"
    ),
)
"""Name -> the function without arguments that makes it."""


@cache
def named_benchmark(name: str) -> Benchmark:
    """The benchmark of a name, made once in a process.

    Raises:
        PluginError: there is none of this name, or another package's is none.
    """
    if told := gone(f"benchmark {name}"):
        raise PluginError(told)
    make = BENCHMARK[name]
    if name in BENCHMARK_NAMES:
        return make()
    whose = BENCHMARK.entry(name)
    try:
        with stranger(whose, make.__module__):
            found: object = make()
    except (KeyboardInterrupt, UserError):  # Ctrl-C; a file that the function reads
        raise
    except BaseException as error:  # SystemExit too: it would end the command without a word
        raise PackageError(f"{whose}: {raised(error)}; it must return a Benchmark") from error
    if not isinstance(found, Benchmark):
        raise PackageError(f"{whose} returned {found!r:.100}; it must return a Benchmark")
    return found
