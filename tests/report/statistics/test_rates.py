"""One registry of rates: every outcome is in one of them, and a name that is taken is refused in a line."""

import os
import subprocess
import sys
from collections import Counter

import pytest
from rounds import each

from r2h_batch.report.statistics.rates import ASKED_FAILURES, FAILURES, OF_ALL, RATES, TIMES, shares
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.verdicts import ASKED, ELSEWHERE, NO_LONGER, NUMBERS, REGISTRY, SPLITS

CODE = """
from r2h_batch.plugins import PluginError

try:
    from r2h_batch.report.statistics.rates import shares
    print(*shares())
except PluginError as error:
    print(error)
"""
SHARE = """from r2h_batch.report.statistics.shares import Share

SLOW = Share("Slow", "Motions that take more than 8 s.", ("t_exec_s",))
"""
CRITERION = f"""from r2h_batch.verdicts import CriterionEntry

NEW = CriterionEntry("new", "RATE", "F_new", 5, "#666666", {SPLITS}, True, since="odd 1.0", function="odd:f")
"""


def said(folder, points, module):
    """What a fresh interpreter that finds this package prints of the shares."""
    info = folder / "odd-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[r2h_batch.plugins]\n{points}\n")
    (folder / "odd.py").write_text(module)
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    line = [sys.executable, "-c", CODE]
    done = subprocess.run(line, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else done.stderr


def test_every_outcome_is_in_one_rate_and_each_rate_says_what_it_is():
    rates = {n: RATES[n] for n in RATES}
    counted = Counter(o for n in rates for o in rates[n].outcomes)
    assert counted == Counter(o for o in OUTCOME_NAMES if o not in (*NO_LONGER, ELSEWHERE))
    assert set(NUMBERS) == rates.keys() - {entry.rate for entry in (*REGISTRY, *ASKED)}
    assert OF_ALL.keys() | ASKED_FAILURES.keys() | set(TIMES) | shares().keys() == rates.keys()
    for name, rate in each(rates.items()):
        assert rate.heading and rate.caption.endswith((".", ")")) and rate.unit == ("s" if name in TIMES else "%")
        assert rate.higher == (None if rate.is_share else name == "sr")
    assert list(FAILURES.values()) == sorted(REGISTRY, key=lambda e: e.column)
    assert list(ASKED_FAILURES.values()) == list(ASKED)


def test_a_share_of_another_package_enters_behind_ours(tmp_path):
    assert said(tmp_path, "share.slow = odd:SLOW", SHARE).split() == [*shares(), "slow"]


@pytest.mark.parametrize(
    "name", ["sr", "f_plan", "missing", "presented", "t_exec_s", "n", "n_plan", "slow_low", "split"]
)
def test_a_share_whose_name_is_taken_is_refused_in_a_line(name, tmp_path):
    text = said(tmp_path, f"share.{name} = odd:SLOW", SHARE)
    assert text.count("\n") == 1 and f"{name!r}" in text and "rename it" in text


@pytest.mark.parametrize("rate", ["sr", "f_plan", "f_pick", "missing", "presented"])
def test_a_criterion_whose_rate_is_taken_is_refused_in_a_line(rate, tmp_path):
    text = said(tmp_path, "criterion.new = odd:NEW", CRITERION.replace("RATE", rate))
    assert text.count("\n") == 1 and f"{rate!r}" in text
