"""Faults of other packages: one line that names package and entry, exit code 1, and nothing of ours changes."""

import json
import os
import subprocess
import sys
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch.judge import foreign
from r2h_batch.judge.metrics import Criterion, Evidence
from r2h_batch.plugins import PackageError
from r2h_batch.verdicts import REGISTRY


def package(folder, points, **modules):
    """A package as pip leaves it."""
    info = folder / "strange-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: strange\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[r2h_batch.plugins]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()))
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)


def python(folder, code, *words):
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    return subprocess.run(
        [sys.executable, *(words or ("-c", code))],
        env={**os.environ, "PYTHONPATH": path}, cwd=folder, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


# --- what a criterion is called ------------------------------------------------------------------------------------

GOOD = (
    "def entry(name, **more):\n    given = dict(rate='f_odd', heading='F_odd', column=9, color='#123456', splits=SPLITS,\n"
    "        touching_passes=True, since='1.0', function='equations:odd') | more\n    return CriterionEntry(name, **given)\n"
)
WRONG_ENTRIES = {
    **{name: ("entry(NAME)", words) for name, words in {
        "plan": "calls a criterion 'plan', and so does r2h_batch", "pick": "so does r2h_batch", "received": "so does r2h_batch",
        "success": "name is 'success'", "invalid_input": "name is 'invalid_input'", "missing": "name is 'missing'",
        "taken": "name is 'taken'", "S0": "name is 'S0'", "s0": "name is 's0'", "other_criterion": "name is 'other_criterion'",
        "kind": "", "good": "",
    }.items()},
    "a_dict": ("{'name': NAME}", "it must be a CriterionEntry of that name"),
    "another": ("entry('one')", "it must be a CriterionEntry of that name"),
    "rate": ("entry(NAME, rate='f_plan')", "rate is 'f_plan'"),
    "number": ("entry(NAME, rate='t_plan_s')", "rate is 't_plan_s'"),
    "low": ("entry(NAME, rate='f_odd_low')", "rate is 'f_odd_low'"),
    "heading": ("entry(NAME, heading='F_plan')", "heading is 'F_plan'"),
    "lines": ("entry(NAME, heading='a\\nb')", "heading is 'a\\nb'"),
    "color": ("entry(NAME, color='red')", "color is 'red'"),
    "splits": ("entry(NAME, splits='S0')", "splits is 'S0'; it must be a tuple"),
    "column": ("entry(NAME, column='9')", "column is '9'; it must be a int"),
    "since": ("entry(NAME, since='')", "since is ''"),
    "no_function": ("entry(NAME, function='')", "function is ''"),
    "applies": ("entry(NAME, applies=3)", "applies is 3"),
    "leaves": ("__import__('sys').exit(0)", "cannot be imported (SystemExit: 0)"),
    "ends": ("__import__('os')._exit(0)", "cannot be imported (Ended: os._exit(0) ends the process"),
    "raises": ("1 / 0", "cannot be imported (ZeroDivisionError: division by zero)"),
    "own": ("None", "it must be a CriterionEntry of that name"),
}  # fmt: skip
"""Name -> the entry, and words of the line about it; none where it is fine."""
ONE_BY_ONE = """
import importlib, json, sys
from r2h_batch import plugins
every, said = plugins.installed(), {}
for point in every:
    plugins.installed = lambda: (point,)
    sys.modules.pop("r2h_batch.verdicts", None)
    try:
        importlib.import_module("r2h_batch.verdicts")
    except plugins.PluginError as error:
        said[point.name] = [str(error), error.exit_code]
    else:
        said[point.name] = ["", 0]
print(json.dumps(said))
"""


@pytest.mark.check
def test_a_criterion_that_is_none_or_has_a_name_that_is_taken_is_refused_with_package_and_entry(tmp_path):
    head = f"from r2h_batch.verdicts import CriterionEntry, SPLITS\n{GOOD}"
    modules = {f"of_{name}": f"NAME = '{name}'\n{head}X = {text}\n" for name, (text, _) in WRONG_ENTRIES.items()}
    package(tmp_path, {f"criterion.{name}": f"of_{name}:X" for name in WRONG_ENTRIES}, **modules)
    done = python(tmp_path, ONE_BY_ONE)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    for name, (_, words) in each(WRONG_ENTRIES.items()):
        line, code = said[f"criterion.{name}"]
        assert words in line and code == bool(words) and "\n" not in line, (name, line)
        assert not words or "package strange" in line, line


def test_commands_end_with_one_line_and_1_where_a_package_cannot_be_had(tmp_path):
    package(tmp_path, {"criterion.odd": "strange:X"}, strange="import sys\nprint('hello')\nsys.exit(0)\n")
    for words in (("-m", "r2h_batch", "report", "nothing"), ("-m", "r2h_batch.sweep", "--method", "fc", "--out", "x")):
        done = python(tmp_path, "", *words)
        assert (done.returncode, done.stdout) == (1, "")
        line = "criterion.odd = strange:X of package strange cannot be imported (SystemExit: 0); mend the package or uninstall it"
        assert done.stderr.splitlines()[-2:] == [
            "criterion.odd = strange:X of package strange printed: hello",
            f"{'report' if 'report' in words else 'sweep'}: {line}",
        ]


# --- what a criterion answers --------------------------------------------------------------------------------------

B = 5
ACTIVE = torch.ones(B, dtype=torch.bool)
X = torch.full((B,), 0.01)


def raise_(error):
    raise error


WRONG_ANSWERS = {
    "nothing": (lambda e: None, "answers NoneType; it must be a Criterion"),
    "a tensor": (lambda e: X, "answers Tensor"),
    "one number": (lambda e: Criterion(torch.tensor(1.0), ACTIVE), r"number is a tensor () of"),
    "two columns": (lambda e: Criterion(X[:, None].repeat(1, 2), ACTIVE), "number is a tensor (5, 2)"),
    "a row more": (lambda e: Criterion(torch.ones(B + 1), ACTIVE), "number is a tensor (6,)"),
    "one row": (lambda e: Criterion(X, ACTIVE[:1]), "evaluated is a tensor (1,)"),
    "float64": (lambda e: Criterion(X.double(), ACTIVE), "number is a tensor (5,) of torch.float64"),
    "int64": (lambda e: Criterion(X.long(), ACTIVE), "number is a tensor (5,) of torch.int64"),
    "meta": (lambda e: Criterion(X.to("meta"), ACTIVE), "number has no memory"),
    "sparse": (lambda e: Criterion(X.to_sparse(), ACTIVE), "number is a tensor of layout sparse_coo"),
    "a list": (lambda e: Criterion([0.0] * B, ACTIVE), "number is [0.0"),
    "passed": (lambda e: Criterion(X, ACTIVE, passed=X), "passed is a tensor (5,) of torch.float32"),
    "kind": (
        lambda e: Criterion(X, ACTIVE, kind=torch.full((B,), 99, dtype=torch.int8)),
        "kind is 99 to 99; it must be 0 to 3",
    ),
    "code": (lambda e: Criterion(X, ACTIVE, kind=ACTIVE.int(), kind_of=(1,)), "kind is 1 to 1; it must be 0 to 0"),
    "kind_of": (lambda e: Criterion(X, ACTIVE, kind=ACTIVE.int(), kind_of=(1, 77)), "kind_of is (1, 77)"),
    "cap": (lambda e: Criterion(X, ACTIVE, cap="far"), "cap is 'far'"),
    "limit": (lambda e: Criterion(X, ACTIVE, limit=float("nan")), "limit is nan"),
    "infinite": (lambda e: Criterion(torch.full((B,), torch.inf), ACTIVE), "margin of +inf"),
    "raises": (lambda e: raise_(RuntimeError("no equation")), "RuntimeError: no equation (" + __file__),
    "leaves": (lambda e: sys.exit(0), "SystemExit: 0"),
    "ends": (lambda e: os._exit(0), "os._exit(0) ends the process"),
}
FINE_ANSWERS = {
    "plain": lambda e: Criterion(X, ACTIVE),
    "NaN": lambda e: Criterion(torch.full((B,), torch.nan), ACTIVE),
    "a cap": lambda e: Criterion(torch.full((B,), torch.inf), ACTIVE, cap=0.1),
    "nowhere": lambda e: Criterion(torch.full((B,), torch.inf), ~ACTIVE),
    "of NumPy": lambda e: Criterion(X, ACTIVE, limit=np.float32(0.5)),
    "every second": lambda e: Criterion(X.repeat(2)[::2], ACTIVE),
    "kinds": lambda e: Criterion(X, ACTIVE, passed=ACTIVE, kind=ACTIVE.to(torch.int8)),
}
ENTRY = REGISTRY[1]._replace(function="strange:equation")


def asked(answer, evidence=None):
    return foreign.ask(ENTRY, lambda: answer, evidence, ACTIVE, Criterion)


def test_an_answer_that_cannot_be_read_is_one_line():
    for name, (answer, words) in each(WRONG_ANSWERS.items()):
        with pytest.raises(PackageError) as error:
            asked(answer)
        assert words in str(error.value) and str(error.value).startswith("criterion plan of "), (name, str(error.value))
        assert "\n" not in str(error.value)
    for name, answer in each(FINE_ANSWERS.items()):
        assert isinstance(asked(answer), Criterion), name


def test_a_criterion_writes_into_copies_alone():
    held = SimpleNamespace(active=ACTIVE)  # no dataclass: as it is
    near = Criterion(X.clone(), ACTIVE.clone())  # any dataclass
    found = {"held": held, "clearance_m": X.clone(), "reason": ACTIVE.int(), "nearest": near}
    evidence = Evidence(**dict.fromkeys(f.name for f in fields(Evidence)) | found)

    def writes(e):
        e.clearance_m.zero_()
        e.nearest.number.numpy()[:] = 9.0
        object.__setattr__(e.nearest, "evaluated", None)
        object.__setattr__(e, "reason", None)
        return Criterion(X, ACTIVE)

    asked(writes, evidence)
    assert torch.equal(evidence.clearance_m, X) and torch.equal(near.number, X)
    assert near.evaluated is not None and evidence.reason is not None


# --- in commands -----------------------------------------------------------------------------------------------------

STRANGE = f"""
import os, sys
from r2h_batch.verdicts import CriterionEntry, SPLITS
{GOOD}
DOES = {{}}
def applies(model):
    if DOES.get("applies"): raise RuntimeError("no applies")
    return True
X = entry("odd", applies=applies)
"""
EQUATIONS = """
import os, sys, torch, strange
from r2h_batch.judge.metrics import Criterion
def odd(e):
    does = strange.DOES.get("odd")
    number = torch.full((len(e.held.active),), 0.01)
    found = Criterion(number, e.held.active.clone())
    if does == "writes":
        print("hello"); os.write(1, b"past python"); torch.set_grad_enabled(False); os.chdir("/")
        e.clearance_m.fill_(-5.0); e.held.active.zero_(); e.held.grasp.margin_m.fill_(-9.0); e.nearest.distance_m.zero_()
    if does == "raises":
        raise RuntimeError("no equation")
    if does == "wide":
        return Criterion(number[:, None], found.evaluated)
    return found
"""
MORE = """
import pyarrow as pa, strange, sys
from r2h_batch.report.statistics.rates import Share
def of(rows):
    does = strange.DOES.get("share")
    if does == "raises": raise RuntimeError("no share")
    if does == "exits": sys.exit(0)
    return [True] if does == "list" else pa.array([True] * len(rows))
SHARE, SEVEN = Share("Odd share", "Rows that are odd.", (), of), 7
def bench():
    if strange.DOES.get("bench") == "exits": sys.exit(0)
    return 7
def method(trials, scene):
    from r2h_batch.methods.random import predict
    return predict(trials, scene, seed=0)
"""
POINTS = {
    "criterion.odd": "strange:X",
    "share.odd_share": "more:SHARE",
    "benchmark.none": "more:bench",
    "benchmark.seven": "more:SEVEN",
    "method.seven": "more:SEVEN",
    "method.gone": "nowhere:f",
    "method.mine": "more:method",
    "policy.seven": "more:SEVEN",
    "family.seven": "more:SEVEN",
}
COMMANDS = """
import contextlib, io, json, os
import r2h_batch.verdicts, strange
from r2h_batch.__main__ import main

top, found, said = os.getcwd(), [], []
def run(does, *words):
    strange.DOES.clear()
    strange.DOES.update(does)
    os.chdir(top)
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(list(words))
    found.append([code, out.getvalue(), err.getvalue()])

def sweep(does, out, *more, method="random"):
    line = ["--benchmark", "r2h-v0", "--trials", "3", "--execute.sim", "none", "--format", "json"]
    run(does, "sweep", "--method", *method.split(), *line, "--out", out, *more)

sweep({}, "fine")
sweep({"odd": "writes"}, "writes")
sweep({}, "mine", method="mine")
sweep({"odd": "raises"}, "raises")
sweep({}, "raises")
sweep({"odd": "wide"}, "wide")
for does in ("raises", "exits", "list"):
    run({"share": does}, "report", "fine")
for does in ("exits", "seven"):
    sweep({"bench": does}, "none", "--benchmark", "none")
sweep({}, "none", "--benchmark", "seven")
sweep({}, "none", method="seven random")
sweep({}, "none", method="gone")
sweep({}, "none", "--objects", "families:seven x 2")
sweep({}, "none", "--receiver-motion", "moves", "--policy", "seven")
from r2h_batch.judge import metrics
metrics._concerned.cache_clear()
sweep({"applies": "raises"}, "none")
rows = {name: r2h_batch.runs.store.load_run(name).trials("random").to_pylist() for name in ("fine", "writes", "raises")}
for table in rows.values():
    for row in table:
        for key in [k for k in row if k.startswith("t_")]:
            del row[key]
os.write(1, json.dumps([found, rows["fine"] == rows["writes"] == rows["raises"], os.path.exists("none")]).encode())
"""
FOUND = (
    (0, ""),
    (0, "criterion.odd = strange:X of package strange printed: hello"),
    (0, ""),
    (1, "sweep: criterion.odd = strange:X of package strange: RuntimeError: no equation ("),
    (0, ""),
    (1, "sweep: criterion.odd = strange:X of package strange: its answer's number is a tensor (6, 1)"),
    (1, "report: share.odd_share = more:SHARE of package strange: RuntimeError: no share ("),
    (1, "report: share.odd_share = more:SHARE of package strange: SystemExit: 0 ("),
    (1, "report: share.odd_share = more:SHARE of package strange: answers a list for "),
    (1, "sweep: benchmark.none = more:bench of package strange: SystemExit: 0 ("),
    (1, "sweep: benchmark.none = more:bench of package strange returned 7; it must return a Benchmark"),
    (1, "sweep: benchmark.seven = more:SEVEN of package strange: is 7; it must be a function"),
    (1, "sweep: method.seven = more:SEVEN of package strange: is 7; it must be a function"),
    (1, "sweep: method.gone = nowhere:f of package strange cannot be imported (ModuleNotFoundError"),
    (1, "sweep: family.seven = more:SEVEN of package strange: is 7; a family is a generator"),
    (1, "sweep: policy.seven = more:SEVEN of package strange: is 7; it must be a function or a class"),
    (1, "sweep: criterion.odd = strange:X of package strange: its `applies` raised RuntimeError: no applies"),
)
"""Exit code and a line of stderr of each command above."""


@pytest.mark.whole(part="changes")
def test_each_fault_is_one_line_and_the_rows_of_others_stay(tmp_path):
    pytest.importorskip("gymnasium")
    package(tmp_path, POINTS, strange=STRANGE, equations=EQUATIONS, more=MORE)
    done = python(tmp_path, COMMANDS)
    assert done.returncode == 0, done.stderr
    assert "past python" in done.stderr, "what is printed past Python goes to stderr"
    found, same, left = json.loads(done.stdout)
    for (code, out, err), (wanted, line) in each(zip(found, FOUND, strict=True)):
        lines = [x for x in err.splitlines() if x.startswith(line)]
        assert code == wanted and "Traceback" not in err, (line, code, err)
        assert not line or 1 <= len(lines) <= 2, (line, err)
        assert (out[:1] == "{") == (code == 0), out
    assert same and not left
