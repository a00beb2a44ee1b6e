"""Other thresholds from stored margins: exactly what a rerun says, and refused where it would not be."""

import dataclasses

import numpy as np
import pytest
import torch
from made_runs import NAMES, made_trials, make_header, make_scores
from problems import default_evaluator
from rounds import each

from r2h_batch.__main__ import main
from r2h_batch.report.statistics import thresholds as others
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.rows import score_rows
from r2h_batch.types import Outcome

BASE = {"reach_radius_m": 0.10, "w_max_m": 0.085, "safe_margin_m": 0.0}
HEADER = {"configuration": {"name": "default", "thresholds": BASE}}


def scored(trials, distance, width, clearance, thresholds):
    """Scores with float32 margins as `metrics` computes them, Plan and Affordance passing."""
    n = len(trials)
    scores = make_scores(trials, np.zeros(n, int))
    margin = scores.margin.clone()
    margin[:, 0] = torch.minimum(thresholds["w_max_m"] - width, torch.tensor(0.01))  # the open gripper's clearance
    margin[:, 2] = thresholds["reach_radius_m"] - distance
    margin[:, 4] = clearance - thresholds["safe_margin_m"]
    passed = scores.passed.clone()
    passed[:, 0], passed[:, 2], passed[:, 4] = margin[:, 0] >= 0, margin[:, 2] >= 0, margin[:, 4] > 0
    failed = scores.evaluated & ~passed
    outcome = torch.where(failed.any(1), failed.int().argmax(1) + 1, 0).to(torch.int8)
    return dataclasses.replace(scores, margin=margin, passed=passed, outcome=outcome, width_m=width)


def stored(folder, trials, scores):
    run = open_run(folder, make_header(len(trials), 0, **HEADER))
    run.register("m", {})
    with run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, scores, NAMES))
    return load_run(folder)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    trials = made_trials(3000, 3000)
    random = torch.Generator().manual_seed(0)
    distance = 0.2 * torch.rand(6000, generator=random)
    width = 0.12 * torch.rand(6000, generator=random)
    clearance = (0.08 * torch.rand(6000, generator=random) - 0.02).clamp(max=0.05)
    folder = tmp_path_factory.mktemp("rethreshold") / "run"
    run = open_run(folder, make_header(3000, 3000, shard_trials=1000, **HEADER))
    scores = scored(trials, distance, width, clearance, BASE)
    for method, order in (("m", torch.arange(6000)), ("other", torch.randperm(6000, generator=random))):
        run.register(method, {"kind": "test"})
        shuffled = scores if method == "m" else scored(trials, distance[order], width[order], clearance, BASE)
        for shard in run.todo(method):
            rows = slice(shard.first, shard.last)
            with run.write(method, shard) as writer:
                writer.append(trials=score_rows(trials[rows], shuffled[rows], NAMES))
    return load_run(folder), trials, distance, width, clearance


def test_every_setting_counts_what_scoring_with_it_counts(made):
    run, trials, distance, width, clearance = made
    radii, widths = (0.02, 0.08, 0.1, 0.12), (0.03, 0.07, 0.085)
    grid = {"reach_radius_m": radii, "w_max_m": widths, "safe_margin_m": (0.0, 0.004, 0.045)}
    points = others.rethreshold(run, **grid)
    assert len(points) == 4 * 3 * 3
    seen = set()
    for point in points:
        thresholds = {k: getattr(point, k) for k in grid}
        outcome = scored(trials, distance, width, clearance, thresholds).outcome.numpy()
        expected = np.stack(
            [np.bincount(outcome[part], minlength=len(OUTCOME_NAMES)) for part in (slice(0, 3000), slice(3000, 6000))]
        )
        assert np.array_equal(point.counts["m"], expected), thresholds
        assert point.undecided["m"] == 0
        seen.add(point.counts["m"].tobytes())
    assert len(seen) == 36  # every threshold matters


def test_a_grasp_that_fails_for_another_reason_than_its_width_still_fails(tmp_path):
    trials = made_trials(2, 0)
    scores = scored(trials, torch.zeros(2), torch.tensor([0.01, 0.02]), torch.full((2,), 0.05), BASE)
    scores.margin[0, 0] = -0.002  # the open fingers cut in
    scores.passed[0, 0], scores.outcome[0] = False, int(Outcome.STABILITY)
    run = stored(tmp_path, trials, scores)
    for w_max in (0.085, 0.08, 0.03):
        (point,) = others.rethreshold(run, w_max_m=[w_max])
        assert point.counts["m"][0, Outcome.STABILITY] == 1 and point.counts["m"][0, Outcome.SUCCESS] == 1


def test_a_trial_on_the_threshold_is_counted_as_undecided(tmp_path):
    trials = made_trials(2, 0)
    scores = scored(trials, torch.tensor([0.03, 0.06]), torch.full((2,), 0.01), torch.full((2,), 0.05), BASE)
    (point,) = others.rethreshold(stored(tmp_path, trials, scores), reach_radius_m=[0.03])
    assert point.undecided["m"] == 1


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        ({"w_max": "0.09"}, ["--w-max 0.09", "allowed is 0 to 0.085", "sweep again"]),
        ({"safe_margin": "0.06"}, ["--safe-margin 0.06", "0 to 0.0499"]),
        ({"reach_radius": "-.1"}, ["--reach-radius -0.1"]),
        ({"reach_radius": "nan"}, ["LOW:HIGH:STEP"]),
    ],
)
def test_what_cannot_be_rescored_exactly_is_refused_with_what_can(made, capsys, flags, parts):
    run, *_ = made
    line = [f"--{flag.replace('_', '-')}={value}" for flag, value in flags.items()]
    assert main(["results", "rethreshold", str(run.folder), *line]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    for part in parts:
        assert part in captured.err


@pytest.mark.slow
def test_rescoring_is_a_rerun_of_the_real_evaluator(tmp_path):
    from r2h_batch import Evaluator, load_benchmark
    from r2h_batch.config import Thresholds
    from r2h_batch.methods import random as method
    from r2h_batch.sweep.rows import TrialNames

    n = 150
    trials = load_benchmark("r2h-v0").trials(n)
    changes = {"reach_radius_m": (0.06, 0.1, 0.2), "w_max_m": (0.02, 0.05, 0.085), "safe_margin_m": (0.0, 0.01, 0.03)}
    evaluator = default_evaluator()
    predictions = method.predict(trials, evaluator.scene, seed=0)
    scene = evaluator.scene
    names = TrialNames([o.name for o in scene.objects], [o.split for o in scene.objects], ["right"] * 400)
    scores = evaluator.score(predictions.T_obj_ee, predictions.T_world_ee, trials)
    run = open_run(tmp_path, make_header(n, n, **{"configuration": dataclasses.asdict(evaluator.config)}))
    run.register("random", {})
    with run.write("random", *run.todo("random")) as writer:
        writer.append(trials=score_rows(trials, scores, names))
    for radius, width, safe in each(zip(*changes.values())):
        thresholds = Thresholds(reach_radius_m=radius, w_max_m=width, safe_margin_m=safe)
        again = Evaluator(dataclasses.replace(load_benchmark("r2h-v0"), thresholds=thresholds))
        same = trials.named(again.scene.objects)
        outcome = again.score(predictions.T_obj_ee, predictions.T_world_ee, same).outcome.numpy()
        grid = {"reach_radius_m": [radius], "w_max_m": [width], "safe_margin_m": [safe]}
        (point,) = others.rethreshold(load_run(tmp_path), **grid)
        expected = np.stack(
            [np.bincount(outcome[part], minlength=len(OUTCOME_NAMES)) for part in (slice(0, n), slice(n, 2 * n))]
        )
        assert np.array_equal(point.counts["random"], expected)
        assert point.undecided["random"] == 0
