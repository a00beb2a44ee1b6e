"""Gradients of Pick's margin in the pose stage, against central differences of the margins themselves."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.observe import moments
from r2h_batch.types import CollidingPair
from r2h_batch.verdicts import PickReason

STEP_M = 2e-4


@cache
def evaluator(asks=("pick",)):
    benchmark = replace(load_benchmark("r2h-v3-draft"), receiver="hand", asks=asks)
    return Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))


@cache
def asked():
    """Trials with a grasp each, of every kind of Pick's reasons here, and a handover pose."""
    ev = evaluator()
    trials = ev.benchmark.trials(24)
    candidates = candidates_of(ev.scene.objects)
    grasps = []
    for i, k in enumerate(trials.object_index.tolist()):
        own = torch.as_tensor(candidates[k].T_obj_ee)
        grasps.append(own[11 * i % len(own)])
    grasps = torch.stack(grasps)
    grasps[::8, :3, 3] += 0.7 * grasps[::8, :3, 1]  # beyond the arm's reach
    palm, normal, _ = ev.scene.palm(trials.hand_index, trials.T_world_hand)
    poses = torch.eye(4).repeat(len(trials), 1, 1)
    poses[:, 1, 1] = poses[:, 2, 2] = -1.0
    poses[:, :3, 3] = palm + 0.15 * normal
    return trials, grasps, poses


def pick_of(ev, grasps, poses, trials):
    scores = ev.score(grasps, poses, trials, stages="pose")
    return scores.margin[:, scores.criteria.index("pick")], scores


@cache
def gradient():
    trials, grasps, poses = asked()
    own = grasps.clone().requires_grad_(True)
    margin, scores = pick_of(evaluator(), own, poses, trials)
    return torch.autograd.grad(margin.sum(), own)[0], margin.detach(), scores


def moved(T, twist, by):
    """T with a motion of its own frame: twist (v, w) times `by`, float64."""
    v, w = by * twist[:3], by * twist[3:]
    K = torch.zeros(3, 3, dtype=torch.float64)
    K[0, 1], K[0, 2], K[1, 0], K[1, 2], K[2, 0], K[2, 1] = -w[2], w[1], w[2], -w[0], -w[1], w[0]
    D = torch.eye(4, dtype=torch.float64)
    D[:3, :3], D[:3, 3] = torch.linalg.matrix_exp(K), v
    return T.double() @ D


def differences(rows):
    """(row, central difference, derivative) of two twists each."""
    trials, grasps, poses = asked()
    found, rng = [], torch.Generator().manual_seed(3)
    for i in rows:
        for _ in range(2):
            twist = torch.randn(6, generator=rng).double() * torch.tensor([1.0, 1, 1, 5, 5, 5])
            both = torch.stack([moved(grasps[i], twist, s * STEP_M) for s in (1, -1)]).float()
            two = torch.tensor([i, i])
            m = pick_of(evaluator(), both, poses[two], trials[two])[0].double()
            along = (moved(grasps[i], twist, 1e-3) - moved(grasps[i], twist, -1e-3)) / 2e-3
            found.append((i, float(m[0] - m[1]) / (2 * STEP_M), float((gradient()[0][i].double() * along).sum())))
    return found


def test_derivatives_are_those_of_differences():
    change, _, scores = gradient()
    reason = scores.pick[:, 0]
    rows = torch.nonzero((change != 0).flatten(1).any(1)).flatten().tolist()
    assert len(rows) >= 12
    assert {int(PickReason.OUT_OF_REACH), int(PickReason.GRASP_COLLIDES)} <= set(reason[rows].tolist())
    good = {}
    for i, fd, own in each(differences(rows)):
        good.setdefault(i, []).append(abs(fd - own) <= 0.02 + 0.03 * abs(fd))
    # depths in the table are lower bounds: where they jump, no difference is a derivative
    assert sum(map(all, good.values())) >= 0.85 * len(good), good
    for why in each((PickReason.OUT_OF_REACH, PickReason.GRASP_COLLIDES)):
        assert any(all(v) for i, v in good.items() if int(reason[i]) == int(why)), why


def test_a_gripper_that_is_nearest_to_a_side_of_the_table_leaves_by_that_side():
    """It points down, its fingertips 30 mm deep in the table, and in x or y some 10 mm of them at one of the table's sides."""
    ev, (trials, _, poses) = evaluator(), asked()
    place, one = ev.scene.config.workplace, trials[:1]
    rest = moments(ev.scene, one).double()

    slopes = []
    for axis, side in each(((0, 1.0), (1, 1.0), (1, -1.0))):  # behind is the robot
        T = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        T[:3, 3] = torch.tensor([0.2, 0.0, place.table_center[2] + place.table_half[2] - 0.022])
        T[axis, 3] = place.table_center[axis] + side * (place.table_half[axis] + (0.005, 0.045)[axis])
        grasp = se3.matmul(se3.inverse(rest), T[None])[0]
        own = grasp[None].float().requires_grad_(True)
        margin, scores = pick_of(ev, own, poses[:1], one)
        assert int(scores.pick[0, 0]) == PickReason.GRASP_COLLIDES and int(scores.pick[0, 1]) == CollidingPair.TABLE
        change = torch.autograd.grad(margin.sum(), own)[0][0].double()
        out = torch.zeros(6, dtype=torch.float64)
        out[:3] = side * T[axis, :3]  # away from the table, in the gripper's frame
        turn = torch.tensor([0.3, -0.5, 0.2, 0.0, 0.0, 0.0], dtype=torch.float64)
        turn[3:] = 6.0 * torch.linalg.cross(out[:3], T[2, :3])  # about the table's edge
        # two parallel faces part by either edge of theirs when they turn
        for twist in (out, turn) if axis == 1 else (out,):
            both = [moved(grasp, twist, s * STEP_M) for s in (1, -1)]
            more, less = (float(pick_of(ev, x[None].float(), poses[:1], one)[0]) for x in both)
            slopes.append(float((change * (both[0] - both[1])).sum()) / (2 * STEP_M))
            assert slopes[-1] == pytest.approx((more - less) / (2 * STEP_M), abs=0.03)
    assert min(slopes[:2] + slopes[3:4]) > 0.9, slopes


def test_a_margin_at_its_cap_has_no_derivative():
    change, margin, _ = gradient()
    capped = margin >= 0.01
    assert capped.any() and not change[capped].any()


def test_margins_are_the_same_bits_with_and_without_a_gradient():
    trials, grasps, poses = asked()
    plain = evaluator().score(grasps, poses, trials, stages="pose")
    assert torch.equal(plain.margin.nan_to_num(7), gradient()[2].margin.detach().nan_to_num(7))


@pytest.mark.parametrize("name", ["reach", "stability", "plan"])
def test_other_margins_change_as_where_nobody_asks_for_pick(name):
    _, grasps, poses = asked()
    found = []
    for asks in each(((), ("pick",), ("pick", "received"))):
        ev = evaluator(asks)
        own = [x.clone().requires_grad_(True) for x in (grasps, poses)]
        scores = ev.score(*own, replace(ev.benchmark.trials(24)), stages="pose")
        margin = scores.margin[:, scores.criteria.index(name)]
        found.append(torch.autograd.grad(margin.nan_to_num(0).sum(), own))
    for other in each(found[1:]):
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
    assert any(x.any() for x in found[0])


def test_torch_compile_gives_the_same_margins_of_all_criteria():
    trials, grasps, poses = asked()
    ev = evaluator()
    found = torch.compile(lambda a, b: 2 * ev.score(a, b, trials[:4], stages="pose").margin)(grasps[:4], poses[:4])
    plain = ev.score(grasps[:4], poses[:4], trials[:4], stages="pose")
    assert found.shape == (4, len(plain.criteria)) and torch.equal(
        found.nan_to_num(7), 2 * plain.margin.nan_to_num(3.5)
    )
