"""Curves over the execution error, of runs made by hand."""

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from made_runs import write_run
from scipy import stats

from r2h_batch.config import EvalConfig
from r2h_batch.report.statistics.intervals import BORROWED
from r2h_batch.sweep.settings import execution_error
from r2h_batch.types import Outcome

sys.path.append(str(Path(__file__).resolve().parents[2] / "bench"))

from _curves import figure, render, robustness

LEVELS, MM = ("0mm,0deg", "5mm,1deg", "20mm,3deg"), np.array([0.0, 5.0, 20.0])
STABILITY, SUCCESS = int(Outcome.STABILITY), int(Outcome.SUCCESS)


@pytest.fixture(scope="module")
def solved():
    """(2 methods, 3 levels, 2 splits, 60 trials): the first loses 0, 25, 50 % and more with the third object."""
    u = np.random.default_rng(3).uniform(size=(2, 2, 60)) + 0.1 * (np.arange(60) % 3)
    return np.stack([[u[0] > 0.0, u[0] > 0.25, u[0] > 0.5], [u[1] > 0.3] * 3])


@pytest.fixture(scope="module")
def runs(tmp_path_factory, solved):
    made = []
    for i, level in enumerate(LEVELS):
        config = asdict(replace(EvalConfig(), execution_error=execution_error(level)))
        codes = np.where(solved[:, i].reshape(2, 120), SUCCESS, STABILITY)
        folder = tmp_path_factory.mktemp("runs") / level
        made.append(write_run(folder, dict(zip("ab", codes, strict=True)), 60, 60, configuration=config))
    return made


@pytest.mark.check
def test_curves_areas_and_losses_are_those_of_the_counted_trials(runs, solved):
    found = robustness(runs)
    assert found.levels == ("0 mm, 0 deg", "5 mm, 1 deg", "20 mm, 3 deg") and found.millimetres == tuple(MM)
    for curve, own in zip(found.curves, solved, strict=True):
        sr = 100 * own.mean((1, 2))
        assert [r.percent for r in curve.sr] == pytest.approx(sr)
        assert curve.area.value == pytest.approx(np.trapezoid(sr, MM) / 20)
        assert [e.value for e in curve.lost] == pytest.approx(sr[0] - sr)
        assert [f["f_stab"].percent for f in curve.failures] == pytest.approx(100 - sr)
        assert curve.failures[0]["f_plan"].percent == 0
    steady = found.curves[1]
    assert steady.area.value == pytest.approx(steady.sr[0].percent) and steady.lost[2].value == 0
    # no trial moved: Tango's interval of each split, 60 trials
    least = stats.norm.ppf(0.975) ** 2 / (60 + stats.norm.ppf(0.975) ** 2)
    assert steady.lost[2].half == pytest.approx(100 * np.hypot(least, least) / 2)


def test_intervals_are_t_intervals_over_objects_of_the_same_trials(runs, solved):
    each = solved[0, 0].astype(int) - solved[0, 2]
    lost = each.reshape(2, 20, 3).mean(1)  # by split and object, of equal size
    varied = [(2 * o.var(ddof=1) + BORROWED * t.var()) / (2 + BORROWED) for o, t in zip(lost, each, strict=True)]
    error = np.sqrt(sum(varied) / 3) / 2
    assert robustness(runs).curves[0].lost[2].half == pytest.approx(100 * stats.t.ppf(0.975, 2) * error)


def test_the_page_has_each_method_at_each_level_and_every_pair(runs):
    found = robustness(runs)
    text = render(found)
    heads = ("SR", "Points of SR lost", "First failures", "Pairs: A-B")
    assert all(f"\n\n{head}\n\n" in f"\n\n{text}" for head in heads) and "20 mm, 3 deg" in text
    (axes,) = figure(found).axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0\n0", "5\n1", "20\n3"]
