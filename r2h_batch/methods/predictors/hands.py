"""Hands as a method sees them: the receiver's hand on the object, and the target hand in the
world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float32, Int8, Int64
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.errors import UsageError
from r2h_batch.methods.predictors.external_predictions import ExternalHands, Observations
from r2h_batch.scene.hand import HandGeometry, HandModel, palm_frame
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.holding.instructions import intents_of, understand
from r2h_batch.trials.holding.receiving import ReceivingGrasps, load_receiving
from r2h_batch.trials.holding.sampler import NoHoldError
from r2h_batch.trials.noise import PredictorNoise, estimated_hand, perturbed, trial_ids
from r2h_batch.types import Trials
from r2h_batch.verdicts import SIDES

MIDDLE_TIP = 1  # in HandModel.tip_vertices
_GRASP, _RECEIVING = 0, 1  # purposes of the random counters; 2, 3: trials/noise.py


@dataclass(frozen=True, eq=False)
class _SeenHand:
    """N hands: row of a bank of posed hands, and where each stands in a frame (obj or world),
    metres."""

    bank: HandGeometry
    row: Int64[Tensor, " n"]
    side: Int8[Tensor, " n"]
    """0 right, 1 left"""
    T: Float32[Tensor, "n 4 4"]
    model: HandModel

    def __len__(self) -> int:
        return len(self.row)

    @cached_property
    def joints(self) -> Float32[Tensor, "n 16 3"]:
        """MANO's 16 joints."""
        return se3.apply(self.T[:, None], self.bank.joints[self.row])

    @cached_property
    def vertices(self) -> Float32[Tensor, "n v 3"]:
        """The skin; made at first use (16 KB a trial). Faces: `model.faces_by_side[side]`."""
        return se3.apply(self.T[:, None], self.bank.vertices[self.row])

    @cached_property
    def _palm(self) -> tuple[Tensor, Tensor]:
        return palm_frame(self.joints, self.side)

    @property
    def palm_point(self) -> Float32[Tensor, "n 3"]:
        """p_h: mean of wrist and the four finger roots."""
        return self._palm[0]

    @property
    def palm_normal(self) -> Float32[Tensor, "n 3"]:
        """n_h: unit normal out of the palm."""
        return self._palm[1]

    @cached_property
    def wrist_to_middle(self) -> Float32[Tensor, "n 3"]:
        """Unit vector from the wrist to the tip of the middle finger."""
        tip = int(self.model.tip_vertices[MIDDLE_TIP])
        d = se3.apply(self.T, self.bank.vertices[self.row, tip]) - self.joints[:, 0]
        return d / (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]).sqrt()[:, None]


@dataclass(frozen=True, eq=False)
class ReceivingHand(_SeenHand):
    """The receiver's hand on the object as predicted, frame obj."""

    grasp: Int64[Tensor, " n"]
    """the drawn row of `load_receiving` for the scene's objects and hand; -1: a network's own"""

    @property
    def T_obj_hand(self) -> Float32[Tensor, "n 4 4"]:
        """Where the hand stands in the object's frame."""
        return self.T


@dataclass(frozen=True, eq=False)
class TargetHand(_SeenHand):
    """The hand that the object is brought to, as estimated, frame world."""

    reach_offset_m: float

    @property
    def T_world_hand(self) -> Float32[Tensor, "n 4 4"]:
        """Where the hand stands in the world."""
        return self.T

    @property
    def ball_center(self) -> Float32[Tensor, "n 3"]:
        """c_h = p_h + 0.12 n_h of the estimated hand."""
        return self.palm_point + self.reach_offset_m * self.palm_normal


def predict_receiving(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
) -> ReceivingHand:
    """A receiving grasp of each trial's object and hand side, with the error model.

    Args:
        trials: N trials.
        scene: objects and hand model: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: deviations of the error model; None: `PredictorNoise()`.
        seen: answers of your own network instead, where it has some.

    Returns:
        N hands in the object's frame.
    """
    if seen is not None and seen.receiving is not None:
        return _given(trials, scene, seen.receiving)
    grasps = load_receiving(scene.objects, scene.hands.model)
    fits = torch.ones((len(scene.objects), 1, len(grasps)), dtype=torch.bool, device="cpu")
    wanted = torch.zeros(len(trials), dtype=torch.int64, device="cpu")
    return _drawn(trials, scene, grasps, fits, wanted, seed, noise)


def retrieve_receiving(
    trials: Trials,
    scene: Scene,
    instructions: Sequence[str] | None = None,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
) -> ReceivingHand:
    """A receiving grasp that answers each trial's instruction, with the error model.

    Args:
        trials: N trials.
        scene: objects and hand model: `Evaluator.scene`.
        instructions: one sentence a trial (`instructions.understand`); None: each object's own.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: deviations of the error model; None: `PredictorNoise()`.
        seen: answers of your own network instead.

    Returns:
        N hands in the object's frame.

    Raises:
        UsageError: a sentence names another object, or a part that the receiver does not
            take; or there are not N of them.
    """
    if seen is not None and seen.receiving is not None:
        return _given(trials, scene, seen.receiving)
    object_index = trials.object_index.cpu().tolist()
    texts = (
        [scene.objects[i].instruction for i in object_index]
        if instructions is None
        else list(instructions)
    )
    if len(texts) != len(trials):
        raise UsageError(
            f"{len(texts)} instructions for {len(trials)} trials; give one for each, or None"
        )
    grasps = load_receiving(scene.objects, scene.hands.model)
    most = max(len(intents_of(o)) for o in scene.objects)
    fits = torch.zeros((len(scene.objects), most, len(grasps)), dtype=torch.bool, device="cpu")
    for i, model in enumerate(scene.objects):
        for k, intent in enumerate(intents_of(model)):
            labels = torch.tensor(intent.labels, dtype=torch.uint8, device="cpu")
            fits[i, k] = torch.isin(grasps.part, labels)
    answer = {
        pair: understand(pair[1], scene.objects, object_index=pair[0]).intent
        for pair in dict.fromkeys(zip(object_index, texts, strict=True))
    }
    rows = [answer[pair] for pair in zip(object_index, texts, strict=True)]
    wanted = torch.tensor(rows, dtype=torch.int64, device="cpu")
    return _drawn(trials, scene, grasps, fits, wanted, seed, noise)


def _drawn(
    trials: Trials,
    scene: Scene,
    grasps: ReceivingGrasps,
    fits: Tensor,
    wanted: Tensor,
    seed: int,
    noise: PredictorNoise | None,
) -> ReceivingHand:
    """Grasps of the object and side with `fits[object, wanted]`, all equally likely, then the
    error."""
    noise = PredictorNoise() if noise is None else noise
    ids, device = trial_ids(trials.trial_id), trials.trial_id.device
    key = rng.key_of(f"receiving hand {seed}")
    side = scene.hands.set.side.to(torch.int8)[trials.hand_index.cpu().long()]
    table, number = _rows(grasps, fits)
    at = (trials.object_index.cpu().long(), side.long(), wanted)
    if not bool((number[at] > 0).all()):
        i = int(torch.nonzero(number[at] == 0)[0, 0])
        name = scene.objects[int(trials.object_index[i])].name
        raise NoHoldError(
            f"{name}: no receiving grasp of a {SIDES[int(side[i])]} hand was found; leave its trials out"
        )
    (u,) = rng.uniforms(key, ids, 1, purpose=_GRASP)
    drawn = torch.from_numpy(rng.choice(u, number[at].numpy()))
    grasp = table[at][torch.arange(len(ids), dtype=torch.int64, device="cpu"), drawn]
    point, _ = palm_frame(grasps.posed.joints, grasps.side)
    T = perturbed(
        grasps.T_obj_hand[grasp], point[grasp], ids, key, purpose=_RECEIVING,
        rotation_deg=noise.receiving_rotation_deg, translation_m=noise.receiving_translation_m,
    )  # fmt: skip
    bank = HandGeometry(grasps.posed.vertices.to(device), grasps.posed.joints.to(device))
    row = grasp.to(device)
    return ReceivingHand(bank, row, side.to(device), T.to(device), grasps.hand, row)


def _rows(grasps: ReceivingGrasps, fits: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of `grasps` for (object, side, choice), padded (O, 2, C, L), and how many; where nothing
    fits, all do."""
    of_object = torch.stack([grasps.object_index == i for i in range(len(fits))])
    fitting = of_object[:, None] & torch.stack([grasps.side == s for s in (0, 1)])
    kept = fitting[:, :, None] & fits[:, None]
    kept = torch.where(kept.any(-1, keepdim=True), kept, fitting[:, :, None].expand_as(kept))
    number = kept.sum(-1)
    order = torch.argsort((~kept).to(torch.uint8), dim=-1, stable=True)
    return order[..., : int(number.max())], number


def _given(trials: Trials, scene: Scene, hands: ExternalHands) -> ReceivingHand:
    """A network's hands on the objects."""
    device = trials.trial_id.device
    side = scene.hands.set.side.to(torch.int8)[trials.hand_index.cpu().long()]
    bank, T = hands.hands(trials, scene.hands.model, side)
    row = torch.arange(len(trials), dtype=torch.int64, device=device)
    on = HandGeometry(bank.vertices.to(device), bank.joints.to(device))
    where = side.to(device), T.to(device)
    return ReceivingHand(on, row, *where, scene.hands.model, torch.full_like(row, -1))


def predict_target(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
) -> TargetHand:
    """Each trial's real hand as an estimator sees it, with the error model.

    Args:
        trials: N trials.
        scene: hands: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: deviations of the error model; None: `PredictorNoise()`.
        seen: answers of your own network instead, where it has some.

    Returns:
        N hands in the world.
    """
    noise = PredictorNoise() if noise is None else noise
    hands, device = scene.hands, trials.trial_id.device
    offset_m = scene.config.thresholds.reach_offset_m
    if seen is not None and seen.target is not None:
        it = _given(trials, scene, seen.target)
        return TargetHand(it.bank, it.row, it.side, it.T, it.model, offset_m)
    row = trials.hand_index.long()
    true = trials.trial_id, trials.hand_index, trials.T_world_hand
    T = estimated_hand(scene, *true, seed=seed, noise=noise)
    bank = HandGeometry(hands.vertices.to(device), hands.joints.to(device))
    side = hands.set.side.to(device, torch.int8)[row]
    return TargetHand(bank, row, side, T, hands.model, offset_m)
