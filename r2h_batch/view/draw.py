"""A trial in a viser scene: bodies that follow a posture, and the marks that say what the criteria
asked about."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.export.drawing import RED, Stage
from r2h_batch.export.mjcf_parts import COLORS_OF_MARKS
from r2h_batch.scene.model_parts import VISUAL
from r2h_batch.view.shapes import Shape, shape_of

Array = NDArray[np.float64]

MARKS = ("target", "region", "ball", "palm", "width", "witness")
"""What can be shown and hidden: see `Drawn.marks`."""
STANDING = ("world", "table", "hand", "target", "target_gripper", "receiver")
LIFT_M = 4e-4
"""The region is drawn this far outside of the object's surface, that both are not seen at once."""


class Drawn:
    """One trial under `name` in a viser scene, `offset` m to the side. `marks`: the handles of each
    mark."""

    def __init__(
        self,
        scene: Any,
        stage: Stage,
        name: str = "/trial",
        offset: tuple[float, float, float] = (0, 0, 0),
    ) -> None:
        self.scene, self.stage, self.name = scene, stage, name
        self.data = mujoco.MjData(stage.model)
        self.marks: dict[str, list[Any]] = {mark: [] for mark in MARKS}
        self.root = scene.add_frame(name, show_axes=False, position=offset)
        self.bodies: dict[int, Any] = {}
        self.moving: list[int] = []
        self.pose(stage.stored.target_q)
        self._add_bodies()
        self._add_marks()
        self.pose(stage.stored.target_q)

    def pose(self, q: Array) -> None:
        """Puts the robot and what it holds at posture q (6,) rad."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.stage.model, self.data)
        for i in self.moving:
            self.bodies[i].position, self.bodies[i].wxyz = (
                self.data.xpos[i].copy(),
                self.data.xquat[i].copy(),
            )

    def show(self, mark: str, shown: bool) -> None:
        """Shows or hides one of MARKS."""
        for handle in self.marks[mark]:
            handle.visible = shown

    def remove(self) -> None:
        """Takes the trial out of the scene."""
        self.root.remove()

    def _add_bodies(self) -> None:
        model = self.stage.model
        for i in range(1, model.nbody):
            body = model.body(i).name
            path = f"{self.name}/{body}"
            self.bodies[i] = self.scene.add_frame(
                path,
                show_axes=False,
                position=self.data.xpos[i].copy(),
                wxyz=self.data.xquat[i].copy(),
            )
            if body not in STANDING:
                self.moving.append(i)
            for g in np.flatnonzero(model.geom_bodyid == i):
                if model.geom_group[g] == VISUAL:
                    self._add_shape(
                        f"{path}/{model.geom(int(g)).name.replace('/', '_')}",
                        shape_of(model, int(g)),
                    )

    def _add_shape(self, path: str, shape: Shape, **how: Any) -> Any:
        opacity = how.pop("opacity", float(shape.rgba[3]))
        return self.scene.add_mesh_simple(
            path, shape.vertices, shape.faces, color=_rgb(how.pop("color", shape.rgba)), flat_shading=len(shape.faces) < 20000,
            opacity=None if opacity >= 1 else opacity, position=shape.pos, wxyz=shape.quat_wxyz, cast_shadow=opacity >= 1, **how,
        )  # fmt: skip

    def _add_marks(self) -> None:
        self._add_target_and_region()
        self._add_ball_and_palm()
        self._add_width()
        self._add_witness()

    def _add_target_and_region(self) -> None:
        model, stored = self.stage.model, self.stage.stored
        for g in range(model.ngeom):
            geom, body = model.geom(g).name, model.body(int(model.geom_bodyid[g])).name
            path = f"{self.name}/{body}/{geom.replace('/', '_')}_mark"
            if geom.startswith("target/"):
                handle = self._add_shape(
                    path, shape_of(model, g), visible=not stored.moves, side="double"
                )
                self.marks["target"].append(handle)
            elif geom == "object/region_visual":
                shape = _lifted(shape_of(model, g))
                self.marks["region"].append(
                    self._add_shape(path, shape, side="double", color=COLORS_OF_MARKS["region"])
                )

    def _add_ball_and_palm(self) -> None:
        model = self.stage.model
        ball, palm = self.data.site("ball"), self.data.site("palm")
        self.marks["ball"].append(
            self.scene.add_icosphere(
                f"{self.name}/ball", radius=float(model.site("ball").size[0]), color=_rgb(COLORS_OF_MARKS["ball"]),
                opacity=0.18, position=ball.xpos.copy(), cast_shadow=False, receive_shadow=False,
            )
        )  # fmt: skip
        normal = palm.xmat.reshape(3, 3)[:, 2]
        arrow = np.stack([palm.xpos, palm.xpos + 0.08 * normal])[None]
        self.marks["palm"].append(
            self.scene.add_arrows(
                f"{self.name}/palm", arrow, np.array(_rgb(COLORS_OF_MARKS["palm"])), shaft_radius=0.003, head_radius=0.008,
                head_length=0.02,
            )
        )  # fmt: skip

    def _add_width(self) -> None:
        """The pads, and a line as long as the material between them, in the gripper's frame."""
        model, width = self.stage.model, self.stage.stored.row["width_m"]
        body = int(model.geom_bodyid[model.geom("gripper/left_pad").id])
        path = f"{self.name}/{model.body(body).name}"
        ends = []
        for side in ("left", "right"):
            g = model.geom(f"gripper/{side}_pad").id
            pad = shape_of(model, g)
            self.marks["width"].append(
                self._add_shape(f"{path}/{side}_pad_mark", pad, color=(0.95, 0.8, 0.1), opacity=0.6)
            )
            ends.append(pad.pos)
        if width is None:
            return
        middle, along = (
            (ends[0] + ends[1]) / 2,
            (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]),
        )
        line = np.stack([middle - width / 2 * along, middle + width / 2 * along])[None]
        self.marks["width"].append(
            self.scene.add_line_segments(
                f"{path}/width", line, (240, 190, 20), thickness=0.003, thickness_units="world"
            )
        )
        self.marks["width"].append(
            self.scene.add_label(
                f"{path}/width_label",
                f"{1e3 * width:.1f} mm",
                position=middle,
                anchor="bottom-center",
            )
        )

    def _add_witness(self) -> None:
        """Of a failed Plan: the pair in red, the line between its nearest points, and the
        clearance; of a failed Safe the touch."""
        stage, row = self.stage, self.stage.stored.row
        if not stage.stored.moves and stage.witness is not None:
            model, witness = stage.model, stage.witness
            for name in witness.geoms:
                g = model.geom(name).id
                path = f"{self.name}/{model.body(int(model.geom_bodyid[g])).name}/{name.replace('/', '_')}_red"
                self.marks["witness"].append(
                    self._add_shape(path, shape_of(model, g), color=RED, opacity=0.75)
                )
            self._line(witness.line, witness.words)
        elif row["outcome"] == "safe" and row.get("witness_point_m"):
            point = np.array(row["witness_point_m"], np.float64)
            self.marks["witness"].append(
                self.scene.add_icosphere(
                    f"{self.name}/touch", radius=0.012, color=_rgb(RED), position=point
                )
            )
            part = str(row.get("witness_safe_part")).replace("_", " ")
            self._label(point, f"{part} meets the hand at {row['witness_time_s']:.1f} s")

    def _line(self, line: Array, words: str) -> None:
        self.marks["witness"].append(
            self.scene.add_line_segments(
                f"{self.name}/witness",
                line[None],
                _rgb(RED),
                thickness=0.004,
                thickness_units="world",
            )
        )
        for k, end in enumerate(line):
            self.marks["witness"].append(
                self.scene.add_icosphere(
                    f"{self.name}/witness_{k}", radius=0.005, color=_rgb(RED), position=end
                )
            )
        self._label(line.mean(0), words)

    def _label(self, at: Array, words: str) -> None:
        self.marks["witness"].append(
            self.scene.add_label(
                f"{self.name}/witness_label", words, position=at, anchor="bottom-center"
            )
        )


def look_at(server: Any, stage: Stage, aside: float = 0.0) -> None:
    """The viewer's first camera: from the receiver's side, hand and gripper beside each other;
    `aside` m of more trials."""
    data = mujoco.MjData(stage.model)
    data.qpos[:] = stage.stored.target_q
    mujoco.mj_kinematics(stage.model, data)
    camera = stage.camera(close=False)
    at = np.array(camera.lookat) + [0, aside / 2, -0.02]
    azimuth = 180.0 if aside else camera.azimuth  # two trials stand beside each other along y
    a, e = np.radians([azimuth, camera.elevation - 6.0])
    back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    at = at + (0.22 + 0.15 * aside) * right  # the panel stands on the right
    server.initial_camera.fov = np.radians(45.0)
    server.initial_camera.look_at = at
    server.initial_camera.position = at - (1.75 + 0.7 * aside) * back


def prepare(server: Any) -> None:
    """Light and background, the same for every trial; nothing comes from a network."""
    scene = server.scene
    scene.set_up_direction("+z")
    scene.configure_environment_map(None)
    scene.configure_default_lights(enabled=False)
    scene.add_light_ambient("/light/ambient", intensity=1.1)
    for k, (place, strength) in enumerate(
        (((-0.6, -1.2, 2.4), 1.5), ((1.6, 1.0, 2.0), 1.2), ((0.3, 0.5, -1.0), 0.4))
    ):
        scene.add_light_directional(f"/light/{k}", intensity=strength, position=place)


def _lifted(shape: Shape) -> Shape:
    """The surface a little outside of itself, along the normals of its vertices."""
    v, f = shape.vertices.astype(np.float64), shape.faces
    face_normal = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    normal = np.zeros_like(v)
    for k in range(3):
        np.add.at(normal, f[:, k], face_normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return Shape(
        (v + LIFT_M * normal).astype(np.float32), f, shape.pos, shape.quat_wxyz, shape.rgba
    )


def _rgb(color: Any) -> tuple[int, int, int]:
    r, g, b = (int(np.clip(255 * float(c), 0, 255)) for c in list(color)[:3])
    return r, g, b
