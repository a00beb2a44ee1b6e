"""Turn tests of runs made by hand: what is marked follows from a test over the frames, not from how far a rate moves."""

import numpy as np
import pytest
from made_runs import write_run
from scipy import stats
from statsmodels.stats.contingency_tables import cochrans_q
from statsmodels.stats.multitest import multipletests

from r2h_batch.report.turn import Move, Turned, about, folder_of, turned

FRAMES = ("half", "cycled")
N = 90
"""Trials of a split; objects in turn, three of each split."""


def made(tmp_path, outcomes):
    """A run with its turned ones; outcomes: method -> successes (3, 2 N) as it lies, half turn, cycled axes."""
    codes = {m: np.where(success, 0, 2) for m, success in outcomes.items()}
    run = write_run(tmp_path / "run", {m: code[0] for m, code in codes.items()}, N, N)
    for k, turn in enumerate(FRAMES, 1):
        own = {m: code[k] for m, code in codes.items()}
        write_run(folder_of(run.folder, turn), own, N, N, benchmark={"flags": [f"--turn {turn}"]})
    return turned(run)


def test_a_mark_follows_from_the_corrected_test(tmp_path):
    random = np.random.default_rng(3)
    objects = np.arange(2 * N) % 3
    still = random.random(2 * N) < 0.7
    falls, opposite = np.stack([still] * 3), np.stack([still] * 3)
    falls[2] &= random.random(2 * N) < 0.7  # one frame loses
    opposite[1, :N] = np.where(objects[:N] == 0, True, np.where(objects[:N] == 1, False, still[:N]))
    chance = random.random((3, 2 * N)) < 0.6
    tests = {
        (t.method, t.group): t
        for t in made(
            tmp_path, {"falls": falls, "opposite": opposite, "chance": chance, "still": np.stack([still] * 3)}
        )
    }
    marked = {key for key, test in tests.items() if test.marked}
    assert {("falls", "all"), ("opposite", "S0")} <= marked
    assert not {m for m, _ in marked} & {"chance", "still"} and ("opposite", "S1") not in marked
    lost = tests["falls", "all"]
    # the farthest move is a loss, and `most` is that move
    assert lost.most.turn == "cycled" and lost.most.points < -10 < 0 == lost.moves[0].points
    assert lost.most.low < lost.most.points < lost.most.high < 0
    rate = 100 * falls.mean(1)
    assert [lost.rate, *(lost.rate + m.points for m in lost.moves)] == pytest.approx(rate.tolist())
    # the test by hand, for all methods of S0
    expected = []
    for success in (falls, opposite, chance, np.stack([still] * 3)):
        own = success[:, :N]
        parts = [own[:, objects[:N] == k] for k in range(3)]
        found = [cochrans_q(p.T.astype(int), return_object=True) for p in parts if (p != p[0]).any()]
        strata = stats.chi2.sf(sum(f.statistic for f in found), 2 * len(found)) if found else 1.0
        pooled = cochrans_q(own.T.astype(int), return_object=True).pvalue if found else 1.0
        expected.append(min(1, 2 * min(strata, pooled)))
    names = ("falls", "opposite", "chance", "still")
    found = [tests[m, "S0"].p_frames for m in names]
    assert found == pytest.approx(expected, abs=0.03)  # of few trials that differ, by permutations
    corrected = multipletests(found, method="holm")[1]
    assert [tests[m, "S0"].p_frames_holm for m in names] == pytest.approx(corrected)
    assert {(t["method"], t["group"]) for t in about(list(tests.values())) if t["marked"]} == marked


def test_where_no_trial_moves_the_interval_has_a_width_and_no_negative_zero(tmp_path):
    still = np.stack([np.arange(2 * N) % 4 > 0] * 3)
    tests = made(tmp_path, {"m": still})
    for test in tests:
        for move in test.moves:
            assert str(move.points) == "0.0" and move.low < 0 < move.high and move.high == pytest.approx(-move.low)
    assert "-0.0" not in [end.strip() for test in tests for end in test.most.ends.split(" to ")]


@pytest.mark.parametrize(("p", "is_marked"), [(0.06, False), (0.04, True)])
def test_a_large_move_alone_is_no_mark_and_a_loss_is_as_good_as_a_gain(p, is_marked):
    moves = (Move("half", 3.0, -1.0, 7.0, 0.2), Move("cycled", -10.8, -35.1, 13.4, 0.06))
    test = Turned("m", "S0", 240, 70.0, moves, p / 4, p)
    assert test.marked is is_marked and test.most.turn == "cycled"
    assert (
        "cycled axes" in test.sentence
        and "-10.8 points" in test.sentence
        and "SR 59.2 to 73.0 in 3 frames" in test.sentence
    )
