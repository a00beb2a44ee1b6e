"""Files of joint motions and of the authors' trials, judged by the sweep."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sweep_command import in_process

from r2h_batch.runs.store import load_run
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate
from r2h_batch.verdicts import CRITERIA
from r2h_batch.view.stored import Reader

TRIALS = 3


@pytest.fixture(scope="module")
def planned(tmp_path_factory, request):
    """A run of ours without a simulator, and its motions as a file: the samples one after another."""
    folder, robot = tmp_path_factory.mktemp("motions"), getattr(request, "param", "ur5e_2f85")
    line = (
        "--benchmark",
        "r2h-v1",
        "--method",
        "oracle",
        "--robot",
        robot,
        "--trials",
        TRIALS,
        "--execute.sim",
        "none",
        "--save-paths",
    )
    done = in_process(*line, "--out", folder / "own")
    assert done.returncode == 0, done.stderr
    run = load_run(folder / "own")
    paths, poses = run.paths("oracle").to_pylist(), run.poses("oracle").to_pylist()
    path_of = {p["trial_id"]: p for p in paths}
    ids = [p["trial_id"] for p in poses]
    none = np.zeros((0, len(paths[0]["q_goal"])), np.float32)
    q = [np.array(path_of[i]["q"], np.float32) if i in path_of else none for i in ids]
    assert any(len(x) for x in q)
    data = {
        "method": np.array("my planner"),
        "trial_id": np.array(ids),
        "T_obj_ee": np.array([p["T_obj_ee"] for p in poses], np.float32).reshape(-1, 4, 4),
        "T_world_ee": np.array([p["T_world_ee"] for p in poses], np.float32).reshape(-1, 4, 4),
        "q": np.concatenate(q),
        "time_s": np.concatenate([np.array(path_of[i]["time_s"]) + 1e6 for i in ids if i in path_of]),
        "length": np.array([len(x) for x in q]),
    }
    np.savez(folder / "motions.npz", **data)
    return folder, run, data


def judged(folder, file, out, *more):
    robot = load_run(folder / "own").robot
    line = [
        "--benchmark",
        "r2h-v1",
        "--motions",
        file,
        "--robot",
        robot,
        "--trials",
        TRIALS,
        "--execute.sim",
        "none",
        "--out",
        folder / out,
        *more,
    ]
    done = in_process(*line)
    assert done.returncode == 0, done.stderr
    return load_run(folder / out)


@pytest.mark.parametrize(
    "planned", ["ur5e_2f85", pytest.param("panda_hand", marks=pytest.mark.whole(part="sweep"))], indirect=True
)
def test_motions_in_a_file_get_the_verdicts_of_the_same_paths_and_a_run_goes_on(planned):
    folder, own, _ = planned
    again = reevaluate(own, "oracle", 100, Judge(own))
    assert again.equal == again.scored == 2 * TRIALS and not again.differences
    run = judged(folder, folder / "motions.npz", "given", "--shard-trials", 5)
    a, b = own.trials("oracle").to_pylist(), run.trials("my planner").to_pylist()
    for x, y in zip(a, b, strict=True):
        assert {k: x[k] for k in ("trial_id", "outcome", "t_exec_s")} == pytest.approx(
            {k: y[k] for k in ("trial_id", "outcome", "t_exec_s")}
        )
        assert (y["t_plan_s"] is None) == (x["t_exec_s"] is not None)  # what moves was not planned here
        for c in CRITERIA:
            assert y[f"margin_{c}_m"] == pytest.approx(x[f"margin_{c}_m"], abs=2e-5), c
    # what is stored is enough to judge again, bit for bit, and to open a trial
    again = reevaluate(run, "my planner", 100, Judge(run))
    assert again.equal == again.scored == 2 * TRIALS and not again.differences
    moves = next(r["trial_id"] for r in b if r["t_plan_s"] is None)
    assert Reader(folder / "given").trial(moves).moves
    # a shard that is gone is judged again
    digest = run.digest("my planner")
    next((folder / "given" / "shards").rglob("000001-*")).unlink()
    assert judged(folder, folder / "motions.npz", "given").digest("my planner") == digest


def test_parquet_holds_the_same_motions(planned):
    folder, _, data = planned
    ends = np.cumsum(data["length"])
    cut = [slice(e - n, e) for e, n in zip(ends, data["length"])]
    table = pa.table(
        {
            "trial_id": data["trial_id"],
            "T_obj_ee": data["T_obj_ee"].reshape(-1, 16).tolist(),
            "T_world_ee": data["T_world_ee"].reshape(-1, 16).tolist(),
            "q": [data["q"][s].tolist() for s in cut],
            "time_s": [data["time_s"][s].tolist() for s in cut],
        }
    )
    pq.write_table(table, folder / "m.parquet")
    a = judged(folder, folder / "motions.npz", "npz").trials("my planner").drop_columns(["t_method_s", "t_plan_s"])
    b = judged(folder, folder / "m.parquet", "parquet").trials("m").drop_columns(["t_method_s", "t_plan_s"])
    assert a.equals(b)


def test_motions_of_joint_states_in_degrees_and_milliseconds_get_the_same_verdicts_once_they_say_so(planned):
    folder, own, data = planned
    joints, T = load_robot(own.robot).joints, data["T_world_ee"].copy()
    T[:, :2] = 0 - T[:, :2]  # in the frame of a UR's pendant
    order = sorted(range(6), key=lambda k: joints[k])
    said = {"frame": "base", "joint_names": [joints[k] for k in order], "angle_unit": "rad", "time_unit": "s"}
    turned = {**data, "T_world_ee": T, "q": data["q"][:, order]}
    np.savez(folder / "turned.npz", **turned, **said)
    said |= {"angle_unit": "deg", "time_unit": "ms", "length_unit": "mm"}
    other = {"q": np.rad2deg(turned["q"].astype(float)), "time_s": data["time_s"] * 1e3, "T_world_ee": T.astype(float)}
    other["T_obj_ee"] = data["T_obj_ee"].astype(float)
    for name in ("T_obj_ee", "T_world_ee"):
        other[name][:, :3, 3] *= 1e3
    np.savez(folder / "units.npz", **{**turned, **other}, **said)
    times = ["t_method_s", "t_plan_s"]
    rows = [
        judged(folder, folder / f"{name}.npz", f"declared-{name}").trials("my planner").drop_columns(times)
        for name in ("motions", "turned", "units")
    ]
    assert rows[0].equals(rows[1])  # signs and orders keep every bit
    for name in ("outcome", *(f"passed_{c}" for c in CRITERIA)):
        assert rows[0][name].equals(rows[2][name]), name
    for c in CRITERIA:
        near = [np.array(r[f"margin_{c}_m"].to_pylist(), float) for r in (rows[0], rows[2])]
        np.testing.assert_allclose(*near, atol=2e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"q": np.zeros((3, 6))}, "q (its rows are the sum of length) is (3, 6) float64; need"),
        ({"time_s": None}, "has no time_s; motions need"),
        ({"trial_id": None, "id": np.array([f"t{k}" for k in range(2 * TRIALS)])}, "names trials by id"),
        ({"T_world_ee": None, "q": np.zeros((2, 6)), "time_s": np.zeros(2), "length": np.eye(2 * TRIALS, dtype=int)[0] * 2},
         "and there is no T_world_ee"),
    ],
)  # fmt: skip
def test_what_is_no_motions_file_is_one_line(planned, changes, words):
    folder, _, data = planned
    np.savez(folder / "bad.npz", **{k: v for k, v in {**data, **changes}.items() if v is not None})
    done = in_process(
        "--motions", folder / "bad.npz", "--trials", TRIALS, "--execute.sim", "none", "--out", folder / "bad"
    )
    assert done.returncode == 2 and words in done.stderr and "bad.npz" in done.stderr.splitlines()[-1]


def test_a_motion_with_a_number_that_is_none_is_one_invalid_row(planned):
    folder, _, data = planned
    q = data["q"].copy()
    row = int((data["length"] > 0).argmax())
    q[int(data["length"][:row].sum()), 0] = np.nan
    np.savez(folder / "nan.npz", **{**data, "q": q})
    run = judged(folder, folder / "nan.npz", "nan")
    run.verify()
    outcome = dict(zip(*(run.trials("my planner")[c].to_pylist() for c in ("trial_id", "outcome")), strict=True))
    whole = judged(folder, folder / "motions.npz", "given").trials("my planner").to_pylist()
    expected = {r["trial_id"]: r["outcome"] for r in whole} | {int(data["trial_id"][row]): "invalid_input"}
    assert outcome == expected, "a number that is none in one motion changed other rows, or left its own as it was"
    assert reevaluate(run, "my planner", 100, Judge(run)).differences == (), "its rows are others when judged again"
