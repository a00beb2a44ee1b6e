"""The postures at a target that no path leads to: which one the stored margin is about, and what each of them meets.

Plan's margin of such a row is the clearance of one posture: the valid branch whose worst pair overlaps least. The stored
`plan_pair` is another fact: what the planner's check of the first valid branch met first. A picture shows the posture and
the pair of the margin.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.goal import judge_goals
from r2h_batch.judge.ik import one_branch, solve_ik
from r2h_batch.scene.person import PIECES
from r2h_batch.sweep.rows import TrialNames
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import CollidingPair

Array = NDArray[np.float64]

BRANCHES = 8
"""Solutions of an arm's inverse kinematics at most (`IkResult.valid`)."""
TABLE = "table"


@dataclass(frozen=True)
class Nearest:
    """The two bodies that decide a posture's clearance."""

    kind: str  # `CollidingPair` in lower case
    part: str  # of the robot, or `object`
    other: str  # `table`, a piece of the hand or of the person, or a part of the robot


@dataclass(frozen=True)
class Postures:
    """A target's postures as planning judges them."""

    q: Array  # (joints,) rad, that of the margin; home where the start collides
    clearance_m: float  # of that posture: the margin
    nearest: (
        Nearest | None
    )  # None: nothing is nearer than the cap, or no posture reaches the target
    met: dict[str, int]
    """Kind of pair -> how many of the postures that reach the target have it as their worst overlap."""


def postures_at(evaluator: Evaluator, trial: Trials, answer: Predictions) -> Postures:
    """The postures at the target of one answer.

    Args:
        evaluator: judges the answer.
        trial: one trial.
        answer: one prediction for it.
    """
    scene, config = evaluator.scene, evaluator.config
    rows = torch.zeros(BRANCHES + 1, dtype=torch.int64, device=scene.device)
    trials, T_obj_ee, T_world_ee = trial[rows], answer.T_obj_ee[rows], answer.T_world_ee[rows]
    with evaluator.working():
        poses = executed_poses(config, scene.objects, T_obj_ee, T_world_ee, trials)
        held = attach_object(scene, *poses, trials, config)
        # the branches that `Evaluator` judges
        solve = solve_ik
        if config.ik.solver == "pytorch-kinematics":
            from r2h_batch.judge.ik_jacobian import solve_ik as solve
        robot, home = scene.robot, config.workplace.home_q
        ik = solve(held.T_world_ee, active=held.active, robot=robot, home=home)
        branches = ik.valid
        if config.plan.goals != "set":
            branches = one_branch(ik, held.T_world_ee, robot=robot, home=home)
        # a row for each branch alone, and one for all of them: that of the margin
        alone = torch.eye(BRANCHES + 1, BRANCHES, dtype=torch.bool, device=scene.device)
        alone[-1] = True
        goal = judge_goals(
            scene, held.planner_poses, held.T_world_ee, ik, branches & alone, held.active,
            from_home="pick" not in scene.benchmark.asks,
        )  # fmt: skip
    parts, pieces = TrialNames.of(scene).parts, (*scene.hands.model.piece_names, *PIECES)
    reaches = branches[-1].cpu()

    def nearest(row: int) -> Nearest | None:
        body, other, pair = (int(x[row]) for x in (goal.body, goal.other, goal.nearest_pair))
        if body < 0:
            return None
        kind = CollidingPair(pair)
        of_robot = kind in (CollidingPair.SELF, CollidingPair.OBJECT_ROBOT)
        name = TABLE if other < 0 else (parts if of_robot else pieces)[other]
        return Nearest(kind.name.lower(), parts[body], name)

    each = [nearest(k) for k in range(BRANCHES) if reaches[k] and float(goal.clearance_m[k]) < 0]
    counts = Counter(found.kind for found in each if found is not None)
    return Postures(
        goal.q[-1].double().cpu().numpy(),
        float(goal.clearance_m[-1]),
        nearest(BRANCHES),
        dict(counts.most_common()),
    )
