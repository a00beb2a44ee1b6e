"""A second judge of physics at the gripper: `results held` and `results transfer`.

Written from docs/transfer.md: gripper, object and the person's hand as MJCF for MuJoCo C, closing, settling, weight, sensor,
policies, person and outcomes tick by tick and row by row in float64, and statics as an own linear program. Shared with the
project are meshes, masses and pieces of objects, and the solver (MuJoCo C); of `held` nothing else: where the gripper closes on
the object comes from `judge_twin`. Of transfers also the start (where reception has object, gripper and hand, and what the
hand's grasp withstands), the drawn persons and the sensor's noise. Centres of mass: of a driver half way to its pin, of a pad
in its middle.

`carries` hangs on which points touch. Two postures that agree to a tenth of a millimetre can touch at other ones, and then the
multiples of the weight differ by factors, on both sides: the linear programs agree on the same contacts. So the twin closes the
gripper with half the step too. A number is judged where the twin's own two agree, and is `open` where they do not.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, tostring

import mujoco
import numpy as np
from judge_twin import Again, Finding
from numpy.typing import NDArray
from scipy.optimize import brentq, linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
G, TICK_S, STEPS = 9.81, 1 / 120, 6
MU, TORSION_M = 0.8, 0.005
PAD, OPEN_M = (0.011, 0.003175, 0.01875), 0.085
PIVOT, PIN, TO_PAD = 0.0306 + 0.0549j, 0.0376 + 0.043j, -0.02202 + 0.03242j
TORQUE_NM, SPEED_M_S = 1.5, 0.15
BASE_KG, WRIST_N_M = 4.0, 6e4
ARM_KG, TURN_KG_M2, TURN_NM_RAD, DAMPED = 1.2, 0.005, 6.0, 0.9
AJAR_M, CLOSE_TICKS, SETTLE_TICKS, MOST_TICKS, ARM_N_M, LEAST = 0.004, 15, 30, 1200, 300.0, 1e-6
TOUCH_M, BEGIN_S, PRELOAD_S = 0.0005, 0.15, 0.15
LENGTH_M, ANGLE_DEG, FORCE_N, TIME_S = 1e-3, 1.0, 1.0, 0.2
"""To which numbers that decide nothing must agree: docs/transfer.md compares its engines so."""
CARRIED = 0.1
"""Share by which `carries` may differ: polytopes in the cones are smaller by some percent."""


def el(tag: str, *children: Element, **attributes: Any) -> Element:
    """An element of MJCF; lists of numbers are written out."""
    made = Element(tag, {k: v if isinstance(v, str) else text(v) for k, v in attributes.items()})
    made.extend(children)
    return made


def text(numbers: Any) -> str:
    return " ".join(map(repr, np.atleast_1d(np.asarray(numbers, np.float64)).ravel().tolist()))


def gap_at(drive: float) -> float:
    """Between the inner faces of the pads, m."""
    return 2 * float((PIVOT + PIN * np.exp(1j * drive) + TO_PAD).real - PAD[1])


def drive_at(gap: float) -> float:
    """Turn of the drivers at a gap."""
    return float(brentq(lambda q: gap_at(q) - gap, 0.0, 0.8))


def spring(joint: str, kp: float, mass: float, damped: float = 1.0) -> Element:
    return el("position", name=joint, joint=joint, kp=kp, kv=2 * damped * np.sqrt(kp * mass))


def inertial(mass: float, inertia: float, at: Any = (0, 0, 0)) -> Element:
    return el("inertial", pos=at, mass=mass, diaginertia=[inertia] * 3)


STIFF: Mapping[str, Any] = {"solref": [0.0056, 1], "solimp": [0.99, 0.99, 0.001, 0.5, 2]}
RUBBER: Mapping[str, Any] = {
    "friction": [MU, TORSION_M, 1e-4], "condim": "4", **STIFF,
}  # fmt: skip
AXES = dict(zip("xyz", np.eye(3), strict=True))


def finger(name: str, side: int) -> Element:
    """A driver, its pad on a parallelogram: the pad turns back by as much."""
    hinge = {"type": "hinge", "axis": [side, 0, 0]}
    most = {"actuatorfrcrange": [-TORQUE_NM, TORQUE_NM], "range": [-0.05, 0.85], "limited": "true"}
    at = {
        k: [0, side * p.real, p.imag]
        for k, p in (("driver", PIVOT), ("pin", PIN), ("middle", PIN / 2), ("pad", TO_PAD))
    }
    box = el("geom", type="box", size=PAD, pos=at["pad"], contype="1", conaffinity="2", name=name, **RUBBER)
    tip = el("joint", name=f"{name}_pad", armature=1e-4, **hinge)
    pad = el("body", inertial(0.05, 1e-5, at["pad"]), tip, box, pos=at["pin"], gravcomp="1")
    turns = el("joint", name=name, armature=1e-3, actuatorfrclimited="true", **hinge, **most)
    return el("body", inertial(0.05, 1e-5, at["middle"]), turns, pad, pos=at["driver"], gravcomp="1")


def model_of(thing: Any, step_s: float, T_obj: Array, T_slip: Array, arm_n_m: float) -> mujoco.MjModel:
    """The gripper, and the object in the person's hand: at the grasp's frame T_slip, on an arm that is so stiff."""
    xx, yy, zz, xy, xz, yz = np.asarray(thing.inertia, np.float64)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    mass = {"pos": thing.com, "mass": float(thing.mass), "fullinertia": [xx, yy, zz, xy, xz, yz]}
    hulls = [np.asarray(v, np.float64)[ConvexHull(v).vertices] for v, _ in thing.pieces]
    meshes = [el("mesh", name=f"p{k}", vertex=v, inertia="convex") for k, v in enumerate(hulls)]
    body = el("body", el("inertial", **mass), name="object")
    for k in range(len(hulls)):
        body.append(el("geom", type="mesh", mesh=f"p{k}", contype="2", conaffinity="1", **RUBBER))
    slides = [el("joint", name=f"wrist_{x}", type="slide", axis=a) for x, a in AXES.items()]
    base = el("body", inertial(BASE_KG, 0.02), *slides, finger("left", -1), finger("right", 1), gravcomp="1")
    slowed = TORQUE_NM / (SPEED_M_S * abs(drive_at(OPEN_M / 2 - 1e-4) - drive_at(OPEN_M / 2 + 1e-4)) / 2e-4)
    motors = [
        el("general", name=n, joint=n, gainprm="1", biastype="affine", biasprm=[0, 0, -slowed])
        for n in ("left", "right")
    ]
    motors += [spring(f"wrist_{x}", WRIST_N_M, BASE_KG) for x in AXES]
    pairs = (("left_pad", "left", -1), ("right_pad", "right", -1), ("left", "right", 1))
    ties = [el("joint", joint1=a, joint2=b, polycoef=[0, s, 0, 0, 0], **STIFF) for a, b, s in pairs]
    dry = {"frictionloss": LEAST, "solreffriction": [0.0028, 1], "solimpfriction": [0.9995, 0.9999, 0.001, 0.5, 2]}
    T = np.linalg.inv(T_slip) @ T_obj
    body.attrib |= {"pos": text(T[:3, 3]), "quat": text(wxyz(T[:3, :3]))}
    slips = [el("joint", name=f"slip_{x}", type="slide", axis=a, **dry) for x, a in AXES.items()]
    slips.append(el("joint", name="slip_turn", type="ball", **dry))
    grasp = el("body", *slips, body, quat=wxyz(T_slip[:3, :3]), gravcomp="1")
    arm = [el("joint", name=f"arm_{x}", type="slide", axis=a) for x, a in AXES.items()]
    arm += [el("joint", name=f"turn_{x}", type="hinge", axis=a) for x, a in AXES.items()]
    hand = el("body", inertial(ARM_KG, TURN_KG_M2), *arm, grasp, pos=T_slip[:3, 3], gravcomp="1")
    motors += [spring(f"arm_{x}", arm_n_m, ARM_KG, DAMPED) for x in AXES]
    motors += [spring(f"turn_{x}", TURN_NM_RAD, 2 * TURN_KG_M2, DAMPED) for x in AXES]
    how = {"timestep": step_s, "gravity": [0, 0, 0], "integrator": "implicitfast", "cone": "elliptic"}
    option = el("option", el("flag", autoreset="disable"), impratio="100", tolerance="1e-12", **how)
    parts = [el("worldbody", base, hand), el("equality", *ties), el("actuator", *motors)]
    whole = el("mujoco", el("compiler", angle="radian"), option, el("asset", *meshes), *parts)
    return mujoco.MjModel.from_xml_string(tostring(whole, encoding="unicode"))


def wxyz(R: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R).as_quat(scalar_first=True))


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a transfer in the gripper's frame, and the person; what this file shares with the project."""

    thing: Any
    T_obj: Array
    opening: float
    down: Array
    T_slip: Array
    capacity: Array
    total_n: float
    pull: Array
    point: Array
    press: Array
    R_world: Array
    noise: Array
    grip: float
    arm_n_m: float
    pull_n: float
    pause_s: float
    age: float


class Gripper:
    """The gripper, ajar about the object, in MuJoCo; `close` closes it."""

    def __init__(
        self,
        thing: Any,
        T_obj: Array,
        opening: float,
        *,
        T_slip: Array | None = None,
        arm_n_m: float = ARM_N_M,
        steps: int = STEPS,
    ) -> None:
        self.steps = steps
        self.m = model_of(thing, TICK_S / steps, T_obj, T_obj if T_slip is None else T_slip, arm_n_m)
        self.d = d = mujoco.MjData(self.m)
        q = drive_at(min(opening + AJAR_M, OPEN_M))
        for name in ("left", "right"):
            d.joint(name).qpos, d.joint(f"{name}_pad").qpos = q, -q
        self.slip_v = int(self.m.joint("slip_x").dofadr[0]) + np.arange(6)
        self.body = self.m.body("object").id
        self.mass = float(self.m.body_mass[self.body])
        mujoco.mj_forward(self.m, d)

    @property
    def com(self) -> Array:
        return np.array(self.d.xipos[self.body])

    @property
    def turn(self) -> Rotation:
        return Rotation.from_quat(self.d.xquat[self.body], scalar_first=True)

    def touched(self) -> bool:
        return any(contact.dist < TOUCH_M for contact in self.d.contact)

    def tick(self, ticks: int = 1) -> None:
        mujoco.mj_step(self.m, self.d, ticks * self.steps)

    def squeeze(self, share: float) -> None:
        for name in ("left", "right"):
            self.d.actuator(name).ctrl = share * TORQUE_NM

    def close(self) -> None:
        """Closes with full torque; the object is slowed and does not weigh."""
        heavy = np.repeat([self.mass, self.m.body_inertia[self.body].sum()], 3)
        self.m.dof_damping[self.slip_v] = 50.0 * heavy
        self.squeeze(1.0)
        self.tick(CLOSE_TICKS)
        self.m.dof_damping[self.slip_v] = 1e-5


@dataclass(frozen=True)
class Held:
    """The numbers of a row of held/METHOD.parquet; lengths in m."""

    lost: str | None
    settled: bool
    closing_m: float
    squeezed_m: float
    slip_m: float = float("nan")
    turn_deg: float = float("nan")
    carries: float = float("nan")


def held(thing: Any, T_obj: Array, opening: float, down: Array, *, steps: int = STEPS) -> Held:
    """Closes the gripper, waits until the object stands, and lets its weight act for a second."""
    g = Gripper(thing, T_obj, opening, steps=steps)
    start = g.com
    g.close()
    closed, last, slow, settled = g.com, g.com, 0, False
    for _ in range(120):
        g.tick()
        slow = slow + 1 if np.linalg.norm(g.com - last) / TICK_S < 1e-3 else 0
        last = g.com
        if settled := slow >= 6:
            break
    ways = float(np.linalg.norm(closed - start)), float(np.linalg.norm(last - closed))
    contacts = contacts_of(g)
    if any(sum(c.force @ c.normal for c in contacts if c.left == left) <= 0.05 for left in (True, False)):
        return Held("closing", settled, *ways)
    if ways[1] >= 0.02:
        return Held("closing", settled, *ways)
    carries, stood = carried(contacts, g.com, g.mass * G * down), g.turn
    g.m.opt.gravity[:] = G * down
    g.tick(120)
    slip = float(np.linalg.norm(g.com - last))
    turn = float(np.degrees((stood.inv() * g.turn).magnitude()))
    return Held("weight" if slip >= 0.02 else None, settled, *ways, slip, turn, carries)


@dataclass(frozen=True, eq=False)
class Contact:
    """A contact of a pad and the object: normal into the object, and the pad's force on it, frame gripper."""

    left: bool
    at: Array
    normal: Array
    force: Array


def contacts_of(g: Gripper) -> list[Contact]:
    """Contacts and forces of the posture now."""
    mujoco.mj_forward(g.m, g.d)
    found, wrench = [], np.zeros(6)
    for k, c in enumerate(g.d.contact):
        if c.efc_address < 0:
            continue
        mujoco.mj_contactForce(g.m, g.d, k, wrench)
        axes = c.frame.reshape(3, 3) * (-1 if g.m.geom_bodyid[c.geom1] == g.body else 1)
        left = g.m.geom("left").id in (c.geom1, c.geom2)
        found.append(Contact(left, c.pos.copy(), axes[0], axes.T @ wrench[:3]))
    return found


def carried(contacts: list[Contact], com: Array, weight: Array) -> float:
    """The largest multiple of the weight, at most 50, that forces in the cones balance while the pads press as simulated.

    A contact's tangential force over 0.8 N and its torsion over 0.8 N x 5 mm lie in a ball of radius 1 for a newton of normal
    force. 600 points of its surface, spread as on a sunflower, stand for it.
    """
    k = np.arange(600) + 0.5
    z, phi = 1 - 2 * k / 600, np.pi * (1 + 5**0.5) * k
    ball = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z])
    columns, press = [], []
    for c in contacts:
        tangents = np.linalg.svd(c.normal[None])[2][1:]
        force = c.normal[:, None] + MU * tangents.T @ ball[:2]
        moment = np.cross(c.at - com, force.T).T
        columns.append(np.concatenate([force, (moment + MU * TORSION_M * np.outer(c.normal, ball[2])) * 20]))
        press.append(force[1] * (1 if c.left else -1))
    pressed = sum(abs(sum(c.force[1] for c in contacts if c.left == left)) for left in (True, False))
    A = np.block([[np.concatenate(columns, 1), np.r_[weight, 0, 0, 0][:, None]], [np.concatenate(press), 0.0]])
    ends = []
    for sign in (1, -1):
        cost = np.r_[np.zeros(A.shape[1] - 1), sign]
        found = linprog(
            cost, A_eq=A, b_eq=np.r_[np.zeros(6), pressed], bounds=[(0, None)] * (len(cost) - 1) + [(-50, 50)]
        )
        if not found.success:
            return float("nan")
        ends.append(found.x[-1])
    return float(ends[1]) if ends[0] <= 1.0 else float("nan")


class Policy:
    """`threshold`, `load-share`, `timer` or `never`: reads the load's change in world axes.

    Attributes:
        shift: where it moves its hand, world axes, m.
    """

    shift: Array = np.zeros(3)

    def __init__(self, name: str, weight_n: float) -> None:
        self.name, self.weight = name, max(weight_n, 0.6)
        self.read: list[Array] = []
        self.lasted = 0
        self.over: list[float] = []
        self.surplus = -np.inf
        """By how much the readings exceed what lets go."""

    def __call__(self, force: Array) -> tuple[bool, float]:
        """Whether to let go now, and the squeeze until then."""
        self.read.append(force)
        if len(self.read) <= 12:
            return False, 1.0
        change = np.mean(self.read[12:][-6:], 0) - np.mean(self.read[:12], 0)
        size, share = float(np.linalg.norm(change)), float(change[2]) / self.weight
        if self.name == "timer":
            self.surplus = size - 1.5
            self.lasted += self.lasted > 0 or size > 1.5
            return self.lasted * TICK_S > 0.5, 1.0
        over = {"threshold": size - 5.0, "load-share": (share - 0.9) * self.weight, "never": -np.inf}[self.name]
        self.over.append(over)
        if len(self.over) >= 7:
            self.surplus = min(self.over[-7:])
        self.lasted = self.lasted + 1 if over > 0 else 0
        squeeze = float(np.clip(1 - 0.65 * share, 0.35, 1)) if self.name == "load-share" else 1.0
        return self.lasted * TICK_S > 0.05 + 1e-9, squeeze


class Probe:
    """`probe`: shakes its hand, and looks for two directions in which something beside the object's mass resists.

    Attributes:
        shift: where it moves its hand, world axes, m.
    """

    TURN, SHIFT_M, RAMP_S, WINDOW = 2 * np.pi * np.array([4.0, 6.0, 8.0]), 0.004, 0.1, 54

    def __init__(self, weight_n: float) -> None:
        self.weight, self.kg = max(weight_n, 0.6), weight_n / G + 0.2
        self.read: list[Array] = []
        self.shift = np.zeros(3)
        self.over: list[float] = []
        self.surplus = -np.inf
        """By how much the readings exceed what lets go."""
        age = np.arange(1 - self.WINDOW, 1) / self.WINDOW
        self.drift = np.column_stack([age**0, age, age**2])

    def moved(self, t: Array) -> Array:
        """Shifts at these times since the tare, and after them the same a quarter of a period later, (K, 6)."""
        wave = np.exp(1j * np.outer(t, self.TURN)) * self.SHIFT_M * np.clip(t / self.RAMP_S, 0, 1)[:, None]
        return np.hstack([wave.imag, wave.real])

    def __call__(self, force: Array) -> tuple[bool, float]:
        """Whether to let go now, and the squeeze until then."""
        t = (len(self.read) - 12) * TICK_S
        self.read.append(force)
        self.shift = self.moved(np.array([t]))[0, :3]
        if len(self.read) >= self.WINDOW:
            self.over.append(self.feels(t))
        if len(self.over) >= 13:
            self.surplus = min(self.over[-13:])
        return self.surplus > 0, 1.0

    def feels(self, t: float) -> float:
        """By how much a hand holds and carries the object, N: the least squares of readings and of what is believed before."""
        sent = t - TICK_S * np.arange(self.WINDOW, 0, -1)  # a reading is a tick late
        seen = np.hstack([self.drift, self.moved(sent)]) / 0.5
        believed = np.diag(np.r_[np.full(3, 1e-6**0.5), np.full(6, 1 / 2000.0)])
        answers = np.vstack([np.array(self.read[-self.WINDOW :]) / 0.5, np.zeros((9, 3))])
        found, *_ = np.linalg.lstsq(np.vstack([seen, believed]), answers)
        sigma = np.linalg.norm(np.linalg.pinv(np.vstack([seen, believed]))[3:], axis=1).max()
        stiff = (found[3:6] + 1j * found[6:]).T - np.diag(self.kg * self.TURN**2)
        second = float(np.linalg.svd(stiff, compute_uv=False)[1])
        share = (found[0, 2] - float(np.mean([r[2] for r in self.read[:12]]))) / self.weight
        least = 200 + 0.35 * self.kg * self.TURN[1] ** 2 + 3 * sigma
        stiff = 0.5 * (sum(second > least + step * 0.5 / self.SHIFT_M for step in (-1, 0, 1)) - 1.5)
        return float(min((share - 0.5) * self.weight, stiff))


class Person:
    """Takes the object: grips, takes the weight, pulls, waits, rests, pulls once more, gives up."""

    def __init__(self, start: Start, weight_n: float, scenario: str) -> None:
        self.start, self.weight, self.early = start, weight_n, scenario == "pull-early"
        self.load_s = 0.3 + 0.046 * weight_n
        older = float(np.clip((start.age - 50.0) / 26.5, 0, 1))
        self.grip, self.pause_s = start.grip * (1 + older), start.pause_s + 0.1 * older
        self.most_grip, self.speed = (30.0 if scenario == "weak" else 80.0), 0.3 if self.early else 0.15
        self.state, self.ticks, self.pulls, self.firm = "waits", 0, 1, 1.0
        self.pulled = self.let_go = self.felt = self.grip_n = 0.0
        self.support = np.zeros(3)

    def act(self, t: float, arm: Array, *, free: bool, lost: bool) -> tuple[Array, Array]:
        """Where the arm pulls the hand (m, from the grasp), and what the grasp withstands."""
        s, before, for_s = self.start, self.state, self.ticks * TICK_S
        farthest = s.pull_n / s.arm_n_m
        after = 0.0 if self.early else PRELOAD_S + self.load_s + self.pause_s
        if before in ("grips", "pulls", "waits at most", "rests") and free:
            self.state, self.let_go = "has", self.pulled
        elif before == "waits" and for_s >= BEGIN_S - 1e-9:
            self.state = "grips"
        elif (before == "grips" and for_s >= after) or (before == "rests" and for_s >= 0.4):
            self.state = "pulls"
            if before == "rests":
                self.firm, self.pulls = 1.25 * self.firm, self.pulls + 1
        elif before == "pulls" and self.pulled >= farthest:
            self.state = "waits at most"
        elif before == "waits at most" and for_s >= 0.5:
            self.state = "rests" if self.pulls < 2 else "gave up"
        self.ticks = self.ticks + 1 if self.state == before else 0
        step = self.speed * TICK_S
        if self.state in ("pulls", "has"):
            self.pulled = min(self.pulled + step, self.let_go + 0.25 if self.state == "has" else farthest)
        elif self.state == "rests":
            self.pulled = max(self.pulled - 3 * step, 0.0)
        age = t - BEGIN_S if self.state != "waits" else -1.0
        load = 0.0 if lost else float(np.clip((age - PRELOAD_S) / self.load_s, 0, 1))
        self.support = -s.down * load * self.weight
        self.felt += 0.3 * (float(np.linalg.norm(arm)) - self.felt)
        usual = max(s.total_n, 10.0 + 5.0 * self.felt) * self.grip * self.firm
        self.grip_n = 0.0 if lost else float(np.clip(age / self.load_s, 0, 1)) * min(usual, self.most_grip)
        return self.support / s.arm_n_m + s.pull * self.pulled, np.maximum(0.7 * s.capacity * self.grip_n, LEAST)


@dataclass(frozen=True)
class Ended:
    """The numbers of a row of transfer/METHOD.parquet."""

    outcome: str
    transfer_s: float
    pull_n: float
    hand_n: float
    grip_n: float
    slip_m: float
    turn_deg: float
    robot_slip_m: float
    undecided: bool


class Transfer:
    """One transfer, tick by tick."""

    def __init__(self, start: Start, release: str, scenario: str, *, steps: int = STEPS) -> None:
        self.start, self.scenario, self.takes = start, scenario, scenario not in ("touch", "nobody")
        self.g = g = Gripper(
            start.thing, start.T_obj, start.opening, T_slip=start.T_slip, arm_n_m=start.arm_n_m, steps=steps
        )
        g.close()
        self.closed = g.com
        g.m.opt.gravity[:] = G * start.down
        g.tick(SETTLE_TICKS)
        self.policy = Probe(g.mass * G) if release == "probe" else Policy(release, g.mass * G)
        self.person = Person(start, g.mass * G, scenario)
        self.at0, self.turn0 = self.in_hand()
        self.decided = self.free_s = self.lost_s = np.inf
        self.apart, self.slipping = 0, False
        self.pull_n = self.hand_n = self.grip_n = self.slip = self.turned = self.robot_slip = self.untouched = 0.0
        self.surplus = -np.inf

    def in_hand(self) -> tuple[Array, Rotation]:
        """Shift and turn of the object in the hand."""
        d = self.g.d
        shift = np.array([float(d.joint(f"slip_{x}").qpos[0]) for x in AXES])
        return shift, Rotation.from_quat(d.joint("slip_turn").qpos, scalar_first=True)

    def xyz(self, kind: str, of: str) -> Array:
        d = self.g.d
        if kind == "force":
            return np.array([float(np.atleast_1d(d.actuator(f"{of}_{x}").force)[0]) for x in AXES])
        return np.array([float(getattr(d.joint(f"{of}_{x}"), kind)[0]) for x in AXES])

    def run(self) -> Ended:
        """Until something decides how it ends, at most 6 s."""
        heard: Array | None = None
        outcome = None
        for k in range(MOST_TICKS):
            t = k * TICK_S
            outcome = self.look(t)
            if outcome is not None:
                break
            force = self.start.R_world @ (BASE_KG * self.xyz("qacc", "wrist") - self.xyz("force", "wrist"))
            force = force + self.start.noise[k]
            opens, squeeze = self.policy(force if heard is None else heard)
            heard = force
            if t - self.decided < 0.06:
                self.surplus = max(self.surplus, self.policy.surplus)
            if opens and np.isinf(self.decided):
                self.decided = t
                if self.takes and self.person.pulls == 1 and self.person.state in ("waits", "grips", "pulls"):
                    self.surplus = np.inf
            self.move(t, squeeze)
            self.g.tick()
        free = self.free_s - BEGIN_S if np.isfinite(self.free_s) else float("nan")
        ways = self.slip, self.turned, self.robot_slip
        return Ended(outcome or "", free, self.pull_n, self.hand_n, self.grip_n, *ways, self.doubtful(outcome or ""))

    def doubtful(self, outcome: str) -> bool:
        """Whether it hangs on less than the model knows."""
        if any(0.015 < x < 0.06 for x in (self.robot_slip, self.untouched)) or abs(self.surplus) < 0.5:
            return True
        if outcome == "stuck" or (np.isfinite(self.free_s) and self.free_s - self.decided > 0.75):
            return True
        if outcome in ("dropped", "hand_slipped_off"):
            return self.slip < 0.1
        far = self.slip > 0.025 or self.turned > 45.0
        if far and outcome in ("badly_held", "not_released", "torn_out"):
            return True
        surely, perhaps = (self.slip < 0.02 * x and self.turned < 30.0 * x for x in (0.5, 2.0))
        return outcome in ("taken", "badly_held") and surely != perhaps

    def move(self, t: float, squeeze: float) -> None:
        """The person, the fingers and the robot's arm act."""
        d = self.g.d
        since = t - self.decided - 0.06
        self.g.squeeze(-1.0 if since >= 0 else squeeze)
        back = np.array([0, 0, -np.clip(0.15 * (since - 0.2), 0, 0.1)])
        for x, value in zip(AXES, back if since >= 0 else self.start.R_world.T @ self.policy.shift, strict=True):
            d.actuator(f"wrist_{x}").ctrl = value
        if self.takes:
            free, lost = np.isfinite(self.free_s), np.isfinite(self.lost_s)
            target, dry = self.person.act(t, self.xyz("force", "arm"), free=free, lost=lost)
            for x, value in zip(AXES, target, strict=True):
                d.actuator(f"arm_{x}").ctrl = value
            self.g.m.dof_frictionloss[self.g.slip_v] = dry
        elif self.scenario == "touch":
            self.press(t - BEGIN_S)

    def press(self, age: float) -> None:
        """A finger that presses like a spring, and stops where the object gives way."""
        d, s = self.g.d, self.start
        R = d.xmat[self.g.body].reshape(3, 3) @ s.T_obj[:3, :3].T
        at = d.xpos[self.g.body] + R @ (s.point - s.T_obj[:3, 3])
        if not hasattr(self, "met"):
            self.met = at.copy()
        push = 6.0 * float(np.clip(min(age, 0.7 - age) / 0.1, 0, 1)) - 600.0 * max(
            float((at - self.met) @ R @ s.press), 0.0
        )
        force = max(push, 0.0) * (R @ s.press)
        d.xfrc_applied[self.g.body] = np.r_[force, np.cross(at - self.g.com, force)]

    def look(self, t: float) -> str | None:
        """Measures; how it ends, if it does now."""
        begun, gripping = t >= BEGIN_S - 1e-9, self.person.state != "waits"
        decided, free = np.isfinite(self.decided), np.isfinite(self.free_s)
        at, turn = self.in_hand()
        if not begun:
            self.at0, self.turn0 = at, turn
        if not begun or not self.takes:
            if not (begun and decided):
                self.robot_slip = float(np.linalg.norm(self.g.com - self.xyz("qpos", "wrist") - self.closed))
                self.slipping |= self.robot_slip > 0.03
            if not begun:
                self.untouched = self.robot_slip
        slip, turned = float(np.linalg.norm(at - self.at0)), float(np.degrees((self.turn0.inv() * turn).magnitude()))
        if self.takes and gripping:
            arm = self.xyz("force", "arm")
            self.slip, self.turned = slip, turned
            self.hand_n, self.grip_n = (
                max(self.hand_n, float(np.linalg.norm(arm))),
                max(self.grip_n, self.person.grip_n / 2),
            )
            if not free:
                self.pull_n = max(self.pull_n, float((arm - self.person.support) @ self.start.pull))
        self.apart = 0 if self.g.touched() else self.apart + 1
        if begun and self.apart >= 4 and not free:
            self.free_s, free = t - 3 * TICK_S, True
        if (
            self.takes
            and t >= BEGIN_S + self.person.load_s - 1e-9
            and np.isinf(self.lost_s)
            and (slip > 0.05 or turned > 90.0)
        ):
            self.lost_s = t
        if not np.isfinite(self.g.d.qpos).all() or np.abs(self.g.d.qvel).max() > 300.0:
            return "exploded"
        far = self.robot_slip > 2 * 0.03
        if not begun:
            return "robot_dropped" if far else None
        return self.taken(t, decided, free) if self.takes else self.kept(t, decided, free, far)

    def kept(self, t: float, decided: bool, free: bool, far: bool) -> str | None:
        """How a touch ends."""
        over = t > BEGIN_S + 0.7 + 0.3
        if self.slipping and (far or over or decided):
            return "robot_dropped"
        if decided:
            return "false_release" if t - self.decided >= 0.06 else None
        return "robot_dropped" if free else "kept" if over else None

    def taken(self, t: float, decided: bool, free: bool) -> str | None:
        """How taking ends."""
        lost = np.isfinite(self.lost_s)
        if self.slipping:
            return "robot_dropped"
        kept = free and t - self.free_s > 0.5
        if free and lost and (kept or self.slip > 2 * 0.05):
            return "dropped"
        if kept:
            return "torn_out" if not decided else "taken" if self.slip < 0.02 and self.turned < 30.0 else "badly_held"
        if lost and not decided and not free and t - self.lost_s > 0.3:
            return "hand_slipped_off"
        if not free and decided and t - self.decided > 1.5:
            return "stuck"
        return "not_released" if self.person.state == "gave up" and not decided and not free else None


def held_of(again: Again, says: Mapping[str, Any]) -> Iterator[Finding]:
    """Statements of a row of held/METHOD.parquet beside what is so; of kind `open` where half the step says something else.

    Args:
        again: the row's twin.
        says: the row; empty: there is none.
    """
    stable = bool(again.stability() >= 0)
    robot = again.robot
    T_ee_gripper = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
    yield Finding("is_asked", bool(says), stable, "fact", wrong=bool(says) != stable)
    if not says or not stable:
        return
    T_obj = np.linalg.inv(again.attached @ T_ee_gripper)
    opening = max(again.closed.opening - again.config.thresholds.pad_squeeze_m, 0.0)
    down = -(again.T_world_ee @ T_ee_gripper)[2, :3]
    true, finer = (held(again.model, T_obj, opening, down, steps=n) for n in (STEPS, 2 * STEPS))
    same = true.lost == finer.lost and not says["undecided"]
    yield Finding("lost", says["lost"], true.lost, "fact" if same else "open", wrong=same and says["lost"] != true.lost)
    if not same or says["lost"] != true.lost:
        return
    yield one_of("settled", says["settled"], true.settled, finer.settled, lambda a, b: a == b)
    numbers = ("closing_m", "squeezed_m", "slip_m", "turn_deg", "carries") if says["lost"] is None else ()
    for name in numbers:
        agree = AGREE[name]
        said = float("nan") if says[name] is None else says[name]
        yield one_of(name, said, getattr(true, name), getattr(finer, name), agree)


def one_of(name: str, said: Any, true: Any, finer: Any, agree: Callable[[Any, Any], bool]) -> Finding:
    """A statement beside what is so, where half the step says the same."""
    if not agree(true, finer):
        return Finding(name, said, true, "open")
    return Finding(name, said, true, "fact", wrong=not (agree(said, true) or agree(said, finer)))


def within(room: float) -> Callable[[float, float], bool]:
    return lambda a, b: bool(abs(a - b) <= room)


def alike(a: float, b: float) -> bool:
    """Whether two multiples of the weight agree: neither is one, or they differ by no more than `CARRIED`."""
    return bool(np.isnan([a, b]).all() or abs(a - b) <= CARRIED * min(abs(a), abs(b)))


AGREE: Mapping[str, Callable[[Any, Any], bool]] = {
    "closing_m": within(LENGTH_M), "squeezed_m": within(LENGTH_M), "slip_m": within(LENGTH_M), "turn_deg": within(ANGLE_DEG),
    "carries": alike,
}  # fmt: skip


def transfer_of(start: Start, says: Mapping[str, Any]) -> Iterator[Finding]:
    """Statements of a row of transfer/METHOD.parquet beside what is so; of kind `open` where half the step says something else.

    Args:
        start: of the transfer, and the person.
        says: the row.
    """
    true, finer = (Transfer(start, says["release"], says["scenario"], steps=n).run() for n in (STEPS, 2 * STEPS))
    same = true.outcome == finer.outcome and not says["undecided"]
    wrong = same and says["outcome"] != true.outcome
    yield Finding("outcome", says["outcome"], true.outcome, "fact" if same else "open", wrong=wrong)
    if true.outcome == finer.outcome == says["outcome"]:
        yield one_of("undecided", says["undecided"], true.undecided, finer.undecided, lambda a, b: a == b)
    if not same or wrong:
        return
    for name, room in ROOM.items():
        if says[name] is not None and np.isfinite(getattr(true, name)):
            yield one_of(name, says[name], getattr(true, name), getattr(finer, name), within(room))


ROOM = {
    "transfer_s": TIME_S, "pull_n": FORCE_N, "hand_n": FORCE_N, "grip_n": FORCE_N, "slip_m": LENGTH_M, "turn_deg": ANGLE_DEG,
    "robot_slip_m": LENGTH_M,
}  # fmt: skip
