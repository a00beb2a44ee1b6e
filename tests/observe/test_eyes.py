"""The receiver's view on the region (r2h_batch.observe.eyes) against MuJoCo's rays, float64 triangles and the built-in people."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from problems import default_evaluator
from rays_twin import first_hit, march, person_parts
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.judge.grasp import attach
from r2h_batch.methods import random as random_method
from r2h_batch.observe import LABELS
from r2h_batch.observe.eyes import POINTS, eyes_of, hidden_points, region_points, view
from r2h_batch.scene.arrays import asset, read_arrays
from r2h_batch.scene.dynamics import Payload
from r2h_batch.scene.model import TrialScene


@cache
def handed():
    """Scene, trials, T_world_obj, q and opening of held S1 objects at the handover."""
    scene, trials = default_evaluator("r2h-v2").scene, load_benchmark("r2h-v2").trials(30)
    asked = random_method.predict(trials, scene)
    scores = default_evaluator("r2h-v2").score(asked.T_obj_ee, asked.T_world_ee, trials, stages="pose")
    fits = scores.passed[:, 0] & scores.q_goal.isfinite().all(1) & scores.presented_angle_deg.isfinite()
    rows = fits.nonzero()[:, 0]
    T_obj_ee = attach(asked.T_obj_ee[rows], scores.grasp_shift_m[rows])
    T = se3.matmul(asked.T_world_ee[rows], se3.inverse(T_obj_ee))
    return scene, trials[rows], T, scores.q_goal[rows], scores.opening_m[rows], T_obj_ee


def in_mujoco(i):
    """MuJoCo's own model of a handover: its robot and the held object, as they are drawn."""
    scene, trials, _, q, opening, T_obj_ee = handed()
    own = scene.model(trials.hand_index[:10].tolist())
    T_ee_gripper = np.linalg.inv(scene.robot.T_flange_ee) @ scene.robot.T_flange_gripper
    T_gripper_obj = np.linalg.inv(T_obj_ee[i].double().numpy() @ T_ee_gripper)
    o, h = int(trials.object_index[i]), int(trials.hand_index[i])
    held = Payload.of(scene.objects[o], T_gripper_obj)
    trial = TrialScene(held, o, h, trials.T_world_hand[i].double().numpy(), float(opening[i]))
    data = mujoco.MjData(own.model)
    own.load(own.model, trial, data)
    data.qpos[:] = own.start(trial, q[i].double().numpy())
    mujoco.mj_kinematics(own.model, data)
    return own.model, data


@pytest.mark.check
def test_points_are_hidden_by_what_mujocos_rays_and_float64_triangles_meet_first():
    scene, trials, T, q, opening, _ = handed()
    found = hidden_points(scene, trials, T, q, opening).numpy()
    eyes, drawn = eyes_of(trials.receiver).numpy(), np.random.default_rng(0)
    center, half = (np.array(x) for x in (scene.config.workplace.table_center, scene.config.workplace.table_half))
    wrong, asked, labels = 0, 0, set()
    for i in each(range(10)):
        model, data = in_mujoco(i)
        o, h = int(trials.object_index[i]), int(trials.hand_index[i])
        at = T[i].double().numpy()
        points, normals = (x @ at[:3, :3].T for x in region_points(scene.objects[o]))
        skin = scene.hands.vertices[h].double().numpy()[scene.hands.model.faces.numpy()]
        R = trials.T_world_hand[i].double().numpy()
        skin = skin @ R[:3, :3].T + R[:3, 3]
        parts = person_parts(trials.receiver[i].numpy())
        bodies = {name: (model.body(name).id,) for name in ("object", "hand", "table")}
        for j in drawn.integers(POINTS, size=20):
            p = points[j] + at[:3, 3]
            hides = []
            for eye in eyes[i]:
                d = p - eye
                far = np.linalg.norm(d)
                d, what = d / far, set()
                if normals[j] @ d >= 0:
                    what.add("object")
                origin, geom = eye, np.zeros(1, np.int32)
                start = 0.0
                while True:  # all that MuJoCo meets on the way, one after the other
                    t = mujoco.mj_ray(
                        model, data, origin + start * d, d, np.array([0, 0, 1, 0, 0, 0], np.uint8), 1, -1, geom
                    )
                    if t < 0 or start + t > far - 1e-4:
                        break
                    body = int(model.geom_bodyid[geom[0]])
                    name = next((k for k, own in bodies.items() if body in own), "robot")
                    what |= {name} - {"hand", "table"}  # its pieces are hulls
                    start += t + 1e-6
                if first_hit(eye, d, skin)[0] < far - 1e-4:
                    what.add("hand")
                for name, distance in parts.items():
                    if name != "torso" and march(eye, d, distance) < far - 1e-4:
                        what.add(name)
                if march(eye, d, lambda x: np.linalg.norm(np.maximum(np.abs(x - center) - half, 0))) < far - 1e-4:
                    what.add("table")
                hides.append(what)
            asked += 1
            own = LABELS[found[i, j]]
            labels.add(own)
            if own == "nothing":
                wrong += not any(not what for what in hides)
            elif own == "object":
                wrong += not all("object" in what for what in hides)
            else:
                wrong += not (all(hides) and any(own in what and "object" not in what for what in hides))
    assert asked == 200 and wrong <= 0.005 * asked
    assert {"nothing", "object", "robot"} <= labels


def test_shares_are_those_of_the_points_and_objects_without_a_region_have_none():
    scene, trials, T, q, opening, _ = handed()
    found = view(scene, trials, T, q, opening)
    label = hidden_points(scene, trials, T, q, opening)
    for k, name in enumerate(LABELS):
        share = found.seen if name == "nothing" else found.hidden_by[:, k]
        assert torch.equal(share, (label == k).sum(1) / POINTS)
    assert float(found.hidden_by[:, LABELS.index("robot")].max()) > 0.05 and 0.2 < float(found.seen.max()) < 0.8
    plain = next(i for i, o in enumerate(scene.objects) if not o.receiver_face.any())
    other = replace(trials[:1], object_index=torch.tensor([plain], dtype=torch.int32))
    alone = view(scene, other, T[:1], q[:1], opening[:1])
    assert bool(alone.seen.isnan().all()) and bool(alone.hidden_by.isnan().all())


def test_views_have_the_same_bits_alone_in_sevens_and_permuted():
    scene, trials, T, q, opening, _ = handed()
    whole = hidden_points(scene, trials, T, q, opening)
    n = len(trials)
    order = torch.from_numpy(np.random.default_rng(0).permutation(n))
    for part in each([torch.arange(k, min(k + 7, n)) for k in range(0, n, 7)] + [torch.tensor([n - 1]), order]):
        assert torch.equal(hidden_points(scene, trials[part], T[part], q[part], opening[part]), whole[part])


def test_a_regions_points_lie_on_it_evenly():
    scene = handed()[0]
    for model in each([o for o in scene.objects if o.receiver_face.any()]):
        points, normals = region_points(model)
        corners = model.vertices.astype(float)[model.faces[model.receiver_face]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        mean, spread = np.average(corners.mean(1), axis=0, weights=area), np.ptp(corners.reshape(-1, 3), axis=0).max()
        assert np.abs(points.mean(0) - mean).max() < 0.01 * spread
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
        planes = np.einsum("fk,fk->f", cross / area[:, None], corners[:, 0])
        off = np.abs(points @ (cross / area[:, None]).T - planes).min(1)
        assert off.max() < 1e-7


def test_eyes_are_where_those_of_the_built_in_people_are():
    skin, people = (read_arrays(asset("people", f"{name}.npz")) for name in ("skin", "people"))
    n = len(skin["weights"])
    basis = skin["basis"] * skin["scale"].astype(float)[:, None, None]
    # the last vertices are those of the two eyes, 72 each
    own = [slice(n - 144, n - 72), slice(n - 72, n)]
    own = [
        skin["points"][k].mean(0) + np.tensordot(skin["person"].astype(float), basis[:, k].mean(1), 1) for k in own
    ]  # fmt: skip
    theirs = np.stack(sorted(own, key=lambda x: -x[:, 1].mean()), 1)
    receiver = torch.zeros((len(people["age"]), 5, 4))
    receiver[:, 1, 2] = -torch.from_numpy((1 - 0.104) * people["acromion_radiale"])  # the elbow below the shoulder
    receiver[:, 3, 2] = torch.from_numpy(0.5 * (people["acromial_height"] + people["iliac_height"]))
    receiver[:, 4, 2] = torch.from_numpy(0.5 * (people["acromial_height"] - people["iliac_height"]))
    receiver[:, 3, 3] = 1.0
    off = eyes_of(receiver).numpy() - theirs
    assert np.abs(off.mean((0, 1))).max() < 0.002
    assert np.abs(off[..., 2]).max() < 0.022 and np.sqrt((off[..., 2] ** 2).mean()) < 0.0055
    assert np.sqrt((off[..., 0] ** 2).mean()) < 0.015 and np.abs(off[..., 1]).max() < 0.007


def test_eyes_turn_with_the_torso():
    trials = handed()[1]
    s, c = np.sin(0.7), np.cos(0.7)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    turned = trials.receiver.clone()
    turned[:, :4, :3] = trials.receiver[:, :4, :3] @ R.T
    fx, fy = trials.receiver[:, 3, 3], trials.receiver[:, 4, 3]
    turned[:, 3, 3], turned[:, 4, 3] = c * fx - s * fy, s * fx + c * fy
    assert (eyes_of(turned) - eyes_of(trials.receiver) @ R.double().T).abs().max() < 1e-6
