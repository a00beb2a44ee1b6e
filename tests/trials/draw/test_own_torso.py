"""People of r2h-v2 do not overlap themselves: capsules and skin against the own torso, by other code."""

from dataclasses import replace

import fcl
import fcl_twin
import numpy as np
import pytest
from people_twin import capsule

from r2h_batch import load_benchmark
from r2h_batch.data.people import built_in_people
from r2h_batch.scene.robot import ShapeKind
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.draw.own_torso import (
    ROOM_M,
    arm_is_clear,
    crosses_box,
    hand_is_clear,
    in_torso,
    segment_to_box,
)
from r2h_batch.trials.draw.receivers import Person, reach
from r2h_batch.trials.edit import edited

NEAR_M = 1e-6
"""Trials are stored in single precision."""


def benchmark_of(who: str) -> Benchmark:
    return load_benchmark("r2h-v2") if who == "r2h-v2" else edited(BenchmarkChoice(benchmark="r2h-v1", people=who))


SMALLER = [pytest.param(who, marks=pytest.mark.whole(part="trials")) for who in ("children", "wheelchair")]


@pytest.mark.parametrize("who", ["r2h-v2", *SMALLER])
def test_forearm_and_hand_keep_off_the_own_torso_as_fcl_sees_them(who: str) -> None:
    benchmark = benchmark_of(who)
    trials = benchmark.trials(60)
    assert trials.receiver is not None
    least = {"forearm": np.inf, "hand": np.inf}
    T_world_hand = trials.T_world_hand.double().numpy()
    skin = benchmark.hand_set.geometry.vertices.double().numpy()
    for k, body in enumerate(trials.receiver.double().numpy()):
        T = np.eye(4)
        ahead = np.array([body[3, 3], body[4, 3], 0.0])
        T[:3, :3] = np.stack([ahead, [-ahead[1], ahead[0], 0.0], [0.0, 0.0, 1.0]], 1)
        T[:3, 3] = body[3, :3]
        torso = fcl_twin.primitive(ShapeKind.BOX, body[4, :3], T)
        elbow, wrist = body[1, :3], body[2, :3]
        size = np.array([body[1, 3], np.linalg.norm(wrist - elbow) / 2, 0.0])
        arm = fcl_twin.primitive(ShapeKind.CAPSULE, size, capsule(elbow, wrist))
        least["forearm"] = min(least["forearm"], fcl_twin.distance(arm, torso))
        T_hand = T_world_hand[k]
        hull = fcl_twin.hull(skin[int(trials.hand_index[k])] @ T_hand[:3, :3].T + T_hand[:3, 3])
        if not fcl.collide(hull, torso, fcl.CollisionRequest(), fcl.CollisionResult()):
            continue
        own = (skin[int(trials.hand_index[k])] @ T_hand[:3, :3].T + T_hand[:3, 3] - T[:3, 3]) @ T[:3, :3]
        least["hand"] = min(least["hand"], (np.abs(own) - body[4, :3]).max(1).min())
    assert least["forearm"] > -NEAR_M, least
    assert least["hand"] > ROOM_M - NEAR_M, least


def some(n: int, seed: int = 3) -> Person:
    people = built_in_people("all")
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, len(people), n)
    size = {name: values[rows] for name, values in people.lengths.items()}
    return reach(rng.random(n) < 0.25, size, rng.random((12, n)), rng.integers(0, 2, n), 0.45)


def sampled(people: Person, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, 2001) signed distances of points along segments to the torsos."""
    s = np.linspace(0, 1, 2001)[:, None]
    rows = []
    for k in range(len(a)):
        one = people.rows(np.full(len(s), k))
        q = np.abs(in_torso(one, a[k] + s * (b[k] - a[k]))) - people.torso_half[k]
        rows.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0))
    return np.array(rows)


def test_the_rule_is_what_points_along_the_arm_say() -> None:
    people = some(400)
    fore, upper = sampled(people, people.elbow, people.wrist), sampled(people, people.shoulder, people.elbow)
    radius = people.radius
    off_fore = fore.min(1) - radius[:, 1]
    off_upper = upper.min(1) - np.minimum(radius[:, 0], upper[:, 0])
    clear, sure = arm_is_clear(people), np.abs(off_fore) > 1e-4
    assert (off_fore < 0).sum() > 50 and (off_upper < -1e-4).sum() > 20 and clear.sum() > 50
    assert not clear[sure & (off_fore < 0)].any()
    assert not clear[off_upper < -1e-4].any()
    assert clear[(off_fore > 1e-4) & (off_upper > -1e-9)].all()


def test_distances_of_segments_are_those_of_their_nearest_points() -> None:
    rng = np.random.default_rng(4)
    a, b, half = rng.normal(size=(300, 3)), rng.normal(size=(300, 3)), rng.uniform(0.1, 1.0, (300, 3))
    b[:40, 0], b[20:60, 1], b[50:90, 2] = a[:40, 0], a[20:60, 1], a[50:90, 2]
    b[30:35] = a[30:35]
    s = np.linspace(0, 1, 4001)[None, :, None]
    points = a[:, None] + s * (b - a)[:, None]
    over = np.abs(points) - half[:, None]
    dense = np.linalg.norm(np.maximum(over, 0), axis=2).min(1)
    own = np.sqrt(segment_to_box(a, b, half))
    assert (own <= dense + 1e-12).all() and (dense - own).max() < 2e-3
    inside = over.max(2).min(1)
    found = crosses_box(a, b, half)
    assert found[inside < -2e-3].all() and not found[inside > 2e-3].any()
    assert 50 < found.sum() < 250


def test_a_hand_in_the_own_chest_is_refused_and_one_before_it_is_not() -> None:
    people = some(50)
    T = np.tile(np.eye(4, dtype=np.float32), (50, 1, 1))
    skin = np.random.default_rng(5).uniform(-0.05, 0.05, (3, 1, 500))
    hand, around = np.zeros(50, np.int64), (np.zeros((50, 3)), np.full(50, 0.09))
    ahead = np.concatenate([people.facing, np.zeros((50, 1))], 1)
    for away, clear in ((0.0, False), (0.03, False), (0.10, True)):
        T[:, :3, 3] = people.torso + (people.torso_half[:, :1] + away) * ahead
        assert (hand_is_clear(people, T, skin, *around, hand) == clear).all(), away


def test_receivers_without_people_are_as_before() -> None:
    """The rule of r2h-v1 is frozen: points of the axis, so some of its forearms do overlap their torso."""
    trials = load_benchmark("r2h-v1").trials(200)
    assert trials.receiver is not None
    body = trials.receiver.double().numpy()
    people = replace(
        some(len(body)), shoulder=body[:, 0, :3], elbow=body[:, 1, :3], wrist=body[:, 2, :3], torso=body[:, 3, :3],
        facing=body[:, 3:5, 3], torso_half=body[:, 4, :3], radius=body[:, :2, 3],
    )  # fmt: skip
    assert not arm_is_clear(people).all()
