"""The upper bound: candidates x a fan of handover poses, judged by the evaluator itself (spec:
baselines.md).

In rounds: every trial that is still unsolved proposes one grasp and one pose, the evaluator scores
them all at once (the motion as planned, without the simulator), and what succeeds is kept. Where
nothing succeeds, the proposal that failed last in the paper's order stays. Where the object rests on the table
first, proposals are grasps that the arm can pick (`methods.from_table`).
"""

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base import rng, se3
from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp import attach, close_gripper, region_distance, squeezed
from r2h_batch.judge.reception import reception
from r2h_batch.methods.candidates import candidates_in, check_candidates, stacked
from r2h_batch.methods.from_table import TURNS, PickedGrasps, picked_grasps
from r2h_batch.methods.placing import check_choice
from r2h_batch.observe.known import known_moments
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Outcome, Predictions, Scores, Trials
from r2h_batch.verdicts import IN_ORDER

Aim = Literal["success", "reception"]
"""Kinds of solutions. reception: the person can take the object too."""

SOLUTIONS = 4
"""Number of receivable solutions of which the easiest is kept."""

ROUNDS = 64
"""Proposals a trial gets at most."""

MARGIN_M = 0.001
"""Smallest margins of a candidate's Stability and Affordance, where an object has such
candidates."""

TILT_DEG = 60.0
"""How far the approach may lean away from the line to the palm, or to the receiver."""
TILTS, ROLLS = 64, 8
NEARER_M, FARTHER_M = -0.02, 0.06
"""How far beyond c_h, seen from the palm, the object's free point is put."""

_FAN = 0  # purpose of the random counters
Array = NDArray[np.float64]


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    evaluator: Evaluator | None = None,
    rounds: int = ROUNDS,
    for_: Aim = "success",
) -> Predictions:
    """For each trial the first proposal that succeeds, else the answer that the benchmark knows (`Benchmark.certificates`),
    else the proposal that got farthest; drawn by (seed, trial id).

    Args:
        trials: B trials.
        scene: as the evaluator's.
        seed: of the draws.
        evaluator: the judge; None: one of the scene.
        rounds: proposals of a trial at most.
        for_: "reception": of the first 4 proposals that succeed and that the person can take
            (`judge.reception`), the one of least effort: an upper bound of reception, not a method.
    """
    check_choice("for_", for_, Aim)
    if evaluator is None:
        evaluator = Evaluator(scene.benchmark, scene.config, device=scene.device)
    check_candidates(scene, trials.object_index)
    evaluator = evaluator.kinematic
    n, home = len(trials), trials.trial_id.device
    trials = trials.to(scene.device)
    fan = Fan(trials, evaluator, seed)
    farthest = torch.full((n,), -torch.inf, dtype=torch.float64, device=scene.device)
    T_obj_ee, T_world_ee = (
        torch.eye(4, dtype=torch.float32, device=scene.device).repeat(n, 1, 1) for _ in range(2)
    )
    todo = torch.arange(n, dtype=torch.int64, device=scene.device)
    solutions = torch.zeros(n, dtype=torch.int64, device=scene.device)
    wanted = SOLUTIONS if for_ == "reception" else 1
    for turn in range(rounds):
        if not len(todo):
            break
        grasp, pose = (T.to(scene.device) for T in fan.proposals(todo.cpu().numpy(), turn))
        scores = evaluator.score(grasp, pose, trials[todo])
        reached, solved = how_far(scores), scores.success
        if for_ == "reception" and solved.any():
            rows = torch.nonzero(solved)[:, 0]
            taken = reception(scores[rows])
            # beyond every failure and every unreceivable success
            ease = 1.0 / (1.0 + taken.effort.double())
            reached[rows] += torch.where(taken.received, 1.0 + ease, 0.0)
            solved[rows] = taken.received
        solutions[todo] += solved
        better = reached > farthest[todo]
        rows = todo[better]
        farthest[rows], T_obj_ee[rows] = reached[better], grasp[better]
        T_world_ee[rows] = pose[better]
        todo = todo[solutions[todo] < wanted]
    if for_ == "success" and len(todo):  # what the search misses may be known
        known = evaluator.benchmark.certificates(trials.trial_id[todo].cpu().numpy())
        rows, own = todo[torch.from_numpy(known.known).to(todo.device)], known.known
        T_obj_ee[rows] = torch.from_numpy(known.T_obj_ee[own]).to(scene.device)
        T_world_ee[rows] = torch.from_numpy(known.T_world_ee[own]).to(scene.device)
    return Predictions(trials.trial_id, T_obj_ee, T_world_ee, method="oracle").to(home)


def how_far(scores: Scores) -> torch.Tensor:
    """How far a proposal got: the place of the criterion that failed first (success: one beyond the last), then that
    one's margin.

    Args:
        scores: of B proposals.
    """
    outcome = scores.outcome.long()
    criteria = scores.criteria
    order = [e.name for e in IN_ORDER if e.name in criteria]
    places = [1 + order.index(name) for name in criteria]
    place = torch.tensor(places, dtype=torch.int64, device=outcome.device)
    failed = (outcome - 1).clamp(0, len(criteria) - 1)
    margin = scores.margin[
        torch.arange(len(outcome), dtype=torch.int64, device=outcome.device), failed
    ].double()
    step = torch.where(outcome == int(Outcome.SUCCESS), 1 + len(criteria), place[failed])
    judged = outcome < int(Outcome.INVALID_INPUT)
    return torch.where(
        judged, step + 0.5 * torch.nan_to_num(margin, nan=-1.0, neginf=-1.0).clamp(-1.0, 0.0), -1.0
    )


class Fan:
    """Proposals of a batch of trials: Kronecker sequences, each trial's started at a random point
    of its own.

    Args:
        trials: B trials.
        evaluator: of their scene.
        seed: of the random points.
        picked: grasps that the arm can pick from the table; None: those of the first `TURNS` that are drawn, where the
            benchmark asks for Pick.
    """

    def __init__(
        self, trials: Trials, evaluator: Evaluator, seed: int, picked: PickedGrasps | None = None
    ) -> None:
        self._object = trials.object_index.cpu().numpy().astype(np.int64)
        usable = usable_grasps(evaluator)
        self._grasps, self._first, self._count = usable.T_obj_ee, usable.first, usable.spare
        self._free = usable.free
        _, normal, center = evaluator.scene.palm(trials.hand_index, trials.T_world_hand)
        self._normal, self._center = (x.cpu().numpy().astype(np.float64) for x in (normal, center))
        out = self._center * [1.0, 1.0, 0.0]
        self._outwards = out / np.sqrt(out[:, 0] ** 2 + out[:, 1] ** 2)[:, None]
        key = rng.key_of(f"oracle {seed}")
        self._start = rng.uniforms(key, trials.trial_id.cpu().numpy(), len(_STEPS), purpose=_FAN)
        self._picked = picked
        if picked is None and "pick" in evaluator.benchmark.asks:
            self._picked = picked_grasps(
                evaluator.scene,
                trials,
                known_moments(evaluator.scene).of(trials),
                self._candidates,
                np.full(len(trials), TURNS),
            )

    def _candidates(self, turn: int) -> NDArray[np.float64]:
        """(n, 4, 4) a candidate of each trial's object, in the order of its sequence."""
        u = self._start[0] + turn * _STEPS[0]
        row = self._first[self._object] + rng.choice(u - np.floor(u), self._count[self._object])
        return self._grasps[row].astype(np.float64)

    def proposals(self, rows: NDArray[np.int64], turn: int) -> tuple[torch.Tensor, torch.Tensor]:
        """T_obj_ee, T_world_ee (n, 4, 4) that trials try in a round.

        Args:
            rows: (n,) of the batch.
            turn: number of the round.
        """
        u = self._start[:, rows] + turn * _STEPS[:, None]
        which, mix, tilt, roll, far = u - np.floor(u)
        objects, normal = self._object[rows], self._normal[rows]
        row = self._first[objects] + rng.choice(which, self._count[objects])
        T_obj_ee = self._grasps[row].astype(np.float64)
        if self._picked is not None:
            T_obj_ee = self._picked.chosen(rows, which, T_obj_ee)
        approach = mix[:, None] * self._outwards[rows] - (1.0 - mix)[:, None] * normal
        frame = _basis(se3.rotate(_basis(approach), _TILTS[rng.choice(tilt, TILTS)]))
        x, z = se3.rotate(frame, _ROLLS[rng.choice(roll, ROLLS)]), frame[:, :, 2]
        R = np.stack([x, np.cross(z, x), z], 2)
        from_ee = self._free[objects] - T_obj_ee[:, :3, 3]
        free = se3.rotate(T_obj_ee[:, :3, :3].transpose(0, 2, 1), from_ee)  # in ee
        target = self._center[rows] + (NEARER_M + (FARTHER_M - NEARER_M) * far)[:, None] * normal
        T_world_ee = np.zeros((len(rows), 4, 4))
        T_world_ee[:, :3, :3] = R
        T_world_ee[:, :3, 3] = target - se3.rotate(R, free)
        T_world_ee[:, 3, 3] = 1.0
        grasp, pose = (torch.from_numpy(T.astype(np.float32)) for T in (T_obj_ee, T_world_ee))
        return grasp, pose


class Usable(NamedTuple):
    """Grasps of K objects that pass Stability and Affordance; of an object of which none does, all.

    Attributes:
        T_obj_ee: (R, 4, 4), one object after the other; of each first those that pass with a margin.
        first: (K,) each object's first row.
        spare: (K,) how many of its rows have that margin; where none has, all.
        number: (K,) its rows.
        free: (K, 3) each object's free point (frame obj).
    """

    T_obj_ee: NDArray[np.float32]
    first: NDArray[np.int64]
    spare: NDArray[np.int64]
    number: NDArray[np.int64]
    free: Array


@lru_cache(maxsize=1)
def usable_grasps(evaluator: Evaluator) -> Usable:
    """Candidates that pass, of the evaluator's objects.

    Args:
        evaluator: of a scene with candidates.
    """
    scene = evaluator.scene
    grasps, first, count = stacked(candidates_in(scene))
    of_object = np.repeat(np.arange(len(count)), count).astype(np.int32)
    spare_m = spare_margins(evaluator, grasps, of_object)
    kept, spare = [], []
    for i in range(len(count)):
        rows, some = usable_first(spare_m[first[i] : first[i] + count[i]])
        kept.append(first[i] + rows)
        spare.append(some)
    number = np.array([len(k) for k in kept], np.int64)
    # the centre of the receiver's region, else of the surface, is held out to the hand
    regions = (o.receiver_face[o.point_face] for o in scene.objects)
    held_out = (o.points[r] if r.any() else o.points for o, r in zip(scene.objects, regions))
    free = np.stack([points.astype(np.float64).mean(0) for points in held_out])
    rows = np.cumsum(number) - number
    return Usable(grasps[np.concatenate(kept)], rows, np.array(spare, np.int64), number, free)


def spare_margins(
    evaluator: Evaluator, T_obj_ee: NDArray[np.float32], of_object: NDArray[np.int32]
) -> NDArray[np.float32]:
    """(n,) the smaller one of the margins of grasps in Stability and Affordance, m; -inf where one of these fails.

    Args:
        evaluator: of the objects.
        T_obj_ee: (n, 4, 4) grasps, m.
        of_object: (n,) which objects.
    """
    scene, thresholds = evaluator.scene, evaluator.config.thresholds
    T, index = (torch.from_numpy(x).to(scene.device) for x in (T_obj_ee, of_object))
    held = close_gripper(
        scene.grasp_tables, T, index,
        w_max=thresholds.w_max_m, w_min=thresholds.w_min_m, mode=evaluator.config.width
    )  # fmt: skip
    region_m, _ = region_distance(
        scene.grasp_tables, attach(T, held.shift_m), index, squeezed(held, thresholds),
        cap_m=CLEARANCE_CAP_M
    )  # fmt: skip
    region_m = torch.where(region_m.isnan(), torch.inf, region_m)  # no region: nothing to spare
    passes = (held.margin_m >= 0) & (region_m > 0)
    spare = torch.where(passes, torch.minimum(held.margin_m, region_m), -torch.inf)
    return spare.cpu().numpy()


def usable_first(spare_m: NDArray[np.float32]) -> tuple[NDArray[np.int64], int]:
    """Which grasps of an object are of use, those with a margin first, and how many have it; where none has, all count as such.
    Where none passes, all are of use.

    Args:
        spare_m: (n,) of `spare_margins`.
    """
    every = np.arange(len(spare_m))
    passes = spare_m > -np.inf
    own = every[passes] if passes.any() else every
    good = spare_m[own] >= MARGIN_M
    return np.concatenate([own[good], own[~good]]), int(good.sum()) if good.any() else len(own)


def _basis(z: Array) -> Array:
    """(n, 3, 3) right-handed frames with these z axes (need not be unit vectors); columns x, y,
    z."""
    z = z / np.sqrt(z[:, 0] ** 2 + z[:, 1] ** 2 + z[:, 2] ** 2)[:, None]
    sign = np.where(z[:, 2] >= 0, 1.0, -1.0)  # Duff et al. 2017
    a = -1.0 / (sign + z[:, 2])
    b = z[:, 0] * z[:, 1] * a
    x = np.stack([1.0 + sign * z[:, 0] ** 2 * a, sign * b, -sign * z[:, 0]], 1)
    y = np.stack([b, sign + z[:, 1] ** 2 * a, -z[:, 1]], 1)
    return np.stack([x, y, z], 2)


def _kronecker_steps(dimensions: int) -> Array:
    """Steps of an additive low-discrepancy sequence: powers of 1/g, where g^(d+1) = g + 1 (Roberts
    2018)."""
    g = 2.0
    for _ in range(64):
        g = (1.0 + g) ** (1.0 / (dimensions + 1))
    return np.round(g ** -np.arange(1.0, dimensions + 1), 12)


def _cap(count: int, angle_deg: float) -> Array:
    """`count` directions spread evenly within an angle of +z (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - k / count * (1.0 - np.cos(np.radians(angle_deg)))
    turn = np.pi * (3.0 - np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - z * z)
    return np.round(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1), 12)


_STEPS = _kronecker_steps(5)
_TILTS = _cap(TILTS, TILT_DEG)
_ANGLES = 2 * np.pi * (np.arange(ROLLS) + 0.5) / ROLLS
_ROLLS = np.round(np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(ROLLS)], 1), 12)
