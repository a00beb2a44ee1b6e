"""A second judge of what people do: can the receiver take the object, and how did an episode in closed loop end.

As in `judge_twin`: float64, MuJoCo C, Qhull and NumPy. Shared are the held-out grasps (places and skins of hands, newtons) and,
of an episode, where robot and hand were after each step. That nothing can be taken is not proven here: an episode's or a
trial's failure is looked at only where it names what was met.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from convex_twin import bodies, convex_distance
from judge_twin import TOLERANCE_M, Again, Finding, rigid
from numpy.typing import ArrayLike, NDArray
from oracle import CLASSES, head_of
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from r2h_batch.closed_loop.env import End
from r2h_batch.scene.robot import ShapeKind
from r2h_batch.trials.holding.held_out import load_held_out

Array = NDArray[np.float64]
ROOM_M, GRIP_N, ROUNDED_M = 0.0005, 40.0, 2e-5
REST_M_S, HELD_OUT_S, NEAR_M = 0.03, 0.1, 0.25
UP = np.array([0.0, 0.0, 1.0])
SCALES = ((180, 60), (180, 75), (75, 75), (80, 80), (80, 70), (30, 20), (60, 60))
"""Ranges (degrees) of the arm's angles on their two sides, the elbow's about 80, and of the lean."""


def apart(kinds: ArrayLike, sizes: ArrayLike, places: Array, hulls: Sequence[Array]) -> float:
    """Least distance (m) of primitives and hulls in one frame; 0 or less where two of them meet."""
    kinds, sizes = np.asarray(kinds), np.asarray(sizes)
    kept = [h[ConvexHull(h).vertices] for h in hulls]
    n, m = len(kinds), len(kept)
    a = bodies(np.repeat(kinds, m), np.repeat(sizes, m, 0), np.repeat(places, m, 0))
    b = bodies([ShapeKind.HULL] * (n * m), None, np.tile(np.eye(4), (n * m, 1, 1)), kept * n)
    return float(convex_distance(a, b)[1].min())


def leaned(receiver: Array, lean_deg: float, elbow: Array, wrist: Array) -> tuple[Array, Array, Array]:
    """The receiver (5, 4) who leans with the arm there, T_world of the torso's box, and the ends (2, 3) of the head."""
    ahead = np.array([receiver[3, 3], receiver[4, 3], 0.0])
    lean = Rotation.from_rotvec(np.radians(lean_deg) * np.cross(UP, ahead))
    hip = receiver[3, :3] - receiver[4, 2] * UP
    body = receiver.copy()
    body[0, :3], body[1, :3], body[2, :3] = hip + lean.apply(receiver[0, :3] - hip), elbow, wrist
    T = np.eye(4)
    T[:3, :3] = lean.as_matrix() @ np.stack([ahead, np.cross(UP, ahead), UP], 1)
    T[:3, 3] = hip + lean.apply(receiver[4, 2] * UP)
    return body, T, hip + lean.apply(np.stack(head_of(receiver)[:2]) - hip)


def capsule(a: Array, b: Array) -> Array:
    """(4, 4): z from a to b, in the middle."""
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors([b - a], [UP])[0].as_matrix()
    T[:3, 3] = (a + b) / 2
    return T


def reception_of(again: Again, found: Any, index: int) -> Iterator[Finding]:
    """Statements of row `index` of `reception`'s answer about a trial, beside what is so of the grasp that it chose."""
    held = bool(again.stability() >= 0)
    evaluated, count = bool(found.evaluated[index]), found.count[index].tolist()
    yield Finding("reception of a dropped object", evaluated, held, "fact", wrong=evaluated and not held)
    fall = sorted(count, reverse=True) == count and count[0] <= int(found.known[index])
    yield Finding("counts fall", count, "", "fact", wrong=not fall)
    if not bool(found.received[index]):
        return
    scene, robot, receiver = again.scene, again.robot, again.receiver
    assert receiver is not None
    here = again.true.staged.object_index
    held_out = load_held_out(scene.objects, scene.hands.model, [here])
    grasp = int(held_out.first[here]) + int(found.grasp[index])
    own = held_out.grasps[torch.tensor([grasp])]
    thing = int(own.object_index[0])
    yield Finding("object of the grasp", thing, here, "fact", wrong=thing != here)

    # the object is held where the row's closing, which the second judge has found again (`Again.findings`), takes it
    closed, stored = rigid(found.T_obj_ee[index]), again.T_obj_ee.copy()
    stored[:3, 3] += again.row["grasp_shift_m"] * stored[:3, 1]
    com = np.append(np.asarray(scene.objects[here].com, np.float64), 1.0)
    beside = float(np.linalg.norm((np.linalg.inv(closed) - np.linalg.inv(stored))[:3] @ com))
    yield Finding("held beside where it closes, m", 0.0, beside, "fact", wrong=beside > 1e-5)

    # in the object's frame the hand is the grasp's, or turned about the axis of an object of revolution
    T_world_obj = again.T_world_ee @ np.linalg.inv(closed)
    T_hand, T_obj_hand = rigid(found.T_world_hand[index]), rigid(own.T_obj_hand[0])
    turned = np.linalg.inv(T_world_obj) @ T_hand @ np.linalg.inv(T_obj_hand)
    axis, point = (x[thing].double().numpy() for x in (held_out.axis, held_out.axis_point))
    off = np.abs(turned - np.eye(4)).max()
    if axis.any():
        off = max(np.abs(turned[:3, :3] @ axis - axis).max(), np.abs(turned[:3] @ np.append(point, 1.0) - point).max())
    yield Finding("hand beside its grasp", 0.0, float(off), "fact", wrong=off > 1e-4)
    gravity = np.concatenate([np.eye(3), -np.eye(3)])
    newton = float(held_out.grip_n[grasp, int((gravity @ ((T_world_obj @ turned)[:3, :3].T @ -UP)).argmax())])
    yield Finding("grip, N", GRIP_N, newton, "fact", wrong=newton > GRIP_N * (1 + 1e-6))

    T = T_world_obj @ turned
    skin, joints = (x[0].double().numpy() @ T[:3, :3].T + T[:3, 3] for x in (own.vertices, own.joints))
    opening = max(again.closed.opening - again.config.thresholds.pad_squeeze_m, 0.0)
    fingers = again.T_world_ee @ again.fingers.places(opening)
    pieces = [skin[ids.numpy()] for ids in scene.hands.model.pieces]
    gap = apart(robot.gripper.kind, robot.gripper.size, fingers, pieces)
    yield Finding("hand to gripper, m", ROOM_M, gap, "fact", wrong=gap < ROOM_M - ROUNDED_M)

    angles, elbow = found.angles_deg[index].double().numpy(), found.elbow[index].double().numpy()
    body, T_torso, head = leaned(receiver, float(angles[-1]), elbow, joints[0])
    for name, a, b in (("upper arm, m", 0, 1), ("forearm, m", 1, 2)):
        was, now = (float(np.linalg.norm(x[a, :3] - x[b, :3])) for x in (receiver, body))
        yield Finding(name, was, now, "fact", wrong=abs(was - now) > TOLERANCE_M)
    about = angles - np.array([0, 0, 80, 0, 0, 0, 0])
    shares = (about / np.where(about >= 0, *np.array(SCALES).T)) ** 2
    effort, said = float(shares[:6].mean() + shares[6]), float(found.effort[index])
    yield Finding("effort", said, effort, "fact", wrong=abs(said - effort) > 1e-4)
    way = float(np.linalg.norm(joints[0] - receiver[2, :3]))
    yield Finding("travel, m", float(found.travel_m[index]), way, "fact", wrong=abs(way - found.travel_m[index]) > 1e-4)
    turn = float(np.degrees(Rotation.from_matrix(again.T_hand[:3, :3].T @ T_hand[:3, :3]).magnitude()))
    yield Finding(
        "turn, degrees", float(found.turn_deg[index]), turn, "fact", wrong=abs(turn - found.turn_deg[index]) > 0.05
    )

    links = [name for link in robot.links for name in again.true.groups[link]]
    again.true.ee(np.array(again.row["q_goal"], np.float64))
    kinds, sizes, places, hulls = again.true.primitives(links)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T * body[4, :3]
    arm = [(ShapeKind.CAPSULE, [r, np.linalg.norm(b - a) / 2, 0.0], capsule(a, b)) for a, b, r in (
        (body[0, :3], elbow, body[0, 3]), (elbow, joints[0], body[1, 3]), (*head, head_of(receiver)[2]))]  # fmt: skip
    torso = corners @ T_torso[:3, :3].T + T_torso[:3, 3]
    gaps = [apart(kinds, sizes, places, [torso])] if len(kinds) else []
    for kind, size, T_arm in arm:
        for i in range(len(kinds)):
            pair = [
                bodies([k], [s], np.asarray(p)[None])
                for k, s, p in ((kind, size, T_arm), (kinds[i], sizes[i], places[i]))
            ]
            gaps.append(float(convex_distance(*pair)[1][0]))
        gaps += [apart([kind], [size], T_arm[None], [h]) for h in hulls]
    points = np.asarray(scene.objects[here].vertices, np.float64) @ T_world_obj[:3, :3].T + T_world_obj[:3, 3]
    kind, size, T_head = arm[-1]
    gaps.append(apart([kind], [size], T_head[None], [points]))
    # where cores without a radius meet, their distance is 0 up to rounding
    yield Finding("body to robot, and head to object, m", 0.0, min(gaps), "fact", wrong=min(gaps) < 1e-9)


def episode_of(again: Again, env: Any, index: int) -> Iterator[Finding]:
    """Statements of `env.episodes()` about episode `index`, beside what its postures and poses show.

    Only the object's, the table's and the robot's own collisions, the hand's distance, reach and rest are judged.
    """
    said, step_s = env.episodes(), 1.0 / env.config.rate_hz
    end, last = End(int(said.end[index])), round(float(said.time_s[index]) / step_s)
    if end == End.DROP:
        yield Finding("dropped", end.name, "", "fact", wrong=again.stability() >= 0)
        return
    q, T = (x[index].double().numpy()[: last + 1] for x in env.trace())
    own = again.hand @ again.T_hand[:3, :3] - again.T_hand[:3, 3] @ again.T_hand[:3, :3]
    gaps = [again.true.safe_at(own @ R[:3, :3].T + R[:3, 3], at, cap=NEAR_M) for at, R in zip(q, T, strict=True)]
    least = float(said.least_m[index])
    yield Finding("least_m", max(least, 0.0), min(gaps), "fact", wrong=abs(max(least, 0.0) - min(gaps)) > TOLERANCE_M)
    touched = min(gaps[: last or 1]) <= 0  # before the last step; in it contact may lie between two samples
    yield Finding("contact", end.name, min(gaps), "fact", wrong=touched and end != End.CONTACT)

    fastest = again.robot.max_velocity
    law = again.config.execute
    speeds = np.abs(np.diff(q, axis=0)) / step_s * (fastest.min() / fastest)
    beyond = float(speeds.max(initial=0.0) - law.scale * law.max_velocity_rad_s * (1 + 2e-3))
    yield Finding("joint speed beyond its limit, rad/s", 0.0, max(beyond, 0.0), "fact", wrong=beyond > 1e-4)
    off = float(np.abs(q[0] - np.array(again.config.workplace.home_q)).max())
    yield Finding("start beside home, rad", 0.0, off, "fact", wrong=off > 1e-5)
    path = float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum())
    mine = float(said.hand_path_m[index])
    yield Finding("hand_path_m", mine, path, "fact", wrong=abs(mine - path) > 1e-4)
    idle = float((np.diff(q, axis=0) == 0).all(1).mean()) if last else 1.0
    mine = float(said.robot_idle[index])
    yield Finding("robot_idle", mine, idle, "fact", wrong=last > 0 and abs(mine - idle) > 1e-3)

    if end not in (End.CONTACT, End.RUNNING):
        kinds = [k for k in CLASSES if k not in ("hand", "object_hand")]
        found = [min(again.true.clearances(at).distance[k] for k in kinds) for at in q]
        met = min(found) < -TOLERANCE_M
        yield Finding("collision", end.name, min(found), "fact", wrong=met and end != End.COLLISION)
    if end == End.SUCCESS:
        held = round(HELD_OUT_S / step_s)
        tcp = np.array([again.true.ee(at)[:3, 3] for at in q[-held - 1 :]])
        for name, moved in (("TCP", np.diff(tcp, axis=0)), ("wrist", np.diff(T[-held - 1 :, :3, 3], axis=0))):
            speed = float(np.linalg.norm(moved, axis=1).max()) / step_s
            yield Finding(f"{name} at rest, m/s", REST_M_S, speed, "fact", wrong=speed > REST_M_S * (1 + 1e-3) + 1e-5)
        margin = again.reach_at(again.true.ee(q[-1]), T[-1])
        yield Finding("within reach, m", 0.0, margin, "fact", wrong=margin < -TOLERANCE_M)
