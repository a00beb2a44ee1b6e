"""Errors of the object's pose that methods see (`EvalConfig.object_errors`)."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import default_evaluator
from rounds import each
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.base import rng
from r2h_batch.config import OBJECT_ERRORS, EvalConfig, ExecConfig, ExecutionError, ObjectErrors
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.object_errors import box_middle, seen_frames, symmetry_axis, taken_grasps
from r2h_batch.methods import fc, oracle

FIELD = ObjectErrors(*OBJECT_ERRORS["field"])
WILD = ObjectErrors(0.005, 4.0, gross=0.3, seed=3)


def evaluator(errors):
    """The shared evaluator's scene with these errors, the motion as planned."""
    twin = copy.copy(default_evaluator("r2h-v1"))
    twin.config = EvalConfig(object_errors=errors, execute=ExecConfig(sim="none"))
    return twin


@pytest.fixture(scope="module")
def asked():
    trials = load_benchmark("r2h-v1").trials(24)
    answer = fc.predict(trials, default_evaluator("r2h-v1").scene)
    return answer.T_obj_ee, answer.T_world_ee, trials


def objects():
    return default_evaluator("r2h-v1").scene.objects


def twin_frames(errors, trials):
    """T_obj_seen by scipy in float64: from the counters' uniform numbers and the objects' vertices alone."""
    key, ids = rng.key_of(f"object errors {errors.seed}"), trials.trial_id.numpy()
    u = rng.uniforms(key, ids, 72, purpose=0).reshape(12, 6, -1)
    z = u.sum(0) - 6.0
    hit, which, angle = rng.uniforms(key, ids, 3, purpose=1)
    found = np.zeros((len(ids), 4, 4))
    for i, o in enumerate(trials.object_index.tolist()):
        v = objects()[o].vertices.astype(np.float64)
        middle = (v.min(0) + v.max(0)) / 2
        turn = Rotation.from_rotvec(np.radians(errors.rotation_deg) * z[:3, i])
        if hit[i] < errors.gross and errors.gross_turn == "half":
            turn = turn * Rotation.from_euler("xyz"[int(3 * which[i])], 180, degrees=True)
        elif hit[i] < errors.gross:
            turn = turn * Rotation.from_euler("xyz"[symmetry_axis(objects()[o])], 360 * angle[i], degrees=True)
        found[i] = np.eye(4)
        found[i, :3, :3] = turn.as_matrix()
        found[i, :3, 3] = middle - turn.apply(middle) + errors.translation_m * z[3:, i]
    return found


@pytest.mark.check
@pytest.mark.parametrize("errors", [FIELD, WILD, replace(WILD, gross_turn="symmetry")])
def test_the_grasp_that_is_taken_is_that_of_a_twin_in_float64(asked, errors):
    T_obj_ee, _, trials = asked
    expected = twin_frames(errors, trials)
    assert np.allclose(seen_frames(errors, objects(), trials).numpy(), expected, atol=3e-7)
    taken = taken_grasps(errors, objects(), T_obj_ee, trials).double().numpy()
    assert np.allclose(taken, expected @ T_obj_ee.double().numpy(), atol=5e-7)
    moved = np.linalg.norm(taken[:, :3, 3] - T_obj_ee.double().numpy()[:, :3, 3], axis=1)
    assert moved.min() > 1e-4


def test_errors_have_the_sizes_that_were_asked_and_are_independent():
    trials = load_benchmark("r2h-v1").trials(2000)
    T = seen_frames(FIELD, objects(), trials).numpy()
    middle = np.stack([box_middle(objects()[o]) for o in trials.object_index.tolist()])
    turn = np.degrees(Rotation.from_matrix(T[:, :3, :3]).as_rotvec())
    shift = np.einsum("nij,nj->ni", T[:, :3, :3], middle) + T[:, :3, 3] - middle
    for found, sd in each([(turn, 4.0), (shift, 0.005)]):
        # 4,000 draws: the deviation is within 5 %, the mean within 4 standard errors
        assert np.allclose(found.std(0), sd, rtol=0.05) and (abs(found.mean(0)) < 4 * sd / 4000**0.5).all()
    # the angle of three normal components (Maxwell): its mean is sd sqrt(8 / pi)
    assert np.isclose(np.linalg.norm(turn, axis=1).mean(), 4.0 * np.sqrt(8 / np.pi), rtol=0.03)
    assert abs(np.corrcoef(np.hstack([turn, shift]).T) - np.eye(6)).max() < 0.08


def test_gross_errors_come_as_often_as_asked_about_each_axis_and_any_angle_of_the_symmetry():
    trials = load_benchmark("r2h-v1").trials(2000)
    index = trials.object_index.numpy()
    half, any_angle = (ObjectErrors(gross=0.25, gross_turn=kind) for kind in ("half", "symmetry"))
    turn = Rotation.from_matrix(seen_frames(half, objects(), trials)[:, :3, :3].numpy()).as_rotvec()
    angle = np.linalg.norm(turn, axis=1)
    hit = angle > 0
    assert np.allclose(angle[hit], np.pi) and abs(hit.mean() - 0.25) < 4 * (0.25 * 0.75 / 4000) ** 0.5
    share = (abs(turn[hit]) > 3).mean(0)
    assert np.isclose(share.sum(), 1) and (abs(share - 1 / 3) < 4 * (2 / 9 / hit.sum()) ** 0.5).all()
    turn = Rotation.from_matrix(seen_frames(any_angle, objects(), trials)[:, :3, :3].numpy()).as_rotvec()
    turned = np.linalg.norm(turn, axis=1) > 0
    assert turned.tolist() == hit.tolist()  # one draw says whether
    own = np.array([symmetry_axis(o) for o in objects()])[index[hit]]
    along = turn[hit][np.arange(hit.sum()), own]
    assert np.allclose(abs(along), np.linalg.norm(turn[hit], axis=1))
    counts = np.histogram(along % (2 * np.pi), 8, (0, 2 * np.pi))[0]
    assert (abs(counts - hit.sum() / 8) < 4 * (hit.sum() * 7 / 64) ** 0.5).all()


def test_a_round_object_is_turned_about_the_axis_that_it_is_round_about():
    axes = {o.name: symmetry_axis(o) for o in objects()}
    for name in each(n for n in axes if n in ("bowl", "bottle", "wine_glass", "cup")):
        assert axes[name] == 2, name


def test_a_trial_meets_the_same_error_alone_in_any_order_and_in_shards_and_another_with_another_seed():
    trials = load_benchmark("r2h-v1").trials(40)
    for errors in each([WILD, replace(WILD, gross_turn="symmetry")]):
        whole = seen_frames(errors, objects(), trials)
        order = torch.randperm(len(trials), generator=torch.Generator().manual_seed(0))
        assert torch.equal(seen_frames(errors, objects(), trials[order]), whole[order])
        alone = [seen_frames(errors, objects(), trials[i : i + 1]) for i in range(len(trials))]
        sevens = [seen_frames(errors, objects(), trials[i : i + 7]) for i in range(0, len(trials), 7)]
        assert torch.equal(torch.cat(alone), whole) and torch.equal(torch.cat(sevens), whole)
        other = seen_frames(replace(errors, seed=4), objects(), trials)
        assert (other - whole).abs().amax((1, 2)).min() > 1e-4


@pytest.mark.check
def test_the_judge_scores_the_taken_grasps_and_keeps_the_answer_and_no_error_changes_nothing(asked):
    T_obj_ee, T_world_ee, trials = asked
    off = evaluator(WILD).score(*asked)
    taken = taken_grasps(WILD, objects(), T_obj_ee, trials)
    plain = evaluator(ObjectErrors())
    moved, true = plain.score(taken, T_world_ee, trials), plain.score(*asked)
    seed_alone = evaluator(ObjectErrors(seed=9, gross_turn="symmetry")).score(*asked)
    for name in each(("outcome", "margin", "path", "q_goal")):
        assert torch.equal(getattr(off, name).nan_to_num(), getattr(moved, name).nan_to_num())
        assert torch.equal(getattr(seed_alone, name).nan_to_num(), getattr(true, name).nan_to_num())
    assert not torch.equal(off.margin.nan_to_num(), true.margin.nan_to_num())
    assert torch.equal(off.inputs.T_obj_ee, T_obj_ee)  # what is stored is the answer
    assert taken_grasps(ObjectErrors(), objects(), T_obj_ee, trials) is T_obj_ee


def test_the_object_is_seen_first_and_the_execution_errs_on_what_was_seen(asked):
    T_obj_ee, T_world_ee, trials = asked
    error = ExecutionError(camera_m=0.01, object_m=0.005, object_deg=4.0)
    config = EvalConfig(object_errors=WILD, execution_error=error)
    both = executed_poses(config, objects(), T_obj_ee, T_world_ee, trials)
    taken = taken_grasps(WILD, objects(), T_obj_ee, trials)
    after = executed_poses(EvalConfig(execution_error=error), objects(), taken, T_world_ee, trials)
    assert all(torch.equal(a, b) for a, b in zip(both, after, strict=True))
    # another draw than the execution's
    alone = executed_poses(EvalConfig(execution_error=error), objects(), T_obj_ee, T_world_ee, trials)[0]
    assert not torch.allclose(both[0], alone, atol=1e-3)


def test_a_method_that_searches_with_the_evaluator_believes_what_it_sees():
    trials, answers = load_benchmark("r2h-v1").trials(4), []
    for errors in each((ObjectErrors(), WILD)):
        judge = evaluator(errors)
        answers.append(oracle.predict(trials, judge.scene, evaluator=judge).T_obj_ee)
    assert torch.equal(*answers)


def test_motions_are_refused_in_one_line(asked):
    with pytest.raises(ValueError, match="object_errors changes poses, and motions are judged as they are"):
        evaluator(FIELD).score_motion(asked[0], torch.zeros(48, 2, 6), torch.tensor([0.0, 1.0]), asked[2])
