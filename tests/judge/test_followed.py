"""Plans of a believed world, judged in the true one: against sampled ways in MuJoCo C, and against the truth."""

from collections import Counter
from dataclasses import fields, replace
from functools import cache

import pytest
import torch
from pick_twin import PickTwin
from rounds import each

from r2h_batch import load_benchmark, stages
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.followed import follow_plans, no_plan, nothing_to_pick
from r2h_batch.judge.pick import Picked, follow_picks, judge_picks
from r2h_batch.judge.plan import Plan, path_clearances
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.observe.known import known_moments
from r2h_batch.observe.sees import Sees
from r2h_batch.scene.resting import without
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.scene import Scene
from r2h_batch.types import CollidingPair, PlanReason
from r2h_batch.verdicts import PickReason
from r2h_batch.work import Work

EXACT = "cell-v1,noise=0,model=known,object=none"


@cache
def benchmark():
    return load_benchmark("r2h-v3").until("present")


@cache
def evaluator(sees=""):
    config = EvalConfig(execute=ExecConfig(sim="none"))
    plans_in = Sees.parse(sees).on(benchmark()) if sees else None
    return Evaluator(benchmark(), config, plans_in=plans_in)


@cache
def asked(n=24):
    """Trials, grasps that the arm can pick, and where the objects rest."""
    trials, scene = benchmark().trials(n), evaluator().scene
    rest = known_moments(scene).of(trials)
    candidates = candidates_of(scene.objects)
    grasps = []
    for i, k in enumerate(trials.object_index.tolist()):
        T = torch.as_tensor(candidates[k].T_obj_ee)[::7][:24]
        many = trials[torch.full((len(T),), i)]
        found = judge_picks(scene, T, rest[i].expand(len(T), 4, 4), many)
        grasps.append(T[int(found.picked.to(torch.int8).argmax())])
    return trials, torch.stack(grasps), rest


def moved(rest, step_m):
    """Objects that rest elsewhere along x, y."""
    out = rest.clone()
    out[:, :2, 3] += torch.tensor(step_m)
    return out


@cache
def truth(step_m=(0.0, 0.0)):
    """Grasps in the frames of objects that rest elsewhere than is believed, by `step_m`, and where those rest."""
    _, grasps, rest = asked()
    there = moved(rest, step_m)
    held = se3.matmul(se3.inverse(there.double()), se3.matmul(rest.double(), grasps.double())).float()
    return (held, there) if any(step_m) else (grasps, rest)


@cache
def followed(step_m=(0.0, 0.0)):
    """Picks as they were planned, and what becomes of them where the objects are not, by `step_m`."""
    trials, grasps, rest = asked()
    scene = evaluator().scene
    planned = judge_picks(scene, grasps, rest, trials)
    return planned, follow_picks(scene, *truth(step_m), trials, planned)


def row_of(result, i):
    return Picked(*(getattr(result, f.name)[i : i + 1] for f in fields(Picked)))


def test_a_belief_that_is_true_is_followed_to_the_same_verdict():
    planned, made = followed()
    assert planned.picked.sum() >= 12
    assert torch.equal(made.picked, planned.picked) and torch.equal(made.reason, planned.reason)
    # the gripper at the grasp is looked at again, and approaches by their depths: never more room than before
    assert (made.margin_m <= planned.margin_m + 1e-6)[planned.picked].all()
    assert ((made.margin_m - planned.margin_m).abs() < 2e-4)[planned.picked].float().mean() > 0.8


@pytest.mark.parametrize("most", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_what_a_wrong_belief_meets_is_what_samples_meet(most):
    seen = Counter()
    trials = asked()[0]
    for step in ((0.0, 0.012), (0.02, 0.0), (-0.04, -0.02)):
        (planned, made), (grasps, rest) = followed(step), truth(step)
        for i in torch.nonzero(planned.picked).flatten().tolist():
            reason = PickReason(int(made.reason[i]))
            seen[reason] += 1
            if seen[reason] > most:
                continue
            twin = PickTwin(evaluator().scene, trials[i : i + 1], grasps[i], rest[i], row_of(made, i))
            assert twin.wrong() == "", (step, i, reason.name)
    assert {PickReason.OK, PickReason.APPROACH_COLLIDES, PickReason.NOTHING_BETWEEN_PADS} <= set(seen), seen


def test_a_path_from_home_that_meets_the_true_object_fails_by_that():
    """The object stands where the path to another one leads."""
    trials, grasps, rest = asked()
    scene, seen = evaluator().scene, 0
    planned, _ = followed()
    for i in each(torch.nonzero(planned.picked).flatten().tolist()[:6]):
        length = int(planned.length[i])
        if length < 2:
            continue
        # on the last part of the path, where the gripper is
        q = (0.4 * planned.path[i, length - 2] + 0.6 * planned.path[i, length - 1])[None].double().numpy()
        at = torch.from_numpy(ee_pose(scene.robot, q)[0, :3, 3]).float()
        there = rest[i : i + 1].clone()
        there[0, :3, 3] = at
        own = row_of(planned, i)
        made = follow_picks(scene, grasps[i : i + 1], there, trials[i : i + 1], own)
        twin = PickTwin(scene, trials[i : i + 1], grasps[i], there[0], own)
        assert twin.way() < 0
        assert not bool(made.picked[0])
        seen += int(made.reason[0]) == int(PickReason.PATH_COLLIDES)
    assert seen >= 3  # the others meet it on the way in first


def test_what_was_not_picked_in_the_belief_stays_as_it_was():
    trials, _, rest = asked()
    scene, (held, there) = evaluator().scene, truth((0.0, 0.05))
    planned = judge_picks(scene, held, there, trials)  # the same grasps, beside the objects
    made = follow_picks(scene, asked()[1], rest, trials, planned)
    out = ~planned.picked
    assert out.sum() > 4
    for f in fields(Picked):
        a, b = (getattr(x, f.name)[out].double().nan_to_num(7) for x in (planned, made))
        assert torch.equal(a, b), f.name


def test_where_nothing_is_seen_nothing_is_between_the_pads():
    scene = evaluator().scene
    found = nothing_to_pick(scene, torch.eye(4).repeat(2, 1, 1))
    assert not found.picked.any() and set(found.reason.tolist()) == {int(PickReason.NOTHING_BETWEEN_PADS)}
    assert (found.margin_m < 0).all() and not found.length.any()


@cache
def carried():
    trials, grasps, _ = asked()
    ev = evaluator()
    T_world_ee = ev.scene.palm(trials.hand_index, trials.T_world_hand)[2]
    normal = ev.scene.palm(trials.hand_index, trials.T_world_hand)[1]
    z = -normal
    x = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand_as(z), z)
    x = x / x.norm(dim=1, keepdim=True)
    poses = torch.eye(4).repeat(len(z), 1, 1)
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = x, torch.linalg.cross(z, x), z
    poses[:, :3, 3] = T_world_ee + 0.06 * normal
    held = attach_object(ev.scene, grasps, poses, trials, ev.config)
    picks = ev.picks(grasps, poses, trials)
    work = Work(ev.scene, ev.config, trials, grasps, poses)
    work.held, work.picked = held, picks
    stages.plan(work)
    plan = work.planned
    return trials, held, plan


def test_a_plan_is_judged_without_the_robot_against_the_person_and_with_what_it_holds():
    trials, held, plan = carried()
    scene, own = evaluator().scene, plan.length > 0
    assert own.sum() >= 8
    made = follow_plans(scene, held, plan, own)
    assert (made.reason[own] == int(PlanReason.OK)).all()
    assert (made.clearance_m[own] >= plan.clearance_m[own] - 2e-4).all()
    # the same paths, and the person where the robot's hand goes
    onto = replace(held, planner_poses=_person_at_the_gripper(held, trials))
    full = path_clearances(scene, onto.planner_poses, plan.path, torch.where(own, plan.length, 0))
    met = own & (full[0] < 0)
    again = follow_plans(scene, onto, plan, own)
    by_robot = met & (full[1] == int(CollidingPair.HAND))
    assert by_robot.sum() >= 4
    alone = without(scene, onto.planner_poses, arm=True, gripper=True, table=True)
    carries = path_clearances(scene, alone, plan.path, torch.where(own, plan.length, 0))[0] < 0
    assert torch.equal((again.reason == int(PlanReason.MOTION_IN_COLLISION)) & own, carries & own)
    assert (by_robot & ~carries).any()  # a robot that meets the person is no fault of Plan
    assert (again.pair[carries & own] == int(CollidingPair.OBJECT_HAND)).all()


def _person_at_the_gripper(held, trials):
    """Hands that stand 12 cm behind the handover pose, along the gripper's axis: the wrist is in them."""
    scene = evaluator().scene
    T = held.T_world_hand.clone()
    T[:, :3, 3] += 0.3 * -held.T_world_ee[:, :3, 2]
    return scene.body_poses(held.objects, held.hands, held.attached, T, held.grasp.opening_m)


def test_rows_that_do_not_begin_have_no_plan():
    trials, held, plan = carried()
    begins = torch.zeros(len(trials), dtype=torch.bool)
    made = follow_plans(evaluator().scene, held, plan, begins)
    none = no_plan(len(trials), plan.path.shape[2], plan.path.device)
    for f in each(fields(Plan)):
        assert torch.equal(getattr(made, f.name), getattr(none, f.name)), f.name


def test_a_scene_with_room_keeps_it_from_hand_and_person_alone():
    ev, room = evaluator(), 0.013
    _, held, plan = carried()
    grown = Scene(ev.benchmark, config=ev.config, hand_room_m=room)
    own = torch.where(plan.length > 0, plan.length, 0)

    def clearances(scene, **leave):
        poses = scene.body_poses(held.objects, held.hands, held.attached, held.T_world_hand, held.grasp.opening_m)
        return path_clearances(scene, without(scene, poses, **leave), plan.path, own)

    before, after = (clearances(s, table=True) for s in (ev.scene, grown))
    near = (own > 0) & (before[0] > room + 2e-3) & (before[0] < 0.045) & (before[1] == after[1])
    near &= (before[1] == int(CollidingPair.HAND)) | (before[1] == int(CollidingPair.OBJECT_HAND))
    assert near.sum() >= 3
    assert torch.allclose(after[0][near], before[0][near] - room, atol=3e-4)
    bare = [clearances(s, person=True)[0] for s in (ev.scene, grown)]
    assert torch.equal(*bare)


def test_planning_by_exact_images_of_known_objects_differs_by_the_room_alone():
    """With no errors and the models known, what planning believes is the truth but for the room about the person."""
    trials, grasps, _ = asked()
    truth = evaluator()
    told = truth.score(grasps, poses_of(trials), trials)
    seen = evaluator(EXACT).score(grasps, poses_of(trials), trials)
    stable, pick = (list(told.criteria).index(x) for x in ("stability", "pick"))
    assert torch.equal(told.margin[:, stable], seen.margin[:, stable])
    same = told.passed[:, pick] == seen.passed[:, pick]
    assert same.float().mean() > 0.9
    reasons = Counter(seen.plan_reason.tolist())
    assert reasons[int(PlanReason.OK)] >= 4
    assert not reasons[int(PlanReason.MOTION_IN_COLLISION)]


def poses_of(trials):
    return carried()[1].T_world_ee


def test_a_row_has_the_same_bits_alone_and_in_a_batch():
    trials, grasps, _ = asked()
    ev = evaluator("cell-v1")
    some = torch.tensor([5, 2, 9, 14])
    T = poses_of(trials)
    whole = ev.score(grasps[some], T[some], trials[some])
    alone = [ev.score(grasps[i : i + 1], T[i : i + 1], trials[i : i + 1]) for i in some.tolist()]
    for name in ("margin", "pick", "outcome", "path", "plan_reason", "q_goal"):
        one = torch.cat(
            [
                getattr(s, name)[:, : getattr(whole, name).shape[1]]
                if getattr(whole, name).ndim > 1
                else getattr(s, name)
                for s in alone
            ]
        )
        assert torch.equal(one.double().nan_to_num(9), getattr(whole, name).double().nan_to_num(9)), name


def test_planning_by_cameras_is_for_benchmarks_that_begin_on_the_table():
    with pytest.raises(ValueError, match="begins with the object in the gripper"):
        Evaluator(load_benchmark("r2h-v2"), plans_in=Sees.parse("cell-v1"))
