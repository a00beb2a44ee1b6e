"""Runs made by hand for the tests of what comes after `Scores`: trials, scores, the paper's rows."""

import contextlib
import csv
import faulthandler
import io
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from r2h_batch.__main__ import main
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.base.registry import is_drawn
from r2h_batch.base.schedule import trial_ids
from r2h_batch.runs import store as results
from r2h_batch.runs.files import sha256_of
from r2h_batch.runs.writing import RunFolder, open_run
from r2h_batch.sweep.rows import TrialNames, detail_rows, path_rows, pose_rows, score_rows
from r2h_batch.types import CRITERIA, CollidingPair, Outcome, PlanReason, Predictions, Scores, Trials

OBJECTS = ("bowl", "cup", "eyeglasses", "hammer", "knife", "scissors")
NAMES = TrialNames(
    objects=OBJECTS,
    object_splits=("S0", "S0", "S0", "S1", "S1", "S1"),
    hand_sides=("right", "right", "left", "left"),
    parts=("base", "forearm", "left_pad"),
)
FAILED = {Outcome[name.upper()]: column for column, name in enumerate(CRITERIA)}
PLAN, REACH, AFFORDANCE, SAFE = (CRITERIA.index(name) for name in ("plan", "reach", "affordance", "safe"))
TABLE_1 = Path(__file__).resolve().parents[2] / "r2h_batch" / "sweep" / "study" / "paper" / "table1.csv"


def made_trials(n_s0: int, n_s1: int) -> Trials:
    """Trials with ids 0.. in S0 and then S1, objects in turn."""
    objects = np.concatenate([np.arange(n_s0) % 3, 3 + np.arange(n_s1) % 3])
    n = n_s0 + n_s1
    return Trials(
        trial_id=torch.arange(n),
        object_index=torch.from_numpy(objects.astype(np.int32)),
        hand_index=torch.arange(n, dtype=torch.int32) % 4,
        T_world_hand=torch.eye(4).expand(n, 4, 4).clone(),
    )


def make_predictions(trials: Trials, method: str = "made", seed: int = 0) -> Predictions:
    poses = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, len(trials), 4, 4)).astype(np.float32))
    return Predictions(trials.trial_id, poses[0], poses[1], None, method)


def make_scores(
    trials: Trials, outcome: np.ndarray, *, t_plan_s: float = 0.1, t_exec_s: float = 8.5, s1: np.ndarray | None = None
) -> Scores:
    """Scores whose first failure is `outcome`; Stability and Plan failures fail Reach too, times vary. `s1`: whose
    Affordance is looked at (default: of `OBJECTS`)."""
    outcome = np.asarray(outcome)
    n = len(outcome)
    s1 = trials.object_index.numpy() >= 3 if s1 is None else s1
    invalid = outcome >= Outcome.INVALID_INPUT
    passed, evaluated = np.ones((n, len(CRITERIA)), bool), np.ones((n, len(CRITERIA)), bool)
    for code, column in FAILED.items():
        passed[outcome == code, column] = False
    passed[np.isin(outcome, [Outcome.STABILITY, Outcome.PLAN]), REACH] = False
    evaluated[outcome == Outcome.PLAN, SAFE] = False
    evaluated[~s1, AFFORDANCE] = False
    evaluated[invalid] = False
    passed &= evaluated
    margin = np.where(passed, 0.01, -0.02).astype(np.float32)
    margin[~evaluated] = np.nan
    margin[outcome == Outcome.PLAN, PLAN] = -np.inf
    has_path = evaluated[:, PLAN] & passed[:, PLAN]
    lengths = np.where(has_path, 2 + np.arange(n) % 3, 0)
    path = np.random.default_rng(7).normal(size=(n, 5, 6)).astype(np.float32)
    reason = np.where(outcome == Outcome.PLAN, PlanReason.IK_IN_COLLISION, PlanReason.OK)
    reason[invalid] = PlanReason.NOT_EVALUATED
    pair = np.where(outcome == Outcome.PLAN, CollidingPair.OBJECT_HAND, CollidingPair.NONE)

    def floats(values: np.ndarray, where: np.ndarray) -> torch.Tensor:
        shape = (n,) + (1,) * (values.ndim - 1)
        return torch.from_numpy(np.where(where.reshape(shape), values, np.nan).astype(np.float32))

    return Scores(
        trial_id=trials.trial_id,
        outcome=torch.from_numpy(outcome.astype(np.int8)),
        success=torch.from_numpy(outcome == Outcome.SUCCESS),
        passed=torch.from_numpy(passed),
        evaluated=torch.from_numpy(evaluated),
        margin=torch.from_numpy(margin),
        margin_kind=torch.from_numpy(
            np.select([~evaluated, np.isinf(margin), margin < 0], [0, 3, 2], 1).astype(np.int8)
        ),
        borderline=torch.from_numpy(np.arange(n) % 7 == 0),
        plan_reason=torch.from_numpy(reason.astype(np.int8)),
        plan_pair=torch.from_numpy(pair.astype(np.int8)),
        witness_part=torch.from_numpy(np.where(has_path[:, None], [1, 2], -1).astype(np.int32)),
        witness_time_s=floats(np.full(n, 1.5), has_path),
        witness_point=floats(np.full((n, 3), 0.25), has_path),
        t_plan_s=floats(_around(t_plan_s, n), ~invalid),
        t_exec_s=floats(_spread(t_exec_s, has_path), has_path),
        q_goal=floats(path[:, 0], has_path),
        width_m=floats(np.full(n, 0.04), ~invalid),
        opening_m=floats(np.full(n, 0.041), ~invalid),
        grasp_shift_m=floats(np.zeros(n), ~invalid),
        slip_m=floats(np.full(n, 0.001), np.arange(n) % 2 == 0),
        presented_margin_m=floats(np.where(np.arange(n) % 4 > 0, 0.02, -0.03), ~invalid),
        presented_by=torch.from_numpy(np.where(invalid, -1, np.arange(n) % 3).astype(np.int8)),
        tilt_deg=floats(np.where(np.arange(n) % 4 > 1, 20.0, 120.0), ~s1 & ~invalid),
        path=torch.from_numpy(path),
        path_time_s=torch.from_numpy(np.tile(np.arange(5, dtype=np.float32), (n, 1))),
        path_len=torch.from_numpy(lengths.astype(np.int32)),
        motion=torch.from_numpy(path[:, ::-1].copy()),
        motion_len=torch.from_numpy(np.where(has_path, 5, 0).astype(np.int32)),
        failed_state=torch.arange(3 * n, dtype=torch.float64).reshape(n, 3),
        body_m=torch.full((n,), torch.nan),
    )


def _around(mean: float, n: int) -> np.ndarray:
    """n values that differ and have exactly this mean."""
    offsets = np.arange(n) - (n - 1) / 2
    return mean * (1 + 0.5 * offsets / max(n, 1))


def _spread(mean: float, where: np.ndarray) -> np.ndarray:
    values = np.full(len(where), np.nan)
    values[where] = _around(mean, int(where.sum()))
    return values


def make_header(n_s0: int, n_s1: int, **changes: object) -> dict:
    header = {
        "protocol": "made",
        "trials": {split: n for split, n in (("S0", n_s0), ("S1", n_s1)) if n is not None},
        "configuration": {"name": "default"},
        "digests": {"trials": "0123456789abcdef"},
        "seed": 0,
        "stored": [],
        "device": {"kind": "cpu", "name": "cpu: test"},
        "versions": {"r2h_batch": "0.1.0"},
        "command": ["made", "by", "hand"],
    }
    return {**header, **changes}


def store(run: RunFolder, method: str, trials: Trials, scores: Scores, t_method_s: torch.Tensor | None = None) -> None:
    """All of a method's shards that are not there yet, with what the header asks for."""
    run.register(method, {"kind": "test"})
    for shard in run.todo(method):
        rows = slice(shard.first, shard.last)
        part, scored = trials[rows], scores[rows]
        with run.write(method, shard) as writer:
            seconds = None if t_method_s is None else t_method_s[rows]
            writer.append(trials=score_rows(part, scored, NAMES, seconds))
            more = {"details": detail_rows(part, scored, NAMES), "poses": pose_rows(make_predictions(part))}
            more["paths"] = path_rows(scored)
            writer.append(**{k: more[k] for k in run.header["stored"]})


def write_run(folder: Path, methods: dict[str, np.ndarray], n_s0: int, n_s1: int, **changes: object) -> results.Run:
    """A stored run in which method -> outcome codes of its n_s0 + n_s1 trials."""
    trials, header = made_trials(n_s0, n_s1), make_header(n_s0, n_s1, **changes)
    if is_drawn(header):  # a rule has ids of its own
        trials = replace(trials, trial_id=torch.from_numpy(trial_ids(header["trials"], 0, len(trials))))
    run = open_run(folder, header)
    for name, outcome in methods.items():
        store(run, name, trials, make_scores(trials, outcome))
    return results.load_run(folder)


def table_1() -> list[dict[str, str]]:
    """The paper's Table I, cells as printed."""
    with TABLE_1.open(encoding="utf-8") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def paper_run(folder: Path) -> results.Run:
    """500 rows per split and method with the paper's counts and mean times, shuffled, as a stored run."""
    cells = {(r["split"], r["method"]): r for r in table_1()}
    columns = {"f_stab": Outcome.STABILITY, "f_plan": Outcome.PLAN, "f_reach": Outcome.REACH}
    columns |= {"f_afford": Outcome.AFFORDANCE, "f_safe": Outcome.SAFE}
    trials = made_trials(500, 500)
    run = open_run(folder, make_header(500, 500))
    for method in dict.fromkeys(m for _, m in cells):
        parts = []
        for split, rows in (("S0", slice(0, 500)), ("S1", slice(500, 1000))):
            cell = cells[split, method]
            counts = {code: round(5 * float(cell[name] or 0)) for name, code in columns.items()}
            outcome = np.repeat(list(counts), list(counts.values()))
            outcome = np.concatenate([outcome, np.zeros(500 - len(outcome), int)])
            np.random.default_rng(11).shuffle(outcome)
            seconds = {k: float(cell[k]) for k in ("t_plan_s", "t_exec_s")}
            parts.append(make_scores(trials[rows], outcome, **seconds))
        store(run, method, trials, Scores.concatenate(parts), torch.full((1000,), 0.02))
    return results.load_run(folder)


def read_json(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


_O = Outcome
OUTCOMES = np.array([
    *(_O.SUCCESS, _O.STABILITY, _O.PLAN, _O.REACH, _O.SAFE, _O.INVALID_INPUT, _O.INVALID_SIM),
    *(_O.SUCCESS, _O.AFFORDANCE, _O.SAFE, _O.PLAN, _O.SUCCESS),
])  # fmt: skip


def write(folder, outcome=OUTCOMES, method="m", **changes):
    n = len(outcome) // 2
    trials = made_trials(n, len(outcome) - n)
    scores = make_scores(trials, outcome)
    run = open_run(folder, make_header(n, len(outcome) - n, **changes))
    store(run, method, trials, scores)
    return trials, scores


def files_of(folder, method=""):
    return sorted((folder / "shards" / method).rglob("*.parquet"))


def forge(path, change, kind="trials"):
    """Another shard in the place of one, with the digest that it has; `change` gets the rows of a kind as a table. The new
    file."""
    table = pq.read_table(path, partitioning=None)
    if kind == "trials":
        structs = [field for field in table.schema if pa.types.is_struct(field.type)]
        rows = change(table.drop_columns([field.name for field in structs]))
        for field in structs:
            rows = rows.append_column(field, table[field.name])
    else:
        struct = table[kind].combine_chunks()
        there = struct.is_valid()
        flat = pa.table([table["trial_id"], *struct.flatten()], names=["trial_id", *(f.name for f in struct.type)])
        flat = change(flat.filter(there)).drop_columns(["trial_id"])
        place = pa.array(np.where(there, np.cumsum(there) - 1, 0), mask=~np.asarray(there))
        arrays = [c.combine_chunks() for c in flat.take(place).columns]
        struct = pa.StructArray.from_arrays(arrays, fields=list(flat.schema), mask=place.is_null())
        rows = table.set_column(table.column_names.index(kind), kind, struct)
    path.unlink()
    return put_shard(path, rows.replace_schema_metadata(table.schema.metadata))


def put_shard(path, table):
    """The table as a shard's file in the folder of `path` and with its number, under the digest that it has."""
    temporary = path.with_name(".forged")
    pq.write_table(table, temporary)
    new = path.with_name(f"{path.name[:6]}-{sha256_of(temporary)[:16]}.parquet")
    temporary.rename(new)
    return new


def receipt_of(path):
    return json.loads(pq.read_schema(path).metadata[b"r2h_batch"])


def with_receipt(path, receipt):
    """The shard with another receipt, under the digest that it has."""
    table = pq.read_table(path, partitioning=None)
    path.unlink()
    return put_shard(path, table.replace_schema_metadata({"r2h_batch": json.dumps(receipt)}))


def with_a_fatal_footer(data):
    """The bytes with one bit of the footer flipped so that pyarrow aborts."""
    size = int.from_bytes(data[-8:-4], "little")

    def flipped(bit):
        found = bytearray(data)
        found[bit // 8] ^= 1 << bit % 8
        return bytes(found)

    told, tell = os.pipe()
    if not (child := os.fork()):  # says which bit it tries, and dies of one
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        for bit in range(8 * (len(data) - 8 - size), 8 * (len(data) - 8)):
            os.write(tell, bit.to_bytes(8, "little"))
            with contextlib.suppress(Exception), pq.ParquetFile(io.BytesIO(flipped(bit))) as file:
                check_decoded_size(file, 1 << 60, "")
        os._exit(0)
    os.close(tell)
    with os.fdopen(told, "rb") as words:
        tried = words.read()
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) < 0:
        return flipped(int.from_bytes(tried[-8:], "little"))
    raise AssertionError("no bit of this footer aborts pyarrow: the test has nothing to show")


def forged(folder, out, change, kind="trials"):
    """A copy of the run in which `change(row) -> bool` has edited rows, with receipt and digest agreeing."""
    shutil.copytree(folder, out)
    edited = []
    for path in files_of(out, "random"):
        receipt = receipt_of(path)

        def edit(table, receipt=receipt):
            rows = table.to_pylist()
            for row in rows:
                before = row.get("outcome")
                if change(row):
                    edited.append(row["trial_id"])
                    if kind == "trials":
                        counts = receipt["outcomes"][row["split"]]
                        counts[before] -= 1
                        counts[row["outcome"]] = counts.get(row["outcome"], 0) + 1
            return pa.Table.from_pylist(rows, schema=table.schema)

        with_receipt(forge(path, edit, kind), receipt)
    return edited


def command(name: str, *runs: Path | str, **options: object) -> int:
    """The exit code of a command on run folders; options as the command has them in Python."""
    flags = [[f"--{k.replace('_', '-')}", *([] if v is True else [str(v)])] for k, v in options.items()]
    return main([name, *map(str, runs), *(word for flag in flags for word in flag)])
