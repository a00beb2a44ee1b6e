"""The command `results reception`: a table in the run folder, a funnel on the screen."""

import errno
import shutil
import tempfile

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.reception import SCHEMA, render

QUICK = ["--execute.sim", "none", "--quiet"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reception") / "run"
    assert (
        main(
            [
                "sweep",
                "--benchmark",
                "r2h-v1",
                "--method",
                "random",
                "oracle,for=reception",
                "--trials",
                "2",
                "--out",
                str(folder),
                *QUICK,
            ]
        )
        == 0
    )
    return folder


def test_every_stored_pose_has_a_row_and_the_funnel_counts_them(run, capsys):
    assert main(["results", "reception", str(run)]) == 0
    shown = capsys.readouterr().out
    for entry in load_run(run).entries:
        table = pq.read_table(run / "reception" / f"{entry.slug}.parquet")
        assert table.schema.equals(SCHEMA) and len(table) == 4
        rows = table.to_pylist()
        assert all((r["grasp"] is None) == (not r["received"]) for r in rows)
        assert all(r["n_hold"] <= r["n_arm"] <= r["known"] for r in rows)
        judged = [r for r in rows if r["evaluated"]]
        share = 100 * sum(r["received"] for r in judged) / len(judged)
        line = next(
            x for x in shown.splitlines() if x.startswith("| " + ("oracle" if "oracle" in entry.name else "random"))
        )
        assert f"{share:.1f}" in line and line.split("|")[2].strip() == str(len(judged))
    best = [r for r in rows if r["success"]]
    assert len(best) == 4 and sum(r["received"] for r in best) >= 3  # the bound
    assert main(["results", "verify", str(run)]) == 0


def test_what_is_stored_is_printed_again_and_a_damaged_file_is_one_line(run, tmp_path, capsys):
    assert main(["results", "reception", str(run)]) == 0
    shown, copy = capsys.readouterr().out, tmp_path / "run"
    shutil.copytree(run, copy)
    (first, second) = sorted((copy / "reception").iterdir())
    second.unlink()  # as if the command had ended between two methods
    before = first.stat().st_ino
    assert main(["results", "reception", str(copy)]) == 0
    assert capsys.readouterr().out == shown and second.exists() and first.stat().st_ino == before
    page = pq.read_metadata(first).row_group(0).column(SCHEMA.names.index("known"))
    for damage in (lambda d: d[: len(d) // 2], lambda d: d[: (k := page.data_page_offset + 20)] + b"xx" + d[k + 2 :]):
        good = first.read_bytes()
        first.write_bytes(damage(good))
        assert main(["results", "reception", str(copy)]) == 2
        said = capsys.readouterr()
        assert said.out == "" and str(first) in said.err and "Traceback" not in said.err
        assert said.err.strip().count("\n") == said.err.count("has these rows")
        first.write_bytes(good)


def test_a_link_in_place_of_the_tables_folder_is_refused_and_nothing_is_written_there(run, tmp_path, capsys):
    copy, victim = tmp_path / "run", tmp_path / "victim"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("reception"))
    victim.mkdir()
    (copy / "reception").symlink_to(victim)
    assert main(["results", "reception", str(copy)]) == 2
    error = capsys.readouterr().err
    assert "a symbolic link" in error and error.count("\n") == 1 and not list(victim.iterdir())


def test_a_run_folder_that_takes_no_file_is_told_before_anything_is_judged(run, tmp_path, monkeypatch, capsys):
    copy, real = tmp_path / "run", tempfile.TemporaryFile
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("reception"))

    def read_only(*words, dir=None, **more):
        if dir is not None:
            raise OSError(errno.EROFS, "Read-only file system")
        return real(*words, **more)

    monkeypatch.setattr(tempfile, "TemporaryFile", read_only)
    assert main(["results", "reception", str(copy)]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "working" not in line]
    assert (
        line.startswith("results: the answers go into")
        and "no file can be written in" in line
        and "judging" not in line
    )


def test_with_fewer_grasps_never_more_are_received():
    n = 6
    columns = {name: [0] * n for name in SCHEMA.names if name.startswith(("n_", "known", "trial_id"))}
    columns |= {name: [None] * n for name in SCHEMA.names if SCHEMA.field(name).nullable}
    columns |= {"success": [True] * n, "evaluated": [True] * n, "known": [256] * n, "n_hold": [40] * n}
    columns |= {"received": [True, True, True, False, False, False]}  # the whole way of half of them is blocked
    table = pa.table({name: columns[name] for name in SCHEMA.names}, schema=SCHEMA)
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in render({"m": table}).splitlines()]
    heads = {head: (head_line, i) for i, head_line in enumerate(lines) for head in head_line}
    curve, row = heads["K=8"][0], lines[heads["K=8"][1] + 2]
    shares = [float(cell) for head, cell in zip(curve, row, strict=True) if head.startswith("K=")]
    assert shares == sorted(shares) and 0 < shares[0] < 50 and shares[-1] == 50
