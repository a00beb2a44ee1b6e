"""Images, strips and films of trials, drawn by MuJoCo without a screen."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.write import atomic_path
from r2h_batch.report.figures import style
from r2h_batch.scene.model_parts import SHADOW_PIXELS
from r2h_batch.scene.offscreen import RenderError, renderer
from r2h_batch.view.captions import headline, legend, title
from r2h_batch.view.drawing import Drawing, Mark, View, view_of
from r2h_batch.view.mjcf import MARK

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SEEN = ("target", "region", "witness")
"""Marks of a trial without a motion."""
SEEN_AT_FAILURE = ("region", "ball", "witness")
"""Marks of the moment at which a motion fails."""
STILL_S = 3.0  # a film of a trial without a motion: half from far, half from near
REST_S = 0.7  # a film goes on after the motion
PASSES, FAILS = "#1b6e3c", "#a3262a"


@contextmanager
def painter(drawing: Drawing, size: tuple[int, int], view: View) -> Iterator[Callable[..., Image]]:
    """Gives `paint(q, *groups)`: an image (height, width, 3) of the trial at posture q (joints,), with
    the marks of these groups of `MARKS`.

    Args:
        drawing: the trial.
        size: width and height, pixels.
        view: the camera.

    Raises:
        RenderError: nothing draws on this machine.
    """
    model, (width, height) = drawing.model, size
    option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
    option.sitegroup[:] = 0
    camera.lookat[:], camera.distance = view.look_at, view.distance_m
    camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
    # memory and time of every image follow these sizes
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = min(SHADOW_PIXELS, 4 * max(width, height))
    with renderer(model, width, height) as drawer:

        def paint(q: Array, *groups: str) -> Image:
            option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
            option.geomgroup[MARK] = True
            for mark in drawing.marks:
                if mark.geom >= 0 and model.geom_group[mark.geom] == MARK:
                    model.geom_rgba[mark.geom, 3] = mark.rgba[3] if mark.group in groups else 0.0
            drawer.update_scene(drawing.at(q), camera, option)
            for mark in drawing.marks:
                if mark.group in groups and mark.body == "world":
                    _add_mark(drawer.scene, mark)
            return np.array(drawer.render())

        yield paint


def _add_mark(scene: mujoco.MjvScene, mark: Mark) -> None:
    """A ball at the one point, or a tube between the two points of a mark in the world."""
    points = mark.points
    if points is None or scene.ngeom >= scene.maxgeom:
        return
    geom, rgba = scene.geoms[scene.ngeom], np.array(mark.rgba, np.float32)
    ball, tube = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE
    size, turn = np.full(3, mark.radius_m), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, ball if len(points) == 1 else tube, size, points[0], turn, rgba)
    if len(points) == 2:
        mujoco.mjv_connector(geom, tube, mark.radius_m, points[0], points[1])
    scene.ngeom += 1


def images(
    drawing: Drawing, size: tuple[int, int], n: int, view: View | None = None
) -> list[tuple[Image, str]]:
    """`n` images along the motion and a caption for each.

    A trial without a motion has three at most: home, the posture at the target, and that from near;
    its marks say what was wrong.
    """
    aspect = size[0] / size[1]
    with painter(drawing, size, view or view_of([drawing], aspect)) as paint:
        if drawing.stored.moves:
            moments = drawing.moments(n)
            return [
                (paint(q, *SEEN_AT_FAILURE if fails else ()), f"{t:.1f} s")
                for t, q, fails in moments
            ]
        home, target_q = np.array(drawing.stored.workplace.home_q), drawing.stored.target_q
        at_home = drawing.stored.row.get("plan_reason") == "start_in_collision"
        groups = SEEN if at_home else SEEN[:2]
        found = [(paint(home, *groups), "home"), (paint(target_q, *SEEN), "target")]
    with painter(drawing, size, view_of([drawing], aspect, close=True)) as paint:
        return [*found, (paint(target_q, *SEEN), "target, near")][:n]


def image_at_end(drawing: Drawing, size: tuple[int, int], *, close: bool = False) -> Image:
    """Where the motion ends, or the robot meets the hand; without a motion the target. Of a failure
    with the marks that say why."""
    _, q, fails = max(drawing.moments(2), key=lambda moment: moment[2:] + moment[:1])
    groups = SEEN_AT_FAILURE if fails else ()
    with painter(drawing, size, view_of([drawing], size[0] / size[1], close=close)) as paint:
        return paint(q, *groups if drawing.stored.moves else SEEN)


def write_strips(drawings: Sequence[Drawing], out: Path, *, n: int, size: tuple[int, int]) -> None:
    """A row of `n` images for each drawing, with its method and verdict, all from one camera.

    Raises:
        RenderError: nothing draws here, or matplotlib is missing.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch
    except ImportError:
        raise RenderError("strips need matplotlib: pip install 'r2h_batch[view]'") from None
    view = view_of(drawings, size[0] / size[1])
    wide, tall = 2.4, 2.4 * size[1] / size[0] + 0.32  # inches of an image, and of a row
    with style(page=False):
        heights = [0.35, *[tall] * len(drawings), 0.3]
        figure = Figure(figsize=(wide * n, sum(heights)), dpi=160)
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
        heading, *rows, foot = parts[:, 0]
        still = [d for d in drawings if not d.stored.moves]
        groups = SEEN if still else SEEN_AT_FAILURE
        failed = still or [d for d in drawings if any(fails for *_, fails in d.moments(n))]
        patches = [Patch(color=c, label=words) for c, words in legend(failed, groups)]
        if patches:
            foot.legend(handles=patches, loc="center", ncols=4, frameon=False, fontsize=7)
        heading.text(0.5, 0.5, title(drawings[0]), ha="center", va="center", fontsize=10)
        for part, drawing in zip(rows, drawings, strict=True):
            stored = drawing.stored
            verdict = (headline(stored.row), stored.row["outcome"] == "success")
            words, good = drawing.ended or verdict
            color = PASSES if good else FAILS
            part.text(0.005, 0.995, stored.method, ha="left", va="top", fontsize=9, weight="bold")
            part.text(0.995, 0.995, words, ha="right", va="top", fontsize=9, color=color)
            axes = part.subplots(1, n, gridspec_kw={"wspace": 0.02}, squeeze=False)[0]
            part.subplots_adjust(left=0.005, right=0.995, top=1 - 0.26 / tall, bottom=0.01)
            for axis in axes:
                axis.set_axis_off()
            for axis, (image, when) in zip(axes, images(drawing, size, n, view), strict=False):
                axis.imshow(image)
                plate = {"color": "white", "alpha": 0.7, "pad": 1.0, "linewidth": 0}
                axis.text(0.03, 0.05, when, transform=axis.transAxes, fontsize=7, bbox=plate)
        with atomic_path(out) as temporary:
            figure.savefig(temporary, metadata={"Software": None} if out.suffix == ".png" else None)


def write_film(drawings: Sequence[Drawing], out: Path, *, size: tuple[int, int], fps: int) -> None:
    """A film of the trials beside each other; each rests on its last image until all have ended.

    Raises:
        RenderError: nothing draws here, or imageio or its ffmpeg is missing.
    """
    view = view_of(drawings, size[0] / size[1])
    films = [_film(d, size, fps, view) for d in drawings]
    with atomic_path(out) as temporary, _writer(temporary, fps) as writer:
        last = [next(f) for f in films]
        ended = [False] * len(films)
        while not all(ended):
            writer.append_data(np.concatenate(last, axis=1))
            for k, film in enumerate(films):
                image = next(film, None)
                ended[k] = image is None
                last[k] = last[k] if image is None else image


def _film(drawing: Drawing, size: tuple[int, int], fps: int, view: View) -> Iterator[Image]:
    """The images of one trial: its motion and a short rest, or the target from far and near."""
    if drawing.stored.moves:
        times, q = drawing.motion()
        with painter(drawing, size, view) as paint:
            for t in np.arange(0.0, times[-1] + REST_S, 1.0 / fps):
                yield paint(q[np.abs(times - t).argmin()])
        return
    for camera in (view, view_of([drawing], size[0] / size[1], close=True)):
        with painter(drawing, size, camera) as paint:
            image = paint(drawing.stored.target_q, *SEEN)
        yield from [image] * max(1, round(STILL_S * fps / 2))


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


def save_picture(file: str | Path, image: Image) -> None:
    """Writes an image in the format that its name says.

    Raises:
        RenderError: imageio is missing.
    """
    try:
        import imageio.v3 as imageio
    except ImportError:
        raise RenderError("pictures need imageio: pip install 'r2h_batch[view]'") from None
    # through bytes: PIL raises a traceback of its own where it cannot close a file
    data = imageio.imwrite("<bytes>", image, extension=Path(file).suffix)
    with atomic_path(Path(file)) as temporary:
        temporary.write_bytes(data)
