"""The frozen mix moved by one engine or another, and what differs between two runs of it."""

import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

import r2h_batch.evaluate as evaluate
from r2h_batch.config import EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.motion import sim_mjwarp, sim_mujoco
from r2h_batch.motion.execute import Executed, execute
from r2h_batch.trials.protocol import trials_with_ids
from r2h_batch.types import Scores, Trials

__all__ = ["Mix", "changed", "in_order", "same", "steps_of", "worst_margin"]

MIX = Path(__file__).with_name("mix.npz")


class Mix:
    """The frozen trials, scored under any execution; in the order in which an evaluator takes them, so that rows of scores and
    of what was executed are the same trials."""

    def __init__(self, n: int, device: str, threads: int | None) -> None:
        self.device, self.threads, self.n = device, threads, n
        with np.load(MIX, allow_pickle=False) as mix:
            rows = torch.arange(n) % len(mix["trial_id"])
            trials = trials_with_ids(torch.from_numpy(mix["trial_id"]), protocol="r2h-v0")
            rows = rows[in_order(trials[rows])]
            self.trials = trials[rows].to(device)
            self.g, self.h = (torch.from_numpy(mix[k])[rows].to(device) for k in ("T_obj_ee", "T_world_ee"))

    def score(self, config: ExecConfig, plan: PlanConfig | None = None) -> tuple[Scores, Executed, dict[str, Any]]:
        """Scores, the executed motion, what execute was given, process seconds under `seconds`, and under `rows` which
        rows were simulated in the whole scene (True) and with the arm alone (False)."""
        evaluator = Evaluator(
            EvalConfig(execute=config, plan=plan or PlanConfig()), device=self.device, threads=self.threads
        )
        seen: dict[str, Any] = {}

        def watched(scene: Any, body_poses: Any, path: Any, length: Any, motion: Any, c: Any, **k: Any) -> Executed:
            start, wall = time.process_time(), time.perf_counter()
            seen.update(body_poses=body_poses, path=path, length=length, motion=motion, scene=scene)
            seen["executed"] = execute(scene, body_poses, path, length, motion, c, **k)
            seen["execute_s"], seen["execute_wall_s"] = time.process_time() - start, time.perf_counter() - wall
            return seen["executed"]

        few = slice(0, 8)
        evaluator.score(self.g[few], self.h[few], self.trials[few])
        if config.sim != "none" and config.model != "arm":  # once in a process (docs/results/motion.md)
            start = time.process_time()
            evaluator.scene.model(self.trials.hand_index.tolist())
            seen["compile_s"] = time.process_time() - start
        engine = {"mujoco": sim_mujoco, "mjwarp": sim_mjwarp}.get(config.sim, sim_mujoco)
        simulate, rows = engine.simulate, seen.setdefault("rows", {True: set(), False: set()})

        def counted(job: Any, **k: Any) -> Any:
            rows[job.scene.full] |= set(job.rows.tolist())
            return simulate(job, **k)

        with mock.patch.object(evaluate, "execute", watched), mock.patch.object(engine, "simulate", counted):
            start = time.process_time()
            scores = evaluator.score(self.g, self.h, self.trials)
            seen["seconds"] = time.process_time() - start
        assert torch.equal(seen["length"], scores.path_len), "rows of scores and of motions are other trials"
        return scores, seen["executed"], seen


def in_order(trials: Trials) -> torch.Tensor:
    """The rows object by object, and of each hand by hand."""
    hands = int(trials.hand_index.max()) + 1
    return torch.argsort(trials.object_index.long() * hands + trials.hand_index, stable=True)


def changed(a: Scores, b: Scores) -> tuple[int, int, list[int]]:
    """Trials whose verdict differs, those of them outside the 0.1 mm band, and the ids of the latter."""
    differ = a.outcome != b.outcome
    outside = differ & ~(a.borderline | b.borderline)
    return int(differ.sum()), int(outside.sum()), a.trial_id[outside].tolist()


def steps_of(executed: Executed) -> int:
    """Steps of all trials."""
    return int((executed.length.clamp(min=1) - 1).sum()) * ExecConfig().record_steps


def worst_margin(a: Scores, b: Scores) -> float:
    """Largest difference of Safe's margins, m."""
    return float(torch.nan_to_num(a.margin[:, 4] - b.margin[:, 4]).abs().max())


def same(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Where two tensors hold the same number, or neither holds one."""
    return (a == b) | (a.isnan() & b.isnan())
