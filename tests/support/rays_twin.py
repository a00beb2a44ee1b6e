"""Depth and labels of a cell in float64 NumPy that knows nothing of Warp: rays on triangles, sphere tracing of the rest."""

from functools import cache

import mujoco
import numpy as np
from oracle import head_of
from problems import default_evaluator

from r2h_batch import load_benchmark
from r2h_batch.observe import LABELS, load_rig, moments
from r2h_batch.scene.dynamics import Payload
from r2h_batch.scene.model import TrialScene

RIG = load_rig("cell-v1")


@cache
def cell(benchmark="r2h-v2", count=4):
    """Scene, trials and moments of a benchmark."""
    scene, trials = default_evaluator(benchmark).scene, load_benchmark(benchmark).trials(count)
    return scene, trials, moments(scene, trials)


def triangles(scene, trials, T_world_obj, i):
    """Corners (F, 3, 3) float64 in the world of all meshes of a trial, and each one's label; the robot from MuJoCo's model."""
    found, labels = [], []
    o, h = int(trials.object_index[i]), int(trials.hand_index[i])
    model, T = scene.objects[o], T_world_obj[i].double().numpy()
    found.append(model.vertices[model.faces] @ T[:3, :3].T + T[:3, 3])
    labels += [LABELS.index("object")] * len(model.faces)
    T, hands = trials.T_world_hand[i].double().numpy(), scene.hands
    faces = hands.model.faces.numpy()
    found.append(hands.vertices[h].double().numpy()[faces] @ T[:3, :3].T + T[:3, 3])
    labels += [LABELS.index("hand")] * len(faces)
    robot = robot_of_mujoco()
    found.append(robot)
    labels += [LABELS.index("robot")] * len(robot)
    return np.concatenate(found), np.array(labels)


@cache
def robot_of_mujoco():
    """Corners (F, 3, 3) of what MuJoCo shows of the robot at home with an open gripper."""
    scene = cell()[0]
    own = scene.model([0])
    model, data = own.model, mujoco.MjData(own.model)
    eye = np.eye(4)
    held = TrialScene(Payload.of(scene.objects[0], eye), 0, 0, eye, scene.robot.open_gap_m)
    data.qpos[:] = own.start(held, scene.config.workplace.home_q)
    mujoco.mj_kinematics(model, data)
    others = {model.body(name).id for name in ("hand", "object", "table")}
    corners = []
    for g in range(model.ngeom):
        if model.geom_group[g] != 2 or int(model.geom_bodyid[g]) in others:
            continue
        R, p = data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
            signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
            faces = [f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))]
            own_corners = (signs * model.geom_size[g])[np.array(faces)]
        else:
            m = model.geom_dataid[g]
            v, nv = model.mesh_vertadr[m], model.mesh_vertnum[m]
            f, nf = model.mesh_faceadr[m], model.mesh_facenum[m]
            own_corners = model.mesh_vert[v : v + nv].astype(np.float64)[model.mesh_face[f : f + nf]]
        corners.append(own_corners @ R.T + p)
    return np.concatenate(corners)


def first_hit(origin, direction, corners):
    """Moeller and Trumbore 1997: distance along the ray to the first triangle, and its row."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, e2)
    det = (e1 * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = (s * p).sum(1) / det
        q = np.cross(s, e1)
        v = q @ direction / det
        t = (e2 * q).sum(1) / det
    hit = (np.abs(det) > 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    t = np.where(hit, t, np.inf)
    return t.min(), int(t.argmin())


def march(origin, direction, distance, far=4.0):
    """Sphere tracing of a distance function."""
    t = 0.0
    for _ in range(2000):
        d = distance(origin + t * direction)
        if d < 1e-9:
            return t
        t += d
        if t > far:
            break
    return np.inf


def person_parts(receiver):
    """Label -> distance function of arm, torso and head (float64)."""
    s, e, w, m, half = receiver.astype(np.float64)

    def capsule(a, b, r):
        def distance(x):
            along = b - a
            return np.linalg.norm(x - a - np.clip((x - a) @ along / (along @ along), 0, 1) * along) - r

        return distance

    axes = np.array([[m[3], half[3], 0], [-half[3], m[3], 0], [0, 0, 1]])

    def torso(x):
        return np.linalg.norm(np.maximum(np.abs(axes @ (x - m[:3])) - half[:3], 0))

    arm = {"forearm": capsule(e[:3], w[:3], e[3]), "upper_arm": capsule(s[:3], e[:3], s[3])}
    return {**arm, "torso": torso, "head": capsule(*head_of(receiver.astype(np.float64)))}


def expected(scene, trials, T_world_obj, i, K, T_world_camera, column, row):
    """Depth and label of a pixel, in float64."""
    ray = np.array([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], 1.0])
    length = np.linalg.norm(ray)
    R, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
    direction = R @ (ray / length)
    corners, labels = triangles(scene, trials, T_world_obj, i)
    t, at = first_hit(origin, direction, corners)
    best = [(t, int(labels[at]))]
    center, half = (np.array(x) for x in (scene.config.workplace.table_center, scene.config.workplace.table_half))
    best.append((march(origin, direction, lambda x: np.linalg.norm(np.maximum(np.abs(x - center) - half, 0))), 1))
    for name, distance in person_parts(trials.receiver[i].numpy()).items():
        best.append((march(origin, direction, distance), LABELS.index(name)))
    t, label = min(best)
    return (t / length, label) if np.isfinite(t) and t < 4.0 else (0.0, 0)


def depth_of_bodies(receiver, table, eye, rays):
    """Depths by label of table, arm, torso and head in closed form, float64; inf: nothing.

    Args:
        receiver: (5, 4) a row of `Trials.receiver`.
        table: its centre and half sizes, m.
        eye: (3,) the camera's centre, m.
        rays: (..., 3) directions in the world of one metre of depth.
    """
    s, e, w, m, half = receiver.astype(np.float64)
    turn = np.array([[m[3], half[3], 0], [-half[3], m[3], 0], [0, 0, 1]])
    center, size = (np.array(x) for x in table)
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            "table": _box(eye - center, rays, size),
            "forearm": _capsule(eye, rays, e[:3], w[:3], e[3]),
            "upper_arm": _capsule(eye, rays, s[:3], e[:3], s[3]),
            "torso": _box(turn @ (eye - m[:3]), rays @ turn.T, half[:3]),
            "head": _capsule(eye, rays, *head_of(receiver.astype(np.float64))),
        }


def _box(eye, rays, half):
    """Depths of a box about the origin: the last of the planes that face the eye."""
    a, b = (-half - eye) / rays, (half - eye) / rays
    begin, end = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((begin <= end) & (begin > 0), begin, np.inf)


def _root(a, b, c):
    """The smaller root of a t^2 + 2 b t + c; inf: none, or behind the eye."""
    t = (-b - np.sqrt(b * b - a * c)) / a
    return np.where(t > 0, t, np.inf)


def _capsule(eye, rays, a, b, radius):
    """Depths of the balls about both ends, and of the cylinder between them."""
    rr = (rays * rays).sum(-1)
    t = np.minimum(*(_root(rr, rays @ (eye - c), (eye - c) @ (eye - c) - radius**2) for c in (a, b)))
    along = b - a
    if not along.any():
        return t
    axis = along / np.linalg.norm(along)
    d, o = (x - np.multiply.outer(x @ axis, axis) for x in (rays, eye - a))
    side = _root((d * d).sum(-1), d @ o, o @ o - radius**2)
    place = (eye - a) @ axis + np.where(np.isfinite(side), side, 0) * (rays @ axis)
    return np.minimum(t, np.where((place > 0) & (place < np.linalg.norm(along)), side, np.inf))
