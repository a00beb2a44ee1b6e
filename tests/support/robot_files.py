"""A made arm of seven joints with two sliding fingers, written as a URDF and as an MJCF that say the same."""

from pathlib import Path

import trimesh

from r2h_batch.data.robot_chain import Chain, read_chain
from r2h_batch.data.robot_links import Link, Meshes, check_meshes, link_of, seen_of
from r2h_batch.data.robot_model import read_model

ARM = [  # offset of the joint from the one before, its axis, its range, torque
    ((0, 0, 0.15), "0 0 1", (-2.9, 2.9), 80),
    ((0, 0, 0.18), "0 1 0", (-1.8, 1.8), 80),
    ((0, 0, 0.20), "0 0 1", (-2.9, 2.9), 80),
    ((0, 0, 0.20), "0 1 0", (-2.6, 2.6), 80),
    ((0, 0, 0.20), "0 0 1", (-2.9, 2.9), 20),
    ((0, 0, 0.20), "0 -1 0", (-2.4, 2.4), 20),
    ((0.06, 0, 0.08), "0 0 1", (-2.9, 2.9), 20),
]
SHAPES = [  # of the base and of each link: kind, radius and length or sides, centre
    ("cylinder", (0.07, 0.14), (0, 0, 0.07)),
    ("cylinder", (0.06, 0.16), (0, 0, 0.07)),
    ("capsule", (0.05, 0.12), (0, 0, 0.09)),
    ("cylinder", (0.05, 0.16), (0, 0, 0.08)),
    ("box", (0.08, 0.08, 0.16), (0, 0, 0.08)),
    ("mesh", (0.07, 0.07, 0.18), (0, 0, 0.09)),
    ("sphere", (0.045,), (0.02, 0, 0.02)),
    ("cylinder", (0.04, 0.05), (0, 0, 0.04)),
]
FINGER, PALM, FLANGE_M, HAND_M = (0.016, 0.012, 0.05), (0.05, 0.18, 0.05), 0.07, 0.075
MASS_KG, FINGER_KG = 1.5, 0.1


def write_urdf(folder: Path, **changes: str) -> Path:
    """The arm as a URDF; of `changes` each key is text of it that the value replaces."""
    links, joints = [_link("base", *SHAPES[0])], []
    for k, (offset, axis, (low, high), torque) in enumerate(ARM):
        parent, child = "base" if k == 0 else f"l{k}", f"l{k + 1}"
        links.append(_link(child, *SHAPES[k + 1]))
        limit = f'<limit lower="{low}" upper="{high}" effort="{torque}" velocity="2"/>'
        joints.append(_joint(f"j{k + 1}", "revolute", parent, child, offset, axis, limit))
    joints.append(_joint("f", "fixed", "l7", "flange", (0, 0, FLANGE_M)))
    links.append(_link("flange", "box", PALM, (0, 0, 0.025)))
    for side, y in (("left", "1"), ("right", "-1")):
        links.append(_link(f"{side}_finger", "box", FINGER, (0, float(y) * 0.006, 0.025), FINGER_KG))
        limit = '<limit lower="0" upper="0.04" effort="1" velocity="2"/>'
        joints.append(
            _joint(f"{side}_slide", "prismatic", "flange", f"{side}_finger", (0, 0, HAND_M - 0.025), f"0 {y} 0", limit)
        )
    text = f'<robot name="made">{"".join(links + joints)}</robot>'
    return _written(folder / "made.urdf", text, changes)


def write_mjcf(folder: Path, **changes: str) -> Path:
    """The same arm as an MJCF: ranges in degrees, classes, a capsule from point to point, meshes in a folder."""
    body, tail, motors = _body("base", (0, 0, 0), SHAPES[0]), "</body>", ""
    for k, (offset, axis, (low, high), torque) in enumerate(ARM):
        turn = f'<joint name="j{k + 1}" axis="{axis}" range="{low * DEGREE!r} {high * DEGREE!r}"/>'
        body += _body(f"l{k + 1}", offset, SHAPES[k + 1], turn)
        tail += "</body>"
        motors += f'<motor joint="j{k + 1}" ctrlrange="-{torque / 2} {torque / 2}" gear="2"/>'
    body += _body("flange", (0, 0, FLANGE_M), ("box", PALM, (0, 0, 0.025)))
    for side, y in (("left", "1"), ("right", "-1")):
        slide = f'<joint name="{side}_slide" type="slide" axis="0 {y} 0" range="0 0.04"/>'
        finger = _body(f"{side}_finger", (0, 0, HAND_M - 0.025), ("box", FINGER, (0, float(y) * 0.006, 0.025)), slide)
        body += finger.replace(f'mass="{MASS_KG}"', f'mass="{FINGER_KG}"') + "</body>"
        motors += f'<motor joint="{side}_slide" ctrlrange="-1 1"/>'
    text = (
        '<mujoco model="made"><compiler meshdir="parts"/>'
        '<default><mesh scale="0.001 0.001 0.001"/><default class="seen"><geom contype="0" conaffinity="0" group="2"/></default>'
        '</default><asset><texture name="t" type="2d" file="../../wood.png"/><material name="m" texture="t"/>'
        f'<mesh name="block" file="block.stl"/></asset><worldbody><light pos="0 0 3"/>{body}{tail}</body></worldbody>'
        f"<actuator>{motors}</actuator><sensor/></mujoco>"
    )
    return _written(folder / "made.xml", text, changes)


DEGREE = 57.29577951308232


def _written(file: Path, text: str, changes: dict[str, str]) -> Path:
    (file.parent / "parts").mkdir(exist_ok=True)
    trimesh.creation.box([1e3 * x for x in SHAPES[5][1]]).export(file.parent / "parts" / "block.stl")
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    file.write_text(text)
    return file


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(map(repr, numbers))


def _link(name: str, kind: str, size: tuple[float, ...], at: tuple[float, ...], mass: float = MASS_KG) -> str:
    sizes = {
        "box": f'<box size="{_words(size)}"/>',
        "mesh": '<mesh filename="parts/block.stl" scale="0.001 0.001 0.001"/>',
        "sphere": f'<sphere radius="{size[0]}"/>',
    }
    shape = sizes.get(kind, f'<{kind} radius="{size[0]}" length="{size[-1]}"/>')
    body = f'<origin xyz="{_words(at)}"/><geometry>{shape}</geometry>'
    moments = 'ixx="0.01" ixy="0" ixz="0" iyy="0.012" iyz="0" izz="0.008"'
    return (
        f'<link name="{name}"><visual>{body}</visual><collision>{body}</collision>'
        f'<inertial><origin xyz="0 0 0.05"/><mass value="{mass}"/><inertia {moments}/></inertial></link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, offset: tuple, axis: str = "1 0 0", limit: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_words(offset)}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def _body(name: str, offset: tuple, shape: tuple, joint: str = "") -> str:
    kind, size, at = shape
    place, half = f'pos="{_words(at)}"', _words(tuple(x / 2 for x in size))
    if kind == "capsule":
        ends = (*at[:2], at[2] + size[1] / 2, *at[:2], at[2] - size[1] / 2)  # z points from the second to the first
        place, half = f'fromto="{_words(ends)}"', str(size[0])
    elif kind == "cylinder":
        half = _words((size[0], size[1] / 2))
    elif kind == "sphere":
        half = str(size[0])
    what = 'type="mesh" mesh="block"' if kind == "mesh" else f'type="{kind}" size="{half}"'
    return (
        f'<body name="{name}" pos="{_words(offset)}">{joint}'
        f'<inertial pos="0 0 0.05" mass="{MASS_KG}" diaginertia="0.01 0.012 0.008"/>'
        f'<geom {what} {place}/><geom class="seen" {what} {place}/>'
    )


def read_arm(path: Path, base: str = "base", flange: str = "flange", *, bare: bool = False) -> tuple[Chain, list[Link]]:
    """The chain of a file and its links with their meshes, read as the import reads them."""
    model = read_model(path)
    chain = read_chain(model, base, flange, bare=bare)
    check_meshes(chain.links, (), model.shown)
    meshes = Meshes(model, [g for part in chain.links for g in seen_of(part)], {})
    return chain, [link_of(part, meshes) for part in chain.links]
