"""A benchmark's seed: other trials of the same rule."""

import pytest
from refusals import one_line

from r2h_batch import load_benchmark
from r2h_batch.trials.benchmark import trials_digest

SEED = "0123456789abcdef" * 2


@pytest.mark.check
def test_a_seed_draws_other_trials_of_the_same_rule_and_none_draws_the_published_ones():
    base = load_benchmark("r2h-v2")
    other, third = base.with_seed(SEED), base.with_seed(SEED[::-1])
    drawn = [b.trials(6) for b in (base, other, third)]
    assert len({trials_digest(t) for t in drawn}) == len({b.digest for b in (base, other, third)}) == 3
    assert all(t.object_index.equal(drawn[0].object_index) for t in drawn)
    moved = [(t.T_world_hand[:, :3, 3] - drawn[0].T_world_hand[:, :3, 3]).norm(dim=1) for t in drawn[1:]]
    assert all((m > 1e-3).all() for m in moved) and not moved[0].equal(moved[1])
    assert other.with_seed("").digest == base.digest
    assert trials_digest(other.with_seed("").trials(6)) == trials_digest(drawn[0])
    alone = other.trials_with_ids(drawn[1].trial_id[[7]])
    assert alone.T_world_hand[0].equal(drawn[1].T_world_hand[7])


def test_what_is_no_seed_is_refused():
    base = load_benchmark("r2h-v1")
    for seed in ("7", SEED.upper(), SEED + "0", "g" * 32):
        with pytest.raises(ValueError, match="it must be 32 hexadecimal digits, or empty"):
            base.with_seed(seed)


def test_a_benchmark_file_keeps_what_it_says_and_gets_a_seed(tmp_path):
    own = tmp_path / "mine.yaml"
    own.write_text("protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: hammer}\n")
    seeded = tmp_path / "seeded.yaml"
    seeded.write_text(f'{own.read_text()}seed: "{SEED}"\n')
    found = load_benchmark(seeded)
    assert [o.name for o in found.objects] == ["cup", "hammer"] and found.seed == SEED
    assert found.with_seed("").digest == load_benchmark(own).digest != found.digest
    seeded.write_text(f'{own.read_text()}seed: "{SEED[1:]}"\n')
    with one_line("seed"):
        load_benchmark(seeded)
