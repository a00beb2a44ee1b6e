"""Benchmark r2h-v0: 16 objects, hands alone, with any roll about the palm's normal. Frozen."""

from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import load_objects
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.draw.hands_alone import place_hands_alone
from r2h_batch.trials.draw.rule import Rule
from r2h_batch.trials.registry import BENCHMARK


@BENCHMARK("r2h-v0")
def r2h_v0() -> Benchmark:
    """16 objects, 400 hands that float."""
    return Benchmark(load_objects(), load_hand_set(), Rule("r2h-v0", place_hands_alone), "r2h-v0")
