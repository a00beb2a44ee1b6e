"""Intent-Handover (Zhang et al. 2026): the grasp opposed to and near the hand that the instruction
asks for; docs/baselines.md.

Grasp: of the candidates that fit the gripper and whose approach axis does not first meet the region
named by the instruction, the least A(g) = cos(v_g, v_h) - |p_g - p_h|, as published (metres; the
hand is the one retrieved for the instruction, on the object). Pose: the object's centre 15 cm above the target
palm; hand, object and gripper are turned as one, so that the retrieved hand lies as the target hand
turned 15 degrees inward in its palm plane (`orientation="transform"`), or the gripper alone is
opposed to that direction ("axis").
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.methods import approach_hit
from r2h_batch.methods.batches import answers, part_of
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.fc import opposition
from r2h_batch.methods.from_table import chosen_candidate
from r2h_batch.methods.gate import Gate, first_fit, let_through, passing
from r2h_batch.methods.placing import (
    HEIGHT_M,
    allowed_else_usable,
    approach_frames,
    check_choice,
    home_x,
    placed_above_palm,
    roll_angles,
    rolled,
    turned_inward,
    unit,
)
from r2h_batch.methods.predictors import (
    Observations,
    PredictorNoise,
    ReceivingHand,
    TargetHand,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.holding.instructions import ANYWHERE, intents_of, understand
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Intent-Handover", "retrieval"

ROLLS = 8
"""Turns about the approach axis that are tried: the paper fixes none (baselines.md)."""

INWARD_DEG = 15.0
"""Published. Inward is towards the thumb here: the paper does not say which way."""

CLEARANCE_M = 0.0
"""Distance that the gripper and the target hand must keep with gate `hand`: touching is a
collision, no clearance is required."""

BACK_OFF_M = 0.10
"""The approach ray starts this far behind the TCP: inside the gripper's body, where a candidate has
no material."""


Select = Literal["published", "FS", "A1", "A2", "A3"]
"""published: as the paper says it. FS: as the authors' program does: distances from the mean of the
hand's skin, and a grasp whose axis misses the object is out. Its ablations: A1 without the region,
A2 without the ranking (the first candidate that is left), A3 without both."""

Place = Literal["object", "gripper", "ergonomic"]
"""`placing.Anchor`, or where the receiver's arm suggests (`ergonomic_pose`)."""

EXTENSION_DEG = 15.0
"""Extension of the wrist in `ergonomic_pose` (published)."""

Orientation = Literal["transform", "axis"]
"""transform: the predicted hand and the gripper keep their places on the object (the original's
fixed hand-to-gripper transform). axis: the gripper's approach axis against the hand's direction,
its roll searched."""

IntentGate = Literal["own", Gate]
"""`gate.Gate`, or own: nothing with orientation `transform`, the gate `hand` with `axis`. With
`axis` the gate chooses among the rolls of the best grasp. Otherwise a grasp has one pose, and the
gate chooses among the grasps."""


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    instructions: Sequence[str] | None = None,
    rolls: int = ROLLS,
    height_m: float = HEIGHT_M,
    inward_deg: float = INWARD_DEG,
    clearance_m: float = CLEARANCE_M,
    back_off_m: float = BACK_OFF_M,
    orientation: Orientation = "transform",
    gate: IntentGate = "own",
    at: Place = "object",
    select: Select = "published",
) -> Predictions:
    """One grasp and handover pose a trial.

    Args:
        trials: N trials.
        scene: objects, hands and robot: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: errors of what the method sees; None: `PredictorNoise()`.
        seen: answers of your own networks, in place of the stand-ins.
        T_world_obj: (N, 4, 4) where the objects rest when a trial begins on the table, m; the method then takes the best grasp
            that the arm can pick there. None: a trial begins with the object in the gripper.
        instructions: one sentence a trial; None: each object's own.
        rolls: with orientation `axis`: turns about the approach axis that are tried.
        height_m: how far what `at` names stands above the palm.
        inward_deg: turn in the palm's plane towards the thumb, degrees.
        clearance_m: with gate `hand`: what gripper and estimated hand must keep.
        back_off_m: how far behind the TCP the approach ray starts.
        orientation: what is turned (`Orientation`).
        gate: what a pose must pass (`IntentGate`).
        at: what stands above the palm; `ergonomic`: the object goes where the receiver's shoulders
            and arm suggest (receivers with a body).
        select: which rules choose the grasp (`Select`).

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.

    Raises:
        ValueError: the number of instructions is not N, or `ergonomic` without bodies.
    """
    check_choice("orientation", orientation, Orientation)
    check_choice("select", select, Select)
    check_choice("at", at, Place)
    check_choice("gate", gate, IntentGate)
    if at == "ergonomic" and trials.receiver is None:
        raise ValueError(
            "at is 'ergonomic': these trials have no bodies; take a benchmark of people"
        )
    table, w_max = candidate_table(scene), scene.config.thresholds.w_max_m
    if instructions is not None and len(instructions) != len(trials):
        raise ValueError(
            f"{len(instructions)} instructions for {len(trials)} trials; give one for each, or None"
        )
    place = scene.config.workplace
    table_m = place.table_center[2] + place.table_half[2]
    named = named_parts(scene, trials, instructions).to(scene.device)
    hit_part, hit_region, hits = approach_hits(scene, back_off_m)

    def choose(part: Trials, rows_of: slice) -> tuple[Tensor, Tensor]:
        texts = None if instructions is None else instructions[rows_of]
        taking = retrieve_receiving(part, scene, texts, seed=seed, noise=noise, seen=seen)
        target = predict_target(part, scene, seed=seed, noise=noise, seen=seen)
        rows, exists = table.rows(part.object_index)
        # The receiver's grasp is what the instruction names: a robot grasp whose approach axis
        # enters that part there is out
        in_region = hit_region[rows] & named[rows_of].gather(1, hit_part[rows])
        fits = table.width_m[rows] <= w_max
        if select in ("published", "FS", "A2"):
            fits = fits & ~in_region
        if select != "published":
            fits = fits & hits[rows]
        hand = taking.palm_point if select == "published" else taking.vertices.double().mean(1)
        score = affordance_score(table.T_obj_ee[rows], taking.wrist_to_middle, hand)
        if select in ("A2", "A3"):
            score = torch.zeros_like(score)  # of equals the first

        def posed(T_obj_ee: Tensor) -> Tensor:
            """The one pose of a grasp of each trial; the rolls of it with orientation `axis`."""
            if at == "ergonomic":
                assert part.receiver is not None
                T_world_obj = ergonomic_pose(part.receiver, taking.wrist_to_middle, table_m)
                return se3.matmul(T_world_obj, T_obj_ee.double()).float()[:, None]
            if orientation == "transform":
                R = moved_with_the_hand(taking, target, T_obj_ee, inward_deg)[:, None]
            # the gripper comes against the hand's own direction, turned towards the thumb; home's x
            # is the roll's zero
            else:
                approach = turned_inward(
                    -target.wrist_to_middle, target.palm_normal, target.side, inward_deg
                )
                R = rolled(approach_frames(approach, home_x(scene)), roll_angles(rolls))
            return placed_above_palm(scene, R, T_obj_ee, part.object_index, target, height_m, at)

        turns = orientation == "axis" and at != "ergonomic"
        asked: Gate = ("hand" if turns else "none") if gate == "own" else gate
        allowed = fits & exists
        if asked != "none" and not turns:
            candidates = table.T_obj_ee[rows]
            T = torch.cat([posed(candidates[:, k]) for k in range(candidates.shape[1])], 1)
            passes, reached = passing(
                scene, T, table.opening_m[rows], target.vertices, clearance_m, gate=asked
            )
            allowed = let_through(passes, reached, allowed)
        T_obj_ee, opening = chosen_candidate(
            scene,
            part,
            part_of(T_world_obj, rows_of),
            allowed_else_usable(allowed, exists),
            score,
        )
        poses = posed(T_obj_ee)
        if not turns:
            return T_obj_ee, poses[:, 0].contiguous()
        return T_obj_ee, first_fit(scene, poses, opening, target.vertices, clearance_m, gate=asked)

    return answers(trials, scene, "intent", choose)


def moved_with_the_hand(
    taking: ReceivingHand, target: TargetHand, T_obj_ee: Float32[Tensor, "b 4 4"], inward_deg: float
) -> Float[Tensor, "b 3 3"]:
    """R_world_ee that keeps hand and gripper as they are on the object, when the hand on the object
    is turned to lie as the target hand (palm normal and fingers' direction), `inward_deg` towards
    the thumb about its palm normal."""
    fingers = turned_inward(target.wrist_to_middle, target.palm_normal, target.side, inward_deg)
    # z out of the palm, x along the fingers
    R_world_palm = approach_frames(target.palm_normal, fingers)
    R_obj_palm = approach_frames(taking.palm_normal, taking.wrist_to_middle)
    return se3.matmul(R_world_palm, se3.matmul(R_obj_palm.mT, T_obj_ee[:, :3, :3].double()))


def ergonomic_pose(
    receiver: Float32[Tensor, "b 5 4"], direction: Float[Tensor, "b 3"], table_m: float
) -> Float[Tensor, "b 4 4"]:
    """(b, 4, 4) T_world_obj, float64: the object in front of the receiver, as far as a bent arm
    reaches, turned so that the hand lies on it as an extended wrist would.

    The authors' formulas. The origin of the object's frame stands at c_t + r f: c_t lies below the
    middle of the shoulders, halfway to the table; f is where the chest faces; r is the hypotenuse of
    |elbow - middle of the shoulders| and the forearm. The least rotation takes the hand's direction
    (frame obj) to the forearm's, extended by 15 degrees. Our choice: extension is upwards, in the
    forearm's vertical plane.

    Args:
        receiver: as `Trials.receiver`, world frame.
        direction: of the predicted hand on the object, from the wrist to the middle finger.
        table_m: height of the table's top.
    """
    given = receiver.double()
    shoulder, elbow, wrist, torso = given[:, :4, :3].unbind(1)
    zero = torch.zeros_like(given[:, 0, 0])
    facing = torch.stack([given[:, 3, 3], given[:, 4, 3], zero], 1)
    middle = torch.cat([torso[:, :2], shoulder[:, 2:]], 1)
    upper, fore = elbow - middle, wrist - elbow
    reach = (se3.dot(upper, upper) + se3.dot(fore, fore)).sqrt()
    below = torch.cat([middle[:, :2], (middle[:, 2:] + table_m) / 2], 1)
    forward = unit(fore)
    up = torch.stack([zero, zero, zero + 1.0], 1)
    aside = unit(se3.cross(forward, up))
    raised = se3.cross(aside, forward)
    c, s = (round(f(math.radians(EXTENSION_DEG)), 15) for f in (math.cos, math.sin))
    R = least_rotation(unit(direction.double()), c * forward + s * raised)
    return se3.from_rotation(R, below + reach[:, None] * facing)


def least_rotation(a: Float[Tensor, "b 3"], b: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """(b, 3, 3) the smallest turn that takes unit vectors a to b; about any perpendicular axis if
    they are opposed."""
    cosine = se3.dot(a, b)
    spare = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).double()
    spare = unit(spare - se3.dot(spare, a)[:, None] * a)
    # two reflections: a to b is a turn in their plane by twice the angle from a to the half vector
    half = a + b
    half = unit(torch.where((cosine > -1 + 1e-12)[:, None], half, spare))
    eye = torch.eye(3, dtype=torch.float64, device=a.device)
    first = eye - 2 * a[:, :, None] * a[:, None, :]
    second = eye - 2 * half[:, :, None] * half[:, None, :]
    return se3.matmul(second, first)


def affordance_score(
    T_obj_ee: Float[Tensor, "b k 4 4"],
    direction: Float[Tensor, "b 3"],
    palm_point: Float[Tensor, "b 3"],
) -> Float[Tensor, "b k"]:
    """A(g) = cos(v_g, v_h) - |p_g - p_h| in metres: the chosen grasp has the least (opposed to the
    hand, and far from it)."""
    apart = T_obj_ee[..., :3, 3].double() - palm_point.double()[:, None]
    return opposition(T_obj_ee[..., :3, 2], direction) - se3.dot(apart, apart).sqrt()


@KeptWith
def approach_hits(
    scene: Scene, back_off_m: float = BACK_OFF_M
) -> tuple[Int64[Tensor, " m"], Bool[Tensor, " m"], Bool[Tensor, " m"]]:
    """For every row of the candidate table: the part that its approach axis meets first, whether a
    receiver may take it there (False too where the axis meets nothing), and whether it meets the
    object."""
    table = candidate_table(scene)
    face = torch.empty(len(table.T_obj_ee), dtype=torch.int32, device=scene.device)
    launch_trials(
        approach_hit.approach_hits,
        len(face),
        inputs={
            "back_off": back_off_m,
            "cutoff": 1.0,
            "mesh": scene.object_mesh_ids,
            "object": table.object_index,
            "T_obj_ee": table.T_obj_ee,
        },
        outputs={"face": face},
        device=scene.device,
        chunk=64,
    )
    part, region = np.zeros(len(face), np.int64), np.zeros(len(face), bool)
    for row, (o, f) in enumerate(zip(table.object_index.tolist(), face.tolist(), strict=True)):
        model = scene.objects[o]
        if f >= 0:
            part[row] = model.face_part[f]
            region[row] = model.receiver_face[f] or not model.receiver_face.any()
    first, taken_there = (torch.from_numpy(x).to(scene.device) for x in (part, region))
    return first, taken_there, face >= 0


def named_parts(
    scene: Scene, trials: Trials, instructions: Sequence[str] | None
) -> Bool[Tensor, "n p"]:
    """The part labels of the region R_o that each trial's instruction names. Where it names the object alone: the
    receiver's region (S1), or none."""
    index, region = trials.object_index.cpu().long(), _regions(scene)
    if instructions is None:
        own = [region(i, o.instruction) for i, o in enumerate(scene.objects)]
        return torch.stack(own)[index]
    pairs = list(zip(index.tolist(), instructions, strict=True))
    # Each sentence is understood once however many trials ask it: (object, sentence) -> row of
    # `regions`
    number = {pair: k for k, pair in enumerate(dict.fromkeys(pairs))}
    regions = torch.stack(
        [region(*pair) for pair in number] or [region(0, scene.objects[0].instruction)]
    )
    return regions[torch.tensor([number[pair] for pair in pairs], dtype=torch.int64, device="cpu")]


@KeptWith
def _regions(scene: Scene) -> Callable[[int, str], Bool[Tensor, " p"]]:
    """`_region` of a scene's objects, each sentence understood once."""
    return lru_cache(maxsize=65536)(partial(_region, scene.objects))


def _region(
    objects: Sequence[ObjectModel], object_index: int, instruction: str
) -> Bool[Tensor, " p"]:
    parts = max(len(o.part_names) for o in objects)
    region = torch.zeros(parts, dtype=torch.bool, device="cpu")
    understood = understand(instruction, objects, object_index=object_index)
    model = objects[object_index]
    intent = intents_of(model)[understood.intent]
    if intent.part != ANYWHERE or model.split == "S1":
        region[list(intent.labels)] = True
    return region
