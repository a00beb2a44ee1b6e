"""An MJCF as the URDF that says the same, so that a robot is read in one way.

MuJoCo reads the file: its classes, angles and frames. It sees text alone, with nothing in it but bodies,
joints, geoms, masses and motors, so it opens no file: meshes are named in the URDF, and read as a URDF's.
"""

import warnings
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.io.read import FileError, path_within, printable

Array = NDArray[np.float64]

SPEED_RAD_S = 2.0
"""Of a joint: an MJCF has no limits of speed [choice]."""
MAX_INCLUDES, MAX_ELEMENTS = 16, 4096
_IN_BODY = {"body", "frame", "joint", "freejoint", "geom", "inertial"}
_MOTORS = {"motor", "general", "position", "velocity", "intvelocity", "damper"}
READ: dict[str, set[str]] = {
    "mujoco": {"compiler", "default", "asset", "worldbody", "actuator", "equality"},
    "default": {"default", "mesh", "geom", "joint", *_MOTORS},
    "asset": {"mesh"}, "worldbody": _IN_BODY, "body": _IN_BODY, "frame": _IN_BODY,
    "actuator": _MOTORS, "equality": {"joint"},
}  # fmt: skip
"""Element -> those of its children that say what a robot is."""
REFUSED = {
    "plugin": "plugins run code", "extension": "plugins run code",
    "attach": "write the other model's bodies into it", "model": "write the other model's bodies into it",
    "replicate": "save it with MuJoCo, which writes all copies",
    "composite": "it is not a rigid body", "flexcomp": "it is not a rigid body",
}  # fmt: skip
COMPILER = {
    "angle", "eulerseq", "autolimits", "inertiafromgeom", "inertiagrouprange", "settotalmass",
    "boundmass", "boundinertia", "balanceinertia",
}  # fmt: skip
"""What MuJoCo hears of <compiler>; the folders of meshes are read here."""


def as_urdf(root: Element, path: Path, parse: Callable[[Path], Element]) -> Element:
    """The <robot> that says what a <mujoco> says: a link for each body, named alike.

    A hinge without a range turns continuously. A joint's torque is the limit of its forces, or of its
    motor's. Geoms that collide with nothing are what is seen.

    Args:
        root: the file's.
        path: the file: its meshes and includes lie in its folder.
        parse: reads the root of another such file, bounded in size, without a document type.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    shown = printable(path)
    try:
        _include(root, path, parse, [MAX_INCLUDES])
        kept = _kept(root)
    except RecursionError:
        raise FileError(f"{shown}: is nested too deeply") from None
    if (count := sum(1 for _ in kept.iter())) > MAX_ELEMENTS:
        raise FileError(f"{shown}: {count} elements say what it is; {MAX_ELEMENTS} are allowed")
    for element in root.iter():
        if element.tag in REFUSED or "plugin" in element.attrib:
            tag = element.tag if element.tag in REFUSED else "plugin"
            raise FileError(f"{shown}: <{tag}> is not read: {REFUSED[tag]}; remove it")
    folder = ""
    for compiler in root.findall("compiler"):
        folder = compiler.get("meshdir", compiler.get("assetdir", folder))
    try:
        text = ElementTree.tostring(kept, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text)
        files = _take_meshes(spec, folder, shown)
        own = [_own_mass(spec, body) for body in spec.bodies]
        meshes = _take_mesh_geoms(spec, files, shown)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a model that cannot be simulated
            model = spec.compile()
    except FileError:
        raise
    except (ValueError, mujoco.FatalError) as error:
        why = printable(" ".join(str(error).split()))[:160]
        raise FileError(f"{shown}: MuJoCo: {why}") from None
    numbers = (
        model.body_pos, model.body_quat, model.body_ipos, model.body_iquat, model.body_inertia, model.body_mass,
        model.jnt_pos, model.jnt_axis, model.geom_pos, model.geom_quat, model.geom_size, model.qpos0,
    )  # fmt: skip
    if not all((np.abs(x) < 1e6).all() for x in numbers):
        raise FileError(f"{shown}: a place, size or mass is not finite or above a million")
    return _urdf(model, meshes, own)


def _include(at: Element, path: Path, parse: Callable[[Path], Element], left: list[int]) -> None:
    """Puts what an <include> names in its place."""
    for i, child in reversed(list(enumerate(at))):
        if child.tag == "include":
            left[0] -= 1
            if left[0] < 0:
                raise FileError(f"{printable(path)}: more than {MAX_INCLUDES} includes")
            other = parse(path_within(path.parent, child.get("file", "")))
            at[i : i + 1] = list(other)
            _include(at, path, parse, left)
            return
        _include(child, path, parse, left)


def _kept(element: Element) -> Element:
    """The element with those of its children that `READ` names, and nothing that names a file but meshes."""
    attributes = dict(element.attrib)
    attributes.pop("material", None)
    if element.tag == "compiler":
        attributes = {k: v for k, v in attributes.items() if k in COMPILER}
    kept = Element(element.tag, attributes)
    for child in element:
        motor = element.tag == "actuator" and "joint" not in child.attrib  # of a tendon, a site
        if child.tag in READ.get(element.tag, ()) and not motor:
            kept.append(_kept(child))
    return kept


def _take_meshes(spec: mujoco.MjSpec, folder: str, shown: str) -> dict[str, tuple[str, Array]]:
    """Mesh -> its file beside the MJCF and its scale; MuJoCo has none of them any more."""
    found = {}
    for mesh in list(spec.meshes):
        if not mesh.file or mesh.refpos.any() or not np.array_equal(mesh.refquat, [1, 0, 0, 0]):
            what = "needs a file, and neither refpos nor refquat"
            raise FileError(f"{shown}: mesh {printable(mesh.name)[:60]} {what}")
        found[mesh.name] = str(PurePosixPath(folder, mesh.file)), np.array(mesh.scale)
        spec.delete(mesh)
    return found


def _own_mass(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> bool:
    """Whether the file says a body's mass: in its <inertial>, or by geoms that are no meshes."""
    given = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    low, high = spec.compiler.inertiagrouprange
    weighs = [g for g in body.geoms if low <= g.group <= high and g.mass != 0 and g.density != 0]
    return (given and bool(body.explicitinertial)) or not any(g.meshname for g in weighs)


def _take_mesh_geoms(
    spec: mujoco.MjSpec, files: dict[str, tuple[str, Array]], shown: str
) -> dict[int, tuple[str, Array]]:
    """Number of each geom that is a mesh -> file and scale. To MuJoCo it is a ball without mass, at the same place."""
    found = {}
    for i, geom in enumerate(spec.geoms):
        if geom.type != mujoco.mjtGeom.mjGEOM_MESH:
            if geom.meshname:
                raise FileError(f"{shown}: a geom is fitted to a mesh; write its own size")
            continue
        if geom.meshname not in files:
            raise FileError(f"{shown}: a geom names no mesh: {printable(geom.meshname)[:60]!r}")
        found[i] = files[geom.meshname]
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_SPHERE, ""
        geom.size, geom.mass = [1.0, 0.0, 0.0], 0.0
    return found


def _urdf(model: mujoco.MjModel, meshes: dict[int, tuple[str, Array]], own: list[bool]) -> Element:
    robot = Element("robot")
    links = ["world", *(model.body(i).name or f"body{i}" for i in range(1, model.nbody))]
    # a URDF's joint turns about its link's origin: the link's frame lies at the joint's anchor
    T_body_link = np.tile(np.eye(4), (model.nbody, 1, 1))
    for j in range(model.njnt):
        T_body_link[model.jnt_bodyid[j], :3, 3] = model.jnt_pos[j]
    T_link_body = np.linalg.inv(T_body_link)
    for i, name in enumerate(links):
        link = SubElement(robot, "link", name=name)
        if own[i] and model.body_mass[i] > 0:
            _add_inertial(link, model, i, T_link_body[i])
        for g in np.flatnonzero(model.geom_bodyid == i):
            seen = not (model.geom_contype[g] or model.geom_conaffinity[g])
            shape = SubElement(link, "visual" if seen else "collision")
            T = T_link_body[i] @ _pose(model.geom_pos[g], model.geom_quat[g])
            SubElement(shape, "origin", _place(T))
            _add_shape(SubElement(shape, "geometry"), model, int(g), meshes)
        if i:
            parent = int(model.body_parentid[i])
            T = T_link_body[parent] @ _pose(model.body_pos[i], model.body_quat[i]) @ T_body_link[i]
            _add_joint(robot, model, i, links[parent], name, T)
    return robot


def _add_joint(
    robot: Element, model: mujoco.MjModel, body: int, parent: str, child: str, T: Array
) -> None:
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    kinds = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
    kind = "fixed" if count == 0 else "several joints" if count > 1 else "free"
    if count == 1:
        kind = kinds.get(mujoco.mjtJoint(model.jnt_type[first]), "free or a ball")
    name = _joint_name(model, first) if count == 1 else f"joint_of_{child}"
    joint = Element("joint", name=name, type=kind)
    if kind in kinds.values():
        axis, start = model.jnt_axis[first], float(model.qpos0[model.jnt_qposadr[first]])
        back = np.eye(4)  # the file's posture is at `ref`, a URDF's at 0
        if kind == "revolute":
            back[:3, :3] = Rotation.from_rotvec(-start * axis).as_matrix()
        else:
            back[:3, 3] = -start * axis
        T = T @ back if start else T
        SubElement(joint, "axis", xyz=_words(axis))
        low, high = model.jnt_range[first]
        limit = {"effort": _words([_effort(model, first)]), "velocity": str(SPEED_RAD_S)}
        if model.jnt_limited[first]:
            limit |= {"lower": _words([low]), "upper": _words([high])}
        elif kind == "revolute":
            joint.set("type", "continuous")
        SubElement(joint, "limit", limit)
        of_joints = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
        for e in np.flatnonzero(of_joints & (model.eq_obj1id == first)):
            other, data = int(model.eq_obj2id[e]), model.eq_data[e]
            like = "" if other < 0 or data[2:5].any() else _joint_name(model, other)
            mimic = {"joint": like, "multiplier": _words(data[1:2]), "offset": _words(data[:1])}
            SubElement(joint, "mimic", mimic)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", _place(T))
    robot.append(joint)


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return model.joint(joint).name or f"joint{joint}"


def _effort(model: mujoco.MjModel, joint: int) -> float:
    """The largest torque (force of a slide) that the file lets a joint have; 0: it does not say."""
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).max())
    found = [0.0]
    for i in np.flatnonzero(model.actuator_trnid[:, 0] == joint):
        gear, fixed = abs(float(model.actuator_gear[i, 0])), model.actuator_biastype[i] == 0
        if model.actuator_forcelimited[i]:
            found.append(gear * float(np.abs(model.actuator_forcerange[i]).max()))
        elif fixed and model.actuator_ctrllimited[i]:  # a motor: its control is its force
            gain = abs(float(model.actuator_gainprm[i, 0]))
            found.append(gear * gain * float(np.abs(model.actuator_ctrlrange[i]).max()))
    return max(found)


def _add_inertial(link: Element, model: mujoco.MjModel, body: int, T: Array) -> None:
    T = T @ _pose(model.body_ipos[body], model.body_iquat[body])
    tensor = T[:3, :3] @ np.diag(model.body_inertia[body]) @ T[:3, :3].T
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_words(T[:3, 3]))
    SubElement(inertial, "mass", value=_words([model.body_mass[body]]))
    upper = zip(*np.triu_indices(3), strict=True)
    cells = {f"i{'xyz'[a]}{'xyz'[b]}": _words([tensor[a, b]]) for a, b in upper}
    SubElement(inertial, "inertia", cells)


def _add_shape(
    at: Element, model: mujoco.MjModel, geom: int, meshes: dict[int, tuple[str, Array]]
) -> None:
    if geom in meshes:
        file, scale = meshes[geom]
        SubElement(at, "mesh", filename=file, scale=_words(scale))
        return
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    size = model.geom_size[geom]
    if kind == "box":
        SubElement(at, "box", size=_words(2 * size))
    else:
        SubElement(at, kind, radius=_words(size[:1]), length=_words(2 * size[1:2]))


def _pose(position: Array, quat_wxyz: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()
    T[:3, 3] = position
    return T


def _place(T: Array) -> dict[str, str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two angles about one line, one is 0
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    return {"xyz": _words(T[:3, 3]), "rpy": _words(rpy)}


def _words(numbers: Array | list[float]) -> str:
    return " ".join(repr(float(x)) for x in numbers)
