"""Draws trials of r2h-v3-draft again until the oracle's search finds a whole way, and writes r2h-v3-draft.npz.

`python assets/certified/build_certified.py --trials 500` certifies the first 500 trials of each split by all criteria, with the
motion as planned. A trial that the search does not solve is drawn again up to `MOST` times: the next object of its split, person,
hand and moment. Answers that the file holds already are kept (`--anew`: they are not). The file is written after each `--part`
trials; a run that was stopped goes on behind them. `--again` judges the answers of the file, as after a change of the criteria,
and searches once more where one fails: the same trials, as often drawn as before.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.trials.certified import (
    NEVER,
    Certified,
    joined_certified,
    read_certified,
    save_certified,
)
from r2h_batch.trials.registry import named_benchmark

NAME = "r2h-v3-draft"
OUT = Path(__file__).parent / f"{NAME}.npz"
MOST = 9
"""Redraws of a trial at most."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500, help="of each split")
    parser.add_argument("--part", type=int, default=200, help="trials after which the file is written")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--anew", action="store_true", help="ask for all trials, also for those that the file knows")
    parser.add_argument(
        "--again", action="store_true", help="judge what the file holds, and search what fails once more"
    )
    options = parser.parse_args()
    plain = replace(named_benchmark(NAME), certified=None)
    if options.again:
        save_certified(options.out, certified_again(plain, read_certified(options.out)))
        return
    ids = np.sort(plain.trials(options.trials).trial_id.numpy())
    known = None
    if not options.anew and options.out.exists():
        before = read_certified(options.out)
        if before.benchmark == plain.undrawn_digest:
            known = before
            ids = ids[~before.knows(ids)]
    for i in range(0, len(ids), options.part):
        found = certified(plain, ids[i : i + options.part])
        known = found if known is None else joined_certified(known, found)
        unfinished = options.out.with_suffix(".unfinished.npz")
        save_certified(unfinished, known)
        unfinished.replace(options.out)
        print(f"{len(known.trial_id)} trials, {int((known.redraws > 0).sum())} of them drawn again", flush=True)


def certified(plain: Any, ids: np.ndarray) -> Certified:
    """These trials of a benchmark without certificates, each drawn again until the search solves it."""
    redraws, solved = np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
    grasp, pose = (np.tile(np.eye(4, dtype=np.float32), (len(ids), 1, 1)) for _ in range(2))
    for k in range(MOST + 1):
        todo = np.flatnonzero(~solved)
        if not len(todo):
            break
        redraws[todo] = k
        blank = np.tile(np.eye(4, dtype=np.float32), (len(todo), 1, 1))
        asked = Certified(ids[todo], redraws[todo], np.zeros(len(todo), bool), blank, blank, plain.undrawn_digest)
        benchmark = replace(plain, certified=asked)
        judge = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")), threads=1)
        trials = benchmark.trials_with_ids(torch.from_numpy(ids[todo]))
        answers = oracle.predict(trials, judge.scene, evaluator=judge)
        won = judge.score(answers.T_obj_ee, answers.T_world_ee, trials).success.numpy()
        rows = todo[won]
        grasp[rows], pose[rows] = answers.T_obj_ee.numpy()[won], answers.T_world_ee.numpy()[won]
        solved[rows] = True
        print(f"drawn {k + 1} times: {won.sum()} of {len(todo)} solved", flush=True)
    redraws[~solved] = NEVER
    return Certified(ids, redraws, solved, grasp, pose, plain.undrawn_digest)


def certified_again(plain: Any, known: Certified) -> Certified:
    """The same trials with answers that pass today."""
    benchmark = replace(plain, certified=known)
    judge = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    ids, answers = known.trial_id[known.solved], known.answers(known.trial_id[known.solved])
    trials = benchmark.trials_with_ids(torch.from_numpy(ids))
    passes = judge.score(
        torch.from_numpy(answers.T_obj_ee), torch.from_numpy(answers.T_world_ee), trials
    ).success.numpy()
    rows = np.flatnonzero(known.solved)[~passes]
    todo = trials[torch.from_numpy(np.flatnonzero(~passes))]
    found = oracle.predict(todo, judge.scene, evaluator=judge)
    won = judge.score(found.T_obj_ee, found.T_world_ee, todo).success.numpy()
    grasp, pose, solved = known.T_obj_ee.copy(), known.T_world_ee.copy(), known.solved.copy()
    grasp[rows], pose[rows], solved[rows] = found.T_obj_ee.numpy(), found.T_world_ee.numpy(), won
    print(f"of {len(ids)} answers {len(rows)} fail; another one is found for {won.sum()} of these", flush=True)
    return replace(known, T_obj_ee=grasp, T_world_ee=pose, solved=solved)


if __name__ == "__main__":
    main()
