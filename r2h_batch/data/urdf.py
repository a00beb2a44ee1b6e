"""The chain of a URDF between two links: joint frames, limits, masses, visual meshes, shapes; the
fingers of a gripper. An MJCF is read as the URDF that says the same.

The file comes from a stranger. It is text of bounded size without a doctype, so it has no entities;
meshes lie in its folder or in a package's that the caller names. Nothing is fetched.
"""

import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.io.read import FileError, path_within, printable, read_file
from r2h_batch.data.robot_mjcf import as_urdf
from r2h_batch.data.robot_shapes import CAPSULE, CYLINDER, Shape
from r2h_batch.scene.mesh_import.file import load_mesh_file

Array = NDArray[np.float64]
Element = ElementTree.Element

MAX_BYTES, MAX_LINKS, MAX_MESHES = 8 << 20, 256, 32
SAMPLES = 513
"""Of a gripper's way from closed to open."""
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
    triangles: Array  # (F, 3, 3) of what is seen, m: of meshes first
    mass: float
    com: Array  # (3,)
    inertia: Array  # (3, 3) about com
    meshed: int
    """how many of the triangles are of meshes"""
    shapes: tuple[Shape, ...]
    """what is seen besides: cylinders, spheres, boxes, capsules"""
    collides: tuple[Shape, ...]
    """what it collides as, if that is such shapes alone"""
    members: tuple[str, ...]
    """the links of the file that are this part"""


@dataclass(frozen=True)
class Part:
    """A link of a gripper that moves."""

    name: str
    boxes: tuple[Box, ...]
    """what it collides as, in its frame"""
    meshes: tuple[Array, ...]
    """(F, 3, 3) what is seen of it, where it has no such boxes"""
    mass: float
    T: Array
    """(SAMPLES, 4, 4) in the flange's frame, from closed to open in even steps of what drives it"""


@dataclass(frozen=True)
class Fingers:
    """A gripper: what stands still, flange frame, and what moves."""

    palm: Link
    parts: tuple[Part, ...]


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
    beyond: frozenset[str]
    """the flange and the links of the file that it carries"""


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
    root, shown = _read(path), printable(path)
    links = {str(e.get("name")): e for e in root.findall("link")}
    joints = root.findall("joint")
    if (most := max(len(links), len(joints))) > MAX_LINKS:
        raise FileError(f"{shown}: has {most} links or joints; {MAX_LINKS} are allowed")
    for flag, name in (("--base", base), ("--flange", flange)):
        if name not in links:
            found = ", ".join(printable(n)[:40] for n in list(links)[:12])
            raise FileError(f"{shown}: {flag} {printable(name)} is not a link; it has {found}")
    into = {_end(j, "child", shown): j for j in joints}
    if unknown := {_end(j, end, shown) for j in joints for end in ("parent", "child")} - set(links):
        raise FileError(f"{shown}: a joint names {printable(min(unknown))[:40]!r}, no link")
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
    beyond, todo = {flange}, [flange]
    while todo:
        at = todo.pop()
        new = {_end(j, "child", shown) for j in joints if _end(j, "parent", shown) == at} - beyond
        beyond |= new
        todo += new
    own = _exact(T_before)
    return Chain(names, T, own, low, high, speed, effort, tuple(parts), frozenset(beyond))


def read_fingers(
    path: Path, flange: str, pads: tuple[str, str], packages: Mapping[str, Path]
) -> Fingers:
    """The gripper at a flange, moved from where the two `pads` are nearest to each other.

    Args:
        path: the URDF.
        flange: the link that carries the gripper.
        pads: two links that grasp. A joint that mimics no other runs through its limits, others
            follow it.
        packages: as in `read_chain`.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    root, shown = _read(path), printable(path)
    links = {str(e.get("name")): e for e in root.findall("link")}
    joints, below = root.findall("joint"), {flange: 0}
    while more := [j for j in joints if _end(j, "parent", shown) in below and _end(j, "child", shown) not in below]:  # fmt: skip
        below |= {_end(j, "child", shown): len(below) for j in more}
    inner = [
        j for j in joints if _end(j, "child", shown) in below and _end(j, "child", shown) != flange
    ]
    moving = {str(j.get("name")): j for j in inner if j.get("type") != "fixed"}
    carried = {_end(j, "child", shown) for j in moving.values()}
    if len(below) - 1 != len(inner) or not set(below) <= set(links):
        raise FileError(f"{shown}: the links at {flange} do not form a tree")
    for pad in pads:
        at, way = pad, [j for j in inner if _end(j, "child", shown) == pad]
        while way and _end(way[0], "child", shown) not in carried:
            at = _end(way[0], "parent", shown)
            way = [j for j in inner if _end(j, "child", shown) == at]
        if not way:
            what = f"is not a link that a joint of the gripper at {flange} moves"
            raise FileError(f"{shown}: --fingers {printable(pad)} {what}")
    roots = sorted({_root(j, moving, shown)[0] for j in moving.values()})
    if len(roots) > 2:
        raise FileError(
            f"{shown}: {len(roots)} joints of the gripper move by themselves ({printable(', '.join(roots))[:80]});"
            " one, or one of each finger, is allowed, the others mimic them"
        )

    def placed(opened: Mapping[str, Array]) -> dict[str, Array]:
        """Frames (S, 4, 4) of all links with the roots' joints at these positions (S,)."""
        frames = {flange: np.tile(np.eye(4), (SAMPLES, 1, 1))}
        for joint in sorted(inner, key=lambda j: below[_end(j, "child", shown)]):
            T = frames[_end(joint, "parent", shown)] @ _origin(joint, shown)
            if joint.get("type") != "fixed":
                name, factor, offset = _root(joint, moving, shown)
                T = T @ _moved(joint, factor * opened[name] + offset, shown)
            frames[_end(joint, "child", shown)] = T
        return frames

    limits = {name: _limits(moving[name], shown)[:2] for name in roots}
    ends = {name: np.linspace(low, high, SAMPLES) for name, (low, high) in limits.items()}
    ways = [
        placed({n: x[::turn] for (n, x), turn in zip(ends.items(), turns, strict=True)})
        for turns in itertools.product((1, -1), repeat=len(roots))
    ]
    middle = [
        np.mean([b.T[:3, 3] for b in _boxes(links[pad], np.eye(4), shown)] or [np.zeros(3)], 0)
        for pad in pads
    ]

    def apart(frames: Mapping[str, Array], at: int) -> float:
        one, two = (
            frames[pad][at, :3, :3] @ x + frames[pad][at, :3, 3]
            for pad, x in zip(pads, middle, strict=True)
        )
        return float(np.linalg.norm(one - two))

    frames = max(ways, key=lambda f: apart(f, -1))
    palm = _rigid(flange, np.eye(4), links, joints, carried, path, packages)
    parts: list[Part] = []
    for name in below:
        at = name  # the link that carries this one
        while at not in carried and at != flange:
            at = next(_end(j, "parent", shown) for j in inner if _end(j, "child", shown) == at)
        if at == flange:
            continue
        inertial = links[name].find("inertial")
        mass = 0.0 if inertial is None else _body(inertial, np.eye(4), shown)[0]
        boxes = _boxes(links[name], np.eye(4), shown)
        seen = [] if boxes else [
            _mesh(mesh, _origin(v, shown), path, packages) for v in links[name].findall("visual")
            if (mesh := v.find("geometry/mesh")) is not None
        ]  # fmt: skip
        if not boxes and not seen and (name in pads or links[name].find("collision") is not None):
            what = "has neither boxes to collide nor a visual mesh"
            raise FileError(f"{shown}: {printable(name)} of the gripper {what}")
        parts.append(Part(name, boxes, tuple(seen), mass, frames[name]))
        if (many := sum(len(part.meshes) for part in parts)) > MAX_MESHES:
            raise FileError(
                f"{shown}: the gripper's fingers have {many} visual meshes and more; {MAX_MESHES} are allowed"
            )
    if palm.mass <= 0:
        raise FileError(f"{shown}: the gripper's palm has {palm.mass:g} kg; it needs a mass")
    return Fingers(palm, tuple(parts))


def _root(joint: Element, moving: Mapping[str, Element], shown: str) -> tuple[str, float, float]:
    """The joint that a moving joint follows (itself), and by what factor and offset."""
    name, factor, offset = str(joint.get("name")), 1.0, 0.0
    for _ in range(len(moving) + 1):
        if joint.get("type") not in ("revolute", "continuous", "prismatic"):
            raise FileError(
                f"{shown}: joint {printable(joint.get('name'))} is {printable(joint.get('type'))[:20]}; a gripper's turn or slide"
            )
        mimic = joint.find("mimic")
        if mimic is None:
            return str(joint.get("name")), factor, offset
        like, where = str(mimic.get("joint")), f"{shown}: a mimic joint"
        if like not in moving:
            raise FileError(
                f"{where} follows {printable(like)[:40]!r}, which is not a joint that moves the gripper"
            )
        offset += factor * float(_numbers(mimic.get("offset", "0"), 1, where)[0])
        factor *= float(_numbers(mimic.get("multiplier", "1"), 1, where)[0])
        joint = moving[like]
    raise FileError(f"{shown}: joint {printable(name)} follows itself")


def _moved(joint: Element, at: Array, shown: str) -> Array:
    """What a joint does at positions (S,): (S, 4, 4)."""
    axis = _to_axis(joint, shown)[:3, 2]
    T = np.tile(np.eye(4), (len(at), 1, 1))
    if joint.get("type") == "prismatic":
        T[:, :3, 3] = at[:, None] * axis
    else:
        T[:, :3, :3] = Rotation.from_rotvec(at[:, None] * axis).as_matrix()
    return T


def _boxes(link: Element, T: Array, shown: str) -> tuple[Box, ...]:
    """What a link collides as, where all of it is boxes; else none."""
    found = []
    for collision in link.findall("collision"):
        box = collision.find("geometry/box")
        if box is None:
            return ()
        half = _numbers(box.get("size", ""), 3, f"{shown}: a box") / 2
        found.append(Box(T @ _origin(collision, shown), half))
    return tuple(found)


def _read(path: Path) -> Element:
    """The <robot> of a URDF, or of the URDF that says what an MJCF says."""
    root = parsed(path)
    return root if root.tag == "robot" else as_urdf(root, path, parsed)


def parsed(path: Path) -> Element:
    """The root of a stranger's <robot> or <mujoco>: bounded in size, without a document type."""
    text, shown = read_file(path, MAX_BYTES).decode("utf-8", errors="replace"), printable(path)
    if re.search(r"<!\s*(doctype|entity)", text, re.IGNORECASE):
        raise FileError(f"{shown}: declares a document type; remove it, a robot needs none")
    if "xacro:" in text or path.suffix == ".xacro":
        how = "expand it with: xacro FILE > robot.urdf"
        raise FileError(f"{shown}: is a xacro program, which is not run here; {how}")
    try:  # prefixes that a file does not declare, such as drake:, say nothing that is read here
        text = re.sub(r"(</?|\s)[A-Za-z]+:(?=[A-Za-z_]+[\s=/>])", r"\1", text)
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, RecursionError) as error:
        raise FileError(f"{shown}: is not XML: {printable(error)[:100]}") from None
    if root.tag not in ("robot", "mujoco", "mujocoinclude"):
        raise FileError(
            f"{shown}: begins with <{printable(root.tag)[:40]}>, not <robot> or <mujoco>"
        )
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
    usual = {"lower": "-6.2831853", "upper": "6.2831853", "velocity": "0", "effort": "0"}
    low, high, speed, effort = (
        float(_numbers(node.get(k, d), 1, f"{shown}: joint {name}: {k}")[0])
        for k, d in usual.items()
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
    seen: dict[str, list[tuple[Element, Array]]] = {"visual": [], "collision": []}
    members = {name}
    while todo:
        at, T_at = todo.pop()
        for kind, found in seen.items():
            found += [(e, T_at @ _origin(e, shown)) for e in links[at].findall(kind)]
        if (inertial := links[at].find("inertial")) is not None:
            bodies.append(_body(inertial, T_at, f"{shown}: link {printable(at)}"))
        for joint in joints:
            child = _end(joint, "child", shown)
            fixed = joint.get("type") == "fixed" and _end(joint, "parent", shown) == at
            if fixed and child not in members | ends and child in links:
                members.add(child)
                todo.append((child, T_at @ _origin(joint, shown)))
    where = f"{shown}: link {printable(name)}"
    shown_as = [(_geometry(e, where), at) for e, at in seen["visual"] or seen["collision"]]
    meshes = [(mesh, at) for mesh, at in shown_as if mesh.tag == "mesh"]
    if len(meshes) > MAX_MESHES:
        raise FileError(f"{where} has more than {MAX_MESHES} visual meshes; join them into one")
    triangles = [_mesh(mesh, at, path, packages) for mesh, at in meshes]
    meshed = sum(map(len, triangles))
    shapes = _shapes([x for x in shown_as if x[0].tag != "mesh"], where)
    triangles += [shape.triangles() for shape in shapes]
    if not triangles:
        raise FileError(f"{where} has no visual mesh or shape")
    faces = np.concatenate(triangles)
    size = float(np.ptp(faces.reshape(-1, 3), axis=0).max())
    if not 1e-3 <= size <= LONGEST_M:
        how = f"1 mm to {LONGEST_M:g} m are allowed; correct the scale of its meshes"
        raise FileError(f"{where} is {size:g} m long; {how}")
    solid = [(_geometry(e, where), at) for e, at in seen["collision"]]
    plain = not any(shape.tag == "mesh" for shape, _ in solid)
    mass = sum(m for m, _, _ in bodies)
    com = sum((m * c for m, c, _ in bodies), np.zeros(3)) / (mass or 1.0)
    about = np.zeros((3, 3))
    for m, c, inertia in bodies:  # the parallel axis theorem
        d = c - com
        about += inertia + m * ((d @ d) * np.eye(3) - np.outer(d, d))
    collides = _shapes(solid, where) if plain and seen["visual"] else ()
    return Link(name, faces, mass, com, about, meshed, shapes, collides, tuple(sorted(members)))


def _geometry(element: Element, where: str) -> Element:
    """The shape of a <visual> or <collision>."""
    node = element.find("geometry")
    if node is None or not len(node):
        raise FileError(f"{where}: a <{element.tag}> has no shape in its <geometry>")
    return node[0]


def _shapes(given: list[tuple[Element, Array]], where: str) -> tuple[Shape, ...]:
    """Shapes as bodies: a cylinder between two spheres of its radius is a capsule, another sphere a capsule
    0.2 mm longer than it."""
    found: list[Shape] = []
    balls: list[Shape] = []
    capped: set[int] = set()
    for element, T in given:
        kind, sizes = element.tag, f"{element.get('radius', '')} {element.get('length', '')}"
        if kind == "box":
            size = _numbers(element.get("size", ""), 3, f"{where}: a box") / 2
        elif kind in ("cylinder", "capsule"):
            size = _numbers(sizes, 2, f"{where}: radius and length of a {kind}") * [1, 0.5]
        elif kind == "sphere":
            radius = _numbers(element.get("radius", ""), 1, f"{where}: a sphere's radius")
            size = np.append(radius, 1e-4)
        else:
            allowed = "a mesh, box, cylinder, sphere or capsule is"
            raise FileError(f"{where}: a <{printable(kind)[:40]}> is not read; {allowed}")
        if not 1e-4 <= size.min() <= size.max() <= LONGEST_M:
            raise FileError(
                f"{where}: a {kind} of {size} m; radii and half sides of 0.1 mm to {LONGEST_M:g} m are allowed"
            )
        shape = Shape(CAPSULE if kind == "sphere" else kind, T[:3, 3], T[:3, :3], size)
        (balls if kind == "sphere" else found).append(shape)
    for i, shape in enumerate(found):
        ends = [shape.pos + s * shape.size[1] * shape.R[:, 2] for s in (1, -1)]
        caps = [
            {
                k
                for k, b in enumerate(balls)
                if np.abs([*b.pos - end, b.size[0] - shape.size[0]]).max() < 1e-5
            }
            for end in ends
        ]
        if shape.kind == CYLINDER and all(caps):
            found[i] = Shape(CAPSULE, shape.pos, shape.R, shape.size)
            capped |= caps[0] | caps[1]
    return (*found, *(b for k, b in enumerate(balls) if k not in capped))


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
