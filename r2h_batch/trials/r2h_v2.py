"""Benchmark r2h-v2: six instances of each of 16 families of objects, and people from 6 to 90
years, whose arm, torso and head count. Frozen."""

from r2h_batch.data.people import ALL, built_in_people, people_hand_set
from r2h_batch.scene.objects import INSTANCE_NAMES, load_objects
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.draw.reaching import place_reaching
from r2h_batch.trials.draw.rule import Rule
from r2h_batch.trials.registry import BENCHMARK


@BENCHMARK("r2h-v2")
def r2h_v2() -> Benchmark:
    """96 objects, 2,000 people with 400 hands of theirs, whose arms, torsos and heads count."""
    # objects take turns in their order: categories first, then instances
    in_turn = sorted(INSTANCE_NAMES, key=lambda name: name.rpartition("_")[2])
    people = built_in_people(ALL)
    rule = Rule("r2h-v2", place_reaching, bodies=True)
    objects, hands = load_objects(in_turn), people_hand_set(people)
    return Benchmark(objects, hands, rule, "r2h-v2", people, receiver="body")
