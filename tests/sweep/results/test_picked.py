"""The command `results picked`: which objects the arm can pick from the table with the stored grasps."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from r2h_batch.__main__ import main
from r2h_batch.judge.pick import PickReason, picked
from r2h_batch.observe import moments
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.picked import CAUSES, MADE_OF, SCHEMA
from r2h_batch.sweep.results.reevaluation import Judge

QUICK = ["--sim", "none", "--quiet"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("picked") / "run"
    sweep = ["sweep", "--method", "random", "handover-va", "--trials", "3", "--out", str(folder), *QUICK]
    assert main(sweep) == 0
    return folder


@pytest.mark.check
def test_every_stored_pose_has_a_row_with_reason_margin_and_witness(run, capsys):
    assert main(["results", "picked", str(run)]) == 0
    shown = capsys.readouterr().out
    assert "Objects that the arm can pick" in shown and "What the robot meets at the grasp and on the way in" in shown
    stored, judge = load_run(run), Judge(load_run(run))
    scene, some = judge.evaluator.scene, []
    for entry in stored.entries:
        table = pq.read_table(run / "picked" / f"{entry.slug}.parquet")
        assert table.schema.remove_metadata().equals(SCHEMA) and len(table) == 6
        rows = table.to_pylist()
        some += rows
        poses = {r["trial_id"]: r["T_obj_ee"] for r in stored.poses(entry.name).to_pylist()}
        ids = np.array([r["trial_id"] for r in rows])
        trials = judge.trials(ids)
        grasps = torch.tensor([poses[i] for i in ids.tolist()]).reshape(-1, 4, 4)
        again = picked(scene, grasps, moments(scene, trials), trials)
        for i, row in enumerate(rows):
            assert row["picked"] == bool(again.picked[i]) == (row["pick_reason"] == "ok")
            assert row["pick_reason"] == PickReason(int(again.reason[i])).name.lower()
            margin = float(again.margin_m[i])
            assert row["pick_m"] is None if np.isinf(margin) else np.float32(row["pick_m"]) == np.float32(margin)
            body = int(again.body[i])
            assert row["pick_part"] == (scene.part_names[body] if body >= 0 else None)
        share = 100 * sum(r["picked"] for r in rows) / 6
        word = "random" if "random" in entry.name else "Handover-VA"
        line = next(x for x in shown.splitlines() if x.startswith(word))
        assert f"{share:.1f}" in line.split("|")[2]
    assert {r["picked"] for r in some} == {True, False} and any(r["pick_pair"] == "table" for r in some)
    assert main(["results", "verify", str(run)]) == 0


def test_a_table_of_the_same_rows_is_kept_and_one_of_another_seed_is_made_anew(run, capsys):
    assert main(["results", "picked", str(run)]) == 0
    paths = sorted((run / "picked").iterdir())
    before = [p.read_bytes() for p in paths]
    stamps = [p.stat().st_mtime_ns for p in paths]
    assert main(["results", "picked", str(run)]) == 0
    assert [p.stat().st_mtime_ns for p in paths] == stamps
    assert main(["results", "picked", str(run), "--seed", "3", "--method", "random"]) == 0
    changed = [p for p, old in zip(paths, before, strict=True) if p.read_bytes() != old]
    assert [p.stem for p in changed] == ["random"]
    assert json.loads(pq.read_schema(changed[0]).metadata[MADE_OF])["seed"] == 3


def test_every_reason_but_ok_is_in_one_column_of_the_table():
    listed = [r for of in CAUSES.values() for r in of]
    assert sorted(listed) == sorted(set(PickReason) - {PickReason.OK}) and len(set(listed)) == len(listed)


def test_a_link_in_the_tables_place_and_a_run_with_errors_of_execution_are_refused(run, tmp_path, capsys):
    erring = tmp_path / "erring"
    flags = ["--execution-error", "5mm,1deg"]
    assert main(["sweep", "--method", "random", "--trials", "1", "--out", str(erring), *flags, *QUICK]) == 0
    capsys.readouterr()
    assert main(["results", "picked", str(erring)]) == 2
    assert "execution_error moves the grasps" in capsys.readouterr().err
    (tmp_path / "elsewhere").mkdir()
    (erring / "picked").symlink_to(tmp_path / "elsewhere")
    assert main(["results", "picked", str(erring)]) == 2
    assert not any((tmp_path / "elsewhere").iterdir())
    assert main(["results", "picked", str(run), "--seed", "-1"]) == 2


def test_a_benchmark_of_hands_alone_is_judged_too(tmp_path, capsys):
    folder = tmp_path / "hands"
    sweep = ["sweep", "--benchmark", "r2h-v0", "--method", "random", "--trials", "2", "--out", str(folder), *QUICK]
    assert main(sweep) == 0
    assert main(["results", "picked", str(folder)]) == 0
    assert len(pq.read_table(folder / "picked" / "random.parquet")) == 4
