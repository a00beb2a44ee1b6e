"""The whole scene as one model: where everything is, which pairs push, and that no trial leaves anything of itself behind."""

import copy
from functools import cache
from unittest import mock

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from dynamics_twin import mass_matrix, some_payload
from problems import default_evaluator
from rounds import each
from scipy.spatial import cKDTree

from r2h_batch.base.launch import init_warp
from r2h_batch.config import HOME_Q, ExecConfig
from r2h_batch.judge.motion.sim_mjwarp import StandingWorlds
from r2h_batch.judge.motion.simulation import Job
from r2h_batch.judge.motion.time_law import servo_law
from r2h_batch.scene.dynamics import Payload
from r2h_batch.scene.model import SceneModel, TrialScene, TrialScenes, build_scene_model
from r2h_batch.scene.robot import ee_pose, forward_kinematics, gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.scene.scene import Scene

HANDS = (3, 250, 17)
STEP_S = 0.002


def scene() -> Scene:
    return default_evaluator().scene


@cache
def built(collision: str = "hull") -> SceneModel:
    s = scene()
    return build_scene_model(s.robot, s.objects, s.hands, HANDS, step_s=STEP_S, object_collision=collision)


def some_trial(rng: np.random.Generator, object_index: int, hand: int = 3) -> TrialScene:
    """A random grasp, hand pose and opening."""
    T = [np.eye(4), np.eye(4)]
    for X in T:
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        X[:3, :3], X[:3, 3] = Q * np.linalg.det(Q), rng.normal(size=3) * 0.2
    payload = Payload.of(scene().objects[object_index], T[0])
    return TrialScene(payload, object_index, hand, T[1], float(rng.uniform(0.003, 0.085)))


def at(
    model: SceneModel, trial: TrialScene, q, before: tuple[TrialScene, ...] = ()
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The trial in a copy of the model, after others; positions computed at arm posture q."""
    m = copy.copy(model.model)
    data = mujoco.MjData(m)
    for t in (*before, trial):
        model.load(m, t, data)
    mujoco.mj_resetData(m, data)
    data.qpos[:] = model.start(trial, q)
    mujoco.mj_fwdPosition(m, data)
    return m, data


def mesh_points(m: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Vertices of a mesh geom in the world."""
    mesh = m.geom_dataid[geom]
    first, count = m.mesh_vertadr[mesh], m.mesh_vertnum[mesh]
    return m.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def same_points(a: np.ndarray, b: np.ndarray, tol: float = 2e-6) -> bool:
    """Equal as sets (a mesh may repeat a vertex)."""
    return all(cKDTree(y).query(x[:400])[0].max() < tol for x, y in ((a, b), (b, a)))


def test_every_object_and_hand_stands_where_its_trial_says_whatever_stood_there_before():
    rng, s = np.random.default_rng(0), scene()
    for o in each(range(len(s.objects))):
        before, trial = some_trial(rng, (o + 5) % len(s.objects), 17), some_trial(rng, o, HANDS[o % 3])
        q = rng.uniform(-2, 2, 6)
        m, data = at(built(), trial, q, (before,))
        T = forward_kinematics(s.robot, q)[7] @ trial.payload.T_gripper_obj
        for name, points in (("mesh_visual", s.objects[o].vertices), ("hull_0", s.objects[o].hull_vertices)):
            geom = m.geom(f"object/{name}").id
            assert same_points(mesh_points(m, data, geom), points @ T[:3, :3].T + T[:3, 3]), (o, name)
        for k, name in each(enumerate(s.hands.model.piece_names)):
            points = s.hands.piece_points(trial.hand_index, k).astype(np.float64)
            points = points @ trial.T_world_hand[:3, :3].T + trial.T_world_hand[:3, 3]
            assert same_points(mesh_points(m, data, m.geom(f"hand/{name}").id), points), (o, name)
        for geom in built().varied:  # what broadphases trust
            mesh = m.geom_dataid[geom]
            own = m.mesh_vert[m.mesh_vertadr[mesh] : m.mesh_vertadr[mesh] + m.mesh_vertnum[mesh]]
            center, half = m.geom_aabb[geom][:3], m.geom_aabb[geom][3:]
            np.testing.assert_allclose(own.max(0), center + half, atol=1e-6)
            np.testing.assert_allclose(own.min(0), center - half, atol=1e-6)
            assert np.linalg.norm(own, axis=1).max() <= m.geom_rbound[geom] + 1e-9


@pytest.mark.parametrize("gap", [0.085, 0.04, 0.005])
def test_robot_and_fingers_are_the_planners_and_the_loops_are_closed(gap):
    s, q = scene(), np.array(HOME_Q) + np.random.default_rng(1).uniform(-0.3, 0.3, 6)
    trial = TrialScene(Payload.of(s.objects[0], np.eye(4) + np.eye(4, k=3) * 3), 0, 3, np.eye(4), gap)
    m, data = at(built(), trial, q)
    T = forward_kinematics(s.robot, q)
    wanted = [
        ("robot", s.robot.arm.names[i], T[s.robot.arm.link[i]] @ s.robot.arm.T_link_prim[i])
        for i in range(len(s.robot.arm.names))
    ]
    poses = ee_pose(s.robot, q) @ gripper_primitives_at(s.robot, gap)
    wanted += [("gripper", name, poses[i]) for i, name in enumerate(s.robot.gripper.names)]
    for kind, name, X in wanted:
        geom = data.geom(f"{kind}/{name}")
        np.testing.assert_allclose(geom.xpos, X[:3, 3], atol=1e-9, err_msg=name)
        np.testing.assert_allclose(geom.xmat.reshape(3, 3), X[:3, :3], atol=1e-9, err_msg=name)
    mujoco.mj_forward(m, data)
    assert data.nefc == 7 and np.abs(data.efc_pos).max() < 1e-9  # two connects, one pair of joints
    for side in ("left", "right"):  # the pad that is seen is the pad that is planned with
        seen, planned = (data.geom(f"gripper/{side}_pad{x}").xpos for x in ("_visual", ""))
        np.testing.assert_allclose(seen, planned, atol=2e-6)


def test_masses_are_those_of_the_arm_with_a_rigid_gripper():
    rng = np.random.default_rng(2)
    payload, q = some_payload(rng), rng.uniform(-2, 2, 6)
    m, data = at(built(), TrialScene(payload, 0, 3, np.eye(4), 0.05), q)
    mujoco.mj_forward(m, data)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, M)
    mass = load_robot().dynamics.mass.sum() + load_robot().linkage.mass_kg + payload.mass
    assert m.body_subtreemass[m.body("shoulder").id] == pytest.approx(mass)
    np.testing.assert_allclose(M[:6, :6], mass_matrix(q, payload), atol=0.012)  # the fingers' 0.14 kg are elsewhere
    np.testing.assert_allclose(data.qfrc_gravcomp, data.qfrc_bias, atol=1e-9)  # all weight is carried, the fingers' too
    assert np.linalg.eigvalsh(M).min() > 0


def test_exactly_the_pairs_that_planning_checks_may_push_less_the_hand():
    s, m = scene(), built().model
    names = [*s.robot.links, "object", "table"]
    body = {"left": "gripper", "right": "gripper"}
    found = set()
    for a in range(m.ngeom):
        for b in range(a):
            if (m.geom_contype[a] & m.geom_conaffinity[b]) | (m.geom_contype[b] & m.geom_conaffinity[a]):
                pair = [m.body(m.geom_bodyid[g]).name for g in (a, b)]
                found.add(frozenset(body.get(x.split("_")[0], x) for x in pair))
    wanted = {frozenset(s.robot.links[k] for k in pair) for pair in s.robot.self_pairs}
    wanted |= {frozenset(("object", s.robot.links[k])) for k in s.robot.object_pairs}
    wanted |= {frozenset(("table", link)) for link in s.robot.links[s.robot.table_from :]}
    assert found == wanted and set(names) >= {x for pair in found for x in pair}


@pytest.mark.parametrize("collision", ["hull", "pieces"])
def test_contacts_of_any_object_are_those_of_a_model_compiled_for_it_alone(collision):
    """Objects swung into the forearm: stale boxes, frames or hulls of another object would lose or move contacts."""
    rng, s, met = np.random.default_rng(3), scene(), 0
    q = np.array(HOME_Q)
    for o in range(0, len(s.objects), 5 if collision == "hull" else 8):
        trial = TrialScene(into_the_forearm(rng, o, q), 0, 3, np.eye(4), 0.05)
        alone = build_scene_model(s.robot, [s.objects[o]], s.hands, [3], step_s=STEP_S, object_collision=collision)
        many = TrialScene(trial.payload, o, 3, np.eye(4), 0.05)
        a, b = at(alone, trial, q)[1], at(built(collision), many, q, (some_trial(rng, (o + 3) % 16, 17),))[1]
        if collision == "hull":
            np.testing.assert_allclose(contacts(a), contacts(b), atol=1e-7)
        else:  # pieces that an object lacks repeat its last one
            assert {tuple(c) for c in contacts(a)} == {tuple(c) for c in contacts(b)}
        met += a.ncon > 0
    assert met >= 2


def into_the_forearm(rng: np.random.Generator, object_index: int, q: np.ndarray) -> Payload:
    """An object whose frame's origin is inside the forearm, turned at random."""
    T_world_gripper, forearm = (forward_kinematics(scene().robot, q)[k] for k in (7, 3))
    T = some_trial(rng, object_index).payload.T_gripper_obj.copy()
    T[:3, 3] = (np.linalg.inv(T_world_gripper) @ forearm @ [-0.2, 0.0, 0.06, 1])[:3]
    return Payload.of(scene().objects[object_index], T)


def test_worlds_of_mujoco_warp_each_have_the_body_of_their_own_trial():
    """Sixteen objects in sixteen worlds, put in by the kernel that refills them: deepest contact and pose as in MuJoCo C."""
    init_warp()
    rng, q, model = np.random.default_rng(6), np.array(HOME_Q), built()
    hands = np.stack([some_trial(rng, 0).T_world_hand for _ in range(16)])
    grasps = np.stack([into_the_forearm(rng, o, q).T_gripper_obj for o in range(16)])
    which = np.arange(16)
    trials = TrialScenes(scene().objects, grasps, which, np.array(HANDS)[which % 3], hands, 0.02 + 0.004 * which)
    order = rng.permutation(16)  # which world runs which trial
    path = [wp.zeros(shape, dtype=kind) for shape, kind in (((16, 2, 6), float), ((16, 2), float), (16, int))]
    law = servo_law(ExecConfig(), np.ones(6), lead_s=0.0, step_s=STEP_S)
    start, radii = np.tile(q, (16, 1)), scene().motion_radii.numpy()
    job = Job(model, law, tuple(path), which, trials, start, np.full(16, 2), 1, "cpu", radii)
    # no public way to one world of an engine: simulate() steps its own until they are empty
    stand = StandingWorlds(model, law, 1, radii, "cpu", 16, 512, 2048)
    m, d = stand.model, stand.data
    with mock.patch.object(wp, "capture_launch", lambda graph: stand.worlds.left.zero_()):
        stand.run(job, order)
    worlds = stand.worlds
    mjw.kinematics(m, d)
    mjw.collision(m, d)
    n = int(d.nacon.numpy()[0])
    assert 16 < n <= d.naconmax and not d.overflow.numpy().any()
    world, depth = d.contact.worldid.numpy()[:n], d.contact.dist.numpy()[:n]
    slot = worlds.slot.numpy()
    hand, geoms = model.hand_body, model.varied
    for w in range(16):
        _, data = at(model, trials[int(order[slot[w]])], q)
        np.testing.assert_allclose(d.geom_xpos.numpy()[w][geoms], data.geom_xpos[geoms], atol=2e-6)
        np.testing.assert_allclose(d.geom_xmat.numpy()[w][geoms].reshape(-1, 9), data.geom_xmat[geoms], atol=2e-6)
        np.testing.assert_allclose(d.xpos.numpy()[w, hand], data.xpos[hand], atol=1e-6)
        mine = depth[world == w]
        assert (data.ncon > 0) == (len(mine) > 0)
        if data.ncon:
            assert float(mine.min()) == pytest.approx(min(c.dist for c in data.contact), abs=1e-3)


def contacts(data: mujoco.MjData) -> list[list[float]]:
    """Depths and places, sorted."""
    return sorted([round(c.dist, 9), *np.round(c.pos, 7)] for c in data.contact)


def test_nothing_touches_the_hand_and_the_object_touches_neither_table_nor_gripper():
    s, rng = scene(), np.random.default_rng(4)
    q = np.array(HOME_Q)
    inside = np.eye(4)
    inside[:3, 3] = forward_kinematics(s.robot, q)[2, :3, 3] + [0, 0, 0.15]
    T_gripper_obj = np.eye(4)
    for z in (0.12, 0.59):  # in the gripper; in the table
        T_gripper_obj[2, 3] = z
        trial = TrialScene(Payload.of(s.objects[6], T_gripper_obj), 6, 3, inside, 0.05)
        _, data = at(built(), trial, q)
        assert data.ncon == 0
    deep = q + [0, 0.8, 0.8, -1.0, 0, 0]
    _, data = at(built(), some_trial(rng, 2), deep)
    assert data.ncon > 0  # the gripper in the table is felt


def test_the_sway_bounds_how_far_the_fingers_are_off():
    rng, s, model = np.random.default_rng(5), scene(), built()
    trial = TrialScene(some_payload(rng), 0, 3, np.eye(4), 0.03)
    m, data = at(model, trial, HOME_Q)
    names = [n for n, side in zip(s.robot.gripper.names, s.robot.gripper_side, strict=True) if side]
    half = {n: s.robot.gripper.size[s.robot.gripper.names.index(n)] for n in names}
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)

    def points() -> np.ndarray:
        geoms = [(n, data.geom(f"gripper/{n}")) for n in names]
        return np.concatenate([corners * half[n] @ g.xmat.reshape(3, 3).T + g.xpos for n, g in geoms])

    rest, ratio = points(), []
    for _ in range(20):
        qpos = model.start(trial, HOME_Q)
        qpos[6:] += rng.normal(size=6) * 1e-3 * (rng.random(6) < 0.5)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(m, data)
        off, bound = np.linalg.norm(points() - rest, axis=1).max(), model.sway(trial, qpos[None])
        assert off <= bound + 1e-12
        ratio.append(off / bound if bound else 1.0)
    assert np.mean(ratio) > 0.5
    assert model.sway(trial, model.start(trial, HOME_Q)[None]) == pytest.approx(0, abs=1e-12)
