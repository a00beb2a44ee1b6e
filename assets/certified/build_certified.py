"""Draws trials of r2h-v3 again until the oracle's search finds a whole way, and writes r2h-v3.npz.

`python assets/certified/build_certified.py --trials 500` certifies the first 500 trials of each split by all criteria, with the
motion as planned (`methods.certify`). Answers that the file holds already are kept (`--anew`: they are not). `--processes` work
side by side on parts of `--part` trials; the file is written after each part, and a run that was stopped goes on behind
those that are done. `--again` judges the answers of the file, as after a change of the criteria, and searches once more where one
fails: first the same trials, as often drawn as before, then anew.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.methods.certify import certify
from r2h_batch.trials.certified import Certified, joined_certified, read_certified, save_certified
from r2h_batch.trials.registry import named_benchmark

NAME = "r2h-v3"
OUT = Path(__file__).parent / f"{NAME}.npz"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500, help="of each split")
    parser.add_argument("--part", type=int, default=100, help="trials of a part")
    parser.add_argument("--processes", type=int, default=2)
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
    known, unfinished = None, options.out.with_suffix(".unfinished.npz")
    start = unfinished if unfinished.exists() else options.out
    if start.exists() and (start == unfinished or not options.anew):
        before = read_certified(start)
        if before.benchmark == plain.undrawn_digest:
            known = before
            ids = ids[~(before.holds(ids) if start == unfinished else before.knows(ids))]
    parts = [ids[i : i + options.part] for i in range(0, len(ids), options.part)]
    with ProcessPoolExecutor(options.processes, get_context("spawn")) as pool:
        for part in as_completed([pool.submit(_certify, part) for part in parts]):
            known = part.result() if known is None else joined_certified(known, part.result())
            save_certified(unfinished, known)
            print(f"{len(known.trial_id)} trials, {int((known.redraws > 0).sum())} of them drawn again", flush=True)
    if known is not None:
        save_certified(unfinished, known)
        unfinished.replace(options.out)


def _certify(ids: np.ndarray) -> Certified:
    return certify(replace(named_benchmark(NAME), certified=None), ids)


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
    known = replace(known, T_obj_ee=grasp, T_world_ee=pose, solved=solved)
    left = known.trial_id[~solved]
    return joined_certified(known, certify(plain, left)) if len(left) else known


if __name__ == "__main__":
    main()
