"""Comfort ratings beside a run's measures: the rank correlation is scipy's over objects."""

import numpy as np
import pytest
from made_runs import OBJECTS, write_run
from scipy import stats

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.sweep.study.comfort import comfort_report


def rated(path, ratings):
    lines = [f"{o},S1,{i},3,{r}" for o, values in ratings.items() for i, r in enumerate(values)]
    path.write_text("\n".join(["object,capture,handover,giver,receiver", *lines]) + "\n")
    return path


def test_comfort_goes_with_success_as_the_ranks_of_the_objects_say(tmp_path, capsys):
    solved = dict(zip(OBJECTS, (2, 5, 9, 14, 17, 20)))  # of 20 trials of each object
    outcome = [0 if k // 3 < solved[OBJECTS[k % 3]] else 2 for k in range(60)]
    outcome += [0 if k // 3 < solved[OBJECTS[3 + k % 3]] else 2 for k in range(60)]
    run = write_run(tmp_path / "run", {"m": np.array(outcome)}, 60, 60)
    ratings = {o: [k, k + 1] for o, k in zip(OBJECTS, (1, 3, 2, 5, 4, 6))}
    file = rated(tmp_path / "comfort.csv", {**ratings, "elsewhere": [1]})
    assert main(["study", "comfort", str(run.folder), str(file)]) == 0
    said = capsys.readouterr().out
    rho = stats.spearmanr([1.5, 3.5, 2.5, 5.5, 4.5, 6.5], list(solved.values())).statistic
    (line,) = [x for x in said.splitlines() if x.startswith("| m ")]
    cells = [c.strip() for c in line.strip("|").split("|")]
    assert cells[1:5] == ["6", "12", "4.00", f"{100 * sum(solved.values()) / 120:.1f}"]
    assert cells[5].startswith(f"{rho:+.2f} [") and cells[6] == "n/a", "S1 has three objects"


def test_a_run_without_the_rated_objects_is_refused(tmp_path):
    run = write_run(tmp_path / "run", {"m": np.zeros(12, int)}, 6, 6)
    with pytest.raises(FileError, match="has 1 of the rated objects"):
        comfort_report(run.folder, rated(tmp_path / "comfort.csv", {"cup": [4], "elsewhere": [1]}))
