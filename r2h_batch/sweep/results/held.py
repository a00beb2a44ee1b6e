"""Objects of a stored run that the closed gripper holds: after closing, and under their weight (`results held`)."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.base.io.cache import code_digest
from r2h_batch.base.io.log import LOG
from r2h_batch.closed_loop.transfer.cases import Processes, Simulator, processes
from r2h_batch.closed_loop.transfer.handed import gripped_of
from r2h_batch.closed_loop.transfer.held import NEAR_M, Lost
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.judge.grasp_physics import DROPPED_M, TORSION_M
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.held import FOLDER, MADE_OF
from r2h_batch.report.text import aligned, notes_list, percent_text, plain, rate_text, short_names
from r2h_batch.runs.side import about_side, side_path, side_writer
from r2h_batch.runs.store import Run
from r2h_batch.sweep.results.reception import judge_of, judged_again
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.scoring import progress

_FLOAT = pa.float32()
_NUMBERS = ("closing_m", "squeezed_m", "slip_m", "turn_deg", "carries")
SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("held", pa.bool_()),
        pa.field("lost", pa.string()),
        pa.field("undecided", pa.bool_(), nullable=False),
        pa.field("settled", pa.bool_()),
        *(pa.field(k, _FLOAT) for k in _NUMBERS),
    ]
)
"""A row for each stored row whose grasp passes Stability, as `closed_loop.transfer.held.Holds` has it. held: physically
stable; null: the simulation failed. lost: `closing`, `weight`, or null. Numbers are null where nothing came to them."""
CODE = ("r2h_batch.closed_loop.transfer", "r2h_batch.judge.grasp_physics")
VERSIONS = ("mujoco", "numpy", "scipy")
NOTES = (
    "Physically stable: the gripper closes with 30 N (pad friction 0.8), both pads touch the object, it slips by less than"
    f" {100 * DROPPED_M:g} cm until it stands, and by less than {100 * DROPPED_M:g} cm more while its weight acts for 1 s at the"
    " handover pose. Lost in closing, or under the weight: which of these fails first.",
    "n counts the rows that pass Stability. Brackets: 95 %, Wilson. No part of SR. undecided: within"
    f" {1e3 * NEAR_M:g} mm of a limit, or half the time step says otherwise. statics: friction balances the weight on the settled"
    " posture (a linear program; no solver's friction). `report` and `compare` show the rate from now on.",
)


def write_tables(
    run: Run,
    benchmark: BenchmarkChoice,
    *,
    count: int,
    device: str,
    torsion_mm: float = 1e3 * TORSION_M,
) -> dict[str, Path]:
    """Method -> its file RUN/held/METHOD.parquet. A file that was made of the same rows by the same code is kept.

    Another torsion than the usual one has files of its own, which no table shows.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        count: processes.
        device: cpu, cuda or cuda:N, for the grasps.
        torsion_mm: radius of the pads' patches that withstand turning.

    Raises:
        RunError: the run holds no rows or no poses.
    """
    judge, names = judge_of(run, benchmark, device)
    scene = judge.evaluator.scene
    setting = Setting(torsion_m=torsion_mm / 1e3)
    simulator = Simulator(scene.robot, tuple(scene.objects), setting, 0)
    code, written = code_digest(CODE, VERSIONS), {}
    own = "" if setting == Setting() else f".torsion-{torsion_mm:g}mm"
    with processes(simulator, count) as simulated:
        for name in names:
            path = written[name] = side_path(run.entry(name), FOLDER, own)
            made_of = {"rows": run.digest(name), "code": code}
            if about_side(path, MADE_OF) == made_of and run.keeps(name, path, SCHEMA):
                LOG.info(f"{name}: {path} has these rows")
                continue
            rows = _rows(run, name, judge, simulated)
            with side_writer(path, SCHEMA, {MADE_OF: made_of}) as writer:
                for table in rows:
                    writer.write(table)
    return written


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
                held = pa.array(found.held, mask=found.failed)
                yield pa.table(
                    {
                        "trial_id": rows.trial_id,
                        "object": [words[i][0] for i in ids],
                        "split": [words[i][1] for i in ids],
                        "success": [won[i] for i in ids],
                        "held": held,
                        "lost": pa.array(found.lost, pa.string()),
                        "undecided": found.undecided,
                        "settled": pa.array(found.settled, mask=found.failed),
                        **{k: _floats(getattr(found, k)) for k in _NUMBERS},
                    },
                    schema=SCHEMA,
                )


def _floats(values: NDArray[np.float64]) -> pa.Array:
    return pa.array(values, _FLOAT, mask=np.isnan(values))


def render(files: dict[str, Path]) -> str:
    """Rates of physically stable grasps of each method, and the objects that are lost, as text that ends in a newline."""
    short = short_names(list(files))
    rates, objects = [], []
    for name, path in files.items():
        table = pq.read_table(path)
        label, won = plain(short[name]), table["success"].to_numpy()
        held = table["held"].to_numpy(zero_copy_only=False) == True  # noqa: E712 - null: failed
        lost = np.array(table["lost"].to_pylist(), dtype=object)
        undecided, carries = table["undecided"].to_numpy(), table["carries"].to_numpy()
        ends = [percent_text(lost == word) for word in Lost]
        doubt, statics = percent_text(undecided), percent_text(carries >= 1.0)
        successes = [str(int(won.sum())), rate_text(held[won])]
        rates.append([label, str(len(held)), rate_text(held), *ends, doubt, statics, *successes])
        of = np.array(table["object"].to_pylist(), dtype=object)
        for word in dict.fromkeys(of.tolist()):
            own = of == word
            if not held[own].all():
                counts = [str(int((lost[own] == end).sum())) for end in Lost]
                objects.append(
                    [label, plain(word), str(int(own.sum())), percent_text(held[own]), *counts]
                )
    ends = ["lost in closing", "under the weight"]
    head = ["Method", "n", "physically stable", *ends, "undecided", "statics", "successes"]
    parts = [
        "Grasps that hold in physics, percent of those past Stability",
        aligned([*head, "of these stable"], rates, 1),
    ]
    if objects:
        parts += ["Objects", aligned(["Method", "object", "n", "stable", *ends], objects, 2)]
    return "\n\n".join([*parts, notes_list(NOTES)]) + "\n"
