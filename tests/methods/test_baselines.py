"""The four baselines choose what their rules say: every choice is made again, trial by trial, by brute force."""

import numpy as np
import pytest
import torch
from baseline_twins import (
    METHODS,
    NOISE,
    N,
    answer,
    candidates,
    chosen_candidate,
    clear_of,
    ends,
    evaluator,
    first_passing,
    pose,
    predict,
    rolls_from,
    trials,
)
from needs import needs

from r2h_batch import se3
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import handover_va, intent
from r2h_batch.methods.box_grasps import box_grasps, depth_steps
from r2h_batch.methods.utility_axis import align_templates
from r2h_batch.predictors import (
    predict_parts,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)


def test_fc_takes_the_grasp_most_opposed_to_the_hand_of_those_that_do_not_touch_it():
    taking = predict_receiving(trials(), evaluator().scene, noise=NOISE)
    tip = int(evaluator().scene.hands.model.tip_vertices[1])
    some = fallbacks = 0
    for i in range(len(trials())):
        T, opening, _ = candidates(i)
        clear = clear_of(taking.vertices[i], T, opening)
        v_h = (taking.vertices[i, tip] - taking.joints[i, 0]).double().numpy()
        cos = T[:, :3, 2].double().numpy() @ v_h / np.linalg.norm(v_h)
        got = chosen_candidate(i, answer("fc").T_obj_ee[i])
        pool = clear if clear.any() else np.ones_like(clear)
        fallbacks += not clear.any()
        assert pool[got] and cos[got] <= cos[pool].min() + 1e-6
        some += 0 < clear.sum() < len(clear)
    assert some > N and fallbacks <= 3


def test_fc_opposes_the_gripper_to_the_target_hand_with_the_object_at_the_balls_centre():
    target = predict_target(trials(), evaluator().scene, noise=NOISE)
    for i in range(len(trials())):
        T_obj_ee, T_world_ee = (getattr(answer("fc"), k)[i].double().numpy() for k in ("T_obj_ee", "T_world_ee"))
        v_h = target.wrist_to_middle[i].double().numpy()
        assert np.abs(T_world_ee[:3, 2] + v_h).max() < 1e-5
        T_world_obj = T_world_ee @ np.linalg.inv(T_obj_ee)
        model = evaluator().scene.objects[int(trials().object_index[i])]
        middle = (model.vertices.min(0) + model.vertices.max(0)) / 2
        assert np.abs(T_world_obj[:3, :3] @ middle + T_world_obj[:3, 3] - target.ball_center[i].numpy()).max() < 1e-5
        R = rolls_from(answer("fc").T_world_ee[i], -v_h)
        inverse = np.linalg.inv(T_obj_ee)
        tries = pose(R, target.ball_center[i].double().numpy() - R @ (inverse[:3, :3] @ middle + inverse[:3, 3]))
        k = chosen_candidate(i, answer("fc").T_obj_ee[i])
        turn = first_passing(tries, candidates(i)[1][k : k + 1], target.vertices[i])
        assert np.abs(tries[turn] - T_world_ee).max() < 2e-5


@needs("rtree")
def test_intent_takes_the_least_published_score_of_what_fits_and_keeps_off_the_named_region():
    taking = retrieve_receiving(trials(), evaluator().scene, noise=NOISE)
    refused = 0
    for i in range(0, len(trials()), 2):
        model = evaluator().scene.objects[int(trials().object_index[i])]
        T = candidates(i)[0].double().numpy()
        z, p = T[:, :3, 2], T[:, :3, 3]
        _, ray, face = model.mesh.ray.intersects_id(p - 0.1 * z, z, multiple_hits=False, return_locations=True)[::-1]
        region = np.zeros(len(T), bool)
        ray, face = np.asarray(ray, int), np.asarray(face, int)
        region[ray] = model.receiver_face[face]
        v_h, palm = taking.wrist_to_middle[i].double().numpy(), taking.palm_point[i].double().numpy()
        score = z @ v_h - np.linalg.norm(p - palm, axis=1)
        got = chosen_candidate(i, answer("intent").T_obj_ee[i])
        pool = ~region
        refused += int(score[pool].min() > score.min())
        assert pool[got] and score[got] <= score[pool].min() + 1e-6
    assert refused >= 1


def test_intent_stands_15_cm_above_the_palm_turned_15_degrees_towards_the_thumb():
    target = predict_target(trials(), evaluator().scene, noise=NOISE)
    for i in range(len(trials())):
        T = answer("intent").T_world_ee[i].double().numpy()
        n, palm = target.palm_normal[i].double().numpy(), target.palm_point[i].double().numpy()
        assert np.abs(T[:3, 3] - palm - 0.15 * n).max() < 1e-5 and abs(T[:3, 2] @ n) < 1e-5
        fingers = target.wrist_to_middle[i].double().numpy()
        fingers = fingers - fingers @ n * n
        fingers /= np.linalg.norm(fingers)
        thumb = (target.joints[i, 13] - target.joints[i, 7]).double().numpy()  # from the little finger's root
        aside = thumb - thumb @ n * n - thumb @ fingers * fingers
        aside /= np.linalg.norm(aside)
        z = -(np.cos(np.radians(15)) * fingers + np.sin(np.radians(15)) * aside)
        assert np.abs(T[:3, 2] - z).max() < 1e-4
        tries = pose(rolls_from(answer("intent").T_world_ee[i], T[:3, 2]), T[:3, 3])
        k = chosen_candidate(i, answer("intent").T_obj_ee[i])
        turn = first_passing(tries, candidates(i)[1][k : k + 1], target.vertices[i])
        assert np.abs(tries[turn] - T).max() < 2e-5


def test_intent_does_as_it_is_told():
    model = evaluator().scene.objects
    s1 = trials()[trials().trial_id % 2 == 1]
    own = predict(intent, s1)
    said = [model[int(i)].instruction for i in s1.object_index]
    told = predict(intent, s1, instructions=said)
    assert torch.equal(own.T_obj_ee, told.T_obj_ee) and torch.equal(own.T_world_ee, told.T_world_ee)
    with pytest.raises(ValueError, match="1 instructions for 16 trials"):
        predict(intent, s1, instructions=said[:1])


def test_the_region_is_what_the_sentence_names():
    scene = evaluator().scene
    some = trials()[trials().trial_id == 1]  # a hammer
    model = scene.objects[int(some.object_index[0])]
    assert model.name == "hammer"
    assert [model.part_names[k] for k in intent.named_parts(scene, some, None)[0].nonzero()[:, 0]] == ["grip"]
    free = trials()[trials().trial_id == 0]
    assert not intent.named_parts(scene, free, None).any()
    words = intent.named_parts(scene, free, ["hand me the controller by its grip"])[0]
    assert [scene.objects[0].part_names[k] for k in words.nonzero()[:, 0]] == ["grip"]


def test_va_takes_its_own_best_scored_grasp_and_presents_the_handle_to_the_palm():
    scene = evaluator().scene
    seen = predict_parts(trials(), scene, noise=NOISE)
    target = predict_target(trials(), scene, noise=NOISE)
    role = handover_va.point_roles(scene, trials().object_index, seen)
    own = box_grasps(
        scene, trials().object_index, role,
        voxel_m=0.02, azimuth_step=0.05 * np.pi, depths_m=depth_steps(-0.005, 0.05, 0.0025), crop_m=0.1,
    )  # fmt: skip
    axis = align_templates(scene, trials().object_index, role, iterations=100, tolerance_m=1e-5)
    for i in range(len(trials())):
        T_obj_ee, got = (getattr(answer("handover_va"), k)[i].double().numpy() for k in ("T_obj_ee", "T_world_ee"))
        if (own.score[i] > 0).any():
            assert np.array_equal(T_obj_ee, own.T_obj_ee[i, int(own.score[i].argmax())].double().numpy())
        else:
            best = candidates(i)[2].argmax()
            assert chosen_candidate(i, answer("handover_va").T_obj_ee[i]) == best
        T_world_obj = got @ np.linalg.inv(T_obj_ee)
        handle = T_world_obj[:3, :3] @ axis.R_obj_template[i, :, 0].numpy()
        n = target.palm_normal[i].double().numpy()
        assert np.abs(handle + n).max() < 1e-5
        middle = T_world_obj[:3, :3] @ axis.handle[i].double().numpy() + T_world_obj[:3, 3]
        assert np.abs(middle - target.ball_center[i].numpy()).max() < 1e-5
        tries = handover_va.carried(
            handover_va.presented(
                axis.R_obj_template[i : i + 1], target.palm_normal[i : i + 1], [2 * np.pi * k / 7 for k in range(7)]
            ),
            axis.handle[i : i + 1], target.ball_center[i : i + 1], answer("handover_va").T_obj_ee[i : i + 1],
        )[0].double().numpy()  # fmt: skip
        assert np.abs(tries[first_passing(tries, torch.zeros(1), None)] - got).max() < 2e-5
        turn = tries[1, :3, :3] @ tries[0, :3, :3].T  # 2 pi / 7 about the handover axis
        assert np.trace(turn) == pytest.approx(1 + 2 * np.cos(2 * np.pi / 7), abs=1e-5)
        assert np.abs(turn @ n - n).max() < 1e-5


def test_va_presents_with_the_templates_z_axis_up():
    n = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    (R,) = handover_va.presented(torch.eye(3, dtype=torch.float64)[None], n, [0.0])[0]
    assert torch.allclose(R, torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]], dtype=torch.float64))


@pytest.mark.parametrize("name", METHODS)
def test_an_answer_does_not_depend_on_batch_size_or_order(name):
    whole = answer(name)
    rows = torch.tensor([21, 4, 30, 9])
    some, one = predict(METHODS[name], trials()[rows]), predict(METHODS[name], trials()[4:5])
    for k in ("T_obj_ee", "T_world_ee"):
        assert torch.equal(getattr(some, k), getattr(whole, k)[rows])
        assert torch.equal(getattr(one, k)[0], getattr(whole, k)[4])
    assert len(predict(METHODS[name], trials()[:0])) == 0
    assert se3.is_pose(whole.T_obj_ee).all() and se3.is_pose(whole.T_world_ee).all()
    assert whole.t_method_s.shape == (2 * N,) and (whole.t_method_s > 0).all()


@pytest.mark.parametrize("name", METHODS)
def test_seed_and_noise_change_what_is_seen_and_no_noise_sees_the_target_hand_as_it_is(name):
    other = predict(METHODS[name], trials(), seed=1)
    assert not torch.equal(other.T_world_ee, answer(name).T_world_ee)
    exact = predict(METHODS[name], trials(), noise=NOISE.scaled(0))
    again = predict(METHODS[name], trials(), noise=NOISE.scaled(0), seed=1)
    seen = predict_target(trials(), evaluator().scene, noise=NOISE.scaled(0))
    point, normal, _ = evaluator().scene.palm(trials().hand_index, trials().T_world_hand)
    assert (seen.palm_point - point).abs().max() < 1e-6 and (seen.palm_normal - normal).abs().max() < 1e-5
    if name in ("contact", "intent"):
        above = point + 0.15 * normal
        assert (exact.T_world_ee[:, :3, 3] - above).abs().max() < 1e-5
        assert (again.T_world_ee[:, :3, 3] - above).abs().max() < 1e-5


@pytest.mark.gpu
@pytest.mark.parametrize("name", METHODS)
def test_a_gpu_chooses_the_same_grasps_and_poses(name):
    scene = Evaluator(device="cuda").scene
    options = {"predictor": ends} if name == "contact" else {}
    found = METHODS[name].predict(trials(), scene, **options)
    near = (found.T_obj_ee - answer(name).T_obj_ee).abs().amax((1, 2)) < 1e-4
    near &= (found.T_world_ee - answer(name).T_world_ee).abs().amax((1, 2)) < 1e-3
    assert near.float().mean() > 0.9  # equal costs and touching within rounding may fall the other way


@pytest.mark.slow
def test_the_kernels_compile_for_a_gpu(tmp_path):
    import warp as wp

    from r2h_batch.kernels.methods import approach_hit, blocked, box_grasps, hand_clearance, label_icp, pose_cost

    for module in (approach_hit, blocked, box_grasps, hand_clearance, label_icp, pose_cost):
        wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 6
