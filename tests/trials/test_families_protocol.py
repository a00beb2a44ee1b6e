"""Protocol r2h-v2: 96 instances and people of every size, frozen; what other flags make of it."""

from pathlib import Path

import numpy as np
import pytest
import torch

from r2h_batch import load_benchmark
from r2h_batch.data.people import ALL, GROUPS, built_in_people, people_hand, people_hand_set
from r2h_batch.scene.hand import load_hand
from r2h_batch.scene.objects import INSTANCE_NAMES, load_objects
from r2h_batch.trials.benchmark import Benchmark, trials_digest
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited
from r2h_batch.trials.holding import receiving
from r2h_batch.trials.yaml_file import read_benchmark
from r2h_batch.types import PERSON, Trials

FROZEN = "4bee35bc09e816e0fefa0d6c8214bb08dc8aebf7da1452444650ed641f3f757b"
"""Digest of 200 trials a split: r2h-v2 never changes; docs/benchmark.md names it too."""
DEFINED = "1d35d5bbaaa8283967c355cd701670caf6c231f118f660a78c9a4b69aaa1721f"
"""Digest of the benchmark: objects, hands, people and what they are made of, limits and place. Until persons had a head it was
940101fe..., of the same trials."""


@pytest.fixture(scope="module")
def v2() -> Benchmark:
    return load_benchmark("r2h-v2")


@pytest.fixture(scope="module")
def trials(v2: Benchmark) -> Trials:
    return v2.trials(200)


def test_the_protocol_is_frozen(v2: Benchmark, trials: Trials) -> None:
    assert v2.digest == DEFINED
    assert trials_digest(trials) == FROZEN


def test_every_group_and_both_seats_receive_and_a_trial_is_the_same_by_its_name_alone(
    v2: Benchmark, trials: Trials
) -> None:
    assert v2.people is built_in_people(ALL) and {o.name for o in v2.objects} == set(INSTANCE_NAMES)
    assert trials.person is not None and trials.receiver is not None
    age, seated = (trials.person[:, PERSON.index(name)].numpy() for name in ("age_years", "seated"))
    shares = [np.mean((age >= low) & (age < high)) for low, high in ((6, 13), (18, 66), (70, 91))]
    assert min(shares) > 0.1 and np.isclose(sum(shares), 1) and len(GROUPS) == len(shares)
    assert 0.1 < seated.mean() < 0.9
    rows = torch.tensor([3, 211, 399])
    alone = load_benchmark("r2h-v2").trials_with_ids(trials.trial_id[rows])
    for name in ("object_index", "hand_index", "T_world_hand", "receiver", "person"):
        assert torch.equal(getattr(alone, name), getattr(trials, name)[rows]), name


def test_flags_and_files_narrow_or_exchange_the_receivers(tmp_path: Path, v2: Benchmark) -> None:
    assert edited(BenchmarkChoice(benchmark="r2h-v2")) is v2
    adults = edited(BenchmarkChoice(benchmark="r2h-v2", people="adults"))
    assert adults.people is built_in_people("adults") and adults.hand_set is people_hand_set(adults.people)
    assert adults.objects == v2.objects and adults.digest != v2.digest
    file = tmp_path / "benchmark.yaml"
    file.write_text("format: 1\nprotocol: r2h-v2\n")
    assert read_benchmark(file).digest == v2.digest
    file.write_text("format: 1\nprotocol: r2h-v1\npeople: children\n")
    children = edited(BenchmarkChoice(benchmark=str(file)))
    assert children.people is built_in_people("children") and len(children.objects) == 16


def test_receiving_grasps_of_the_instances_are_shipped_on_the_peoples_hand(
    monkeypatch: pytest.MonkeyPatch, v2: Benchmark
) -> None:
    def asked(*args: object, **kwargs: object) -> None:
        raise AssertionError("sampled")

    monkeypatch.setattr(receiving, "sample_receiving", asked)
    grasps = receiving.load_receiving(v2.objects, v2.hand_set.model)
    assert grasps.hand is people_hand() and receiving.without_receiving(v2.objects, people_hand()) == []
    assert len(grasps) > 0.95 * 96 * 2 * receiving.PER_SIDE
    monkeypatch.setattr(receiving, "cached", asked)
    with pytest.raises(AssertionError, match="sampled"):  # the built-in hand's are sampled at first use
        receiving.load_receiving(load_objects(["cup_05"]), load_hand())
