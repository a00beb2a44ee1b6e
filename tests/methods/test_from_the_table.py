"""Rules that choose among grasps that the arm can pick from the table (r2h_batch.methods.from_table)."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig, ObjectErrors
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp import close_gripper
from r2h_batch.judge.pick import picked
from r2h_batch.methods import contact, fc, handover_va, intent, learned, oracle, robust
from r2h_batch.methods.believed import known_before
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.from_table import KEPT, MOST_BACK_M, chosen_candidate, first_picked, picked_grasps
from r2h_batch.methods.placing import in_order, least
from r2h_batch.methods.predictors import PredictorNoise, predict_receiving
from r2h_batch.methods.robust import Sizes, holding
from r2h_batch.observe import moments
from r2h_batch.observe.known import KnownMoments, known_moments
from r2h_batch.observe.sees import Sees
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep

METHODS = (fc, handover_va, contact, intent, learned)
EACH = [
    pytest.param(m, marks=[pytest.mark.whole(part="methods")] * (m not in (fc, learned)), id=m.TITLE) for m in METHODS
]
"""The methods that answer by a rule share its code with the first one."""
EXACT = PredictorNoise().scaled(0.0)
N = 8


@cache
def judge():
    return Evaluator(load_benchmark("r2h-v3"), EvalConfig(execute=ExecConfig(sim="none")))


@cache
def trials():
    return judge().benchmark.trials(N)


@cache
def rest():
    return moments(judge().scene, trials())


@cache
def answer(method, on_table=True):
    return method.predict(trials(), judge().scene, noise=EXACT, T_world_obj=rest() if on_table else None)


@cache
def pickable():
    """What the search knows of all trials. It is not changed."""
    return robust.pickable(trials(), judge(), 0)


@cache
def searched():
    """What the search answers for the first trials. It is not changed."""
    return robust.predict(trials()[:4], judge().scene, evaluator=judge(), draws=0, rounds=12)


def is_picked(T_obj_ee, rows):
    return picked(judge().scene, T_obj_ee.contiguous(), rest()[rows], trials()[rows]).picked


@pytest.mark.check
def test_the_order_is_by_the_first_key_then_the_next_then_the_place_and_begins_with_the_least():
    a = torch.tensor([[2.0, 1.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    b = torch.tensor([[0.0, 3.0, 1.0, 0.0, 1.0], [4.0, 3.0, 3.0, 1.0, 2.0]])
    pool = torch.tensor([[1, 1, 1, 0, 1], [1, 1, 1, 0, 0]], dtype=torch.bool)
    order, count = in_order(pool, a, b)
    assert [row[:n] for row, n in zip(order.tolist(), count.tolist())] == [[2, 4, 1, 0], [1, 2, 0]]
    assert sorted(order[1].tolist()) == [0, 1, 2, 3, 4]
    u = torch.from_numpy(np.random.default_rng(0).integers(0, 5, (50, 9)).astype(np.float32))
    allowed = torch.from_numpy(np.random.default_rng(1).random((50, 9)) < 0.5)
    assert torch.equal(in_order(allowed, u)[0][:, 0], least(u, allowed, torch.ones_like(allowed)))


@pytest.mark.parametrize("method", EACH)
def test_rules_take_grasps_that_the_arm_can_pick_and_take_others_when_trials_begin_in_the_gripper(method):
    told, before = (is_picked(answer(method, on).T_obj_ee, slice(None)) for on in (True, False))
    assert told.sum() >= 2 * N - 3 and before.sum() <= told.sum() - 4


def test_no_candidate_that_fcs_rule_ranks_before_its_choice_can_be_picked():
    scene, table = judge().scene, candidate_table(judge().scene)
    found, rows = answer(fc).T_obj_ee, range(0, 2 * N, 3)
    taking = predict_receiving(trials(), scene, seed=0, noise=EXACT)
    before, backs = 0, []
    for i in each(rows):
        own = slice(
            *(int(table.first[trials().object_index[i]]) + k for k in (0, int(table.count[trials().object_index[i]])))
        )
        T = table.T_obj_ee[own]
        along = taking.wrist_to_middle[i].double() / taking.wrist_to_middle[i].double().norm()
        score = (T[:, :3, 2].double() @ along).numpy()
        turned = (T[:, :3, :3] - found[i, :3, :3]).abs().amax((1, 2)) < 1e-6
        off = found[i, :3, 3] - T[:, :3, 3]
        back = -(off * T[:, :3, 2]).sum(1)
        same = turned & ((off + back[:, None] * T[:, :3, 2]).norm(dim=1) < 1e-6) & (back >= -1e-7)
        k = int(torch.nonzero(same)[0])
        backs.append(float(back[k]))
        assert backs[-1] <= MOST_BACK_M
        better = np.flatnonzero(score < score[k] - 1e-9)
        if not len(better):
            continue
        some = torch.full((len(better),), i)
        free = is_picked(T[better], some).numpy()
        hand = fc.candidates_clear_of(scene, table, trials().object_index[i : i + 1], taking.vertices[i : i + 1], 0.0)
        assert not (free & hand[0].numpy()[better]).any()
        before += len(better)
    assert before > 20 and max(backs) > 1e-4


def test_a_learned_pose_holds_the_object_where_the_ranked_pair_did_also_when_the_grasp_is_backed_out(monkeypatch):
    asked = []

    def kept(scene, part, T_world_obj, grasps, order, usable):
        found = first_picked(scene, part, T_world_obj, grasps, order, usable)
        asked.append((grasps, usable, *found))
        return found

    monkeypatch.setattr(learned, "first_picked", kept)
    found = learned.predict(trials(), judge().scene, noise=EXACT, T_world_obj=rest())
    ((grasps, usable, place, T_obj_ee, some),) = asked
    assert torch.equal(found.T_obj_ee, T_obj_ee) and some.sum() >= N and usable.min() > 1
    row = torch.arange(2 * N)
    moved = (T_obj_ee - grasps[row, place]).abs().amax((1, 2)) > 1e-5
    assert moved.any() and place.max() > 0
    # pairs of one candidate: the one that was ranked holds the object elsewhere only by the grasp's own change
    monkeypatch.setattr(learned, "first_picked", lambda *a: (place, grasps[row, place], some))
    unmoved = learned.predict(trials(), judge().scene, noise=EXACT, T_world_obj=rest())
    held = (se3.matmul(x.T_world_ee.double(), se3.inverse(x.T_obj_ee.double())) for x in (found, unmoved))
    assert torch.allclose(*held, atol=1e-6)


@pytest.mark.parametrize("method", EACH)
def test_rows_have_the_same_bits_alone_and_in_any_order(method):
    for rows in each((torch.tensor([5]), torch.tensor([11, 2, 7]))):
        found = method.predict(trials()[rows], judge().scene, noise=EXACT, T_world_obj=rest()[rows])
        assert torch.equal(found.T_obj_ee, answer(method).T_obj_ee[rows])
        assert torch.equal(found.T_world_ee, answer(method).T_world_ee[rows])


def test_of_no_grasp_that_can_be_picked_the_best_stays_as_it_is():
    far = torch.eye(4).repeat(2, 3, 1, 1)
    far[:, :, 2, 3] = torch.tensor([5.0, 6.0, 7.0])
    order = torch.tensor([[1, 0, 2], [2, 1, 0]])
    count = torch.tensor([3, 2])
    _, T, found = first_picked(judge().scene, trials()[:2], rest()[:2], far, order, count)
    assert found.tolist() == [False, False] and T[:, 2, 3].tolist() == [6.0, 7.0]


def test_a_grasp_that_may_not_be_taken_is_not_tried():
    table = candidate_table(judge().scene)
    rows, _ = table.rows(trials().object_index[:1])
    T = table.T_obj_ee[rows]
    free = is_picked(T[0], torch.zeros(T.shape[1], dtype=torch.int64))
    k = int(torch.nonzero(free)[0])
    bad = int(torch.nonzero(~free)[0])
    two = torch.tensor([[bad, k]])
    place, _, _ = first_picked(judge().scene, trials()[:1], rest()[:1], T, two, torch.tensor([2]))
    assert int(place) in (bad, k)
    far = T.clone()
    far[0, bad, :3, 3] += 5.0
    place, T_obj_ee, found = first_picked(judge().scene, trials()[:1], rest()[:1], far, two, torch.tensor([2]))
    assert (int(place), bool(found)) == (k, True) and torch.equal(T_obj_ee[0], far[0, k])
    _, _, found = first_picked(judge().scene, trials()[:1], rest()[:1], far, two, torch.tensor([1]))
    assert not found


def test_of_candidates_that_a_rule_forbids_none_is_taken():
    table = candidate_table(judge().scene)
    rows, exists = table.rows(trials().object_index[:1])
    free = is_picked(table.T_obj_ee[rows[0]], torch.zeros(rows.shape[1], dtype=torch.int64)) & exists[0]
    last = int(torch.nonzero(free)[-1])
    pool = torch.zeros_like(exists)
    pool[0, last] = True
    key = torch.arange(rows.shape[1]).double()[None]
    for there in each((None, rest()[:1])):
        T, _ = chosen_candidate(judge().scene, trials()[:1], there, pool, key)
        assert free.sum() > 1 and torch.equal(T[0], table.T_obj_ee[rows[0, last]])


def test_the_gripper_closes_as_far_as_the_chosen_grasp_lets_it(monkeypatch):
    openings = []
    real = fc.first_fit

    def seen(scene, poses, opening, *more, **options):
        openings.append(opening)
        return real(scene, poses, opening, *more, **options)

    monkeypatch.setattr(fc, "first_fit", seen)
    found = fc.predict(trials(), judge().scene, noise=EXACT, T_world_obj=rest())
    held = close_gripper(judge().scene.grasp_tables, found.T_obj_ee, trials().object_index, w_max=0.085)
    assert torch.equal(torch.cat(openings), held.opening_m)


def test_a_sweep_tells_a_method_where_objects_rest_only_if_trials_begin_there(tmp_path):
    code = tmp_path / "mine.py"
    code.write_text(
        "from pathlib import Path\nimport torch\nfrom r2h_batch.methods.random import predict as at_random\n"
        "def predict(trials, scene, *, seed=0, T_world_obj=None):\n"
        f"    torch.save(T_world_obj, {str(tmp_path / 'told.pt')!r})\n"
        "    return at_random(trials, scene, seed=seed)\n"
    )
    line = ["--method", f"{code}:predict", "--trials", "2", "--execute.sim", "none"]
    for name in each(("r2h-v3", "r2h-v2")):
        assert sweep([*line, "--benchmark", name, "--out", str(tmp_path / name)]) == 0
        told = torch.load(tmp_path / "told.pt")
        if name == "r2h-v2":
            assert told is None
            continue
        run = load_run(tmp_path / name)
        ids = run.trials(run.methods[0])["trial_id"].to_numpy().copy()
        own = judge().benchmark.trials_with_ids(torch.from_numpy(ids))
        assert torch.equal(told, moments(judge().scene, own))


def test_where_objects_rest_is_no_option_of_a_method(tmp_path, capsys):
    assert sweep(["--method", "fc,T_world_obj=1", "--trials", "1", "--out", str(tmp_path / "x")]) == 2
    assert "unknown option 'T_world_obj'" in capsys.readouterr().err


def test_moments_that_were_told_count_for_those_trials_alone():
    known, some = KnownMoments(judge().scene), trials()[:3]
    there = rest()[:1] @ se3.from_rotation(torch.eye(3), torch.tensor([0.01, 0.0, 0.0]))
    assert torch.equal(known.of(some), rest()[:3])
    known.tell(some[:1], there)
    assert torch.equal(known.of(some), torch.cat([there, rest()[1:3]]))
    hand = some.T_world_hand[:1].clone()
    hand[:, 0, 3] += 0.001
    other = replace(some[:1], T_world_hand=hand)
    assert torch.equal(known.of(other), moments(judge().scene, other))


def test_a_search_with_errors_picks_the_object_where_it_lies_wherever_the_hand_is():
    evaluator, some, found = judge(), trials()[:4], searched()
    sizes = Sizes(ObjectErrors(), PredictorNoise())
    held = holding(evaluator, some, found.T_obj_ee, found.T_world_ee, sizes, 3, 0)
    solved = evaluator.score(found.T_obj_ee, found.T_world_ee, some).success
    assert solved.any() and (held[solved] > 0).all()
    told = known_moments(evaluator.scene)
    told._told.clear()
    held = holding(evaluator, some, found.T_obj_ee, found.T_world_ee, sizes, 3, 0)
    assert len({k[:8] for k in told._told}) == 4  # each trial was told, with each drawn hand
    ids = list(some.trial_id.numpy())
    for key, T in each(told._told.items()):
        assert torch.allclose(T, rest()[ids.index(np.frombuffer(key[:8], np.int64)[0])], atol=1e-6)


@pytest.mark.whole(part="methods")
def test_a_search_picks_the_object_where_it_is_told_to_lie_also_with_an_evaluator_of_its_own():
    there = rest()[:6].clone()
    there[:, :3, 3] += torch.tensor([0.03, 0.0, 0.0])
    own = Evaluator(judge().benchmark.until("present"), judge().config)
    some = own.benchmark.trials_with_ids(trials().trial_id[:6])
    told = robust.predict(some, own.scene, evaluator=own, T_world_obj=there, draws=0, rounds=16)
    grasps = picked(own.scene, told.T_obj_ee, there, some).picked
    assert grasps.sum() >= 5
    assert torch.equal(known_moments(own.kinematic.scene).of(some), there)


@pytest.mark.whole(part="methods")
def test_a_search_with_errors_knows_grasps_that_can_be_picked_and_comes_from_above_where_candidates_are_few():
    found, usable = pickable(), oracle.usable_grasps(judge())
    objects, above = trials().object_index.numpy(), 0
    for k in each(range(KEPT)):
        rows = np.flatnonzero(found.count > k)
        T = torch.from_numpy(found.T_obj_ee[rows, k].astype(np.float32))
        assert is_picked(T, torch.from_numpy(rows)).all()
    for i in each(range(2 * N)):
        number, first = int(usable.number[objects[i]]), int(usable.first[objects[i]])
        grasps, draws = (x[i, : found.count[i]] for x in (found.T_obj_ee, found.draw))
        assert len(set(draws.tolist())) == len(draws)  # none is tried twice
        turns = usable.T_obj_ee[first : first + number, :3, :3]
        known = (grasps[:, None, :3, :3].astype(np.float32) == turns).all((2, 3)).any(1)
        assert np.array_equal(known, draws < number)
        down = -grasps[~known, :3, 2] @ rest()[i, 2, :3].double().numpy()
        assert (down > 0.5 - 1e-6).all()
        above += int((~known).sum())
    assert above and (found.count > 0).all() and (found.count == KEPT).any()
    other = robust.pickable(trials(), judge(), 1)
    assert not np.array_equal(other.T_obj_ee[:, 0], found.T_obj_ee[:, 0])


def test_above_is_where_the_vertical_is_of_an_object_that_rests_on_another_side(monkeypatch):
    some, known, asked = trials()[:3], known_moments(judge().scene), []
    c, s = np.cos(1.1), np.sin(1.1)
    tilted = rest()[:3] @ se3.from_rotation(torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]]).float(), torch.zeros(3))
    real = robust.sample_grasps
    monkeypatch.setattr(robust, "sample_grasps", lambda *a, **k: asked.append(k["along"]) or real(*a, **k))
    tilted[:, 0, 3] += 5.0  # out of reach: no candidate can be picked
    known.tell(some, tilted)
    try:
        robust.pickable(some, judge(), 0)
    finally:
        known_moments.cache_clear()  # other tests ask where these objects rest
    down = [T[:3, :3].double().numpy() @ along for T, along in zip(tilted, asked, strict=True)]
    assert np.allclose(down, [0, 0, -1], atol=1e-6)


@pytest.mark.whole(part="methods")
def test_grasps_from_above_are_sampled_once_for_an_object_on_one_side(monkeypatch):
    asked, real = [], robust.sample_grasps
    monkeypatch.setattr(robust, "sample_grasps", lambda *a, **k: asked.append((a[0], *k["along"])) or real(*a, **k))
    found, number = pickable(), oracle.usable_grasps(judge()).number[trials().object_index.numpy()]
    above = (np.arange(KEPT) < found.count[:, None]) & (found.draw >= number[:, None])
    some = trials()[torch.from_numpy(np.flatnonzero(above.any(1))[:2])]
    robust.sampled_along.cache_clear()
    first = robust.pickable(some, judge(), 0)
    once = len(asked)
    again = robust.pickable(some, judge(), 0)
    assert once and len(asked) == once == len(set(asked))
    assert np.array_equal(first.T_obj_ee, again.T_obj_ee) and np.array_equal(first.count, again.count)


@pytest.mark.whole(part="methods")
def test_candidates_of_a_search_with_errors_are_tried_once_each_and_those_with_spare_margins_first(monkeypatch):
    usable, asked = oracle.usable_grasps(judge()), []

    def kept(scene, part, T_world_obj, draw, number, **options):
        asked.append((draw, number))
        return picked_grasps(scene, part, T_world_obj, draw, number, **options)

    monkeypatch.setattr(robust, "picked_grasps", kept)
    robust.pickable(trials(), judge(), 0)
    (draw, number), _ = asked
    objects = trials().object_index.numpy()
    assert np.array_equal(number, usable.number[objects]) and (usable.spare < usable.number)[objects].any()
    for i in each(range(2 * N)):
        own = np.stack([draw(k)[i] for k in range(number[i])]).astype(np.float32)
        margins = oracle.spare_margins(judge(), own, np.full(len(own), objects[i], np.int32))
        n = int(usable.spare[objects[i]])
        assert len(np.unique(own, axis=0)) == len(own)
        assert (margins[:n] >= oracle.MARGIN_M).all() and (margins[n:] < oracle.MARGIN_M).all()


@pytest.mark.whole(part="methods")
def test_grasps_of_a_search_with_errors_are_those_of_a_trial_alone():
    every = pickable()
    for rows in each((torch.tensor([5]), torch.tensor([11, 2, 7, 14]), torch.arange(0))):
        found = robust.pickable(trials()[rows], judge(), 0)
        for name in ("T_obj_ee", "draw", "count"):
            assert np.array_equal(getattr(found, name), getattr(every, name)[rows.numpy()])


def test_errors_are_judged_at_once_where_each_has_a_moment_of_its_own(monkeypatch):
    evaluator, some, found = judge(), trials()[:4], searched()
    solved = torch.nonzero(evaluator.score(found.T_obj_ee, found.T_world_ee, some).success)[:, 0]
    pairs = some[solved], found.T_obj_ee[solved], found.T_world_ee[solved]
    n, calls, real = len(solved), [], type(evaluator).score
    assert n >= 2
    monkeypatch.setattr(type(evaluator), "score", lambda self, *a, **k: calls.append(len(a[0])) or real(self, *a, **k))
    errors = ObjectErrors(0.004, 2.0)
    held = holding(evaluator, *pairs, Sizes(errors, PredictorNoise()), 5, 0)
    exact = holding(evaluator, *pairs, Sizes(errors, EXACT), 3, 0)
    assert calls == [5 * n, n, n, n]  # an exact hand: the draws share a moment
    assert 0 < held.sum() < 5 * n and 0 < exact.sum() < 3 * n
    with monkeypatch.context() as patch:
        patch.setattr(KnownMoments, "tells_apart", lambda self, trials: False)
        assert torch.equal(holding(evaluator, *pairs, Sizes(errors, PredictorNoise()), 5, 0), held)


def test_a_search_with_errors_of_the_object_moves_the_object_and_not_the_gripper(monkeypatch):
    evaluator, some = judge(), trials()[:2]
    found = robust.predict(some, evaluator.scene, evaluator=evaluator, draws=0, rounds=2)
    asked = []
    real = type(evaluator).score
    monkeypatch.setattr(type(evaluator), "score", lambda self, *a, **k: asked.append(a) or real(self, *a, **k))
    sizes = Sizes(ObjectErrors(0.005, 4.0), PredictorNoise())
    holding(evaluator, some, found.T_obj_ee, found.T_world_ee, sizes, 2, 0)
    known = known_moments(evaluator.scene)
    for grasp, _, moved, *_ in each(asked):
        T, still = known.of(moved), rest()[:2].repeat(2, 1, 1)
        assert (T - still).abs().amax((1, 2)).min() > 1e-4
        told = found.T_obj_ee.repeat(2, 1, 1)
        there, told = (se3.matmul(x.double(), y.double()) for x, y in ((T, grasp), (still, told)))
        assert torch.allclose(there, told, atol=1e-6)
    holding(evaluator, some, found.T_obj_ee, found.T_world_ee, Sizes(ObjectErrors(0.005, 4.0), EXACT), 2, 0)
    assert torch.equal(known.of(some), rest()[:2])  # an exact hand: the draws were of these very trials


def test_a_believed_world_asks_for_pick_alone():
    v3 = load_benchmark("r2h-v3")
    own, _ = known_before(v3)
    assert "received" in v3.asks and own.asks == ("pick",) and own.certified is None
    assert known_before(load_benchmark("r2h-v2"))[0].asks == ()


def test_cameras_see_the_object_where_pick_is_judged_whatever_their_seed():
    for seed in each((0, 7)):
        _, T = Sees.parse(f"cell-v1,seed={seed}").look(judge().scene, trials()[:2])
        assert torch.equal(T, rest()[:2])
    v2 = Evaluator(load_benchmark("r2h-v2"))
    some = v2.benchmark.trials(1)
    two = [Sees.parse(f"cell-v1,seed={seed}").look(v2.scene, some)[1] for seed in (0, 7)]
    assert not torch.equal(*two)
