"""How a receiver's hand may hold each object: frozen receiving grasps, the ground truth that
predictors estimate."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int8, Int32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.data.people import people_hand
from r2h_batch.scene.arrays import arrays_digest, stored_arrays
from r2h_batch.scene.hand import HandGeometry, HandModel, load_hand
from r2h_batch.scene.objects import (
    ObjectModel,
    load_objects,
    object_digest,
    stored_arrays_of,
)
from r2h_batch.trials.holding.instructions import intents_of
from r2h_batch.trials.holding.sampler import PER_SIDE, NoHoldError, sample_receiving
from r2h_batch.verdicts import SIDES

CONTACT_M = 0.005
"""A digit or the palm is in contact when a point of its palmar skin is this near to the surface."""
PENETRATION_M = 0.005
"""No point of the hand is deeper in the object, and no point of the object deeper in the hand."""

SAME_M, SAME_POSED = 1e-6, 16
"""By how much a skin may be off the built-in hand's to be the same hand, and in how many random
postures it is asked."""

CODE = (
    *(
        f"r2h_batch.trials.holding.{name}"
        for name in ("hand_closing", "hand_contact", "instructions", "sampler")
    ),
    *(f"r2h_batch.scene.{name}" for name in ("hand", "solid", "vocabulary")),
    *(
        "r2h_batch.kernels.options",
        "r2h_batch.kernels.receiver",
        "r2h_batch.kernels.geometry.mesh_distance",
    ),
)
VERSIONS = ("numpy", "scipy", "torch", "trimesh", "warp-lang")
"""Modules and distributions that make receiving grasps. Another of them makes every one again."""

FORM = {
    "side": ArraySpec("int8", ("holds",)),
    "T_obj_hand": ArraySpec("float32", ("holds", 4, 4)),
    "pose": ArraySpec("float32", ("holds", 48)),
    "shape": ArraySpec("float32", ("holds", 10)),
    "part": ArraySpec("uint8", ("holds",)),
}
FIELDS = tuple(FORM)


@dataclass(frozen=True, eq=False)
class ReceivingGrasps:
    """M receiving grasps, object by object, right hands before left ones; hands as in `hand.py`,
    metres."""

    object_index: Int32[Tensor, " m"]
    side: Int8[Tensor, " m"]
    """0 right, 1 left"""
    T_obj_hand: Float32[Tensor, "m 4 4"]
    pose: Float32[Tensor, "m 48"]
    shape: Float32[Tensor, "m 10"]
    part: UInt8[Tensor, " m"]
    """the part of the object that the hand touches most, index into `part_names`"""
    instruction: Int32[Tensor, " m"]
    """which of the object's intents (`instructions.intents_of`) the grasp answers first"""
    hand: HandModel
    """whose hands they are"""

    def __len__(self) -> int:
        return len(self.side)

    def __getitem__(self, rows: slice | Tensor) -> ReceivingGrasps:
        """The selected rows; `rows` is a slice, an index tensor or a mask."""
        return ReceivingGrasps(
            **{k: getattr(self, k)[rows] for k in ("object_index", *FIELDS, "instruction")},
            hand=self.hand,
        )

    @cached_property
    def posed(self) -> HandGeometry:
        """Skins and joints in the hands' own frames; made at first use (16 KB a grasp)."""
        return self.hand.pose(self.pose, self.shape, self.side)

    @cached_property
    def joints(self) -> Float32[Tensor, "m 16 3"]:
        """Joints in the object's frame."""
        return se3.apply(self.T_obj_hand[:, None], self.posed.joints)

    @cached_property
    def vertices(self) -> Float32[Tensor, "m v 3"]:
        """Skins in the object's frame."""
        return se3.apply(self.T_obj_hand[:, None], self.posed.vertices)

    def rows_of(
        self, object_index: int, side: int | None = None, part: int | None = None
    ) -> Tensor:
        """Row numbers of an object's grasps, optionally of one side and one part."""
        kept = self.object_index == object_index
        if side is not None:
            kept = kept & (self.side == side)
        if part is not None:
            kept = kept & (self.part == part)
        return torch.nonzero(kept)[:, 0]


@lru_cache(maxsize=8)
def _load(objects: tuple[ObjectModel, ...], hand: HandModel) -> ReceivingGrasps:
    every = [_of_object(o, hand) for o in objects]
    index = np.repeat(np.arange(len(objects), dtype=np.int32), [len(e["side"]) for e in every])
    columns = {k: torch.from_numpy(np.concatenate([e[k] for e in every])) for k in FIELDS}
    intent = [_intents(o, e["part"]) for o, e in zip(objects, every, strict=True)]
    return ReceivingGrasps(
        torch.from_numpy(index),
        **columns,
        instruction=torch.from_numpy(np.concatenate(intent)),
        hand=hand,
    )


def _intents(model: ObjectModel, part: NDArray[np.uint8]) -> NDArray[np.int32]:
    """The first intent that wants the part each grasp holds."""
    first = {
        label: k
        for k, intent in reversed(list(enumerate(intents_of(model))))
        for label in intent.labels
    }
    return np.array([first.get(int(p), len(intents_of(model)) - 1) for p in part], np.int32)


def load_receiving(
    objects: Sequence[ObjectModel] | None = None, hand: HandModel | None = None
) -> ReceivingGrasps:
    """Receiving grasps of objects, `object_index` counting them in order.

    Those of the built-in objects are stored on the built-in hand and on that of the built-in people, those of the
    families' instances on the latter. For other objects and hands they are sampled once (seconds an object) and kept
    on disk (`io.cache`).

    Args:
        objects: None: the 16 built-in ones.
        hand: the hand's model; None: the built-in one.
    """
    return _load(
        tuple(load_objects() if objects is None else objects), load_hand() if hand is None else hand
    )


def without_receiving(objects: Sequence[ObjectModel], hand: HandModel) -> list[tuple[int, int]]:
    """(index, side) of the objects that no receiving grasp of this side was found for."""
    grasps = load_receiving(objects, hand)
    return [
        (i, side)
        for i in range(len(objects))
        for side in (0, 1)
        if not bool(((grasps.object_index == i) & (grasps.side == side)).any())
    ]


def receiving_digest(grasps: ReceivingGrasps | None = None) -> str:
    """sha256 (hex) over every array's name, type, shape and bytes."""
    grasps = load_receiving() if grasps is None else grasps
    return arrays_digest({k: getattr(grasps, k).cpu().numpy() for k in ("object_index", *FIELDS)})


@lru_cache(maxsize=16)
def _is_built_in_hand(hand: HandModel) -> bool:
    """Whether a hand has the built-in one's skin, to `SAME_M` in `SAME_POSED` postures and shapes:
    the same hand from a file of another layout must not be shown other receiving grasps, which
    other digits of its numbers would make of it."""
    built_in = load_hand()
    if hand is built_in:
        return True
    if (
        not torch.equal(hand.faces, built_in.faces)
        or hand.vertices.shape != built_in.vertices.shape
    ):
        return False
    rng = np.random.Generator(np.random.Philox(key=13))
    pose, shape = (
        torch.from_numpy(rng.normal(0, s, (SAME_POSED, n))) for s, n in ((0.5, 48), (1.0, 10))
    )
    side = torch.arange(SAME_POSED, dtype=torch.int8, device="cpu") % 2
    return bool(
        (hand.pose(pose, shape, side).vertices - built_in.pose(pose, shape, side).vertices)
        .abs()
        .max()
        < SAME_M
    )


@lru_cache(maxsize=256)
def _of_object(model: ObjectModel, hand: HandModel) -> dict[str, NDArray[Any]]:
    if (turn := model.who.turn) is not None:
        own = _of_object(turn.own, hand)
        return {**own, "T_obj_hand": turn.poses(own["T_obj_hand"])}
    hand = load_hand() if _is_built_in_hand(hand) else hand
    stored = (
        _stored() if hand is load_hand() else _stored_of_people() if hand is people_hand() else {}
    )
    if f"{(key := model.who.key)}/side" in stored:
        return {k: stored[f"{key}/{k}"] for k in FIELDS}

    def make() -> dict[str, NDArray[Any]]:
        try:
            return sample_receiving(model, hand=hand)
        except NoHoldError:
            return {k: _stored()[f"{load_objects()[0].name}/{k}"][:0] for k in FIELDS}

    made = cached("receiving", _made_of(model, hand), make, FORM)
    wanted = {side: PER_SIDE - int((made["side"] == side).sum()) for side in (0, 1)}
    for side, missing in wanted.items():
        if missing > 0:
            warnings.warn(
                f"{model.name}: {PER_SIDE - missing} of {PER_SIDE} {SIDES[side]} receiving grasps found; a hand must be able to "
                "hold the receiver's region (S1) or some part (S0) between thumb and fingers",
                stacklevel=2,
            )
    return {k: made[k] for k in FIELDS}


def _made_of(model: ObjectModel, hand: HandModel) -> str:
    """sha256 (hex) over all that an object's receiving grasps come from: object, hand, the code,
    what it is built on."""
    digest = hashlib.sha256(
        f"{object_digest(model)} {hand.digest} {code_digest(CODE, VERSIONS)}".encode()
    )
    return digest.hexdigest()


@lru_cache(maxsize=1)
def _stored_of_people() -> dict[str, NDArray[Any]]:
    """The same of the hand of `data/people.py`; the instances of families are stored with this hand alone."""
    return stored_arrays_of("receiving.npz", "people")


@lru_cache(maxsize=1)
def _stored() -> dict[str, NDArray[Any]]:
    return stored_arrays("receiving", "receiving.npz")
