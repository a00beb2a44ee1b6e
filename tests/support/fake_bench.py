"""A sweep without geometry: `python tests/support/fake_bench.py FLAGS` is the sweep command on a fake evaluator.

Its methods misbehave as the environment says, in this process or in the workers that it starts.
"""

import os
import signal
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from made_runs import NAMES, made_trials, make_header, make_scores

from r2h_batch.config import HOME_Q
from r2h_batch.sweep.jobs import Setting
from r2h_batch.sweep.request import Sweep
from r2h_batch.types import Outcome


class FakeEvaluator:
    """Success where the trial id is even, else a Plan failure; a pose that is not finite is INVALID_INPUT."""

    def __init__(self):
        self.config, self.threads = SimpleNamespace(chunk=2048), None
        self.sizes = []
        self.benchmark = SimpleNamespace(name="r2h-v1", label="r2h-v1@0", asks=(), certified=None)
        objects = [SimpleNamespace(name=n, split=s) for n, s in zip(NAMES.objects, NAMES.object_splits)]
        sides = torch.tensor([("right", "left").index(s) for s in NAMES.hand_sides])
        hands = SimpleNamespace(set=SimpleNamespace(side=sides, digest="h"))
        robot = SimpleNamespace(joints=range(6), home_q=HOME_Q)
        self.scene = SimpleNamespace(device="cpu", objects=objects, hands=hands, part_names=NAMES.parts, robot=robot)

    def hint(self, scores, T_obj_ee, T_world_ee, trials):
        return None

    def score(self, T_obj_ee, T_world_ee, trials, *, keep_motion=False):
        assert T_obj_ee.shape == T_world_ee.shape == (len(trials), 4, 4)
        self.sizes.append(len(trials))
        outcome = np.where(trials.trial_id.numpy() % 2 == 0, Outcome.SUCCESS, Outcome.PLAN)
        outcome[~torch.isfinite(T_world_ee).all(-1).all(-1).numpy()] = Outcome.INVALID_INPUT
        scores = make_scores(trials, outcome)
        ids = trials.trial_id  # make_scores counts rows; a verdict may depend on the trial only
        t_exec_s = torch.where(torch.isnan(scores.t_exec_s), torch.nan, 8.0 + 0.001 * ids).float()
        margin = torch.where(ids % 4 > 0, 0.02, -0.03)
        tilt = torch.where(ids % 4 > 1, 20.0, 120.0)
        return replace(
            scores,
            t_exec_s=t_exec_s,
            borderline=ids % 7 == 0,
            presented_margin_m=torch.where(scores.presented_margin_m.isnan(), torch.nan, margin),
            presented_by=torch.where(scores.presented_by < 0, -1, ids % 3).to(torch.int8),
            tilt_deg=torch.where(scores.tilt_deg.isnan(), torch.nan, tilt),
        )


def set_up(request: Sweep) -> Setting:
    """The result of `jobs.set_up`, with a fake evaluator: trial ids are 0, 1, 2, ... in the plan's order."""
    count = request.trials
    n = {s: count if s in request.splits else 0 for s in ("S0", "S1")}
    planned = {s: k for s, k in n.items() if k}
    error = replace(request.configuration.execution_error, seed=0)
    config = {"name": "default", "execution_error": asdict(error)}
    more = {"seed": request.seed, "stored": list(request.stored), "configuration": config}
    header = make_header(0, 0, trials=planned, **more)
    trials = made_trials(n["S0"], n["S1"])
    return Setting(
        FakeEvaluator(), header, lambda first, last: torch.arange(first, last), lambda ids: trials[ids], request
    )


def best(trials, scene, *, seed):
    """A user's method: a pose that depends on trial id and seed only."""
    T = torch.eye(4).repeat(len(trials), 1, 1)
    T[:, 0, 3] = trials.trial_id.float() + 1000 * seed
    return T, T + len(scene.objects)


def wrong(trials, scene, *, seed):
    """A user's method that forgets half of the trials."""
    return tuple(p[::2] for p in best(trials, scene, seed=seed))


def workers(log):
    """Processes that have answered something."""
    return {int(line.split()[0]) for line in log.read_text().splitlines()} if log.exists() else set()


def slow(trials, scene, *, seed):
    """Takes FAKE_SECONDS a call and notes in FAKE_LOG which process answered which trials.

    The second half of the trials waits until FAKE_WORKERS processes have answered: a busy machine starts workers late.
    """
    log, first, end = Path(os.environ["FAKE_LOG"]), int(trials.trial_id[0]), time.monotonic() + 60
    with log.open("a") as file:
        file.write(f"{os.getpid()} {first}\n")
    time.sleep(float(os.environ.get("FAKE_SECONDS", "0.05")))
    while first >= 60 and len(workers(log)) < int(os.environ.get("FAKE_WORKERS", "1")) and time.monotonic() < end:
        time.sleep(0.05)
    return best(trials, scene, seed=seed)


def deadly(trials, scene, *, seed):
    """Kills its process at trial FAKE_DEADLY, every time; FAKE_LOG gets an x first."""
    if int(os.environ["FAKE_DEADLY"]) in trials.trial_id.tolist():
        with Path(os.environ["FAKE_LOG"]).open("a") as log:
            log.write("x")
        os.kill(os.getpid(), signal.SIGKILL)
    return best(trials, scene, seed=seed)


if __name__ == "__main__":
    import fake_bench  # under its own name, so that workers can import what they are sent

    from r2h_batch.sweep import command as sweep
    from r2h_batch.sweep import jobs

    jobs.set_up = fake_bench.set_up
    sys.exit(sweep.main())
