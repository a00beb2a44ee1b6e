"""Draft of benchmark r2h-v3: objects, people and hands of r2h-v2, and the arm has to pick the object from the table first.

Not frozen: trials, criteria and thresholds may change (docs/pick.md).
"""

from dataclasses import replace

from r2h_batch.protocols.benchmark import Benchmark
from r2h_batch.protocols.draw.reaching import place_reaching
from r2h_batch.protocols.draw.rule import Rule
from r2h_batch.protocols.registry import BENCHMARK, named_benchmark


@BENCHMARK("r2h-v3-draft")
def r2h_v3_draft() -> Benchmark:
    """r2h-v2 with Pick, and trials of its own."""
    rule = Rule("r2h-v3-draft", place_reaching, bodies=True)
    return replace(named_benchmark("r2h-v2"), rule=rule, name="r2h-v3-draft", asks=("pick",))
