"""The table "I want to" of CONTRIBUTING, done in copies of the tree: a criterion in files of ours, and all
that a package of a stranger adds. Shipped rows are read as before, and runs are compared with them."""

import json
import shutil
from pathlib import Path

import pytest
from changed_tree import Tree, changed_tree

pytestmark = pytest.mark.whole(part="changes")
MOST_FILES = 2
OF_A_CRITERION = (
    "tests/judge/test_metrics.py::test_touching_passes_where_the_paper_says_so",
    "tests/judge/test_judge_again.py::test_a_row_of_each_split_is_right_in_all_that_it_says",
    "tests/training/test_stream.py::test_labels_and_margins_are_what_score_says_of_these_poses_and_trials",
    "tests/view/export/test_export_release.py",
)
OF_A_COLUMN = (
    "tests/report/statistics/test_aggregate.py",
    "tests/report/statistics/test_breakdown.py",
    "tests/report/test_report.py",
    "tests/report/test_latex.py",
)
"""Tests of ours that hold in a changed tree as well."""
BUT = (
    "--deselect=tests/report/test_report.py::test_what_a_sweep_prints_is_the_tables_success_and_first_failures_in_few_lines",
    "--deselect=tests/report/test_report.py::test_sr_says_how_many_rows_a_criterion_that_came_later_never_judged",
)
"""They name the criteria that there are."""

READ = """
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.runs.columns import later
from r2h_batch.runs.store import load_run

FOLDERS = stored_rows()
for folder in FOLDERS:
    shipped = load_run(folder)
    assert len(shipped.methods) in (6, 7)  # with Learned, where it was not later
    for method in shipped.methods:
        print(method, shipped.digest(method))
"""
"""The digests of the shipped rows."""


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digests of the shipped rows in a tree that nobody has changed."""
    return changed_tree(tmp_path_factory.mktemp("same") / "tree", {}).run(READ)


def report(tree: Tree) -> None:
    """Asserts how many files of the package changed; prints them for `pytest -s`."""
    print(", ".join(f"{name} {lines} lines" for name, lines in tree.changed.items()))
    assert len(tree.changed) <= MOST_FILES and not any(name.startswith(("docs", "tests")) for name in tree.changed)


CENTRED = '''def centred(e: Evidence) -> Criterion:
    """The object is held within 3 cm of its centre of mass."""
    com = torch.tensor([o.com.tolist() for o in e.scene.objects], dtype=torch.float32, device=e.held.attached.device)
    away = e.held.attached[:, :3, 3] - com[e.held.objects.long()]
    return Criterion(0.03 - away.square().sum(1).sqrt(), e.held.active)


def reach(e: Evidence) -> Criterion:
'''
USE_CENTRED = """
import torch
from r2h_batch import EvalConfig, verdicts
from r2h_batch.config import ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch import load_benchmark

assert verdicts.CRITERIA[5] == "centred"
benchmark = load_benchmark("r2h-v0")
evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
trials = benchmark.trials_with_ids(torch.arange(24))
poses = oracle.predict(trials, evaluator.scene, seed=0)
grasp = poses.T_obj_ee.clone().requires_grad_()
scores = evaluator.score(grasp, poses.T_world_ee, trials, stages="pose")
margin, passed = scores.margin[:, 5], scores.passed[:, 5]
assert scores.margin.shape == (24, 6) and torch.equal(passed, margin.detach() >= 0) and 0 < passed.sum() < 24
alone = ~passed & (scores.passed | ~scores.evaluated)[:, :5].all(1)
assert alone.any() and (scores.outcome[alone] == verdicts.Outcome.CENTRED).all() and not scores.success[~passed].any()
assert "passed/centred" in scores.scalars() and "centred" in scores.summary()

# its gradient: a grasp that goes 1 mm along the finger's axis
(slope,) = torch.autograd.grad(margin.sum(), grasp)
along = 1e-3 * grasp.detach()[:, :3, 2]
moved = []
for sign in (-1.0, 1.0):
    T = grasp.detach().clone()
    T[:, :3, 3] += sign * along
    moved.append(evaluator.score(T, poses.T_world_ee, trials, stages="pose").margin[:, 5])
found, expected = (slope[:, :3, 3] * along).sum(1), (moved[1] - moved[0]) / 2
assert expected.abs().max() > 5e-4 and (found - expected).abs().median() < 2e-5, (found, expected)

said("sweep --benchmark r2h-v1 --method oracle random --trials 12 --execute.sim none --out run")
said("sweep --method learned --trials 4 --execute.sim none --out learned")  # knows nothing of the new criterion
(learned,) = (run := load_run("learned")).methods
assert len(run.trials(learned)) == 8 and run.trials(learned)["passed_centred"].null_count < 8
run = load_run("run")
method = run.methods[0]
rows = run.trials(method).to_pylist()
assert "centred" in {r["outcome"] for r in rows} and all(r["margin_centred_m"] <= 0.03 for r in rows)
assert all(r["passed_centred"] == (r["margin_centred_m"] >= 0) for r in rows)
for form, heading in (("md", "F_centre"), ("latex", "centre"), ("html", "F_centre")):
    assert heading in said(f"report run --format {form}")
assert "F_centre" in said("results rethreshold run --reach-radius .08,.1")
assert "0 differences" in (text := said("results reevaluate run")) or "equal" in text, text

# older rows: null before, tables as they were, and a comparison that says what they lack
old = shipped.trials(shipped.methods[0])
assert old["passed_centred"].null_count == old["margin_centred_m"].null_count == len(old) == 1000
assert later("trials")["passed_centred"] == "0.3.0"
table = said(f"report {FOLDERS[1]} --format json")
assert '"sr"' in table
text = " ".join(said("compare run baselines --full").split())
assert "lack centred (since 0.3.0)" in text and "oracle" in text.lower(), text
"""


def test_a_criterion_has_rates_tables_a_gradient_and_older_rows_without_it(tmp_path: Path, shipped: str) -> None:
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/verdicts.py": {
                'fails="the robot meets the hand"),\n': 'fails="the robot meets the hand"),\n'
                '    CriterionEntry("centred", "f_centre", "F_centre", 5, "#666666", SPLITS, True, since="0.3.0"),\n',
            },
            "r2h_batch/judge/metrics.py": {"def reach(e: Evidence) -> Criterion:\n": CENTRED},
        },
    )
    report(tree)
    assert "`passed_centred`" in tree.tables_of_columns()
    assert tree.run(READ + "\nsys.exit()") == shipped
    tree.run(READ + USE_CENTRED)
    tree.passes(*OF_A_CRITERION, *OF_A_COLUMN, *BUT)


ENTRY = """CriterionEntry("centred", "f_centre", "F_centre", 5, "#123456", SPLITS, True, since="0.9", unit="deg",
                   applies=lambda o: o.split == "S0", function="PLACE", fails="it is held off its middle",
                   means="how near its middle it is held", behind="stability")"""
SAY_CENTRED = """
import json
from r2h_batch import Evaluator, load_benchmark, verdicts
from r2h_batch.methods import random
from r2h_batch.report.figures import COLORS
from r2h_batch.report.statistics.aggregate import FAILURES
from r2h_batch.runs.columns import TRIALS
from r2h_batch.runs.explain import headline
from r2h_batch.sweep.rows import TrialNames, score_rows

benchmark = load_benchmark("r2h-v0")
evaluator, trials = Evaluator(benchmark), benchmark.trials(40)
poses = random.predict(trials, evaluator.scene, seed=0)
scores = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials, stages="pose")
rows = score_rows(trials, scores, TrialNames.of(evaluator.scene)).to_pylist()
failed = [r for r in rows if r["outcome"] == "centred"]
assert failed and {r["passed_centred"] for r in rows} == {None, True, False}, [r["outcome"] for r in rows]
order = [e.name for e in verdicts.IN_ORDER]
print(json.dumps({
    "entry": [x for x in next(e for e in verdicts.EVERY if e.name == "centred")._replace(applies=None, function="")],
    "order": order, "columns": [c._replace(type=str(c.type)) for c in TRIALS if "centred" in c.name], "color": COLORS["centred"],
    "headings": [e.heading for e in FAILURES.values()], "words": [headline(r) for r in failed],
    "margins": scores.margin[:, 5].nan_to_num(9.0).tolist(), "summary": scores.summary(), "outcomes": scores.outcome.tolist(),
}))
"""


def test_a_criterion_inside_our_tree_and_the_same_one_of_a_stranger_have_the_same_columns_words_and_verdicts(
    tmp_path: Path,
) -> None:
    function = CENTRED.partition("def reach")[0].rstrip() + "\n"
    ours = changed_tree(
        tmp_path / "ours",
        {
            "r2h_batch/verdicts.py": {
                'fails="the robot meets the hand"),\n': 'fails="the robot meets the hand"),\n    '
                + ENTRY.replace("PLACE", "") + ",\n",
            },
            "r2h_batch/judge/metrics.py": {"def reach(e: Evidence) -> Criterion:\n": CENTRED},
        },
    )  # fmt: skip
    heads = "import torch\nfrom r2h_batch.judge.metrics import Criterion, Evidence\n\n\n"
    words = "from r2h_batch.verdicts import SPLITS, CriterionEntry\n\nENTRY = "
    theirs = changed_tree(
        tmp_path / "theirs",
        {},
        package={
            "middle/__init__.py": "",
            "middle/words.py": words + ENTRY.replace("PLACE", "middle.equation:centred") + "\n",
            "middle/equation.py": heads + function,
        },
        points={"criterion.centred": "middle.words:ENTRY"},
    )
    said = [json.loads(tree.run(SAY_CENTRED).splitlines()[-1]) for tree in (ours, theirs)]
    assert said[0] == said[1] and said[0]["order"][:3] == ["stability", "pick", "centred"]
    assert all(line.startswith("centred fails: it is held off its middle") for line in said[0]["words"])
    assert len(theirs.changed) == 0 and len(ours.changed) == 2


WORDS = '''"""What the criterion is called; read before anything heavy is imported."""

from r2h_batch.verdicts import SPLITS, CriterionEntry


def has_opening(o):
    """Cups, bowls and wine glasses: a rim that holds no lens."""
    return "rim" in o.part_names and "lens" not in o.part_names


UPRIGHT = CriterionEntry("upright", "f_upright", "F_upright", 5, "#666666", SPLITS, True, since="strange 1.0",
                         unit="deg", applies=has_opening, function="tilted.equation:upright")
'''
EQUATION = '''"""A vessel is handed over with its opening up."""

import torch

from r2h_batch.judge.metrics import Criterion
from tilted.words import has_opening


def opening(o):
    """From the centre of mass to the rim's, object frame."""
    rim = o.face_part == o.part_names.index("rim")
    corners = o.vertices[o.faces[rim]].astype(float)
    area = abs_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = (corners.mean(1) * area[:, None]).sum(0) / area.sum() - o.com
    return axis / (axis @ axis) ** 0.5


def abs_cross(a, b):
    x, y, z = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1], a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2], a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return (x * x + y * y + z * z) ** 0.5


def upright(e):
    """At most 60 degrees between the opening and the vertical."""
    axes = [opening(o) if has_opening(o) else (0.0, 0.0, 1.0) for o in e.scene.objects]
    axis = torch.tensor(axes, dtype=torch.float32, device=e.held.attached.device)[e.held.objects.long()]
    R_world_obj = e.held.T_world_ee[:, :3, :3] @ e.held.attached[:, :3, :3].mT
    up = (R_world_obj @ axis[:, :, None])[:, :, 0]
    angle = torch.rad2deg(torch.atan2((up[:, 0] ** 2 + up[:, 1] ** 2).sqrt(), up[:, 2]))
    return Criterion(angle, e.held.active, limit=60.0, below=True)
'''
USE_UPRIGHT = """
import json
import shutil
from pathlib import Path
import numpy as np
import torch
from r2h_batch import EvalConfig, verdicts
from r2h_batch.config import ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle
from r2h_batch.methods.ranker.network import read_weights
from r2h_batch.scene.objects import load_objects
from r2h_batch.training import reward
from r2h_batch import load_benchmark
from r2h_batch.types import Outcome

assert verdicts.CRITERIA[5] == "upright" and Outcome.UPRIGHT == 6 and Outcome.INVALID_SIM == len(verdicts.EVERY) + 2
OPEN = {"cup", "bowl", "wineglass"}
said("sweep --benchmark r2h-v1 --method oracle random --trials 36 --execute.sim none --save-paths --out run")
said("sweep --method learned --trials 4 --execute.sim none --out learned")  # knows nothing of the new criterion
line = "--regions 0 --items 1 --steps 2 --rounds 0 --out rank"
with contextlib.redirect_stdout(io.StringIO()):
    assert main(["train", "rank", "--families", "cup x 1 seed 5", *line.split()]) == 0
assert read_weights(Path("rank/rank.safetensors").absolute()).criteria == verdicts.CRITERIA  # it learned the new one
run = load_run("run")
vessels, axes = {o.name: o for o in load_objects() if o.name in OPEN}, {}
for name, o in vessels.items():  # another way to the same axis: trimesh's centroid of the rim alone
    rim = o.mesh.submesh([np.flatnonzero(o.face_part == o.part_names.index("rim"))], append=True)
    axes[name] = (rim.centroid - o.com) / np.linalg.norm(rim.centroid - o.com)
below, n = 0, 0
for method in run.methods:
    rows = {r["trial_id"]: r for r in run.trials(method).to_pylist()}
    for pose in run.poses(method).to_pylist():
        row = rows[pose["trial_id"]]
        if row["object"] not in OPEN:
            assert row["passed_upright"] is row["margin_upright_deg"] is row["margin_kind_upright"] is None
            assert row["outcome"] != "upright"
            continue
        T_obj_ee, T_world_ee = (np.reshape(pose[k], (4, 4)) for k in ("T_obj_ee", "T_world_ee"))
        up = T_world_ee[:3, :3] @ T_obj_ee[:3, :3].T @ axes[row["object"]]
        margin = 60.0 - np.degrees(np.arccos(np.clip(up[2], -1, 1)))
        assert abs(margin - row["margin_upright_deg"]) < 0.02, (margin, row)
        assert row["passed_upright"] == (row["margin_upright_deg"] >= 0) and row["margin_kind_upright"] == "distance"
        others = [row[f"passed_{c}"] for c in verdicts.CRITERIA[:5]]
        first = not row["passed_upright"] and False not in others
        assert (row["outcome"] == "upright") == first
        below, n = below + first, n + 1
assert below > 0 and n > below

# its rate is of the trials that it concerns, and every format says so and names the unit
found = {(r["split"], r["method"]): r for r in json.loads(said("report run --format json"))["rows"]}
for method in run.methods:
    own = [r for r in run.trials(method).to_pylist() if r["object"] in OPEN]
    failed = sum(r["outcome"] == "upright" for r in own)
    s0, s1, mean = (found[split, method] for split in ("S0", "S1", "Avg"))
    assert s0["f_upright_of"] == len(own) == 18 and s0["n"] == 36 and abs(s0["f_upright"] - 100 * failed / 18) < 1e-9
    assert s1["f_upright"] is None and abs(mean["f_upright"] - s0["f_upright"]) < 1e-9
for form, words in (("md", "F_upright"), ("latex", "{upright}"), ("html", "F_upright"), ("csv", "f_upright_of")):
    assert words in (text := said(f"report run --format {form}{' --full' if form == 'md' else ''}")), form
    if form != "csv":
        assert "whose object the criterion concerns" in " ".join(text.split()) and "margins are in deg" in " ".join(text.split())
page = said("report run --format html")
assert '"margin_upright_deg":["upright","deg",1.0]' in page and ">deg<" in page and ">mm<" in page
again = said("results rethreshold run --reach-radius .08,.1")
lines = [[x.strip() for x in line.strip("|").split("|")] for line in again.splitlines() if "|" in line]
at = lines[0].index("F_upright")
cells = {(x[0], x[1]): x[at] for x in lines[2:] if len(x) > at and x[2] == "0.1"}
assert cells["oracle", "S0"] == f"{found['S0', 'oracle']['f_upright']:.1f}" and cells["oracle", "S1"] == "n/a"
said("results reevaluate run")
said("report run --by-object")

# older rows have no such criterion
old = shipped.trials(shipped.methods[0])
assert old["passed_upright"].null_count == old["margin_upright_deg"].null_count == len(old) == 1000
assert '"sr"' in said(f"report {FOLDERS[1]} --format json")
assert "lack upright (since strange 1.0)" in " ".join(said("compare run baselines --full").split())
assert "upright (since strange 1.0) never judged 6000 rows of" in " ".join(said(f"report {FOLDERS[1]} --full").split())
assert "criterion upright (strange 1.0), which did not judge it" in said(f"why {FOLDERS[1]} 0")

# in Python: the unit, rewards in metres, and a gradient like that of a small turn
benchmark = load_benchmark("r2h-v0")
evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
trials = benchmark.trials_with_ids(torch.arange(24))
poses = oracle.predict(trials, evaluator.scene, seed=0)
asked = torch.tensor([o.name in OPEN for o in evaluator.scene.objects])[trials.object_index.long()]
hand = poses.T_world_ee.clone().requires_grad_()
scores = evaluator.score(poses.T_obj_ee, hand, trials, stages="pose")
assert torch.equal(scores.evaluated[:, 5], asked & scores.evaluated[:, 0]) and asked.any() and not asked.all()
assert "deg" in scores.summary() and "margin_deg/upright" in scores.scalars()
assert "margin_upright_deg" in scores.to_pandas() if __import__("importlib.util").util.find_spec("pandas") else True
row = scores.evaluated[:, 5]
vector = reward.margin_vector(scores)[row, 5]
assert torch.allclose(vector, (0.002 * scores.margin[row, 5]).clamp(-0.05, 0.05))
assert scores.soft(temperature_m=0.01).isfinite().all()
(slope,) = torch.autograd.grad(scores.margin[row, 5].sum(), hand)
turn = torch.tensor([[0.0, 0.0, 1e-3], [0.0, 0.0, 0.0], [-1e-3, 0.0, 0.0]])  # about y
moved = []
for sign in (-1.0, 1.0):
    T = hand.detach().clone()
    T[:, :3, :3] = torch.linalg.matrix_exp(sign * turn) @ T[:, :3, :3]
    moved.append(evaluator.score(poses.T_obj_ee, T, trials, stages="pose").margin[row, 5])
expected = (moved[1] - moved[0]) / 2
along = (slope[:, :3, :3] * (turn @ hand.detach()[:, :3, :3])).sum((1, 2))[row]
assert expected.abs().max() > 0.03 and (along - expected).abs().median() < 1e-3, (along, expected)
"""


SLOW = '''"""How often an arm takes its time."""

import pyarrow.compute as pc

from r2h_batch.report.statistics.shares import Share


def over_8_s(rows):
    return pc.greater(rows["t_exec_s"], 8.0)


SLOW = Share("Slow", "Motions that take more than 8 s, of those that came to rest.", ("t_exec_s",), over_8_s)
'''
USE_SLOW = """
import csv, json

said("sweep --benchmark r2h-v1 --method oracle random --trials 12 --execute.sim none --out run")
run = load_run("run")
expected = {}
for method in run.methods:
    for split in ("S0", "S1"):
        rows = [r for r in run.trials(method).to_pylist() if r["split"] == split and r["t_exec_s"] is not None]
        if rows:
            expected[split, method] = (sum(r["t_exec_s"] > 8 for r in rows), len(rows))
assert len(expected) > 2 and any(0 < k < n for k, n in expected.values()), expected
found = {(r["split"], r["method"]): r for r in json.loads(said("report run --format json"))["rows"]}
records = {(r["split"], r["method"]): r for r in csv.DictReader(io.StringIO(said("report run --format csv")))}
for key, (k, n) in expected.items():
    assert abs(found[key]["slow"] - 100 * k / n) < 1e-9 and found[key]["slow_low"] < found[key]["slow_high"]
    assert abs(float(records[key]["slow"]) - 100 * k / n) < 1e-6
text = {form: said(f"report run --format {form}{' --full' if form == 'md' else ''}") for form in ("md", "latex", "html")}
(section,) = [part for part in text["md"].split("\\n\\n") if "Slow" in part]
assert "Motions that take more than 8 s" in text["md"] and all(f"{100 * k / n:.1f}" in section for k, n in expected.values())
assert "{Slow}" in text["latex"] and "Motions that take more than 8 s" in " ".join(text["latex"].replace("% ", "").split())
assert ">Slow</th>" in text["html"]
k, n = expected["S0", "oracle"]
line = next(x for x in text["latex"].splitlines() if x.startswith("oracle &"))
assert f"{100 * k / n:.1f}" in line.split(" & ")[-1] or f"& {100 * k / n:.1f} " in line
groups = {g["group"]: g for g in json.loads(said("compare run --format json"))}
assert groups["S0"]["shares"]["oracle"]["slow"]["total"] == n and groups["S0"]["shares"]["oracle"]["slow"]["count"] == k
assert "Slow" in said("compare run --full") and "Slow" in said("compare run --format latex")
assert "slow_a" in said("compare run --format csv").splitlines()[0]
said("sweep --benchmark r2h-v1 --method random --trials 12 --execute.sim mujoco --out mine")
both = json.loads(said("compare mine baselines --format json"))[0]["shares"]
assert all("slow" in own for own in both.values()) and len(both) == 6 or len(both) == 7, both.keys()
assert all(own["slow"]["total"] <= 12 for own in both.values())  # on the shared trials alone
"""


VASE = '''"""Vases: nothing of ours has one."""

from r2h_batch.scene.families.family import GLASS, Shape, family
from r2h_batch.scene.families.shapes import revolve
from r2h_batch.scene.vocabulary import Thing

WORDS = Thing(("vase", "flower vase"), {"foot": ("foot",), "body": ("body",)}, {"use": "foot", "pour": "body"})


@family("vase", "S1", parts=("body", "foot"), rests=("upright", "side"), receiver=("foot",), take="foot", words=WORDS,
        roles={"body": "function"})
def VASE(draw, part):
    """A full glass vase with a wide foot."""
    r, h = draw("radius", 20, 28), draw("height", 110, 170)
    profile = [(0, 0), (1.1 * r, 0), (1.1 * r, 8), (0.7 * r, 16), (r, 0.6 * h), (0.8 * r, h), (0, h)]
    solid = part.divided("body", revolve(profile, 40), ("foot", (0, 0, -1), -0.25 * h))
    return Shape(solid, dict.fromkeys(("body", "foot"), float(GLASS)))
'''
USE_VASE = """
import numpy as np
from r2h_batch.trials.family_objects import family_objects, family_splits
from r2h_batch.trials.holding.instructions import instructions_of, understand

def swept(objects, out):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as err:
        line = "--method oracle random --trials 4 --splits S1 --execute.sim none --out"
        code = main(["sweep", "--objects", objects, *line.split(), out])
    return code, err.getvalue()

models = family_objects(f"families:{FAMILY} x 2 seed 3")
assert [o.name for o in models] == ["vase_s1003_00", "vase_s1003_01"] and {o.split for o in models} == {"S1"}
assert family_splits(f"families:{FAMILY},cup") == {"S0", "S1"} and models[0].mass != models[1].mass
for o in models:
    assert o.mesh.is_watertight and o.words.names == ("vase", "flower vase") and o.roles == {"body": "function"}
    assert {o.part_names[k] for k in np.unique(o.face_part[o.receiver_face])} == {"foot"}
    assert o.instruction == "hand over the vase foot to human" and o.category == "vase"
    understood = understand("I need the flower vase, I want to use it", [o])
    assert understood.part == "foot" and understood.verb == "use" and o.instruction in instructions_of(o)
code, said_there = swept(f"families:{FAMILY} x 2 seed 3", "run")
assert code == 0, said_there
objects = load_run("run").header["objects"]
assert [o["category"] for o in objects] == ["vase"] * 2 and not any(o["built_in"] for o in objects)
assert any(r["outcome"] == "success" for r in load_run("run").trials("oracle").to_pylist())
assert "of 1 families" in " ".join(said("report run --full").split())
"""
LISTED_VASE = """
assert "vase" in said("ls families").splitlines()[-1]
assert len(said("ls families").splitlines()) == 97
code, line = swept("families:vaze x 2", "none")
assert code == 2 and "did you mean vase?" in line and "trigger_sprayer, vase, or * for all" in line
code, line = swept("families:flower_vase x 2", "none")
assert code == 2 and "did you mean vase?" in line
said("results reevaluate run")  # an installed package is the reader's own
"""
STRANGE = """from dataclasses import replace

from r2h_batch import load_benchmark


def near():
    return replace(load_benchmark("r2h-v0"), name="near", receiver="hand")
"""
USE_NEAR = """
import torch
from r2h_batch import load_benchmark

near, ids = load_benchmark(NAME), torch.arange(40)
trials = near.trials_with_ids(ids)
assert torch.equal(trials[7:9].T_world_hand, near.trials_with_ids(ids[7:9]).T_world_hand)
assert near.digest != load_benchmark("r2h-v1").digest and near.label == trials.benchmark
assert NAME in said("ls benchmarks")
said(f"sweep --benchmark {NAME} --method random --trials 6 --execute.sim none --out run")
assert load_run("run").header["digests"]["benchmark"] == near.digest
said("results reevaluate run")
"""


def test_a_strangers_package_adds_a_criterion_a_share_a_family_and_a_protocol_without_a_file_of_ours(
    tmp_path: Path, shipped: str
) -> None:
    words = {"tilted/__init__.py": "", "tilted/words.py": WORDS, "tilted/equation.py": EQUATION}
    tree = changed_tree(
        tmp_path / "tree",
        {},
        package={**words, "slow.py": SLOW, "vases.py": VASE, "strange_task.py": STRANGE},
        points={
            "criterion.upright": "tilted.words:UPRIGHT",
            "share.slow": "slow:SLOW",
            "family.vase": "vases:VASE",
            "benchmark.near": "strange_task:near",
        },
    )
    report(tree)
    assert "`margin_upright_deg` | float32 | deg" in tree.tables_of_columns()
    assert tree.run(READ + "\nassert 'torch' not in sys.modules\nsys.exit()") == shipped
    for use in (USE_UPRIGHT, USE_SLOW, f"FAMILY = 'vase'\n{USE_VASE}{LISTED_VASE}", f"NAME = 'near'\n{USE_NEAR}"):
        tree.run(f"{READ}\n{use}")
        named = json.loads((tree.folder / "run" / "run.json").read_text())["plugins"]
        assert named["criterion.upright"]["package"] == "strange" and ("family.vase" in named) == ("FAMILY" in use)
        shutil.rmtree(tree.folder / "run")
    tree.passes(*OF_A_CRITERION[:2], *OF_A_COLUMN[:3], *BUT)  # those of LaTeX count on one share of rows
