"""Cochran's Q by strata against statsmodels and scipy, and under the null."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.contingency_tables import cochrans_q

from r2h_batch.report.statistics.cochran import stratified_cochran


@pytest.mark.parametrize("treatments", [2, 3, 5])
def test_one_stratum_is_statsmodels_test(treatments):
    random = np.random.default_rng(treatments)
    success = random.random((treatments, 80)) < np.linspace(0.4, 0.7, treatments)[:, None]
    expected = cochrans_q(success.T.astype(int), return_object=True)
    found = stratified_cochran(success, np.zeros(80, int))
    assert (found.q, found.p, found.freedom) == pytest.approx((expected.statistic, expected.pvalue, expected.df))


def test_strata_add_up_and_moves_of_opposite_sign_do_not_cancel():
    random = np.random.default_rng(0)
    rate = np.repeat([[0.2, 0.8], [0.8, 0.2]], 60, axis=1)
    success = random.random((2, 120)) < rate
    stratum = np.repeat([3, 7], 60)
    parts = [cochrans_q(success[:, stratum == k].T.astype(int), return_object=True) for k in (3, 7)]
    found = stratified_cochran(success, stratum)
    assert found.q == pytest.approx(sum(p.statistic for p in parts)) and found.freedom == 2
    assert found.p == pytest.approx(stats.chi2.sf(found.q, 2)) and found.p < 1e-6
    assert stratified_cochran(success, np.zeros(120, int)).p > 0.05


def test_where_no_trial_differs_nothing_is_found():
    same = np.stack([np.arange(30) % 3 > 0] * 4)
    assert stratified_cochran(same, np.arange(30) % 5).p == 1
    one = same.copy()
    one[2, 4] ^= True  # a stratum with one trial that differs says nothing about which treatment
    found = stratified_cochran(one, np.arange(30) % 5)
    assert (found.freedom, found.q) == (3, pytest.approx(3))


def test_frames_that_change_nothing_but_chance_are_seldom_found():
    """Trials of 16 categories that succeed or not in each of four frames by chance alone, many of them always."""
    random, hits = np.random.default_rng(1), 0
    stratum = np.arange(240) % 16
    for _ in range(400):
        rate = np.where(random.random(240) < 0.6, 1.0, random.random(240))
        hits += stratified_cochran(random.random((4, 240)) < rate, stratum).p < 0.05
    assert hits / 400 < 0.07


def test_of_few_trials_the_p_value_is_that_of_permutations():
    """Three trials in which the same one of four treatments fails: 4 of 4^3 ways, which chi-squared takes for half as many."""
    success = np.ones((4, 12), bool)
    success[2, :3] = False
    found = stratified_cochran(success, np.zeros(12, int))
    assert found.q == pytest.approx(9) and stats.chi2.sf(9, 3) < 0.03
    assert found.p == pytest.approx(4 / 64, abs=0.01)
