"""Trials that are solvable by construction: drawn, searched, and drawn again until the oracle finds a whole way.

A benchmark that names this search (`trials.benchmark.SEARCH`) asks it for trials that its file does not know.
`assets/certified/build_certified.py` writes the files.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.trials.benchmark import SEARCH, Benchmark
from r2h_batch.trials.certified import NEVER, Certified
from r2h_batch.verdicts import ASKED_NAMES

MOST = 9
"""Redraws of a trial at most."""


@SEARCH("oracle")
def certify(benchmark: Benchmark, trial_id: Int64[NDArray[np.int64], " n"]) -> Certified:
    """These trials, each drawn again until the oracle's search solves it by all criteria, with the motion as planned.

    A trial depends on its own id alone.

    Args:
        benchmark: whose trials they are, whichever criteria it asks for; what it knows of them is not asked.
        trial_id: (n,) ids, ascending.
    """
    own, n = tuple(o.who.own for o in benchmark.objects), len(trial_id)
    plain = replace(benchmark, objects=own, asks=ASKED_NAMES, certified=None)
    redraws, solved = np.zeros(n, np.int64), np.zeros(n, bool)
    grasp, pose = (np.tile(np.eye(4, dtype=np.float32), (n, 1, 1)) for _ in range(2))
    for k in range(MOST + 1):
        todo = np.flatnonzero(~solved)
        if not len(todo):
            break
        redraws[todo] = k
        none, blank = (
            np.zeros(len(todo), bool),
            np.tile(np.eye(4, dtype=np.float32), (len(todo), 1, 1)),
        )
        asked = Certified(trial_id[todo], redraws[todo], none, blank, blank, plain.undrawn_digest)
        drawn = replace(plain, certified=asked)
        judge = Evaluator(drawn, EvalConfig(execute=ExecConfig(sim="none")), threads=1)
        trials = drawn.trials_with_ids(torch.from_numpy(trial_id[todo]))
        answers = oracle.predict(trials, judge.scene, evaluator=judge)
        won = judge.score(answers.T_obj_ee, answers.T_world_ee, trials).success.numpy()
        rows = todo[won]
        grasp[rows], pose[rows] = answers.T_obj_ee.numpy()[won], answers.T_world_ee.numpy()[won]
        solved[rows] = True
    redraws[~solved] = NEVER
    return Certified(trial_id, redraws, solved, grasp, pose, plain.undrawn_digest)
