"""docs/your_data.md says what there is: every flag, field and array that the page names, and its examples."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.methods.predictors import read_observations
from r2h_batch.trials.file_fields import BenchmarkFile, read_benchmark_file, read_object_file
from r2h_batch.trials.trials_file import read_trials_file

PAGE = (Path(__file__).resolve().parents[1] / "docs/your_data.md").read_text()
CODE = {kind: re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S) for kind in ("yaml", "python")}

pytestmark = pytest.mark.check


def test_every_flag_and_option_of_the_page_is_one(capsys):
    known = {"--yaml", "--schema"}
    imports = (["import", what] for what in ("hand", "hands", "grasps", "objects", "trials"))
    for line in (["sweep"], *imports, ["export", "trials"], ["export", "scene"], ["export", "release"]):
        with pytest.raises(SystemExit):
            main([*line, "--help" if line[0] == "import" else "--help-all"])
        known |= set(re.findall(r"--[a-z][a-z.-]+", capsys.readouterr().out))
    flags = set(re.findall(r"--[a-z][a-z.-]*[a-z]", re.sub(r"`python bench/.*?`", "", PAGE)))
    assert len(flags) > 20 and flags <= known, flags - known


def test_the_yaml_of_the_page_is_a_benchmark_file_and_names_all_its_fields(tmp_path):
    named = set()
    for i, text in enumerate(CODE["yaml"]):
        path = tmp_path / f"{i}.yaml"
        path.write_text(text)
        if set(yaml.safe_load(text)) <= set(BenchmarkFile.model_fields):
            assert isinstance(read_benchmark_file(path), BenchmarkFile)
            named |= set(yaml.safe_load(text))
        else:  # what lies beside a mesh
            assert read_object_file(path, "saw.obj").file == "saw.obj"
    assert named | {"format", "trials", "seed"} == set(BenchmarkFile.model_fields)


def test_the_python_of_the_page_writes_files_that_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    default, base = load_benchmark(), load_benchmark("r2h-v1")  # the page names none for its trials
    for text in CODE["python"]:
        if "np.savez" in text:
            (tmp_path / "x.py").write_text(text)
            runpy.run_path("x.py")
    trials, _, _ = read_trials_file(tmp_path / "two.npz", default.objects, default.hand_set)
    assert [default.objects[i].name for i in trials.object_index.tolist()] == ["cup_00", "hammer_00"]
    seen = read_observations(base.objects, base.hand_set.model, hands="exact.npz")
    seen.check_trials(load_benchmark("r2h-v1").trials(5).trial_id.numpy())
    assert seen.sources() == {"target": "exact"} and np.load("exact.npz")["trial_id"].shape == (10,)
