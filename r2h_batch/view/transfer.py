"""A film of a transfer: gripper, object and the person's hand, and the forces of arm and wrist as arrows."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.progress import progress
from r2h_batch.closed_loop.transfer.cases import Case, Simulator
from r2h_batch.closed_loop.transfer.handed import Handed, handed_of
from r2h_batch.closed_loop.transfer.model import TICK_S, Places, Setting, place, transfer_spec
from r2h_batch.closed_loop.transfer.worlds import Told
from r2h_batch.closed_loop.transfer.worlds_mujoco import MujocoWorlds
from r2h_batch.judge.grasp_physics import FINGERS
from r2h_batch.judge.reception import Reception, reception
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.runs.files import RunError
from r2h_batch.scene.model_parts import COLORS, add_mesh
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.offscreen import renderer
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep.results.reception import judge_of_bodies, judged_one
from r2h_batch.trials.holding.held_out import load_held_out
from r2h_batch.types import Scores
from r2h_batch.view.film import film_writer
from r2h_batch.view.pictures import Image
from r2h_batch.view.stored import Reader

Array = NDArray[np.float64]

ARM_COLOR, WRIST_COLOR = (0.10, 0.55, 0.25, 1.0), (0.80, 0.15, 0.15, 1.0)
M_PER_N, ARROW_M, LEAST_N = 0.012, 0.004, 0.3
"""Length of an arrow for a newton, its radius, and the smallest force that has one."""
CAMERA_M, FOV_DEG, FRONT_M = 0.7, 40.0, 0.12
"""Distance of the camera, its field of view, and how far arrows stand before what they belong to: nothing hides them."""
REST_S = 0.5
_SEEN: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0.0}


class Moment(NamedTuple):
    """A tick of a transfer: posture of the model, forces (N, frame gripper), effort of the fingers."""

    qpos: Array
    arm: Array
    wrist: Array
    effort: float


class _Recorder(MujocoWorlds):
    """Worlds that keep what happened to their first row."""

    def __init__(self, *args: Any) -> None:
        self.moments: list[Moment] = []
        super().__init__(*args)

    def step(self, told: Told, running: Any) -> None:
        super().step(told, running)
        seen = self.seen()
        arm, wrist = (x[0].numpy().copy() for x in (seen.arm, seen.load))
        self.moments.append(Moment(self.data[0].qpos.copy(), arm, wrist, float(told.effort[0])))


def write_transfer_film(
    reader: Reader,
    trial: int,
    method: str | None,
    case: Case,
    out: Path,
    *,
    size: tuple[int, int],
    fps: int,
    benchmark: BenchmarkChoice,
) -> str:
    """Simulates the transfer of a stored row and writes it as a film; how it ended.

    Args:
        reader: of the run folder.
        trial: number of the trial.
        method: its name or word; None: the only one.
        case: policy, scenario and person.
        out: .mp4, .webm or .gif.
        size: width and height, pixels.
        fps: pictures a second.
        benchmark: where its files are now, if they are not where the sweep found them.

    Raises:
        RunError: nobody receives the object of this row.
        RenderError: nothing draws here, or imageio or its ffmpeg is missing.
    """
    name = reader.method(method)
    reader.trial(trial, name)
    LOG.info(
        f"film {out.name}: trial {trial} of {name} is judged and its transfer simulated, some minutes"
    )
    run = reader.run.only([name])
    judge, _ = judge_of_bodies(run, benchmark, "cpu")
    trial_id, scores, _ = judged_one(run, name, judge, trial)
    shown = Shown.of(scores, trial_id, case)
    if shown is None:
        raise RunError(
            f"trial {trial} of {name!r}: nobody receives the object, so there is no transfer"
        )
    rest = round(REST_S * fps)
    total = shown.count(fps) + rest
    with film_writer(out, fps) as write, progress(f"film {out.name}", total, "pictures") as told:
        for k, image in enumerate(shown.images(size, fps)):
            last = k == shown.count(fps) - 1
            for _ in range(1 + rest * last):
                write(image)
                told(1)
    return shown.outcome


@dataclass(frozen=True)
class Shown:
    """A simulated transfer to look at.

    Attributes:
        model: gripper, object and hand, with what one sees.
        moments: of every tick.
        outcome: how it ended.
    """

    model: mujoco.MjModel
    moments: list[Moment]
    outcome: str

    @classmethod
    def of(cls, scores: Scores, trial_id: NDArray[np.int64], case: Case) -> "Shown | None":
        """Simulates the transfer of one row; None where nobody receives the object.

        Args:
            scores: one row with its inputs.
            trial_id: (1,) its trial.
            case: policy, scenario and person.
        """
        inputs = scores.inputs
        assert inputs is not None
        found, scene = reception(scores), inputs.evaluator.scene
        handed = handed_of(found, trial_id, inputs.trials, scene)
        if not len(handed):
            return None
        objects = tuple(scene.objects)
        kept: list[_Recorder] = []

        def worlds(*args: Any) -> MujocoWorlds:
            kept.append(_Recorder(*args))
            return kept[-1]

        (made,) = Simulator(scene.robot, objects, Setting(), 0, worlds).once(handed, [case])
        hand, own = _hand(found, handed, scene), objects[handed.object_index[0]]
        model = _shown(scene.robot, own, handed, hand)
        return cls(model, kept[0].moments, str(made.transfers.outcome[0]))

    def count(self, fps: int) -> int:
        """How many images there are."""
        return len(self._times(fps))

    def images(self, size: tuple[int, int], fps: int) -> Iterator[Image]:
        """The images, each with its time and forces in words.

        Args:
            size: width and height, pixels.
            fps: images a second.
        """
        model = self.model
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        data, places = mujoco.MjData(model), Places.of(model)
        with renderer(model, *size) as drawer:
            for t in self._times(fps):
                now = self.moments[min(int(t / TICK_S), len(self.moments) - 1)]
                data.qpos[:] = now.qpos
                mujoco.mj_forward(model, data)
                drawer.update_scene(data, "side")
                front = FRONT_M * data.cam_xmat[0].reshape(3, 3)[:, 2]
                pads = data.geom_xpos[places.pads].mean(0)
                _arrow(drawer.scene, data.xpos[places.hand_body] + front, now.arm, ARM_COLOR)
                _arrow(drawer.scene, pads + front, now.wrist, WRIST_COLOR)
                yield _captioned(np.array(drawer.render()), t, now)

    def _times(self, fps: int) -> Array:
        return np.arange(0.0, len(self.moments) * TICK_S, 1 / fps)


def _hand(found: Reception, handed: Handed, scene: Scene) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (frame gripper, m) and faces of the hand that takes the object."""
    index = int(handed.object_index[0])
    held_out = load_held_out(scene.objects, scene.hands.model, [index])
    grasps, row = held_out.grasps, int(held_out.first[index]) + int(found.grasp[0])
    T_world_hand, T_world_obj = (
        x[0].cpu().double().numpy() for x in (found.T_world_hand, found.T_world_obj)
    )
    T_obj_hand = grasps.T_obj_hand[row].double().numpy()
    T = (
        handed.T_gripper_obj[0]
        @ np.linalg.inv(T_world_obj)
        @ T_world_hand
        @ np.linalg.inv(T_obj_hand)
    )
    vertices = grasps.vertices[row].double().numpy() @ T[:3, :3].T + T[:3, 3]
    return vertices, scene.hands.model.faces_by_side[int(grasps.side[row])].numpy()


def _shown(
    robot: Robot,
    model: ObjectModel,
    handed: Handed,
    hand: tuple[Array, NDArray[np.int64]],
) -> mujoco.MjModel:
    """The model of the transfer with what one sees; the geoms weigh nothing and touch nothing."""
    spec = transfer_spec(robot, model, Setting())
    vertices, faces = hand
    center = handed.T_gripper_slip[0, :3, 3]
    add_mesh(spec, "skin", vertices - center, faces, convex=False)
    spec.body("hand").add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="skin", rgba=[*COLORS["hand"], 0.75], **_SEEN
    )
    for geom in spec.body("object").geoms:
        geom.rgba = [*COLORS["object"], 1]
    ends: list[tuple[Any, Any, float]] = [([0, 0, -0.06], [0, 0, 0.04], 0.035)]
    for name in FINGERS:
        spec.geom(name).rgba = [*COLORS["pad"], 1]
        ends.append(([0, 0, 0.03], spec.body(name).pos, 0.012))
        if (pad := spec.body(f"{name}_pad")) is not None:
            _tube(spec.body(name), [0, 0, 0], pad.pos, 0.007)
            _tube(pad, [0, 0, 0], spec.geom(name).pos, 0.006)
    for a, b, radius in ends:
        _tube(spec.body("gripper"), a, b, radius)
    up, approach = -handed.down[0], np.array([0.0, 0.0, 1.0])
    side = np.cross(approach, up)
    side = side / np.linalg.norm(side) if np.linalg.norm(side) > 0.1 else np.array([1.0, 0.0, 0.0])
    away = side + 0.35 * up
    away /= np.linalg.norm(away)
    right = np.cross(up, away)
    right /= np.linalg.norm(right)
    look_at = 0.5 * (handed.T_gripper_obj[0, :3, 3] + center)
    R = np.column_stack([right, np.cross(away, right), away])
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(R).ravel())
    spec.worldbody.add_camera(name="side", pos=look_at + CAMERA_M * away, quat=quat, fovy=FOV_DEG)
    spec.worldbody.add_light(
        pos=look_at + up, dir=-up, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.97, 0.97, 0.98], rgb2=[0.84, 0.86, 0.89], width=64, height=384,
    )  # fmt: skip
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    made = spec.compile()
    place(made, Places.of(made), handed.T_gripper_slip[0], handed.T_gripper_obj[0], arm_n_m=300.0)
    return made


def _tube(body: mujoco.MjsBody, a: Any, b: Any, radius: float) -> None:
    """A capsule between two points of a body that is only seen."""
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*a, *b], size=[radius, 0, 0], rgba=[*COLORS["gripper"], 1], **_SEEN
    )  # fmt: skip


def _arrow(scene: mujoco.MjvScene, start: Array, force: Array, rgba: tuple[float, ...]) -> None:
    if np.linalg.norm(force) < LEAST_N or scene.ngeom >= scene.maxgeom:
        return
    geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(
        geom, kind, np.zeros(3), start, np.eye(3).ravel(), np.array(rgba, np.float32)
    )
    mujoco.mjv_connector(geom, kind, ARROW_M, start, start + M_PER_N * force)
    scene.ngeom += 1


def _captioned(image: Image, t: float, now: Moment) -> Image:
    """The image with the time and the forces in words."""
    from PIL import Image as Picture
    from PIL import ImageDraw

    picture = Picture.fromarray(image)
    draw = ImageDraw.Draw(picture)
    arm, wrist = (float(np.linalg.norm(f)) for f in (now.arm, now.wrist))
    fingers = "fingers open" if now.effort < 0 else f"fingers press {100 * now.effort:.0f} %"
    lines = (
        (f"{t:.2f} s   {fingers}", (255, 255, 255)),
        (f"person's arm {arm:.1f} N", tuple(round(255 * c) for c in ARM_COLOR[:3])),
        (
            f"load on the robot's wrist {wrist:.1f} N",
            tuple(round(255 * c) for c in WRIST_COLOR[:3]),
        ),
    )
    for k, (words, color) in enumerate(lines):
        draw.rectangle(
            (6, 6 + 16 * k, 230, 21 + 16 * k), fill=(30, 30, 30) if k == 0 else (245, 245, 245)
        )
        draw.text((10, 7 + 16 * k), words, fill=color)
    return np.asarray(picture)
