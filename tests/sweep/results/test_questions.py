"""The loop that judges stored poses again: what a new question needs, what is kept, and what a kill loses."""

import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.base.registry import QUESTIONS
from r2h_batch.runs.files import RunError
from r2h_batch.runs.side import write_side
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.questions import Question, answers, kept_answers, parts

N = 10
JUDGE = SimpleNamespace(evaluator=SimpleNamespace(scene=SimpleNamespace(device="cpu")))
"""What the loop needs of a judge; the question here asks it nothing."""
HIGH = pa.schema([pa.field("trial_id", pa.int64(), nullable=False), pa.field("height_m", pa.float32())])
asked: list[tuple[str, list[int]]] = []


def heights(judge, part):
    """How high each stored pose is."""
    asked.append((part.entry.name, part.trial_id.tolist()))
    poses = part.tables["poses"]
    high = [T[11] for T in poses["T_world_ee"].to_pylist()]
    return pa.table({"trial_id": poses["trial_id"], "height_m": pa.array(high, pa.float32())}, schema=HIGH)


# a new question: this is all that it needs
QUESTION = Question("height", HIGH, 1, heights)
QUESTIONS.add(QUESTION.name, QUESTION)


@pytest.fixture
def run(tmp_path):
    asked.clear()
    outcomes = {"a": np.zeros(N, int), "b": np.zeros(N, int)}
    return write_run(tmp_path / "run", outcomes, N // 2, N // 2, stored=["details", "poses"], shard_trials=4)


def test_a_new_question_is_asked_kept_read_and_verified(run, capsys):
    found = kept_answers(QUESTION, run, run.methods, JUDGE)
    expected = [T[11] for T in run.poses("a")["T_world_ee"].to_pylist()]
    assert found["a"]["height_m"].to_pylist() == expected and len(found["b"]) == N
    assert run.side("a", "height", HIGH).equals(found["a"])
    assert run.side("a", "height").column_names == ["trial_id"]  # no table reads more of it
    assert main(["results", "verify", str(run.folder)]) == 0
    path = run.folder / "height" / "b.parquet"
    path.write_bytes(path.read_bytes()[:99])
    capsys.readouterr()
    assert main(["report", str(run.folder)]) == 2
    assert f"{path}: cannot be read" in (said := capsys.readouterr().err) and "results height" in said
    assert main(["results", "verify", str(run.folder)]) == 1 and not path.exists()
    assert main(["report", str(run.folder)]) == 0
    elsewhere = (run.folder / "height").rename(run.folder.parent / "elsewhere")
    (run.folder / "height").symlink_to(elsewhere)
    with pytest.raises(RunError, match="a symbolic link"):
        load_run(run.folder)


def test_answers_of_the_same_rows_are_kept_and_all_others_made_anew(run, tmp_path):
    first = kept_answers(QUESTION, run, run.methods, JUDGE)
    asked.clear()
    assert kept_answers(QUESTION, run, run.methods, JUDGE)["a"].equals(first["a"]) and asked == []
    kept_answers(Question("height", HIGH, 2, heights), run, ["a"], JUDGE)
    assert {name for name, _ in asked} == {"a"}
    asked.clear()
    kept_answers(QUESTION, run, ["a"], JUDGE)  # and back
    assert len(asked) == 3
    asked.clear()
    # a file that does not say what it was made of, as version 0.3 wrote them
    write_side(run.folder / "height" / "b.parquet", first["b"])
    kept_answers(QUESTION, run, run.methods, JUDGE)
    assert {name for name, _ in asked} == {"b"}
    asked.clear()
    # the same shards in another run, of other settings
    other = write_run(tmp_path / "other", {"a": np.ones(N, int)}, N // 2, N // 2, stored=["poses"], shard_trials=4)
    (other.folder / "height").mkdir()
    (run.folder / "height" / "a.parquet").rename(other.folder / "height" / "a.parquet")
    kept_answers(QUESTION, other, ["a"], JUDGE)
    assert len(asked) == 3


def test_a_kept_file_that_is_damaged_is_one_line_and_stays(run):
    kept_answers(QUESTION, run, ["a"], JUDGE)
    path = run.folder / "height" / "a.parquet"
    data = bytearray(path.read_bytes())
    chunk = pq.read_metadata(path).row_group(0).column(1)
    start = min(filter(None, (chunk.dictionary_page_offset, chunk.data_page_offset)))
    data[start + chunk.total_compressed_size - 1] ^= 1
    path.write_bytes(data)
    with pytest.raises(RunError) as error:
        kept_answers(QUESTION, run, ["a"], JUDGE)
    assert f"{path}: cannot be read" in str(error.value) and "\n" not in str(error.value)
    assert path.read_bytes() == data


KILLED = """
    import os, signal, sys
    sys.path[:0] = sys.argv[2:]
    import test_questions as t

    def heights(judge, part):
        if part.entry.name == "b" and len(t.asked) == 4:  # in the middle of the second method
            os.kill(os.getpid(), signal.SIGKILL)
        return t.heights(judge, part)

    run = t.load_run(sys.argv[1])
    t.kept_answers(t.Question("height", t.HIGH, 1, heights), run, run.methods, t.JUDGE)
"""


def test_a_kill_loses_nothing_of_the_methods_that_were_asked(run):
    places = [str(Path(__file__).parent), *sys.path]
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(run.folder), *places], capture_output=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    folder = run.folder / "height"
    assert [p.name for p in folder.iterdir()] == ["a.parquet"]
    before = (folder / "a.parquet").read_bytes()
    found = kept_answers(QUESTION, run, run.methods, JUDGE)
    assert {name for name, _ in asked} == {"b"} and (folder / "a.parquet").read_bytes() == before
    asked.clear()
    assert all(found[name].equals(whole(run, name)) for name in run.methods)


def whole(run, name):
    return pa.concat_tables(answers(QUESTION, run, name, JUDGE)).combine_chunks()


def test_parts_cover_the_chosen_rows_once_and_stay_within_shards(run):
    each = [p.trial_id for p in parts(run, "a", at_once=3)]
    assert [len(ids) for ids in each] == [3, 1, 3, 1, 2]
    assert np.concatenate(each).tolist() == sorted(run.trials("a")["trial_id"].to_pylist())
    chosen = np.array([0, 3, 9])
    own = list(parts(run, "a", positions=chosen, kinds=("trials", "poses")))
    ids = run.trials("a")["trial_id"].to_numpy()[chosen].tolist()
    assert [p.trial_id.tolist() for p in own] == [ids[:2], ids[2:]]
    assert all(p.tables["poses"]["trial_id"].to_pylist() == p.trial_id.tolist() for p in own)
    assert set(own[0].tables) == {"trials", "poses"}
