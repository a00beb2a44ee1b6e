"""The judges of the test suite, for the benches that compare with them: the one place that knows where they lie."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import grasp_cases
import oracle
from convex_twin import winding_number
from oracle import MujocoScene, Staged
from planning_twins import Checker, checker_of, dense, let_collide, motion_samples, ompl_solve, recheck, staged
from problems import Batch, Problems, make_batch, solve

__all__ = [
    "Batch", "Checker", "MujocoScene", "Problems", "Staged", "checker_of", "dense", "grasp_cases", "let_collide", "make_batch",
    "motion_samples", "ompl_solve", "oracle", "recheck", "solve", "staged", "winding_number",
]  # fmt: skip
