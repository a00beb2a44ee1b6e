"""The judges of the test suite, for the benches that compare with them: the one place that knows where they lie."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import oracle
from judge_twin import Again, AgainBelieved, Finding
from people_twin import episode_of, reception_of
from pick_twin import PickTwin
from planning_twins import Checker, checker_of, dense, let_collide, motion_samples, ompl_solve, recheck, staged
from presented_twin import again as presented_again
from problems import Batch, Problems, make_batch, solve

__all__ = [
    "Again", "AgainBelieved", "Batch", "Checker", "Finding", "PickTwin", "Problems",
    "checker_of", "dense", "episode_of", "let_collide", "make_batch", "motion_samples", "ompl_solve",
    "oracle", "presented_again", "reception_of", "recheck", "solve", "staged",
]  # fmt: skip
