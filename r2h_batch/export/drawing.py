"""Pictures of one trial, drawn by MuJoCo from the exported model: its motion, or what was asked
where there is none."""

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.robot import load_robot
from r2h_batch.export.mjcf_parts import MARK
from r2h_batch.export.stored import StoredTrial
from r2h_batch.export.trial import spec_of, trajectory
from r2h_batch.export.witness import Witness, nearest_pair, shortfall
from r2h_batch.io.write import atomic_path
from r2h_batch.scene.model_parts import SHADOW_PIXELS
from r2h_batch.scene.offscreen import RenderError, renderer

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

RED = (0.86, 0.10, 0.10, 0.85)
WITNESS_M = 0.004
"""Radius of the witness line's tube."""


class Stage:
    """One trial's compiled model, and pictures of it."""

    def __init__(self, stored: StoredTrial) -> None:
        self.stored = stored
        self.model = spec_of(stored).compile()
        self.robot = load_robot()

    @cached_property
    def witness(self) -> Witness | None:
        """What speaks against the posture asked for: how far it stays from an unreachable target;
        else the nearest pair, of the kind that the planner named where it named one, at home if
        that is what collides."""
        reason, pair = (self.stored.row.get(k) for k in ("plan_reason", "plan_pair"))
        if reason == "ik_unreachable":
            return shortfall(self.model, self.stored.target_q)
        q = (
            np.array(self.stored.workplace.home_q)
            if reason == "start_in_collision"
            else self.stored.target_q
        )
        return nearest_pair(self.model, self.robot, q, [pair] if pair else [])

    def motion(self, executed: bool = True) -> tuple[Array, Array]:
        """Times (N,) s and postures (N, 6) rad: as executed where that is asked for and was
        simulated, else as planned."""
        if executed and self.stored.executed_q is not None:
            sample_s = float(self.stored.header["motion"]["sample_s"])
            return np.arange(
                len(self.stored.executed_q), dtype=np.float64
            ) * sample_s, self.stored.executed_q
        return trajectory(self.stored)

    def pictures(
        self, postures: Iterable[Array], *, width: int, height: int, asked: bool = False, close: bool = False
    ) -> Iterator[Image]:  # fmt: skip
        """One picture (height, width, 3) of each posture; `asked`: with the ghost at the target and
        the nearest pair in red; `close`: the camera looks at the hand alone. Raises
        `RenderError`."""
        data, option = mujoco.MjData(self.model), mujoco.MjvOption()
        option.geomgroup[:] = [1, 1, 1, 0, asked, 0]
        option.sitegroup[:] = 0
        witness = self.witness if asked else None
        camera = self.camera(close)
        seen = self.model.vis
        seen.global_.offwidth, seen.global_.offheight = (
            width,
            height,
        )  # memory and time of every picture follow these
        seen.quality.shadowsize = min(SHADOW_PIXELS, 4 * max(width, height))
        with _Reddened(self.model, witness), renderer(self.model, width, height) as drawer:
            for q in postures:
                data.qpos[:] = q
                mujoco.mj_forward(self.model, data)
                drawer.update_scene(data, camera, option)
                if witness is not None:
                    _add_line(drawer.scene, witness)
                yield np.array(drawer.render())

    def camera(self, close: bool) -> mujoco.MjvCamera:
        """A free camera in front of the table that sees hand and gripper beside each other at the
        goal."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.stored.target_q
        mujoco.mj_forward(self.model, data)
        gripper, hand = data.site("target").xpos, data.geom("hand/mesh_visual").xpos
        flat = (hand - gripper)[:2] / max(float(np.linalg.norm((hand - gripper)[:2])), 1e-6)
        angles = np.radians(np.arange(90, 271, 5))  # looking towards -x, from the receiver's side
        side = np.abs(np.cos(angles) * flat[1] - np.sin(angles) * flat[0])
        camera = mujoco.MjvCamera()
        camera.azimuth = float(
            np.degrees(angles[np.argmax(side - 0.35 * np.cos(angles - np.pi) ** 2)])
        )
        camera.elevation = -14.0
        if close:
            camera.lookat[:], camera.distance = (gripper + hand) / 2, 0.75
        else:
            camera.lookat[:], camera.distance = [0.36, 0.6 * gripper[1], 0.30], 1.6
        return camera


class _Reddened:
    """The model with the two geoms of a witness red and seen, and as it was afterwards."""

    def __init__(self, model: mujoco.MjModel, witness: Witness | None) -> None:
        self.model = model
        self.ids = [] if witness is None else [model.geom(name).id for name in witness.geoms]
        self.kept = [(model.geom_rgba[i].copy(), int(model.geom_group[i])) for i in self.ids]

    def __enter__(self) -> None:
        for i in self.ids:
            self.model.geom_rgba[i], self.model.geom_group[i] = RED, MARK

    def __exit__(self, *_: object) -> None:
        for i, (rgba, group) in zip(self.ids, self.kept, strict=True):
            self.model.geom_rgba[i], self.model.geom_group[i] = rgba, group


def _add_line(scene: mujoco.MjvScene, witness: Witness) -> None:
    """The line between the nearest points: a tube, so that it is seen from far."""
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        np.zeros(3),
        np.zeros(3),
        np.zeros(9),
        np.array(RED, np.float32),
    )
    mujoco.mjv_connector(
        geom, mujoco.mjtGeom.mjGEOM_CAPSULE, WITNESS_M, witness.line[0], witness.line[1]
    )
    scene.ngeom += 1


def render_strip(
    stored: StoredTrial,
    png: str | Path,
    *,
    moments: Sequence[float] = (0.0, 0.6, 1.0),
    width: int = 600,
    height: int = 600,
) -> None:
    """A picture of the trial: moments (fractions of its duration) side by side; without a motion,
    home and the posture that was asked for, from afar and near. Raises `RenderError`."""
    stage = Stage(stored)
    if stored.moves:
        times, q = stage.motion()
        postures = [q[np.abs(times - f * times[-1]).argmin()] for f in moments]
        frames = list(stage.pictures(postures, width=width, height=height))
    else:
        both = [np.array(stored.workplace.home_q), stored.target_q]
        frames = list(stage.pictures(both, width=width, height=height, asked=True))
        frames += stage.pictures(
            [stored.target_q], width=width, height=height, asked=True, close=True
        )
    save_picture(png, np.concatenate(frames, axis=1))


def save_picture(file: str | Path, image: Image) -> None:
    """Writes a picture in the format that its name says; raises `RenderError` where the library for
    that is not there."""
    try:
        import imageio.v3 as imageio
    except ImportError:
        raise RenderError("pictures need imageio: pip install 'r2h_batch[view]'") from None
    data = imageio.imwrite(
        "<bytes>", image, extension=Path(file).suffix
    )  # a file that PIL cannot close is a traceback
    with atomic_path(Path(file)) as temporary:
        temporary.write_bytes(data)
