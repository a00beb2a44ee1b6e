"""Receivers with bodies (r2h-v1): the draw is frozen, whose digest holds what is published, and is the same in any run."""

import pytest
import torch

from r2h_batch import load_benchmark
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.types import Trials

N = 1500
FROZEN = "67a519ecb7e700f6284e0ee9b02eabdb2e2f2fd4f3c28ec20ef40f8601e95fa4"
"""Digest of 500 trials a split: r2h-v1 never changes; docs/benchmark.md names it too."""


@pytest.fixture(scope="module")
def people() -> Trials:
    return load_benchmark("r2h-v1").trials(N)


@pytest.mark.check
def test_the_protocol_is_frozen_and_r2h_v0_is_untouched():
    assert trials_digest(load_benchmark("r2h-v1").trials(500)) == FROZEN
    v0 = "ae15c731e024708c9c09de56fd9102a25c0816eae951a93d4b5944d619ddda1f"
    assert trials_digest(load_benchmark("r2h-v0").trials(500)) == v0
    assert (
        load_benchmark("r2h-v0").trials(1).receiver is None and load_benchmark("r2h-v1").trials(1).receiver is not None
    )
    with pytest.raises(ValueError, match=r"r2h-v9.*allowed are r2h-v0, r2h-v1"):
        load_benchmark("r2h-v9").trials(1)


def test_a_person_is_the_same_alone_in_another_order_and_in_a_longer_run(people):
    assert people.receiver is not None
    rows = torch.tensor([4, 1777, 12, 2999])
    again = load_benchmark("r2h-v1").trials_with_ids(people.trial_id[rows])
    assert again.receiver is not None and torch.equal(again.receiver, people.receiver[rows])
    assert torch.equal(again.T_world_hand, people.T_world_hand[rows]) and torch.equal(
        again.hand_index, people.hand_index[rows]
    )
