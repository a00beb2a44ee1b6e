"""Data of airo-models about the robot: joints, linkage, visual meshes in our frames."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import airo_models
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MODELS = Path(airo_models.__file__).resolve().parent
GRIPPER_URDF = MODELS / "grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf"
GRIPPER_MESHES = MODELS / "grippers/robotiq_2f_85/meshes/visual"

ARM_LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
FINGER_PARTS = ("outer_knuckle", "outer_finger", "inner_finger", "inner_knuckle")
GRIPPER_OFFSET_M = 0.011  # flange to gripper base: what the UR coupling adds
COUPLING_LOW_M = -0.007  # lowest point of the coupling's mesh, which lies on the flange


def arm_urdf(arm: str) -> Path:
    """The URDF of an arm: ur3e or ur5e."""
    return MODELS / f"arms/{arm}/{arm}.urdf"


def urdf(path: Path) -> ElementTree.Element:
    """The parsed URDF without Drake's undeclared prefix."""
    return ElementTree.fromstring(re.sub(r"drake:", "", path.read_text()))


def origin(element: ElementTree.Element) -> Array:
    """T_parent_child of a joint, or T_link_visual of a visual."""
    from scipy.spatial.transform import Rotation  # 0.3 s, and only a model of MuJoCo's needs it

    node = element.find("origin")
    T = np.eye(4)
    if node is not None:
        T[:3, :3] = Rotation.from_euler(
            "xyz", [float(v) for v in node.get("rpy", "0 0 0").split()]
        ).as_matrix()
        T[:3, 3] = [float(v) for v in node.get("xyz", "0 0 0").split()]
    return T


def named(root: ElementTree.Element, tag: str) -> dict[str, ElementTree.Element]:
    return {str(e.get("name")): e for e in root.findall(tag)}


def exact(T: Array) -> list[list[float]]:
    """Entries rounded to 1e-9: the URDF's 1.570796327 becomes a quarter turn, 1e-11 m become 0."""
    return (np.round(T, 9) + 0.0).tolist()


def joint_rows(arm: str = "ur5e") -> tuple[list[dict[str, Any]], Array]:
    """The six joints for robot.json, and T_wrist3_flange."""
    path = arm_urdf(arm)
    joints = named(urdf(path), "joint")
    moving = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    names = [f"{j}_joint" for j in moving]
    T_before = origin(joints["base_link-base_link_inertia"])
    rows = []
    for name in names:
        limit = joints[name].find("limit")
        axis = joints[name].find("axis")
        if limit is None or axis is None or axis.get("xyz") != "0 0 1":
            raise ValueError(f"{name} in {path.name} has no limit or another axis than z")
        given = ("lower", "upper", "velocity", "effort")
        keys = ("lower", "upper", "max_velocity", "max_torque")
        numbers = {k: float(limit.attrib[v]) for k, v in zip(keys, given, strict=True)}
        T = exact(T_before @ origin(joints[name]))
        rows.append({"name": name, "T_parent_joint": T, **numbers})
        T_before = np.eye(4)
    return rows, origin(joints["wrist_3-flange"]) @ origin(joints["flange-tool0"])


def linkage() -> dict[str, Any]:
    """Pivots of the right finger in the gripper frame, from the gripper's URDF."""
    joints = named(urdf(GRIPPER_URDF), "joint")
    limit = joints["finger_joint"].find("limit")
    box = named(urdf(GRIPPER_URDF), "link")["right_inner_finger_pad"].find("visual/geometry/box")
    if limit is None or box is None:
        raise ValueError(
            f"{GRIPPER_URDF.name} lacks the limit of finger_joint or the box of right_inner_finger_pad"
        )
    yz = {
        n: origin(joints[f"right_{n}_joint"])[1:3, 3] for n in (*FINGER_PARTS, "inner_finger_pad")
    }
    return {
        "driver_pivot_yz": np.round(yz["outer_knuckle"], 9).tolist(),
        "pin_from_driver_yz": np.round(yz["outer_finger"] + yz["inner_finger"], 9).tolist(),
        "inner_knuckle_pivot_yz": np.round(yz["inner_knuckle"], 9).tolist(),
        "pad_from_pin_yz": np.round(yz["inner_finger_pad"], 12).tolist(),
        "pad_half_size": [float(v) / 2 for v in box.attrib["size"].split()],
        "drive_lower": float(limit.attrib["lower"]),
        "drive_upper": float(limit.attrib["upper"]),
    }


def part_origin(part: str) -> Array:
    """Origin of a right finger part's frame in the gripper frame at drive angle 0 (the frames are
    not turned)."""
    joints = named(urdf(GRIPPER_URDF), "joint")
    chain = {
        "outer_knuckle": ["outer_knuckle"],
        "outer_finger": ["outer_knuckle", "outer_finger"],
        "inner_finger": ["outer_knuckle", "outer_finger", "inner_finger"],
        "pad": ["outer_knuckle", "outer_finger", "inner_finger", "inner_finger_pad"],
        "inner_knuckle": ["inner_knuckle"],
    }[part]
    return np.sum([origin(joints[f"right_{name}_joint"])[:3, 3] for name in chain], axis=0)


def visual_triangles(name: str, arm: str = "ur5e") -> Array:
    """Faces (F, 3, 3) of a link of an arm of airo-models in its frame, of `body` in the gripper frame, of a finger part
    in its own."""
    if name in ARM_LINKS:
        path_of_arm = arm_urdf(arm)
        link_name = "base_link_inertia" if name == "base" else f"{name}_link"
        visual = named(urdf(path_of_arm), "link")[link_name].find("visual")
        mesh = None if visual is None else visual.find("geometry/mesh")
        if visual is None or mesh is None:
            raise ValueError(f"{link_name} in {path_of_arm.name} has no visual mesh")
        T, path = origin(visual), path_of_arm.parent / mesh.attrib["filename"]
        # named in the URDF with cable and labels: the same mesh without them, seen from base_link
        if name == "base":
            T = origin(named(urdf(path_of_arm), "joint")["base_link-base_link_inertia"]) @ T
            path = path.with_name("base.obj")
        return _triangles(path, T)
    if name == "body":
        millimetres = np.diag([1e-3, 1e-3, 1e-3, 1.0])
        millimetres[2, 3] = -GRIPPER_OFFSET_M - COUPLING_LOW_M
        coupling = _triangles(GRIPPER_MESHES / "robotiq_gripper_coupling.obj", millimetres)
        body = _triangles(GRIPPER_MESHES / "robotiq_arg2f_85_base_link.obj", np.eye(4))
        return np.concatenate([body, coupling])
    millimetres = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    return _triangles(GRIPPER_MESHES / f"robotiq_arg2f_85_{name}.obj", millimetres)


def _triangles(path: Path, T: Array) -> Array:
    import trimesh  # 0.3 s: only pictures need it

    mesh = trimesh.load_mesh(path, process=False)
    return np.asarray(trimesh.transform_points(mesh.vertices, T)[mesh.faces], dtype=np.float64)
