"""Can this person take the object? Which of the held-out receiving grasps the receiver can have, and the
easiest of them. Part of the verdict where a benchmark asks for Received (`judge.received`).

A grasp counts when it passes every step of `STEPS`. The person may lean; the object is where the robot
holds it out, and the robot stands at its goal. docs/r2h_v3.md has the definitions, ranges and sources.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Float64, Int8, Int16, Int32, Int64, Shaped
from numpy.typing import NDArray
from scipy.special import gammaln
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.base.validate import array, check_arguments, instance_of, optional
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.hand_clearance import PosedHand, hand_of_points, hand_points
from r2h_batch.kernels.judge import reception as kernels
from r2h_batch.kernels.receiver.grasps import Receiving
from r2h_batch.scene.grasp_tables import gripper_tables
from r2h_batch.scene.hand import JOINTS, HandModel, palm_frame
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.person import heads_of
from r2h_batch.scene.scene import Scene
from r2h_batch.scene.tables import MIDDLE_ROOT
from r2h_batch.trials.holding.capacity import (
    AXES_SHARE,
    GRIP_BASE_N,
    GRIP_PER_WEIGHT,
    Withstood,
)
from r2h_batch.trials.holding.held_out import GRAVITY, G, HeldOut, load_held_out
from r2h_batch.types import CRITERIA, MarginKind, ScoreInputs, Scores, Trials
from r2h_batch.verdicts import Room

STEPS = ("arm", "free", "way", "clear", "release", "hold")
"""Steps that a grasp must pass, in this order. arm: joint ranges allow it. free: the hand is clear
of the closed gripper. way: it can come straight from 10 cm away. clear: arm, torso and head are clear of
the robot, and the head of the object. release: the fingers can open and back off by 10 cm. hold: the hand carries the object
with at most `GRIP_N`, also while it pulls."""

ANGLES = (
    "shoulder_flexion",
    "shoulder_abduction",
    "elbow",
    "supination",
    "wrist_flexion",
    "ulnar_deviation",
    "lean",
)

LEANS_DEG = (0.0, 10.0, 20.0, 30.0)
ROOM_M = 0.0005
"""Between hand and gripper [choice]."""
GRIP_N = 40.0
"""Largest force of one digit or the palm [choice]."""
PULL_N = 10.0
"""Pull of the person at which a gripper lets go [choice]: it turns the object in the hand about the gripper."""
LIFT = 0.2
"""The person pulls along the forearm, at least level, and this much upwards (as a slope) [choice]."""
MARGIN_TOLERANCE_M, MARGIN_SHARE = 1e-4, 0.1
"""The room along the way of the grasp that is taken is certain to the first or to this share of it, what is more, as Pick's."""
WAYS_TRIED = 8
"""The easiest grasps whose whole way is looked at, one after the other."""
TRIALS_AT_ONCE, PAIRS_CHUNK = 256, 16
HANDS_AT_ONCE = 512
"""Hands that are posed at a time: their skins are not kept."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reception:
    """Whether and how B receivers can take the object.

    Attributes:
        evaluated: whether the object is in the gripper (Stability) and the robot has a goal posture.
        received: some grasp passes all steps, and the whole way from the waiting hand to it is free.
        known: number of held-out grasps of the object for the receiver's hand.
        count: how many of them pass each of `STEPS` and all before it.
        grasp: number of the easiest of them among the object's in `load_held_out`; -1 where none is received.
        effort: mean square of the arm's angles over their ranges there, the lean over 60 degrees.
        turn_deg: by how much the hand turns from how it waits.
        travel_m: how far the wrist goes.
        angles_deg: `ANGLES` of the arm that takes the object.
        rula: grand score (McAtamney and Corlett 1993) of that posture, 1 to 7; 0 where none is received.
        elbow: where the elbow is then, world, m.
        T_world_hand: where the hand is then, m.
        T_world_before: where it is 10 cm before that, turned as there; from here it goes straight.
        wrist: where its wrist is then, world, m.
        pull: unit vector along which the person pulls, world.
        margin_m: the least `Room` of the easiest grasp; where none is received, minus what the step that leaves none lacks
            (docs/r2h_v3.md), -inf where no length tells; NaN where margins are not asked for.
        margin_kind: `MarginKind`.
        room: which `Room` that is; -1 where none is received.
        T_obj_ee: the grasp once the gripper has closed (`judge.grasp`), m; identity where nothing is held.
        T_world_obj: where the object is held out, m.
        opening_m: the gripper's squeezed opening.
    """

    evaluated: Bool[Tensor, " b"]
    received: Bool[Tensor, " b"]
    known: Int16[Tensor, " b"]
    count: Int16[Tensor, "b 6"]
    grasp: Int32[Tensor, " b"]
    effort: Float32[Tensor, " b"]
    turn_deg: Float32[Tensor, " b"]
    travel_m: Float32[Tensor, " b"]
    angles_deg: Float32[Tensor, "b 7"]
    rula: Int8[Tensor, " b"]
    elbow: Float32[Tensor, "b 3"]
    T_world_hand: Float32[Tensor, "b 4 4"]
    T_world_before: Float32[Tensor, "b 4 4"]
    wrist: Float32[Tensor, "b 3"]
    pull: Float32[Tensor, "b 3"]
    margin_m: Float32[Tensor, " b"]
    margin_kind: Int8[Tensor, " b"]
    room: Int8[Tensor, " b"]
    T_obj_ee: Float32[Tensor, "b 4 4"]
    T_world_obj: Float32[Tensor, "b 4 4"]
    opening_m: Float32[Tensor, " b"]


@check_arguments(
    scores=instance_of(Scores, "what Evaluator.score returns"),
    leans_deg=array("iuf", 1, "leans of the trunk, 0 to 90 degrees", low=0.0, high=90.0),
    head=optional(instance_of(Tensor, "a torch tensor (B, 2, 4), or None")),
    margins=instance_of(bool, "True or False"),
)
def reception(
    scores: Scores,
    *,
    leans_deg: tuple[float, ...] = LEANS_DEG,
    head: Float32[Tensor, "b 2 4"] | None = None,
    margins: bool = False,
) -> Reception:
    """Whether each receiver can take the object that was handed over.

    Args:
        scores: what `Evaluator.score` returned for trials with a receiver's body (as r2h-v2 has).
        leans_deg: leans of the trunk that a person may use, 0 to 90 degrees; (0,): none.
        head: (B, 2, 4) of `scene.person.heads_of`, where the trials' receivers have moved their arms since, m; None: theirs.
        margins: also by how much, which takes longer.

    Raises:
        TypeError, ValueError: an argument has another type or range, the scores hold no inputs, or the
            trials have no receiver's arm.
    """
    if (inputs := scores.inputs) is None:
        raise ValueError("these scores hold no inputs; score again")
    if inputs.trials.receiver is None:
        raise ValueError(
            "these trials have no receiver's body, which reception needs; take a benchmark of people"
        )
    if not len(leans_deg):
        raise ValueError("leans_deg is empty; give (0.0,) for a person who does not lean")
    rows = range(0, max(len(scores), 1), TRIALS_AT_ONCE)
    with inputs.evaluator.working():
        _grasps(inputs.evaluator.scene, inputs.trials)  # of all rows: hands are posed once
        parts = [
            _reception(scores[part], leans_deg, None if head is None else head[part], margins)
            for part in (slice(i, i + TRIALS_AT_ONCE) for i in rows)
        ]
    return Reception(
        **{k: torch.cat([getattr(p, k) for p in parts]) for k in Reception.__dataclass_fields__}
    )


@dataclass(frozen=True, eq=False)
class _Grasps:
    """Held-out grasps on a device: the kernels' struct and its arrays, the posed hands, and for
    each object and side the first row and the number."""

    held_out: HeldOut
    table: Any
    owners: tuple[Tensor, ...]
    joints: Float32[Tensor, "m 16 3"]
    """frame obj, m"""
    hands: PosedHand
    first: Int32[Tensor, "o 2"]
    number: Int32[Tensor, "o 2"]
    grip_n: Float32[Tensor, "m 6"]
    withstands: dict[str, Tensor]
    """fields of `capacity.Withstood`, float64"""
    com: Float64[Tensor, "o 3"]
    mass: Float64[Tensor, " o"]
    open_gap_m: float

    def first_of(self, object_index: Tensor) -> Tensor:
        """Row of each object's first grasp."""
        return self.held_out.first.to(object_index.device)[object_index.long()]


class _Known:
    """The grasps on some objects, which grow with those that are asked for."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.grasps: _Grasps | None = None


@lru_cache(maxsize=2)
def _known(
    objects: tuple[ObjectModel, ...], hand: HandModel, device: str, open_gap_m: float
) -> _Known:
    """What all scenes with these share: hands on the 96 objects of r2h-v3 take 1.2 GB, and 10 s to pose."""
    return _Known()


def _grasps(scene: Scene, trials: Trials) -> _Grasps:
    """The held-out grasps of the objects of these trials, at least."""
    hand, needed = scene.hands.model, frozenset(trials.object_index.unique().tolist())
    known = _known(scene.objects, hand, scene.device, scene.robot.open_gap_m)
    with known.lock:
        before = known.grasps
        posed: frozenset[int] = frozenset() if before is None else before.held_out.loaded
        if before is None or not needed <= posed:
            # others may have loaded those of all objects, which would take long to pose
            held_out = load_held_out(scene.objects, hand, needed | posed).only(needed | posed)
            known.grasps = _grown(scene, held_out, before)
        assert known.grasps is not None
        return known.grasps


def _skins(
    scene: Scene, held_out: HeldOut, before: _Grasps | None
) -> tuple[Float32[Tensor, "m 16 3"], Float32[Tensor, "m p 3"]]:
    """Joints of the posed hands, and the points of their convex pieces (frame obj, m). Posing takes 0.2 ms a hand, so hands of
    objects that were there before are copied.
    """
    grasps, hand = held_out.grasps, scene.hands.model
    of = grasps.object_index.long()
    loaded = frozenset() if before is None else before.held_out.loaded
    old = torch.isin(of, torch.tensor(sorted(loaded), dtype=torch.int64, device=of.device))
    joints = torch.empty((len(of), JOINTS, 3), dtype=torch.float32, device=of.device)
    points = torch.empty(
        (len(of), len(hand.piece_vertices), 3), dtype=torch.float32, device=scene.device
    )
    if before is not None:
        joints[old], points[old.to(points.device)] = before.joints, before.hands.points
    for rows in torch.nonzero(~old).flatten().split(HANDS_AT_ONCE):
        new = grasps[rows]
        joints[rows] = new.joints
        points[rows.to(points.device)] = hand_points(hand, new.vertices, scene.device)
    return joints, points


def _grown(scene: Scene, held_out: HeldOut, before: _Grasps | None) -> _Grasps:
    """The grasps of a scene; hands that were posed `before` are not posed again."""
    com, mass = (
        torch.from_numpy(np.array([getattr(o, k) for o in scene.objects], np.float64))
        for k in ("com", "mass")
    )
    withstood = Withstood.of(scene.objects, scene.hands.model, held_out.loaded)
    grasps = held_out.grasps
    skin_joints, points = _skins(scene, held_out, before)
    joints = skin_joints.double()
    _, normal = palm_frame(joints, grasps.side)
    along = joints[:, MIDDLE_ROOT] - joints[:, 0]
    along = along - se3.dot(along, normal)[:, None] * normal
    along = along / se3.dot(along, along).sqrt()[:, None]
    vectors = [x.float().to(scene.device) for x in (joints[:, 0], along, normal)]
    R = grasps.T_obj_hand[:, :3, :3].contiguous().to(scene.device)
    lines = [x.to(scene.device) for x in (held_out.axis, held_out.axis_point)]
    table: Any = Receiving()
    for name, x in zip(("wrist", "along", "normal"), vectors, strict=True):
        setattr(table, name, wp.from_torch(x, dtype=wp.vec3))
    table.R = wp.from_torch(R, dtype=wp.mat33)
    table.axis, table.axis_point = (wp.from_torch(x, dtype=wp.vec3) for x in lines)
    of = grasps.object_index.long() * 2 + grasps.side.long()
    number = torch.bincount(of, minlength=2 * len(scene.objects)).to(torch.int32)
    first = (torch.cumsum(number, 0) - number).to(torch.int32)
    return _Grasps(
        held_out,
        table,
        (*vectors, R, *lines),
        skin_joints,
        hand_of_points(scene.hands.model, points),
        first.view(-1, 2).to(scene.device),
        number.view(-1, 2).to(scene.device),
        held_out.grip_n.to(scene.device),
        {
            f.name: torch.from_numpy(getattr(withstood, f.name)).to(scene.device, torch.float64)
            for f in fields(withstood)
        },
        com.to(scene.device),
        mass.to(scene.device),
        scene.robot.open_gap_m,
    )


@dataclass(frozen=True, eq=False)
class _Batch:
    """Some handovers, and what every step reads of them."""

    grasps: _Grasps
    sized: Callable[[Any], Any]
    """a kernel for the arm's number of joints (`Scene.sized`)"""
    device: str
    tables: dict[str, Any]
    """gripper, hands and grasps, for the kernels that look at both"""
    robot: dict[str, Any]
    """the robot at its goals, and the receivers"""
    evaluated: Bool[Tensor, " b"]
    side: Int64[Tensor, " b"]
    first: Int32[Tensor, " b"]
    """first grasp of each trial's object and hand, and how many there are"""
    known: Int32[Tensor, " b"]
    of_trial: dict[str, Tensor]

    @property
    def width(self) -> int:
        return max(int(self.grasps.number.max()), 2)

    def pairs(self, trial: Tensor, k: Tensor, arms: dict[str, Tensor]) -> dict[str, Tensor]:
        """Columns of the pairs (trial, k), from what the arm's step found."""
        columns = {name: x[trial].contiguous() for name, x in self.of_trial.items()}
        return columns | {
            "trial": trial.to(torch.int32),
            "row": (self.first[trial] + k).to(torch.int32),
            "turn": arms["turn"][trial, k],
            "lean": arms["angles"][trial, k, ANGLES.index("lean")].contiguous(),
            "elbow": arms["elbow"][trial, k].contiguous(),
        }

    def wrists(self, pair: dict[str, Tensor]) -> Float32[Tensor, "p 3"]:
        """Where the wrists of pairs are, world, m."""
        row = pair["row"].long().clamp(max=len(self.grasps.grip_n) - 1)
        turned = _about_axis(self.grasps, pair["object"].long(), pair["turn"])
        return se3.apply(pair["T_world_obj"], se3.apply(turned, self.grasps.owners[0][row]))


@dataclass(frozen=True, eq=False)
class _Found:
    """What the steps say of every grasp of every trial."""

    arms: dict[str, Tensor]
    passes: Bool[Tensor, "b k 6"]
    """each of `STEPS` and all before it"""
    way: Int32[Tensor, "b k"]
    """direction from which the hand comes; -1: none"""
    far_m: Float32[Tensor, "b k"]
    """how far the best straight way is free, from the grasp on"""
    back_m: Float32[Tensor, "b k"]
    """how far the opened fingers can back off"""
    chosen: Int64[Tensor, " b"]
    """the easiest grasp whose whole way is free; -1: none"""
    left_m: Float32[Tensor, " b"]
    """what is left of the whole way where something meets, of the grasp that comes nearest"""


def _reception(
    scores: Scores, leans_deg: tuple[float, ...], head: Tensor | None, margins: bool
) -> Reception:
    batch = _batch_of(scores, head)
    arms = _arms(batch, leans_deg)
    passes = torch.zeros((*arms["effort"].shape, len(STEPS)), dtype=torch.bool, device=batch.device)
    passes[..., 0] = arms["effort"] >= 0
    way, far_m = _come(batch, arms, passes)
    _beside_robot(batch, arms, passes)
    back_m = _let_go(batch, arms, passes)
    _carry(batch, arms, passes)
    passes = passes.cummin(2).values
    chosen, left_m = _easiest(batch, arms, way, passes[..., -1])
    found = _Found(arms, passes, way, far_m, back_m, chosen, left_m)
    return _result(batch, found, _margins(batch, found, leans_deg) if margins else None)


def _batch_of(scores: Scores, head: Tensor | None = None) -> _Batch:
    inputs = scores.inputs
    assert isinstance(inputs, ScoreInputs)
    evaluator, trials = inputs.evaluator, inputs.trials
    scene, receiver = evaluator.scene, trials.receiver
    assert receiver is not None  # `reception` has asked
    grasps, device = _grasps(scene, trials), scene.device
    asked = inputs.T_obj_ee, inputs.T_world_ee
    executed = executed_poses(evaluator.config, scene.objects, *asked, trials)
    evaluated = scores.passed[:, CRITERIA.index("stability")] & scores.q_goal.isfinite().all(1)
    eye = torch.eye(4, dtype=torch.float32, device=device)
    T_obj_ee, T_world_ee = (
        se3.orthonormalise(torch.where(evaluated[:, None, None], T.to(device), eye))
        for T in executed
    )
    attached = attach(T_obj_ee, torch.where(evaluated, scores.grasp_shift_m, 0.0)).contiguous()
    squeezed = scores.opening_m - evaluator.config.thresholds.pad_squeeze_m
    opening = torch.where(evaluated, squeezed, 0.0).clamp(min=0.0).contiguous()
    T_world_obj = se3.matmul(T_world_ee.double(), se3.inverse(attached.double())).float()
    objects = trials.object_index.long()
    side = scene.hands.set.side.to(device)[trials.hand_index.long()].long()
    poses = scene.body_poses(
        trials.object_index, trials.hand_index, attached, trials.T_world_hand, opening
    )
    return _Batch(
        grasps,
        scene.sized,
        device,
        {
            "gripper": gripper_tables(scene.robot, device),
            "hands": grasps.hands.struct,
            "grasps": grasps.table,
            "eps": ROOM_M,
        },
        {
            "world": scene.world,
            "bodies": poses.bodies,
            "receiver": receiver.contiguous(),
            "head": (heads_of(receiver) if head is None else head).contiguous(),
            "q": scores.q_goal.nan_to_num(nan=0.0).contiguous(),
        },
        evaluated,
        side,
        grasps.first[objects, side].contiguous(),
        torch.where(evaluated, grasps.number[objects, side], 0),
        {
            "object": trials.object_index.contiguous(),
            "attached": attached,
            "opening": opening,
            "T_world_obj": T_world_obj.contiguous(),
            "T_world_hand": trials.T_world_hand.contiguous(),
        },
    )


def _arms(batch: _Batch, leans_deg: tuple[float, ...]) -> dict[str, Tensor]:
    """Effort (-1: no posture), turn about the axis of revolution, angles and elbow of every grasp of
    every trial, (b, k, ...)."""
    b, width, device = len(batch.known), batch.width, batch.device
    sizes = dict.fromkeys(("effort", "turn", "angles", "elbow"), width)
    kernel = batch.sized(kernels.reach_with_arm)
    found: dict[str, Tensor] = over_trials(kernel, b, device, sizes=sizes, width=width, chunk=1)(
        **_arm_columns(batch, leans_deg), T_world_hand=batch.of_trial["T_world_hand"]
    )
    return found


def _arm_columns(batch: _Batch, leans_deg: tuple[float, ...]) -> dict[str, Any]:
    """Inputs of the kernels that look for arms of every grasp of every trial."""
    return {
        "grasps": batch.grasps.table,
        "lean": torch.tensor(leans_deg, dtype=torch.float32, device=batch.device),
        "row": batch.first,
        "count": batch.known.contiguous(),
        "outwards": torch.where(batch.side == 0, -1.0, 1.0).float(),
        "receiver": batch.robot["receiver"],
        **{k: batch.of_trial[k] for k in ("object", "T_world_obj")},
    }


def _launch(batch: _Batch, kernel: Any, n: int, **inputs: Any) -> dict[str, Tensor]:
    """Outputs of a kernel over n pairs."""
    run = over_trials(batch.sized(kernel), n, batch.device, chunk=PAIRS_CHUNK)
    found: dict[str, Tensor] = run(**inputs)
    return found


_PAIR_COLUMNS = ("row", "turn", "object", "attached", "opening")
"""Inputs of the gripper-hand check, for a pair."""


def _come(
    batch: _Batch, arms: dict[str, Tensor], passes: Tensor
) -> tuple[Int32[Tensor, "b k"], Float32[Tensor, "b k"]]:
    """Writes the steps free and way; the direction from which each hand comes, -1: none, and how far one is free, m."""
    trial, k = torch.nonzero(passes[..., 0], as_tuple=True)
    pair = batch.pairs(trial, k, arms)
    columns = {n: pair[n] for n in _PAIR_COLUMNS}
    made = _launch(batch, kernels.come_to_object, len(trial), **batch.tables, **columns)
    passes[trial, k, 1], passes[trial, k, 2] = made["free"], made["way"] >= 0
    way = torch.full(passes.shape[:2], -1, dtype=torch.int32, device=batch.device)
    way[trial, k] = made["way"]
    return way, _of_pairs(passes, trial, k, made["far"])


def _of_pairs(
    passes: Tensor, trial: Tensor, k: Tensor, value: Float32[Tensor, " p"]
) -> Float32[Tensor, "b k"]:
    """A number of some pairs as a table of all; -inf of the others."""
    table = torch.full(passes.shape[:2], -torch.inf, dtype=torch.float32, device=passes.device)
    table[trial, k] = value
    return table


def _beside_robot(batch: _Batch, arms: dict[str, Tensor], passes: Tensor) -> None:
    """Writes the step clear."""
    trial, k = torch.nonzero(passes[..., :3].all(2), as_tuple=True)
    pair = batch.pairs(trial, k, arms)
    posture = {n: pair[n] for n in ("trial", "lean", "elbow")}
    wrist = batch.wrists(pair).contiguous()
    made = _launch(
        batch, kernels.arm_clears_robot, len(trial), **batch.robot, **posture, wrist=wrist
    )
    passes[trial, k, 3] = made["clear"]


def _let_go(batch: _Batch, arms: dict[str, Tensor], passes: Tensor) -> Float32[Tensor, "b k"]:
    """Writes the step release; how far the fingers can back off, m."""
    trial, k = torch.nonzero(passes[..., :4].all(2), as_tuple=True)
    pair = batch.pairs(trial, k, arms)
    columns = {n: pair[n] for n in _PAIR_COLUMNS} | {"open_gap": batch.grasps.open_gap_m}
    made = _launch(batch, kernels.let_go, len(trial), **batch.tables, **columns)
    passes[trial, k, 4] = made["back"] >= float(kernels.WAY_M)
    return _of_pairs(passes, trial, k, made["back"])


def _easiest(
    batch: _Batch, arms: dict[str, Tensor], way: Tensor, passing: Bool[Tensor, "b k"]
) -> tuple[Int64[Tensor, " b"], Float32[Tensor, " b"]]:
    """The grasp of least effort whose whole way is free, among the first `WAYS_TRIED`; -1: none, and what is left of the way
    of the one that comes nearest, m."""
    effort = torch.where(passing, arms["effort"], torch.inf)
    order = effort.argsort(dim=1, stable=True)
    chosen = torch.full((len(passing),), -1, dtype=torch.int64, device=passing.device)
    nearest = torch.full((len(passing),), torch.inf, dtype=torch.float32, device=passing.device)
    left = torch.nonzero(passing.any(1))[:, 0]
    for turn in range(min(WAYS_TRIED, passing.shape[1])):
        k = order[left, turn]
        tried = torch.isfinite(effort[left, k])
        left, k = left[tried], k[tried]
        if not len(left):
            break
        pair = batch.pairs(left, k, arms) | {"way": way[left, k]}
        inputs = {**batch.tables, **batch.robot, **pair}
        made = _launch(batch, kernels.way_to_grasp, len(left), **inputs)
        chosen[left[made["free"]]] = k[made["free"]]
        nearest[left] = torch.minimum(nearest[left], made["left"])
        left = left[~made["free"]]
    return chosen, nearest


def _margins(batch: _Batch, found: _Found, leans_deg: tuple[float, ...]) -> dict[str, Tensor]:
    """`margin_m`, `margin_kind` and `room` of every trial."""
    b, device = len(found.chosen), found.chosen.device
    margin = torch.full((b,), -torch.inf, dtype=torch.float32, device=device)
    kind = torch.full((b,), int(MarginKind.CAP), dtype=torch.int8, device=device)
    room = torch.full((b,), -1, dtype=torch.int8, device=device)
    got = torch.nonzero(found.chosen >= 0)[:, 0]
    if len(got):
        rooms, capped = _rooms(batch, found, got, found.chosen[got])
        least, which = rooms.min(1)
        margin[got], room[got] = least, which.to(torch.int8)
        capped &= which < int(Room.REACH)
        kind[got] = torch.where(capped, int(MarginKind.CAP), int(MarginKind.DISTANCE)).to(
            torch.int8
        )
    none = ~found.passes.any(1)
    step = torch.where(none.any(1), none.to(torch.int8).argmax(1), len(STEPS))
    step = torch.where((batch.known == 0) | (found.chosen >= 0), -1, step)
    for j, name in enumerate((*STEPS, "whole_way")):
        if name in _LACKS and len(rows := torch.nonzero(step == j)[:, 0]):
            lacks, told = _LACKS[name]
            margin[rows], kind[rows] = lacks(batch, found, rows, leans_deg), int(told)
    kind[margin == -torch.inf] = int(MarginKind.CAP)
    return {"margin_m": margin, "margin_kind": kind, "room": room}


def _rooms(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], k: Int64[Tensor, " n"]
) -> tuple[Float32[Tensor, "n 4"], Bool[Tensor, " n"]]:
    """Each `Room` of the grasps k of trials, m, and whether nothing is nearer to hand and body than was looked. Those of hand
    and body are right where they are less than the others."""
    pair = batch.pairs(rows, k, found.arms)
    angles = found.arms["angles"][rows, k].contiguous()
    inputs = {"receiver": batch.robot["receiver"], "trial": pair["trial"], "angles": angles}
    own = _launch(batch, kernels.arm_rooms, len(rows), **inputs)["rooms"]
    pair |= {"way": found.way[rows, k], "enough": own.amin(1)}
    inputs = {**batch.tables, **batch.robot, **pair}
    inputs |= {"tolerance": MARGIN_TOLERANCE_M, "share": MARGIN_SHARE}
    beside = _launch(batch, kernels.rooms_on_way, len(rows), **inputs)
    return torch.cat([beside["rooms"], own], 1), beside["capped"]


def _short_of_reach(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    asked = torch.zeros_like(batch.evaluated)
    asked[rows] = True
    kernel = batch.sized(kernels.short_of_reach)
    run = over_trials(
        kernel, len(asked), batch.device, sizes={"short": batch.width}, width=batch.width, chunk=1
    )
    made = run(**_arm_columns(batch, leans_deg), asked=asked, turn=found.arms["turn"])
    least = made["short"][rows].amin(1)
    return torch.where(least < 1e3, -least, -torch.inf)


def _of_candidates(
    batch: _Batch, found: _Found, rows: Tensor, before: int
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """The pairs of these trials that pass the steps `before` one."""
    asked = torch.zeros_like(batch.evaluated)
    asked[rows] = True
    trial, k = torch.nonzero(found.passes[..., before - 1] & asked[:, None], as_tuple=True)
    return trial, k, batch.pairs(trial, k, found.arms)


def _overlap_of_hand(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    trial, k, pair = _of_candidates(batch, found, rows, STEPS.index("free"))
    columns = {n: pair[n] for n in _PAIR_COLUMNS}
    made = _launch(batch, kernels.overlap_of_hand, len(trial), **batch.tables, **columns)
    return _of_pairs(found.passes, trial, k, made["room"])[rows].amax(1)


def _overlap_of_person(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    trial, k, pair = _of_candidates(batch, found, rows, STEPS.index("clear"))
    posture = {n: pair[n] for n in ("trial", "lean", "elbow")}
    wrist = batch.wrists(pair).contiguous()
    made = _launch(
        batch, kernels.overlap_of_person, len(trial), **batch.robot, **posture, wrist=wrist
    )
    return _of_pairs(found.passes, trial, k, made["room"])[rows].amax(1)


def _left_of_way(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    return found.far_m[rows].amax(1) - float(kernels.WAY_M)


def _left_of_backing_off(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    return found.back_m[rows].amax(1) - float(kernels.WAY_M)


def _left_of_whole_way(
    batch: _Batch, found: _Found, rows: Int64[Tensor, " n"], leans_deg: tuple[float, ...]
) -> Float32[Tensor, " n"]:
    return -found.left_m[rows]


_LACKS: dict[str, tuple[Callable[[_Batch, _Found, Tensor, tuple[float, ...]], Tensor], MarginKind]]
_LACKS = {
    "arm": (_short_of_reach, MarginKind.DISTANCE),
    "free": (_overlap_of_hand, MarginKind.BOUND),
    "way": (_left_of_way, MarginKind.DISTANCE),
    "clear": (_overlap_of_person, MarginKind.BOUND),
    "release": (_left_of_backing_off, MarginKind.DISTANCE),
    "whole_way": (_left_of_whole_way, MarginKind.DISTANCE),
}
"""The step that leaves no grasp -> minus what the best one lacks there, m. `hold` lacks newtons, which are no length."""


def _result(batch: _Batch, found: _Found, margins: dict[str, Tensor] | None) -> Reception:
    arms, way, chosen, count = found.arms, found.way, found.chosen, found.passes.sum(1)
    received, nan = chosen >= 0, torch.nan
    if margins is None:
        unknown = torch.zeros(len(chosen), dtype=torch.int8, device=chosen.device)
        margins = {
            "margin_m": torch.full_like(chosen, nan, dtype=torch.float32),
            "margin_kind": unknown,
            "room": unknown - 1,
        }
    trial = torch.arange(len(chosen), dtype=torch.int64, device=chosen.device)
    k = chosen.clamp(min=0)
    pair = batch.pairs(trial, k, arms)
    row = pair["row"].long().clamp(max=len(batch.grasps.grip_n) - 1)
    turned = _about_axis(batch.grasps, pair["object"].long(), pair["turn"]).double()
    hand = batch.grasps.held_out.grasps.T_obj_hand.to(chosen.device)[row].double()
    T_hand = se3.matmul(se3.matmul(pair["T_world_obj"].double(), turned), hand)
    in_object = se3.matmul(pair["T_world_obj"].double(), turned)[:, :3, :3]
    comes = se3.rotate(in_object, _directions(batch.grasps, row, way[trial, k]).double())
    T_before = T_hand.clone()
    T_before[:, :3, 3] -= float(kernels.WAY_M) * comes
    relative = se3.matmul(se3.inverse(pair["T_world_hand"].double()), T_hand)[:, :3, :3]
    cosine = 0.5 * (relative.diagonal(dim1=1, dim2=2).sum(1) - 1.0)
    wrist = batch.wrists(pair)
    travel = wrist - batch.robot["receiver"][:, 2, :3]
    angles = arms["angles"][trial, k]
    score = torch.from_numpy(rula(angles.cpu().numpy().astype(np.float64))).to(chosen.device)
    return Reception(
        batch.evaluated,
        received,
        batch.known.to(torch.int16),
        count.to(torch.int16),
        torch.where(received, pair["row"] - batch.grasps.first_of(pair["object"]), -1).to(
            torch.int32
        ),
        torch.where(received, arms["effort"][trial, k], nan),
        torch.where(received, cosine.clamp(-1.0, 1.0).acos().rad2deg().float(), nan),
        torch.where(received, se3.dot(travel, travel).sqrt(), nan),
        torch.where(received[:, None], angles, nan),
        torch.where(received, score, 0).to(torch.int8),
        torch.where(received[:, None], arms["elbow"][trial, k], nan),
        torch.where(received[:, None, None], T_hand.float(), nan),
        torch.where(received[:, None, None], T_before.float(), nan),
        torch.where(received[:, None], wrist, nan),
        torch.where(received[:, None], pull_direction(arms["elbow"][trial, k], wrist), nan),
        margins["margin_m"],
        margins["margin_kind"],
        margins["room"],
        batch.of_trial["attached"],
        batch.of_trial["T_world_obj"],
        batch.of_trial["opening"],
    )


def _directions(grasps: _Grasps, row: Tensor, way: Tensor) -> Float32[Tensor, "n 3"]:
    """How hands go the last 10 cm to grasps, frame obj: `way_direction` of the kernels."""
    _, along, normal = (x[row] for x in grasps.owners[:3])
    between = normal + along
    between = between / se3.dot(between, between).sqrt()[:, None]
    which = way[:, None]
    return torch.where(which == 1, along, torch.where(which == 2, between, normal))


def _about_axis(grasps: _Grasps, objects: Tensor, angle: Tensor) -> Float32[Tensor, "n 4 4"]:
    """Turns of objects about their axes of revolution, frame obj."""
    axis, point = (
        x.to(angle.device)[objects].double()
        for x in (grasps.held_out.axis, grasps.held_out.axis_point)
    )
    s, c = (x[:, None] for x in (angle.double().sin(), angle.double().cos()))
    columns = torch.eye(3, dtype=torch.float64, device=angle.device)
    R = torch.stack(
        [
            c * e + s * se3.cross(axis, e.expand_as(axis)) + (1 - c) * (axis @ e)[:, None] * axis
            for e in columns
        ],
        2,
    )
    R = torch.where((se3.dot(axis, axis) > 0)[:, None, None], R, columns)
    return se3.from_rotation(R, point - se3.rotate(R, point)).float()


def _carry(batch: _Batch, arms: dict[str, Tensor], passes: Tensor) -> None:
    """Writes the step hold: the hands carry the object, and the object does not turn in them while they pull.

    The gripper holds on at its TCP, as a point does, until `PULL_N`; then the hand has the weight alone. The person grips
    as people do (`capacity`): firmer with the load, both sides together with 2 `GRIP_N` at most.
    """
    trial, k = torch.nonzero(passes[..., :5].all(2), as_tuple=True)
    pair = batch.pairs(trial, k, arms)
    grasps, objects, row = batch.grasps, pair["object"].long(), pair["row"].long()
    stored, T_obj = grasps.withstands, pair["T_world_obj"].double()
    # objects of revolution may be turned about their axes: the grasp goes with the hand
    T_grasp = se3.matmul(T_obj, _about_axis(grasps, objects, pair["turn"]).double())
    R = se3.matmul(T_grasp[:, :3, :3], stored["axes"][objects])
    down = -R[:, 2]
    gravity = (down @ torch.from_numpy(GRAVITY.T).to(down)).argmax(1)
    center = T_grasp[:, :3, 3] + se3.rotate(R, stored["center"][row])
    weight = torch.zeros_like(center)
    weight[:, 2] = grasps.mass[objects] * G
    pull = PULL_N * pull_direction(pair["elbow"].double(), batch.wrists(pair).double())
    com = se3.apply(T_obj, grasps.com[objects])
    tcp = se3.apply(T_obj, pair["attached"][:, :3, 3].double())
    own = torch.cat([weight, se3.cross(com - center, weight)], 1)
    pulled = own + torch.cat([pull, se3.cross(tcp - center, pull)], 1)
    size = se3.dot(pulled[:, :3], pulled[:, :3]).sqrt()
    usual, capacity = stored["total_n"][row, gravity], stored["capacity"][row, gravity]
    grip = torch.maximum(usual, GRIP_BASE_N + GRIP_PER_WEIGHT * size).clamp(max=2 * GRIP_N)
    most = AXES_SHARE * capacity * grip[:, None]
    stays = torch.ones_like(usual, dtype=torch.bool)
    for load in (own, pulled):
        along = torch.cat([se3.rotate(R.mT, part) for part in load.split(3, 1)], 1)
        stays &= (along.abs() <= most).all(1)
    passes[trial, k, 5] = stays & (grasps.grip_n[row, gravity] <= GRIP_N)


def pull_direction(
    elbow: Float64[Tensor, "n 3"], wrist: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 3"]:
    """Unit vectors along which persons pull, world; see `LIFT`."""
    along = elbow - wrist
    along = torch.cat([along[:, :2], along[:, 2:].clamp(min=0.0)], 1)
    along = along / se3.dot(along, along).sqrt()[:, None]
    along[:, 2] += LIFT
    return along / se3.dot(along, along).sqrt()[:, None]


def chance_of_one(
    passing: Shaped[NDArray[Any], " b"], known: Shaped[NDArray[Any], " b"], k: int
) -> Float64[Array, " b"]:
    """The chance that at least one of k grasps, drawn from the `known`, is one of those that pass.

    1 - C(known - passing, k) / C(known, k): what fewer known grasps would have said of a trial.

    Args:
        passing: (B,) grasps that pass.
        known: (B,) grasps that are known.
        k: how many are drawn, without replacement.
    """
    n, m = known.astype(np.float64), (known - passing).astype(np.float64)
    k_ = np.minimum(k, n)
    with np.errstate(invalid="ignore"):
        log = gammaln(m + 1) - gammaln(m - k_ + 1) - gammaln(n + 1) + gammaln(n - k_ + 1)
    return np.where(m >= k_, 1.0 - np.exp(np.where(m >= k_, log, 0.0)), 1.0) * (n > 0)


_A = np.array(
    [  # upper arm 1 to 6, lower arm 1 to 3, wrist 1 to 4, wrist twist 1 and 2
        [[[1, 2], [2, 2], [2, 3], [3, 3]], [[2, 2], [2, 2], [3, 3], [3, 3]], [[2, 3], [3, 3], [3, 3], [4, 4]]],
        [[[2, 3], [3, 3], [3, 4], [4, 4]], [[3, 3], [3, 3], [3, 4], [4, 4]], [[3, 4], [4, 4], [4, 4], [5, 5]]],
        [[[3, 3], [4, 4], [4, 4], [5, 5]], [[3, 4], [4, 4], [4, 4], [5, 5]], [[4, 4], [4, 4], [4, 5], [5, 5]]],
        [[[4, 4], [4, 4], [4, 5], [5, 5]], [[4, 4], [4, 4], [4, 5], [5, 5]], [[4, 4], [4, 5], [5, 5], [6, 6]]],
        [[[5, 5], [5, 5], [5, 6], [6, 7]], [[5, 6], [6, 6], [6, 7], [7, 7]], [[6, 6], [6, 7], [7, 7], [7, 8]]],
        [[[7, 7], [7, 7], [7, 8], [8, 9]], [[8, 8], [8, 8], [8, 9], [9, 9]], [[9, 9], [9, 9], [9, 9], [9, 9]]],
    ]
)  # fmt: skip
_B = np.array([1, 2, 3, 5])
"""RULA's posture score for trunk 1 to 4, neck 1, legs 1."""
_C = np.array(
    [
        [1, 2, 3, 3, 4, 5, 5], [2, 2, 3, 4, 4, 5, 5], [3, 3, 3, 4, 4, 5, 6], [3, 3, 3, 4, 5, 6, 6],
        [4, 4, 4, 5, 6, 7, 7], [4, 4, 5, 6, 6, 7, 7], [5, 5, 6, 6, 7, 7, 7], [5, 5, 6, 7, 7, 7, 7],
    ]
)  # fmt: skip

ABDUCTED_DEG, STRAIGHT_DEG, TWISTED_DEG = 30.0, 5.0, 60.0
"""RULA names no angles for an abducted arm, for a wrist in neutral and for a forearm near the end of its
range [choice]."""


def rula(angles_deg: Float64[Array, "n 7"]) -> Int8[NDArray[np.int8], " n"]:
    """RULA's grand score of arms: neck and legs 1, no load, no repetition.

    Args:
        angles_deg: (N, 7) `ANGLES`.

    Source:
        McAtamney and Corlett 1993, Applied Ergonomics 24(2), tables A, B and C.
    """
    flexion, abduction, elbow, twist, wrist, deviation, lean = angles_deg.T
    upper = 1 + ((flexion > 20) | (flexion < -20)) + (flexion > 45) + (flexion > 90)
    upper = upper + (abduction > ABDUCTED_DEG)
    lower = np.where((elbow >= 60) & (elbow <= 100), 1, 2)
    bent = 1 + (abs(wrist) > STRAIGHT_DEG) + (abs(wrist) > 15) + (abs(deviation) > STRAIGHT_DEG)
    turned = np.where(abs(twist) > TWISTED_DEG, 2, 1)
    trunk = 1 + (lean > 0) + (lean > 20) + (lean > 60)
    arm = _A[np.minimum(upper, 6) - 1, lower - 1, np.minimum(bent, 4) - 1, turned - 1]
    return _C[np.minimum(arm, 8) - 1, _B[trunk - 1] - 1].astype(np.int8)
