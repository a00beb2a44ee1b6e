"""The chain of a URDF between two links: joint frames, limits, masses, visual meshes; a
gripper of parallel jaws.

The file comes from a stranger. It is text of bounded size without a doctype, so it has no entities;
meshes lie in its folder or in a package's that the caller names. Nothing is fetched.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.mesh_import.file import load_mesh_file
from r2h_batch.io.read import FileError, path_within, printable, read_file

Array = NDArray[np.float64]
Element = ElementTree.Element

MAX_BYTES, MAX_LINKS, MAX_MESHES = 8 << 20, 256, 32
LONGEST_M = 3.0
"""Of a link: a mesh that is longer is in millimetres, and would be covered point by point."""


class Box(NamedTuple):
    """A box of a `<collision>`: its frame and its half sides."""

    T: Array
    half: Array


@dataclass(frozen=True)
class Link:
    """A rigid part: its own link and what is fixed to it, in the frame of the joint that moves it."""

    name: str
    triangles: Array  # (F, 3, 3) of the visual meshes, m
    mass: float
    com: Array  # (3,)
    inertia: Array  # (3, 3) about com


@dataclass(frozen=True)
class Jaws:
    """A gripper with two jaws on slides, flange frame at joint positions 0."""

    palm: Link
    jaws: tuple[tuple[Box, ...], tuple[Box, ...]]
    opens: tuple[Array, Array]  # (3,) the direction in which each jaw opens
    travel: tuple[float, float]  # smallest and largest position of each, m
    mass: float  # of each, kg


@dataclass(frozen=True)
class Chain:
    """N joints from base to flange, each about z of its frame, and the N + 1 rigid parts."""

    joints: tuple[str, ...]
    T_parent_joint: Array  # (N, 4, 4)
    T_last_flange: Array
    lower: Array  # (N,) rad
    upper: Array
    velocity: Array
    effort: Array
    links: tuple[Link, ...]


def read_chain(
    path: Path, base: str, flange: str, packages: Mapping[str, Path], *, bare: bool = False
) -> Chain:
    """The chain between two links of a URDF.

    Args:
        path: the URDF.
        base: the link that stands still.
        flange: the link that carries the gripper.
        packages: folder of each package that `package://NAME/` names.
        bare: without what is fixed to the flange.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    root, shown = _parsed(path), printable(path)
    links = {str(e.get("name")): e for e in root.findall("link")}
    joints = root.findall("joint")
    if (most := max(len(links), len(joints))) > MAX_LINKS:
        raise FileError(f"{shown}: has {most} links or joints; {MAX_LINKS} are allowed")
    for flag, name in (("--base", base), ("--flange", flange)):
        if name not in links:
            found = ", ".join(printable(n)[:40] for n in list(links)[:12])
            raise FileError(f"{shown}: {flag} {printable(name)} is no link of it; it has {found}")
    into = {_end(j, "child", shown): j for j in joints}
    if unknown := {_end(j, end, shown) for j in joints for end in ("parent", "child")} - set(links):
        raise FileError(
            f"{shown}: a joint names {printable(min(unknown))[:40]!r}, which is no link of it"
        )
    way: list[Element] = []
    at = flange
    while at != base:
        if at not in into or len(way) > len(joints):
            raise FileError(f"{shown}: no chain of joints leads from {base} to {flange}")
        way.append(into[at])
        at = _end(into[at], "parent", shown)
    moving = [j for j in reversed(way) if _moves(j, shown)]
    T_before, frames = np.eye(4), []
    for joint in reversed(way):
        T_before = T_before @ _origin(joint, shown)
        if joint in moving:
            turn = _to_axis(joint, shown)
            frames.append(T_before @ turn)
            T_before = turn.T
    limits = np.array([_limits(j, shown) for j in moving]).reshape(-1, 4)
    carried = [base, *(_end(j, "child", shown) for j in moving)]
    back = [np.eye(4), *(_to_axis(j, shown).T for j in moving)]
    parts = [
        _rigid(name, T, links, joints, {*carried, flange} if bare else set(carried), path, packages)
        for name, T in zip(carried, back, strict=True)
    ]
    names = tuple(str(j.get("name")) for j in moving)
    low, high, speed, effort = limits.T
    T = _exact(np.array(frames))
    return Chain(names, T, _exact(T_before), low, high, speed, effort, tuple(parts))


def read_jaws(
    path: Path, flange: str, fingers: tuple[str, str], packages: Mapping[str, Path]
) -> Jaws:
    """The gripper at a flange whose two `fingers` are links on prismatic joints that open apart.

    Args:
        path: the URDF.
        flange: the link that carries the gripper.
        fingers: two links; a finger collides as boxes.
        packages: as in `read_chain`.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    root, shown = _parsed(path), printable(path)
    links = {str(e.get("name")): e for e in root.findall("link")}
    joints = root.findall("joint")
    frames, todo = {flange: np.eye(4)}, [flange]
    while todo:
        at = todo.pop()
        for joint in joints:
            child = _end(joint, "child", shown)
            if _end(joint, "parent", shown) == at and child not in frames:
                frames[child] = frames[at] @ _origin(joint, shown)
                todo += [child] if joint.get("type") == "fixed" else []
    jaws, opens, travel, mass = [], [], [], []
    for finger in fingers:
        into = [j for j in joints if _end(j, "child", shown) == finger]
        if not into or into[0].get("type") != "prismatic" or finger not in frames:
            what = f"is no link on a prismatic joint of the gripper at {flange}"
            raise FileError(f"{shown}: --fingers {printable(finger)} {what}")
        opens.append(frames[finger][:3, :3] @ _to_axis(into[0], shown)[:3, 2])
        jaws.append(_boxes(links[finger], frames[finger], shown))
        travel.append(_limits(into[0], shown)[:2])
        inertial = links[finger].find("inertial")
        mass.append(0.0 if inertial is None else _body(inertial, np.eye(4), shown)[0])
    if travel[0] != travel[1] or np.abs(opens[0] + opens[1]).max() > 1e-6:
        raise FileError(f"{shown}: the two fingers must open apart, by as much each")
    palm = _rigid(flange, np.eye(4), links, joints, set(), path, packages)
    if min(palm.mass, *mass) <= 0 or mass[0] != mass[1]:
        what = f"{palm.mass:g} kg, its fingers {mass[0]:g} and {mass[1]:g} kg"
        raise FileError(
            f"{shown}: the gripper's palm has {what}; it needs masses, the fingers equal ones"
        )
    return Jaws(palm, (jaws[0], jaws[1]), (opens[0], opens[1]), travel[0], mass[0])


def _boxes(link: Element, T: Array, shown: str) -> tuple[Box, ...]:
    """What a link collides as, which must be boxes."""
    found = []
    for collision in link.findall("collision"):
        box = collision.find("geometry/box")
        if box is None:
            raise FileError(
                f"{shown}: {printable(link.get('name'))} collides as other than boxes; a finger is made of boxes"
            )
        half = _numbers(box.get("size", ""), 3, f"{shown}: a box") / 2
        found.append(Box(T @ _origin(collision, shown), half))
    return tuple(found)


def _parsed(path: Path) -> Element:
    text, shown = read_file(path, MAX_BYTES).decode("utf-8", errors="replace"), printable(path)
    if re.search(r"<!\s*(doctype|entity)", text, re.IGNORECASE):
        raise FileError(f"{shown}: declares a document type; remove it, a URDF needs none")
    if "xacro:" in text or path.suffix == ".xacro":
        how = "expand it with: xacro FILE > robot.urdf"
        raise FileError(f"{shown}: is a xacro program, which is not run here; {how}")
    try:  # prefixes that a file does not declare, such as drake:, say nothing that is read here
        root = ElementTree.fromstring(
            re.sub(r"(</?|\s)[A-Za-z]+:(?=[A-Za-z_]+[\s=/>])", r"\1", text)
        )
    except (ElementTree.ParseError, RecursionError) as error:
        raise FileError(f"{shown}: is no XML: {printable(error)[:100]}") from None
    if root.tag != "robot":
        raise FileError(f"{shown}: begins with <{printable(root.tag)[:40]}>; a URDF has <robot>")
    return root


def _end(joint: Element, which: str, shown: str) -> str:
    found = joint.find(which)
    if found is None or found.get("link") is None:
        raise FileError(f"{shown}: joint {printable(joint.get('name'))} has no {which} link")
    return str(found.get("link"))


def _moves(joint: Element, shown: str) -> bool:
    kind, name = joint.get("type"), printable(joint.get("name"))
    if kind not in ("fixed", "revolute", "continuous") or joint.find("mimic") is not None:
        what = "a mimic joint" if joint.find("mimic") is not None else f"{printable(kind)[:20]}"
        raise FileError(f"{shown}: joint {name} is {what}; the arm's joints must be revolute")
    return kind != "fixed"


def _numbers(text: str, count: int, what: str) -> Array:
    try:
        found = np.array([float(x) for x in text.split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != count or not np.isfinite(found).all() or np.abs(found).max() > 1e6:
        raise FileError(f"{what} is {printable(text)[:60]!r}; it must be {count} numbers")
    return found


def _origin(element: Element, shown: str) -> Array:
    node, T = element.find("origin"), np.eye(4)
    if node is not None:
        where = f"{shown}: an origin"
        rpy = _numbers(node.get("rpy", "0 0 0"), 3, where)
        T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        T[:3, 3] = _numbers(node.get("xyz", "0 0 0"), 3, where)
    return T


def _to_axis(joint: Element, shown: str) -> Array:
    """The turn (4, 4) that takes z to the joint's axis."""
    node, T = joint.find("axis"), np.eye(4)
    axis = _numbers("1 0 0" if node is None else node.get("xyz", "1 0 0"), 3, f"{shown}: an axis")
    if np.linalg.norm(axis) < 1e-6:
        raise FileError(f"{shown}: joint {printable(joint.get('name'))} has an axis of length 0")
    if not np.array_equal(axis, [0, 0, 1]):
        T[:3, :3] = Rotation.align_vectors(axis[None], [[0, 0, 1]])[0].as_matrix()
    return T


def _limits(joint: Element, shown: str) -> tuple[float, float, float, float]:
    """Lower, upper (rad), speed and torque; a continuous joint gets one turn each way."""
    node, name = joint.find("limit"), printable(joint.get("name"))
    if node is None:
        raise FileError(f"{shown}: joint {name} has no <limit>; speed and effort are needed")
    low, high, speed, effort = (
        float(_numbers(node.get(k, d), 1, f"{shown}: joint {name}: {k}")[0])
        for k, d in (
            ("lower", "-6.2831853"),
            ("upper", "6.2831853"),
            ("velocity", "0"),
            ("effort", "0"),
        )
    )
    if joint.get("type") == "continuous":
        low, high = -2 * np.pi, 2 * np.pi
    if not (low < high and speed > 0 and effort > 0):
        wanted = "lower < upper, and velocity and effort above 0"
        raise FileError(f"{shown}: joint {name}: limits {low:g} {high:g}; it needs {wanted}")
    return low, high, speed, effort


def _exact(T: Array) -> Array:
    """Entries rounded to 1e-9: 1.570796327 becomes a quarter turn, 1e-11 m become 0."""
    return np.round(T, 9) + 0.0


def _rigid(
    name: str, T: Array, links: Mapping[str, Element], joints: list[Element], ends: set[str],
    path: Path, packages: Mapping[str, Path],
) -> Link:  # fmt: skip
    """A link and all that is fixed to it; T: the link in the frame of the joint that moves it."""
    shown, bodies, todo = printable(path), [], [(name, T)]
    triangles: list[Array] = []
    seen = {name}
    while todo:
        at, T_at = todo.pop()
        for visual in links[at].findall("visual"):
            if (mesh := visual.find("geometry/mesh")) is not None:
                if len(triangles) == MAX_MESHES:
                    most = f"more than {MAX_MESHES} visual meshes; join them into one"
                    raise FileError(f"{shown}: link {printable(name)} has {most}")
                triangles.append(_mesh(mesh, T_at @ _origin(visual, shown), path, packages))
        if (inertial := links[at].find("inertial")) is not None:
            bodies.append(_body(inertial, T_at, f"{shown}: link {printable(at)}"))
        for joint in joints:
            child = _end(joint, "child", shown)
            fixed = joint.get("type") == "fixed" and _end(joint, "parent", shown) == at
            if fixed and child not in seen | ends and child in links:
                seen.add(child)
                todo.append((child, T_at @ _origin(joint, shown)))
    if not triangles:
        raise FileError(f"{shown}: link {printable(name)} has no visual mesh")
    faces = np.concatenate(triangles)
    size = float(np.ptp(faces.reshape(-1, 3), axis=0).max())
    if not 1e-3 <= size <= LONGEST_M:
        how = f"1 mm to {LONGEST_M:g} m are allowed; correct the scale of its meshes"
        raise FileError(f"{shown}: link {printable(name)} is {size:g} m long; {how}")
    mass = sum(m for m, _, _ in bodies)
    com = sum((m * c for m, c, _ in bodies), np.zeros(3)) / (mass or 1.0)
    about = np.zeros((3, 3))
    for m, c, inertia in bodies:  # the parallel axis theorem
        d = c - com
        about += inertia + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    return Link(name, faces, mass, com, about)


def _body(inertial: Element, T: Array, where: str) -> tuple[float, Array, Array]:
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        raise FileError(f"{where}: its <inertial> has no mass or no inertia")
    m = float(_numbers(mass.get("value", ""), 1, f"{where}: mass")[0])
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    xx, xy, xz, yy, yz, zz = (float(_numbers(tensor.get(k, ""), 1, where)[0]) for k in keys)
    T = T @ _origin(inertial, where)
    R = T[:3, :3]
    return m, T[:3, 3], R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T


def _mesh(mesh: Element, T: Array, path: Path, packages: Mapping[str, Path]) -> Array:
    """Triangles (F, 3, 3) of a mesh in the link's frame."""
    name = str(mesh.get("filename"))
    scale = _numbers(mesh.get("scale", "1 1 1"), 3, f"{printable(path)}: a mesh's scale")
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        if package not in packages:
            how = f"give --package {printable(package)}=FOLDER"
            raise FileError(f"{printable(path)}: {printable(name)[:120]}: {how}")
        file = path_within(packages[package], inside)
    else:
        file = path_within(path.parent, name)
    try:
        loaded = load_mesh_file(file, "a visual mesh")
    except ValueError as error:
        raise FileError(f"{printable(path)}: {error}") from None
    corners = np.asarray(loaded.vertices, np.float64) * scale
    return np.asarray((corners @ T[:3, :3].T + T[:3, 3])[loaded.faces])
