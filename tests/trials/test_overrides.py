"""A benchmark out of flags: other hands, grasps and trials in a sweep, and what is refused."""

import json
import random
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import trimesh
from odd_fields import outcome, with_odd
from refusals import one_line

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.scene.arrays import asset, read_arrays
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import load_objects
from r2h_batch.trials.choice import BenchmarkChoice, words_of
from r2h_batch.trials.edit import edited
from r2h_batch.trials.file_fields import text_of
from r2h_batch.trials.trials_file import read_trials_file
from r2h_batch.trials.yaml_file import read_benchmark


def some_trials(count: int = 5) -> dict[str, np.ndarray]:
    """The protocol's first trials of both splits as a file has them, S1 before S0, with a posture for each."""
    trials, hands, objects = (
        load_benchmark("r2h-v1").trials(count, splits=["S1", "S0"]),
        load_hand_set(),
        load_objects(),
    )
    hand = trials.hand_index.long()
    return {
        "object": np.array([objects[i].name for i in trials.object_index.tolist()]),
        "T_world_hand": trials.T_world_hand.numpy(),
        **{k: getattr(hands, k)[hand].numpy() for k in ("pose", "shape", "side")},
    }


def as_parquet(path: Path, columns: dict[str, np.ndarray]) -> Path:
    lists = {k: v.reshape(len(v), -1).tolist() if v.ndim > 1 else v.tolist() for k, v in columns.items()}
    pq.write_table(pa.table({k: pa.array(v) for k, v in lists.items()}), path)
    return path


def score(out: Path, *flags: object) -> None:
    line = [
        "sweep",
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--execute.sim",
        "none",
        "--out",
        out,
        "--save-paths",
        *flags,
    ]
    assert main([str(a) for a in line]) == 0


def rows(run: Path) -> list[dict]:
    free = ("t_plan_s", "t_method_s", "hand_index", "body_m")  # listed trials have no bodies
    return [{k: v for k, v in row.items() if k not in free} for row in load_run(run).trials("random").to_pylist()]


def test_the_protocols_trials_and_the_built_in_benchmark_as_files_give_the_same_rows(tmp_path, capsys):
    np.savez(tmp_path / "t.npz", **some_trials())
    score(tmp_path / "a", "--trials", 5)
    score(tmp_path / "b", "--trials-file", tmp_path / "t.npz")
    v1 = load_benchmark("r2h-v1")
    (tmp_path / "built_in.yaml").write_text(text_of(v1.name, v1.objects, v1.receiver))
    score(tmp_path / "c", "--trials", 5, "--benchmark", tmp_path / "built_in.yaml")
    capsys.readouterr()
    found = rows(tmp_path / "b")
    assert len(found) == 10 and found == rows(tmp_path / "a") == rows(tmp_path / "c")
    assert load_run(tmp_path / "b").header["protocol"] == "listed"
    again = ["results", "reevaluate", str(tmp_path / "b"), "--rows", "4"]
    (tmp_path / "t.npz").rename(tmp_path / "moved.npz")
    assert main(again) == 0  # the run has the file
    assert "none differs" in capsys.readouterr().out
    assert main([*again, "--trials-file", str(tmp_path / "moved.npz")]) == 2
    assert "--trials-file: r2h_batch 0.3 had it" in capsys.readouterr().err
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 2
    assert "differ in benchmark (r2h-v1, trials of a file)" in capsys.readouterr().err


def test_one_sided_hands_are_drawn_for_all_trials_and_the_run_is_as_planned(tmp_path, capsys):
    own = load_hand_set()
    right = {k: getattr(own, k).numpy()[:3] for k in ("pose", "shape", "side")}
    np.savez(tmp_path / "hands.npz", **right, posture=np.array(["a", "b", "c"]))
    score(tmp_path / "run", "--trials", 4, "--hands", tmp_path / "hands.npz")
    digest = edited(BenchmarkChoice("r2h-v1", hands=str(tmp_path / "hands.npz"))).digest
    assert main(["report", str(tmp_path / "run"), "--full"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"flags: --benchmark r2h-v1 --hands hands.npz, digest {digest[:12]}" in printed
    assert main(["results", "verify", str(tmp_path / "run")]) == 0
    run = load_run(tmp_path / "run")
    assert set(run.trials("random")["side"].to_pylist()) == {"right"}
    assert run.header["benchmark"]["flags"] == ["--benchmark r2h-v1", f"--hands {tmp_path / 'hands.npz'}"]
    assert run.header["digests"]["benchmark"] == digest != load_benchmark("r2h-v1").digest


def test_a_split_without_objects_is_refused_before_any_mesh_is_built(tmp_path, capsys):
    for name in ("mug", "jar"):
        trimesh.creation.box((0.05, 0.06, 0.07)).export(tmp_path / f"{name}.obj")
    line = [
        "sweep",
        "--objects",
        str(tmp_path),
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "2",
        "--out",
        str(tmp_path / "r"),
    ]
    assert main(line) == 2
    refused = "sweep: no object belongs to split S1; give at least one, or --splits S0\n"
    assert capsys.readouterr().err == refused
    (tmp_path / "benchmark.yaml").write_text("objects: [{file: mug.obj, split: S1}, {built_in: hammer}]")
    assert main(line) == 2
    assert capsys.readouterr().err == refused.replace("S0", "S2").replace("S1", "S0").replace("S2", "S1")


def test_npz_and_parquet_with_rows_of_the_hand_set_or_postures_say_the_same(tmp_path):
    columns, base = some_trials(), load_benchmark("r2h-v1")
    np.savez(tmp_path / "p.npz", **columns)
    as_parquet(tmp_path / "p.parquet", columns)
    by_row = {k: columns[k] for k in ("object", "T_world_hand")}
    by_row["hand"] = load_benchmark("r2h-v1").trials(5, splits=["S1", "S0"]).hand_index.numpy()
    np.savez(tmp_path / "h.npz", **by_row)
    as_parquet(tmp_path / "h.parquet", by_row)
    wanted = load_benchmark("r2h-v1").trials(5)
    for name in ("p.npz", "p.parquet", "h.npz", "h.parquet"):
        trials, hands, _ = read_trials_file(tmp_path / name, base.objects, base.hand_set)
        assert trials.trial_id.tolist() == wanted.trial_id.tolist()
        assert (trials.T_world_hand == wanted.T_world_hand).all() and (trials.object_index == wanted.object_index).all()
        for key in ("pose", "shape", "side"):
            mine = getattr(hands, key)[trials.hand_index.long()]
            assert (mine == getattr(base.hand_set, key)[wanted.hand_index.long()]).all()
    given = edited(BenchmarkChoice("r2h-v1", trials_file=str(tmp_path / "h.npz")))
    assert given.trials_with_ids(wanted.trial_id[[7, 2]]).T_world_hand.equal(wanted.T_world_hand[[7, 2]])
    assert len(given.trials(3, splits="S1")) == 3
    with pytest.raises(ValueError, match="trial id 99 is not in the list"):
        given.trials_with_ids(wanted.trial_id[:1] + 99)


def bent(at: tuple[int, ...], value: float) -> np.ndarray:
    T = some_trials()["T_world_hand"].copy()
    T[at] = value
    return T


REFUSED = {
    "no object is called 'mug'": lambda: {"object": ["mug"] * 10},
    "T_world_hand of row 3 is not a rigid pose": lambda: {"T_world_hand": bent((3, 0, 0), 2.0)},
    "T_world_hand of row 2 is more than 10 m away": lambda: {"T_world_hand": bent((2, 0, 3), 450.0)},
    "has no shape; needed are": lambda: {"shape": None},
    "give either hand": lambda: {"hand": np.zeros(10, int)},
    "answers \\(T_obj_ee\\), no trials; give it as --predictions": lambda: {"T_obj_ee": np.zeros((10, 4, 4))},
    "no trials; give it as --motions": lambda: {"T_obj_ee": np.zeros((10, 4, 4)), "q": np.zeros((10, 6))},
    "unknown array 'hnad'": lambda: {"hnad": np.zeros(10, int)},
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_trials_file_that_is_none_is_refused_in_one_line(words, tmp_path):
    base, changed = load_benchmark("r2h-v1"), some_trials() | REFUSED[words]()
    np.savez(tmp_path / "t.npz", **{k: np.asarray(v) for k, v in changed.items() if v is not None})
    with one_line(words):
        read_trials_file(tmp_path / "t.npz", base.objects, base.hand_set)


def test_a_long_trials_file_with_one_id_twice_at_its_end_is_refused_at_once(tmp_path):
    base, rows = load_benchmark("r2h-v1"), 100_000
    ids = np.arange(rows).astype(str)
    ids[-1] = ids[-2]
    columns = {k: np.repeat(x[:1], rows, 0) for k, x in some_trials(1).items() if k in ("object", "T_world_hand")}
    np.savez(tmp_path / "t.npz", **columns, hand=np.zeros(rows, np.int64), id=ids)
    start = time.process_time()
    with one_line(f"two trials have the id '{rows - 2}'"):
        read_trials_file(tmp_path / "t.npz", base.objects, base.hand_set)
    assert time.process_time() - start < 20  # a comparison of each with each takes minutes


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_odd_columns_of_a_trials_file_are_one_line(tmp_path, suffix):
    objects, hands = [SimpleNamespace(name=n, split=s) for n, s in (("mug", "S0"), ("hammer", "S1"))], load_hand_set()
    T = np.eye(4)
    T[:3, 3] = 0.5, 0.0, 0.9
    good = {
        "object": ["mug", "hammer"] * 3, "T_world_hand": [T.tolist()] * 6, "hand": [*range(6)],
        "id": [*"abcdef"], "variant": ["x"] * 6,
    }  # fmt: skip
    path, rng, found = tmp_path / f"t{suffix}", random.Random(7), []
    for changed in [good, *(with_odd(good, rng) for _ in range(150))]:
        try:
            if suffix == ".json":
                path.write_text(json.dumps(changed))
            else:
                np.savez(path, **{k: np.array(v) for k, v in changed.items()})
        except ValueError:  # no array is made of it
            continue
        found.append(outcome(lambda: read_trials_file(path, objects, hands)))
    assert found[0] and found.count(False) > 60


def test_another_hand_takes_the_postures_of_the_set_everywhere(tmp_path):
    arrays = read_arrays(asset("hand", "hand.npz"))
    np.savez(tmp_path / "large.npz", **arrays | {"vertices": arrays["vertices"] * np.float32(1.1)})
    own = load_hand_set()
    few = {k: getattr(own, k).numpy()[[0, 399]] for k in ("pose", "shape", "side")}
    np.savez(tmp_path / "two.npz", **few, posture=np.array(["a", "b"]))
    given = BenchmarkChoice("r2h-v1", hand_model=str(tmp_path / "large.npz"), hands=str(tmp_path / "two.npz"))
    found = edited(given)
    assert edited(given).hand_set is found.hand_set  # read once: what is made for a hand is made once
    scene = Evaluator(found).scene
    assert scene.hands.model is found.hand_set.model and len(scene.hands.set) == 2
    rest = own.model.pose(torch.zeros(1, 48)).vertices
    assert torch.allclose(scene.hands.model.pose(torch.zeros(1, 48)).vertices, rest * 1.1, atol=1e-3)
    assert found.digest != edited(BenchmarkChoice("r2h-v1", hands=str(tmp_path / "two.npz"))).digest
    np.savez(tmp_path / "large.npz", **arrays)  # another hand in the file: it is read again
    assert edited(given).digest != found.digest


ROWS = {"a": [0, 1, 2, 200, 201, 202], "b": [7, 8, 207, 208]}


@pytest.fixture
def sets(tmp_path):
    """Two sets of our own hands: six with what is known of them, four without."""
    own = load_hand_set()
    known = {
        "object": np.array(["mug", "cup", "mug", "mug", "cup", "cup"]),
        "held_s": np.array([0.5, 0.1, 0.4, 0.3, np.nan, 2.0], np.float32),
        "mover": np.array([True, False, True, False, True, True]),
    }
    for name, at, more in (("a", ROWS["a"], known), ("b", ROWS["b"], {})):
        arrays = {k: getattr(own, k).numpy()[at] for k in ("pose", "shape", "side")}
        np.savez(tmp_path / f"{name}.npz", **arrays, posture=np.array([f"{name}{i}" for i in range(len(at))]), **more)
    return tmp_path


@pytest.mark.parametrize(
    ("said", "postures"),
    [
        ("[a.npz, b.npz]", "a0 a1 a2 b0 b1 a3 a4 a5 b2 b3"),
        ("[{file: a.npz, side: left}, {file: b.npz, side: right}]", "b0 b1 a3 a4 a5"),
        ("[{file: a.npz, object: [mug]}]", "a0 a2 a3"),
        ("[{file: a.npz, contact: true}]", "a0 a2 a3 a5"),
        ("[{file: a.npz, mover: true, side: left, count: 1}, b.npz]", "b0 b1 a4 b2 b3"),
    ],
)
def test_hand_sets_are_joined_and_chosen_from(sets, said, postures):
    (sets / "b.yaml").write_text(f"hand_set: {said}\n")
    found = read_benchmark(sets / "b.yaml").hand_set
    assert " ".join(found.posture) == postures and (np.diff(found.side.numpy()) >= 0).all()
    own = load_hand_set()
    rows = [ROWS[p[0]][int(p[1])] for p in found.posture]
    assert torch.equal(found.pose, own.pose[rows]) and torch.equal(found.side, own.side[rows])


def test_stored_flags_are_read_back_whatever_is_in_a_name():
    """A shell's quotes since names may have spaces; runs of older versions have none."""
    given = BenchmarkChoice(
        objects="families:cup,hammer x 20 seed 7", object_mesh=("a b.obj:S0", "c's.obj"), robot="ur3e_2f85"
    )
    objects, meshes, robot = given.flags()
    assert words_of(objects.partition(" ")[2]) == [given.objects]
    assert tuple(words_of(meshes.partition(" ")[2])) == given.object_mesh and robot == "--robot ur3e_2f85"
    assert words_of("c's.obj b.obj") == ["c's.obj", "b.obj"]


def test_a_file_about_a_mesh_that_is_not_read_is_named(tmp_path, capsys):
    trimesh.creation.box((0.03, 0.05, 0.12)).export(tmp_path / "block.obj")
    choice = BenchmarkChoice(benchmark="r2h-v1", object_mesh=(str(tmp_path / "block.obj"),))
    edited(choice)
    assert "is not read" not in capsys.readouterr().err
    (tmp_path / "block.yaml").write_text("roles: {wal: wrap}\n")
    edited(choice)
    said = capsys.readouterr().err
    assert f"{tmp_path / 'block.yaml'} is not read" in said and "--objects FOLDER" in said
