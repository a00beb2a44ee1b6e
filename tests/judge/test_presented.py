"""Presented: its margin made again in float64, what it is about, where it counts and where it does not; Upright."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from presented_twin import again
from problems import default_evaluator
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.methods import oracle
from r2h_batch.methods import random as random_method
from r2h_batch.scene.objects import turned, without_region
from r2h_batch.types import Nearer, Outcome
from r2h_batch.verdicts import MAY_ASK


def judged(name: str, trials: int = 48):
    """Random poses, those of the oracle, and these a few centimetres and degrees off."""
    evaluator = default_evaluator(name)
    of = load_benchmark(name).trials(trials // 2)
    asked = random_method.predict(of, evaluator.scene)
    best = oracle.predict(of, evaluator.scene, evaluator=evaluator, rounds=1)
    g = torch.Generator().manual_seed(0)
    near = best.T_world_ee.clone()
    near[:, :3, 3] += 0.04 * torch.randn(len(of), 3, generator=g)
    for T_obj_ee, T_world_ee in (
        (asked.T_obj_ee, asked.T_world_ee),
        (best.T_obj_ee, best.T_world_ee),
        (best.T_obj_ee, near),
    ):
        found = replace(asked, T_obj_ee=T_obj_ee, T_world_ee=T_world_ee)
        yield evaluator.scene, of, found, evaluator.score(T_obj_ee, T_world_ee, of, stages="pose")


@pytest.mark.check
@pytest.mark.parametrize("name", ["r2h-v2", pytest.param("r2h-v1", marks=pytest.mark.slow), "r2h-v0"])
def test_margins_words_and_tilts_are_those_of_the_twin(name):
    seen = set()
    for scene, trials, asked, scores in judged(name):
        for i in each(range(len(trials))):
            twin, margin = again(scene, trials, asked, scores, i), float(scores.presented_margin_m[i])
            assert margin == pytest.approx(twin.margin, abs=3e-5), i
            by = int(scores.presented_by[i])
            if by != twin.by:  # two of the three are as near
                ahead = twin.room + np.array([twin.gripper, twin.sharp]) - twin.wanted
                assert np.sort([twin.in_ball, *ahead])[1] == pytest.approx(twin.margin, abs=1e-4)
            if abs(twin.margin) > 1e-4:
                assert bool(scores.presented[i]) == (twin.margin >= 0)
            assert float(scores.tilt_deg[i]) == pytest.approx(twin.tilt, abs=0.05, nan_ok=True)
            seen.add((by, bool(scores.presented[i])))
    assert {(by, passes) for by in (Nearer.BALL, Nearer.GRIPPER) for passes in (True, False)} <= seen
    assert any(by == Nearer.SHARP for by, _ in seen)


@pytest.fixture(scope="module")
def rows():
    """Poses of r2h-v2, judged without Presented and with it."""
    plain = load_benchmark("r2h-v2")
    trials = plain.trials(32)
    asked = random_method.predict(trials, default_evaluator("r2h-v2").scene)
    best = oracle.predict(trials, default_evaluator("r2h-v2").scene, evaluator=default_evaluator("r2h-v2"), rounds=1)
    poses = [torch.cat([getattr(p, k) for p in (asked, best)]) for k in ("T_obj_ee", "T_world_ee")]
    trials = trials[torch.arange(2 * len(trials)) % len(trials)].named(plain.objects)  # of both benchmarks
    with_it = Evaluator(replace(plain, asks=("presented",)), threads=1)
    return trials, poses, default_evaluator("r2h-v2"), with_it


def test_a_benchmark_that_asks_for_it_alone_has_one_column_more_and_fails_what_it_refuses(rows):
    trials, poses, plain, with_it = rows
    before, after = (e.score(*poses, trials, stages="pose") for e in (plain, with_it))
    assert after.criteria == (*before.criteria, "presented") and "presented" not in before.criteria
    for name in ("passed", "evaluated", "margin", "margin_kind"):
        assert torch.equal(getattr(after, name)[:, :-1].nan_to_num(), getattr(before, name).nan_to_num()), name
    judged = before.outcome < int(Outcome.INVALID_INPUT)
    assert torch.equal(after.margin[:, -1][judged], before.presented_margin_m[judged])
    assert torch.equal(after.passed[:, -1], before.presented) and torch.equal(after.evaluated[:, -1], judged)
    lost = before.success & ~before.presented
    assert 0 < lost.sum() < before.success.sum()
    assert torch.equal(after.failed("presented"), lost) and torch.equal(after.success, before.success & ~lost)
    assert torch.equal(after.outcome[~lost], before.outcome[~lost])


def test_what_ranks_and_learns_sees_it(rows):
    from r2h_batch.training.reward import first_failure, margin_vector, quality

    trials, poses, plain, with_it = rows
    before, after = (e.score(*poses, trials, stages="pose") for e in (plain, with_it))
    lost = after.failed("presented")
    assert margin_vector(after).shape[1] == 6 and (first_failure(after)[lost] == 5).all()
    assert torch.equal(first_failure(after)[~lost], first_failure(before)[~lost])
    assert (quality(after)[lost] < 0).all() and (quality(before)[lost] > 0).all()
    soft = [s.soft(temperature_m=0.01) for s in (before, after)]
    assert (soft[1][lost] <= 0.5).all() and (soft[0][lost] > 0.5).all()
    text = after.summary()
    assert "presented" in text and "passed/presented" in after.scalars() and "outcome/presented" in after.scalars()
    assert "outcome/pick" not in after.scalars()


def test_its_gradient_is_the_slope_of_its_margin(rows):
    """Along the way to the palm, the ball and turns: differences of the twin's own kind, with another step."""
    from r2h_batch.base import se3, twist

    trials, (T_obj_ee, T_world_ee), _, with_it = rows
    few = torch.arange(0, len(trials), 8)
    trials, T_obj_ee, T_world_ee = trials[few], T_obj_ee[few], T_world_ee[few]
    T = T_world_ee.clone().requires_grad_()
    with_it.score(T_obj_ee, T, trials, stages="pose").margin[:, -1].sum().backward()

    def margin(step: torch.Tensor) -> torch.Tensor:
        moved = twist.retract(T_world_ee, step.expand(len(few), 6))
        return with_it.score(T_obj_ee, moved, trials, stages="pose").presented_margin_m

    agreed = 0
    for k in range(6):
        size = 3e-3 if k < 3 else 3e-2
        step = torch.zeros(6)
        step[k] = size / 2
        slope = (margin(step) - margin(-step)) / size
        unit = torch.zeros(6)
        unit[k] = 1e-3
        along = se3.matmul(T_world_ee, twist.retract(torch.eye(4)[None], unit[None])) - T_world_ee
        found = (T.grad[:, :3] * along[:, :3]).sum((1, 2)) / 1e-3
        agreed += int((found - slope).abs().lt(0.1).sum())
    assert T.grad.isfinite().all() and agreed > 0.9 * 6 * len(few)


def test_captured_and_compiled_calls_have_it_too(rows):
    trials, poses, _, with_it = rows
    trials, poses = trials[:8], [T[:8] for T in poses]
    direct = with_it.score(*poses, trials, stages="pose")
    captured = with_it.capture(8)(*poses, trials)
    assert torch.equal(captured.margin.nan_to_num(), direct.margin.nan_to_num())
    assert captured.criteria == direct.criteria
    assert torch.equal(captured.presented_margin_m, direct.presented_margin_m)

    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(T_obj_ee, T_world_ee):
        scores = with_it.score(T_obj_ee, T_world_ee, trials, stages="pose")
        return scores.margin, scores.presented_by, scores.soft(temperature_m=0.01)

    margin, by, soft = compiled(*poses)
    assert torch.equal(margin.nan_to_num(), direct.margin.nan_to_num()) and torch.equal(by, direct.presented_by)
    assert torch.equal(soft, direct.soft(temperature_m=0.01))


def test_which_criteria_go_together_and_what_a_digest_knows():
    v2, v3 = load_benchmark("r2h-v2"), load_benchmark("r2h-v3")
    assert v2.asks == () and v3.asks == ("pick", "presented", "received") and ("presented",) in MAY_ASK
    for asks in (("presented", "pick"), ("received",), ("presented", "received"), ("presented", "presented")):
        with pytest.raises(ValueError, match="received with pick"):
            replace(v2, asks=asks)
    assert v3.until("present").asks == ("pick", "presented") and v3.until("received").asks == v3.asks
    with pytest.raises(ValueError, match="until 'present' needs pick"):
        replace(v2, asks=("presented",)).until("present")
    asked = replace(v2, asks=("presented",))
    blunt = tuple(replace(o, sharp=()) for o in v2.objects)
    assert asked.digest != v2.digest == replace(v2, objects=blunt).digest  # only who asks has the role in its digest
    assert replace(asked, objects=blunt).digest != asked.digest


def test_what_is_sharp_and_up_goes_along_with_an_object(tmp_path):
    objects = {o.name: o for o in load_benchmark("r2h-v1").objects}
    sharp = {n: o.sharp for n, o in objects.items() if o.sharp}
    assert sharp == {"knife": ("blade",), "screwdriver": ("tip",), "scissors": ("blade",), "power_drill": ("bit",)}
    assert {n for n, o in objects.items() if o.up is not None} == {"cup", "bowl", "wineglass"}
    instances = {o.name.rpartition("_")[0] for o in load_benchmark("r2h-v2").objects if o.sharp}
    assert instances == set(sharp)
    R = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert np.allclose(turned(objects["cup"], R).up, R @ objects["cup"].up) and objects["cup"].up[2] > 0.99
    assert without_region(objects["knife"]).sharp == ("blade",) and objects["knife"].sharp_face.sum() == 210


def test_a_file_asks_for_it_and_says_what_is_sharp_and_where_a_vessel_opens(tmp_path):
    import trimesh

    from r2h_batch.base.errors import FileError

    mesh = trimesh.util.concatenate([trimesh.creation.box((0.02, 0.02, 0.1)), trimesh.creation.box((0.01, 0.01, 0.12))])
    trimesh.boolean.union(mesh.split()).export(tmp_path / "awl.obj")
    labels = np.zeros(len(trimesh.load(tmp_path / "awl.obj").faces), np.int64)
    labels[:8] = 1
    np.save(tmp_path / "parts.npy", labels)
    entry = "{file: awl.obj, parts: parts.npy, part_names: [grip, spike], roles: {spike: sharp}, up: [0, 3, 4]}"
    (tmp_path / "mine.yaml").write_text(f"objects: [{entry}]\nasks: [presented]\n")
    benchmark = load_benchmark(str(tmp_path / "mine.yaml"))
    (awl,) = benchmark.objects
    assert benchmark.asks == ("presented",) and awl.sharp == ("spike",) and awl.roles is None
    assert awl.sharp_face.any() and np.allclose(awl.up, (0, 0.6, 0.8))
    for word, said in (("asks: [presented, pick]", "received with pick"), ("asks: [taken]", "asks.0 is 'taken'")):
        (tmp_path / "mine.yaml").write_text(f"objects: [{entry}]\n{word}\n")
        with pytest.raises(FileError, match=said):
            load_benchmark(str(tmp_path / "mine.yaml"))
    (tmp_path / "mine.yaml").write_text(f"objects: [{entry.replace('[0, 3, 4]', '[0, 0, 0]')}]\n")
    with pytest.raises(FileError, match="up is"):
        load_benchmark(str(tmp_path / "mine.yaml"))
