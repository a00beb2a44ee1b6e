"""A bound for methods that see: of many grasps and handover poses the pair that succeeds under most of 16 drawn errors.

As the oracle it proposes pairs in rounds and asks the evaluator, but in the world that it believes. A pair that succeeds there is
judged again with the object and the hand moved by each of the drawn errors. The first pair that succeeds under all of them is
taken, else the one that does under most. It knows how large the errors are, not what they are. It bounds what knowledge of
one's own errors brings; it is no upper bound of success.

Where the object rests on the table first, grasps are those that the arm can pick: of all candidates, and where these are few,
of grasps that come from above.
"""

import warnings
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.validate import integer
from r2h_batch.config import ObjectErrors
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.object_errors import taken_grasps
from r2h_batch.methods.candidates import check_candidates
from r2h_batch.methods.from_table import BACKS, KEPT, PickedGrasps, picked_grasps
from r2h_batch.methods.grasps import NoGraspError, sample_grasps
from r2h_batch.methods.oracle import Fan, how_far, spare_margins, usable_first, usable_grasps
from r2h_batch.observe.believed_object import KEPT_SOLIDS
from r2h_batch.observe.known import known_moments
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.noise import PredictorNoise, estimated_hand
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Robust search", "the judge"

ROUNDS = 64
"""Proposals a trial gets at most; as the oracle's."""
DRAWS = 16
_ORDER = 0  # purpose of the random counters
MOST_DRAWS = 256
FIRST = 4
"""Errors under which a pair that has a rival is judged first: most can then no longer hold under more than it does [choice]."""
ABOVE, ABOVE_ENOUGH = 32, 120
"""Grasps from above of an object that lacks others, and the number that they are chosen from [choice]."""


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of the errors that a search reckons with.

    Attributes:
        object: of the object's pose; its seed is not used.
        hand: of the target hand; the rest is not used.
    """

    object: ObjectErrors
    hand: PredictorNoise


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    evaluator: Evaluator | None = None,
    sizes: Sizes | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    draws: int = DRAWS,
    rounds: int = ROUNDS,
) -> Predictions:
    """For each trial the proposal that succeeds under most drawn errors; drawn by (seed, trial id).

    Args:
        trials: B trials.
        scene: as the evaluator's.
        seed: of proposals and errors.
        evaluator: the judge; None: one of the scene.
        sizes: of the errors; None: the evaluator's `object_errors`, and an exact hand.
        T_world_obj: (B, 4, 4) where the objects rest when a trial begins on the table, m, as it believes; None: where they do.
        draws: errors under which a proposal is judged; 0: it must succeed as believed, as the oracle's.
        rounds: proposals of a trial at most.
    """
    draws = integer(0, MOST_DRAWS)("draws", draws)
    if evaluator is None:
        evaluator = Evaluator(scene.benchmark, scene.config, device=scene.device)
    if sizes is None:
        sizes = Sizes(evaluator.config.object_errors, PredictorNoise().scaled(0.0))
    check_candidates(scene, trials.object_index)
    evaluator = evaluator.kinematic
    n, home = len(trials), trials.trial_id.device
    trials = trials.to(scene.device)
    bare = evaluator
    if evaluator.scene.hand_room_m:  # it is for errors that are not drawn
        bare = evaluator.in_scene(Scene(scene.benchmark, scene.device, config=scene.config))
    if T_world_obj is not None:
        for judge in (evaluator, bare):
            known_moments(judge.scene).tell(trials, T_world_obj.to(scene.device))
    picks = pickable(trials, evaluator, seed) if "pick" in evaluator.benchmark.asks else None
    fan = Fan(trials, evaluator, seed, picks)
    best = torch.full((n,), -torch.inf, dtype=torch.float64, device=scene.device)
    T_obj_ee, T_world_ee = (
        torch.eye(4, dtype=torch.float32, device=scene.device).repeat(n, 1, 1) for _ in range(2)
    )
    todo = torch.arange(n, dtype=torch.int64, device=scene.device)
    for turn in range(rounds):
        if not len(todo):
            break
        grasp, pose = (T.to(scene.device) for T in fan.proposals(todo.cpu().numpy(), turn))
        scores = evaluator.score(grasp, pose, trials[todo])
        value, solved = how_far(scores), torch.nonzero(scores.success)[:, 0]
        if len(solved):
            own, base = todo[solved], value[solved]
            held = holding(
                bare, trials[own], grasp[solved], pose[solved], sizes, draws, seed, beyond=best[own] - base
            )  # fmt: skip
            # beyond every failure
            value[solved] += held.double()
        better = value > best[todo]
        rows = todo[better]
        best[rows], T_obj_ee[rows], T_world_ee[rows] = value[better], grasp[better], pose[better]
        done = torch.zeros(len(todo), dtype=torch.bool, device=scene.device)
        if len(solved):
            done[solved] = held == draws
        todo = todo[~done]
    return Predictions(trials.trial_id, T_obj_ee, T_world_ee, method="robust").to(home)


def pickable(trials: Trials, evaluator: Evaluator, seed: int) -> PickedGrasps:
    """Up to `KEPT` grasps of each trial that the arm can pick: of its object's candidates, all of which are tried if need be;
    then of grasps that come from above where the object rests.

    Args:
        trials: B trials.
        evaluator: of their scene, whose benchmark asks for Pick.
        seed: of the order of the candidates.
    """
    scene = evaluator.scene
    T_world_obj = known_moments(scene).of(trials)
    usable, objects = usable_grasps(evaluator), trials.object_index.cpu().numpy()
    number, spare = usable.number[objects], usable.spare[objects]
    most = int(number.max(initial=0))
    u = rng.uniforms(
        rng.key_of(f"robust grasps {seed}"), trials.trial_id.cpu().numpy(), most, purpose=_ORDER
    ).T
    place = np.arange(most)
    later = np.where(place < spare[:, None], 0, 1) + (place >= number[:, None])
    rows = usable.first[objects][:, None] + np.argsort(u + later, 1, kind="stable")

    found = _tried(
        scene,
        trials,
        T_world_obj,
        [usable.T_obj_ee[r[:n]] for r, n in zip(rows, number, strict=True)],
    )
    few = np.flatnonzero(found.count < KEPT)
    some = torch.from_numpy(few).to(scene.device)
    down = -T_world_obj[some, 2, :3].double().cpu().numpy()
    above = [_from_above(evaluator, int(objects[i]), d) for i, d in zip(few, down, strict=True)]
    more = _tried(scene, trials[some], T_world_obj[some], above)
    for i, T, draw, count in zip(few, more.T_obj_ee, more.draw, more.count, strict=True):
        own = slice(found.count[i], min(KEPT, found.count[i] + count))
        new = own.stop - own.start
        found.T_obj_ee[i, own], found.draw[i, own] = T[:new], number[i] + draw[:new]
        found.count[i] = own.stop
    return found


def _tried(
    scene: Scene, trials: Trials, T_world_obj: Tensor, grasps: list[NDArray[np.float32]]
) -> PickedGrasps:
    """The first of each trial's grasps (n, 4, 4) that can be picked."""
    number = np.array([len(T) for T in grasps], np.int64)
    most = int(number.max(initial=0))
    every = np.tile(np.eye(4), (len(grasps), most, 1, 1))
    for own, T in zip(every, grasps, strict=True):
        own[: len(T)] = T
    return picked_grasps(
        scene, trials, T_world_obj, lambda k: every[:, k], number, turns=(1 + BACKS) * most
    )


def _from_above(
    evaluator: Evaluator, object_index: int, down: Float64[np.ndarray, "3"]
) -> NDArray[np.float32]:
    """(n, 4, 4) grasps of an object that pass Stability and Affordance, and that approach along `down` (frame obj)."""
    scene = evaluator.scene
    x, y, z = down.tolist()
    found = sampled_along(scene.objects[object_index], scene.robot, (x, y, z))
    spare_m = spare_margins(evaluator, found, np.full(len(found), object_index, np.int32))
    passes = spare_m > -np.inf
    return found[passes][usable_first(spare_m[passes])[0]]


@lru_cache(maxsize=KEPT_SOLIDS)
def sampled_along(
    model: ObjectModel, robot: Robot, down: tuple[float, float, float]
) -> NDArray[np.float32]:
    """(n, 4, 4) sampled grasps of an object that approach along a direction; kept for the next search of a sweep, and for the
    next trial with this object on this side.

    Args:
        model: the object.
        robot: whose gripper.
        down: the direction, a unit vector (frame obj).
    """
    with warnings.catch_warnings():  # that few of them keep off the region is no user's business
        warnings.simplefilter("ignore")
        try:
            found = sample_grasps(
                model, robot, count=ABOVE, enough=ABOVE_ENOUGH, along=np.array(down)
            ).T_obj_ee
        except NoGraspError:
            found = np.empty((0, 4, 4), np.float32)
    return found


def holding(
    evaluator: Evaluator,
    trials: Trials,
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    sizes: Sizes,
    draws: int,
    seed: int,
    *,
    beyond: Float64[Tensor, " b"] | None = None,
) -> Tensor:
    """(B,) the number of drawn errors under which each pair succeeds.

    Args:
        evaluator: without errors of its own.
        trials: B trials as they are believed to be.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        T_world_ee: (B, 4, 4) float32 handover poses, m.
        sizes: of the errors.
        draws: number of errors.
        seed: of the errors.
        beyond: (B,) number that each pair has to exceed to be of use. One that cannot is not judged to the end, and its number
            is too small. None: all are judged to the end.
    """
    known = known_moments(evaluator.scene)
    resting = known.of(trials) if "pick" in evaluator.benchmark.asks else None
    held = torch.zeros(len(trials), dtype=torch.int64, device=T_obj_ee.device)
    if not draws:
        return held
    drawn: list[tuple[Tensor, Tensor]] = []
    for k in range(draws):
        # no key that errors of a judge or of an estimator are drawn by
        own = int(rng.key_of(f"robust {seed} {k}")[0])
        drawn.append((
            taken_grasps(replace(sizes.object, seed=own), evaluator.scene.objects, T_obj_ee, trials),
            estimated_hand(
                evaluator.scene, trials.trial_id, trials.hand_index, trials.T_world_hand, seed=own, noise=sizes.hand
            ),
        ))  # fmt: skip
    grasps, hands = (torch.stack(T) for T in zip(*drawn, strict=True))

    def judge(draw: Tensor, row: Tensor) -> None:
        grasp, moved = grasps[draw, row], replace(trials[row], T_world_hand=hands[draw, row])
        if resting is not None:  # the gripper goes where it was told, and the object is elsewhere
            T_obj_moved = se3.matmul(T_obj_ee[row].double(), se3.inverse(grasp.double()))
            known.tell(moved, se3.matmul(resting[row].double(), T_obj_moved).float())
        success = evaluator.score(grasp, T_world_ee[row], moved).success
        held.index_add_(0, row, success.long())

    # as many as can be at once: a call for few rows costs as much as for many
    every = torch.ones((draws, len(trials)), dtype=torch.bool, device=held.device)
    first = every & False
    if beyond is not None:
        first[:FIRST] = beyond >= 0
    for some, left in ((first, draws), (~first, (~first).sum(0))):
        if beyond is not None:
            some = some & (held + left > beyond)
        draw, row = torch.nonzero(some, as_tuple=True)
        moved = replace(trials[row], T_world_hand=hands[draw, row])
        if resting is None or known.tells_apart(moved):
            parts = [(draw, row)] if len(row) else []
        else:  # a draw that leaves a hand where it was shares its moment with others
            parts = [(draw[draw == k], row[draw == k]) for k in draw.unique()]
        for part in parts:
            judge(*part)
    if resting is not None:
        known.tell(trials, resting)
    return held
