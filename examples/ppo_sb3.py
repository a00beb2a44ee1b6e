"""PPO of Stable-Baselines3 on handovers to a person who moves.

python examples/ppo_sb3.py          # a few minutes on two cores; needs the extra env and stable-baselines3

The policy says joint speeds and sees the hand as a camera does. The reward is 1 for a
success and -1 for a contact, so that a policy first learns not to touch the hand; a good one takes millions of steps.
"""

import argparse

import gymnasium
import numpy as np
from gymnasium.wrappers.vector import FlattenObservation, RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import r2h_batch  # noqa: F401 - registers the environment
from r2h_batch.closed_loop import LoopConfig
from r2h_batch.closed_loop.for_sb3 import Sb3VecEnv


def main(argv: list[str] | None = None) -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--envs", type=int, default=32, help="handovers at once")
    parser.add_argument("--trials", type=int, default=32, help="trials of each split that it learns on")
    given = parser.parse_args(argv)
    envs = gymnasium.make_vec(
        "r2h_batch/Handover-v1", num_envs=given.envs, vectorization_mode="vector_entry_point", autoreset=False,
        method="oracle", trials=given.trials, config=LoopConfig(rate_hz=10, horizon_s=8),
    )  # fmt: skip
    flat = RescaleAction(FlattenObservation(envs), -1.0, 1.0)
    normal = VecNormalize(VecMonitor(Sb3VecEnv(flat)), gamma=0.995)
    learned = PPO("MlpPolicy", normal, gamma=0.995, seed=0, n_steps=64, batch_size=512, n_epochs=4)
    learned.learn(given.steps)
    episodes, ends = list(learned.ep_info_buffer or ()), list(learned.ep_success_buffer or ())
    found = {
        "episodes": len(episodes),
        "return": float(np.mean([e["r"] for e in episodes])),
        "success %": 100 * float(np.mean(ends)),
    }
    print(f"last {found['episodes']} episodes: return {found['return']:+.2f}, success {found['success %']:.0f} %")
    return found


if __name__ == "__main__":
    main()
