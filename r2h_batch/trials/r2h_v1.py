"""Benchmark r2h-v1: 16 objects, hands on the arms of adults who stand or sit and reach. Frozen."""

from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import load_objects
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.draw.reaching import place_reaching
from r2h_batch.trials.draw.rule import Rule
from r2h_batch.trials.registry import BENCHMARK


@BENCHMARK("r2h-v1")
def r2h_v1() -> Benchmark:
    """16 objects, 400 hands of adults."""
    rule = Rule("r2h-v1", place_reaching, bodies=True)
    return Benchmark(load_objects(), load_hand_set(), rule, "r2h-v1")
