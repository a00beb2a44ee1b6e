"""The 100 grasp candidates that a method may choose from: stored for the built-in objects, sampled
for a user's."""

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.base.io.progress import busy
from r2h_batch.judge.grasp import close_gripper
from r2h_batch.methods.grasps import ENOUGH as SAMPLED
from r2h_batch.methods.grasps import (
    Candidates,
    NoGraspError,
    carrier,
    generate_grasps,
    own_grasps,
    sample_grasps,
    seat_grasps,
)
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.objects import (
    ObjectModel,
    load_objects,
    object_digest,
    stored_arrays_of,
)
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene

CandidateKind = Literal["filtered", "as-generated", "narrow"]
"""As `EvalConfig.candidates` says it: what this evaluator's own gripper can hold; whatever is
proposed; or of the first those across which the whole object fits between the pads (all where none
does)."""

STORED: dict[CandidateKind, str] = {
    "filtered": "grasps.npz",
    "as-generated": "grasps_as_generated.npz",
}

CODE = (
    *("r2h_batch.methods.box_grasps", "r2h_batch.methods.grasps", "r2h_batch.judge.grasp"),
    *("r2h_batch.scene.grasp_set", "r2h_batch.scene.grasp_tables", "r2h_batch.scene.robot"),
    *(
        "r2h_batch.kernels.options",
        "r2h_batch.kernels.methods.antipodal",
        "r2h_batch.kernels.robot.gripper",
    ),
    *("r2h_batch.kernels.grasp", "r2h_batch.kernels.geometry"),
)
VERSIONS = ("numpy", "scipy", "torch", "warp-lang")
"""Modules and distributions that make candidates. Another of them makes every one again."""

FORM = {
    "T_obj_ee": ArraySpec("float32", ("grasps", 4, 4)),
    "width": ArraySpec("float32", ("grasps",)),
    "score": ArraySpec("float32", ("grasps",)),
    "part": ArraySpec("uint8", ("grasps",)),
    "region_m": ArraySpec("float32", ("grasps",), gaps=True),
}
"""Stored fields of `Candidates`."""

ENOUGH = 240
"""Number of grasps that a user's object's candidates are chosen from; for the stored ones 1,200."""

NOTHING_FITS = "no grasp found; the gripper needs a part narrower than {:.0f} mm that it can reach"


def candidates_in(scene: Scene) -> tuple[Candidates, ...]:
    """Candidates of each of a scene's objects, of the kind that its configuration says."""
    return candidates_of(scene.objects, scene.config.candidates, carrier(scene.robot))


@lru_cache(maxsize=8)
@busy("grasp candidates")
def candidates_of(
    objects: tuple[ObjectModel, ...], kind: CandidateKind = "filtered", robot: Robot | None = None
) -> tuple[Candidates, ...]:
    """Candidates of each object for the robot's gripper (None: the 2F-85), in the objects' order.

    Stored are the built-in objects' for the 2F-85. Others are sampled once (seconds each) and kept on
    disk. An object that the gripper cannot hold has none, with a warning.

    `region_m` is not stored: NaN for the built-in objects.
    """
    robot = carrier(robot)
    if kind == "narrow":
        every = candidates_of(objects, "filtered", robot)
        return tuple(_narrow(o, c, robot) for o, c in zip(objects, every, strict=True))
    return tuple(_candidates(o, kind, robot) for o in objects)


def _narrow(model: ObjectModel, found: Candidates, robot: Robot) -> Candidates:
    """The candidates along whose closing axis the object is at most as wide as the open gripper;
    all of them where there is none."""
    along = model.vertices.astype(np.float64) @ found.T_obj_ee[:, :3, 1].T.astype(np.float64)
    fits = np.ptp(along, axis=0) <= robot.open_gap_m
    return found.rows(fits) if fits.any() else found


def stacked(
    candidates: Sequence[Candidates],
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """T_obj_ee of all candidates (K, 4, 4), and of each object the first row and the number of
    rows.

    Args:
        candidates: those of each object.
    """
    count = np.array([len(c) for c in candidates], np.int64)
    return np.concatenate([c.T_obj_ee for c in candidates]), np.cumsum(count) - count, count


def without_candidates(scene: Scene) -> list[int]:
    """Indices of the objects that no candidate was found for."""
    return [i for i, c in enumerate(candidates_in(scene)) if len(c) == 0]


def check_candidates(scene: Scene, object_index: torch.Tensor) -> None:
    """Raises `NoGraspError` where a trial's object has no candidate: methods choose from them."""
    for i in without_candidates(scene):
        if bool((object_index == i).any()):
            raise NoGraspError(
                f"{scene.objects[i].name}: has no grasp candidate; leave its trials out, or give grasps of your own"
            )


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """All candidates of a scene's O objects, M rows on its device; those of object o are first[o]
    .. first[o] + count[o]."""

    T_obj_ee: Float32[Tensor, "m 4 4"]
    """grasps, the best of an object first: the ee in the object's frame, m"""
    opening_m: Float32[Tensor, " m"]
    """gap between the pads once they have closed on the object, m"""
    width_m: Float32[Tensor, " m"]
    """material between the pads, m"""
    score: Float32[Tensor, " m"]
    """0 to 1, higher is better"""
    object_index: Int32[Tensor, " m"]
    """whose grasp it is: row of `scene.objects`"""
    first: Int64[Tensor, " o"]
    """first row of each object"""
    count: Int64[Tensor, " o"]
    """rows of each object"""

    def __repr__(self) -> str:  # one line: a dataclass would print its tensors
        each = "none" if not len(self.count) else f"{int(self.count.min())} to {self.most}"
        return f"CandidateTable({len(self.score)} grasps of {len(self.count)} objects, {each} each, on {self.score.device})"

    @cached_property
    def some_have_none(self) -> bool:
        """Whether some object has no candidate."""
        return bool((self.count == 0).any())

    @property
    def most(self) -> int:
        """K, the largest number of candidates that an object has."""
        return int(self.count.max())

    def rows(
        self, object_index: Int32[Tensor, " b"]
    ) -> tuple[Int64[Tensor, "b k"], Bool[Tensor, "b k"]]:
        """Rows of the K candidates of each trial's object, and which of them exist (the others
        repeat the first).

        Args:
            object_index: (b,) the object of each trial.

        Raises:
            NoGraspError: an object has none.
        """
        o = object_index.long()
        if self.some_have_none and bool((self.count[o] == 0).any()):
            raise NoGraspError("trials of objects that have no grasp candidate; leave them out")
        k = torch.arange(self.most, dtype=torch.int64, device=o.device)
        exists = k < self.count[o][:, None]
        return self.first[o][:, None] + torch.where(exists, k, 0), exists


@KeptWith
def candidate_table(scene: Scene) -> CandidateTable:
    """The candidates of a scene's objects with the opening that each closes to; made once per
    scene."""
    every = candidates_in(scene)
    T, first, count = stacked(every)
    index = np.repeat(np.arange(len(count)), count).astype(np.int32)
    if not len(T):
        raise NoGraspError("no object has a grasp candidate: the gripper can hold none of them")
    T_obj_ee, object_index = (torch.from_numpy(x).to(scene.device) for x in (T, index))
    held = close_gripper(scene.grasp_tables, T_obj_ee, object_index, w_max=scene.robot.open_gap_m)
    values = (np.concatenate([getattr(c, name) for c in every]) for name in ("width", "score"))
    width, score = (torch.from_numpy(v).to(scene.device) for v in values)
    places = (torch.from_numpy(v).to(scene.device) for v in (first, count))
    return CandidateTable(T_obj_ee, held.opening_m, width, score, object_index, *places)


@lru_cache(maxsize=256)
def _candidates(model: ObjectModel, kind: CandidateKind, robot: Robot) -> Candidates:
    if (turn := model.who.turn) is not None:
        before = _candidates(turn.own, kind, robot)
        return replace(before, T_obj_ee=turn.poses(before.T_obj_ee))
    filtered = kind == "filtered"
    if model.grasps is not None:  # a user's own: none left is the user's to know
        return (seat_grasps if filtered else own_grasps)(model, model.grasps, robot)
    stored, usual = _stored(kind), robot == carrier(None)
    if f"{(own := model.who.key)}/T_obj_ee" in stored and usual:
        values = {k: stored[f"{own}/{k}"] for k in ("T_obj_ee", "width", "score", "part")}
        return Candidates(**values, region_m=np.full(len(values["width"]), np.nan, np.float32))

    def make() -> dict[str, NDArray[Any]]:
        try:
            if not filtered:
                return vars(generate_grasps(model, robot))
            return vars(sample_grasps(model, robot=robot, enough=ENOUGH if usual else SAMPLED))
        except NoGraspError:
            return vars(_candidates(load_objects()[0], kind, carrier(None)).rows(slice(0)))

    whose = "" if usual else robot.digest
    key = hashlib.sha256(
        f"{object_digest(model)} {code_digest(CODE, VERSIONS)}{whose}".encode()
    ).hexdigest()
    folder = "candidates" if filtered else "candidates-as-generated"
    found = Candidates(**cached(folder, key, make, FORM))
    if not len(found):
        warnings.warn(f"{model.name}: {NOTHING_FITS.format(1e3 * robot.open_gap_m)}", stacklevel=2)
    return found


@lru_cache(maxsize=2)
def _stored(kind: CandidateKind) -> dict[str, NDArray[Any]]:
    return stored_arrays_of(STORED[kind], "objects")
