"""A stored trial as a film or as a strip of pictures; the same trial of several methods beside each
other."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.command_line import UsageError
from r2h_batch.export.drawing import Stage, save_picture
from r2h_batch.export.stored import StoredTrial
from r2h_batch.io.write import atomic_path
from r2h_batch.scene.offscreen import RenderError

Image = NDArray[np.uint8]

FILMS, PICTURES = (".mp4", ".webm", ".gif"), (".png", ".jpg", ".jpeg")
LARGEST = (1920, 1080)
STILL_S = 3.0
"""How long a trial without a motion is looked at: half from afar, half near."""
REST_S = 0.7
STRIP = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Moments of a strip: fractions of the motion."""


def check_size(out: Path, size: tuple[int, int], fps: int) -> None:
    """Refuses what cannot be written before anything slow starts: raises `UsageError`."""
    if out.suffix.lower() not in (*FILMS, *PICTURES):
        raise UsageError(
            f"--out is {out}; its ending must be one of {', '.join((*FILMS, *PICTURES))}"
        )
    if not all(16 <= s <= most and s % 2 == 0 for s, most in zip(size, LARGEST, strict=True)):
        raise UsageError(
            f"--size is {size[0]} {size[1]}; even numbers from 16 to {LARGEST[0]} and {LARGEST[1]}"
        )
    if not 1 <= fps <= 60:
        raise UsageError(f"--fps is {fps}; it must be 1 to 60")


def write_video(
    stored: Sequence[StoredTrial],
    out: str | Path,
    *,
    size: tuple[int, int] = (960, 720),
    fps: int = 25,
) -> Path:
    """Writes a film, or for a picture's ending a strip (a row for each method); returns the path.
    Raises `RenderError`."""
    path, stages = Path(out), [Stage(s) for s in stored]
    if path.suffix.lower() in PICTURES:
        save_picture(
            path,
            np.concatenate([np.concatenate(list(strip(s, size)), axis=1) for s in stages], axis=0),
        )
        return path
    films = [film(s, size, fps) for s in stages]
    with atomic_path(path) as temporary, _writer(temporary, fps) as writer:
        last: list[Image] = []
        for k in range(_frames(stages, fps)):
            last = [
                next(f, last[n] if k else np.zeros((size[1], size[0], 3), np.uint8))
                for n, f in enumerate(films)
            ]
            writer.append_data(np.concatenate(last, axis=1))
    return path


def film(stage: Stage, size: tuple[int, int], fps: int) -> Iterator[Image]:
    """The trial's pictures, one after the other: its motion and a short rest, or what was asked
    from afar and near."""
    width, height = size
    if stage.stored.moves:
        times, q = stage.motion()
        at = np.arange(0.0, times[-1] + REST_S, 1.0 / fps)
        yield from stage.pictures(
            (q[np.abs(times - t).argmin()] for t in at), width=width, height=height
        )
        return
    n = round(STILL_S * fps / 2)
    for close in (False, True):
        image = next(
            stage.pictures(
                [stage.stored.target_q], width=width, height=height, asked=True, close=close
            )
        )
        yield from (image for _ in range(n))


def strip(stage: Stage, size: tuple[int, int]) -> Iterator[Image]:
    """Pictures at STRIP's moments; without a motion home, the posture asked for, and the same from
    near (twice)."""
    width, height = size
    if stage.stored.moves:
        times, q = stage.motion()
        postures = [q[np.abs(times - f * times[-1]).argmin()] for f in STRIP]
        yield from stage.pictures(postures, width=width, height=height)
        return
    asked = stage.stored.target_q
    yield from stage.pictures(
        [np.array(stage.stored.workplace.home_q), asked], width=width, height=height, asked=True
    )
    near = next(stage.pictures([asked], width=width, height=height, asked=True, close=True))
    yield from (near, *[np.full_like(near, 255)] * (len(STRIP) - 3))


def _frames(stages: Sequence[Stage], fps: int) -> int:
    longest = max(
        [float(s.motion()[0][-1]) + REST_S for s in stages if s.stored.moves], default=STILL_S
    )
    return max(2, round(longest * fps))


def _writer(path: Path, fps: int) -> Any:
    """imageio's writer with its own ffmpeg; `RenderError` with one line where it is not there."""
    try:
        import imageio

        if path.suffix.lower() == ".gif":
            return imageio.get_writer(path, mode="I", duration=1000 / fps, loop=0)
        import imageio_ffmpeg  # noqa: F401 (imageio says less when it is missing)

        return imageio.get_writer(path, fps=fps, macro_block_size=2, quality=7)
    except ImportError:
        raise RenderError(
            "films need imageio with its ffmpeg: pip install 'r2h_batch[view]'"
        ) from None
