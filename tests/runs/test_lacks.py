"""A trial or a method that a run does not have is told before torch is imported, which takes four seconds."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from made_runs import write_run
from rounds import each

from r2h_batch.runs.files import RunError
from r2h_batch.verdicts import Outcome

TOLD = """
import contextlib, io, sys
from pathlib import Path
from r2h_batch.__main__ import main
run, out, *lines = sys.argv[1:]
for line in lines:
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = main([{"RUN": run}.get(word, word.replace("OUT", out)) for word in line.split()])
    if code != 2 or "torch" in sys.modules: sys.exit(f"{line}: exit code {code}, torch in {'torch' in sys.modules}")
    print(said.getvalue().splitlines()[-1])
"""
NO_METHOD, NO_TRIAL = "no method 'randm', did you mean random?; it has random, m", "has no trial 99999; it has 12: 0, 1"
SEVERAL, UNJUDGED = "choose one with --method: random, m", "trial 3 of 'm' was not judged (invalid_input)"
REFUSED = (
    ("why RUN 1 --method randm", NO_METHOD),
    ("why RUN 99999", NO_TRIAL),
    ("why RUN -1", "no trial has the id '-1'; there are 12: 0, 1"),
    ("why RUN cup", "no trial has the id 'cup'; trials of this object are 1, 4"),
    ("view RUN --method randm", NO_METHOD),
    ("view RUN --trial 99999", NO_TRIAL),
    ("view RUN --one-of-each --html OUT/x.html --method randm", NO_METHOD),
    ("view RUN --trial 99999 --method m --html OUT/x.html", NO_TRIAL),
    ("view RUN --trial 1 --strips OUT/x.png", SEVERAL),
    ("view RUN --trial 3 --method random m --strips OUT/x.png", UNJUDGED),
    ("view RUN --trial 99999 --sees OUT/x.png", "has 6 of S0, 6 of S1"),
    ("export scene RUN --trial 1 --method randm --out OUT/x", NO_METHOD),
    ("export scene RUN --trial 99999 --method m --out OUT/x", NO_TRIAL),
    ("export scene RUN --trial abc --method m --out OUT/x", "no trial has the id 'abc'"),
    ("export real RUN --method randm --out OUT/x", NO_METHOD),
    ("export real RUN --trials 3,99999 --out OUT/x", "the run has no trial 99999"),
    ("export release RUN --method randm --out OUT/x", NO_METHOD),
    ("export release RUN --out OUT/x", SEVERAL),
    ("results reception RUN --method randm", NO_METHOD),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    outcome = np.zeros(12, int)
    outcome[3] = Outcome.INVALID_INPUT
    return write_run(tmp_path_factory.mktemp("lacks") / "run", {"random": np.zeros(12, int), "m": outcome}, 6, 6)


def test_every_command_tells_it_before_torch_is_imported(run, tmp_path):
    lines = [line for line, _ in REFUSED]
    done = subprocess.run(
        [sys.executable, "-c", TOLD, str(run.folder), str(tmp_path), *lines], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for (line, words), said in each(zip(REFUSED, done.stdout.splitlines(), strict=True)):
        assert words in said, (line, said)
    assert not list(tmp_path.iterdir())


def test_a_run_names_the_complete_methods_that_hold_a_trial(run):
    assert run.holding(5, ["m", "random"]) == ["m", "random"]
    assert run.holding(3, ["random"]) == ["random"] and run.holding(3, ["m"], judged=False) == ["m"]
    assert run.only(["m"]).holding(5) == ["m"] and run.only(["m"]).complete() == "m"
    with pytest.raises(RunError, match="has several methods"):
        run.holding(5)
    with pytest.raises(RunError, match=r"not judged \(invalid_input\): there is nothing to show"):
        run.holding(3, ["random", "m"])
    with pytest.raises(RunError, match=r"'m' has no trial 12; it has 12: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ... up to 11$"):
        run.holding(12, ["m"])


def test_a_method_with_shards_to_score_holds_nothing(run):
    whole, half = run.entries
    begun = replace(run, entries=(whole, replace(half, shards={})))
    assert begun.complete() == "random"
    with pytest.raises(RunError, match="'m' is not complete; run its sweep again to go on"):
        begun.holding(5, ["m"])
    with pytest.raises(RunError, match="no method is complete"):
        begun.only(["m"]).complete()
