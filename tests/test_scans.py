"""Meshes of a user beside Table I: bench/scans.py, and what it stored (docs/results/questions.md)."""

import argparse
import json
import re
import subprocess
from pathlib import Path

import pytest
import trimesh
from rounds import each

from r2h_batch.base.errors import FileError
from r2h_batch.report.table import record, table_of
from r2h_batch.runs.store import load_run
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited

ROOT = Path(__file__).resolve().parents[1]
PLACE = re.compile(r"(?<![\w.~-])/(?:work|tmp|home|root|Users|mnt|opt|usr|srv|var|private)/")


@pytest.fixture
def scans(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "bench")
    import scans

    return scans


def stored(name="scans"):
    return json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text("utf-8"))


def test_no_committed_json_names_a_place_on_a_machine():
    listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", "*.json"], capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no checkout")
    for name in each(listed.stdout.splitlines()):
        text = (ROOT / name).read_text("utf-8")
        assert not PLACE.search(text) and str(ROOT) not in text, name


def asked(folder, about, **other):
    return argparse.Namespace(folder=folder, about=about, trials=2, trials_v3=2, methods=["random"], json=None, **other)


def test_rows_and_json_of_a_folder_do_not_say_where_it_is(scans, tmp_path, monkeypatch):
    import _rows

    home, meshes = tmp_path / "checkout", tmp_path / "meshes"
    meshes.mkdir()
    home.mkdir()
    for module in (scans, _rows):
        monkeypatch.setattr(module, "ROOT", home)
    monkeypatch.chdir(tmp_path)
    for name in ("brick", "post"):
        trimesh.creation.box((0.05, 0.06, 0.12)).export(meshes / f"{name}.obj")
    about = tmp_path / "scans.toml"
    post = '[post]\ncategory = "bottle"\nregion = "z<0.4"\ncreator = "a box"\nlicence = "none"\n'
    about.write_text('source = "a test"\nmade = "by trimesh"\n' + post)
    found = scans.measure(asked(meshes, about), None)
    rows = home / "bench" / "options" / "scans"
    for file in each([p for p in rows.rglob("*") if p.is_file()]):
        assert b"meshes/" not in file.read_bytes() and str(tmp_path).encode() not in file.read_bytes(), file
    text = json.dumps(found)
    assert str(tmp_path) not in text and not PLACE.search(text)
    assert [(o["name"], o["split"], o.get("region")) for o in found["objects"]] == [
        ("brick", "S0", None),
        ("post", "S1", "z<0.4"),
    ]
    for rates in (found["rates"], found["rates_v3"]):
        assert rates["random"]["S0"]["n"] == rates["random"]["S1"]["n"] == 2
    assert found["origin"] == {"source": "a test", "made": "by trimesh"}
    monkeypatch.setattr(scans, "ROOT", ROOT)
    assert (
        home / "runs" / "scans-objects" / "post.yaml"
    ).read_text() == 'split: S1\nreceiver: "z<0.4"\ncategory: bottle\n'
    shown = scans.tables(found | {"commit": "1" * 40})
    assert shown["number"] == 2 and "| random |" in shown["table"]
    monkeypatch.setattr(scans, "ROOT", home)
    about.write_text('[vase]\nregion = "z<0.4"\n')
    with pytest.raises(SystemExit, match=r"--about names vase, and .* has no such mesh"):
        scans.measure(asked(meshes, about), None)
    with pytest.raises(SystemExit, match="no mesh is there; give a folder with files of"):
        scans.measure(asked(home, about), None)
    with pytest.raises(SystemExit, match=r"give --about bench/SET\.toml, SET one of scanned, scans"):
        scans.measure(asked(meshes, None), None)


def test_a_mesh_names_the_category_that_its_predictor_must_not_have_seen(tmp_path):
    trimesh.creation.box((0.05, 0.06, 0.12)).export(tmp_path / "post.obj")
    beside = tmp_path / "post.yaml"

    def found():
        (model,) = edited(BenchmarkChoice(benchmark="r2h-v2", objects=str(tmp_path))).objects
        return model.who.category

    assert found() is None
    beside.write_text("category: hammer\n")
    assert found() == "hammer"
    beside.write_text("category: hamer\n")
    with pytest.raises(FileError, match="category"):
        found()
    (tmp_path / "all.yaml").write_text("objects:\n- {built_in: cup, category: hammer}\n")
    with pytest.raises(FileError, match="object cup: a built-in object has its own category; leave category out"):
        edited(BenchmarkChoice(benchmark="r2h-v2", objects=str(tmp_path / "all.yaml")))


@pytest.mark.parametrize("name", ["scanned", "scans"])
def test_the_stored_rates_are_those_of_the_stored_rows(name):
    data, run = stored(name), load_run(ROOT / "bench" / "options" / name)
    words = [*data["rates"]]
    names = {e.name: word for e, word in zip(run.entries, words, strict=True)}
    for row in each([r for r in table_of(run).rows if r.split != "Avg"]):
        now, then = record(row), data["rates"][names[row.method]][row.split]
        assert now["n"] == data["trials"] and {k: now[k] for k in then} == then
    assert {o["name"] for o in data["objects"]} == {o["name"] for o in run.header["objects"]}
    assert all(o["licence"] and o["creator"] for o in data["objects"])
    assert {o["name"] for o in data["objects"] if o["split"] == "S1"} == {*data["areas"]["contact"]}


@pytest.mark.parametrize("name", ["scanned", "scans"])
def test_the_stored_rows_are_a_column_of_table_one(capsys, name):
    from r2h_batch.__main__ import main

    folder = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2-as-planned"
    assert main(["report", str(folder), "--scans", str(ROOT / "bench" / "options" / name), "--format", "json"]) == 0
    data = stored(name)
    for row in each(json.loads(capsys.readouterr().out)["rows"]):
        if row["split"] != "Avg" and row["method"] in ("random", "oracle"):
            assert row["sr_scans"] == pytest.approx(data["rates"][row["method"]][row["split"]]["sr"])
