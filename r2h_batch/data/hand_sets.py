"""A hand set out of a data set: one receiving frame of every sequence, the whole motions beside it.

hands.npz holds H hands, right ones first, as `scene.hand.load_hand_set(path)` reads them, and what
is known of each:

    pose (H, 48)           full turns about the flat hand; the wrist's own turn is 0: trials turn the
    whole hand
    shape (H, 10)  side (H,) 0 right, 1 left      posture (H,) the source's name
    source, instruction, object (H,)              text; source finds the sequence again
    frame, frames (H,)     which frame it is, of how many; rate_hz (H,) 0 where unknown
    T_world_hand, T_world_object (H, 4, 4)        in the source's world at that frame; NaN where unknown
    facing, up (H, 3)      the body's chest, and against gravity, in that world; NaN where unknown
    arm (H, 3, 3)          the body's shoulder, elbow and wrist there; NaN where unknown
    held_s (H,)            seconds in which it carries the object; NaN where that is unknown
    mover (H,)             whether it carries the object longest of the hands of its sequence

NAME_motion.npz beside it holds N frames, hand h's from first[h] to first[h + 1]:

    first (H + 1,)   hand (N, 6) wrist's turn (axis-angle) and place in the source's world   object
    (N, 6) the same fingers (N, 45) float16: turns to 1e-3 rad
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import write_npz
from r2h_batch.data.data_sets import DATA_SETS, HandMotion, oakink_receivers
from r2h_batch.data.mano import ManoHand
from r2h_batch.data.smplx import Bodies
from r2h_batch.scene.hand import HandModel, load_hand, load_hand_set
from r2h_batch.scene.hand_file import HELD_S, check_postures, in_body

F64 = NDArray[np.float64]

MOVED_M, TURNED_RAD = 0.005, float(np.radians(5.0))
"""An object is being carried once it is this far from where it began."""
REACH_S = 1.0
THUMB_TIP, INDEX_TIP = 15, 3
STEP_S, CARRIED_M, SLIP, NEAR_M = 0.1, 0.004, 1 / 3, 0.5
"""A hand carries an object in a step of `STEP_S` if the object takes the wrist's place along by
`CARRIED_M` or more, and the wrist goes elsewhere by at most `SLIP` of that. It is `NEAR_M` from the
object's origin at most: both hands of somebody who walks move alike [choice]."""
KINDS = {"hand": np.float32, "object": np.float32, "fingers": np.float16}


class Collected:
    """The hands that were read, of either side, as the files hold them; what was left out."""

    def __init__(self) -> None:
        self.rows: tuple[list[dict[str, Any]], ...] = ([], [])
        self.motions: tuple[dict[str, list[Any]], ...] = (
            {k: [] for k in KINDS},
            {k: [] for k in KINDS},
        )
        self.skipped: list[str] = []
        self.idle = 0

    def add(self, row: dict[str, Any], hand: HandMotion) -> None:
        """Take a hand and what `row_of` says of it."""
        self.rows[hand.side].append(row)
        motion = {
            "hand": _vectors(hand.T_world_hand, len(hand.fingers)),
            "object": _vectors(hand.T_world_object, len(hand.fingers)),
            "fingers": hand.fingers,
        }
        for name, values in motion.items():
            self.motions[hand.side][name].append(values.astype(KINDS[name]))

    @staticmethod
    def row_of(hand: HandMotion, frame: int, posture: str, **more: Any) -> dict[str, Any]:
        """Row of hands.npz for a hand that receives as in this frame; ValueError for what --hands
        would refuse."""

        def at(value: F64 | None, shape: tuple[int, ...]) -> F64:
            # a view would keep all frames
            return np.full(shape, np.nan) if value is None else value[frame].copy()

        pose = np.concatenate([more.pop("wrist", np.zeros(3)), hand.fingers[frame]])
        check_postures(pose[None], hand.shape[None])
        row: dict[str, Any] = {
            "T_world_hand": at(hand.T_world_hand, (4, 4)),
            "T_world_object": at(hand.T_world_object, (4, 4)),
            "facing": at(hand.facing, (3,)),
            "up": np.full(3, np.nan) if hand.up is None else hand.up,
            "arm": at(hand.arm, (3, 3)),
        }
        if np.isfinite(row["facing"]).all() and np.isfinite(row["up"]).all():
            names = ("T_world_hand", "facing", "up", "arm")
            in_body({k: row[k][None] for k in names}, 1, hand.source)
        about = {"source": hand.source, "instruction": hand.instruction, "object": hand.object_name}
        row |= {"pose": pose, "shape": hand.shape, "side": hand.side, "posture": posture, **about}
        return {**row, "frame": frame, "frames": len(hand.fingers), "rate_hz": hand.rate_hz, **more}

    def counts(self) -> tuple[int, int]:
        """How many right and left hands there are."""
        return len(self.rows[0]), len(self.rows[1])


def collect(
    source: str,
    folder: Path,
    hand: ManoHand | None,
    rule: str | int = "aperture",
    *,
    strict: bool = False,
    idle: bool = False,
    into: Collected | None = None,
    bodies: Bodies | None = None,
) -> Collected:
    """The hands of a data set's folder.

    Args:
        source: one of `DATA_SETS`.
        folder: the data set.
        hand: MANO, which some data sets need.
        rule: which frame of a sequence (`receiving_frame`).
        strict: refuse what cannot be read, instead of telling and counting it.
        idle: take hands too that never carry the object.
        into: hands of other data sets that they join.
        bodies: SMPL-X' models, for the arms of bodies.
    """
    data_set = DATA_SETS[source]
    paths = data_set.find(folder)
    if source == "oakink" and rule == "aperture":
        paths = oakink_receivers(paths, folder)
    model = hand.model if hand else None
    found = Collected() if into is None else into
    before, skipped, idle_before = sum(found.counts()), len(found.skipped), found.idle
    for path in _shown(paths, f"reading {source}"):
        try:
            hands = data_set.read(path, hand, bodies)
            held = [seconds_held(h) for h in hands]
            longest = int(np.argmax(np.nan_to_num(held, nan=-1.0)))
            taken = [
                (
                    found.row_of(
                        h, receiving_frame(h, rule, model), source, held_s=s, mover=i == longest
                    ),
                    h,
                )
                for i, (h, s) in enumerate(zip(hands, held, strict=True))
                if idle or not s < HELD_S
            ]
        except (FileError, OSError, ValueError) as error:
            text = " ".join(printable(error).split())
            line = text if text.startswith(printable(path)) else f"{printable(path)}: {text}"
            if strict:
                raise FileError(line) from None
            found.skipped.append(line)
            LOG.info(f"skipped: {line}")
            continue
        found.idle += len(hands) - len(taken)
        for row, h in taken:
            found.add(row, h)
    if sum(found.counts()) == before:
        unread, left_out = found.skipped[skipped:], found.idle - idle_before
        where = f"{printable(folder)}: of {len(paths)} files"
        if left_out:
            what = f"all {left_out} hands are idle, none carries the object for {HELD_S:g} s"
            more = f"; {len(unread)} files could not be read" if unread else ""
            raise FileError(f"{where} {what}: take them with --idle{more}")
        first = f"; the first: {unread[0]}" if unread else ""
        raise FileError(f"{where} none could be read{first}")
    return found


def _shown(paths: Sequence[Path], what: str) -> Iterator[Path]:
    """The paths one by one, with a bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(paths, what, console=console, transient=True, disable=not console.is_terminal)


def receiving_frame(hand: HandMotion, rule: str | int, model: HandModel | None = None) -> int:
    """The frame in which this hand receives. `rule`: a frame's number, or aperture, first, middle, last.

    `aperture`, the default: of the last second before the object first moves by 5 mm or 5 degrees
    (of all frames where it never does, or where nothing is known of it), the one with the widest
    grip, thumb's last joint to index's. A hand that reaches for a thing opens widest shortly before
    it closes on it (Jeannerod 1984): the posture to receive with.
    """
    count = len(hand.fingers)
    if isinstance(rule, int):
        if not -count <= rule < count:
            raise FileError(f"{hand.source}: has {count} frames; frame {rule} is not one of them")
        return rule % count
    if rule != "aperture":
        return {"first": 0, "middle": count // 2, "last": count - 1}[rule]
    first, end = 0, count
    if (starts := _starts_to_move(hand.T_world_object)) is not None:
        end = max(starts, 1)
        first = max(0, end - max(1, round(REACH_S * hand.rate_hz))) if hand.rate_hz > 0 else 0
    grip = np.zeros((end - first, 48))
    grip[:, 3:] = hand.fingers[first:end]
    side = torch.full((len(grip),), hand.side, dtype=torch.int8, device="cpu")
    shape = torch.from_numpy(np.tile(hand.shape, (len(grip), 1)))
    skeleton = _skeleton(model or load_hand())
    joints = skeleton.pose(torch.from_numpy(grip), shape, side).joints.double().numpy()
    return first + int(np.linalg.norm(joints[:, THUMB_TIP] - joints[:, INDEX_TIP], axis=1).argmax())


@lru_cache(maxsize=4)
def _skeleton(model: HandModel) -> HandModel:
    """The same joints with one vertex: skinning would take six times as long as all else."""
    one = {k: getattr(model, k)[:1] for k in ("vertices", "weights", "shape_basis")}
    basis = None if model.pose_basis is None else model.pose_basis[:1]
    left = None if model.left is None else _skeleton(model.left)
    return replace(model, **one, pose_basis=basis, left=left)


def _starts_to_move(T_world_object: F64 | None) -> int | None:
    if T_world_object is None:
        return None
    far = np.linalg.norm(T_world_object[:, :3, 3] - T_world_object[0, :3, 3], axis=1) > MOVED_M
    turned = (
        Rotation.from_matrix(T_world_object[:, :3, :3] @ T_world_object[0, :3, :3].T).magnitude()
        > TURNED_RAD
    )
    moved = np.flatnonzero(far | turned)
    return int(moved[0]) if len(moved) else None


def seconds_held(hand: HandMotion) -> float:
    """For how long this hand carries the object; NaN where no motion of an object is known."""
    T, step = hand.T_world_object, max(1, round(STEP_S * hand.rate_hz))
    if T is None or hand.rate_hz <= 0 or _starts_to_move(T) is None:
        return float("nan")
    wrist = hand.T_world_hand[:, :3, 3]
    in_object = np.einsum("nji,nj->ni", T[:, :3, :3], wrist - T[:, :3, 3])
    taken = np.einsum("nij,nj->ni", T[step:, :3, :3], in_object[:-step]) + T[step:, :3, 3]
    carried = np.linalg.norm(taken - wrist[:-step], axis=1)
    slip = np.linalg.norm(taken - wrist[step:], axis=1)
    near = np.linalg.norm(in_object[:-step], axis=1) < NEAR_M
    held = (carried >= CARRIED_M) & (slip <= SLIP * carried) & near
    return float(held.sum() / hand.rate_hz)


def built_in() -> Collected:
    """The project's own 400 postures in the same form: motions of one frame, world and body
    unknown."""
    own, found = load_hand_set(), Collected()
    for i, (side, pose, shape, posture) in enumerate(
        zip(own.side.tolist(), own.pose.numpy(), own.shape.double().numpy(), own.posture)
    ):
        fingers = pose[None, 3:].astype(np.float64)
        unknown = np.full((1, 4, 4), np.nan)
        hand = HandMotion(f"r2h_batch:{i}", side, unknown, fingers, shape)
        about = found.row_of(hand, 0, posture, wrist=pose[:3], held_s=np.nan, mover=True)
        found.add(about, hand)
    return found


def motion_file(out: Path) -> Path:
    """Where the motions of a hand set stand: beside it."""
    return out.with_name(f"{out.stem}_motion.npz")


def write(out: Path, found: Collected) -> None:
    """hands.npz and its motions."""
    rows = [*found.rows[0], *found.rows[1]]
    whole: dict[str, Any] = {"side": np.int8, "frame": np.int32, "frames": np.int32, "mover": bool}
    arrays = {}
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        kind = whole.get(name, np.float32 if values.dtype.kind == "f" else None)
        arrays[name] = values if kind is None else values.astype(kind)
    motions: dict[str, Any] = {
        "first": np.cumsum([0, *(row["frames"] for row in rows)]).astype(np.int64)
    }
    right, left = found.motions
    motions |= {name: right[name] + left[name] for name in KINDS}
    write_npz(motion_file(out), motions)
    write_npz(out, arrays)


def _vectors(T: F64 | None, count: int) -> F64:
    if T is None or np.isnan(T).any():
        return np.full((count, 6), np.nan)
    return np.concatenate([Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]], axis=1)
