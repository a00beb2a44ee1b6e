"""Which links of a robot touch: contact rates per pair of links in random postures, measured with
MuJoCo C (gripper open and closed, both present)."""

from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.config import Workplace
from r2h_batch.scene.robot import Robot, ShapeKind, corners_of, gripper_primitives_at

FAR_M = 0.05
NEAR_M = 0.010
"""Links that never touch and never come this near are not checked against each other."""
DENSE_JOINTS = 2
"""Joints between two links up to which random postures lie close enough to each other to say so."""


def mjcf(robot: Robot, table: Workplace | None = None) -> str:
    """The primitives as a MuJoCo model; geom names are `link/primitive`, finger shapes carry their opening's number."""
    T_gripper_ee = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee
    geoms: dict[str, list[str]] = {link: [] for link in robot.links}
    arm, meshes = robot.arm, ""
    for i, corners in enumerate(corners_of(arm)):
        link = robot.links[arm.link[i]]
        name = f"{link}/{arm.names[i]}"
        geoms[link].append(_geom(name, int(arm.kind[i]), arm.T_link_prim[i], arm.size[i]))
        if len(corners):
            meshes += f'<mesh name="{name}" inertia="convex" vertex="{_text(corners.ravel())}"/>'
    for i, opening in enumerate((robot.open_gap_m, 0.0)):
        for name, kind, T, size in zip(
            robot.gripper.names,
            robot.gripper.kind,
            gripper_primitives_at(robot, opening),
            robot.gripper.size,
            strict=True,
        ):
            geoms[robot.links[-1]].append(
                _geom(f"{robot.links[-1]}/{name}@{i}", int(kind), T_gripper_ee @ T, size)
            )
    xml, tail = "".join(geoms[robot.links[0]]), ""
    for i in range(len(robot.joints)):
        xml += (
            f'<body {_pose(robot.T_parent_joint[i])}><joint name="{robot.joints[i]}"/>'
            + "".join(geoms[robot.links[i + 1]])
        )
        tail += "</body>"
    xml += (
        f"<body {_pose(robot.T_wrist3_flange @ robot.T_flange_gripper)}>"
        + "".join(geoms[robot.links[-1]])
        + "</body>"
    )
    if table is not None:
        T = np.eye(4)
        T[:3, 3] = table.table_center
        tail += _geom("table/top", ShapeKind.BOX, T, np.array(table.table_half))
    return (
        '<mujoco><option><flag filterparent="disable"/></option><size memory="64M"/>'
        f'<default><geom mass="0.1" margin="{FAR_M}" gap="0"/></default>'
        f"<asset>{meshes}</asset><worldbody>{xml}{tail}</worldbody></mujoco>"
    )


def contact_rates(
    robot: Robot, configurations: int, seed: int = 0
) -> dict[tuple[str, str], tuple[float, float]]:
    """Per pair of links: share of configurations in contact, smallest distance in m (FAR_M if it was never nearer)."""
    model = mujoco.MjModel.from_xml_string(mjcf(robot))
    data = mujoco.MjData(model)
    names = (model.geom(g).name.split("/")[0] for g in range(model.ngeom))
    owner = np.array([robot.links.index(name) for name in names])
    touched = np.zeros((len(robot.links),) * 2, int)
    nearest = np.full((len(robot.links),) * 2, FAR_M)
    limits = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    size = (configurations, len(robot.joints))
    for q in np.random.default_rng(seed).uniform(*limits, size):
        _collide(model, data, q)
        pairs = np.sort(owner[data.contact.geom], axis=1)
        np.minimum.at(nearest, (pairs[:, 0], pairs[:, 1]), data.contact.dist)
        hit = np.unique(pairs[data.contact.dist <= 0.0], axis=0)
        touched[hit[:, 0], hit[:, 1]] += 1
    return {
        (robot.links[a], robot.links[b]): (touched[a, b] / configurations, float(nearest[a, b]))
        for a, b in combinations(range(len(robot.links)), 2)
    }


def checked_pairs(robot: Robot, configurations: int) -> dict[tuple[str, str], tuple[bool, str]]:
    """Whether each pair of links is to be checked, and why, from so many random postures."""
    found = {}
    for (a, b), (rate, nearest) in contact_rates(robot, configurations).items():
        first, last = robot.links.index(a), robot.links.index(b)
        joints = min(last, len(robot.joints)) - first
        if last - first == 1:
            found[a, b] = False, "neighbours"
        elif rate == 1:
            found[a, b] = False, "always in contact"
        elif rate == 0 and nearest > NEAR_M and joints <= DENSE_JOINTS:
            found[a, b] = False, f"never nearer than {1e3 * nearest:.0f} mm"
        else:
            often = f"in contact in {100 * rate:.1f} % of postures"
            never = f"no contact in {configurations:,} random postures, which prove nothing"
            found[a, b] = True, often if rate else never
    return found


def _collide(model: mujoco.MjModel, data: mujoco.MjData, q: NDArray[np.float64]) -> None:
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)


class Touching:
    """Checked pairs of links, and links and table, that overlap at a posture, gripper open or closed."""

    def __init__(self, robot: Robot, table: Workplace | None = None) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf(robot, table))
        self.data = mujoco.MjData(self.model)
        self.names = [*robot.links, "table"]
        self.checked = {tuple(sorted(pair)) for pair in robot.self_pairs.tolist()}
        self.checked |= {(k, len(robot.links)) for k in range(robot.table_from, len(robot.links))}

    def __call__(self, q: NDArray[np.float64]) -> list[str]:
        """Words for each such pair."""
        names = self.names
        _collide(self.model, self.data, q)
        met: dict[tuple[int, ...], set[str]] = {}
        for contact in self.data.contact:
            parts = [self.model.geom(g).name for g in contact.geom]
            pair = tuple(sorted(names.index(part.split("/")[0]) for part in parts))
            if contact.dist <= 0 and pair in self.checked:
                openings = {part.partition("@")[2] for part in parts}
                met.setdefault(pair, set()).update(
                    {"0", "1"} if openings == {""} else openings - {""}
                )
        when = {"0": " (gripper open)", "1": " (gripper closed)"}
        return [
            f"{names[a]} and {names[b]}{when.get(''.join(sorted(how)), '')}"
            for (a, b), how in sorted(met.items())
        ]


def touching(robot: Robot, q: NDArray[np.float64], table: Workplace | None = None) -> list[str]:
    """`Touching` at one posture."""
    return Touching(robot, table)(q)


def _geom(name: str, kind: int, T: NDArray[np.float64], size: NDArray[np.float64]) -> str:
    numbers = size if kind == ShapeKind.BOX else size[:2]
    shape = f'type="{ShapeKind(kind).name.lower()}" size="{_text(numbers)}"'
    if kind == ShapeKind.HULL:
        shape = f'type="mesh" mesh="{name}"'
    return f'<geom name="{name}" {shape} {_pose(T)}/>'


def _pose(T: NDArray[np.float64]) -> str:
    quat_wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return f'pos="{_text(T[:3, 3])}" quat="{_text(quat_wxyz)}"'


def _text(numbers: NDArray[np.float64]) -> str:
    return " ".join(repr(float(n)) for n in numbers)
