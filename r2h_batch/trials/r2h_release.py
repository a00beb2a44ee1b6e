"""Benchmark r2h-release: objects, hands, palms, table and home of the authors' public release (docs/release.md).
Frozen."""

from r2h_batch.config import Workplace
from r2h_batch.scene.hand import neutral_hand_set
from r2h_batch.scene.objects import load_objects, without_region
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.draw.palms import place_palms
from r2h_batch.trials.draw.rule import Rule
from r2h_batch.trials.registry import BENCHMARK

S0 = (
    *("bottle", "bowl", "can", "cup"),
    *("dispenser", "eyeglasses", "game_controller", "headphones"),
)
S1 = (
    *("binoculars", "power_drill", "hammer", "knife"),
    *("pliers", "scissors", "screwdriver", "toothbrush"),
)
"""The release's own assumption: the paper does not say which objects each split has."""

HOME_Q = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
TABLE_CENTER, TABLE_HALF = (0.35, 0.0, -0.05), (0.65, 0.55, 0.035)
"""Its home and the table of its CPU planner, m: 15 mm below the base, and under the receiver."""


@BENCHMARK("r2h-release")
def r2h_release() -> Benchmark:
    """16 objects, two hands."""
    objects = (*map(without_region, load_objects(S0)), *load_objects(S1))
    place = Workplace(HOME_Q, TABLE_CENTER, TABLE_HALF)
    rule = Rule("r2h-release", place_palms)
    return Benchmark(objects, neutral_hand_set(), rule, "r2h-release", workplace=place)
