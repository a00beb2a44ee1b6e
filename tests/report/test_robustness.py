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

from _curves import figure, robustness

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
def test_curves_and_areas_are_those_of_the_counted_trials(runs, solved):
    found = robustness(runs)
    assert found.levels == ("0 mm, 0 deg", "5 mm, 1 deg", "20 mm, 3 deg") and found.millimetres == tuple(MM)
    for curve, own in zip(found.curves, solved, strict=True):
        sr = 100 * own.mean((1, 2))
        assert [r.percent for r in curve.sr] == pytest.approx(sr)
        assert curve.area.value == pytest.approx(np.trapezoid(sr, MM) / 20)
    steady = found.curves[1]
    assert steady.area.value == pytest.approx(steady.sr[0].percent)


def test_intervals_are_t_intervals_over_objects_of_the_same_trials(runs, solved):
    mean = np.trapezoid(solved[0].astype(float), MM, axis=0) / 20  # of the SR over the error, by split and trial
    of_object = mean.reshape(2, 20, 3).mean(1)  # of equal size
    spread = [p * (1 - p) for p in mean.mean(1)]
    varied = [(2 * o.var(ddof=1) + BORROWED * v) / (2 + BORROWED) for o, v in zip(of_object, spread, strict=True)]
    error = np.sqrt(sum(varied) / 3) / 2
    assert robustness(runs).curves[0].area.half == pytest.approx(100 * stats.t.ppf(0.975, 2) * error)


def test_the_picture_has_each_level(runs):
    (axes,) = figure(robustness(runs)).axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0\n0", "5\n1", "20\n3"]
