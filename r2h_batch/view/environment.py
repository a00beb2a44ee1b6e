"""Handovers in closed loop as Gymnasium makes them: `gymnasium.make_vec("r2h_batch/Handover-v1", num_envs=64)`."""

import inspect
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2h_batch.base.io.progress import busy
from r2h_batch.base.registry import DEFAULT_BENCHMARK, PRESET_NAMES
from r2h_batch.base.validate import (
    check_keywords,
    describe_value,
    instance_of,
    integer,
    one_of,
    optional,
    sequence_of,
    text,
)
from r2h_batch.closed_loop.env import HandoverEnv, LoopConfig, SingleHandoverEnv, checked_motion
from r2h_batch.closed_loop.moving import ReceiverMotion
from r2h_batch.config import EvalConfig
from r2h_batch.sweep.jobs import make_jobs, prepare
from r2h_batch.sweep.options import base_of, check_method
from r2h_batch.sweep.request import Sweep
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.load import load_benchmark
from r2h_batch.types import CRITERIA, Predictions, Scores
from r2h_batch.verdicts import SPLITS
from r2h_batch.view.drawing import View, view_of
from r2h_batch.view.episode import EpisodeDrawing
from r2h_batch.view.pictures import painter
from r2h_batch.view.stored import judged_again

LEAST_TRIALS = 30
SIZE = (640, 480)
"""Width and height of a picture, pixels."""


def _check_render_mode(mode: object) -> None:
    """`ValueError` for another render mode than None and rgb_array."""
    if mode not in (None, *_DRAWS["render_modes"]):
        raise ValueError(f"render_mode is {describe_value(mode)}; allowed are None and 'rgb_array'")


class DrawnHandoverEnv(HandoverEnv):
    """A `HandoverEnv` that draws its handovers (extra `view`).

    Args:
        scores: as of `HandoverEnv`.
        args: its other positional arguments.
        render_mode: None or rgb_array.
        more: its arguments by name.
    """

    def __init__(
        self, scores: Scores, *args: Any, render_mode: str | None = None, **more: Any
    ) -> None:
        super().__init__(scores, *args, **more)
        self.metadata = {**self.metadata, **_DRAWS, "render_fps": self.config.rate_hz}
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self._drawings: dict[int, tuple[EpisodeDrawing, View]] = {}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) uint8 of each handover now; None without a render mode."""
        self.check_open("render")
        if self.render_mode is None:
            return None
        return tuple(self._picture(row) for row in range(self.num_envs))

    def _picture(self, row: int) -> np.ndarray:
        place = int(self._row[row])
        if place not in self._drawings:
            self._drawings[place] = self._drawing(row)
        (drawing, view), people = self._drawings[place], self.receiver
        T = self.T_world_hand[row].double().cpu().numpy()
        body = None if people is None else people[row].double().cpu().numpy()[None]
        drawing.show(T[None], body)
        with painter(drawing, SIZE, view) as paint:
            q = self.q[row].double().cpu().numpy()
            return paint(np.append(q, 0.0))

    def _drawing(self, row: int) -> tuple[EpisodeDrawing, View]:
        """A handover, and a camera that sees its whole plan."""
        inputs, rows = self.scores.inputs, torch.tensor([row], dtype=torch.int64, device="cpu")
        assert inputs is not None
        trial = inputs.trials[rows]
        answer = Predictions(trial.trial_id, inputs.T_obj_ee[rows], inputs.T_world_ee[rows])
        stored = judged_again(self.evaluator, trial, answer, "")
        T = np.repeat(trial.T_world_hand.double().cpu().numpy(), len(stored.q), 0)
        drawing = EpisodeDrawing(stored, stored.q, T, None, self.step_s)
        return drawing, view_of([drawing], SIZE[0] / SIZE[1])


_INNER = ("self", "scores", "more")
"""Names of parameters that a caller of `make_vec` does not give."""
_WAYS = ("action", "output", "privileged")
"""Arguments of `HandoverEnv` that are checked before a method answers."""
_DRAWS: dict[str, Any] = {"render_modes": ["rgb_array"]}


@busy("an environment")
def make_vector(
    num_envs: int = 1,
    *,
    method: str = "oracle",
    motion: ReceiverMotion | str = "moves",
    benchmark: Benchmark | str | Path | None = None,
    splits: Sequence[str] | str = SPLITS,
    trials: int | None = None,
    preset: str = "default",
    device: str = "cpu",
    threads: int | None = None,
    seed: int = 0,
    autoreset: bool = True,
    render_mode: str | None = None,
    config: LoopConfig | None = None,
    **more: Any,
) -> DrawnHandoverEnv:
    """Handovers of a method on the benchmark's trials, as a Gymnasium vector environment.

    Args:
        num_envs: handovers at once.
        method: who says grasps and handover poses: a word of `r2h-batch ls methods`, or your package.module:function.
        motion: of the receivers, or its name.
        benchmark: whose trials, or what `load_benchmark` takes; None: the default one. Where it asks for Pick, episodes begin
            where the object is lifted.
        splits: S0, S1 or both.
        trials: trials of each split; None: at least 30, and enough for `num_envs`. Those whose object the gripper
            cannot hold, or (where it asks for Pick) that are not lifted and carried, are left out. Episodes after the first
            take the next trial in turn.
        preset: how the benchmark plans.
        device: `cpu`, `cuda` or `cuda:N`.
        threads: CPU threads; None: all cores.
        seed: of the method.
        autoreset: whether rows that have ended begin their next episode (`AutoresetMode.NEXT_STEP`).
        render_mode: None, or rgb_array.
        config: how the loop runs.
        more: other arguments of `HandoverEnv`: action, privileged, output.

    Raises:
        ValueError: there are not as many handovers, no such benchmark or method.
        TypeError: config is no LoopConfig.
    """
    names = inspect.signature(HandoverEnv.__init__).parameters
    own = [k for k in (*inspect.signature(make_vector).parameters, *names) if k not in _INNER]
    check_keywords("make_vec", more, list(dict.fromkeys(own)))
    integer(1)("num_envs", num_envs)
    integer(0)("seed", seed)
    optional(integer(1))("trials", trials)
    text("method", method)
    check_method(base_of(method))
    optional(instance_of(LoopConfig, "LoopConfig(rate_hz=..., latency_s=...)"))("config", config)
    _check_render_mode(render_mode)
    if not isinstance(benchmark, Benchmark):
        benchmark = load_benchmark(DEFAULT_BENCHMARK if benchmark is None else benchmark)
    named = {name: more[name] for name in _WAYS if name in more}
    checked_motion(motion, autoreset=autoreset, **named)  # a method answers for seconds
    chosen = (splits,) if isinstance(splits, str) else sequence_of(str)("splits", splits)
    one_of(*PRESET_NAMES)("preset", preset)
    plan = dict.fromkeys(chosen, trials or max(LEAST_TRIALS, num_envs))
    how = EvalConfig.preset(preset)
    sweep = Sweep(
        method=(method,), seed=seed, device=device, threads=threads,
        configuration=replace(how, execute=replace(how.execute, sim="none")),
    )  # fmt: skip
    setting = prepare(benchmark, plan, sweep)
    jobs = make_jobs(setting, [])
    asked = setting.trials(setting.ids(0, setting.planned)).to(setting.evaluator.scene.device)
    answer = jobs[0].predict(asked, None)
    scores = setting.evaluator.score(answer.T_obj_ee, answer.T_world_ee, asked)
    plays = scores.passed[:, CRITERIA.index("stability")]
    if "pick" in benchmark.asks:
        plays = plays & (scores.path_len > 0)
    scores = scores[torch.nonzero(plays).flatten().cpu()]
    if len(scores) < num_envs:
        held = f"{method} holds the object in {len(scores)} of {len(asked)} trials"
        raise ValueError(f"{held}, and num_envs is {num_envs}; give more trials=")
    made: dict[str, Any] = {
        "num_envs": num_envs,
        "autoreset": autoreset,
        "render_mode": render_mode,
    }
    return DrawnHandoverEnv(scores, motion, config=config, **made, **more)


def make_single(**how: Any) -> SingleHandoverEnv:
    """One handover at a time as a plain Gymnasium environment.

    Args:
        how: as of `make_vector`, without num_envs and autoreset.
    """
    return SingleHandoverEnv(make_vector(1, autoreset=False, **how))


make_single.metadata = _DRAWS  # type: ignore[attr-defined]  # Gymnasium asks before it makes one
