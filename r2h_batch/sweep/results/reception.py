"""Reception of a stored run: can the person take what each method handed over? (`results reception`)"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch

from r2h_batch.base.io.log import LOG
from r2h_batch.base.table import Table, document, notes_list, of_lines
from r2h_batch.judge.reception import ANGLES, STEPS, chance_of_one, reception
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.text import short_names
from r2h_batch.runs.files import RunError
from r2h_batch.runs.side import side_writer
from r2h_batch.runs.store import Run
from r2h_batch.sweep.results.reevaluation import Judge, check_poses
from r2h_batch.types import Scores

CURVE_K = (8, 32, 64, 128, 256)
TURNS_DEG = (45, 60, 90, 180)
ROWS = 1024

SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("evaluated", pa.bool_(), nullable=False),
        pa.field("received", pa.bool_(), nullable=False),
        pa.field("known", pa.int16(), nullable=False),
        *(pa.field(f"n_{step}", pa.int16(), nullable=False) for step in STEPS),
        pa.field("grasp", pa.int32()),
        pa.field("effort", pa.float32()),
        pa.field("turn_deg", pa.float32()),
        pa.field("travel_m", pa.float32()),
        *(pa.field(f"{name}_deg", pa.float32()) for name in ANGLES),
        pa.field("rula", pa.int8()),
    ]
)
"""A row for each stored row that has a pose; fields as in `judge.reception.Reception`, null where nothing is
received."""

NOTES = (
    "Percent of the rows with a held object and a goal posture; `n` counts them. A column of a step: rows with a grasp left that"
    " passes it and all before. received: the whole way to the easiest of these is free too. No part of SR, but where the"
    " benchmark asks for Received.",
    "K: how many of the received would be if only K grasps a side were known (drawn at random): at least one of them passes"
    " every step. Turn: received with the hand turned by at most so much in the easiest grasp.",
    "Hands have the shape of the held-out grasps, not of the trial's person (docs/receivers.md).",
)


def tables_of_run(run: Run, benchmark: BenchmarkChoice, device: str) -> dict[str, pa.Table]:
    """Method -> its table, of all methods with rows.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.

    Raises:
        RunError: the run holds no rows, no poses, or trials without a receiver's body.
    """
    judge, names = judge_of_bodies(run, benchmark, device)
    tables = {}
    for name in names:
        LOG.info(f"{name}: 256 grasps for each trial, some 10 ms a trial")
        tables[name] = table_of(run, name, judge)
    return tables


def judge_of(run: Run, benchmark: BenchmarkChoice, device: str) -> tuple[Judge, list[str]]:
    """The evaluator of a run, and its methods with rows.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.

    Raises:
        RunError: the run holds no rows or no poses.
    """
    check_poses(run)
    names = [e.name for e in run.entries if e.shards]
    if not names:
        raise RunError(f"{run.folder}: no shard of any method is stored")
    return Judge(run, given=benchmark, device=device), names


def judge_of_bodies(run: Run, benchmark: BenchmarkChoice, device: str) -> tuple[Judge, list[str]]:
    """The evaluator of a run whose receivers have bodies, and its methods with rows.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.

    Raises:
        RunError: the run holds no rows, no poses, or trials without a receiver's body.
    """
    judge, names = judge_of(run, benchmark, device)
    one = run.trials(names[0], ["trial_id"])["trial_id"][:1].to_numpy()
    if judge.trials(one).receiver is None:
        raise RunError(
            f"{run.folder}: its trials have no receiver's body; sweep a benchmark of people"
        )
    return judge, names


def table_of(run: Run, method: str, judge: Judge) -> pa.Table:
    """Reception of a method's stored rows.

    Args:
        run: with poses.
        method: name in the run.
        judge: the evaluator of the run.

    Raises:
        RunError: the run holds no poses.
        ValueError: its trials have no receiver's body.
    """
    tables = [rows_of(*part) for part in judged_again(run, method, judge)]
    return pa.concat_tables(tables) if tables else SCHEMA.empty_table()


def judged_again(
    run: Run, method: str, judge: Judge
) -> Iterator[tuple[np.ndarray, Scores, dict[int, bool]]]:
    """Numbers of the trials, scores of their stored poses up to the goal posture, and whether each trial succeeded;
    `ROWS` stored rows of a method at a time.

    Args:
        run: with poses. Where it holds details, the goal posture is the stored one.
        method: name in the run.
        judge: the evaluator of the run.

    Raises:
        RunError: the run holds no poses.
    """
    check_poses(run)
    for part in _parts(run, method):
        yield _judged(part, judge)


def judged_one(
    run: Run, method: str, judge: Judge, trial_id: int
) -> tuple[np.ndarray, Scores, dict[int, bool]]:
    """As `judged_again`, of one stored row."""
    stored = {"trials": run.trials(method), "poses": run.poses(method)}
    if all("details" in s.kinds for s in run.entry(method).shards.values()):
        stored["details"] = run.details(method)
    own = {k: t.filter(pc.equal(t["trial_id"], trial_id)) for k, t in stored.items()}
    return _judged(own, judge)


def _parts(run: Run, method: str) -> Iterator[dict[str, pa.Table]]:
    """Rows, poses and goals of a method, `ROWS` trials at a time."""
    for index, shard in sorted(run.entry(method).shards.items()):
        kinds = [k for k in ("trials", "poses", "details") if k in shard.kinds]
        stored = {k: run.shard(k, method, index).sort_by("trial_id") for k in kinds}
        ids = stored["poses"]["trial_id"].to_numpy()
        for i in range(0, len(ids), ROWS):
            own = pa.array(ids[i : i + ROWS])
            yield {k: t.filter(pc.is_in(t["trial_id"], own)) for k, t in stored.items()}


def _judged(
    stored: dict[str, pa.Table], judge: Judge
) -> tuple[np.ndarray, Scores, dict[int, bool]]:
    poses, device = stored["poses"], judge.evaluator.scene.device
    grasp, handover = (
        torch.tensor(poses[k].to_pylist(), dtype=torch.float32, device=device).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    )
    trials = judge.trials(poses["trial_id"].to_numpy())
    scores = judge.evaluator.score(grasp, handover, trials, stages="pose")
    if "details" in stored:  # a path may end in another branch than the pose stage's
        rows = {r["trial_id"]: r["q_goal"] for r in stored["details"].to_pylist()}
        nowhere = [float("nan")] * scores.q_goal.shape[1]
        q = [rows.get(i) or nowhere for i in poses["trial_id"].to_pylist()]
        goal = torch.tensor(q, dtype=torch.float32, device=device)
        known = goal.isfinite().all(1, keepdim=True)
        inputs = scores.inputs
        assert inputs is not None
        scores = replace(scores, q_goal=torch.where(known, goal, scores.q_goal)).with_inputs(inputs)
    rows = stored["trials"].select(["trial_id", "outcome"]).to_pylist()
    won = {r["trial_id"]: r["outcome"] == "success" for r in rows}
    return poses["trial_id"].to_numpy(), scores, won


def rows_of(trial_id: np.ndarray, scores: Scores, success: Mapping[int, bool]) -> pa.Table:
    """Reception of judged handovers as a table of `SCHEMA`.

    Args:
        trial_id: (n,) numbers of the trials.
        scores: n rows with their inputs.
        success: whether each trial succeeded.
    """
    found = reception(scores)
    count, angles = found.count.cpu().numpy(), found.angles_deg.cpu().numpy()
    columns: dict[str, Any] = {
        "trial_id": trial_id,
        "success": np.array([success[i] for i in trial_id.tolist()], bool),
        **{k: getattr(found, k).cpu().numpy() for k in ("evaluated", "received", "known")},
        **{f"n_{step}": count[:, j] for j, step in enumerate(STEPS)},
    }
    names = ("grasp", "effort", "turn_deg", "travel_m", "rula")
    easiest = {k: getattr(found, k).cpu().numpy() for k in names}
    easiest |= {f"{name}_deg": angles[:, j] for j, name in enumerate(ANGLES)}
    none = ~columns["received"]
    columns |= {k: pa.array(v, SCHEMA.field(k).type, mask=none) for k, v in easiest.items()}
    return pa.table({name: columns[name] for name in SCHEMA.names}, schema=SCHEMA)


def write(path: Path, table: pa.Table) -> None:
    """Writes the table as Parquet, in one step."""
    with side_writer(path, table.schema) as writer:
        writer.write(table)


def render(tables: dict[str, pa.Table]) -> str:
    """The funnel, what it says with fewer grasps and with less turn of the hand, and the effort, of each
    method, as text that ends in a newline."""
    short = short_names(list(tables))
    funnel, curve, effort = [], [], []
    for name, table in tables.items():
        row = {k: table[k].to_numpy(zero_copy_only=False) for k in table.column_names}
        judged = row["evaluated"]
        got = row["received"] & judged
        label = short[name]
        last = row[f"n_{STEPS[-1]}"]
        steps = [_percent((row[f"n_{step}"] > 0)[judged]) for step in STEPS]
        shares = [*steps, _percent(got[judged]), _percent(got), _percent(got & row["success"])]
        funnel.append([label, str(int(judged.sum())), *shares])
        # of received rows alone: so no column K exceeds received
        passing = np.where(got, last, 0)[judged]
        chances = [chance_of_one(passing, row["known"][judged], k) for k in CURVE_K]
        turned = [np.nan_to_num(row["turn_deg"][judged], nan=np.inf) <= t for t in TURNS_DEG]
        curve.append([label, *map(_percent, chances), *map(_percent, turned)])
        effort.append([label, *_means(row, got)])
    curve_head = [*(f"K={k}" for k in CURVE_K), *(f"{t} deg" for t in TURNS_DEG)]
    parts: list[Table | str] = [
        "Received, by step",
        of_lines(["Method", "n", *STEPS, "received", "of all", "and success"], funnel),
        "With fewer known grasps, and with less turn of the hand",
        of_lines(["Method", *curve_head], curve),
        "Means of the easiest grasp",
        of_lines(["Method", "turn, deg", "travel, cm", "lean, deg", "effort", "RULA"], effort),
        notes_list(NOTES),
    ]
    return document(parts)


def _percent(hits: Sequence[bool] | np.ndarray) -> str:
    return f"{100 * float(np.mean(hits)):.1f}" if len(hits) else "-"


def _means(row: dict[str, np.ndarray], got: np.ndarray) -> list[str]:
    if not got.any():
        return ["-"] * 5
    turn, travel, lean, effort, rula = (
        float(np.mean(row[k][got])) for k in ("turn_deg", "travel_m", "lean_deg", "effort", "rula")
    )
    return [f"{turn:.0f}", f"{100 * travel:.1f}", f"{lean:.1f}", f"{effort:.3f}", f"{rula:.2f}"]
