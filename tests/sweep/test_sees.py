"""`sweep --sees`: methods that are shown what cameras see, and nothing else."""

import csv
import io
import json

import numpy as np
import pytest
from problems import default_evaluator
from rounds import each
from sweep_command import in_process

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.observe import load_rig, moments
from r2h_batch.observe.sees import Sees
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import seeing

GRAB = """
import torch

def predict(seen, *, seed=0, height_m=0.0):
    cloud, mask = seen.cloud(512)
    some = mask[..., None].float()
    T = torch.eye(4).repeat(len(seen), 1, 1)
    T[:, 1, 1] = T[:, 2, 2] = -1.0
    T[:, :3, 3] = (cloud * some).sum(1) / some.sum(1).clamp(min=1)
    H = T.clone()
    H[:, :3, 3] = seen.receiver.palm + 0.15 * seen.receiver.normal
    H[:, 2, 3] += height_m
    return T, H
"""
TOLD = """
import torch

def predict(seen, *, seed=0):
    cloud, mask = seen.cloud(512)
    region = seen.cloud_region(512)
    # the numbers of points and of region points, as a pose that says them
    T = torch.eye(4, dtype=torch.float64).repeat(len(seen), 1, 1)
    T[:, 0, 3], T[:, 1, 3] = mask.sum(1) / 1000, region.sum(1) / 1000
    return T, T
"""
ODD = GRAB.replace(
    "    return T, H",
    """
    T[0, 0, 0] = float("nan")
    T[1, :3, :3] *= 2
    H[2, :3, 0] *= -1
    H[3, 0, 3] = float("inf")
    return T.double().numpy(), H.tolist()
""",
)
KNOWS = """
import torch

def predict(seen):
    # the grasp is the frame of the object itself, 3 cm up
    T = seen.known.T_world_obj.double().clone()
    assert len(seen.known.vertices) and all(len(seen.known.vertices[k]) > 3 for k in seen.known.mesh.tolist())
    T[:, :3, 3] += 0.03 * T[:, :3, 2]
    return T, T
"""


@pytest.fixture(scope="module")
def methods(tmp_path_factory):
    folder = tmp_path_factory.mktemp("methods")
    for name, text in (("grab", GRAB), ("knows", KNOWS), ("told", TOLD), ("odd", ODD)):
        (folder / f"{name}.py").write_text(text)
    (folder / "blind.py").write_text("def predict(trials, scene):\n    return None\n")
    return folder


def swept(methods, out, *more, method="grab", sees="cell-v1", trials=5):
    return in_process(
        "--method", f"{method}={methods / method}.py:predict", "--sees", sees, "--trials", trials, "--execute.sim", "none",
        "--out", out, *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def run(methods, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "seen"
    done = swept(methods, out)
    assert done.returncode == 0, done.stderr
    assert "\nS0   |" in done.stdout and "grab" in done.stdout
    return load_run(out)


def test_a_method_that_sees_is_judged_by_all_criteria_and_the_run_says_what_it_saw(run):
    rows, seen = run.trials("grab"), run.sees("grab")
    assert len(rows) == len(seen) == 10 and rows["trial_id"].to_pylist() == seen["trial_id"].to_pylist()
    assert set(rows["outcome"].to_pylist()) <= {"success", "stability", "plan", "reach", "affordance", "safe"}
    share, pixels = seen["seen_share"].to_numpy(), seen["seen_px"].to_numpy()
    assert (share > 0.3).all() and (share < 1).any() and (pixels > 300).all()
    assert (seen["t_sees_s"].to_numpy() > 0).all()
    assert set(seen["pick"].to_pylist()) <= {True, False}
    header = json.loads((run.folder / "run.json").read_text())
    assert (
        header["sees"] == Sees.parse("cell-v1").identity and header["sees"]["rig_digest"] == load_rig("cell-v1").digest
    )
    assert header["digests"]["sees"] == Sees.parse("cell-v1").digest
    assert main(["report", str(run.folder)]) == 0
    rows = {row.split: row.shares["pick"] for row in table_of(run).rows if row.split != "Avg"}
    for k, split in each(enumerate(("S0", "S1"))):
        own = seen["pick"].to_pylist()[5 * k : 5 * k + 5]
        assert (rows[split].count, rows[split].total) == (own.count(True), 5)
    lines = list(csv.DictReader(io.StringIO(render(table_of(run), "csv"))))
    assert [line["pick"] for line in lines if line["split"] == "Avg"] == ["n/a"]
    assert float(lines[0]["pick"]) == pytest.approx(rows["S0"].percent)
    assert "| Pick posture |" in render(table_of(run), "md").replace("  ", " ")


@pytest.mark.whole(part="sweep")
def test_poses_that_are_not_finite_or_not_rigid_are_invalid_rows_and_the_others_are_judged_as_ever(
    run, methods, tmp_path
):
    done = swept(methods, tmp_path / "odd", method="odd")
    assert done.returncode == 0 and "Traceback" not in done.stderr
    found, right = (r.trials(r.methods[0]) for r in (load_run(tmp_path / "odd"), run))
    pairs = list(zip(found["outcome"].to_pylist(), right["outcome"].to_pylist(), strict=True))
    assert sum(a == "invalid_input" for a, _ in pairs) == 4
    assert all(a == b for a, b in each(pair for pair in pairs if pair[0] != "invalid_input"))


def test_grasps_of_the_world_are_judged_where_the_object_lay_at_the_moment(methods, tmp_path):
    assert swept(methods, tmp_path / "run", method="knows", sees="cell-v1,noise=0,model=known,seed=4").returncode == 0
    scene, trials = default_evaluator("r2h-v2").scene, load_benchmark("r2h-v2").trials(5)
    poses = load_run(tmp_path / "run").poses("knows")
    T = moments(scene, trials, seed=4).double().numpy()
    for i in each(range(10)):
        assert poses["trial_id"][i].as_py() == int(trials.trial_id[i])
        grasp, handover = (np.array(poses[k][i].as_py()).reshape(4, 4) for k in ("T_obj_ee", "T_world_ee"))
        expected = np.eye(4)
        expected[2, 3] = 0.03  # the frame of the object itself: nothing of the moment is left
        assert np.abs(grasp - expected).max() < 1e-6
        assert np.abs(handover - T[i] @ expected).max() < 1e-6


@pytest.mark.whole(part="sweep")
def test_known_objects_are_known_as_well_as_their_level_says(methods, tmp_path):
    off = {}
    for level in each(("lab", "rgb")):
        sees = f"cell-v1,model=known,object={level}"
        assert swept(methods, tmp_path / level, method="knows", sees=sees, trials=20).returncode == 0
        grasp = np.array(load_run(tmp_path / level).poses("knows")["T_obj_ee"].to_pylist()).reshape(-1, 4, 4)
        turn = np.degrees(np.arccos(np.clip((np.trace(grasp[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
        off[level] = np.sqrt((turn**2).mean() / 3)
    assert off["lab"] == pytest.approx(1.0, rel=0.4) and off["rgb"] == pytest.approx(8.0, rel=0.4)


@pytest.mark.whole(part="sweep")
def test_rows_have_the_same_bits_in_chunks_shards_and_after_a_resume(run, methods, tmp_path):
    parts = tmp_path / "parts"
    assert swept(methods, parts, "--chunk", "3", "--shard-trials", "4", "--shard", "2/2").returncode in (0, 1)
    assert swept(methods, parts, "--chunk", "2", "--shard-trials", "4").returncode == 0
    found = load_run(parts)
    for kind in each(("trials", "poses", "sees")):
        a, b = (getattr(r, kind)("grab").to_pydict() for r in (run, found))
        for name in each([k for k in a if k not in ("t_plan_s", "t_method_s", "t_sees_s")]):
            assert a[name] == b[name], name


@pytest.mark.whole(part="sweep")
def test_methods_of_a_sweep_look_once_and_answer_as_they_do_alone(run, methods, tmp_path, monkeypatch):
    looked = []
    look = Sees.look

    def counted(self, scene, trials):
        looked.append(len(trials))
        return look(self, scene, trials)

    monkeypatch.setattr(Sees, "look", counted)
    monkeypatch.setattr(seeing, "AT_ONCE", 3)
    for kept, anew in each(((4, 6), (256, 0))):  # of parts of 3, 3, 3 and 1 trials the first and the last stay
        looked.clear()
        monkeypatch.setattr(seeing, "KEPT_TRIALS", kept)
        done = in_process(
            "--method", f"grab={methods / 'grab.py'}:predict", "random", "--sees", "cell-v1", "--trials", 5,
            "--execute.sim", "none", "--out", tmp_path / f"{kept}",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        found = load_run(tmp_path / f"{kept}")
        assert sum(looked) == 10 + anew and len(found.methods) == 2, looked
        for kind in each(("trials", "poses", "sees")):
            alone, first = (getattr(r, kind)(n).to_pydict() for r, n in ((run, "grab"), (found, "grab")))
            for name in each([k for k in alone if k not in ("t_plan_s", "t_method_s", "t_sees_s")]):
                assert alone[name] == first[name], name
    # a later method's look took as long as the first one's
    a, b = (found.sees(n)["t_sees_s"].to_pylist() for n in found.methods[:2])
    assert a == b and min(a) > 0


@pytest.mark.whole(part="sweep")
def test_runs_that_see_otherwise_are_not_paired_and_do_not_share_a_folder(run, methods, tmp_path, capsys):
    assert swept(methods, tmp_path / "exact", sees="cell-v1,noise=0").returncode == 0
    capsys.readouterr()
    assert main(["compare", str(run.folder), str(tmp_path / "exact")]) == 2
    error = capsys.readouterr().err
    assert "differ in what their methods see (cell-v1, noise 1, " in error and "cell-v1, noise 0" in error
    assert "sweep both with the same --sees" in error and error.count("\n") == 1
    truth = tmp_path / "truth"
    assert in_process("--method", "random", "--trials", 5, "--execute.sim", "none", "--out", truth).returncode == 0
    assert main(["compare", str(run.folder), str(truth)]) == 2
    assert "the truth): their trials cannot be paired" in capsys.readouterr().err
    again = swept(methods, run.folder, sees="cell-v1,noise=0")
    assert again.returncode == 2 and "digests (sees)" in again.stderr


@pytest.mark.whole(part="sweep")
def test_a_told_region_reaches_the_method_and_such_runs_are_not_paired_with_others(run, methods, tmp_path, capsys):
    told = tmp_path / "told"
    assert swept(methods, told, method="told", sees="cell-v1,region=told").returncode == 0
    own = load_run(told)
    header = json.loads((told / "run.json").read_text())
    assert header["sees"]["region"] == "told" and "region" not in run.header["sees"]
    assert header["digests"]["sees"] == Sees.parse("cell-v1,region=told").digest
    count = np.array(own.poses("told")["T_world_ee"].to_pylist()).reshape(-1, 4, 4)[:, :2, 3] * 1000
    assert (count[:, 0] > 300).all() and (count[:5, 1] == 0).all()
    assert (count[5:, 1] > 20).all() and (count[5:, 1] < count[5:, 0] - 20).all()
    # what is seen is the same
    for name in each(("seen_px", "seen_share")):
        assert own.sees("told")[name].to_pylist() == run.sees("grab")[name].to_pylist()
    assert table_of(own).origin["methods see"].endswith("seed 0, region told")
    capsys.readouterr()
    assert main(["compare", str(run.folder), str(told)]) == 2
    error = capsys.readouterr().err
    assert "object unknown, seed 0, cell-v1" in error and "seed 0, region told): their trials cannot be paired" in error
    untold = swept(methods, tmp_path / "untold", method="told", trials=1)
    assert "the receiver's region is not told; look with region=told" in untold.stderr


def test_runs_of_before_the_option_are_seen_as_they_were():
    # stored rows name these digests
    for text, digest in each(
        (
            ("cell-v1", "a154ee149bf7f033e8ebee95bd6c3233c06581432ee87ff394d261700f4806b8"),
            ("cell-v1,region=hidden", "a154ee149bf7f033e8ebee95bd6c3233c06581432ee87ff394d261700f4806b8"),
            (
                "cell-v1,model=known,object=rgb,seed=3",
                "c16e280907ee606895fa3bf7ab8702ff2ab142418d179c5ded70b4073d4a905a",
            ),
        )
    ):
        assert Sees.parse(text).digest == digest
    assert Sees.parse("cell-v1,region=told").digest != Sees.parse("cell-v1").digest


@pytest.mark.whole(part="sweep")
def test_options_of_the_method_reach_it(methods, tmp_path):
    done = in_process(
        "--method", f"high={methods}/grab.py:predict,height_m=0.2", "--sees", "cell-v1", "--trials", 1, "--splits", "S0",
        "--execute.sim", "none", "--out", tmp_path / "high",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    run = load_run(tmp_path / "high")
    (name,) = run.methods
    assert "height_m=0.2" in str(run.entry(name).source)


@pytest.mark.parametrize(
    ("sees", "words"),
    [
        ("cell-v2", "rig 'cell-v2', did you mean cell-v1?"),
        ("cell-v1,nose=1", "--sees: unknown option 'nose', did you mean noise?"),
        ("cell-v1,noise=9", "--sees: noise is '9'; it must be a number from 0 to 5"),
        ("cell-v1,noise=nan", "--sees: noise is 'nan'; it must be a number from 0 to 5"),
        ("cell-v1,labels=grow", "--sees: labels is 'grow', did you mean grown?"),
        ("cell-v1,object=lab", "add model=known"),
        ("cell-v1,region=hiden", "--sees: region is 'hiden', did you mean hidden?; allowed are hidden, told"),
        ("cell-v1,seed=0.5", "--sees: seed is '0.5'; it must be a whole number"),
        ("cell-v1,noise=1,noise=1", "--sees: noise is given twice"),
    ],
)
def test_what_cannot_be_seen_is_refused_in_one_line(methods, sees, words, tmp_path):
    done = swept(methods, tmp_path / "none", sees=sees)
    assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "none").exists()


def test_methods_that_are_told_the_truth_and_methods_that_see_do_not_take_each_others_place(methods, tmp_path):
    for arguments, words in each(
        (
            (
                ("--method", "oracle", "--sees", "cell-v1"),
                "--method oracle is told the truth, it asks the judge; leave it out",
            ),
            (("--method", f"{methods}/blind.py:predict", "--sees", "cell-v1"), "the function takes (seen) with --sees"),
            (("--method", f"{methods}/grab.py:predict"), "or (seen) with --sees"),
            (
                ("--method", f"{methods}/grab.py:predict", "--sees", "cell-v1", "--object-errors", "lab"),
                "--sees shows methods images and estimates of its own; leave --object-errors out",
            ),
            (("--predictions", "x.npz", "--sees", "cell-v1"), "leave --predictions out"),
        )
    ):
        done = in_process(*arguments, "--trials", 1, "--out", tmp_path / "none")
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1, done.stderr
