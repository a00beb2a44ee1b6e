"""Trials in a browser: a drawing in a viser scene, as one page without a server, and in notebooks."""

import logging
import socket
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import write_text
from r2h_batch.base.validate import instance_of, integer
from r2h_batch.sweep.rows import TrialNames, detail_rows, score_rows
from r2h_batch.types import Predictions, Scores
from r2h_batch.view.captions import as_html, title
from r2h_batch.view.drawing import FIXED, FOV_DEG, MARKS, Drawing, Mark, View, view_of
from r2h_batch.view.stored import difference, judged_again
from r2h_batch.view.stored_trial import StoredTrial

Array = NDArray[np.float64]

FRAMES_PER_S = 12.0  # of a recorded motion; the player shows it in real time
REST_S = 1.5  # before the motion starts again
APART_M = 1.6  # between two trials side by side, along y
ASPECT = 1.2  # of the part of a window that the panel leaves free
CLEAR = 0.35  # opacity of bodies that stand before what a failure is seen by
FIRST_M = 1.1  # least distance of the first camera from what a failure is seen by
THIN_M = 0.004  # least radius of a red line
ABOVE_M = 0.07  # words stand so far above what they name, and do not cover it
SMOOTH_FACES = 20_000  # smaller meshes are drawn with flat faces


class Drawn:
    """One trial in a viser scene, under `name` and `offset_m` to the side (along y); bodies that stand before its
    failure, seen from the first camera, are clear."""

    def __init__(
        self, scene: Any, drawing: Drawing, view: View, name: str = "/trial", offset_m: float = 0.0
    ) -> None:
        self.scene, self.drawing, self.name = scene, drawing, name
        self.marks: dict[str, list[Any]] = {group: [] for group in MARKS}
        self.root = scene.add_frame(name, show_axes=False, position=(0.0, offset_m, 0.0))
        model = drawing.model
        names = [str(model.body(i).name) for i in range(model.nbody)]
        frames = (scene.add_frame(f"{name}/{body}", show_axes=False) for body in names[1:])
        self.bodies = dict(enumerate(frames, 1))
        self.open: Any = None
        self._pose(drawing.stored.target_q, list(self.bodies))
        self.moving = [i for i in self.bodies if names[i] not in FIXED]
        fails = drawing.stored.row["outcome"] != "success"
        clear = drawing.before(moved(view, -offset_m)) if fails else frozenset()
        for g in drawing.visual_geoms():
            geom = model.geom(g).name.replace("/", "_")
            rgba = (*drawing.surface(g).rgba[:3], CLEAR) if g in clear else None
            self._add_surface(f"{name}/{drawing.body_of(g)}/{geom}", g, rgba)
        for k, mark in enumerate(drawing.marks):
            body = "" if mark.body == "world" else f"/{mark.body}"
            self._add_mark(f"{name}{body}/{mark.group}_mark_{k}", mark)
        self.show("target", drawing.away)
        self.open = self._open_gripper()
        self.stretches: list[tuple[float, Drawing, Array, Array]] = []

    def play(self, executed: bool = True) -> float:
        """Gets the motion ready, the legs before it too, for `at`; its duration, s.

        Args:
            executed: as of `Drawing.motion`.
        """
        self.stretches, start_s = [], 0.0
        for drawing in (*self.drawing.legs, self.drawing):
            times, q = drawing.motion(executed)
            self.stretches.append((start_s, drawing, times, q))
            start_s += float(times[-1])
        return start_s

    def at(self, time_s: float) -> None:
        """Puts the robot and the object where they are at a time of `play`.

        Args:
            time_s: since the motion, or its first leg, began.
        """
        start_s, drawing, times, q = [x for x in self.stretches if x[0] <= time_s + 1e-9][-1]
        self._pose(q[np.abs(times - (time_s - start_s)).argmin()], self.moving, drawing)

    def pose(self, q: Array) -> None:
        """Puts the robot and what it holds at posture q (joints,) rad."""
        self._pose(q, self.moving)

    def _pose(self, q: Array, bodies: Sequence[int], drawing: Drawing | None = None) -> None:
        drawing = drawing or self.drawing
        data, model, own = drawing.at(q), drawing.model, self.drawing.model
        for i in bodies:
            # a leg is a model of its own, in which the object may stand elsewhere in the tree
            k = i if model is own else int(model.body(own.body(i).name).id)
            handle = self.bodies[i]
            handle.position, handle.wxyz = data.xpos[k].copy(), data.xquat[k].copy()
        if self.open is not None:
            opened = drawing.stored.resting is not None
            body = data.body("gripper")
            self.open.position, self.open.wxyz = body.xpos.copy(), body.xquat.copy()
            self.open.visible = opened
            self.bodies[int(own.body("gripper").id)].visible = not opened

    def _open_gripper(self) -> Any:
        """The gripper of the leg in which it has not closed, hidden; None: there is no such leg."""
        legs = [leg for leg in self.drawing.legs if leg.stored.resting is not None]
        if not legs:
            return None
        leg, path = legs[0], f"{self.name}/gripper_open"
        frame = self.scene.add_frame(path, show_axes=False, visible=False)
        for g in leg.visual_geoms():
            if leg.body_of(g) == "gripper":
                made = leg.surface(g)
                name = f"{path}/{leg.model.geom(g).name.replace('/', '_')}"
                self.scene.add_mesh_simple(
                    name, made.vertices, made.faces, color=_rgb(made.rgba), flat_shading=True
                )
        return frame

    def show(self, group: str, shown: bool) -> None:
        """Shows or hides one group of MARKS."""
        for handle in self.marks[group]:
            handle.visible = shown

    def _add_surface(self, path: str, geom: int, rgba: Any = None, **how: Any) -> Any:
        made = self.drawing.surface(geom)
        *rgb, alpha = made.rgba if rgba is None else rgba
        return self.scene.add_mesh_simple(
            path, made.vertices, made.faces, color=_rgb(rgb), cast_shadow=alpha >= 1,
            flat_shading=self._flat(geom, len(made.faces)), opacity=None if alpha >= 1 else alpha,
            **how,
        )  # fmt: skip

    def _flat(self, geom: int, faces: int) -> bool:
        """Whether a surface has edges: all but people, hands and large meshes."""
        return faces < SMOOTH_FACES and self.drawing.body_of(geom) not in ("hand", "receiver")

    def _add_mark(self, path: str, mark: Mark) -> None:
        scene, handles, color = self.scene, self.marks[mark.group], _rgb(mark.rgba)
        if mark.geom >= 0:
            handles.append(self._add_surface(path, mark.geom, mark.rgba, side="double"))
        if mark.points is None:
            return
        if len(mark.points) == 1:
            shadows = {"cast_shadow": False, "receive_shadow": False}
            look = {"radius": mark.radius_m, "color": color, "opacity": mark.rgba[3], **shadows}
            handles.append(scene.add_icosphere(path, position=mark.points[0], **look))
        elif mark.arrow:
            r = mark.radius_m
            sizes = {"shaft_radius": r, "head_radius": 2.7 * r, "head_length": 6.7 * r}
            handles.append(scene.add_arrows(path, mark.points[None], np.array(color), **sizes))
        else:
            least = THIN_M if mark.group == "witness" else 0.0
            wide = {"thickness": 2 * max(mark.radius_m, least), "thickness_units": "world"}
            handles.append(scene.add_line_segments(path, mark.points[None], color, **wide))
        if mark.text:
            at = mark.points.mean(0) + ABOVE_M * self.drawing.up_in(mark.body)
            label = scene.add_label(f"{path}_label", mark.text, position=at, anchor="bottom-center")
            handles.append(label)


def moved(view: View, y_m: float) -> View:
    """The same camera, farther along y."""
    return replace(view, look_at=view.look_at + [0.0, y_m, 0.0])


def aim(server: Any, drawings: Sequence[Drawing]) -> View:
    """Puts the viewer's first camera where it sees all of the trials; one that fails from near, where
    it fails."""
    near = len(drawings) == 1 and drawings[0].stored.row["outcome"] != "success"
    view: View = view_of(drawings, ASPECT, close=near, apart_m=APART_M)
    view = replace(view, distance_m=max(view.distance_m, FIRST_M))
    camera = server.initial_camera
    camera.fov, camera.look_at = np.radians(FOV_DEG), view.look_at
    camera.position = view.look_at - view.distance_m * view.axes[2]
    return view


def light(server: Any) -> None:
    """Lights the scene, the same for every trial; nothing comes from a network."""
    scene = server.scene
    scene.set_up_direction("+z")
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/light/ambient", intensity=1.1)
    lamps = (((-0.6, -1.2, 2.4), 1.5), ((1.6, 1.0, 2.0), 1.2), ((0.3, 0.5, -1.0), 0.4))
    for k, (place, strength) in enumerate(lamps):
        scene.add_light_directional(f"/light/{k}", intensity=strength, position=place)


def write_page(stored: StoredTrial | Sequence[StoredTrial], file: str | Path) -> Path:
    """Writes a trial, or two side by side, as one page (about 2 MB) that needs no server.

    Args:
        stored: the trial, or the trials.
        file: the page to write.

    Returns:
        The page's path.

    Raises:
        UsageError: viser is missing.
        OSError: the file cannot be written.
    """
    path, some = Path(file), [stored] if isinstance(stored, StoredTrial) else stored
    write_text(path, page_of([Drawing(s) for s in some]))
    return path


def page_of(drawings: Sequence[Drawing]) -> str:
    """The page as text: viser's client, the recorded motion and a panel with the margins."""
    server = new_server(0)
    try:
        light(server)
        view = aim(server, drawings)
        drawn = [
            Drawn(server.scene, d, view, f"/trial_{k}", APART_M * k) for k, d in enumerate(drawings)
        ]
        recording = server.get_scene_serializer()
        moving = [d for d in drawn if d.drawing.stored.moves]
        end = max((d.play() for d in moving), default=0.0)
        at = np.linspace(0.0, end, max(2, round(end * FRAMES_PER_S)) if moving else 0)
        for k, t in enumerate(at):
            for d in moving:
                d.at(float(t))
            recording.insert_sleep(float(at[k + 1] - t) if k + 1 < len(at) else REST_S)
        html: str = recording.as_html()
    finally:
        stop_server(server)
    panel = files("r2h_batch.view").joinpath("panel.html").read_text(encoding="utf-8")
    panel = panel.replace("{{panel}}", "<hr>".join(map(as_html, drawings)))
    end_of_body = html.rindex("</body>")
    html = html[:end_of_body] + panel + html[end_of_body:]
    start, stop = html.find("<title>"), html.find("</title>")
    return html if start < 0 else f"{html[: start + 7]}{escape(title(drawings[0]))}{html[stop:]}"


def new_server(port: int) -> Any:
    """A viser server on 127.0.0.1 that only its own page can connect to; port 0: any free one.

    Any page in a browser may open a websocket to this machine, and viser accepts them all. So the
    `serve` of websockets that viser calls gets the page's Origin here.

    Raises:
        UsageError: viser is missing, or serves in another way.
    """
    try:
        import viser
        from websockets.asyncio import server as sockets
    except ImportError:
        raise UsageError("looking at trials needs viser: pip install 'r2h_batch[view]'") from None
    if not port:
        with closing(socket.socket()) as free:
            free.bind(("127.0.0.1", 0))
            port = int(free.getsockname()[1])
    guarded: list[int] = []

    class ServeOwnPage(sockets.serve):
        def __init__(self, handler: Any, host: str, port: int, **options: Any) -> None:
            options["origins"] = [f"http://{name}:{port}" for name in ("127.0.0.1", "localhost")]
            options["logger"] = _nobody()
            guarded.append(port)
            super().__init__(_without_traceback(handler), host, port, **options)

    before = sockets.serve
    sockets.serve = ServeOwnPage  # type: ignore[misc, assignment]
    try:
        with _no_banner():
            server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    finally:
        sockets.serve = before  # type: ignore[misc]
    if server.get_port() not in guarded:
        stop_server(server)
        words = f"viser {viser.__version__} does not let the viewer refuse pages of others"
        raise UsageError(f"{words}; install the version in constraints.txt")
    return server


def _nobody() -> logging.Logger:
    """A logger that prints nothing: websockets writes a traceback for each visitor that is no browser."""
    quiet = logging.getLogger("r2h_batch.view.connections")
    quiet.propagate, quiet.disabled = False, True
    return quiet


def _without_traceback(
    handler: Callable[[Any], Awaitable[None]],
) -> Callable[[Any], Awaitable[None]]:
    """A handler of a connection that a broken message ends with one line, not with viser's traceback."""

    async def handled(connection: Any) -> None:
        try:
            await handler(connection)
        except Exception as error:  # viser's parser raises whatever it meets
            why = f"{type(error).__name__}: {printable(error)}"[:160].rstrip(": ")
            LOG.info(f"view: a page sent a broken message and is disconnected ({why}); reload it")

    return handled


def stop_server(server: Any) -> None:
    """Ends a server and prints nothing: stdout is for answers."""
    with _no_banner():
        server.stop()


@contextmanager
def _no_banner() -> Iterator[None]:
    """Keeps viser from printing: its console (rich) writes past sys.stdout in notebooks."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


class Shown:
    """A trial's page inside a notebook; `html` is the page, `trial` what it shows."""

    def __init__(self, trial: StoredTrial, height: int) -> None:
        self.trial, self.height = trial, height
        self.html = page_of([Drawing(trial)])

    def __repr__(self) -> str:
        row, size_mb = self.trial.row, len(self.html) / 1e6
        return f"Shown(trial {row['trial_id']}, {row['outcome']}, {size_mb:.1f} MB)"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe style="{style}" srcdoc="{escape(self.html, quote=True)}"></iframe>'


def show(scores: Scores, *, height: int = 640) -> Shown:
    """Shows one judged handover in three dimensions in a notebook: `show(scores[3])`.

    The row is planned and moved again, to the same bits.

    Args:
        scores: one row of what `Evaluator.score` returned.
        height: of the frame, pixels.

    Returns:
        What the notebook displays.

    Raises:
        ValueError: `scores` has several rows, was made without its inputs, or was not judged.
    """
    instance_of(Scores, "what Evaluator.score returns")("scores", scores)
    height = integer(100, 10_000, " of pixels")("height", height)
    if len(scores) != 1 or scores.outcome.ndim != 1:
        shape = tuple(scores.outcome.shape)
        raise ValueError(f"show takes one row, given are {shape}; say show(scores[0])")
    inputs = scores.inputs
    if inputs is None:
        why = "captured, compiled, joined or loaded"
        raise ValueError(f"these scores hold no inputs ({why}); score again")
    if bool((scores.opening_m != scores.opening_m).any()):
        why = "its answer is not a pose"
        raise ValueError(f"this row was not judged ({why}): there is nothing to show")
    evaluator = inputs.evaluator
    trial = inputs.trials.named(evaluator.scene.objects)
    answer = Predictions(trial.trial_id, inputs.T_obj_ee, inputs.T_world_ee, method="shown")
    again = judged_again(evaluator, trial, answer, "shown")
    note = ""
    if bool(scores.path_len[0] > 0):  # of stages="pose" only margins without a path are the same
        names = TrialNames.of(evaluator.scene)
        row = score_rows(trial, scores, names).to_pylist()[0]
        row |= detail_rows(trial, scores, names).to_pylist()[0]
        note = difference(row, again.row)
    return Shown(replace(again, note=note), height)


def _rgb(color: Sequence[float]) -> tuple[int, int, int]:
    r, g, b = (int(np.clip(255 * float(c), 0, 255)) for c in list(color)[:3])
    return r, g, b
