"""Names that other packages add: by entry points as `pip` installs them, read by a fresh interpreter."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from r2h_batch import plugins
from r2h_batch.plugins import PluginError, Registry

HEAD = """
import sys
from r2h_batch.plugins import PluginError, Registry
KNIFE = Registry("knife", {"bread": 1})

def line(call):
    try:
        call()
    except PluginError as error:
        return str(error)
    raise AssertionError("nothing was refused")

"""
MODULE = '''from __main__ import KNIFE


@KNIFE("paring")
class Paring:
    """A small one."""
'''


def installed(folder: Path, package: str, points: str, module: str = "") -> None:
    """A package as pip leaves it: a module and the metadata beside it."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[r2h_batch.plugins]\n{points}")
    (folder / f"{package}.py").write_text(module)


def said(folder: Path, code: str) -> str:
    """The lines that a fresh interpreter prints that finds the packages of this folder."""
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", HEAD + code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_declared_thing_is_listed_without_its_import_and_imported_when_it_is_used(tmp_path: Path) -> None:
    installed(tmp_path, "strange", "knife.palette = strange:PALETTE\nfork.fish = strange:NONE\n", "PALETTE = 7\n")
    code = "print(*KNIFE, 'palette' in KNIFE, 'strange' in sys.modules, KNIFE['palette'], 'strange' in sys.modules)"
    assert said(tmp_path, code).split() == ["bread", "palette", "True", "False", "7", "True"]


def test_a_module_registers_when_it_is_imported_for_a_list_or_an_unknown_name_and_not_before(tmp_path: Path) -> None:
    installed(tmp_path, "strange", "all = strange\n", MODULE)
    assert said(tmp_path, "KNIFE['bread']; print('strange' in sys.modules)").split() == ["False"]
    assert said(tmp_path, "print(KNIFE['paring'].__doc__, *KNIFE)").split()[-2:] == ["bread", "paring"]


def test_what_is_there_twice_or_cannot_be_imported_is_refused_in_a_line_that_names_the_package(tmp_path: Path) -> None:
    installed(tmp_path / "a", "strange", "knife.bread = strange:X\n", "X = 2\n")
    text = said(tmp_path / "a", "print(line(lambda: list(KNIFE))); print(line(lambda: KNIFE['bread']))")
    assert text.count("package strange calls a knife 'bread', and so does r2h_batch; rename it") == 2
    (tmp_path / "a" / "drawer.py").write_text("from __main__ import FORK\nFORK.add('fish', 1)\n")
    installed(tmp_path / "a", "forks", "fork.fish = forks:X\n", "X = 2\n")
    text = said(tmp_path / "a", "FORK = Registry('fork', modules=['drawer']); print(line(lambda: FORK['fish']))")
    assert "package forks calls a fork 'fish', and so does r2h_batch" in text
    installed(tmp_path / "b", "strange", "knife.oyster = strange:X\n", "X = 2\n")
    installed(tmp_path / "b", "other", "knife.oyster = other:X\n", "X = 2\n")
    assert "calls a knife 'oyster', and so does package" in said(tmp_path / "b", "print(line(lambda: list(KNIFE)))")
    installed(tmp_path / "c", "strange", "knife.oyster = strange:X\nall = strange\n", "import not_there\n")
    for ask in ("KNIFE['oyster']", "list(KNIFE)", "list(KNIFE)"):
        text = said(tmp_path / "c", f"print(line(lambda: {ask}))")
        assert "of package strange cannot be imported (ModuleNotFoundError: No module named 'not_there')" in text
        assert len(text.splitlines()) == 1


def test_an_unknown_name_is_refused_with_the_nearest_one() -> None:
    knives = Registry[int]("knife", {"bread": 1, "butter": 2})
    with pytest.raises(
        PluginError, match=r"^no knife is called 'buter', did you mean butter\?; there are bread, butter$"
    ):
        knives["buter"]


def test_two_of_a_name_are_refused_and_one_that_is_imported_anew_is_not() -> None:
    knives = Registry[type]("knife")

    def make(place: str) -> type:
        return type("Bread", (), {"__module__": place})

    assert knives("bread")(first := make("ours")) is first is knives["bread"]
    knives("bread")(anew := make("ours"))
    assert knives["bread"] is anew
    with pytest.raises(PluginError, match=r"two of kind knife are called 'bread': ours:Bread and theirs:Bread"):
        knives("bread")(make("theirs"))


def test_modules_of_ours_are_imported_once_a_name_is_asked_for_and_a_package_stands_for_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drawer").mkdir()
    (tmp_path / "drawer" / "__init__.py").write_text("")
    (tmp_path / "drawer" / "top.py").write_text("import builtins\nbuiltins.KNIVES.add('fish', 3)\n")
    monkeypatch.syspath_prepend(tmp_path)
    knives = Registry[int]("knife", {"bread": 1}, modules=("drawer",), names=("fish",), light=True)
    monkeypatch.setattr("builtins.KNIVES", knives, raising=False)
    assert list(knives) == ["fish", "bread"] and "drawer" not in sys.modules
    assert knives["bread"] == 1 and "drawer" not in sys.modules
    assert knives["fish"] == 3 and "drawer.top" in sys.modules
    monkeypatch.delitem(sys.modules, "drawer.top")
    monkeypatch.delitem(sys.modules, "drawer")


CODE = """
from r2h_batch.methods.random import predict as drawn


def predict(trials, scene, *, seed):
    return drawn(trials, scene, seed=seed + 1)


class Stands:
    def __init__(self, *given):
        pass
"""
NAMED = """
import contextlib, io
from r2h_batch.__main__ import main
from r2h_batch.closed_loop.episodes import policy_of
from r2h_batch.runs.store import load_run

def run(*words):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(list(words))
    return code, out.getvalue() + err.getvalue()

listed = [line for line in run("ls", "methods")[1].splitlines() if "working" not in line]
assert listed[-1].split() == ["shifted", "acts:predict"]
more = ("--benchmark", "r2h-v1", "--trials", "3", "--execute.sim", "none")
code, text = run("sweep", "--method", "shifted", "random", "--seed", "0", *more, "--out", "run")
assert code == 0, text
assert run("sweep", "--method", "random", "--seed", "1", *more, "--out", "other")[0] == 0
stored, other = load_run("run"), load_run("other")
assert stored.methods == ("shifted", "random") and stored.entry("shifted").source["function"] == "acts:predict"
assert stored.poses("shifted").equals(other.poses("random")) and not stored.poses("random").equals(other.poses("random"))
code, text = run("sweep", "--method", "shiftd", "--trials", "3")
assert code == 2 and "did you mean shifted?" in text and "learned, robust, shifted or your own" in text, text
found, text = policy_of("stand")
assert found.__name__ == "Stands" and text.startswith("acts:Stands "), text
try:
    policy_of("stnd")
except ImportError as error:
    assert "did you mean stand?" in str(error) and len(str(error).splitlines()) == 1
else:
    raise AssertionError
"""


@pytest.mark.whole(part="changes")
def test_methods_and_policies_of_a_package_are_named_listed_swept_and_hinted_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gymnasium")
    points = "method.shifted = acts:predict\npolicy.stand = acts:Stands\n"
    installed(tmp_path / "site", "acts", points, CODE)
    monkeypatch.chdir(tmp_path)
    said(tmp_path / "site", NAMED)


def test_the_criterion_of_the_notes_judges_as_it_stands_there(tmp_path: Path) -> None:
    notes = plugins.__doc__ or ""
    _, _, rest = notes.partition("in mine.py):\n")
    code, _, _ = rest.partition("\nIts fields")
    assert len([line for line in code.splitlines() if line.strip()]) <= 9, "ten lines with its entry point"
    installed(tmp_path, "mine", "criterion.level = mine:LEVEL\n", textwrap.dedent(code))
    use = """
from r2h_batch import Evaluator, load_benchmark
from r2h_batch.methods.random import predict
evaluator = Evaluator(load_benchmark("r2h-v0")).kinematic
trials = evaluator.benchmark.trials(4)
answer = predict(trials, evaluator.scene, seed=0)
scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, stages="pose")
at = scores.criteria.index("level")
wanted = 30 - answer.T_world_ee[:, 2, 1].asin().rad2deg().abs()
judged = scores.evaluated[:, at]
assert judged.any() and (scores.margin[:, at] - wanted).abs()[judged].max() < 1e-3
assert (scores.passed[:, at] == (wanted >= 0))[judged].all()
print("level of", int(judged.sum()))
"""
    assert said(tmp_path, use).startswith("level of ")


HANDED = """
from r2h_batch.verdicts import SPLITS, CriterionEntry

FIRST = CriterionEntry("first", "f_first", "F_first", 5, "#666666", SPLITS, True, since="handed 1.0", function="handed:first")
FACE = CriterionEntry("face", "f_face", "F_face", 6, "#777777", SPLITS, True, since="handed 1.0", function="handed:face")
STANDS = CriterionEntry("stands", "f_stands", "F_stands", 7, "#888888", SPLITS, True, since="handed 1.0", unit="deg",
                        function="handed:stands", applies=lambda o: o.up is not None)


def first(e):
    import torch
    from r2h_batch.config import PRESENTED_M
    from r2h_batch.judge.metrics import Criterion
    point, _, ball = e.palm
    t = torch.where(e.trial_id % 2 == 0, PRESENTED_M["S0"], PRESENTED_M["S1"])
    others = torch.minimum(e.distance(point, "gripper"), e.distance(point, "sharp"))
    margin = torch.minimum(0.10 - e.distance(ball, "wanted"), t + others - e.distance(point, "wanted"))
    return Criterion(margin.float(), e.held.active)


def face(e):
    from r2h_batch.judge.metrics import Criterion
    points, of_object = e.points("object")
    gaps = [e.distance(points[:, i].contiguous(), "head") for i in range(0, points.shape[1], 64)]
    nearest = gaps[0]
    for gap in gaps[1:]:
        nearest = nearest.minimum(gap)
    return Criterion(nearest, e.held.active, limit=0.05)


def stands(e):
    from r2h_batch.judge.metrics import Criterion
    return Criterion(e.up[:, 2].nan_to_num(0.0).clamp(-1, 1).acos().rad2deg(), e.held.active, limit=60.0, below=True)
"""


@pytest.mark.whole(part="changes")
def test_a_stranger_writes_presented_the_heads_clearance_and_upright_with_our_verdicts(tmp_path: Path) -> None:
    points = "".join(f"criterion.{name.lower()} = handed:{name}\n" for name in ("FIRST", "FACE", "STANDS"))
    installed(tmp_path, "handed", points, HANDED)
    use = """
import numpy as np, torch
from r2h_batch import Evaluator, load_benchmark
from r2h_batch.config import UPRIGHT_DEG
from r2h_batch.methods.random import predict
from r2h_batch.scene.person import heads_of
evaluator = Evaluator(load_benchmark("r2h-v1")).kinematic
trials = evaluator.benchmark.trials(48)
answer = predict(trials, evaluator.scene, seed=0)
s = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, stages="pose")
of = {name: s.criteria.index(name) for name in ("first", "face", "stands")}
judged = s.evaluated[:, of["first"]]
first, ours = s.margin[:, of["first"]], s.presented_margin_m
assert judged.all() and (first - ours).abs().max() < 2e-5 and (first > 0).any() and (first < 0).any()
stands = s.evaluated[:, of["stands"]]
assert torch.equal(stands, ~s.tilt_deg.isnan()) and stands.any() and not stands.all()
assert torch.equal(s.passed[:, of["stands"]][stands], (s.tilt_deg <= UPRIGHT_DEG)[stands])
shift = torch.eye(4).repeat(len(trials), 1, 1)
shift[:, 1, 3] = s.grasp_shift_m  # closing moves the object along y of the gripper
T_world_obj = (answer.T_world_ee @ torch.linalg.inv(answer.T_obj_ee @ shift)).double().numpy()
head = heads_of(trials.receiver).double().numpy()
for i in range(len(trials)):
    points = np.asarray(evaluator.scene.objects[int(trials.object_index[i])].points, float)[::64]
    world = points @ T_world_obj[i, :3, :3].T + T_world_obj[i, :3, 3]
    low, high, r = head[i, 0, :3], head[i, 1, :3], head[i, 0, 3]
    share = np.clip((world - low) @ (high - low) / ((high - low) @ (high - low)), 0, 1)
    gap = np.linalg.norm(world - low - share[:, None] * (high - low), axis=1).min() - r
    assert abs(gap - 0.05 - s.margin[i, of["face"]]) < 2e-5, (i, gap, s.margin[i, of["face"]])
print("same verdicts", len(trials))
"""
    assert said(tmp_path, use).startswith("same verdicts")
