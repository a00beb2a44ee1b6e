"""Files beside the shards: whole, bounded and of the run's trials, or one line."""

import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_runs import with_a_fatal_footer, write_run

from r2h_batch.__main__ import main
from r2h_batch.report.people import RECEPTION
from r2h_batch.runs.files import RunError
from r2h_batch.runs.side import write_side
from r2h_batch.runs.store import load_run

N = 6


def table(**changes):
    columns = {
        "trial_id": pa.array(range(N), pa.int64()),
        "success": pa.array([True] * N),
        "evaluated": pa.array([True] * N),
        "received": pa.array([True] * N),
        "word": pa.array(["x"] * N),
    }
    return pa.table({k: v for k, v in {**columns, **changes}.items() if v is not None})


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good") / "run"
    write_run(folder, {"m": np.zeros(N, int)}, 3, 3)
    return folder


@pytest.fixture
def run(good, tmp_path):
    return shutil.copytree(good, tmp_path / "run")


def put(run, rows):
    """Stores rows as the reception of the run's method."""
    path = run / RECEPTION / "m.parquet"
    write_side(path, rows)
    return path


def read(run):
    """The columns of it that tables read."""
    return load_run(run).side("m", RECEPTION)


def repeated(rows, times):
    """As many rows in a small file: dictionaries of one entry."""
    small = table().take([0] * rows)
    return pa.concat_tables([small] * times)


ODD = {
    "30 million rows in dictionaries": (lambda: repeated(1000, 300), "300000 rows; at most one for each of 6 trials"),
    "trials of another run": (
        lambda: table(trial_id=pa.array(range(10, 10 + N), pa.int64())),
        "trial 10 is not in this run",
    ),
    "a trial twice": (lambda: table().take([0, 0, 1, 2]), "trial 0 stands there twice"),
    "a column missing": (lambda: table(received=None), "column 'received' is missing"),
    "a column of numbers": (lambda: table(received=pa.array(range(N))), "column 'received' is int64; it must be bool"),
    "gaps": (lambda: table(received=pa.array([None] * N, pa.bool_())), "column 'received' has 6 empty rows"),
}


@pytest.mark.parametrize("what", ODD)
def test_a_file_of_other_columns_or_trials_is_one_line_and_verify_sets_it_aside(run, what, capsys):
    make, words = ODD[what]
    path = put(run, make())
    with pytest.raises(RunError) as error:
        read(run)
    said = str(error.value)
    assert "\n" not in said and str(path) in said and words in said and "r2h-batch results reception" in said
    assert main(["results", "verify", str(run)]) == 1
    assert f"{path}: " in capsys.readouterr().out and not path.exists() and path.with_name("m.parquet.bad").exists()
    assert read(run) is None


DAMAGE = {
    "cut off": lambda d: d[: len(d) // 2],
    "empty": lambda d: b"",
    "no Parquet file": lambda d: b"trial_id,success\n",
    "a bit of a column that tables read": lambda d: flipped(d, "received"),
    "a bit of a column that no table reads": lambda d: flipped(d, "word"),
}


def flipped(data, name):
    """The bytes with a bit flipped inside of a column's pages."""
    group = pq.ParquetFile(pa.BufferReader(data)).metadata.row_group(0)
    (chunk,) = (c for c in map(group.column, range(group.num_columns)) if c.path_in_schema == name)
    k = chunk.data_page_offset + chunk.total_compressed_size - 1
    k -= 0 if chunk.dictionary_page_offset is None else chunk.data_page_offset - chunk.dictionary_page_offset
    return data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :]


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_file_is_one_line_and_verify_sets_it_aside(run, what, capsys):
    path = put(run, table())
    assert read(run).num_rows == N
    path.write_bytes(DAMAGE[what](path.read_bytes()))
    with pytest.raises(RunError) as error:
        read(run)
    assert "\n" not in str(error.value) and f"{path}: cannot be read" in str(error.value)
    assert main(["results", "verify", str(run)]) == 1
    assert f"{path}: cannot be read" in capsys.readouterr().out and not path.exists()
    assert read(run) is None


def test_a_link_in_the_place_of_the_folder_is_refused(run, capsys):
    (run / RECEPTION).symlink_to(run.parent)
    assert main(["report", str(run)]) == 2
    assert RECEPTION in (said := capsys.readouterr().err) and "symbolic link" in said


@pytest.mark.usefixtures("own_process")
def test_a_footer_that_ends_its_reader_is_found_before_it_is_opened(run, capsys):
    path = put(run, table())
    path.write_bytes(with_a_fatal_footer(path.read_bytes()))
    assert main(["report", str(run)]) == 2
    error = capsys.readouterr().err
    assert str(path) in error and error.count("\n") == 1
    assert main(["results", "verify", str(run)]) == 1 and not path.exists()


@pytest.mark.parametrize("kind", ["link", "pipe", "folder that is a link"])
def test_links_and_pipes_are_not_followed(run, tmp_path, kind, capsys):
    path = put(run, table())
    elsewhere = tmp_path / "elsewhere"
    if kind == "folder that is a link":
        path.parent.rename(elsewhere)
        (run / RECEPTION).symlink_to(elsewhere)
    else:
        path.rename(elsewhere)
        os.mkfifo(path) if kind == "pipe" else path.symlink_to(elsewhere)
    before = elsewhere.read_bytes() if elsewhere.is_file() else b""
    with pytest.raises(RunError, match=r"symbolic link|a pipe"):
        read(run)
    main(["results", "verify", str(run)])
    assert not elsewhere.is_file() or elsewhere.read_bytes() == before


@pytest.mark.check
def test_a_sound_file_is_read_and_one_of_an_older_version_too(run, capsys):
    path = put(run, table(received=pa.array([True] * 5 + [False])))
    assert read(run)["received"].to_pylist() == [True] * 5 + [False]
    pq.write_table(pq.read_table(path).replace_schema_metadata({b"r2h_batch columns": b"a digest"}), path)
    assert read(run)["received"].to_pylist() == [True] * 5 + [False]
    assert main(["results", "verify", str(run)]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("not checked: ")]
    assert "files beside the shards" in line and "reevaluate" in line
