"""A Gymnasium vector environment as Stable-Baselines3 (2.9) takes it. Needs the package stable-baselines3."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium import Wrapper
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv

_AT_EVERY_STEP = ("end", "why", "trial_id", "is_success")


class Sb3VecEnv(VecEnv):
    """Handovers for `stable_baselines3.PPO("MlpPolicy", Sb3VecEnv(envs))`.

    A row that ends begins its next episode in the same step, as Stable-Baselines3 expects: the observation is already that
    of the next episode, and `info` has the last one as `terminal_observation`, and `TimeLimit.truncated`.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        """Args:
            envs: made with `autoreset=False`, with flat observations and actions from -1 to 1 where the policy wants
                such: `gymnasium.wrappers.vector.FlattenObservation` and `RescaleAction`.

        Raises:
            ValueError: the environment begins episodes by itself.
        """
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.DISABLED:
            raise ValueError(
                "this environment begins episodes by itself; make it with make_vec(..., autoreset=False)"
            )
        self.envs, self._actions = envs, np.zeros(0, np.float32)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """First episodes of the seed that `seed` gave, or else the next ones. Row i goes i places on from the seed's
        handover by itself, so all rows are given the first row's seed."""
        seed, options = self._seeds[0], self._options[0] or None
        observation, infos = self.envs.reset(seed=seed, options=options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"trial_id": trial} for trial in infos["trial_id"].tolist()]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions for `step_wait`.

        Args:
            actions: (B, A) of the environment's action space.
        """
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        last, reward, ended, late, infos = self.envs.step(self._actions)
        over, columns = ended | late, [infos[name].tolist() for name in _AT_EVERY_STEP]
        rows = [dict(zip(_AT_EVERY_STEP, row, strict=True)) for row in zip(*columns, strict=True)]
        for row in np.flatnonzero(over).tolist():
            rows[row]["TimeLimit.truncated"] = bool(late[row] and not ended[row])
            rows[row]["terminal_observation"] = _row(last, row)
        if over.any():
            last, _ = self.envs.reset(options={"reset_mask": over})
        return last, reward, over, rows

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The environment's attribute, once for each row.

        Args:
            attr_name: its name.
            indices: rows; None: all.
        """
        return [getattr(self.envs, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuses: rows have no attributes of their own.

        Args:
            attr_name: of the attribute.
            value: what it should be.
            indices: of which rows.
        """
        raise AttributeError(f"{attr_name} cannot be set: all rows are one environment")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuses: rows have no methods of their own.

        Args:
            method_name: of the method.
            method_args: its arguments.
            indices: of which rows.
            method_kwargs: its arguments by name.
        """
        raise AttributeError(
            f"{method_name} cannot be called for a row: all rows are one environment"
        )

    def env_is_wrapped(
        self, wrapper_class: type[Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """No row is wrapped by itself.

        Args:
            wrapper_class: of the wrapper.
            indices: rows; None: all.
        """
        return [False] * len(self._rows(indices))

    def _rows(self, indices: int | Iterable[int] | None) -> Sequence[int]:
        return list(self._get_indices(indices))


def _row(observation: Any, row: int) -> Any:
    if isinstance(observation, dict):
        return {name: values[row] for name, values in observation.items()}
    return observation[row].copy()
