"""The links and joints of a URDF or MJCF, as MuJoCo compiles it.

The file comes from a stranger. It is text of bounded size without a doctype, so it has no entities.
MuJoCo gets a copy with nothing in it but bodies, joints, geoms, masses and motors, and no name of a file:
it opens none. Meshes are kept here by name, and found in the file's folder or in a package's.
"""

import os
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import path_within, printable, read_file

Array = NDArray[np.float64]

MAX_BYTES, MAX_LINKS, MAX_ELEMENTS, MAX_INCLUDES = 8 << 20, 256, 8192, 16
MAX_ATTRIBUTES = 64
"""Most attributes of an element: MuJoCo's parser compares each with all others."""

_IN_BODY = {"body", "frame", "joint", "freejoint", "geom", "inertial", "site"}
_MOTORS = {"motor", "general", "position", "velocity", "intvelocity", "damper"}
MJCF: dict[str, set[str]] = {
    "mujoco": {"compiler", "default", "asset", "worldbody", "actuator", "equality"},
    "default": {"default", "mesh", "geom", "joint", "site", *_MOTORS},
    "asset": {"mesh"}, "worldbody": _IN_BODY, "body": _IN_BODY, "frame": _IN_BODY,
    "actuator": _MOTORS, "equality": {"joint", "connect"},
}  # fmt: skip
"""Element -> the children of it that MuJoCo gets."""
URDF: dict[str, set[str]] = {
    "robot": {"link", "joint"}, "link": {"inertial", "visual", "collision"},
    "joint": {"origin", "parent", "child", "axis", "limit", "mimic"},
    "inertial": {"origin", "mass", "inertia"}, "visual": {"origin", "geometry"}, "collision": {"origin", "geometry"},
    "geometry": {"mesh", "box", "cylinder", "sphere", "capsule"},
}  # fmt: skip
MOST_NUMBER = 1e6
"""A number of a robot's file is at most this."""
NUMBERS = {
    "xyz": 3, "rpy": 3, "scale": 3, "size": 3, "radius": 1, "length": 1, "value": 1, "multiplier": 1, "offset": 1,
    "lower": 1, "upper": 1, "velocity": 1, "effort": 1, "ixx": 1, "ixy": 1, "ixz": 1, "iyy": 1, "iyz": 1, "izz": 1,
}  # fmt: skip
"""Attribute of a URDF -> how many numbers it has."""
REFUSED = {
    "plugin": "plugins run code", "extension": "plugins run code",
    "attach": "write the other model's bodies into it", "model": "write the other model's bodies into it",
    "replicate": "save it with MuJoCo, which writes all copies",
    "composite": "it is not a rigid body", "flexcomp": "it is not a rigid body",
}  # fmt: skip
COMPILER = {
    "angle", "eulerseq", "autolimits", "inertiafromgeom", "inertiagrouprange", "settotalmass",
    "boundmass", "boundinertia", "balanceinertia", "fitaabb",
}  # fmt: skip
"""Options of an MJCF's <compiler> that MuJoCo gets; the folder of meshes is read here."""


class Geom(NamedTuple):
    """A shape of a link: `kind` as MuJoCo calls it, `size` as in MuJoCo, T in the link's frame."""

    kind: str
    size: Array
    T: Array
    seen: bool
    """it collides with nothing"""
    file: str = ""
    """of a mesh: its name in the robot's file; its scale is `size`"""
    fitted: str = ""
    """how a shape that is no mesh is fitted to that mesh: inertia or aabb"""


@dataclass(frozen=True)
class Joint:
    """How a link moves on its parent, at 0 where the link's `T_parent` says."""

    name: str
    kind: str
    """revolute, prismatic, or words for another"""
    axis: Array
    """(3,) in the link's frame, length 1"""
    lower: float
    """rad or m; NaN: no limit"""
    upper: float
    speed: float
    """rad/s or m/s; 0: the file does not say, as no MJCF does"""
    effort: float
    """N m or N; 0: the file does not say"""
    follows: tuple[str, float, float] | None
    """the joint that it mimics, factor, offset; a name of "" follows in no line"""
    spring: tuple[float, float]
    """stiffness, and where it pulls nothing"""
    driven: bool
    """by a motor of its own"""


@dataclass(frozen=True)
class Body:
    """A link of the file. Its origin lies on its joint's axis."""

    name: str
    parent: str
    T_parent: Array  # (4, 4), the joint at 0
    joint: Joint | None
    """None: fixed to its parent"""
    mass: float
    com: Array  # (3,)
    inertia: Array  # (3, 3) about com, the link's axes
    geoms: tuple[Geom, ...]


class Loop(NamedTuple):
    """Two points, in the frames of two links, that stay together."""

    links: tuple[str, str]
    points: tuple[Array, Array]


@dataclass(frozen=True)
class Model:
    """A robot's file: its links by name, parents first; named places on links; what closes loops."""

    path: Path
    links: Mapping[str, Body]
    sites: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    """name -> link and place in its frame"""
    loops: tuple[Loop, ...] = ()
    folders: tuple[Path, ...] = ()
    """where files that it names may lie besides its own folder"""

    @property
    def shown(self) -> str:
        """The file in messages."""
        return printable(self.path)

    def below(self, name: str) -> Iterator[Body]:
        """The links that a link carries itself."""
        return (link for link in self.links.values() if link.parent == name)


def read_model(path: Path, folders: Collection[Path] = ()) -> Model:
    """The links and joints of a URDF or MJCF. No mesh is read.

    A hinge of an MJCF without a range turns continuously. A joint's effort is the limit of its forces, or
    of its motor's.

    Args:
        path: the file.
        folders: where files that it names may lie besides its own folder.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    root = parsed(path)
    model = _of_urdf(root, path) if root.tag == "robot" else _of_mjcf(root, path, folders)
    return replace(model, folders=tuple(folders))


def beside(path: Path, name: str, folders: Collection[Path]) -> Path:
    """The file that a robot's file names: in its own folder, or where `..` leads to, in a folder that the user gave.

    Args:
        path: the robot's file.
        name: as it names the other.
        folders: those of the user.

    Raises:
        FileError: it lies elsewhere.
    """
    if ".." not in PurePosixPath(name.replace("\\", "/")).parts:
        return path_within(path.parent, name)
    at = Path(os.path.normpath(path.resolve().parent / name))
    for folder in (path.resolve().parent, *(one.resolve() for one in folders)):
        if at.is_relative_to(folder):
            return path_within(folder, str(at.relative_to(folder)))
    what, how = printable(name)[:120], "give the folder above it with --package NAME=FOLDER"
    raise FileError(f"{printable(path)}: {what} points outside the folder; {how}")


def parsed(path: Path) -> Element:
    """The root of a stranger's <robot> or <mujoco>: bounded in size, without a document type."""
    text, shown = read_file(path, MAX_BYTES).decode("utf-8", errors="replace"), printable(path)
    if re.search(r"<!\s*(doctype|entity)", text, re.IGNORECASE):
        raise FileError(f"{shown}: declares a document type; remove it, a robot needs none")
    plain = re.sub(
        r"<!--.*?-->", "", text, flags=re.DOTALL
    )  # a comment may say what it was made from
    if re.search(r"<\s*xacro:|\$\{", plain) or path.suffix == ".xacro":
        how = "expand it with: xacro FILE > robot.urdf"
        raise FileError(f"{shown}: is a xacro program, which is not run here; {how}")
    try:  # prefixes that a file does not declare, such as drake:, say nothing that is read here
        text = re.sub(r"(</?|\s)[A-Za-z]\w*:(?=[A-Za-z_][\w.-]*[\s=/>])", r"\1", text)
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, RecursionError) as error:
        raise FileError(f"{shown}: is not XML: {printable(error)[:100]}") from None
    if root.tag not in ("robot", "mujoco", "mujocoinclude"):
        raise FileError(
            f"{shown}: begins with <{printable(root.tag)[:40]}>, not <robot> or <mujoco>"
        )
    for element in root.iter():
        if (count := len(element.attrib)) > MAX_ATTRIBUTES:
            where = f"{shown}: <{printable(element.tag)[:40]}>"
            raise FileError(f"{where} has {count} attributes; {MAX_ATTRIBUTES} are allowed")
    return root


# ---- URDF


def _of_urdf(root: Element, path: Path) -> Model:
    shown, links, joints = printable(path), root.findall("link"), root.findall("joint")
    if (most := max(len(links), len(joints))) > MAX_LINKS:
        raise FileError(f"{shown}: has {most} links or joints; {MAX_LINKS} are allowed")
    _check_tree(links, joints, shown)
    for link in links:
        _check_link(link, shown)
    kept, files = _kept(root, URDF), {}
    for i, element in enumerate(kept.iter()):
        _check_numbers(element, shown)
        if element.tag == "mesh":  # MuJoCo gets a number in place of the name
            files[str(i)] = element.get("filename", "")
            element.set("filename", str(i))
        if element.tag == "limit" and element.get("lower") == element.get("upper"):
            for end in {"lower", "upper"} & set(element.attrib):  # MuJoCo would print a warning
                del element.attrib[end]
        if element.tag in (
            "visual",
            "collision",
        ):  # MuJoCo prints a line of each name that is there twice
            element.attrib.pop("name", None)
        if element.tag == "inertial":
            _complete(element)
    options = {"strippath": "false", "fusestatic": "false", "discardvisual": "false"}
    SubElement(SubElement(kept, "mujoco"), "compiler", options)
    names = {str(e.get("name")) for e in links}
    if "world" not in names:  # to MuJoCo the one link that may have no mass
        SubElement(kept, "link", name="world")
        for name in sorted(names - {_end(j, "child", shown) for j in joints}):
            joint = SubElement(kept, "joint", name=f"joint of {name}", type="fixed")
            SubElement(joint, "parent", link="world")
            SubElement(joint, "child", link=name)
    spec = _spec(kept, shown)
    meshes = _meshes_of(spec, files, shown)
    _check_masses(spec, shown)
    masses = {str(b.name): _given_mass(b) for b in spec.bodies}
    model = _model(spec, path, meshes, masses, {str(j.get("name")): j for j in joints})
    if "world" not in names:
        rooted = {n: _rooted(b) for n, b in model.links.items() if n != "world"}
        return replace(model, links=rooted)
    return model


def _rooted(body: Body) -> Body:
    return replace(body, parent="") if body.parent == "world" else body


def _check_tree(links: list[Element], joints: list[Element], shown: str) -> None:
    """Refuses links and joints that do not form trees, by name."""
    names = [e.get("name", "") for e in links]
    if "" in names:
        raise FileError(f"{shown}: a link has no name")
    parent: dict[str, str] = {}
    for joint in joints:
        own, child = _end(joint, "parent", shown), _end(joint, "child", shown)
        mimic, name = joint.find("mimic"), joint.get("name")
        if mimic is not None and mimic.get("joint") == name:
            raise FileError(f"{shown}: joint {printable(name)[:40]} follows itself")
        if unknown := {own, child} - set(names):
            raise FileError(f"{shown}: a joint names {printable(min(unknown))[:40]!r}, no link")
        if child in parent:
            both = f"{printable(parent[child])[:40]} and {printable(own)[:40]}"
            raise FileError(f"{shown}: link {printable(child)[:40]} has two parents, {both}")
        parent[child] = own
    for kind, found in (("link", names), ("joint", [str(j.get("name")) for j in joints])):
        if twice := [name for name in found if found.count(name) > 1]:
            raise FileError(f"{shown}: two {kind}s are called {printable(twice[0])[:40]}")
    for name in names:
        at = name
        for _ in names:
            at = parent.get(at, "")
        if at:
            raise FileError(f"{shown}: link {printable(name)[:40]} hangs in a circle of joints")


def _check_link(link: Element, shown: str) -> None:
    where = f"{shown}: link {printable(link.get('name'))[:40]}"
    for shape in (*link.findall("visual"), *link.findall("collision")):
        node = shape.find("geometry")
        if node is None or not len(node):
            raise FileError(f"{where}: a <{shape.tag}> has no shape in its <geometry>")
        if node[0].tag not in URDF["geometry"]:
            allowed = "a mesh, box, cylinder, sphere or capsule is"
            raise FileError(f"{where}: a <{printable(node[0].tag)[:40]}> is not read; {allowed}")


def _end(joint: Element, which: str, shown: str) -> str:
    found = joint.find(which)
    if found is None or found.get("link") is None:
        raise FileError(f"{shown}: joint {printable(joint.get('name'))} has no {which} link")
    return str(found.get("link"))


def _complete(inertial: Element) -> None:
    """A mass or tensor of 0 where an <inertial> has none."""
    if inertial.find("mass") is None:
        SubElement(inertial, "mass", value="0")
    if inertial.find("inertia") is None:
        SubElement(
            inertial, "inertia", {f"i{ij}": "0" for ij in ("xx", "xy", "xz", "yy", "yz", "zz")}
        )


def _check_numbers(element: Element, shown: str) -> None:
    for name in set(element.attrib) & NUMBERS.keys():
        text = element.get(name, "")
        try:
            found = np.array([float(x) for x in text.split()])
        except ValueError:
            found = np.zeros(0)
        count = NUMBERS[name]
        if len(found) == 1 and _says_no_limit(name, float(found[0])):
            if name in ("lower", "upper"):
                element.set(name, f"{np.sign(found[0]) * MOST_NUMBER:g}")
            else:
                del element.attrib[name]
            continue
        if len(found) != count or not (np.abs(found) <= MOST_NUMBER).all():
            where = f"{shown}: {name} of <{printable(element.tag)[:40]}>"
            what = "a number" if count == 1 else f"{count} numbers, each"
            words = f"it must be {what} from -{MOST_NUMBER:g} to {MOST_NUMBER:g}"
            raise FileError(f"{where} is {printable(text)[:60]!r}; {words}")


def _says_no_limit(name: str, number: float) -> bool:
    """Files write 1e9 or inf where a joint has no limit."""
    ends = {"lower": -1, "upper": 1, "velocity": 1, "effort": 1}
    return name in ends and number * ends[name] > MOST_NUMBER


def _given_mass(body: mujoco.MjsBody) -> tuple[float, Array]:
    """Mass and tensor (3, 3) in the frame of the body's inertia, as its <inertial> has them. MuJoCo gets a
    unit ball: it would refuse the whole file for the tensor of one link that nobody asks for."""
    xx, yy, zz, xy, xz, yz = body.fullinertia
    given = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    mass = float(body.mass) if body.explicitinertial else 0.0
    _set_unit_ball(body)
    return mass, np.nan_to_num(given)


def _set_unit_ball(body: mujoco.MjsBody) -> None:
    """A mass that MuJoCo takes, where it is not asked for."""
    if not body.explicitinertial:
        body.ipos = np.zeros(3)
    body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
    body.fullinertia = np.full(6, np.nan)


# ---- MJCF


def _of_mjcf(root: Element, path: Path, folders: Collection[Path]) -> Model:
    shown = printable(path)
    try:
        _include(root, path, folders, [MAX_INCLUDES])
        kept = _kept(root, MJCF)
    except RecursionError:
        raise FileError(f"{shown}: is nested too deeply") from None
    for element in root.iter():
        if element.tag in REFUSED or "plugin" in element.attrib:
            tag = element.tag if element.tag in REFUSED else "plugin"
            raise FileError(f"{shown}: <{tag}> is not read: {REFUSED[tag]}; remove it")
    for element in kept.iter():
        element.attrib.pop("material", None)
        if element.tag == "compiler":
            for option in set(element.attrib) - COMPILER:
                del element.attrib[option]
    for motors in kept.findall("actuator"):
        for motor in [m for m in motors if "joint" not in m.attrib]:  # of a tendon, a site
            motors.remove(motor)
    folder = ""
    for compiler in root.findall("compiler"):
        folder = compiler.get("meshdir", compiler.get("assetdir", folder))
    spec = _spec(kept, shown)
    files = {m.file: str(PurePosixPath(folder, m.file)) for m in spec.meshes}
    _check_masses(spec, shown)
    # bodies of the world's have names, as masses are kept by name
    for i, body in enumerate(spec.bodies):
        body.name = body.name or f"body{i}"
    unknown = [body for body in spec.bodies if not _knows_mass(spec, body)]
    meshes = _meshes_of(spec, files, shown)
    by_geoms = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    if spec.compiler.inertiafromgeom == by_geoms:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        for body in spec.bodies:
            body.explicitinertial = False
    for body in unknown:
        _set_unit_ball(body)
    return _model(spec, path, meshes, {b.name: (0.0, np.zeros((3, 3))) for b in unknown}, None)


def _include(at: Element, path: Path, folders: Collection[Path], left: list[int]) -> None:
    """Puts what an <include> names in its place."""
    for i, child in reversed(list(enumerate(at))):
        if child.tag == "include":
            left[0] -= 1
            if left[0] < 0:
                raise FileError(f"{printable(path)}: more than {MAX_INCLUDES} includes")
            other = parsed(beside(path, child.get("file", ""), folders))
            at[i : i + 1] = list(other)
            _include(at, path, folders, left)
            return
        _include(child, path, folders, left)


def _knows_mass(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> bool:
    """Whether the file says a body's mass: in its <inertial>, or by geoms that are no meshes."""
    given = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    low, high = spec.compiler.inertiagrouprange
    weighs = [g for g in body.geoms if low <= g.group <= high and g.mass != 0 and g.density != 0]
    return (given and bool(body.explicitinertial)) or not any(g.meshname for g in weighs)


# ---- both


def _check_masses(spec: mujoco.MjSpec, shown: str) -> None:
    for body in spec.bodies:
        if body.explicitinertial and body.mass < 0:
            what = f"{printable(body.name)[:40]} has a mass of {body.mass:g} kg"
            raise FileError(f"{shown}: link {what}; a mass is above 0")


def _kept(element: Element, allowed: Mapping[str, set[str]]) -> Element:
    """A copy of the element with those of its children that are allowed."""
    kept = Element(element.tag, dict(element.attrib))
    kept.extend(_kept(e, allowed) for e in element if e.tag in allowed.get(element.tag, ()))
    return kept


def _spec(kept: Element, shown: str) -> mujoco.MjSpec:
    if (count := sum(1 for _ in kept.iter())) > MAX_ELEMENTS:
        raise FileError(f"{shown}: {count} elements say what it is; {MAX_ELEMENTS} are allowed")
    try:
        return mujoco.MjSpec.from_string(ElementTree.tostring(kept, encoding="unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise _refused_by_mujoco(error, shown) from None


def _refused_by_mujoco(error: Exception, shown: str) -> FileError:
    return FileError(f"{shown}: MuJoCo: {printable(' '.join(str(error).split()))[:160]}")


class _Named(NamedTuple):
    kind: str
    file: str
    scale: Array
    fitted: str


def _meshes_of(spec: mujoco.MjSpec, files: Mapping[str, str], shown: str) -> dict[int, _Named]:
    """Number of each geom that has a mesh -> its kind, file, scale and fit. To MuJoCo it becomes a ball
    without mass at the same place, and there are no meshes."""
    named = {}
    for mesh in list(spec.meshes):
        if not mesh.file or mesh.refpos.any() or not np.array_equal(mesh.refquat, [1, 0, 0, 0]):
            what = "needs a file, and neither refpos nor refquat"
            raise FileError(f"{shown}: mesh {printable(mesh.name)[:60]} {what}")
        named[mesh.name] = files[mesh.file], np.array(mesh.scale)
        spec.delete(mesh)
    found = {}
    fit = "aabb" if spec.compiler.fitaabb else "inertia"
    for i, geom in enumerate(spec.geoms):
        is_mesh = geom.type == mujoco.mjtGeom.mjGEOM_MESH
        if not is_mesh and not geom.meshname:
            continue
        if geom.meshname not in named:
            raise FileError(f"{shown}: a geom names no mesh: {printable(geom.meshname)[:60]!r}")
        file, scale = named[geom.meshname]
        found[i] = _Named(_kind_of(geom.type), file, scale, "" if is_mesh else fit)
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_SPHERE, ""
        geom.size, geom.mass = [1.0, 0.0, 0.0], 0.0
    return found


def _kind_of(kind: int) -> str:
    return mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()


def _model(
    spec: mujoco.MjSpec,
    path: Path,
    meshes: Mapping[int, _Named],
    masses: Mapping[str, tuple[float, Array]],
    said: Mapping[str, Element] | None,
) -> Model:
    """The model that MuJoCo compiles.

    Args:
        spec: without meshes.
        path: the file.
        meshes: number of a geom -> the mesh that it has.
        masses: name of a body -> mass and tensor in the frame of its inertia, in place of MuJoCo's.
        said: name of a joint -> <joint> of a URDF.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a model that cannot be simulated
            model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise _refused_by_mujoco(error, printable(path)) from None
    numbers = (
        model.body_pos, model.body_quat, model.body_ipos, model.body_iquat, model.body_inertia, model.body_mass,
        model.jnt_pos, model.jnt_axis, model.geom_pos, model.geom_quat, model.geom_size, model.qpos0,
    )  # fmt: skip
    if not all((np.abs(x) < 1e6).all() for x in numbers):
        raise FileError(
            f"{printable(path)}: a place, size or mass is not finite or above a million"
        )
    names = ["world", *(model.body(i).name or f"body{i}" for i in range(1, model.nbody))]
    # a link's origin lies at the anchor of its body's joint
    T_body_link = np.tile(np.eye(4), (model.nbody, 1, 1))
    T_body_link[model.jnt_bodyid, :3, 3] = model.jnt_pos
    T_link_body = np.asarray(np.linalg.inv(T_body_link), np.float64)
    links = {}
    for i, name in enumerate(names):
        parent = int(model.body_parentid[i])
        T = T_link_body[parent] @ frame(model.body_pos[i], model.body_quat[i]) @ T_body_link[i]
        joint = _joint(model, i, name, said)
        if joint is not None and joint.kind in ("revolute", "prismatic"):
            start = model.qpos0[model.jnt_qposadr[model.body_jntadr[i]]]
            T = T @ moved(joint, -start) if start else T  # the file's posture is at its `ref`
        T_inertia = T_link_body[i] @ frame(model.body_ipos[i], model.body_iquat[i])
        usual = float(model.body_mass[i]), np.diag(model.body_inertia[i])
        mass, tensor = masses.get(name, usual)
        R = T_inertia[:3, :3]
        geoms = tuple(
            _geom(model, int(g), T_link_body[i], meshes)
            for g in np.flatnonzero(model.geom_bodyid == i)
        )
        links[name] = Body(
            name, names[parent] if i else "", T, joint, mass, T_inertia[:3, 3], R @ tensor @ R.T, geoms
        )  # fmt: skip
    sites = {
        model.site(k).name: (
            names[i],
            T_link_body[i] @ frame(model.site_pos[k], model.site_quat[k]),
        )
        for k, i in enumerate(model.site_bodyid)
    }
    return Model(path, links, sites, tuple(_loops(model, names, T_link_body)))


def _joint(
    model: mujoco.MjModel, body: int, name: str, said: Mapping[str, Element] | None
) -> Joint | None:
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    if count == 0:
        return None
    kinds = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
    kind = kinds.get(mujoco.mjtJoint(model.jnt_type[first]), "free or a ball")
    own = _joint_name(model, first)
    low, high = model.jnt_range[first] if model.jnt_limited[first] else (np.nan, np.nan)
    speed = 0.0
    if said is not None:
        element = said.get(own)  # of a joint that MuJoCo splits there is none
        limit = None if element is None else element.find("limit")
        none: Mapping[str, str] = {}
        given = none if limit is None else limit.attrib
        speed = float(given.get("velocity", "0"))
        if element is not None and element.get("type") == "continuous":
            low = high = np.nan
        elif not model.jnt_limited[first] and given.keys() & {"lower", "upper"}:
            low, high = float(given.get("lower", "0")), float(given.get("upper", "0"))
    follows = None
    of_joints = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0
    for e in np.flatnonzero(of_joints & (model.eq_obj1id == first)):
        other, data = int(model.eq_obj2id[e]), model.eq_data[e]
        like = "" if other < 0 or data[2:5].any() else _joint_name(model, other)
        follows = like, float(data[1]), float(data[0])
    return Joint(
        own if count == 1 else f"joint of {name}", kind if count == 1 else "several joints",
        np.array(model.jnt_axis[first]), float(low), float(high), speed, _effort(model, first), follows,
        (float(model.jnt_stiffness[first]), float(model.qpos_spring[model.jnt_qposadr[first]])),
        bool((model.actuator_trnid[:, 0] == first).any()),
    )  # fmt: skip


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


def _geom(model: mujoco.MjModel, geom: int, T: Array, meshes: Mapping[int, _Named]) -> Geom:
    T = T @ frame(model.geom_pos[geom], model.geom_quat[geom])
    seen = not (model.geom_contype[geom] or model.geom_conaffinity[geom])
    if geom in meshes:
        kind, file, scale, fitted = meshes[geom]
        return Geom(kind, scale, T, seen, file, fitted)
    return Geom(_kind_of(model.geom_type[geom]), np.array(model.geom_size[geom]), T, seen)


def _loops(model: mujoco.MjModel, names: list[str], T_link_body: Array) -> Iterator[Loop]:
    for e in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_CONNECT) & model.eq_active0):
        ids = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        points = model.eq_data[e, 0:3], model.eq_data[e, 3:6]
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            points = model.site_pos[ids[0]], model.site_pos[ids[1]]
            ids = int(model.site_bodyid[ids[0]]), int(model.site_bodyid[ids[1]])
        one, other = (
            T_link_body[i, :3, :3] @ x + T_link_body[i, :3, 3]
            for i, x in zip(ids, points, strict=True)
        )
        yield Loop((names[ids[0]], names[ids[1]]), (one, other))


def moved(joint: Joint, at: Array) -> Array:
    """(..., 4, 4) what a joint does to its link at positions (...)."""
    T = np.zeros((*np.shape(at), 4, 4))
    T[...] = np.eye(4)
    way = np.asarray(at)[..., None] * joint.axis
    if joint.kind == "prismatic":
        T[..., :3, 3] = way
    else:
        T[..., :3, :3] = Rotation.from_rotvec(way.reshape(-1, 3)).as_matrix().reshape(*way.shape, 3)
    return T


def frame(position: Array, quat_wxyz: Array) -> Array:
    """(4, 4) of a position and a quaternion as MuJoCo has them."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()
    T[:3, 3] = position
    return T
