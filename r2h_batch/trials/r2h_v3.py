"""Benchmark r2h-v3: objects, people and hands of r2h-v2. The arm has to pick the object from the table first, the wanted part
has to come to the hand first, and the person has to be able to take it in the end (docs/r2h_v3.md).
"""

from dataclasses import replace

from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.certified import load_certified
from r2h_batch.trials.draw.reaching import place_reaching
from r2h_batch.trials.draw.rule import Rule
from r2h_batch.trials.registry import BENCHMARK, named_benchmark
from r2h_batch.verdicts import ASKED_NAMES

HEAD_CLEARANCE_M = 0.10
"""What robot and object keep from the head [choice by eyes]: of 40 pictures three raters (vision models) accepted none that
came nearer."""


@BENCHMARK("r2h-v3")
def r2h_v3() -> Benchmark:
    """r2h-v2 with Pick, Presented and Received, and trials of its own."""
    # the published trials and certificates were drawn under the name that it had before it was frozen
    rule = Rule("r2h-v3", place_reaching, bodies=True, key="r2h-v3-draft")
    v2, known = named_benchmark("r2h-v2"), load_certified("r2h-v3", search="oracle")
    return replace(
        v2, rule=rule, name="r2h-v3", head_clearance_m=HEAD_CLEARANCE_M, asks=ASKED_NAMES, certified=known
    )  # fmt: skip
