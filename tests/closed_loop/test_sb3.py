"""The environment as Stable-Baselines3 takes it."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, RescaleAction
from gymnasium.wrappers import vector as wrappers
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor

from r2h_batch.closed_loop.env import LoopConfig
from r2h_batch.closed_loop.for_sb3 import Sb3VecEnv
from r2h_batch.closed_loop.registered import ID, register

register()
MORE = {"method": "random", "trials": 6, "benchmark": "r2h-v1", "config": LoopConfig(horizon_s=2, rate_hz=10)}


def vector(**more):
    return gymnasium.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", **MORE, **more)


def test_its_checker_says_nothing():
    flat = FlattenObservation(gymnasium.make(ID, **MORE))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(RescaleAction(flat, np.float32(-1), np.float32(1)))
    assert [str(w.message) for w in said] == []


@pytest.mark.parametrize("flat", [True, False])
def test_rows_end_and_begin_in_one_step_with_what_the_environment_says(flat):
    """Beside the environment itself, whose rows are begun by hand."""
    wrapped = wrappers.FlattenObservation if flat else (lambda envs: envs)
    envs, alone = VecMonitor(Sb3VecEnv(wrapped(vector(autoreset=False)))), wrapped(vector(autoreset=False))

    def equal(a, b):
        return np.array_equal(a, b) if flat else all(np.array_equal(a[k], b[k]) for k in b)

    envs.seed(5)
    assert equal(envs.reset(), alone.reset(seed=5)[0])
    ends = np.zeros(3, int)
    for step in range(45):
        action = np.zeros((3, 6), np.float32)
        action[1] = 2.0 * (step % 9 < 5)
        seen, reward, over, infos = envs.step(action)
        last, own_reward, ended, late, own = alone.step(action)
        assert np.array_equal(reward, own_reward) and np.array_equal(over, ended | late)
        for row, info in enumerate(infos):
            assert (info["trial_id"], info["is_success"]) == (own["trial_id"][row], own["is_success"][row])
            assert ("terminal_observation" in info) == over[row]
            if over[row]:
                kept = info["terminal_observation"]
                assert equal(kept, last[row] if flat else {k: x[row] for k, x in last.items()})
                assert info["TimeLimit.truncated"] == (late[row] and not ended[row]) and info["episode"]["l"] > 0
        if over.any():
            last = alone.reset(options={"reset_mask": over})[0]
        assert equal(seen, last)
        ends += over
    assert ends.min() >= 2
    assert envs.get_attr("num_envs", [0, 2]) == [3, 3] and envs.env_is_wrapped(VecMonitor) == [False] * 3


def test_an_environment_that_begins_by_itself_is_refused():
    with pytest.raises(ValueError, match="autoreset=False"):
        Sb3VecEnv(vector())
