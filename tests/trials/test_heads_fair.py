"""Nobody's head is in the way when a trial begins: it meets neither the own hand and arm, nor ball, table and robot at home.

All by NumPy but the distance from the robot, which is planning's own (tests/judge/test_person.py has it against MuJoCo C).
Robot and object are farther off by what a benchmark has them keep from the head: the robot at home, the object where it rests.
`pytest -m slow tests/trials/test_heads_fair.py` asks 1,000 trials of r2h-v2 and 200 of each other benchmark, group and robot.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import head_of
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.data.people import WORDS, built_in_people
from r2h_batch.judge.distance import person_distance_at
from r2h_batch.observe.known import known_moments
from r2h_batch.scene import load_robot
from r2h_batch.scene.person import heads_of

KINDS = {
    "r2h-v2": lambda: load_benchmark("r2h-v2"),
    "r2h-v1": lambda: load_benchmark("r2h-v1"),
    "r2h-v3": lambda: load_benchmark("r2h-v3"),
    **{
        f"people {word}": lambda word=word: load_benchmark("r2h-v2").with_people(built_in_people(word))
        for word in WORDS
    },
    **{
        f"robot {name}": lambda name=name: load_benchmark("r2h-v2").on(load_robot(name))
        for name in ("ur3e_2f85", "ur10e_2f85", "panda_hand")
    },
}
ALONG = np.linspace(0, 1, 101)


def to_segment(x, a, b):
    """Distances (n, k) of points (n, k, 3) from segments (n, 3)."""
    along = (b - a)[:, None]
    t = np.clip(((x - a[:, None]) * along).sum(2) / (along * along).sum(2), 0, 1)
    return np.linalg.norm(x - a[:, None] - t[..., None] * along, axis=2)


def rooms(benchmark, trials):
    """What is beside the heads of trials -> how far off the nearest head is, m; below 0: it is met."""
    judge = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    scene = judge.scene
    n, body = len(trials), trials.receiver.double().numpy()
    low, high = (np.stack(x) for x in list(zip(*map(head_of, body), strict=True))[:2])
    radius = np.array([head_of(b)[2] for b in body])
    axis = low[:, None] + ALONG[:, None] * (high - low)[:, None]
    shoulder, elbow, wrist = body[:, 0, :3], body[:, 1, :3], body[:, 2, :3]
    place, limits = judge.config.workplace, judge.config.thresholds
    over = np.maximum(np.abs(axis - np.array(place.table_center)) - np.array(place.table_half), 0)
    T, point, normal = trials.T_world_hand.double().numpy(), *(x.double().numpy() for x in scene.palms)
    k = trials.hand_index.long().numpy()
    local = point[k] + limits.reach_offset_m * normal[k]
    ball = np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3]
    hands = scene.hands.vertices[k].double().numpy()
    hands = np.einsum("nij,nvj->nvi", T[:, :3, :3], hands) + T[:, None, :3, 3]
    found = {
        "hand": to_segment(hands, low, high).min(1) - radius,
        "forearm": to_segment(axis, elbow, wrist).min(1) - radius - body[:, 1, 3],
        "upper arm": to_segment(axis, shoulder, elbow).min(1) - radius - body[:, 0, 3],
        "ball": to_segment(ball[:, None], low, high)[:, 0] - radius - limits.reach_radius_m,
        "table": np.linalg.norm(over, axis=2).min(1) - radius,
    }
    # the head alone: all else of the person is far away
    eye, far = torch.eye(4).repeat(n, 1, 1), trials.receiver.clone()
    far[:, :4, 0] += 50.0
    bodies = scene.body_poses(trials.object_index, trials.hand_index, eye, trials.T_world_hand, torch.zeros(n))
    q = torch.tensor(place.home_q, dtype=torch.float32).repeat(n, 1)
    active = torch.ones(n, dtype=torch.bool)
    found["robot at home"] = person_distance_at(scene, bodies, far, q, active, heads_of(trials.receiver))[0].numpy()
    if "pick" in benchmark.asks:  # the ball about the object where it rests
        at = known_moments(scene).of(trials).double().numpy()
        models = [scene.objects[i] for i in trials.object_index.tolist()]
        middle = np.stack([o.hull_vertices.mean(0) for o in models])
        size = np.array(
            [np.linalg.norm(o.hull_vertices - c, axis=1).max() for o, c in zip(models, middle, strict=True)]
        )
        place = np.einsum("nij,nj->ni", at[:, :3, :3], middle) + at[:, :3, 3]
        found["resting object"] = (
            to_segment(place[:, None], low, high)[:, 0] - radius - size - benchmark.head_clearance_m
        )
    return {name: float(x.min()) for name, x in found.items()}


EVERY_DAY = ("r2h-v2", "r2h-v3", next(k for k in KINDS if k.startswith("people")), "robot ur3e_2f85")
"""One of each way in which receivers come to stand elsewhere."""


@pytest.mark.parametrize(
    "kind", [k if k in EVERY_DAY else pytest.param(k, marks=pytest.mark.whole(part="trials")) for k in KINDS]
)
def test_no_head_is_in_the_way_when_a_trial_begins(kind):
    benchmark = KINDS[kind]()
    found = rooms(benchmark, benchmark.trials(20))
    assert len(found) == 6 + ("pick" in benchmark.asks) and min(found.values()) > 0, found


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_of_a_thousand_trials_no_head_is_in_the_way(kind):
    benchmark = KINDS[kind]()
    found = rooms(benchmark, benchmark.trials(500 if kind == "r2h-v2" else 100))
    print(kind, {name: f"{1e3 * x:.1f} mm" for name, x in found.items()})
    assert min(found.values()) > 0, found


def test_heads_that_stand_elsewhere_are_found_in_the_way():
    benchmark = load_benchmark("r2h-v2")
    trials = benchmark.trials(20)
    at = {
        "hand": trials.T_world_hand[:, :3, 3],
        "robot at home": torch.tensor([[0.0, 0.1, 0.1]]).expand(len(trials), 3),
    }
    for name, place in each(at.items()):
        receiver = trials.receiver.clone()
        receiver[:, 3, :3] = place - (0.25 + receiver[:, 4, 2:3]) * torch.eye(3)[2]  # the torso below, the head there
        found = rooms(benchmark, replace(trials, receiver=receiver))
        assert found[name] < 0 and (name != "hand" or found["forearm"] < 0), found
