"""Additions of other packages to a run: with another one its sweep does not go on, without one it is read as it is."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from changed_tree import changed_tree
from made_runs import make_header

from r2h_batch import plugins
from r2h_batch.runs.header import differing
from r2h_batch.runs.plugged import (
    criteria_since,
    lacking,
    other_criteria,
    other_plugins,
    package_of_method,
    plugin_records,
)
from r2h_batch.sweep import jobs

FILES = {
    "strange_r2h/__init__.py": "",
    "strange_r2h/things.py": "import numpy\nfrom strange_r2h.numbers import LIMIT\n",
    "strange_r2h/numbers.py": "LIMIT = 3\ndef later():\n    from . import deep\n",
    "strange_r2h/deep.py": "X = 1\n",
    "strange_r2h/unused.py": "X = 1\n",
}
KINDS = ("criterion", "share", "family", "method")
USED = {"families": {"vase": ""}, "methods": ["strange_r2h.things:predict"]}


def installed_as(folder: Path, *, package="strange", version="1.0", points=None) -> None:
    """Entry points of a package as pip writes them."""
    for old in folder.glob("*.dist-info"):
        for file in old.iterdir():
            file.unlink()
        old.rmdir()
    info = folder / f"{package}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    points = points or {
        **{f"{kind}.{name}": f"strange_r2h.things:{name.upper()}" for kind, name in (("criterion", "kind"), ("share", "slow"))},
        "family.vase": "strange_r2h.things:VASE", "family.other": "strange_r2h.things:OTHER",
        "method.mine": "strange_r2h.things:predict", "policy.slow": "strange_r2h.things:Slow", "all": "strange_r2h.things",
    }  # fmt: skip
    lines = "".join(f"{name} = {place}\n" for name, place in points.items())
    (info / "entry_points.txt").write_text(f"[{plugins.GROUP}]\n{lines}")
    plugins.installed.cache_clear()


@pytest.fixture
def place(tmp_path, monkeypatch):
    folder = tmp_path / "site-packages"  # as pip installs it
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(folder)
    installed_as(folder)
    yield folder
    plugins.installed.cache_clear()


def records():
    plugins.installed.cache_clear()
    return plugin_records(**USED)


def header(plugged=None):
    return make_header(1, 1, **({"plugins": records()} if plugged is None else {"plugins": plugged}))


def test_run_json_names_what_the_run_has_to_do_with(place):
    found = records()
    assert list(found) == [
        "all",
        "criterion.kind",
        "family.vase",
        "method.mine",
        "share.slow",
    ]  # no policy, no other family
    for key, record in found.items():
        assert (record["package"], record["version"]) == ("strange", "1.0"), key
        assert record["module"].startswith("strange_r2h.things")
        assert len(record["sha256"]) == 64 and record["sha256"] != found["all"]["module"]
    assert package_of_method("strange_r2h.things:predict") == "strange 1.0" and not package_of_method("else:predict")
    assert (
        plugin_records(families={"own": "strange_r2h.deep"}, methods=())["family.own"]["module"] == "strange_r2h.deep"
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file", ["strange_r2h/things.py", "strange_r2h/numbers.py", "strange_r2h/deep.py"])
def test_another_code_of_it_is_refused_by_its_name(place, kind, file):
    installed_as(place, points={k: r["module"] for k, r in records().items() if k.startswith(f"{kind}.")})
    old = header()
    (name,) = (key.partition(".")[2] for key in old["plugins"])
    assert differing(old, header()) == []
    (place / "strange_r2h" / "unused.py").write_text("X = 2\n")
    assert differing(old, header()) == []
    with (place / file).open("a") as text:
        text.write("# a comment\n")
    assert differing(old, header()) == [f"{kind} {name} (strange 1.0), now other code"]


@pytest.mark.parametrize("kind", KINDS)
def test_another_version_and_another_package_of_its_name_are_refused(place, kind):
    points = {k: r["module"] for k, r in records().items() if k.startswith(f"{kind}.")}
    installed_as(place, points=points)
    old = header()
    (key,) = old["plugins"]
    installed_as(place, version="1.1", points=points)
    assert differing(old, header()) == [f"{key.replace('.', ' ')} (strange 1.0), now strange 1.1"]
    installed_as(place, package="stranger", points=points)
    assert differing(old, header()) == [f"{key.replace('.', ' ')} (strange 1.0), now stranger 1.0"]
    assert other_criteria(old, header()) == (
        ["criterion kind (strange 1.0), and stranger 1.0"] if kind == "criterion" else []
    )


def test_what_is_gone_is_refused_and_what_is_new_only_where_it_judges(place):
    with_all, nothing = header(), header({})
    assert other_plugins(with_all, nothing) == [
        *("module all (strange 1.0), which is not installed", "criterion kind (strange 1.0), which is not installed"),
        *("family vase (strange 1.0), which is not installed", "share slow (strange 1.0), which is not installed"),
    ]  # a method that is not asked now answers as it did
    assert other_plugins(nothing, with_all) == ["criterion kind (strange 1.0), which did not judge it"]
    del nothing["plugins"]  # an older run, or one of nobody else's
    assert other_plugins(nothing, nothing) == other_criteria(nothing, with_all) == lacking(nothing) == []


def test_a_reader_without_it_is_told_of_columns_alone(place):
    made = header()
    assert lacking(made) == []
    assert criteria_since(made) == []
    installed_as(place, points={"share.new": "strange_r2h.things:NEW"})
    assert lacking(made) == ["module all (strange 1.0)", "criterion kind (strange 1.0)", "share slow (strange 1.0)"]
    assert criteria_since(made) == ["criterion kind (strange 1.0), which is not installed"]


def test_a_family_of_the_users_is_named_by_its_module(monkeypatch):
    made = {"vase": SimpleNamespace(make=SimpleNamespace(__module__="my_vases"))}
    made["pot"] = SimpleNamespace(make=SimpleNamespace(__module__="r2h_batch.scene.families.vessels"))
    monkeypatch.setattr("r2h_batch.scene.families.family.FAMILIES", plugins.Registry("family", made))
    objects = [SimpleNamespace(who=SimpleNamespace(category=name)) for name in ("vase", "pot", "pot")]
    assert jobs.families_of(objects) == {"vase": "my_vases", "pot": ""}


WORDS = """from r2h_batch.verdicts import SPLITS, CriterionEntry

CENTRED = CriterionEntry("centred", "f_centre", "F_centre", 5, "#666666", SPLITS, True, since="odd 1.0",
                         function="odd.equation:centred")
"""
EQUATION = """import torch

from r2h_batch.judge.metrics import Criterion

LIMIT_M = 0.03


def centred(e):
    com = torch.tensor([o.com.tolist() for o in e.scene.objects], dtype=torch.float32, device=e.held.attached.device)
    away = e.held.attached[:, :3, 3] - com[e.held.objects.long()]
    return Criterion(LIMIT_M - away.square().sum(1).sqrt(), e.held.active)
"""
SHARE = """import pyarrow.compute as pc

from r2h_batch.report.statistics.shares import Share

SLOW = Share("Slow", "Motions that take more than 8 s.", ("t_exec_s",), lambda rows: pc.greater(rows["t_exec_s"], 8.0))
"""
METHOD = """from r2h_batch.methods import oracle


def predict(trials, scene, *, seed):
    found = oracle.predict(trials, scene, seed=seed)
    return found.T_obj_ee, found.T_world_ee
"""
POINTS = {
    "criterion.centred": "odd.words:CENTRED",
    "share.slow": "odd.share:SLOW",
    "method.mine": "odd.method:predict",
}
COMMON = """
import json
from pathlib import Path

HERE = Path(os.environ["R2H_TREE"])

def files():
    return sorted(str(p.relative_to(HERE)) for p in (HERE / "run").rglob("*") if p.is_file() and ".claims" not in p.parts)

def told(line):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(line.split())
    return code, out.getvalue(), err.getvalue()

SWEEP = "sweep --benchmark r2h-v0 --method mine random --trials 24 --splits S0 --execute.sim none --out run"
"""
WITH = """
said(SWEEP)
header = json.loads((HERE / "run" / "run.json").read_text())
assert list(header["plugins"]) == ["criterion.centred", "method.mine", "share.slow"]
assert header["plugins"]["criterion.centred"]["package"] == "strange"
source = json.loads((HERE / "run" / "methods" / "mine.json").read_text())["source"]
assert source["package"] == "strange 1.0" and "file odd.method" in source
before = files()
from r2h_batch.runs.store import load_run
rows = [r for r in load_run("run").trials("mine").to_pylist()]
print("failed", sum(r["outcome"] == "centred" for r in rows), "won", sum(r["outcome"] == "success" for r in rows))
for file, what in (("equation", "criterion centred"), ("share", "share slow"), ("method", "method mine")):
    path = HERE / "odd" / f"{file}.py"
    text = path.read_text()
    path.write_text(text + "# other\\n")
    code, _, err = told(SWEEP)
    assert code == 2 and f"another run, which differs in {what} (strange 1.0), now other code; choose another --out" in err, err
    path.write_text(text)
(HERE / "odd" / "unused.py").write_text("X = 1\\n")
assert told(SWEEP)[0] == 0 and files() == before
"""
WITHOUT = """
before = files()
code, _, err = told(SWEEP.replace("mine random", "random"))
assert code == 2 and "criterion centred (strange 1.0), which is not installed" in err, err
code, out, err = told("results verify run")
assert code == 0 and "bad" not in out + err and "foreign" not in out + err, (out, err)
line = "read without the columns of criterion centred (strange 1.0) and share slow (strange 1.0), not installed here"
assert err.count(line) == 1, err
code, out, err = told("report run --format json")
(row,) = [r for r in json.loads(out)["rows"] if (r["split"], r["method"]) == ("S0", "mine")]
print("won", round(row["sr"] * row["n"] / 100))
assert "f_centre" not in row and code == 0 and "slow" not in out
from r2h_batch.runs.store import load_run
run = load_run("run")
rows = run.trials("mine").to_pylist()
failed = [r for r in rows if r["outcome"] == "other_criterion"]
print("failed", len(failed))
assert not any("centred" in name for name in rows[0])
assert "fails a criterion whose package is not installed here" in said(f"why run {failed[0]['trial_id']} --method mine")
assert "were judged by criterion centred (strange 1.0) too" in said("compare run")
code, out, err = told("results reevaluate run")
assert code == 0 and "which is not installed" in out + err, (out, err)
assert "other criterion" in said("report run --format html")
code, _, err = told("results rethreshold run --reach-radius .08,.1")
assert code == 2 and "criterion centred (strange 1.0) judged these rows and is not installed" in err, err
assert files() == before
"""


@pytest.mark.whole(part="changes")
def test_a_sweep_goes_on_with_the_same_plug_ins_alone_and_is_read_without_them(tmp_path):
    package = {"odd/__init__.py": "", "odd/words.py": WORDS, "odd/equation.py": EQUATION, "odd/share.py": SHARE}
    tree = changed_tree(tmp_path / "tree", {}, package={**package, "odd/method.py": METHOD}, points=POINTS)
    failed, won = re.search(r"failed (\d+) won (\d+)", tree.run(COMMON + WITH)).groups()
    assert int(failed) > 0 and int(won) > 0
    for file in (tree.folder / "strange-1.0.dist-info").iterdir():
        file.unlink()
    (tree.folder / "strange-1.0.dist-info").rmdir()
    said = tree.run(COMMON + WITHOUT)
    assert f"won {won}\n" in said and f"failed {failed}\n" in said  # the verdicts are those that were stored
