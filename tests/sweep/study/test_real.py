"""A robot's trials beside a run's: pairs, intervals and orders against other code."""

import csv

import numpy as np
import pytest
from rounds import each
from scipy import stats
from statsmodels.stats.proportion import confint_proportions_2indep, proportion_confint

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.study import real

COLUMNS = ("trial_id", "method", "outcome", "failed_criterion", "seconds")


def write(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(rows)
    return path


@pytest.fixture(scope="module")
def judged(paper_rows):
    """Method -> the run's rows."""
    return {name: load_run(paper_rows.folder).trials(name).to_pylist() for name in paper_rows.methods}


@pytest.fixture
def filled(judged):
    """A table in which the robot does what a coin says, and the same as arrays."""
    random, rows, truth = np.random.default_rng(1), [], {}
    for name, own in judged.items():
        picked = own[:40]
        hits = random.random(len(picked)) < 0.6
        rows += [
            (r["trial_id"], name, "success" if h else "failure", "" if h else "reach", 10.0)
            for r, h in zip(picked, hits)
        ]
        truth[name] = (np.array([r["outcome"] == "success" for r in picked]), hits)
    return rows, truth


@pytest.mark.check
def test_trials_are_paired_by_their_ids(paper_rows, filled, tmp_path, capsys):
    rows, truth = filled
    random = np.random.default_rng(3)
    file = write(tmp_path / "t.csv", [rows[i] for i in random.permutation(len(rows))])
    found, empty = real.paired_trials(paper_rows.folder, file)
    assert empty == 0
    for name, (sim, hits) in each(truth.items()):
        assert found[name].sim.sum() == sim.sum() and found[name].real.sum() == hits.sum()
        assert (found[name].sim & found[name].real).sum() == (sim & hits).sum()
    assert main(["study", "real", str(paper_rows.folder), str(file)]) == 0
    text = capsys.readouterr().out
    for name, (sim, hits) in each(truth.items()):
        line = next(x for x in text.splitlines() if x.startswith(name))
        both, only_sim, only_real = (int(x.sum()) for x in (sim & hits, sim & ~hits, ~sim & hits))
        low, high = proportion_confint(hits.sum(), len(hits), method="wilson")
        p = stats.binomtest(only_real, only_real + only_sim).pvalue if only_real + only_sim else 1.0
        assert f"{100 * hits.mean():.1f} ({100 * low:.0f}-{100 * high:.0f})" in line
        cells = [cell.strip() for cell in line.split("|")]
        assert cells[4].startswith(f"{100 * (hits.mean() - sim.mean()):+.1f} (") and cells[5] == f"{p:.2g}"
        assert cells[6:10] == [str(x) for x in (both, only_sim, only_real, len(sim) - both - only_sim - only_real)]
    sim, hits = ([100 * x.mean() for x in column] for column in zip(*truth.values()))
    assert f"{stats.spearmanr(sim, hits).statistic:+.2f}" in text
    assert f"{real.rank_violation(sim, hits):.1f} points" in text


def test_the_rank_violation_is_the_mean_of_the_widest_gaps_that_simulation_puts_in_another_order():
    """As of SIMPLER."""
    random = np.random.default_rng(0)
    for _ in each(range(20)):
        s, r = random.integers(0, 101, (2, 5)).astype(float)
        worst = [max(abs(r[i] - r[j]) * ((s[i] < s[j]) != (r[i] < r[j])) for j in range(5)) for i in range(5)]
        assert real.rank_violation(s, r) == pytest.approx(np.mean(worst))
    assert real.rank_violation([10, 20, 30], [50, 60, 70]) == 0.0
    assert real.rank_violation([10, 20], [60, 50]) == 10.0


def test_rates_without_ids_have_newcombes_interval():
    for a, b in each([((0.55, 20), (0.45, 40)), ((1.0, 20), (0.2, 500)), ((0.0, 10), (0.0, 10))]):
        counts = (round(a[0] * a[1]), a[1], round(b[0] * b[1]), b[1])
        expected = confint_proportions_2indep(*counts, compare="diff", method="newcomb")
        assert real.unpaired_interval(a, b) == pytest.approx(expected, abs=1e-9)


def test_agreement_is_counted_by_outcome(paper_rows, judged, tmp_path, capsys):
    name = paper_rows.methods[0]
    failed = next(r for r in judged[name] if r["outcome"] == "plan")
    passed = next(r for r in judged[name] if r["outcome"] == "success")
    rows = [(failed["trial_id"], name, "failure", "plan", ""), (passed["trial_id"], name, "failure", "", "")]
    assert main(["study", "real", str(paper_rows.folder), str(write(tmp_path / "t.csv", rows))]) == 0
    text = capsys.readouterr().out
    lines = [[c.strip() for c in x.strip("|").split("|")] for x in text.splitlines()]
    assert ["plan", "1", "1", "100", "-"] in lines
    assert "failure, no criterion noted 1" in text


def test_a_benchmark_that_begins_on_the_table_has_its_own_criteria(paper_rows, judged, tmp_path, capsys):
    """In the table that a lab fills in, and in the agreement by outcome."""
    folder, name = tmp_path / "mine", "random"
    line = ["--benchmark", "r2h-v3", "--method", name, "--trials", "3", "--execute.sim", "none"]
    assert sweep([*line, "--out", str(folder)]) == 0
    stored = {r["trial_id"]: r["outcome"] for r in load_run(folder).trials(name).to_pylist()}
    failed = [i for i, outcome in stored.items() if outcome == "pick"]
    words = ("received", *["pick"] * len(stored))
    rows = [(i, name, "failure", word, "") for i, word in zip(failed, words)]
    capsys.readouterr()
    assert len(rows) > 1
    assert main(["study", "real", str(folder), str(write(tmp_path / "t.csv", rows))]) == 0
    lines = [[c.strip() for c in x.strip("|").split("|")] for x in capsys.readouterr().out.splitlines()]
    same = len(rows) - 1
    assert ["pick", str(len(rows)), str(same), f"{100 * same / len(rows):.0f}", "received 1"] in lines
    # nobody judged the paper's rows by these
    own = next(iter(judged.values()))[0]
    file = write(tmp_path / "t.csv", [(own["trial_id"], paper_rows.methods[0], "failure", "received", "")])
    assert main(["study", "real", str(paper_rows.folder), str(file)]) == 2
    assert "failed_criterion received; allowed are stability, plan" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda rows: [*rows, rows[0]], "is there twice; once is enough"),
        (lambda rows: [(*rows[0][:2], "success", "plan", "")], "a success has no failed criterion"),
        (lambda rows: [(*rows[0][:2], "yes", "", "")], "allowed are success, failure, or nothing"),
        (lambda rows: [(10**9, *rows[0][1:])], "has no trial 1000000000"),
        (lambda rows: [(rows[0][0], "nobody", "success", "", "")], "no method 'nobody'"),
        (lambda rows: [(*rows[0][:2], "", "", "")], "no row has an outcome"),
        (lambda rows: [(*rows[0][:2], "failure", "luck", "")], "failed_criterion luck; allowed are stability"),
    ],
)
def test_a_wrong_table_of_real_trials_is_refused_in_one_line(paper_rows, filled, tmp_path, capsys, change, words):
    file = write(tmp_path / "t.csv", change(filled[0]))
    assert main(["study", "real", str(paper_rows.folder), str(file)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1, error


def test_ids_and_a_count_of_trials_do_not_go_together(paper_rows, filled, tmp_path, capsys):
    file = write(tmp_path / "t.csv", filled[0])
    assert main(["study", "real", str(paper_rows.folder), str(file), "--trials", "40"]) == 2
    assert "count themselves" in capsys.readouterr().err
    file.write_text("method,real_sr,real_t_tot_s\noracle,50,9\n")
    assert main(["study", "real", str(paper_rows.folder), str(file)]) == 2
    assert "has no column trial_id" in capsys.readouterr().err
