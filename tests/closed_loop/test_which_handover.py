"""Which handover an episode plays: by seed, row and number of the episode, and by nothing else."""

from functools import cache

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from rounds import each

from r2h_batch.closed_loop.env import LoopConfig
from r2h_batch.closed_loop.registered import ID, register

register()
MORE = {"method": "random", "trials": 4, "benchmark": "r2h-v1", "config": LoopConfig(horizon_s=2, rate_hz=10)}
LONG = {"trials": 96, "benchmark": "r2h-v2"}
"""More of it, for a thousand episodes."""


@cache
def vector(num_envs, **more):
    """A vector that others have played: each begins with a seed of its own, and nothing may be left of what was before."""
    return gymnasium.make_vec(ID, num_envs=num_envs, vectorization_mode="vector_entry_point", **MORE | more)


def ids(infos):
    return np.asarray(infos["trial_id"]).reshape(-1).tolist()


def stands(envs, step, seen):
    return np.zeros(envs.action_space.shape, np.float32)


def waves(envs, step, seen):
    """Up and down by clock and posture alone."""
    return envs.single_action_space.high * np.sin(4 * seen["time"][:, None] + seen["q"])


def rushes(envs, step, seen):
    """Odd rows go as fast as they can, there and back."""
    action = stands(envs, step, seen)
    action[1::2] = envs.single_action_space.high * (1 if step % 14 < 7 else -1)
    return action


def episodes(envs, policy, count, **reset):
    """Trials of the rows' episodes, and how each ended: two lists for each row."""
    seen, infos = envs.reset(**reset)
    n, most = envs.num_envs, 25 * count
    played, ends, begun = [[i] for i in ids(infos)], [[] for _ in range(n)], np.zeros(n, bool)
    for step in range(most):
        seen, _, ended, late, infos = envs.step(policy(envs, step, seen))
        trials, over = ids(infos), ended | late
        for row in np.flatnonzero(begun):
            played[row].append(trials[row])
        for row in np.flatnonzero(over):
            outcome = infos["end"][row], infos["why"][row], float(infos["least_m"][row])
            ends[row].append((*outcome, seen["T_world_hand"][row].tobytes()))
        begun = over
        if min(map(len, ends)) >= count:
            return [p[:count] for p in played], [e[:count] for e in ends]
    raise AssertionError(f"not {count} episodes in {most} steps")


def by_round(played, ends, n, turn):
    """Ends by row, trial and round: `turn` of row and episode is the place in the row's order, which goes round `n` trials."""
    return {
        (row, trial, turn(row, k) // n): end
        for row, (trials, own) in enumerate(zip(played, ends, strict=True))
        for k, (trial, end) in enumerate(zip(trials, own, strict=True))
    }


@pytest.fixture(scope="module")
def pool():
    return vector(1).unwrapped.pool.trial_id.tolist()


@pytest.mark.parametrize(
    "seed", [*(pytest.param(s, marks=pytest.mark.whole(part="closed_loop")) for s in (0, 5)), 2**62 + 3]
)
def test_the_handover_is_the_seeds_place_and_the_row_and_all_rows_before(pool, seed):
    n = len(pool)
    assert n > 4
    for slots in (1, 3):
        found, _ = episodes(vector(slots), stands, 5, seed=seed)
        assert found == [[pool[(seed + i + k * slots) % n] for k in range(5)] for i in range(slots)]


def test_seeds_of_rows_are_their_own_places(pool):
    seeds = [7, 0, 4]
    found, _ = episodes(vector(3), stands, 4, seed=seeds)
    assert found == [[pool[(s + i + 3 * k) % len(pool)] for k in range(4)] for i, s in enumerate(seeds)]


@pytest.mark.parametrize("motion", ["moves", pytest.param("takes", marks=pytest.mark.whole(part="closed_loop"))])
def test_neither_trial_nor_end_of_a_row_depends_on_what_others_do(motion):
    quiet, ends = episodes(vector(4, motion=motion), stands, 4, seed=1)
    busy, other = episodes(vector(4, motion=motion), rushes, 4, seed=1)
    assert quiet == busy and ends[0] == other[0] and ends[2] == other[2]
    assert ends[1] != other[1]  # or nothing was tested


def test_a_trial_ends_the_same_in_any_row_and_number_of_rows(pool):
    """The m-th time that a trial comes up under a seed."""
    outcomes = []
    for slots in (2, 5):
        played, ends = episodes(vector(slots), stands, -(-2 * len(pool) // slots), seed=3)
        times, found = {}, {}
        for k in range(len(played[0])):
            for row in range(slots):
                trial = played[row][k]
                times[trial] = times.get(trial, 0) + 1
                found[trial, times[trial]] = ends[row][k]
        outcomes.append(found)
    shared = set.intersection(*map(set, outcomes))
    assert {m for _, m in shared} >= {1, 2}
    for key in shared:
        assert outcomes[0][key] == outcomes[1][key]
    assert any(outcomes[0][t, 1] != outcomes[0][t, 2] for t, m in shared if m == 2)  # drawn anew


@pytest.mark.parametrize(
    ("mode", "slots", "count", "more"),
    [
        *(pytest.param(mode, 3, 7, {}, marks=pytest.mark.whole(part="closed_loop")) for mode in ("sync", "async")),
        *(pytest.param(mode, 8, 125, LONG, marks=pytest.mark.slow) for mode in ("sync", "async")),
    ],
)
def test_a_trial_ends_the_same_in_gymnasiums_own_vectors(mode, slots, count, more):
    """A row of our vector plays every `slots`-th place of the order that the copy with its seed plays in full."""
    ours, seeds = vector(slots, **more), list(range(4, 4 + slots))
    n = len(ours.unwrapped.pool)
    ours = by_round(*episodes(ours, waves, count, seed=seeds), n, lambda row, k: row + k * slots)
    envs = gymnasium.make_vec(ID, num_envs=slots, vectorization_mode=mode, **MORE | more)
    copies = by_round(*episodes(envs, waves, count, seed=seeds), n, lambda row, k: k)
    envs.close()
    shared = copies.keys() & ours.keys()
    assert len(shared) >= count and len({trial for _, trial, _ in shared}) >= slots
    for key in each(shared):
        assert copies[key] == ours[key], key


@pytest.mark.slow
def test_of_a_thousand_episodes_policies_play_the_same_and_a_trial_ends_the_same_in_any_number_of_slots():
    found = []
    for slots in each((1, 8, 64)):
        envs, count = vector.__wrapped__(slots, **LONG), -(-1000 // slots)
        n = len(envs.unwrapped.pool)
        quiet, _ = episodes(envs, stands, count, seed=3)
        played, ends = episodes(envs, waves, count, seed=3)
        assert quiet == played, slots
        of = {}
        for row in range(slots):
            for k in range(count):
                of[played[row][k], (row + k * slots) // n] = ends[row][k]
        assert len(of) == slots * count >= 1000
        found.append(of)
    shared = found[0].keys() & found[1].keys() & found[2].keys()
    assert len(shared) == 1000
    for key in each(shared):
        assert found[0][key] == found[1][key] == found[2][key], key


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_copies_in_gymnasiums_own_vectors_play_different_handovers(pool, mode):
    envs = gymnasium.make_vec(ID, num_envs=3, vectorization_mode=mode, **MORE)
    begun = ids(envs.reset(seed=4)[1])
    envs.close()
    assert begun == [pool[(4 + i) % len(pool)] for i in range(3)]


def test_seeds_in_turn_play_the_whole_pool_and_again_the_same(pool):
    env = gymnasium.make(ID, **MORE)
    begun = [ids(env.reset(seed=s)[1])[0] for s in range(len(pool))]
    assert sorted(begun) == sorted(pool)
    assert begun == [ids(env.reset(seed=s)[1])[0] for s in range(len(pool))]
    then = [ids(env.reset()[1])[0] for _ in range(2)]
    assert then == [pool[(len(pool) - 1 + k) % len(pool)] for k in (1, 2)]


def test_a_trial_that_is_asked_for_is_played_and_the_next_comes_as_it_would_have(pool):
    env = gymnasium.make(ID, **MORE)
    seen, info = env.reset(seed=2, options={"trial_id": pool[0]})
    assert ids(info) == [pool[0]] and ids(env.reset()[1]) == [pool[3 % len(pool)]]
    again, info = env.reset(options={"trial_id": pool[0]})
    assert ids(info) == [pool[0]] and all(np.array_equal(seen[k], again[k]) for k in seen)
    for _ in range(len(pool)):
        env.reset()
    again, info = env.reset(options={"trial_id": pool[0]})  # also after a whole round
    assert ids(info) == [pool[0]] and all(np.array_equal(seen[k], again[k]) for k in seen)
    envs = vector(3)
    envs.reset(seed=0)
    mask = np.array([False, True, False])
    for asked in (pool[4], [pool[0], pool[4], -1]):
        found = envs.reset(options={"reset_mask": mask, "trial_id": asked})[1]
        assert ids(found) == [pool[0], pool[4], pool[2]]
    for wrong, words in (
        (10**6, "trial_id is 1000000; this environment has the"),
        ([pool[0]] * 2, "trial_id has 2 entries; it must be one number, or 3"),
        (-1, "trial_id is -1"),
    ):
        with pytest.raises(ValueError, match=words):
            envs.reset(options={"trial_id": wrong})
    with pytest.raises(TypeError, match="trial_id is 'cup'"):
        envs.reset(options={"trial_id": "cup"})


def test_a_row_that_goes_on_keeps_its_fingers_when_another_begins():
    envs = vector(3, motion="takes").unwrapped
    envs.reset(seed=0)
    bent = envs._distance.own.vertices[:1] + 0.01
    envs._distance.own.put(torch.tensor([0]), bent)
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert torch.equal(envs._distance.own.vertices[:1], bent)


def test_checkers_say_nothing_and_the_end_says_is_success(recwarn):
    env = gymnasium.make(ID, **MORE)
    check_env(env.unwrapped, skip_render_check=True)
    assert [str(w.message) for w in recwarn if "Casting" in str(w.message)] == []
    env.reset(seed=0)
    over = False
    while not over:
        *_, ended, late, info = env.step(np.zeros(6, np.float32))
        over = ended or late
        assert info["is_success"] == (info["success"] and over)
