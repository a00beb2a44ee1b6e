"""The named benchmarks: each made once in a process, when it is first asked for."""

from functools import cache
from importlib import import_module

from r2h_batch.base.registry import PROTOCOL_NAMES
from r2h_batch.base.validate import one_of
from r2h_batch.protocols.benchmark import Benchmark


@cache
def named_benchmark(name: str) -> Benchmark:
    """The benchmark of a name of `registry.PROTOCOLS`."""
    word = one_of(*PROTOCOL_NAMES)("name", name).replace("-", "_")
    found: Benchmark = getattr(import_module(f"r2h_batch.protocols.{word}"), word)()
    return found
