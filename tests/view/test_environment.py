"""The environment under its name in Gymnasium, as a stranger makes it."""

import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils.env_checker import check_env
from needs import needs

from r2h_batch.base.errors import UsageError
from r2h_batch.closed_loop.env import End, HandoverEnv, LoopConfig
from r2h_batch.closed_loop.episodes import play
from r2h_batch.closed_loop.policies import POLICIES
from r2h_batch.closed_loop.registered import FROM_TABLE, ID, register
from r2h_batch.view import environment

SMALL = {"method": "random", "trials": 3, "config": LoopConfig(horizon_s=1)}


def test_a_vector_of_them_is_made_by_name_and_plays():
    register()
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="vector_entry_point", **SMALL)
    seen, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(seen) and envs.num_envs == 2
    ended = 0
    for _ in range(45):
        seen, reward, over, late, info = envs.step(np.zeros((2, 6), np.float32))
        assert envs.observation_space.contains(seen) and isinstance(reward, np.ndarray)
        ended += int((over | late).sum())
    assert ended >= 2 and info["margins"]["stability"].shape == (2,)
    with pytest.raises(ValueError, match=r"random holds the object in . of 2 trials, and num_envs is 40"):
        gymnasium.make_vec(ID, num_envs=40, vectorization_mode="vector_entry_point", method="random", trials=1)
    for wrong, error, words in (
        ({"sweep": ("--help",)}, TypeError, r"make_vec\(\) has no argument 'sweep'.*; it has num_envs, method"),
        ({"actoin": "twist"}, TypeError, "has no argument 'actoin', did you mean action"),
        ({"config": {"rate_hz": 10}}, TypeError, "config is .*; it must be a LoopConfig"),
        ({"seed": -1}, ValueError, "seed is -1"),
        ({"splits": 5}, TypeError, "splits is 5"),
        ({"preset": "fast"}, ValueError, "preset is 'fast'; allowed are default, paper, release"),
    ):
        with pytest.raises(error, match=words):
            gymnasium.make_vec(ID, num_envs=1, vectorization_mode="vector_entry_point", **wrong)
    with pytest.raises(UsageError, match="unknown method 'no-such'; allowed are random, oracle, "):
        gymnasium.make_vec(ID, num_envs=1, vectorization_mode="vector_entry_point", method="no-such")


@pytest.mark.parametrize(
    ("name", "wrong", "error", "words"),
    [
        (ID, {"motion": "flies"}, ValueError, "receiver motion is 'flies'"),
        (ID, {"action": "jump"}, ValueError, "action is 'jump'; allowed are velocity, twist, pose, posture"),
        (ID, {"output": "jax"}, ValueError, "output is 'jax'; allowed are numpy, torch"),
        (ID, {"privileged": "yes"}, TypeError, "privileged is 'yes'"),
        (ID, {"autoreset": 1}, TypeError, "autoreset is 1"),
        (ID, {"render_mode": ["rgb_array"]}, ValueError, "render_mode is .*; allowed are None and 'rgb_array'"),
    ],
)
def test_a_wrong_argument_is_refused_before_a_method_answers(name, wrong, error, words, monkeypatch):
    monkeypatch.setattr(environment, "prepare", lambda *_: pytest.fail("trials were drawn"))
    with pytest.raises(error, match=words):
        gymnasium.make_vec(name, num_envs=1, vectorization_mode="vector_entry_point", **wrong)


@pytest.mark.whole(part="closed_loop")
def test_an_episode_from_the_table_begins_where_its_plan_has_lifted_the_object():
    register()
    how = {"trials": 3, "output": "torch", "motion": "still", "action": "posture", "autoreset": False}
    envs = gymnasium.make_vec(FROM_TABLE, num_envs=4, vectorization_mode="vector_entry_point", **how).unwrapped
    seen, info = envs.reset(seed=0)
    home = torch.tensor(envs.scene.config.workplace.home_q, dtype=torch.float32)
    assert "pick" in envs.scene.benchmark.asks and torch.equal(seen["q"], envs.scores.path[:, 0])
    assert ((seen["q"] - home).abs().amax(1) > 0.1).all() and set(info["margins"]) >= {"pick", "presented", "received"}
    ends = play(envs, POLICIES["planned"]).end
    assert (ends == int(End.SUCCESS)).sum() >= 3, ends
    unplanned = replace(envs.scores, path_len=torch.zeros_like(envs.scores.path_len)).with_inputs(envs.scores.inputs)
    env = HandoverEnv(unplanned, "still")
    _, info = env.reset(seed=0)
    assert set(info["end"]) == {"drop"} and set(info["why"]) == {
        "the plan does not lift the object from the table and carry it"
    }


@pytest.mark.whole(part="view")
@needs("gl")
def test_a_single_one_passes_gymnasiums_checker_and_draws_what_moves():
    env = gymnasium.make(ID, render_mode="rgb_array", **SMALL)
    check_env(env.unwrapped)
    for wrong, error in (({"seed": -1}, "seed is -1"), ({"options": {"trial": 3}}, "allowed are 'reset_mask' and")):
        with pytest.raises(ValueError, match=error):
            env.unwrapped.reset(**wrong)
    env.reset(seed=0, options={})
    first = env.render()
    for _ in range(8):
        env.step(env.action_space.high)
    later = env.render()
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8 and first.std() > 10
    assert 0.002 < (first != later).any(2).mean() < 0.9
    env.close()
    with pytest.raises(ClosedEnvironmentError, match="render was called after close"):
        env.render()
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        gymnasium.make_vec(ID, num_envs=1, vectorization_mode="vector_entry_point", render_mode="human", **SMALL)


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, r2h_batch",
        "import r2h_batch, gymnasium",
        "import r2h_batch; from gymnasium.vector import VectorEnv; import gymnasium",
        "import r2h_batch, importlib.util as u; assert u.find_spec('gymnasium').origin; import gymnasium",
    ],
)
def test_the_name_is_registered_whichever_of_the_two_is_imported_first(imports):
    code = (
        f"{imports}; print(gymnasium.spec('r2h_batch/Handover-v1').id, type(gymnasium.__spec__.loader).__name__,"
        " type(gymnasium.__loader__).__name__)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert found.stdout.split() == [ID, "SourceFileLoader", "SourceFileLoader"]


def test_importing_the_package_imports_no_gymnasium():
    code = "import sys, r2h_batch; print('gymnasium' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert found.stdout.strip() == "False"
