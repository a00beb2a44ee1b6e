"""Intervals over clusters against statsmodels, scipy and constrained likelihoods; their coverage; tables of equal methods."""

import json

import interval_coverage as simulated
import numpy as np
import pytest
import statsmodels.api as sm
from made_runs import command, write_run
from scipy import optimize, stats
from scipy.special import expit, logit

from r2h_batch.report.statistics import paired as pairing
from r2h_batch.report.statistics.aggregate import clustered_rate, wilson_interval
from r2h_batch.report.statistics.intervals import BORROWED, over_clusters, paired_score_interval


def clusters(seed, count=9, n=(20, 60)):
    random = np.random.default_rng(seed)
    total = random.integers(*n, count)
    return random.binomial(total, random.beta(6, 3, count)), total


@pytest.mark.parametrize("seed", range(4))
def test_the_error_of_the_log_odds_is_statsmodels_clustered_one(seed):
    """A logistic regression on a constant, with errors clustered by category."""
    x, n = clusters(seed)
    answers = np.concatenate([np.arange(total) < solved for solved, total in zip(x, n)]).astype(float)
    fit = sm.GLM(answers, np.ones(len(answers)), family=sm.families.Binomial()).fit(
        cov_type="cluster", cov_kwds={"groups": np.repeat(np.arange(len(n)), n), "use_correction": True}
    )
    found = over_clusters([(x, n)])
    p = found.value
    assert logit(p) == pytest.approx(fit.params[0])
    half = stats.t.ppf(0.975, len(n) - 1) * fit.bse[0]
    assert found.half() / (p * (1 - p)) == pytest.approx(half, rel=1e-5)
    assert found.rate_ends() == pytest.approx((expit(logit(p) - half), expit(logit(p) + half)), rel=1e-6)


def test_borrowed_variance_is_that_of_categories_that_are_all_or_nothing():
    x, n = clusters(7)
    p = x.sum() / n.sum()
    own, wide = over_clusters([(x, n)]), over_clusters([(x, n)], p * (1 - p))
    freedom = len(n) - 1
    largest = (
        np.sum(n**2 * p * (1 - p)) / n.sum() ** 2
    )  # the variance of a sum of independent all-or-nothing categories
    expected = (freedom * own.own[0] + BORROWED * largest) / (freedom + BORROWED)
    assert wide.wide[0] == pytest.approx(expected) and wide.own == own.own == own.wide


@pytest.mark.parametrize("few", [None, 1, 4, 50])
def test_no_interval_is_narrower_than_the_one_for_more_trials(few):
    for seed in range(60):
        x, n = clusters(seed, count=2 + seed % 9, n=(1, 40))
        rate = clustered_rate(x, n, few)
        low, high = (100 * end for end in wilson_interval(x.sum(), n.sum()))
        assert rate.low <= low + 1e-9 and high - 1e-9 <= rate.high and 0 <= rate.low <= rate.percent <= rate.high <= 100


def test_the_prediction_interval_is_students_and_becomes_the_one_for_all():
    random = np.random.default_rng(1)
    success = (random.random((2, 8, 50)) < random.uniform(0.2, 0.9, (2, 8, 1))).reshape(2, -1)
    objects = np.repeat(np.arange(8), 50)
    paired = pairing.Paired.of(["a", "b"], np.zeros(400, int), objects, success)
    each = success[0].astype(float) - success[1]
    means = each.reshape(8, 50).mean(1)
    variance = (7 * means.var(ddof=1) + BORROWED * each.var()) / (7 + BORROWED)
    for few in (1, 3, 6):
        (pair,) = pairing.compare(paired, draws=1, few=few)[0].pairs
        half = 100 * stats.t.ppf(0.975, 7) * np.sqrt(variance * (1 / 8 + 1 / few))
        expected = np.clip([pair.difference - half, pair.difference + half], -100, 100)
        assert (pair.few_low, pair.few_high) == pytest.approx(tuple(expected))
        assert pair.few_low < pair.low < pair.high < pair.few_high
    (last,) = pairing.compare(paired, draws=1, few=10**9)[0].pairs
    assert (last.few_low, last.few_high) == pytest.approx((last.low, last.high), abs=1e-5)
    x, n = success[0].reshape(8, 50).sum(1), np.full(8, 50)
    whole, few = clustered_rate(x, n), [clustered_rate(x, n, k) for k in (2, 6, 20, 1000)]
    widths = [r.high - r.low for r in (*few, whole)]
    assert widths == sorted(widths, reverse=True)
    plain = 100 * stats.t.ppf(0.975, 7) * (x / n).std(ddof=1) * np.sqrt(1 / 8 + 1 / 6)
    assert few[1].low <= max(whole.percent - plain, 0) and few[1].high >= min(whole.percent + plain, 100)


def constrained(only_a, only_b, n, delta):
    """The score statistic of a paired difference, its nuisance share found by a search over the likelihood."""
    rest = n - only_a - only_b

    def loss(share):
        cells = np.array([share + delta, share, 1 - 2 * share - delta])
        with np.errstate(divide="ignore"):
            return -float(np.dot([only_a, only_b, rest], np.log(np.maximum(cells, 1e-300))))

    low, high = max(0.0, -delta), (1 - delta) / 2
    share = optimize.minimize_scalar(loss, bounds=(low, high), method="bounded", options={"xatol": 1e-12}).x
    return (only_a - only_b - n * delta) / np.sqrt(n * (2 * share + delta - delta**2))


@pytest.mark.parametrize("counts", [(12, 2, 50), (2, 12, 50), (1, 0, 30), (40, 35, 400), (3, 3, 60)])
def test_at_the_ends_of_the_paired_score_interval_the_score_test_is_at_its_limit(counts):
    low, high = paired_score_interval(*counts)
    z = stats.norm.ppf(0.975)
    assert constrained(*counts, low) == pytest.approx(z, rel=1e-3)
    assert constrained(*counts, high) == pytest.approx(-z, rel=1e-3)
    assert paired_score_interval(counts[1], counts[0], counts[2]) == pytest.approx((-high, -low))


def test_where_no_trial_moves_the_difference_has_an_interval():
    z2 = stats.norm.ppf(0.975) ** 2
    assert paired_score_interval(0, 0, 240) == pytest.approx((-z2 / (240 + z2), z2 / (240 + z2)))
    success = np.stack([np.arange(240) % 4 > 0] * 2)
    for category in ((), ("c0", "c0", "c1", "c1", "c2", "c2")):
        paired = pairing.Paired.of(["a", "b"], np.zeros(240, int), np.arange(240) % 6, success, category=category)
        (pair,) = pairing.compare(paired, draws=1)[0].pairs
        assert (pair.low, pair.high) == pytest.approx((-100 * z2 / (240 + z2), 100 * z2 / (240 + z2)))
        assert (pair.difference, pair.p_new, pair.verdict) == (0, 1, "tied") and pair.few_low < pair.low
    # the ends where all trials differ
    assert paired_score_interval(50, 0, 50)[1] == 1 and 0.8 < paired_score_interval(50, 0, 50)[0] < 1
    assert paired_score_interval(0, 50, 50)[0] == -1


@pytest.mark.parametrize("count", [6, 10, 16])
def test_the_interval_for_all_categories_covers_on_both_sides_quickly(count):
    found = simulated.coverage(*simulated.beta(simulated.BETAS["Beta(8, 2)"]), count, 600)
    assert 93 < found["covers"] < 99 and max(found["below"], found["above"]) < 4.5
    assert found["covers"] > simulated.plain_t(*simulated.beta(simulated.BETAS["Beta(8, 2)"]), count, 600)


def test_a_few_new_categories_lie_in_the_prediction_interval_and_not_in_the_one_for_all():
    draw, truth = simulated.resampled(np.array([r["hits"][2] / r["n"] for r in simulated.COUNTED["rows"]]))
    inside = simulated.coverage(draw, truth, 10, 600, few=6)
    assert inside["covers"] > 92
    random, outside = np.random.default_rng(4), 0
    for _ in range(600):
        rate = clustered_rate(random.binomial(50, draw(random, 10)), np.full(10, 50))
        outside += not rate.low <= 100 * random.binomial(50, draw(random, 6)).mean() / 50 <= rate.high
    assert outside / 600 > 0.15


@pytest.mark.slow
def test_the_intervals_cover_in_every_population():
    """Below 93 % only where the categories measured may show nothing of those that fail."""
    low = {}
    for name, (draw, truth) in simulated.populations(simulated.COUNTED["rows"], simulated.COUNTED["methods"]).items():
        for count in simulated.CATEGORIES:
            found = simulated.coverage(draw, truth, count, 2000, seed=3)
            if found["covers"] < 92:
                low[name, count] = found["covers"]
            assert found["covers"] > simulated.plain_t(draw, truth, count, 2000, seed=3) - 1.5
            assert simulated.coverage(draw, truth, count, 1000, few=6, seed=3)["covers"] > 87
    missing = ("0.8 Beta(18, 2) + 0.2 Beta(2, 8)", "0.7 Beta(18, 2) + 0.3 Beta(4, 6)", "Beta(0.8, 0.2), two humps")
    seldom = ("Handover-VA, all (16)", "Handover-VA, S1 (10)", "Contact-Handover, all (16)")
    assert {name for name, _ in low} <= {*missing, *seldom} and min(low.values()) > 80


def equal_methods(random, methods=4, categories=16, n=50):
    """A table of methods whose rates in each category are drawn from one population: none is better for new ones."""
    rate = random.beta(6, 2, (methods, categories))
    success = random.random((methods, categories, n)) < rate[:, :, None]
    names = [f"m{i}" for i in range(methods)]
    objects = np.repeat(np.arange(categories), n)
    split = (objects >= 6).astype(int)
    return pairing.Paired.of(names, split, objects, success.reshape(methods, -1))


def test_equal_methods_are_seldom_called_different_quickly():
    random = np.random.default_rng(2)
    found = simulated.called([simulated.relabelled(simulated.COUNTED["rows"], random, 4) for _ in range(120)])
    assert found["all"]["corrected"] <= 5 < found["all"]["not corrected"]
    assert found["any"]["corrected"] <= 7 < 15 < found["any"]["not corrected"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["relabelled", "drawn"])
def test_equal_methods_are_called_different_in_at_most_5_percent_of_tables(kind):
    random = np.random.default_rng(5)
    tables = [
        simulated.relabelled(simulated.COUNTED["rows"], random, 4) if kind == "relabelled" else equal_methods(random)
        for _ in range(1500)
    ]
    found = simulated.called(tables)
    assert all(found[group]["corrected"] <= 5 for group in ("S0", "S1", "all"))
    # Holm's correction is that of one table; the three tables of a run together are no family of their own
    assert found["any"]["corrected"] <= 8 < 25 < found["any"]["not corrected"]


def test_a_reader_chooses_how_many_new_categories(tmp_path, capsys):
    random = np.random.default_rng(3)
    write_run(tmp_path / "a", {m: random.choice([0, 2], 120) for m in "mn"}, 60, 60)
    widths = []
    for few in (2, 12):
        assert command("report", tmp_path / "a", format="json", categories=few) == 0
        row = json.loads(capsys.readouterr().out)["rows"][0]
        assert row["few"] == few and row["sr_few_low"] <= row["sr_new_categories_low"] < row["sr_new_categories_high"]
        widths.append(row["sr_few_high"] - row["sr_few_low"])
        assert command("compare", tmp_path / "a", format="json", categories=few) == 0
        pair = json.loads(capsys.readouterr().out)[0]
        assert pair["few"] == few and pair["pairs"][0]["few_low"] < pair["pairs"][0]["low"]
    assert widths[0] > widths[1]
    assert command("report", tmp_path / "a", full=True) == 0 and "SR of 6 new" in capsys.readouterr().out
    assert command("report", tmp_path / "a", format="html", out=tmp_path / "page.html", categories=3) == 0
    assert "SR, of 3 new" in (tmp_path / "page.html").read_text()
    capsys.readouterr()
    for name in ("report", "compare"):
        assert command(name, tmp_path / "a", categories=0) == 2
        assert "--categories is 0; it must be 1 to 10,000" in capsys.readouterr().err
