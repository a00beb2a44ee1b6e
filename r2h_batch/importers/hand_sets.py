"""A hand set out of a data set: one receiving frame of every sequence, the whole motions beside it.

hands.npz holds H hands, right ones first, as `bodies.hand.load_hand_set(path)` reads them, and what
is known of each:

    pose (H, 48)           full turns about the flat hand; the wrist's own turn is 0: trials turn
    the whole hand
    shape (H, 10)  side (H,) 0 right, 1 left      posture (H,) the source's name
    source, instruction, object (H,)              text; source finds the sequence again
    frame, frames (H,)     which frame it is, of how many; rate_hz (H,) 0 where unknown
    T_world_hand, T_world_object (H, 4, 4)        in the source's world at that frame; NaN where
    unknown
    facing, up (H, 3)      the body's chest, and against gravity, in that world; NaN where unknown

NAME_motion.npz beside it holds N frames, hand h's from first[h] to first[h + 1]:

    first (H + 1,)   hand (N, 6) wrist's turn (axis-angle) and place in the source's world   object
    (N, 6) the same fingers (N, 45) float16: turns to 1e-3 rad
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import HandModel, load_hand_set
from r2h_batch.bodies.hand_file import check_postures, in_body
from r2h_batch.command_line import tell
from r2h_batch.importers import arctic, dexycb, grab, h2o, oakink
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.sequences import HandMotion, receiving_frame
from r2h_batch.io.read import FileError, printable
from r2h_batch.io.write import write_npz

__all__ = ["SOURCES", "Collected", "built_in", "collect", "motion_file", "write"]

Reader = Callable[[Path, ManoHand | None], list[HandMotion]]
SOURCES: dict[str, tuple[Callable[[Path], list[Path]], Reader]] = {
    "grab": (grab.find, grab.read),
    "arctic": (arctic.find, arctic.read),
    "h2o": (h2o.find, h2o.read),
    "oakink": (oakink.find, oakink.read),
    "dexycb": (dexycb.find, dexycb.read),
}


@dataclass(frozen=True, eq=False)
class Collected:
    """The hands that were read, right ones first, and their frames; names and reasons of files that
    were not."""

    hands: list[HandMotion]
    frames: list[int]
    posture: list[str]
    skipped: list[str]


def collect(
    source: str,
    folder: Path,
    hand: ManoHand | None,
    rule: str | int = "aperture",
    *,
    strict: bool = False,
) -> Collected:
    """All hands of a data set's folder. A file that cannot be read is named on stderr and left out;
    `strict`: raises."""
    find, read = SOURCES[source]
    paths = (
        oakink.find(folder, every=True)
        if source == "oakink" and rule != "aperture"
        else find(folder)
    )
    model: HandModel | None = hand.model if hand else None
    found: list[tuple[HandMotion, int]] = []
    skipped: list[str] = []
    for path in _shown(paths, f"reading {source}"):
        try:
            found += [_with_frame(h, receiving_frame(h, rule, model)) for h in read(path, hand)]
        except (FileError, OSError, ValueError) as error:
            text = " ".join(printable(error).split())
            line = text if text.startswith(printable(path)) else f"{printable(path)}: {text}"
            if strict:
                raise FileError(line) from None
            skipped.append(line)
            tell(f"skipped: {line}")
    if not found:
        raise FileError(
            f"{printable(folder)}: none of {len(paths)} files could be read; the first: {skipped[0]}"
        )
    found.sort(key=lambda f: f[0].side)  # stable: in order of the files on each side
    return Collected([h for h, _ in found], [k for _, k in found], [source] * len(found), skipped)


def _with_frame(hand: HandMotion, frame: int) -> tuple[HandMotion, int]:
    """The hand, held to what a hand set may hold and know of its body and place: what --hands would
    refuse is refused here."""
    known = {"facing": hand.facing, "up": hand.up, "T_world_hand": hand.T_world_hand}
    if all(v is not None for v in known.values()):
        rows = {k: np.asarray(v)[frame if k != "up" else ...][None] for k, v in known.items()}
        in_body(rows, 1, hand.source)
    pose = np.concatenate([np.zeros(3), hand.fingers[frame]])
    check_postures(pose[None], hand.shape[None])
    return hand, frame


def _shown(paths: Sequence[Path], what: str) -> Iterator[Path]:
    """The paths one by one, with a bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(paths, what, console=console, transient=True, disable=not console.is_terminal)


def built_in() -> Collected:
    """The project's own 400 postures in the same form: motions of one frame, world and body
    unknown."""
    own = load_hand_set()
    hands = [
        HandMotion(
            f"r2h_batch:{i}",
            side,
            np.full((1, 4, 4), np.nan),
            pose[None, 3:].astype(np.float64),
            shape,
        )
        for i, (side, pose, shape) in enumerate(
            zip(own.side.tolist(), own.pose.numpy(), own.shape.double().numpy(), strict=True)
        )
    ]
    return Collected(hands, [0] * len(hands), list(own.posture), [])


def motion_file(out: Path) -> Path:
    """Where the motions of a hand set stand: beside it."""
    return out.with_name(f"{out.stem}_motion.npz")


def write(out: Path, found: Collected, wrist: NDArray[np.float32] | None = None) -> None:
    """hands.npz and its motions. `wrist` (H, 3): turns to keep as the wrist's own, instead of 0."""
    count = len(found.hands)
    pose = np.zeros((count, 48), np.float32)
    pose[:, 3:] = [h.fingers[k] for h, k in zip(found.hands, found.frames)]
    if wrist is not None:
        pose[:, :3] = wrist
    arrays: dict[str, NDArray[Any]] = {
        "pose": pose,
        "shape": np.array([h.shape for h in found.hands], np.float32),
        "side": np.array([h.side for h in found.hands], np.int8),
        "posture": np.array(found.posture),
        "source": np.array([h.source for h in found.hands]),
        "instruction": np.array([h.instruction for h in found.hands]),
        "object": np.array([h.object_name for h in found.hands]),
        "frame": np.array(found.frames, np.int32),
        "frames": np.array([len(h.fingers) for h in found.hands], np.int32),
        "rate_hz": np.array([h.rate_hz for h in found.hands], np.float32),
        "T_world_hand": _at([h.T_world_hand for h in found.hands], found.frames, (4, 4)),
        "T_world_object": _at([h.T_world_object for h in found.hands], found.frames, (4, 4)),
        "facing": _at([h.facing for h in found.hands], found.frames, (3,)),
        "up": np.array(
            [np.full(3, np.nan) if h.up is None else h.up for h in found.hands], np.float32
        ),
    }
    motions = {
        "first": np.cumsum([0] + [len(h.fingers) for h in found.hands]).astype(np.int64),
        "hand": np.concatenate([_vectors(h.T_world_hand, len(h.fingers)) for h in found.hands]),
        "object": np.concatenate([_vectors(h.T_world_object, len(h.fingers)) for h in found.hands]),
        "fingers": np.concatenate([h.fingers for h in found.hands]).astype(np.float16),
    }
    write_npz(motion_file(out), motions)
    write_npz(out, arrays)


def _at(
    values: Sequence[NDArray[np.float64] | None], frames: Sequence[int], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    rows = [np.full(shape, np.nan) if v is None else v[k] for v, k in zip(values, frames)]
    return np.array(rows, np.float32).reshape(-1, *shape)


def _vectors(T: NDArray[np.float64] | None, count: int) -> NDArray[np.float32]:
    if T is None or np.isnan(T).any():
        return np.full((count, 6), np.nan, np.float32)
    turn = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    return np.concatenate([turn, T[:, :3, 3]], axis=1).astype(np.float32)
