"""A trial as a self-contained MJCF folder: what the planner checks as collision geoms, what one sees as visual geoms."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Kind, Primitives, Robot, drive_from_gap, finger_motion, gripper_primitives_at
from r2h_batch.bodies.robot_visuals import part_origin, visual_triangles
from r2h_batch.config import Workplace
from r2h_batch.scene.model_parts import (
    AMBIENT,
    COLORS,
    DIFFUSE,
    LIGHTS,
    PICTURE_PIXELS,
    SEEN_CENTER,
    SEEN_EXTENT_M,
    SHADOW_PIXELS,
    SKY,
    SKY_PIXELS,
)
from r2h_batch.scene.tables import TABLE_FROM_LINK, Hands

Array = NDArray[np.float64]

_TYPES = {Kind.SPHERE: "sphere", Kind.CAPSULE: "capsule", Kind.CYLINDER: "cylinder", Kind.BOX: "box"}
_VISUAL = {"contype": "0", "conaffinity": "0", "group": "2", "mass": "0"}
_COLORS = {
    name: " ".join(f"{x:.2f}" for x in (*rgb, 0.4 if name == "collision" else 1)) for name, rgb in COLORS.items()
}


@dataclass(frozen=True)
class TrialBodies:
    """Where one trial's bodies are: `T_obj_ee` as attached (after closing), hand in the world, gap between the pads."""

    object: ObjectModel
    object_collision: str  # "hull" or "pieces", as planned with
    hand_index: int
    T_obj_ee: Array
    T_world_hand: Array
    opening_m: float
    workplace: Workplace = field(default_factory=Workplace)


def write_scene(
    folder: Path, robot: Robot, hands: Hands, trial: TrialBodies, keyframes: Iterable[tuple[str, Array]] = ()
) -> Path:
    """`scene.xml` and `meshes/` in `folder`: loads in plain MuJoCo from anywhere. Returns the path of scene.xml.

    Contacts are left between exactly the pairs that planning checks (MuJoCo makes none between bodies that both stand
    still, as base and hand do).
    """
    return _Writer(folder, robot, hands, trial).write(keyframes)


class _Writer:
    def __init__(self, folder: Path, robot: Robot, hands: Hands, trial: TrialBodies) -> None:
        self.folder, self.robot, self.hands, self.trial = folder, robot, hands, trial
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        self.root = Element("mujoco", model="r2h_batch trial")
        SubElement(self.root, "compiler", angle="radian", meshdir="meshes", autolimits="true")
        option = SubElement(self.root, "option", gravity="0 0 0", ccd_iterations="200", ccd_tolerance="1e-9")
        SubElement(option, "flag", filterparent="disable")  # every pair is named below
        visual = SubElement(self.root, "visual")
        SubElement(visual, "headlight", ambient=_gray(AMBIENT), diffuse=_gray(DIFFUSE), specular=_gray(0))
        SubElement(visual, "global", offwidth=str(PICTURE_PIXELS[0]), offheight=str(PICTURE_PIXELS[1]))
        SubElement(visual, "quality", shadowsize=str(SHADOW_PIXELS), offsamples="8")
        SubElement(self.root, "statistic", center=_words(SEEN_CENTER), extent=str(SEEN_EXTENT_M))
        self.asset = SubElement(self.root, "asset")
        sky = {"type": "skybox", "builtin": "gradient", "rgb1": _words(SKY[0]), "rgb2": _words(SKY[1])}
        SubElement(self.asset, "texture", sky, width=str(SKY_PIXELS[0]), height=str(SKY_PIXELS[1]))
        self.worldbody = SubElement(self.root, "worldbody")
        for lamp in LIGHTS:
            shadow = {} if lamp.shadow else {"castshadow": "false"}
            place = {"pos": _words(lamp.pos), "dir": _words(lamp.dir)}
            SubElement(self.worldbody, "light", {**place, "diffuse": _gray(lamp.diffuse), **shadow})

    def write(self, keyframes: Iterable[tuple[str, Array]]) -> Path:
        table, at = SubElement(self.worldbody, "body", name="table"), self.trial.workplace
        box = {"type": "box", "size": _text(at.table_half), "pos": _text(at.table_center)}
        SubElement(table, "geom", {"name": "table/top", **box, **_collision()})
        SubElement(table, "geom", {"name": "table/top_visual", **box, **_VISUAL, "rgba": _COLORS["table"]})
        self._add_object(self._add_gripper(self._add_arm()))
        self._add_hand()
        self._add_exclusions()
        frames = SubElement(self.root, "keyframe")
        for name, q in keyframes:
            SubElement(frames, "key", name=name, qpos=_text(q))
        ElementTree.indent(self.root)
        path = self.folder / "scene.xml"
        ElementTree.ElementTree(self.root).write(path, encoding="utf-8", xml_declaration=True)
        return path

    def _add_arm(self) -> Element:
        robot, body = self.robot, self.worldbody
        for k, link in enumerate(robot.links[:7]):
            frame = _pose(robot.T_parent_joint[k - 1]) if k else {}
            body = SubElement(body, "body", {"name": link, **frame})
            if k:
                limits = _text([robot.lower[k - 1], robot.upper[k - 1]])
                SubElement(body, "joint", name=robot.joints[k - 1], axis="0 0 1", range=limits, damping="1")
            for i in np.flatnonzero(robot.arm.link == k):
                self._add_primitive(body, f"robot/{robot.arm.names[i]}", robot.arm, int(i), robot.arm.T_link_prim[i])
            self._add_visual(body, f"robot/{link}_visual", visual_triangles(link), np.eye(4), _COLORS[link])
        return body

    def _add_gripper(self, wrist: Element) -> Element:
        robot, gap = self.robot, self.trial.opening_m
        T_wrist_gripper = robot.T_wrist3_flange @ robot.T_flange_gripper
        body = SubElement(wrist, "body", {"name": "gripper", **_pose(T_wrist_gripper)})
        T_gripper_ee = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee
        poses = T_gripper_ee @ gripper_primitives_at(robot, gap)
        for i, name in enumerate(robot.gripper.names):
            self._add_primitive(body, f"gripper/{name}", robot.gripper, i, poses[i])
        self._add_visual(body, "gripper/body_visual", visual_triangles("body"), np.eye(4), _COLORS["gripper"])
        turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # the left finger is the right one turned about the approach axis
        seen = set()
        for part, motion, side in zip(robot.gripper_part, robot.gripper_motion, robot.gripper_side, strict=True):
            if side == 0 or (part, side) in seen:
                continue
            seen.add((part, side))
            origin = np.eye(4)
            origin[:3, 3] = part_origin(part)
            T = (
                finger_motion(robot, motion, int(side), drive_from_gap(gap))
                @ (turned if side < 0 else np.eye(4))
                @ origin
            )
            name = f"gripper/{'left' if side < 0 else 'right'}_{part}_visual"
            if part == "pad":  # a box in the model it comes from
                box = {"type": "box", "size": _text(robot.linkage.pad_half_size), "rgba": _COLORS["pad"]}
                SubElement(body, "geom", {"name": name, **box, **_pose(T), **_VISUAL})
            else:
                self._add_visual(body, name, visual_triangles(part), T, _COLORS["gripper"], mesh=f"gripper_{part}")
        return wrist

    def _add_object(self, wrist: Element) -> None:
        robot, model = self.robot, self.trial.object
        T = robot.T_wrist3_flange @ robot.T_flange_ee @ np.linalg.inv(self.trial.T_obj_ee)
        body = SubElement(wrist, "body", {"name": "object", **_pose(T)})
        xx, yy, zz, xy, xz, yz = (model.inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        inertia = _text([xx, yy, zz, xy, xz, yz])
        SubElement(body, "inertial", pos=_text(model.com), mass=_text([model.mass]), fullinertia=inertia)
        if self.trial.object_collision == "hull":
            self._add_convex(body, "object/hull", model.hull_vertices)
        else:
            for k, (points, _) in enumerate(model.pieces):
                self._add_convex(body, f"object/piece_{k}", points)
        self._add_visual(body, "object/mesh_visual", model.vertices[model.faces], np.eye(4), _COLORS["object"])

    def _add_hand(self) -> None:
        hands, k = self.hands, self.trial.hand_index
        body = SubElement(self.worldbody, "body", {"name": "hand", **_pose(self.trial.T_world_hand)})
        for i, name in enumerate(hands.model.piece_names):
            self._add_convex(body, f"hand/{name}", hands.piece_points(k, i))
        faces = hands.model.faces_by_side[int(hands.set.side[k])].numpy()
        vertices = hands.vertices[k].numpy()
        self._write_obj("hand_mesh", vertices, faces)
        self._mesh_geom(
            body, "hand/mesh_visual", "hand_mesh", {**_VISUAL, "rgba": _COLORS["hand"]}, file="hand_mesh.obj"
        )

    def _add_exclusions(self) -> None:
        robot, contact = self.robot, SubElement(self.root, "contact")
        checked = {frozenset((robot.links[a], robot.links[b])) for a, b in robot.self_pairs}
        checked |= {frozenset(("object", robot.links[a])) for a in robot.object_pairs}
        checked |= {frozenset((link, "hand")) for link in (*robot.links, "object")}
        checked |= {frozenset((link, "table")) for link in (*robot.links[TABLE_FROM_LINK:], "object")}
        for a, b in combinations((*robot.links, "object", "hand", "table"), 2):
            if frozenset((a, b)) not in checked:
                SubElement(contact, "exclude", body1=a, body2=b)

    def _add_primitive(self, body: Element, name: str, shapes: Primitives, i: int, T: Array) -> None:
        kind = Kind(int(shapes.kind[i]))
        size = shapes.size[i][: {Kind.SPHERE: 1, Kind.BOX: 3}.get(kind, 2)]
        SubElement(body, "geom", {"name": name, "type": _TYPES[kind], "size": _text(size), **_pose(T), **_collision()})

    def _add_convex(self, body: Element, name: str, points: NDArray[np.float32]) -> None:
        hull = ConvexHull(points.astype(np.float64))
        at = np.full(len(points), -1)
        at[hull.vertices] = np.arange(len(hull.vertices))
        inward = np.einsum(
            "fi,fi->f",
            np.cross(*np.moveaxis(np.diff(points[hull.simplices].astype(np.float64), axis=1), 1, 0)),
            hull.equations[:, :3],
        )
        faces = np.where((inward < 0)[:, None], hull.simplices[:, ::-1], hull.simplices)
        mesh = name.replace("/", "_")
        self._write_obj(mesh, points[hull.vertices], at[faces])
        self._mesh_geom(body, name, mesh, _collision(), file=f"{mesh}.obj", inertia="convex")

    def _add_visual(
        self, body: Element, name: str, triangles: NDArray[np.floating], T: Array, rgba: str, mesh: str = ""
    ) -> None:
        mesh = mesh or name.replace("/", "_").removesuffix("_visual")
        path = self.folder / "meshes" / f"{mesh}.stl"
        if not any(m.get("name") == mesh for m in self.asset):
            _write_stl(path, triangles)
        self._mesh_geom(body, name, mesh, {**_pose(T), **_VISUAL, "rgba": rgba}, file=path.name)

    def _mesh_geom(
        self, body: Element, name: str, mesh: str, attributes: dict[str, str], *, file: str, inertia: str = "shell"
    ) -> None:
        if not any(m.get("name") == mesh for m in self.asset):
            SubElement(self.asset, "mesh", name=mesh, file=file, inertia=inertia)
        SubElement(body, "geom", {"name": name, "type": "mesh", "mesh": mesh, **attributes})

    def _write_obj(self, mesh: str, vertices: NDArray[np.float32], faces: NDArray[np.integer]) -> None:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
        (self.folder / "meshes" / f"{mesh}.obj").write_text("\n".join(lines) + "\n")


def _write_stl(path: Path, triangles: NDArray[np.floating]) -> None:
    """Binary STL; normals are left to the reader."""
    rows = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = triangles
    path.write_bytes(bytes(80) + np.uint32(len(triangles)).tobytes() + rows.tobytes())


def _collision() -> dict[str, str]:
    return {"group": "3", "rgba": _COLORS["collision"]}


def _pose(T: Array) -> dict[str, str]:
    quat_wxyz = Rotation.from_matrix(np.asarray(T)[:3, :3]).as_quat(canonical=True, scalar_first=True)
    return {"pos": _text(np.asarray(T)[:3, 3]), "quat": _text(quat_wxyz)}


def _words(values: Iterable[float]) -> str:
    """Numbers as they are written in the source: 1, not 1.0."""
    return " ".join(map(str, values))


def _gray(value: float) -> str:
    return _words([value] * 3)


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
