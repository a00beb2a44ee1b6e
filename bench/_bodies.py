"""How people of r2h-v2 stand: what of arm and hand is in the own torso, who is how tall, what arms measure.

`python bench/people.py --bodies` prints it (15 CPU seconds). Other code than the rule that accepts trials: float64,
points along the axes every few millimetres, and each vertex of the skin.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch import load_benchmark
from r2h_batch.data.people import GROUPS, built_in_people
from r2h_batch.protocols.benchmark import Benchmark
from r2h_batch.types import PERSON, Trials

F64 = NDArray[np.float64]
ALONG = np.linspace(0.0, 1.0, 201)[None, :, None]


def to_box(receiver: F64, points: F64) -> F64:
    """(n, m) signed distances, m, of points (n, m, 3) to the torsos of receivers (n, 5, 4); negative inside."""
    d = points - receiver[:, None, 3, :3]
    ahead, left = receiver[:, 3, 3, None], receiver[:, 4, 3, None]
    own = np.stack([d[..., 0] * ahead + d[..., 1] * left, d[..., 1] * ahead - d[..., 0] * left, d[..., 2]], -1)
    q = np.abs(own) - receiver[:, None, 4, :3]
    return np.asarray(np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(-1), 0.0))


def overlaps(benchmark: Benchmark, trials: Trials) -> dict[str, F64]:
    """How deep (n,), m, forearm and skin of the hand are in the own torso, and by how much the upper arm's axis is nearer
    to it than its shoulder; negative: away from it."""
    assert trials.receiver is not None
    body = trials.receiver.double().numpy()

    def axis(a: int, b: int) -> F64:
        return to_box(body, body[:, a : a + 1, :3] + ALONG * (body[:, b : b + 1, :3] - body[:, a : a + 1, :3]))

    upper, radius = axis(0, 1), body[:, 0, 3]
    T = trials.T_world_hand.double().numpy()
    skin = benchmark.hand_set.geometry.vertices.double().numpy()[trials.hand_index.numpy()]
    skin = np.einsum("nij,nvj->nvi", T[:, :3, :3], skin) + T[:, None, :3, 3]
    return {
        "forearm": body[:, 1, 3] - axis(1, 2).min(1),
        "hand": -to_box(body, skin).min(1),
        "upper arm beyond its shoulder": np.minimum(radius, upper[:, 0]) - upper.min(1),
    }


def lines(trials: int = 1000) -> Iterator[str]:
    """The figures of docs/people.md, a line each."""
    benchmark = load_benchmark("r2h-v2")
    drawn = benchmark.trials(trials)
    for part, deep in overlaps(benchmark, drawn).items():
        bad = deep > 1e-6
        yield f"{part}: {bad.sum()} of {len(deep)} in the own torso, to {1000 * max(0.0, deep.max()):.1f} mm"
    assert drawn.person is not None
    again = drawn.person[:, PERSON.index("redrawn")].numpy()
    yield f"trials that drew another person: {(again > 0).sum()} of {len(again)}"
    for group in GROUPS:
        yield from _sizes(group)


def _sizes(group: str) -> Iterator[str]:
    """Medians of a group in mm."""
    people: Any = built_in_people(group)
    arm = ("stature", "biacromial_breadth", "acromion_radiale", "radiale_stylion")
    for sex, word in enumerate(("male", "female")):
        own = people.sex == sex
        shown = ", ".join(f"{name} {1000 * np.median(people.lengths[name][own]):.0f}" for name in arm)
        yield f"{group}, {word}: {shown}"
    if group == "elderly":
        for sex, word in enumerate(("male", "female")):
            old = (people.sex == sex) & (people.age >= 80)
            yield f"80 and older, {word}: stature {1000 * np.mean(people.lengths['stature'][old]):.0f} on average"
