"""The leaderboard's lines and their order, on rows made by hand."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from made_runs import files_of, forge, write_run
from rounds import each

from r2h_batch.report.board import CODE, Judged, page, section_of, standing_of
from r2h_batch.report.compare.shipped_answers import answers_of_shipped
from r2h_batch.report.compare.stored import SHIPPED
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.runs import store as results
from r2h_batch.runs.store import load_run
from r2h_batch.types import Outcome


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Baselines and submissions on 60 trials of each split."""
    place = tmp_path_factory.mktemp("board")
    half = np.where(np.arange(120) % 2, Outcome.SUCCESS, Outcome.REACH)
    whole = np.full(120, Outcome.SUCCESS)
    good = np.where(np.arange(120) % 12, Outcome.SUCCESS, Outcome.REACH)
    return (
        write_run(place / "base", {"half": half, "whole": whole}, 60, 60),
        write_run(place / "long", {"whole": good}, 60, 60),
        write_run(place / "best", {"<b>half</b>": whole}, 60, 60),
    )


def lines_of(text):
    return re.findall(
        r"<tr[^>]*><td>([^<]*)</td><td class=l>([^<]*)(?:<small>[^<]*</small>)?</td><td class=l>([^<]*)</td>", text
    )


def test_methods_stand_in_the_order_of_their_success_on_their_own_trials(folders):
    base, *runs = folders
    standings = [
        standing_of(run, m, run.folder.name, Judged(120, 60, 59, False), base, common_trials([base, run]), {})
        for run in runs
        for m in run.methods
    ]
    long, best = standings
    assert long.method == "whole (submitted)" and long.trials == {"S0": 60, "S1": 60}
    assert long.sr["Avg"][0] == pytest.approx(100 * 110 / 120) and long.sr["S0"][1] < 100 * 55 / 60 < long.sr["S0"][2]
    assert long.against["whole"].difference == pytest.approx(-100 * 10 / 120) and long.against["whole"].trials == 120
    assert long.against["half"].verdict in ("better", "better here")
    assert best.against["half"].difference == 50 and best.against["whole"].verdict == "tied"
    text = page([section_of(base, standings)], least=60)
    assert lines_of(text) == [
        ("1", "&lt;b&gt;half&lt;/b&gt; (submitted)", "best"),
        ("1", "whole", "baseline"),
        ("3", "whole (submitted)", "long"),
        ("4", "half", "baseline"),
    ]
    places = [place for place, _, _ in lines_of(page([section_of(base, standings)], least=61))]
    assert places == ["n/a"] * 4
    assert re.search(r"<td class=m>60 of 120</td><td class=m>59</td><td class=m>4\.9 %</td>", text)  # 1 - 0.05^(1/60)
    assert (
        "the same answers as &lt;b&gt;half&lt;/b&gt; (submitted)" in text
    )  # the baseline `whole` succeeds everywhere too
    assert not re.search(r"https?://|url\(|@import", text)


def test_rows_that_disagree_with_themselves_have_no_line(folders):
    base, run, _ = folders
    with pytest.raises(ValueError, match="no method"):
        standing_of(run, "nobody", "long", Judged(1, 1, 1, False), base, common_trials([base, run]), {})


def test_places_go_by_the_trials_that_all_hold_and_are_shared_where_nothing_is_decided(folders, tmp_path):
    """30 trials against 60 say nothing by their own rates: the easy first half would rank above the whole."""
    base, *_ = folders
    easy = np.where(np.arange(30) % 29, Outcome.SUCCESS, Outcome.REACH)
    hard = np.concatenate([easy, np.full(30, Outcome.REACH)])
    run = write_run(tmp_path / "long", {"mine": np.concatenate([hard, hard])}, 60, 60)
    long = standing_of(run, "mine", "long", Judged(120, 60, 59, False), base, common_trials([base, run]), {})
    first = {split: codes[: 30 * CODE] for split, codes in long.codes.items()}
    trials, rates = {"S0": 30, "S1": 30}, dict.fromkeys(long.sr, (93.3, 84.0, 97.4))
    short = replace(long, submission="short", trials=trials, sr=rates, codes=first)
    assert short.of_all > 90 and long.of_all < 60
    text = page([section_of(base, [long, short])], least=30)
    places = {f"{m} {s}": p for p, m, s in lines_of(text)}
    assert places["mine (submitted) short"] == places["mine (submitted) long"] == places["whole baseline"] == "1"
    assert places["half baseline"] == "4"
    assert "30 S0, 30 S1" in text and "the same answers as mine (submitted)" in text


@pytest.mark.parametrize(("moved", "rows", "same"), [
    (3e-8, 60, True), (2e-5, 1, True), (2e-5, 2, False),
])  # fmt: skip
def test_the_same_answers_are_recognised_on_another_machine_and_others_are_not(folders, tmp_path, moved, rows, same):
    """Another processor moves margins by some 1e-8 m, some of them across the place where rounding changes."""
    base, *_ = folders
    ends = np.where(np.arange(60) % 7, Outcome.SUCCESS, Outcome.REACH)
    lines = []
    for name in ("ours", "theirs"):
        write_run(tmp_path / name, {"mine": np.concatenate([ends, ends])}, 60, 60)
        if name == "theirs":
            for path in files_of(tmp_path / name, "mine")[:1]:
                forge(path, other_rows(moved, rows), "trials")
        run = load_run(tmp_path / name)
        lines.append(standing_of(run, "mine", name, Judged(120, 60, 59, False), base, common_trials([base, run]), {}))
    trials = {"S0": 60, "S1": 60}
    assert lines[0].answers_as(lines[1], trials) == same
    other_end = {**lines[0].codes, "S1": ("0" if lines[0].codes["S1"][0] == "1" else "1") + lines[0].codes["S1"][1:]}
    assert not lines[0].answers_as(replace(lines[0], codes=other_end), trials), "one trial ends otherwise"


def other_rows(moved, rows):
    """A change of the last rows of S0: margins of Reach so far."""

    def change(table):
        s0 = [k for k, split in enumerate(table["split"].to_pylist()) if split == "S0"][-rows:]
        name = "margin_reach_m"
        column = table[name].to_pylist()
        for k in s0:
            column[k] += moved
        field = table.schema.field(name)
        return table.set_column(table.column_names.index(name), field, pa.array(column, field.type))

    return change


def posed(change):
    """A change of stored poses: `change` takes T_obj_ee and T_world_ee (n, 4, 4) and writes into them."""

    def of(table):
        names = ("T_obj_ee", "T_world_ee")
        poses = [np.array(table[k].to_pylist(), np.float64).reshape(-1, 4, 4) for k in names]
        change(*poses)
        for name, T in zip(names, poses, strict=True):
            field = table.schema.field(name)
            column = pa.array(T.reshape(-1, 16).astype(np.float32).tolist(), field.type)
            table = table.set_column(table.column_names.index(name), field, column)
        return table

    return of


def moved_by(metres):
    """A change of stored poses: the object's ee so far along x."""

    def change(T_obj_ee, T_world_ee):
        T_obj_ee[:, 0, 3] += metres

    return posed(change)


@pytest.mark.parametrize(("metres", "share"), [(0.0, 1.0), (0.0011, 1.0), (0.0199, 1.0), (0.0201, 0.0)])
def test_shipped_answers_that_are_moved_a_little_are_named_and_have_no_place(folders, tmp_path, metres, share):
    shutil.copytree(SHIPPED / "r2h-v2", copy := tmp_path / "theirs")
    for path in files_of(copy, "oracle"):
        forge(path, moved_by(metres), "poses")
    found = answers_of_shipped(results.load_run(copy), "oracle")
    assert found == ({"oracle": 1.0} if share else {})
    base, run, _ = folders
    judged = Judged(120, 60, 59, False)
    line = standing_of(run, "whole", "long", judged, base, common_trials([base, run]), found)
    text = page([section_of(base, [line])], least=60)
    (place,) = [place for place, _, who in lines_of(text) if who == "long"]
    assert (place == "n/a") == bool(share) and ("shipped answers: all answers of oracle" in text) == bool(share)
    again = standing_of(run, "whole", "long", Judged(120, 60, 60, True), base, common_trials([base, run]), found)
    assert again.answers == {}  # built in, and answered again


@pytest.mark.parametrize(("degrees", "metres", "share"), [(7.9, 0.019, 1.0), (8.1, 0.019, 0.0), (8.1, 0.0005, 1.0)])
def test_a_shipped_answer_may_turn_the_object_by_less_than_8_degrees_where_it_is_moved(
    tmp_path, degrees, metres, share
):
    shutil.copytree(SHIPPED / "r2h-v2", copy := tmp_path / "theirs")
    angle = np.radians(degrees)
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])

    def change(T_obj_ee, T_world_ee):
        T_world_ee[:, :3, :3] = R @ T_world_ee[:, :3, :3]
        T_world_ee[:, 0, 3] += metres

    for path in files_of(copy, "oracle"):
        forge(path, posed(change), "poses")
    assert answers_of_shipped(results.load_run(copy), "oracle") == ({"oracle": 1.0} if share else {})


def test_a_half_turn_of_the_gripper_about_its_axis_does_not_hide_a_shipped_answer(tmp_path):
    shutil.copytree(SHIPPED / "r2h-v2", copy := tmp_path / "theirs")

    def change(T_obj_ee, T_world_ee):
        for T in (T_obj_ee, T_world_ee):
            T[:, :3, :3] = T[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
        T_obj_ee[:, 0, 3] += 0.005

    for path in files_of(copy, "oracle"):
        forge(path, posed(change), "poses")
    assert answers_of_shipped(results.load_run(copy), "oracle") == {"oracle": 1.0}


def test_no_shipped_method_has_the_answers_of_another_one():
    shipped = results.load_run(SHIPPED / "r2h-v2")
    for method in each(shipped.methods):
        assert answers_of_shipped(shipped, method) == {method: 1.0}


def test_the_answers_of_a_boards_own_baselines_are_named_where_none_are_shipped():
    """A benchmark of a board, such as one with held-out trials, has no shipped rows."""
    run = results.load_run(SHIPPED / "r2h-v2")

    def on(benchmark, methods):
        entries = tuple(e for e in run.entries if e.name in methods)
        header = {**run.header, "digests": {**run.header["digests"], "benchmark": benchmark}}
        return replace(run, header=header, entries=entries, folder=run.folder / "elsewhere")

    theirs = on("a" * 64, ("oracle",))
    assert answers_of_shipped(theirs, "oracle") == {}
    assert answers_of_shipped(theirs, "oracle", on("a" * 64, ("oracle", "random"))) == {"oracle": 1.0}
    assert answers_of_shipped(theirs, "oracle", on("a" * 64, ("random",))) == {}
    assert answers_of_shipped(theirs, "oracle", on("b" * 64, ("oracle",))) == {}
    bare = on("a" * 64, ("oracle",))
    bare = replace(bare, header={**bare.header, "stored": []})
    assert answers_of_shipped(theirs, "oracle", bare) == {}
