"""Many payloads at once: what MuJoCo's mj_setConst would write for each of them alone."""

import copy

import mujoco
import numpy as np
import pytest
from dynamics_twin import some_payload
from problems import default_evaluator
from rounds import each

from r2h_batch.scene.dynamics import MassProperties, Payload, PayloadTables, load, principal, quat_wxyz
from r2h_batch.scene.model import SceneModel, TrialScenes, build_scene_model
from r2h_batch.scene.robot_file import load_robot

N = 24


def model_of(kind: str) -> SceneModel:
    scene = default_evaluator().scene
    if kind == "arm":
        return SceneModel.arm_only(load_robot(), step_s=0.002)
    return build_scene_model(scene.robot, scene.objects, scene.hands, [0, 3], step_s=0.002)


def rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    Q = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return Q * np.linalg.det(Q)[:, None, None]


@pytest.mark.check
@pytest.mark.parametrize("kind", ["arm", pytest.param("scene", marks=pytest.mark.slow)])
def test_rows_of_many_payloads_are_what_each_alone_makes_of_the_model(kind):
    rng, base = np.random.default_rng(0), model_of(kind).model
    payloads = [some_payload(rng, float(rng.uniform(0.001, 3.0))) for _ in range(N)]
    moments, axes = principal(np.stack([p.inertia for p in payloads]))
    held = MassProperties(np.array([p.mass for p in payloads]), np.stack([p.com for p in payloads]), axes, moments)
    rows = PayloadTables(base).rows(np.stack([p.T_gripper_obj for p in payloads]), held)
    model = copy.copy(base)
    data = mujoco.MjData(model)
    seen = set()
    for i, payload in enumerate(payloads):
        before = {name: getattr(model, name).copy() for name in rows}
        load(model, payload, data)
        for name, values in rows.items():
            field = getattr(model, name)
            alone = field[-1] if values[i].shape != field.shape else field
            np.testing.assert_allclose(values[i], alone, rtol=1e-11, atol=1e-15, err_msg=name)
            if not np.array_equal(before[name], field):
                seen.add(name)
    assert seen == set(rows)  # each of them depends on the payload


def test_the_object_of_each_trial_is_the_one_it_holds():
    model, scene = model_of("arm"), default_evaluator().scene
    rng = np.random.default_rng(1)
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotations(rng, N), rng.normal(size=(N, 3)) * 0.1
    objects = rng.integers(0, len(scene.objects), N)
    trials = TrialScenes(scene.objects, T, objects, np.zeros(N, np.int64), T, np.full(N, 0.03))
    rows = model.loaded(trials)
    for i in each(range(N)):
        o = Payload.of(scene.objects[objects[i]], T[i])
        assert rows["body_mass"][i] == o.mass and np.array_equal(rows["body_ipos"][i], o.com)
        np.testing.assert_allclose(rows["body_quat"][i], quat_wxyz(T[i, :3, :3]), atol=1e-15)
        np.testing.assert_allclose(rows["body_inertia"][i].sum(), np.trace(o.inertia), rtol=1e-12)
        one = trials[i]
        np.testing.assert_array_equal(model.start(trials, T[:, 0, :1].repeat(6, 1))[i], model.start(one, T[i, 0, 0]))
        np.testing.assert_array_equal(model.hold(trials)[i], model.hold(one))
