"""Films of trials: their legs, their motion, and what stands before it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.write import atomic_path
from r2h_batch.scene.offscreen import RenderError
from r2h_batch.view.captions import title, verdict_of
from r2h_batch.view.drawing import Drawing, View, view_of
from r2h_batch.view.pictures import LEGS, Image, painter, still_groups

Array = NDArray[np.float64]

STILL = "no motion: the camera turns around the posture"
STILL_S = 7.0  # a film of a trial without a motion: the camera comes near, then turns around it
COMING, SWING_DEG = (
    0.25,
    55.0,
)  # share of that time in which it comes; how far it turns to each side
REST_S = 1.5  # a film goes on after the motion, with the verdict
LEAST_CAPTIONED, LEAST_LETTERS = (
    160,
    11,
)  # least height of a film with words, and of their letters, pixels


class Clip(NamedTuple):
    """Pictures before the motion of a trial: how many, what draws them at a width and height, what they show."""

    length: int
    images: Callable[[tuple[int, int]], Iterator[Image]]
    shows: str


class Story(NamedTuple):
    """A trial as a film tells it, and what stands before its legs and motion."""

    drawing: Drawing
    before: Clip | None = None


def write_film(stories: Sequence[Story], out: Path, *, size: tuple[int, int], fps: int) -> None:
    """A film of the trials beside each other, each with its method, the time and, once it is decided, the verdict; each
    rests on its last image until all have ended. Around a trial without a motion the camera turns.

    Raises:
        RenderError: nothing draws here, or imageio or its ffmpeg is missing.
    """
    view = view_of([s.drawing for s in stories], Caption.of(size, 3).aspect)
    films = [_film(s, size, fps, view) for s in stories]
    total = max(_count(s, fps) for s in stories)
    with film_writer(out, fps) as write, progress(f"film {out.name}", total, "pictures") as told:
        last = [next(f) for f in films]
        ended = [False] * len(films)
        while not all(ended):
            write(np.concatenate(last, axis=1))
            told(1)
            for k, film in enumerate(films):
                image = next(film, None)
                ended[k] = image is None
                last[k] = last[k] if image is None else image


def _count(story: Story, fps: int) -> int:
    """Images of a film of one trial."""
    drawing, before = story
    legs = sum(len(_times(leg, fps)) for leg in drawing.legs)
    own = len(_times(drawing, fps, rests=True))
    return (before.length if before else 0) + legs + own


def _times(drawing: Drawing, fps: int, *, rests: bool = False) -> Array:
    """When the images of a leg, of a motion (and of a rest behind it), or around a posture are, s."""
    if not drawing.stored.moves:
        return np.arange(0.0, STILL_S, 1.0 / fps)
    return np.arange(0.0, drawing.motion()[0][-1] + (REST_S if rests else 0.0), 1.0 / fps)


def _film(story: Story, size: tuple[int, int], fps: int, view: View) -> Iterator[Image]:
    """The images of one trial: its motion and a rest, or its posture at the target from around."""
    drawing = story.drawing
    verdict = drawing.ended[0] if drawing.ended else verdict_of(drawing.stored)
    head = f"{title(drawing)}, {drawing.stored.method}"
    letters = Caption.of(size, 3)
    if story.before is not None:
        for image in story.before.images(letters.inner):
            yield letters.around(image, head, [story.before.shows, ""])
    if not drawing.stored.moves:
        witness, q = drawing.witness, drawing.event[0]
        words = [verdict, STILL] if witness is None else [verdict, witness.caption, STILL]
        letters = Caption.of(size, 1 + len(words))
        with painter(drawing, letters.inner, view) as paint:
            for eye in _around(drawing, letters.aspect, view, _times(drawing, fps) / STILL_S):
                yield letters.around(paint(q, *still_groups(drawing), view=eye), head, words)
        return
    before_s = 0.0
    for leg, does in zip(drawing.legs, LEGS, strict=False):
        times, motion = leg.motion()
        with painter(leg, letters.inner, view) as paint:
            for t in _times(leg, fps):
                words = [f"{before_s + t:.1f} s", does]
                image = paint(motion[np.abs(times - t).argmin()], "region")
                yield letters.around(image, head, words)
        before_s += float(times[-1])
    yield from _moving(drawing, letters, fps, view, head, verdict, before_s)


def _moving(
    drawing: Drawing,
    letters: "Caption",
    fps: int,
    view: View,
    head: str,
    verdict: str,
    before_s: float,
) -> Iterator[Image]:
    """The images of the motion, and of the rest at its end."""
    times, motion = drawing.motion()
    at = _times(drawing, fps, rests=True)
    fails_s = drawing.fails_at_s
    decided_s = fails_s if fails_s is not None else float(times[-1])
    if fails_s is not None:  # the one before it becomes that moment
        at[np.searchsorted(at, fails_s, side="right") - 1] = fails_s
    with painter(drawing, letters.inner, view) as paint:
        for t in at:
            fails = fails_s is not None and t >= fails_s
            shown_s = before_s + min(t, times[-1])
            words = [f"{shown_s:.1f} s", verdict if t >= decided_s else ""]
            image = paint(motion[np.abs(times - t).argmin()], *drawing.groups(fails=fails))
            yield letters.around(image, head, words)


def _around(drawing: Drawing, aspect: float, far: View, share: Array) -> Iterator[View]:
    """Cameras of a film without a motion: from far to near, then to one side and to the other."""
    near = view_of([drawing], aspect, close=True)
    turn = (near.azimuth_deg - far.azimuth_deg + 180) % 360 - 180
    for s in share:
        x = min(s / COMING, 1.0)
        x = x * x * (3 - 2 * x)
        swing = SWING_DEG * np.sin(2 * np.pi * max(s - COMING, 0.0) / (1 - COMING))
        yield View(
            far.look_at + x * (near.look_at - far.look_at),
            far.azimuth_deg + x * turn + swing,
            far.elevation_deg + x * (near.elevation_deg - far.elevation_deg),
            far.distance_m + x * (near.distance_m - far.distance_m),
        )


@dataclass(frozen=True)
class Caption:
    """Room for lines above and below the images of a film."""

    size: tuple[int, int]
    lines: int  # one of them above
    letters: int  # pixels; 0: the film is too small to read any

    @classmethod
    def of(cls, size: tuple[int, int], lines: int) -> Self:
        """For a film of this width and height."""
        height = size[1]
        return cls(
            size, lines, max(LEAST_LETTERS, height // 34) if height >= LEAST_CAPTIONED else 0
        )

    @property
    def row(self) -> int:
        """Height of a line, pixels."""
        return round(1.4 * self.letters)

    @property
    def inner(self) -> tuple[int, int]:
        """Width and height that are left for the image."""
        return self.size[0], self.size[1] - self.lines * self.row

    @property
    def aspect(self) -> float:
        """Its width divided by its height."""
        return self.inner[0] / self.inner[1]

    def around(self, image: Image, head: str, words: Sequence[str]) -> Image:
        """The image with `head` above it and `words` below."""
        if not self.letters:
            return image
        from PIL import Image as Picture
        from PIL import ImageDraw, ImageFont

        picture = Picture.new("RGB", self.size, "white")
        picture.paste(Picture.fromarray(image), (0, self.row))
        draw, font = ImageDraw.Draw(picture), ImageFont.load_default(self.letters)
        below = self.row + image.shape[0]
        for line, top in ((head, 0), *((w, below + k * self.row) for k, w in enumerate(words))):
            place = self.letters // 2, top + self.letters // 6
            draw.text(
                place, _fitting(line, font, self.size[0] - self.letters), font=font, fill="#191919"
            )
        return np.asarray(picture)


def _fitting(line: str, font: Any, room: float) -> str:
    """The line, shortened where it is wider than the room."""
    if font.getlength(line) <= room:
        return line
    while line and font.getlength(f"{line} ...") > room:
        line = line[:-1]
    return f"{line} ..."


@contextmanager
def film_writer(out: Path, fps: int) -> Iterator[Callable[[Image], None]]:
    """Writes a film image by image; the file is there when all are.

    Raises:
        RenderError: imageio or its ffmpeg is missing.
    """
    with atomic_path(out) as temporary, _writer(temporary, fps) as writer:
        yield writer.append_data


def _writer(path: Path, fps: int) -> Any:
    """imageio's writer with its own ffmpeg."""
    try:
        import imageio

        if path.suffix.lower() == ".gif":
            return imageio.get_writer(path, mode="I", duration=1000 / fps, loop=0)
        import imageio_ffmpeg  # noqa: F401 (imageio says less when it is missing)

        return imageio.get_writer(path, fps=fps, macro_block_size=2, quality=7)
    except ImportError:
        words = "films need imageio with its ffmpeg: pip install 'r2h_batch[view]'"
        raise RenderError(words) from None
