"""Objects of a stored run that the closed gripper holds under their weight for 1 s (`results held`)."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from r2h_batch.base.io.cache import code_digest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.write import atomic_path
from r2h_batch.closed_loop.transfer.cases import Processes, Simulator, processes
from r2h_batch.closed_loop.transfer.handed import gripped_of
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.judge.grasp_physics import DROPPED_M
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.held import FOLDER, MADE_OF
from r2h_batch.report.text import aligned, notes_list, percent_text, plain, rate_text, short_names
from r2h_batch.runs.store import Run
from r2h_batch.sweep.results.reception import judge_of, judged_again
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.scoring import progress

_FLOAT = pa.float32()
SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("held", pa.bool_()),
        pa.field("slip_m", _FLOAT),
        pa.field("turn_deg", _FLOAT),
        pa.field("closing_m", _FLOAT),
    ]
)
"""A row for each stored row whose grasp passes Stability. held: the object slipped by less than 2 cm; null: the
simulation failed. closing_m: how far the closing gripper moved it."""
CODE = ("r2h_batch.closed_loop.transfer", "r2h_batch.judge.grasp_physics")
VERSIONS = ("mujoco", "numpy")
NOTES = (
    f"held: the object's centre of mass slips by less than {100 * DROPPED_M:g} cm while the weight acts for 1 s,"
    " at the handover pose, after the gripper has closed with 30 N (pad friction 0.8).",
    "n counts the rows that pass Stability. Brackets: 95 %, Wilson. No part of SR. Objects: those that are not always held, and"
    " the median slip of the lost. `report` and `compare` show the rate from now on.",
)


def write_tables(
    run: Run, benchmark: BenchmarkChoice, *, count: int, device: str
) -> dict[str, Path]:
    """Method -> its file RUN/held/METHOD.parquet. A file that was made of the same rows by the same code is kept.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        count: processes.
        device: cpu, cuda or cuda:N, for the grasps.

    Raises:
        RunError: the run holds no rows or no poses.
    """
    judge, names = judge_of(run, benchmark, device)
    scene = judge.evaluator.scene
    simulator = Simulator(scene.robot, tuple(scene.objects), Setting(), 0)
    code, written = code_digest(CODE, VERSIONS), {}
    with processes(simulator, count) as simulated:
        for name in names:
            path = written[name] = run.folder / FOLDER / f"{run.entry(name).slug}.parquet"
            made_of = {"rows": run.digest(name), "code": code}
            if _made_of(path) == made_of:
                LOG.info(f"{name}: {path} has these rows")
                continue
            rows = _rows(run, name, judge, simulated)
            schema = SCHEMA.with_metadata({MADE_OF: json.dumps(made_of).encode()})
            path.parent.mkdir(exist_ok=True)
            with atomic_path(path) as new, pq.ParquetWriter(new, schema) as writer:
                for table in rows:
                    writer.write_table(table.replace_schema_metadata(schema.metadata))
    return written


def _made_of(path: Path) -> Any:
    """The rows and code that a file was made of; None: it is missing or no such file."""
    if not path.is_file():
        return None
    try:
        return json.loads(pq.read_schema(path).metadata[MADE_OF])
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError):
        return None


def _rows(run: Run, method: str, judge: Judge, simulated: Processes) -> Iterator[pa.Table]:
    stored = run.trials(method, ["trial_id", "object", "split"])
    words = {i: (o, s) for i, o, s in zip(*(c.to_pylist() for c in stored.columns), strict=True)}
    with progress(method, len(words)) as advance:
        for trial_id, scores, won in judged_again(run, method, judge):
            gripped = gripped_of(scores, trial_id)
            advance(len(trial_id) - len(gripped))
            for rows, found in simulated.hold([gripped]):
                advance(len(rows))
                ids = rows.trial_id.tolist()
                closing, slip, turn = (pa.array(x, _FLOAT, mask=np.isnan(x)) for x in found.T)
                yield pa.table(
                    {
                        "trial_id": rows.trial_id,
                        "object": [words[i][0] for i in ids],
                        "split": [words[i][1] for i in ids],
                        "success": [won[i] for i in ids],
                        "held": pc.less(slip, pa.scalar(DROPPED_M, _FLOAT)),
                        "slip_m": slip,
                        "turn_deg": turn,
                        "closing_m": closing,
                    },
                    schema=SCHEMA,
                )


def render(files: dict[str, Path]) -> str:
    """Rates of held objects of each method, and the objects that are lost, as text that ends in a newline."""
    short = short_names(list(files))
    rates, objects = [], []
    for name, path in files.items():
        table = pq.read_table(path)
        label, held = plain(short[name]), table["held"].to_numpy(zero_copy_only=False) == True  # noqa: E712 - null: failed
        slip, won = table["slip_m"].to_numpy(), table["success"].to_numpy()
        rates.append(
            [label, str(len(held)), rate_text(held), str(int(won.sum())), rate_text(held[won])]
        )
        of = np.array(table["object"].to_pylist(), dtype=object)
        for word in dict.fromkeys(of.tolist()):
            own = of == word
            if (lost := own & ~held).any():
                cm = f"{100 * float(np.nanmedian(slip[lost])):.1f}"
                objects.append(
                    [label, plain(word), str(int(own.sum())), percent_text(held[own]), cm]
                )
    parts = [
        "Held under their weight for 1 s",
        aligned(["Method", "n", "held 1 s", "successes", "of these held"], rates, 1),
    ]
    if objects:
        head = ["Method", "object", "n", "held 1 s", "slip of the lost, cm"]
        parts += ["Objects", aligned(head, objects, 2)]
    return "\n\n".join([*parts, notes_list(NOTES)]) + "\n"
