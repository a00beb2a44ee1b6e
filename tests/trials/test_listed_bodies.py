"""Listed trials whose receivers have bodies: `receiver` and `person` of a trials file."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from refusals import one_line

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base.errors import FileError
from r2h_batch.methods import random
from r2h_batch.scene.arrays import asset
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import edited
from r2h_batch.trials.trials_file import read_trials_file
from r2h_batch.types import Trials

HAND = asset("people", "hand.npz")


def with_bodies(n: int = 5) -> tuple[dict[str, np.ndarray], Trials]:
    """Columns of trials whose receivers are people, and the trials."""
    benchmark = edited(BenchmarkChoice("r2h-v2", people="adults"))
    trials = benchmark.trials(n)
    names, hands = [o.name for o in benchmark.objects], benchmark.hand_set
    rows = trials.hand_index.long()
    columns = {
        "object": np.array([names[i] for i in trials.object_index.tolist()]),
        "T_world_hand": trials.T_world_hand.numpy(),
        **{key: getattr(hands, key)[rows].numpy() for key in ("pose", "shape", "side")},
        "receiver": trials.receiver.numpy(),
        "person": trials.person.numpy()[:, :5],
    }
    return columns, trials


def test_listed_trials_may_have_bodies_and_people_and_are_judged_as_the_protocols(tmp_path):
    columns, wanted = with_bodies()
    np.savez(tmp_path / "b.npz", **columns)
    lists = {k: v.reshape(len(v), -1).tolist() if v.ndim > 1 else v.tolist() for k, v in columns.items()}
    pq.write_table(pa.table(lists), tmp_path / "b.parquet")
    (tmp_path / "b.json").write_text(json.dumps({k: v.tolist() for k, v in columns.items()}))
    order = torch.argsort(wanted.trial_id % 2, stable=True)
    wanted = wanted[order]
    for name in ("b.npz", "b.parquet", "b.json"):
        given = edited(
            BenchmarkChoice("r2h-v2", trials_file=str(tmp_path / name), hand_model=str(HAND), receiver="body")
        )
        found = given.trials(5)
        assert found.trial_id.tolist() == wanted.trial_id.tolist() and given.has_bodies
        torch.testing.assert_close(found.receiver, wanted.receiver, rtol=0, atol=0)
        torch.testing.assert_close(found.person[:, :5], wanted.person[:, :5], rtol=0, atol=0)
    own = Evaluator(edited(BenchmarkChoice(benchmark="r2h-v2", people="adults", receiver="body"))).kinematic
    listed = Evaluator(given).kinematic
    answer = random.predict(wanted, own.scene, seed=0)
    a, b = (
        e.score(answer.T_obj_ee, answer.T_world_ee, t)
        for e, t in ((own, wanted.named(own.scene.objects)), (listed, found))
    )
    assert a.outcome.equal(b.outcome) and a.margin.nan_to_num().equal(b.margin.nan_to_num())


@pytest.mark.parametrize(
    "ending", [".npz", *(pytest.param(e, marks=pytest.mark.slow) for e in (".json", ".parquet")), ".csv"]
)
def test_bodies_in_another_frame_and_other_units_are_the_same_once_they_say_so(tmp_path, ending):
    columns, _ = with_bodies(2)
    del columns["shape"], columns["side"], columns["pose"]
    columns["hand"] = np.arange(4)
    other = {k: v.astype(np.float64) if v.dtype.kind == "f" else v.copy() for k, v in columns.items()}
    turn = np.diag([-1.0, -1, 1, 1])
    other["T_world_hand"] = turn @ other["T_world_hand"]
    other["T_world_hand"][:, :3, 3] *= 100
    other["receiver"][:, :4, :2] *= -1
    other["receiver"][:, 3:, 3] *= -1
    other["receiver"][:, :, :3] *= 100
    other["receiver"][:, :2, 3] *= 100
    other["person"][:, 2:4] *= 100
    said = dict.fromkeys(["frame"], "base") | {"length_unit": "cm"}
    found = []
    for name, data in (("ours", columns), ("theirs", other | {k: np.full(4, v) for k, v in said.items()})):
        path = tmp_path / f"{name}{ending}"
        lists = {k: v.reshape(len(v), -1).tolist() if v.ndim > 1 else v.tolist() for k, v in data.items()}
        if ending == ".npz":
            np.savez(path, **data)
        elif ending == ".json":
            path.write_text(json.dumps({k: v.tolist() for k, v in data.items()}))
        elif ending == ".parquet":
            pq.write_table(pa.table(lists), path)
        else:
            flat = {}
            for k, rows in lists.items():
                wide = isinstance(rows[0], list)
                flat |= {f"{k}_{j}": [r[j] for r in rows] for j in range(len(rows[0]))} if wide else {k: rows}
            lines = [",".join(flat), *(",".join(map(str, r)) for r in zip(*flat.values(), strict=True))]
            path.write_text("\n".join(lines))
        found.append(edited(BenchmarkChoice("r2h-v2", trials_file=str(path))).trials(2))
    for name in ("T_world_hand", "receiver", "person"):
        torch.testing.assert_close(getattr(found[0], name), getattr(found[1], name), atol=1e-6, rtol=0)


def test_a_csv_says_bodies_number_by_number(tmp_path):
    columns, wanted = with_bodies(2)
    table = {"object": columns["object"], "hand": np.arange(4)}
    for name in ("T_world_hand", "receiver", "person"):
        flat = columns[name].reshape(4, -1)
        table |= {f"{name}_{k}": flat[:, k] for k in range(flat.shape[1])}
    lines = [",".join(table), *(",".join(str(v[i]) for v in table.values()) for i in range(4))]
    (tmp_path / "b.csv").write_text("\n".join(lines) + "\n")
    base = load_benchmark("r2h-v2")
    found, _, _ = read_trials_file(tmp_path / "b.csv", base.objects, base.hand_set)
    order = np.argsort(wanted.trial_id.numpy() % 2, kind="stable")
    assert found.receiver.numpy() == pytest.approx(columns["receiver"][order], abs=1e-6)


def around_the_robot() -> dict[str, np.ndarray]:
    """The first receiver, arm and hand, moved so that the torso's box is about the origin."""
    columns = with_bodies()[0]
    receiver, T = columns["receiver"].copy(), columns["T_world_hand"].copy()
    way = receiver[0, 3, :2].copy()
    receiver[0, :4, :2] -= way
    T[0, :2, 3] -= way
    return {"receiver": receiver, "T_world_hand": T}


def changed_at(name: str, at: tuple[int, ...], value: float, dtype: type = np.float32) -> dict[str, np.ndarray]:
    column = with_bodies()[0][name].astype(dtype)
    column[at] = value
    return {name: column}


NO_BODY = {
    "receiver: radius of the forearm of trial 3 is 45 m; allowed is 0.01 to 0.2 m": lambda: changed_at(
        "receiver", (3, 1, 3), 45.0
    ),
    "receiver: upper arm of trial 2 is": lambda: changed_at("receiver", (2, 0, 2), 5.0),
    "receiver: half size 1 of the torso of trial 0 is -0.1 m": lambda: changed_at("receiver", (0, 4, 1), -0.1),
    "receiver: facing of trial 4 (last number": lambda: changed_at("receiver", (4, 3, 3), 1.5),
    "distance of the wrist from the hand's frame of trial 1": lambda: {
        "T_world_hand": with_bodies()[0]["T_world_hand"] + np.eye(4, k=3)[None] * (np.arange(10) == 1)[:, None, None]
    },
    "receiver holds a number that is not finite in row 5": lambda: changed_at("receiver", (5, 0, 0), np.nan),
    "receiver is (10, 4, 4) float32; need 10 x 5 x 4": lambda: {"receiver": with_bodies()[0]["receiver"][:, :4]},
    "person: female of trial 2 is 0.5; allowed is 0 or 1": lambda: changed_at("person", (2, 1), 0.5),
    "person: stature of trial 6 is 1700; allowed is 0.6 to 2.35 m": lambda: changed_at("person", (6, 2), 1700.0),
    "receiver: last number of the wrist of trial 4 is 1e+39; it must be 0": lambda: changed_at(
        "receiver", (4, 2, 3), 1e39, np.float64
    ),
    "receiver: last number of the wrist of trial 1 is 0.5; it must be 0": lambda: changed_at(
        "receiver", (1, 2, 3), 0.5
    ),
    "receiver: distance of the shoulder from the torso of trial 2 is": lambda: changed_at("receiver", (2, 3, 2), -9.0),
    "receiver: distance of the torso from the robot's axis of trial 0 is 0 m": around_the_robot,
    "person: arm of trial 3 is": lambda: changed_at("person", (3, 2), 0.6),
    "person: hand length of trial 5 is 0.1 m": lambda: changed_at("person", (5, 3), 0.1),
    "has person and no receiver": lambda: {"receiver": None},
}


@pytest.mark.parametrize("words", NO_BODY)
def test_a_body_that_nobody_has_is_refused_in_one_line(words, tmp_path):
    base, columns = load_benchmark("r2h-v2"), with_bodies()[0] | NO_BODY[words]()
    np.savez(tmp_path / "t.npz", **{k: v for k, v in columns.items() if v is not None})
    with one_line(re.escape(words)):
        read_trials_file(tmp_path / "t.npz", base.objects, base.hand_set)


def test_body_is_asked_of_listed_trials_that_have_none(tmp_path):
    columns, _ = with_bodies()
    np.savez(tmp_path / "t.npz", **{k: v for k, v in columns.items() if k not in ("receiver", "person")})
    with pytest.raises(FileError, match="listed trials without receiver have no body"):
        edited(BenchmarkChoice("r2h-v2", trials_file=str(tmp_path / "t.npz"), receiver="body"))
