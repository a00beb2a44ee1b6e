"""Draws trials of r2h-v3-draft again until the oracle's search finds a whole way, and writes r2h-v3-draft.npz.

`python assets/certified/build_certified.py --trials 100` certifies the first 100 trials of each split by all criteria, with the
motion as planned. A trial that the search does not solve is drawn again up to `MOST` times: the next object of its split, person,
hand and moment. Answers that the file holds already are kept (`--anew`: they are not).
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.protocols.certified import NEVER, Certified, load_certified, save_certified
from r2h_batch.protocols.registry import named_benchmark

NAME = "r2h-v3-draft"
OUT = Path(__file__).parent / f"{NAME}.npz"
MOST = 9
"""Redraws of a trial at most."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100, help="of each split")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--anew", action="store_true", help="ask for all trials, also for those that the file knows")
    options = parser.parse_args()
    plain = replace(named_benchmark(NAME), certified=None)
    ids = np.sort(plain.trials(options.trials).trial_id.numpy())
    redraws = np.zeros(len(ids), np.int64)
    solved = np.zeros(len(ids), bool)
    grasp, pose = (np.tile(np.eye(4, dtype=np.float32), (len(ids), 1, 1)) for _ in range(2))
    known = load_certified(NAME)
    if not options.anew and known.benchmark == plain.undrawn_digest:
        solved, grasp, pose = known.answers(ids)
        solved, redraws = solved.copy(), known.redraws_of(ids)
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
    save_certified(options.out, Certified(ids, redraws, solved, grasp, pose, plain.undrawn_digest))


if __name__ == "__main__":
    main()
