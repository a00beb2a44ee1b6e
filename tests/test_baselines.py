"""The four baselines choose what their rules say: every choice is made again, trial by trial, by brute force."""

from functools import cache
from types import ModuleType

import numpy as np
import pytest
import torch
from convex_twin import primitive_distance
from numpy.typing import NDArray

from r2h_batch import se3
from r2h_batch.evaluate import Evaluator
from r2h_batch.grasp import gripper_poses
from r2h_batch.ik import solve_ik
from r2h_batch.methods import contact, fc, handover_va, intent
from r2h_batch.methods.box_grasps import box_grasps, depth_steps
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.methods.least_cost_pose import approach_fan, collision_cost, gripper_capsule, hand_sample
from r2h_batch.methods.palm_pose import roll_angles
from r2h_batch.methods.utility_axis import align_templates
from r2h_batch.predictors import (
    PredictorNoise,
    predict_contacts,
    predict_parts,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.robot import load_robot
from r2h_batch.trials import make_trials
from r2h_batch.types import Predictions, Trials

N = 16
NOISE = PredictorNoise()


@cache
def evaluator() -> Evaluator:
    return Evaluator()


@cache
def trials() -> Trials:
    return make_trials(trials=N)


def ends(grid: torch.Tensor) -> torch.Tensor:
    """A contact network: people take objects by the end at +x."""
    return grid[:, 0] * (0.5 + 0.5 * grid[:, 1])


METHODS = {"fc": fc, "handover_va": handover_va, "contact": contact, "intent": intent}


def predict(method: ModuleType, some: Trials, **options) -> Predictions:
    if method is contact:
        options = {"predictor": ends} | options
    return method.predict(some, evaluator().scene, evaluator=evaluator(), **options)


@cache
def answer(name: str) -> Predictions:
    return predict(METHODS[name], trials())


def candidates(i: int) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.float64]]:
    """T_obj_ee, opening and score of the candidates of trial i's object."""
    table, o = candidate_table(evaluator().scene), int(trials().object_index[i])
    rows = slice(int(table.first[o]), int(table.first[o] + table.count[o]))
    return table.T_obj_ee[rows], table.opening_m[rows], table.score[rows].double().numpy()


def clear_of(vertices: torch.Tensor, T: torch.Tensor, opening: torch.Tensor) -> NDArray[np.bool_]:
    """Whether each gripper T, opening is clear of one hand."""
    hand = posed_hand(evaluator().scene.hands.model, vertices[None], "cpu")
    first, count = torch.zeros(1, dtype=torch.int32), torch.tensor([len(T)], dtype=torch.int32)
    distance = gripper_clearance(hand, T.contiguous(), opening.contiguous(), first, count, len(T), cap_m=1e-3)
    return (distance[0] > 0).numpy()


def chosen_candidate(i: int, T_obj_ee: torch.Tensor) -> int:
    """Which candidate of its object trial i got."""
    T, _, _ = candidates(i)
    (k,) = torch.nonzero((T_obj_ee == T).all(2).all(1)).flatten().tolist()
    return k


def rolls_from(T_world_ee: torch.Tensor, z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 8 rotations about z in the order they are tried, from the one whose x is nearest to -X of the world."""
    z = z / np.linalg.norm(z)
    x = np.array([-1.0, 0, 0]) - np.array([-1.0, 0, 0]) @ z * z
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    return np.stack([
        np.stack([np.cos(a) * x + np.sin(a) * y, np.cos(a) * y - np.sin(a) * x, z], 1) for a in roll_angles(8)
    ])  # fmt: skip


def first_passing(T: NDArray[np.float64], opening: torch.Tensor, vertices: torch.Tensor | None) -> int:
    """Index of the first pose that the arm reaches, its gripper clear of the hand; else the first it reaches; else 0."""
    poses = torch.from_numpy(T).float()
    reached = [bool(solve_ik(p[None].contiguous()).reachable) for p in poses]
    clear = [True] * len(T) if vertices is None else clear_of(vertices, poses, opening.expand(len(T))).tolist()
    both = [a and b for a, b in zip(reached, clear, strict=True)]
    return both.index(True) if any(both) else reached.index(True) if any(reached) else 0


def pose(R: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    return T


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


def test_intent_takes_the_least_published_score_of_what_fits_and_keeps_off_the_named_region():
    pytest.importorskip("rtree")
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


def near_gripper(i: int) -> NDArray[np.bool_]:
    """(K, P) cloud points nearer than 2 cm to each candidate's gripper."""
    model, robot = evaluator().scene.objects[int(trials().object_index[i])], load_robot()
    T, opening, _ = candidates(i)
    R, p = (x.double().numpy() for x in gripper_poses(opening))
    out = np.zeros((len(T), len(model.points)), bool)
    for k, T_obj_ee in enumerate(T.double().numpy()):
        in_ee = (model.points - T_obj_ee[:3, 3]) @ T_obj_ee[:3, :3]
        for g, (kind, size) in enumerate(zip(robot.gripper.kind, robot.gripper.size, strict=True)):
            near = np.flatnonzero(((in_ee - p[k, g]) ** 2).sum(1) < (np.linalg.norm(size) + contact.BLOCKED_M) ** 2)
            x = (in_ee[near] - p[k, g]) @ R[k, g]
            out[k, near] |= primitive_distance(int(kind), size, x) < contact.BLOCKED_M
    return out


def clusters(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """DBSCAN by its definition: cores have enough neighbours, members are within eps of a core."""
    close = np.linalg.norm(points[:, None] - points, axis=2) <= contact.EPS_M
    core = close.sum(1) >= contact.MIN_SAMPLES
    return (close & core).any(1)


def test_contact_takes_the_grasp_that_blocks_least_contact_of_clustered_clear_ones():
    scene = evaluator().scene
    taking = predict_receiving(trials(), scene, noise=NOISE)
    found = predict_contacts(trials(), scene, predictor=ends).double().numpy()
    kept = np.where(found >= 0.4, found, 0.0)
    assert ((found > 0) & (found < 0.4)).any() and (kept > 0).any(1).all()
    unlike = 0
    for i in range(0, len(trials()), 5):
        T, opening, score = candidates(i)
        member = clusters(T[:, :3, 3].double().numpy())
        blocked = near_gripper(i) @ kept[i]
        pool = clear_of(taking.vertices[i], T, opening) & member
        got = chosen_candidate(i, answer("contact").T_obj_ee[i])
        if not pool.any():
            continue
        assert pool[got] and blocked[got] <= blocked[pool].min() * (1 + 1e-5) + 1.5  # one point within rounding of 2 cm
        equal = pool & (blocked <= 0)
        assert not equal[got] or score[got] >= score[equal].max() - 1e-7
        unlike += int(blocked.max() > blocked[got])
    assert unlike >= 4


def test_clusters_are_dbscans_by_its_definition():
    table, found = candidate_table(evaluator().scene), contact.in_clusters(evaluator().scene, contact.EPS_M, 3)
    for first, count in zip(table.first.tolist(), table.count.tolist(), strict=True):
        rows = slice(first, first + count)
        points = table.T_obj_ee[rows, :3, 3].double().numpy()
        assert np.array_equal(found[rows].numpy(), clusters(points))
    assert 5 < (~found).sum() < 200


def test_of_equally_blocked_grasps_the_best_scored_wins_and_filters_give_way_one_by_one():
    blocked = torch.tensor([[2.0, 1.0, 1.0, 0.0, 0.0]] * 4)
    score = torch.tensor([[0.9, 0.2, 0.3, 0.8, 0.9]] * 4)
    clear = torch.tensor([[1, 1, 1, 1, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0]], dtype=torch.bool)
    clustered = torch.tensor([[1, 1, 1, 0, 1]] * 4, dtype=torch.bool)
    everything = torch.ones_like(clear)
    assert contact.least_blocked(blocked, score, clear, clustered, everything).tolist() == [2, 2, 3, 4]
    four = everything.clone()
    four[:, 4] = False
    assert contact.least_blocked(blocked, score, clear, clustered, four).tolist() == [2, 2, 3, 3]


def test_contacts_orientation_has_the_least_cost_of_those_the_arm_reaches():
    import trimesh

    scene = evaluator().scene
    target = predict_target(trials(), scene, noise=NOISE)
    fan = approach_fan(target.palm_normal, 32, 8).numpy()
    robot = load_robot()
    for i in (1, 18, 27):
        k = chosen_candidate(i, answer("contact").T_obj_ee[i])
        T_obj_ee, opening, _ = candidates(i)
        p = (target.palm_point[i].double() + 0.15 * target.palm_normal[i].double()).numpy()
        T = pose(fan[i], p)
        got = answer("contact").T_world_ee[i].double().numpy()
        reached = np.array([bool(solve_ik(torch.from_numpy(t).float()[None].contiguous()).reachable) for t in T])
        hand = target.vertices[i, hand_sample(scene, 128)]
        o = trials().object_index[i : i + 1]
        cost = collision_cost(
            scene, o, T_obj_ee[k : k + 1], opening[k : k + 1], torch.from_numpy(T).float()[None], hand[None]
        )[0].numpy()
        mine = int(np.abs(T - got).max((1, 2)).argmin())
        assert np.abs(T[mine] - got).max() < 1e-5
        assert reached[mine] and cost[mine] <= cost[reached].min() + 1e-9
        assert mine == np.flatnonzero(reached & (cost == cost[mine]))[0]  # of equals the first of the fan
        R, q = (x[0].double().numpy() for x in gripper_poses(opening[k : k + 1]))
        mesh = scene.objects[int(o)].mesh
        for m in (0, 60, 111, 200):
            x = (hand.double().numpy() - T[m, :3, 3]) @ T[m, :3, :3]
            in_obj = x @ T_obj_ee[k, :3, :3].double().numpy().T + T_obj_ee[k, :3, 3].double().numpy()
            d = -trimesh.proximity.signed_distance(mesh, in_obj)
            for g in range(len(q)):
                d = np.minimum(
                    d, primitive_distance(int(robot.gripper.kind[g]), robot.gripper.size[g], (x - q[g]) @ R[g])
                )
            assert cost[m] == pytest.approx(np.maximum(0.03 - d, 0).mean(), abs=2e-6)


def test_the_grippers_capsule_holds_it_at_any_opening():
    low, high, radius = gripper_capsule()
    robot = load_robot()
    R, p = (x.double().numpy() for x in gripper_poses(torch.tensor([0.0, 0.0137, 0.0411, 0.085])))
    axis = np.array([[0.0, 0.0, z] for z in np.linspace(low, high, 400)])
    d = np.random.default_rng(0).normal(size=(300, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    outside = axis[:, None] + (radius + 1e-3) * d  # a millimetre off the capsule, or inside of it
    gap = np.linalg.norm(outside[:, :, None] - axis[None, None, ::8], axis=3).min(2)
    outside = outside[gap > radius + 5e-4]
    for n in range(4):
        for g, (kind, size) in enumerate(zip(robot.gripper.kind, robot.gripper.size, strict=True)):
            assert primitive_distance(int(kind), size, (outside - p[n, g]) @ R[n, g]).min() > 0
    assert radius < 0.1 and high < 0.03


def test_the_fan_faces_the_palm_and_starts_straight_into_it():
    n = torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.0, -0.8]], dtype=torch.float64)
    fan = approach_fan(n, 32, 8)
    into = -(fan[..., 2] * n[:, None]).sum(-1)
    assert (into > 0).all() and (into[:, :8] > 0.97).all() and into.min() < 0.1
    assert (into[:, ::8].diff(dim=1) < 0).all()  # ever flatter
    assert (fan.mT @ fan - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12


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

    from r2h_batch.kernels import approach_hit, blocked, box_grasps, hand_clearance, label_icp, pose_cost

    for module in (approach_hit, blocked, box_grasps, hand_clearance, label_icp, pose_cost):
        wp.compile_aot_module(module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert len(list(tmp_path.glob("*.ptx"))) == 6
