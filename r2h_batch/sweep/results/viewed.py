"""How much of the part that the receiver wants the receiver's eyes see at the handover (`results viewed`)."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from r2h_batch.base import se3
from r2h_batch.base.io.cache import code_digest
from r2h_batch.base.io.log import LOG
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.grasp import attach
from r2h_batch.observe.eyes import view
from r2h_batch.observe.seen import LABELS
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.text import aligned, notes_list, plain, short_names
from r2h_batch.report.viewed import FOLDER, MADE_OF, mean_share
from r2h_batch.runs.side import about_side, side_path, side_writer
from r2h_batch.runs.store import Run
from r2h_batch.scene.robot import ee_pose
from r2h_batch.sweep.results.reception import judge_of_bodies, judged_again
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.scoring import progress
from r2h_batch.types import Scores
from r2h_batch.verdicts import CRITERIA

CODE = ("r2h_batch.judge", "r2h_batch.kernels", "r2h_batch.observe", "r2h_batch.scene")
VERSIONS = ("warp-lang", "torch", "numpy")
HIDERS = {
    "object": ("object",),
    "robot": ("robot",),
    "hand": ("hand",),
    "arm": ("forearm", "upper_arm"),
    "table": ("table",),
}
"""Column of what hides -> its `LABELS`."""
THERE = 0.005
"""A posture whose gripper differs from the pose by more than this (m, or a number of the rotation matrix) does not reach it."""
SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("viewed", pa.float32(), nullable=False),
        *(pa.field(f"hidden_by_{name}", pa.float32(), nullable=False) for name in HIDERS),
    ]
)
"""A row for each stored row with a region, a held object and a posture that reaches the pose. All six shares sum to 1."""
NOTES = (
    "Mean percent of the region's area, over the rows with a region, a held object and a posture that reaches the pose."
    " in view: what at least one eye sees. Brackets: 95 % (t). No part of SR. `report` shows it beside Presented from now on.",
    "Then what hides the rest: the object itself (its far side), the robot, the waiting hand, the arm, the table.",
)


def write_tables(run: Run, benchmark: BenchmarkChoice, *, device: str) -> dict[str, Path]:
    """Method -> its file RUN/viewed/METHOD.parquet. A file that was made of the same rows by the same code is kept.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.

    Raises:
        RunError: the run holds no rows, no poses, or trials without a receiver's body.
    """
    judge, names = judge_of_bodies(run, benchmark, device)
    code, written = code_digest(CODE, VERSIONS), {}
    for name in names:
        path = written[name] = side_path(run.entry(name), FOLDER)
        made_of = {"rows": run.digest(name), "code": code, "device": device[:3]}
        if about_side(path, MADE_OF) == made_of and run.keeps(name, path, SCHEMA):
            LOG.info(f"{name}: {path} has these rows")
            continue
        with side_writer(path, SCHEMA, {MADE_OF: made_of}) as writer:
            for table in _tables(run, name, judge):
                writer.write(table)
    return written


def _tables(run: Run, method: str, judge: Judge) -> Iterator[pa.Table]:
    stored = run.trials(method, ["trial_id", "object", "split"])
    words = {i: (o, s) for i, o, s in zip(*(c.to_pylist() for c in stored.columns), strict=True)}
    with progress(method, len(words)) as advance:
        for trial_id, scores, won in judged_again(run, method, judge):
            kept, columns = viewed_rows(scores)
            advance(len(trial_id))
            ids = trial_id[kept].tolist()
            yield pa.table(
                {
                    "trial_id": ids,
                    "object": [words[i][0] for i in ids],
                    "split": [words[i][1] for i in ids],
                    "success": [won[i] for i in ids],
                    **columns,
                },
                schema=SCHEMA,
            )


def viewed_rows(scores: Scores) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Which rows have a region, a held object and a posture that reaches the pose, and the shares of these.

    Args:
        scores: B rows with their inputs, judged up to the goal posture.
    """
    inputs = scores.inputs
    assert inputs is not None
    evaluator, trials = inputs.evaluator, inputs.trials
    scene = evaluator.scene
    grasp, pose = executed_poses(
        evaluator.config, scene.objects, inputs.T_obj_ee, inputs.T_world_ee, trials
    )
    # out of reach the goal posture is the nearest one
    there = torch.from_numpy(ee_pose(scene.robot, scores.q_goal.cpu().double().numpy()))
    off = (there.to(pose.device) - pose).abs().amax((1, 2))
    held = scores.passed[:, CRITERIA.index("stability")] & (off < THERE)
    rows = torch.nonzero(held & scores.presented_angle_deg.isfinite())[:, 0]
    attached = attach(se3.orthonormalise(grasp[rows]), scores.grasp_shift_m[rows])
    T_world_obj = se3.matmul(se3.orthonormalise(pose[rows]), se3.inverse(attached))
    found = view(scene, trials[rows], T_world_obj, scores.q_goal[rows], scores.opening_m[rows])
    hidden = {
        f"hidden_by_{name}": sum(found.hidden_by[:, LABELS.index(k)] for k in labels)
        for name, labels in HIDERS.items()
    }
    columns = {"viewed": found.seen, **hidden}
    return rows.cpu().numpy(), {k: x.cpu().numpy() for k, x in columns.items()}  # type: ignore[union-attr]


def render(files: dict[str, Path]) -> str:
    """How much each method shows, and what hides the rest, as text that ends in a newline."""
    short, lines = short_names(list(files)), []
    for name, path in files.items():
        table = pq.read_table(path)
        cells = ["", ""] + [""] * len(HIDERS)
        if len(table):
            found = mean_share(table["viewed"].to_numpy())
            hidden = (table[f"hidden_by_{k}"].to_numpy() for k in HIDERS)
            cells = [
                f"{found.percent:.1f}",
                f"{found.low:.1f}-{found.high:.1f}",
                *(f"{100 * float(x.mean(dtype=np.float64)):.1f}" for x in hidden),
            ]
        lines.append([plain(short[name]), str(len(table)), *cells])
    head = ["Method", "n", "in view", "95 %", *(f"hidden by {k}" for k in HIDERS)]
    title = "The receiver's view on the region at the handover"
    return "\n\n".join([title, aligned(head, lines, 1), notes_list(NOTES)]) + "\n"
