"""The table "Where do I change" of CONTRIBUTING, done as a user would in copies of the tree: each change touches two files
of the package at most, shipped rows are read as before, and runs are compared with them."""

from pathlib import Path

import pytest
from changed_tree import Tree, changed_tree

MOST_FILES = 2

READ = """
from r2h_batch.report.compare.command import FOLDERS
from r2h_batch.runs.columns import later
from r2h_batch.runs.store import load_run

for folder in FOLDERS:
    shipped = load_run(folder)
    assert len(shipped.methods) == 6
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
from r2h_batch.trials.protocol import trials_with_ids

assert verdicts.CRITERIA[5] == "centred"
evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none")))
trials = trials_with_ids(torch.arange(24), objects=evaluator.scene.objects, protocol="r2h-v0")
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

said("sweep --method oracle random --trials 12 --sim none --out run")
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
text = said("compare run baselines")
assert "lack centred (since 0.3.0)" in text and "oracle" in text.lower(), text
"""


def test_a_criterion_has_rates_tables_a_gradient_and_older_rows_without_it(tmp_path: Path, shipped: str) -> None:
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/verdicts.py": {
                ')\n"""The criteria in the order': '    CriterionEntry("centred", "f_centre", "F_centre", 5, "#666666",'
                ' SPLITS, True, since="0.3.0"),\n)\n"""The criteria in the order',
                "    INVALID_INPUT = 6\n    INVALID_SIM = 7\n": "    CENTRED = 6\n    INVALID_INPUT = 7\n    INVALID_SIM = 8\n",
            },
            "r2h_batch/judge/metrics.py": {"def reach(e: Evidence) -> Criterion:\n": CENTRED},
        },
    )
    report(tree)
    tree.write_docs()
    assert "`passed_centred` | bool" in (tree.folder / "docs" / "run_folder.md").read_text()
    assert tree.run(READ + "\nsys.exit()") == shipped
    tree.run(READ + USE_CENTRED)


DRAWN = '''@draws("r2h-near")
def _draw_near(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    hand_index: NDArray[np.int64],
    object_index: NDArray[np.int64],
    place: Place,
) -> Drawn:
    """Hands alone, 5 cm lower than in r2h-v0."""
    T_world_hand, _ = _draw_poses(key, ids, hand_index, object_index, place)
    T_world_hand[:, 2, 3] -= 0.05
    return T_world_hand, None


if set(_DRAWS) != set(PROTOCOL_NAMES):
'''
USE_NEAR = """
import torch
from r2h_batch.trials.protocol import trials_with_ids

ids = torch.arange(40)
trials = trials_with_ids(ids, protocol="r2h-near")
assert torch.equal(trials[7:9].T_world_hand, trials_with_ids(ids[7:9], protocol="r2h-near").T_world_hand)
assert not torch.equal(trials.T_world_hand, trials_with_ids(ids, protocol="r2h-v0").T_world_hand)
assert "r2h-near" in said("ls protocols") and "r2h-near: hands alone, lower" in said_help()
said("sweep --benchmark r2h-near --method random --trials 6 --sim none --out run")
assert load_run("run").header["protocol"] == "r2h-near"
said("results reevaluate run")
open("benchmark.yaml", "w").write("protocol: r2h-near\\n")
said("sweep --benchmark benchmark.yaml --method random --trials 6 --sim none --out same")
assert load_run("same").digest("random") == load_run("run").digest("random")
said("sweep --method random --trials 6 --sim none --out usual")
assert "random" in said("compare usual baselines --method random oracle")
"""
SAID_HELP = """
def said_help():
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main(["sweep", "--help"])
    return " ".join(out.getvalue().split())

"""


def test_a_protocol_is_drawn_listed_swept_named_in_files_and_judged_again(tmp_path: Path, shipped: str) -> None:
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/base/registry.py": {
                'RELEASE = "r2h-release"\nPROTOCOLS = (\n': 'RELEASE = "r2h-release"\nPROTOCOLS = (\n'
                '    Protocol("r2h-near", "hands alone, lower", "hands alone, 5 cm lower"),\n',
            },
            "r2h_batch/protocols/draw/rule.py": {"if set(_DRAWS) != set(PROTOCOL_NAMES):\n": DRAWN},
        },
    )
    report(tree)
    assert tree.run(READ) == shipped
    tree.run(SAID_HELP + READ + USE_NEAR)


USE_POLICY = """
said("sweep --method oracle --trials 2 --splits S0 --sim none --receiver-motion still --policy half --out run")
run = load_run("run")
half = run.episodes(run.methods[0]).to_pylist()
said("sweep --method oracle --trials 2 --splits S0 --sim none --receiver-motion still --policy planned --out planned")
run = load_run("planned")
whole = run.episodes(run.methods[0]).to_pylist()
pairs = [(a["time_s"], b["time_s"]) for a, b in zip(half, whole) if a["end"] == b["end"] == "success"]
assert pairs and all(1.5 * b < a < 2.5 * b for a, b in pairs), pairs
said("results reevaluate run")
said("sweep --method oracle --trials 6 --sim none --out usual")
assert "oracle" in said("compare usual baselines").lower()
"""


def test_a_policy_is_one_class_under_its_name(tmp_path: Path, shipped: str) -> None:
    pytest.importorskip("gymnasium")
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/closed_loop/policies.py": {
                "POLICIES: dict[str, Any] = {\n": 'class HalfSpeed(Planned):\n    """The planned motion at half its speed."""\n\n'
                '    def __call__(self, observation: Observation) -> Float32[Tensor, "b j"]:\n'
                "        self.clock = self.clock + 0.5 * self.step_s\n        return self.posture(self.clock)\n\n\n"
                'POLICIES: dict[str, Any] = {\n    "half": HalfSpeed,\n',
            }
        },
    )
    report(tree)
    assert len(tree.changed) == 1 and tree.run(READ) == shipped
    tree.run(READ + USE_POLICY)


USE_COLUMN = """
import numpy as np

said("sweep --method oracle --trials 6 --sim none --save-paths --out run")
run = load_run("run")
method = run.methods[0]
travel = dict(zip(run.trials(method)["trial_id"].to_pylist(), run.trials(method)["travel_rad"].to_pylist()))
paths = run.paths(method).to_pylist()
assert paths and all(travel[i] is None for i in travel if i not in {p["trial_id"] for p in paths})
for path in paths:
    q = np.array(path["q"])
    assert abs(np.abs(np.diff(q, axis=0)).sum() - travel[path["trial_id"]]) < 1e-4
said("results reevaluate run")
assert shipped.trials(shipped.methods[0])["travel_rad"].null_count == 1000 and later("trials")["travel_rad"] == "0.3.0"
assert "oracle" in said("compare run baselines").lower() and "oracle" in said(f"report {FOLDERS[0]}").lower()
"""


def test_a_stored_column_is_an_entry_and_a_property_and_null_in_older_rows(tmp_path: Path, shipped: str) -> None:
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/types.py": {
                "    @property\n    def inputs(self) -> ScoreInputs | None:": "    @property\n"
                '    def travel_rad(self) -> Float32[Tensor, " b"]:\n'
                '        """How far all joints turn along the path together, rad; NaN without a path."""\n'
                "        turns = (self.path[:, 1:] - self.path[:, :-1]).abs().sum(2)\n"
                "        slot = torch.arange(turns.shape[1], dtype=torch.int32, device=turns.device)\n"
                "        far = torch.where(slot < self.path_len[:, None] - 1, turns, 0.0).sum(1)\n"
                "        return torch.where(self.path_len > 0, far, torch.nan)\n\n"
                "    @property\n    def inputs(self) -> ScoreInputs | None:",
            },
            "r2h_batch/runs/columns.py": {
                "\n\nDETAILS = (\n": "\n\nDETAILS = (\n",
                '    Column("t_plan_s", FLOAT': '    Column("travel_rad", FLOAT, "how far all joints turn along the path", "rad",'
                ' since="0.3.0"),\n    Column("t_plan_s", FLOAT',
            },
        },
    )
    report(tree)
    tree.write_docs()
    assert "`travel_rad` | float32 | rad" in (tree.folder / "docs" / "run_folder.md").read_text()
    assert tree.run(READ) == shipped
    tree.run(READ + USE_COLUMN)


ENGINE = '''"""Motion in MuJoCo C by Runge and Kutta: the engine mujoco with another integrator."""

import copy
from dataclasses import replace

import mujoco

from r2h_batch.judge.motion import sim_mujoco
from r2h_batch.judge.motion.simulation import Job, Samples

ON_CPU = True


def simulate(job: Job) -> Samples:
    """The recorded motion of the job's trials."""
    scene = copy.copy(job.scene)
    model = copy.copy(job.scene.model)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    scene.model = model
    return sim_mujoco.simulate(replace(job, scene=scene))
'''
USE_ENGINE = """
import numpy as np

line = "sweep --method oracle --trials 4 --splits S0 --save-paths"
said(f"{line} --sim rk4 --out run")
run = load_run("run")
assert run.header["motion"]["engine"] == "rk4" and run.header["versions"]["mujoco"][0].isdigit()
said("results reevaluate run")
said(f"{line} --sim mujoco --out usual")
method = run.methods[0]
ours, theirs = (load_run(folder).paths(method)["executed_q"].to_pylist() for folder in ("run", "usual"))
most = max(np.abs(np.subtract(a, b)).max() for a, b in zip(ours, theirs, strict=True) if len(a) == len(b))
assert 0 < most < 1e-3, most
assert "oracle" in said("compare usual baselines").lower()
"""


def test_an_engine_is_a_file_and_an_entry(tmp_path: Path, shipped: str) -> None:
    tree = changed_tree(
        tmp_path / "tree",
        {
            "r2h_batch/base/registry.py": {'    Engine("mujoco", ("mujoco",)),\n': '    Engine("mujoco", ("mujoco",)),\n'
                                      '    Engine("rk4", ("mujoco",)),\n'},
            "r2h_batch/judge/motion/sim_rk4.py": ENGINE,
        },
    )  # fmt: skip
    report(tree)
    assert tree.run(READ) == shipped
    tree.run(READ + USE_ENGINE)
