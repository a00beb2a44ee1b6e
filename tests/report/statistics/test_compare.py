"""Paired comparisons against statsmodels, by simulation, and what is refused."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from made_runs import command, write_run
from scipy import stats
from statsmodels.stats.contingency_tables import mcnemar as reference_mcnemar
from statsmodels.stats.multitest import multipletests

from r2h_batch.report.compare import text as text_of
from r2h_batch.report.statistics import intervals
from r2h_batch.report.statistics import paired as pairing
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.report.statistics.intervals import BORROWED
from r2h_batch.report.statistics.paired import Paired
from r2h_batch.runs.store import Run, load_run


def paired(success, objects, split=None, category=()):
    success = np.asarray(success, bool)
    n = success.shape[1]
    split = np.zeros(n, int) if split is None else np.asarray(split)
    names = [f"m{i}" for i in range(len(success))]
    return Paired.of(names, split, np.asarray(objects), success, category=category)


FAMILIES = [f"c{i // 4}" for i in range(24)]
"""Categories of 24 objects, four of each."""


def in_families(spread, seed=5, n=25):
    """Two methods on six categories of four objects; the difference varies by `spread` between categories."""
    random = np.random.default_rng(seed)
    rate = np.stack([0.5 + 0.08 + np.repeat(random.normal(0, spread, 6), 4), np.full(24, 0.5)]).clip(0, 1)
    success = random.random((2, 24, n)) < rate[:, :, None]
    return success.reshape(2, -1), np.repeat(np.arange(24), n)


@pytest.mark.parametrize("counts", [(0, 0), (1, 0), (5, 5), (3, 17), (40, 60), (0, 9), (200, 260)])
def test_mcnemar_is_statsmodels_exact_test(counts):
    expected = reference_mcnemar([[7, counts[0]], [counts[1], 11]], exact=True).pvalue
    assert pairing.mcnemar(*counts) == pytest.approx(min(expected, 1.0), rel=1e-12)


def test_methods_with_equal_rates_share_their_ranks_evenly():
    draws = np.array([[0.5, 0.5, 0.2], [0.4, 0.6, 0.6], [0.3, 0.3, 0.3], [0.1, 0.2, 0.3]])
    expected = np.zeros((3, 3))
    for rates in draws:  # scipy's ranks: the first and the last that a method may have
        first, last = (stats.rankdata(-rates, method=m).astype(int) for m in ("min", "max"))
        for i in range(3):
            expected[i, first[i] - 1 : last[i]] += 1 / (last[i] - first[i] + 1) / len(draws)
    assert pairing.rank_probabilities(draws) == pytest.approx(expected, abs=1e-15)
    assert expected[0].tolist() == pytest.approx([0.5 / 4 + 1 / 12, 0.5 / 4 + 1 / 12, 1 / 4 + 1 / 12 + 1 / 4])


def test_holm_is_statsmodels_holm():
    random = np.random.default_rng(0)
    for n in (1, 2, 6, 15):
        p = random.random(n) ** 3
        p[: n // 3] = p[0]
        assert pairing.holm(p) == pytest.approx(multipletests(p, method="holm")[1], abs=1e-15)


def test_the_difference_and_the_discordant_trials_are_counted_on_the_same_trials():
    a = np.array([1, 1, 1, 0, 0, 1, 1, 0], bool)
    b = np.array([1, 0, 0, 0, 1, 1, 0, 0], bool)
    (c,) = pairing.compare(paired([a, b], np.arange(8) % 4))
    (pair,) = c.pairs
    assert (pair.only_a, pair.only_b, pair.difference) == (3, 1, 25.0)
    assert pair.p == pair.p_holm == pytest.approx(stats.binomtest(3, 4).pvalue)
    assert c.rates == (62.5, 37.5)


@pytest.mark.parametrize("splits", [1, 2])
def test_the_interval_for_new_objects_covers_the_truth_and_knows_no_seed(splits):
    """Methods whose difference varies by object: 16 drawn objects, the truth is the mean over all objects."""
    random = np.random.default_rng(2)
    hits, plain = 0, 0
    runs, k, n = 300, 16, 40
    split = np.repeat(np.arange(k) * splits // k, n)
    for _ in range(runs):
        rate = random.normal(0.55, 0.12, (2, k)).clip(0.02, 0.98)
        success = (random.random((2, k, n)) < rate[:, :, None]).reshape(2, -1)
        own = paired(success, np.repeat(np.arange(k), n), split)
        pair, again = (pairing.compare(own, draws=2, seed=seed)[-1].pairs[0] for seed in (0, 1))
        assert pair == again
        hits += pair.low <= 0 <= pair.high
        plain += pair.p >= 0.05
    assert 0.93 < hits / runs < 0.975
    assert plain / runs < 0.85  # McNemar speaks about these objects only and says so


def by_hand(success, clusters):
    """The t interval of a difference, and p of its test, from the clusters' own differences and the largest spread."""
    each = success[0].astype(float) - success[1]
    means = each.reshape(clusters, -1).mean(1)
    largest, freedom = each.var(), clusters - 1
    variance = (freedom * means.var(ddof=1) + BORROWED * largest) / (freedom + BORROWED) / clusters
    low, high = stats.t.interval(0.95, freedom, loc=means.mean(), scale=variance**0.5)
    return 100 * low, 100 * high, 2 * stats.t.sf(abs(means.mean()) / variance**0.5, freedom)


def test_the_interval_of_one_split_is_the_t_interval_of_the_objects_differences():
    success = np.random.default_rng(3).random((2, 12 * 30)) < [[0.6], [0.4]]
    (pair,) = pairing.compare(paired(success, np.repeat(np.arange(12), 30)), draws=2)[0].pairs
    low, high, p = by_hand(success, 12)
    assert (pair.low, pair.high) == pytest.approx((low, high), abs=1e-9)
    assert pair.p_new == pair.p_new_holm == pytest.approx(max(p, pair.p))


def test_with_families_the_interval_is_the_t_interval_of_the_categories_differences():
    success, objects = in_families(0.2)
    (c,) = pairing.compare(paired(success, objects, category=FAMILIES), draws=2)
    low, high, p = by_hand(success, 6)
    assert (c.pairs[0].low, c.pairs[0].high) == pytest.approx((low, high), abs=1e-9)
    assert c.pairs[0].p_new == pytest.approx(p) and p > c.pairs[0].p
    assert (c.categories, c.objects) == (6, 24)


def test_without_borrowed_variance_the_test_for_new_ones_is_students_and_statsmodels_holm(monkeypatch):
    monkeypatch.setattr(intervals, "BORROWED", 0.0)
    success = np.random.default_rng(8).random((4, 10 * 40)) < [[0.7], [0.62], [0.5], [0.68]]
    (c,) = pairing.compare(paired(success, np.repeat(np.arange(10), 40)), draws=2)
    rates = dict(zip(c.names, success.reshape(4, 10, 40).mean(2), strict=True))
    expected = [max(stats.ttest_1samp(rates[p.a] - rates[p.b], 0).pvalue, p.p) for p in c.pairs]
    assert [p.p_new for p in c.pairs] == pytest.approx(expected)
    assert [p.p_new_holm for p in c.pairs] == pytest.approx(multipletests(expected, method="holm")[1])
    for p in c.pairs:
        assert (p.verdict in ("better", "worse")) == (p.p_new_holm < 0.05)
        assert (p.verdict == "tied") == (p.p_holm >= 0.05)


def test_a_pair_that_alone_is_better_is_better_here_among_many():
    """Holm corrects the test for new ones too: with more pairs the same pair is no longer called."""
    random = np.random.default_rng(12)
    rate = np.clip(np.stack([random.normal(0.68, 0.12, 10), random.normal(0.5, 0.12, 10)]), 0, 1)
    rate = np.concatenate([rate, rate.mean(0) + random.normal(0, 0.2, (3, 10))]).clip(0, 1)
    success = (random.random((5, 10, 60)) < rate[:, :, None]).reshape(5, -1)
    objects = np.repeat(np.arange(10), 60)
    two, five = (pairing.compare(paired(own, objects), draws=2) for own in (success[:2], success))
    (alone,), among = two[0].pairs, five[0].pairs[0]
    assert alone.verdict == "better" and among.verdict == "better here"
    assert among.alone == alone.alone == "better"
    other = sum(p.alone != p.verdict for p in five[0].pairs)
    for text in (text_of.brief, text_of.render):  # a reader of both tables is told why
        assert f"{other} of 10 pairs read otherwise if compared alone (--method A B), as Holm corrects" in text(five)
        assert "compared alone" not in text(two)
    assert (alone.low, alone.high, alone.p_new) == (among.low, among.high, among.p_new) and among.low > 0


def test_a_method_that_is_better_for_new_objects_alone_is_better_here():
    """Objects of one category agree, so 24 of them say less than 24 of 24 kinds."""
    solved = 10 + np.repeat([10, 10, 10, -3, -1, 2], 4)  # of the 25 trials of each object
    success = np.stack([np.arange(25) < solved[:, None], np.arange(25) < np.full((24, 1), 10)]).reshape(2, -1)
    objects = np.repeat(np.arange(24), 25)
    (alone,), (grouped,) = (pairing.compare(paired(success, objects, category=c))[0].pairs for c in ((), FAMILIES))
    assert (alone.verdict, grouped.verdict) == ("better", "better here")
    assert alone.p_holm == grouped.p_holm and grouped.low < 0 < alone.low


def test_the_ranks_of_families_redraw_categories_and_then_their_objects():
    success, objects = in_families(0.2)
    (c,) = pairing.compare(paired(success, objects, category=FAMILIES), draws=20_000)
    rates = success.reshape(2, 6, 4, 25).mean(3)
    random = np.random.default_rng(1)
    first = 0.0
    for _ in range(8000):  # by hand, a category and an object at a time
        drawn = [rates[:, k, random.integers(0, 4, 4)].mean(1) for k in random.integers(0, 6, 6)]
        a, b = np.mean(drawn, 0)
        first += (a > b) + 0.5 * (a == b)
    assert 0.6 < first / 8000 < 0.95
    assert c.rank[0, 0] == pytest.approx(first / 8000, abs=0.02)


def test_the_worst_rank_names_the_category_whose_absence_gives_it():
    success = np.zeros((3, 6, 10), bool)
    success[0, :, :5] = True  # even everywhere
    success[1, 2] = True  # first by its one category alone
    success[1, [0, 1, 3, 4, 5], :6] = success[1, [0, 1, 3, 4, 5], :6] | (np.arange(6) < 4)
    names = ["cup", "cup", "pan", "pan", "mug", "mug"]
    (c,) = pairing.compare(paired(success.reshape(3, -1), np.repeat(np.arange(6), 10), category=names))
    assert [round(r) for r in c.rates] == [50, 50, 0]
    found = [(w.rank, w.without) for w in c.worst]
    # without pan the second has 40 %; without cup or mug the first, 50 %, is below its 55 %
    assert found == [(2, "cup"), (2, "pan"), (3, "")]


def test_the_worst_rank_compares_all_methods_without_the_same_object():
    """Both fall without the first object. Neither's whole rate may stand beside the other's rate without it."""
    solved = np.array([[40, 20, 20], [36, 19, 19]])
    success = (np.arange(40) < solved[:, :, None]).reshape(2, -1)
    (c,) = pairing.compare(paired(success, np.repeat(np.arange(3), 40)), draws=1)
    assert [(w.rank, w.without) for w in c.worst] == [(1, ""), (2, "")]


def test_a_run_of_families_is_compared_and_reported_by_category(tmp_path, capsys):
    kinds = {"bowl": "bowl", "cup": "cup", "eyeglasses": "cup", "hammer": "tool", "knife": "tool", "scissors": "tool"}
    about = [{"name": n, "split": "S0", "built_in": True, "category": k} for n, k in kinds.items()]
    outcomes = {m: np.random.default_rng(i).choice([0, 2], 120) for i, m in enumerate("mn")}
    run = write_run(tmp_path / "a", outcomes, 60, 60, objects=about)
    assert command("compare", tmp_path / "a", format="json") == 0
    s0, s1, _ = json.loads(capsys.readouterr().out)
    assert (s0["categories"], s0["objects"]) == (2, 3)
    # S1's objects are one category: nothing is said about others
    assert s1["pairs"][0]["low"] is None and s1["worst"] is None and s1["categories"] == 1
    assert command("compare", tmp_path / "a", full=True) == 0
    said = capsys.readouterr().out
    assert "95 % all cat." in said and "6 new" in said and "categories and their objects" in said
    assert command("report", tmp_path / "a", full=True) == 0
    assert "SR new cat." in capsys.readouterr().out
    assert command("report", tmp_path / "a", format="csv") == 0
    (line, *_) = capsys.readouterr().out.splitlines()[1:]
    assert "6 of 3 families, digest" in line and run.categories["eyeglasses"] == "cup"


def test_objects_and_splits_of_different_sizes_weigh_by_their_trials():
    objects = np.repeat(np.arange(6), [5, 90, 20, 40, 1, 60])
    split = (objects >= 3).astype(int)
    success = np.stack([np.ones(216), np.zeros(216), objects == 1])
    for c in pairing.compare(paired(success, objects, split)):
        pair = c.pairs[0]
        # all objects agree, so what is left is the interval for more trials: Wilson's width at 100 %
        least = 100 * (1 - stats.norm.ppf(0.975) ** 2 / (c.n + stats.norm.ppf(0.975) ** 2) * 2)
        assert (pair.difference, pair.high) == (100, 100) and least - 2 < pair.low < 100
    third = next(p for p in c.pairs if (p.a, p.b) == ("m1", "m2"))
    assert third.difference == pytest.approx(-100 * 90 / 216) and third.low < third.difference < third.high


def test_a_run_that_is_given_twice_is_counted_once(tmp_path, capsys):
    """By another spelling, by a link, as a copy, scored again: each would be a method of its own in Holm's correction."""
    random = np.random.default_rng(4)
    rows = {m: random.choice([0, 2], 60) for m in ("m", "n")}
    first = write_run(tmp_path / "a", rows, 30, 30, shard_trials=60).folder
    shutil.copytree(first, tmp_path / "copy")
    (tmp_path / "link").symlink_to(first)
    write_run(tmp_path / "again", rows, 30, 30, shard_trials=7)
    write_run(tmp_path / "other", {"m": rows["m"][::-1]}, 30, 30)
    assert command("compare", first, format="json") == 0
    once = json.loads(capsys.readouterr().out)
    for second in (
        first,
        tmp_path / "." / "copy" / ".." / "a",
        tmp_path / "link",
        tmp_path / "copy",
        tmp_path / "again",
    ):
        assert command("compare", first, second, format="json") == 0
        captured = capsys.readouterr()
        assert json.loads(captured.out) == once and captured.err.count("is given twice") == 2
    assert command("compare", first, tmp_path / "copy", full=True) == 0
    assert " ".join(capsys.readouterr().out.split()).count("is given twice, and counted once") == 2
    assert command("compare", first, tmp_path / "other", format="json") == 0
    assert json.loads(capsys.readouterr().out)[2]["names"] == ["m", "n", "other/m"]
    assert command("compare", first, tmp_path / "copy", method="m") == 2
    assert "'m' is given 2 times" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["ids", "objects"])
def test_methods_that_answered_other_trials_are_refused(tmp_path, capsys, monkeypatch, change):
    run = write_run(tmp_path / "a", {m: np.zeros(40, int) for m in "mn"}, 20, 20, shard_trials=7)
    shards = Run.shards

    def another(self, kind, method, columns=None):
        for table in shards(self, kind, method, columns):
            if method == "n" and change == "ids":
                table = table.set_column(0, "trial_id", pc.add(table["trial_id"], 1))
            if method == "n" and change == "objects":
                table = table.set_column(2, "object", pa.array(["spoon"] * len(table)).dictionary_encode())
            yield table

    monkeypatch.setattr(Run, "shards", another)
    with pytest.raises(
        ValueError, match="other trial ids than 'm'" if change == "ids" else "n and m have other objects"
    ):
        pairing.pair_up([run])


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"protocol": "another"}, r"benchmark \(made, another\)"),
        ({"digests": {"trials": "f"}}, r"digests \(trials\)"),
        ({"configuration": {"name": "paper"}}, r"configuration \(name\)"),
    ],
)
def test_runs_that_were_not_asked_the_same_are_refused(tmp_path, capsys, change, what):
    write_run(tmp_path / "a", {"m": np.zeros(4, int)}, 2, 2)
    write_run(tmp_path / "b", {"n": np.zeros(4, int)}, 2, 2, **change)
    assert command("compare", tmp_path / "a", tmp_path / "b") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    with pytest.raises(ValueError, match=f"differ in {what}: their trials cannot be paired"):
        pairing.pair_up([load_run(tmp_path / n) for n in "ab"])


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (1, 2, 0)])
def test_two_runs_of_other_code_are_refused_beside_baselines_of_other_code(tmp_path, order):
    """Shipped rows are compared without their code's digest, which says nothing of two others."""
    runs = [
        write_run(tmp_path / m, {m: np.zeros(4, int)}, 2, 2, digests={"trials": "t", "code": code})
        for m, code in (("shipped", "old"), ("a", "new"), ("b", "another"))
    ]
    shipped = runs[0].folder
    for other in (1, 2):
        common_trials([runs[0], runs[other]], proven=[shipped])
    with pytest.raises(ValueError, match=r"a and .*b differ in digests \(code\)"):
        common_trials([runs[i] for i in order], proven=[shipped])


def test_folders_with_other_shards_are_paired_row_by_row(tmp_path, capsys):
    random, texts = np.random.default_rng(9), []
    outcomes = {m: random.choice([0, 2, 5], 140) for m in "abc"}
    for sizes in ((140, 140), (7, 33), (60, 11)):
        folders = tuple(tmp_path / f"{sizes[0]}-{sizes[1]}" / name for name in "xy")
        write_run(folders[0], {"a": outcomes["a"]}, 70, 70, shard_trials=sizes[0])
        write_run(folders[1], {m: outcomes[m] for m in "bc"}, 70, 70, shard_trials=sizes[1])
        assert command("compare", *folders, format="json") == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1] == texts[2]
    pair = json.loads(texts[0])[2]["pairs"][0]
    assert pair["only_a"] == int(((outcomes["a"] == 0) & (outcomes["b"] != 0)).sum())
