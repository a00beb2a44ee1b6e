"""The study kit: correlations and tests against scipy and statsmodels."""

import csv
from itertools import combinations

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multitest import multipletests

from r2h_batch.__main__ import main
from r2h_batch.sweep.study import report as study

METHODS = ("w", "x", "y", "z")


def test_rank_correlation_is_scipys_with_its_exact_p_value():
    random = np.random.default_rng(0)
    for n in (3, 4, 5):
        x, y = random.random(n), np.round(random.random(n), 1)
        found = study.spearman(x, y, counts=(500, 150))
        assert found.rho == pytest.approx(stats.spearmanr(x, y).statistic)
        exact = stats.permutation_test(
            (x,), lambda a, y=y: stats.spearmanr(a, y).statistic, permutation_type="pairings", n_resamples=np.inf
        )
        assert found.p == pytest.approx(exact.pvalue)


def test_rating_tests_are_scipys_and_statsmodels():
    rows = np.random.default_rng(2).integers(1, 6, (30, 4)) + np.array([0, 0, 0, 1])
    found = study.rating_tests(rows.clip(1, 5), METHODS)
    expected = stats.friedmanchisquare(*rows.clip(1, 5).T)
    assert (found.chi2, found.p) == pytest.approx((expected.statistic, expected.pvalue))
    raw = [stats.wilcoxon(*rows.clip(1, 5)[:, pair].T).pvalue for pair in combinations(range(4), 2)]
    assert [p for *_, p, _ in found.pairs] == pytest.approx(raw)
    assert [p for *_, p in found.pairs] == pytest.approx(multipletests(raw, method="bonferroni")[1])


def write_csv(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def ratings():
    random = np.random.default_rng(5)
    return [
        {"participant": p, "method": m, "dimension": d, "rating": int(random.integers(1, 6))}
        for p in range(12)
        for m in METHODS
        for d in ("comfort", "trust")
    ]


def test_your_own_ratings_are_tested_and_incomplete_participants_counted(tmp_path, capsys):
    rows = [r for r in ratings() if not (r["participant"] == 3 and r["method"] == "x" and r["dimension"] == "trust")]
    file = write_csv(tmp_path / "r.csv", rows)
    assert main(["study", "ratings", str(file)]) == 0
    text = capsys.readouterr().out
    assert "comfort: 12 complete participants, 0 left out" in text
    assert "trust: 11 complete participants, 1 left out" in text
    table, methods, _ = study.read_ratings(file)["comfort"]
    expected = [[r["rating"] for r in rows if r["participant"] == p and r["dimension"] == "comfort"] for p in range(12)]
    assert methods == list(METHODS) and table.tolist() == expected


@pytest.mark.check
def test_your_own_robot_against_a_run(paper_rows, tmp_path, capsys):
    run = paper_rows
    names = ("FC-Handover", "Handover-VA", "Contact-Handover", "Intent-Handover")
    rows = [{"method": m, "real_sr": sr, "real_t_tot_s": 13.0} for m, sr in zip(names, (63.3, 60.0, 56.7, 73.3))]
    file = write_csv(tmp_path / "real.csv", rows)
    assert main(["study", "real", str(run.folder), str(file), "--trials", "150"]) == 0
    text = capsys.readouterr().out
    assert "-9.5" in text and "+5.4" in text and "+0.40" in text
    write_csv(file, [{**rows[0], "method": "Nobody"}])
    assert main(["study", "real", str(run.folder), str(file), "--trials", "150"]) == 2
    assert "no method 'Nobody'" in capsys.readouterr().err
