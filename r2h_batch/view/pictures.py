"""Images and strips of trials, drawn by MuJoCo without a screen."""

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
from r2h_batch.view.captions import legend, title, verdict_of
from r2h_batch.view.drawing import FOV_DEG, RED, Drawing, Mark, View, view_of
from r2h_batch.view.mjcf import MARK

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

LEGS = ("picks", "lifts")
"""Words for the legs before a motion."""
RING = 0.06
"""Radius of the ring about what a failure is seen by, as a share of the picture's height."""
CLEAR = 0.3
"""Opacity of bodies that stand before what a failure is seen by."""
LETTERS = 34
"""Letters above an image of a strip."""
PASSES, FAILS = "#1b6e3c", "#a3262a"


def still_groups(drawing: Drawing) -> tuple[str, ...]:
    """Marks of a trial without a motion: the target where the arm is not at it, and what is wrong."""
    return ("target", "region", "witness") if drawing.away else ("region", "witness")


@contextmanager
def painter(drawing: Drawing, size: tuple[int, int], view: View) -> Iterator[Callable[..., Image]]:
    """Gives `paint(q, *groups, view=None)`: an image (height, width, 3) of the trial at posture q (joints,), with
    the marks of these groups of `MARKS`, from a camera of its own or from that of all.

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
    # memory and time of every image follow these sizes
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.quality.shadowsize = min(SHADOW_PIXELS, 4 * max(width, height))
    solid, whole = model.geom_rgba.copy(), view
    with renderer(model, width, height) as drawer:

        def paint(q: Array, *groups: str, view: View | None = None) -> Image:
            view = whole if view is None else view
            camera.lookat[:], camera.distance = view.look_at, view.distance_m
            camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
            model.geom_rgba[:] = solid
            for geom in drawing.before(view) if "witness" in groups else ():
                color, material = solid[geom], int(model.geom_matid[geom])
                model.geom_rgba[geom] = color if material < 0 else model.mat_rgba[material]
                model.geom_rgba[geom, 3] = CLEAR
            option.geomgroup[:] = [1, 1, 1, 0, 0, 0]
            option.geomgroup[MARK] = True
            for mark in (m for m in drawing.marks if m.geom >= 0):
                shown, link = mark.group in groups, drawing.seen_of(mark.geom)
                if model.geom_group[mark.geom] == MARK:
                    model.geom_rgba[mark.geom, 3] = mark.rgba[3] if shown else 0.0
                if shown and mark.group == "witness" and link >= 0:  # its body decides
                    model.geom_rgba[link] = (*mark.rgba[:3], 1.0)
            data = drawing.at(q)
            for mesh in drawing.reshaped:
                drawer.load(mesh)
            drawing.reshaped.clear()
            drawer.update_scene(data, camera, option)
            for mark in drawing.marks:
                if mark.group in groups:
                    _add_mark(drawer.scene, mark, data)
            image = np.array(drawer.render())
            return ringed(image, drawing.event[1], view) if "witness" in groups else image

        try:
            yield paint
        finally:
            model.geom_rgba[:] = solid


def ringed(image: Image, point: Array, view: View) -> Image:
    """The image with a red ring about a point of the world: however small or covered, it is found."""
    height, width = image.shape[:2]
    x, y, away = view.axes @ (point - view.look_at) + [0.0, 0.0, view.distance_m]
    scale = height / 2 / np.tan(np.radians(FOV_DEG / 2)) / away
    down, right = np.mgrid[:height, :width]
    apart = np.hypot(right + 0.5 - width / 2 - scale * x, down + 0.5 - height / 2 + scale * y)
    ring = np.abs(apart - RING * height) <= max(RING * height / 12, 0.8)
    image[ring] = np.round(255 * np.array(RED[:3])).astype(np.uint8)
    return image


def _add_mark(scene: mujoco.MjvScene, mark: Mark, data: mujoco.MjData) -> None:
    """A ball at the one point, or a tube between the two points of a mark, where its body is."""
    if mark.points is None or scene.ngeom >= scene.maxgeom:
        return
    body = data.body(mark.body)
    points = mark.points @ body.xmat.reshape(3, 3).T + body.xpos
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
            legs = [_end(leg, size, view or view_of([drawing], aspect)) for leg in drawing.legs]
            # a leg ends where the motion begins
            moments = drawing.moments(max(n - len(legs) + bool(legs), 2))[bool(legs) :]
            return [
                *zip(legs, LEGS, strict=False),
                *(
                    (paint(q, *drawing.groups(fails=fails)), f"{t:.1f} s")
                    for t, q, fails in moments
                ),
            ][-n:]
        home, target_q = np.array(drawing.stored.workplace.home_q), drawing.stored.target_q
        at_home = drawing.stored.row.get("plan_reason") == "start_in_collision"
        groups = still_groups(drawing)
        seen = groups if at_home else ("target", "region")
        where = "grasp" if drawing.stored.row["outcome"] == "pick" else "target"
        found = [(paint(home, *seen), "home"), (paint(target_q, *groups), where)]
    with painter(drawing, size, view_of([drawing], aspect, close=True)) as paint:
        return [*found, (paint(target_q, *groups), f"{where}, near")][:n]


def _end(leg: Drawing, size: tuple[int, int], view: View) -> Image:
    """Where a leg before the motion ends."""
    with painter(leg, size, view) as paint:
        return paint(leg.last)


def image_at_end(drawing: Drawing, size: tuple[int, int], *, close: bool = False) -> Image:
    """Where the motion ends, or the robot meets the hand; without a motion the target. Of a failure
    with the marks that say why."""
    _, q, fails = max(drawing.moments(2), key=lambda moment: moment[2:] + moment[:1])
    groups = drawing.groups(fails=fails) if drawing.stored.moves else still_groups(drawing)
    with painter(drawing, size, view_of([drawing], size[0] / size[1], close=close)) as paint:
        return paint(q, *groups)


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
    each = [images(drawing, size, n, view) for drawing in drawings]
    n = max(map(len, each))  # a trial without a motion has fewer
    wide, tall = 2.4, 2.4 * size[1] / size[0] + 0.32  # inches of an image, and of a row
    with style(page=False):
        heights = [0.35, *[tall] * len(drawings), 0.3]
        figure = Figure(figsize=(wide * n, sum(heights)), dpi=160)
        parts = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
        heading, *rows, foot = parts[:, 0]
        marks = legend(drawings, _groups_shown(drawings, n))
        if patches := [Patch(color=c, label=words) for c, words in marks]:
            foot.legend(handles=patches, loc="center", ncols=4, frameon=False, fontsize=7)
        heading.text(0.5, 0.5, title(drawings[0]), ha="center", va="center", fontsize=10)
        for part, drawing, row in zip(rows, drawings, each, strict=True):
            _write_verdict(part, drawing, LETTERS * n)
            _write_images(part, row, n, top=1 - 0.26 / tall)
        with atomic_path(out) as temporary:
            figure.savefig(temporary, metadata={"Software": None} if out.suffix == ".png" else None)


def _groups_shown(drawings: Sequence[Drawing], n: int) -> set[str]:
    """The groups of marks in rows of `n` images."""
    moving = [drawing for drawing in drawings if drawing.stored.moves]
    still = {"target", "region", "witness"} if len(moving) < len(drawings) else set()
    return still | {
        group
        for drawing in moving
        for *_, fails in drawing.moments(n)
        for group in drawing.groups(fails=fails)
    }


def _write_verdict(part: Any, drawing: Drawing, most: int) -> None:
    """Writes a method and its verdict above its row, which has room for `most` letters of full size."""
    stored = drawing.stored
    verdict = (verdict_of(stored), stored.row["outcome"] == "success")
    words, good = drawing.ended or verdict
    color = PASSES if good else FAILS
    method = stored.method
    if len(method) + len(words) > most:  # both stand in one line
        method = method.partition(" (")[0]
    letters = 9 * min(1.0, most / (len(method) + len(words)))
    part.text(0.005, 0.995, method, ha="left", va="top", fontsize=letters, weight="bold")
    part.text(0.995, 0.995, words, ha="right", va="top", fontsize=letters, color=color)


def _write_images(part: Any, row: Sequence[tuple[Image, str]], n: int, *, top: float) -> None:
    """Puts the images of a row, each with its caption, side by side below `top`, with room for `n`."""
    axes = part.subplots(1, n, gridspec_kw={"wspace": 0.02}, squeeze=False)[0]
    part.subplots_adjust(left=0.005, right=0.995, top=top, bottom=0.01)
    for axis in axes:
        axis.set_axis_off()
    for axis, (image, when) in zip(axes, row, strict=False):
        axis.imshow(image)
        plate = {"color": "white", "alpha": 0.7, "pad": 1.0, "linewidth": 0}
        axis.text(0.03, 0.05, when, transform=axis.transAxes, fontsize=7, bbox=plate)


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
