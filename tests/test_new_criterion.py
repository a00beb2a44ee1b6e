"""A sixth criterion touches two files: an entry and an outcome in verdicts.py, a function in judge/metrics.py."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "r2h_batch"
ENTRY = '    CriterionEntry("height", "f_height", "F_height", 5, "#666666", SPLITS, True),\n'
FUNCTION = '''

def height(e: Evidence) -> Criterion:
    """The object is handed over at least 0.3 m above the table."""
    return Criterion.of("height", e.held.T_world_ee[:, 2, 3] - 0.3, e.held.active)
'''
USE = """
import contextlib, io, sys, torch
from r2h_batch import EvalConfig
from r2h_batch.config import ExecConfig
from r2h_batch import verdicts
from r2h_batch.__main__ import main
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.runs.store import load_run
from r2h_batch.trials.protocol import trials_with_ids

assert verdicts.CRITERIA[5] == "height" and verdicts.__file__.startswith(sys.argv[1])
evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none")))
trials = trials_with_ids(torch.arange(24), objects=evaluator.scene.objects, protocol="r2h-v0")
poses = oracle.predict(trials, evaluator.scene, seed=0)
T = poses.T_world_ee.clone().requires_grad_()
scores = evaluator.score(poses.T_obj_ee, T, trials, stages="pose")
high = T[:, 2, 3] - 0.3 >= 0
assert scores.margin.shape == (24, 6) and torch.equal(scores.passed[:, 5], high) and 0 < high.sum() < 24
alone = ~high & scores.passed[:, :5].logical_or(~scores.evaluated[:, :5]).all(1)
assert (scores.outcome[alone] == verdicts.Outcome.HEIGHT).all() and not scores.success[~high].any()
scores.soft(temperature_m=0.01).sum().backward()
assert T.grad.isfinite().all()
assert "passed/height" in scores.scalars() and "height" in scores.summary()


def said(line):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(line.split()) == 0
    return out.getvalue()


said("sweep --method oracle --trials 6 --sim none --out run")
run = load_run("run")
rows = run.trials(run.methods[0]).to_pylist()
assert "height" in {r["outcome"] for r in rows} and all(abs(r["margin_height_m"]) < 2 for r in rows)
assert rows[0]["passed_height"] in (True, False)
for form, heading in (("md", "F_height"), ("latex", "height"), ("html", "F_height")):
    assert heading in said(f"report run --format {form}")
assert "F_height" in said("results rethreshold run --reach-radius .08,.1")
"""


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package with a sixth criterion: two files are changed, the others are links."""
    top = tmp_path_factory.mktemp("tree")
    made = top / "r2h_batch"
    (made / "judge").mkdir(parents=True)
    for folder in (PACKAGE, PACKAGE / "judge"):
        for path in folder.iterdir():
            place = made / path.relative_to(PACKAGE)
            if path.name != "__pycache__" and not place.exists():
                place.symlink_to(path)
    for name in ("kernels", "assets"):
        (made / name).symlink_to(PACKAGE.parent / name)
    words, metrics = made / "verdicts.py", made / "judge" / "metrics.py"
    text = words.read_text()
    text = text.replace(')\n"""The criteria in the order', f'{ENTRY})\n"""The criteria in the order')
    text = text.replace(
        "    INVALID_INPUT = 6\n    INVALID_SIM = 7\n", "    HEIGHT = 6\n    INVALID_INPUT = 7\n    INVALID_SIM = 8\n"
    )
    equations = metrics.read_text() + FUNCTION
    for file, changed in ((words, text), (metrics, equations)):
        file.unlink()
        file.write_text(changed)
    return top


def test_it_is_scored_last_and_rows_tables_the_page_and_rethresholding_know_it(tree: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    command = [sys.executable, "-c", USE, str(tree)]
    done = subprocess.run(command, env=environment, cwd=tree, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
