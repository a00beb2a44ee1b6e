"""Objects of a stored run that the arm can pick from the table with the stored grasps (`results picked`)."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from r2h_batch.base.io.cache import code_digest
from r2h_batch.base.io.log import LOG
from r2h_batch.judge.pick import ROWS, PickReason, picked
from r2h_batch.observe.moment import moments
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.text import aligned, notes_list, percent_text, plain, rate_text, short_names
from r2h_batch.runs.files import RunError
from r2h_batch.runs.side import about_side, side_path, side_writer
from r2h_batch.runs.store import Run
from r2h_batch.sweep.results.reception import judge_of
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.scoring import progress
from r2h_batch.types import CollidingPair

FOLDER = "picked"
"""Folder of a run that holds METHOD.parquet."""
MADE_OF = b"r2h_batch picked"
"""Key of the Parquet file's metadata: the digest of the rows, the code, and the seed of the moments."""
CODE = ("r2h_batch.judge", "r2h_batch.kernels", "r2h_batch.observe", "r2h_batch.scene")
VERSIONS = ("warp-lang", "torch", "numpy")
SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("success", pa.bool_(), nullable=False),
        pa.field("picked", pa.bool_(), nullable=False),
        pa.field("pick_m", pa.float32()),
        pa.field("pick_reason", pa.string(), nullable=False),
        pa.field("pick_pair", pa.string()),
        pa.field("pick_part", pa.string()),
    ]
)
"""A row for each stored row with a pose, as `judge.pick.Picked` has it. pick_m: null where no path was found. pick_pair: the two
bodies that it is about, null where no two bodies are; pick_part: the robot's."""
CAUSES = {
    "reach": (PickReason.OUT_OF_REACH,),
    "grasp": (PickReason.GRASP_COLLIDES,),
    "straight way": (PickReason.NO_STRAIGHT_WAY,),
    "way in": (PickReason.APPROACH_COLLIDES,),
    "pads": (PickReason.NOTHING_BETWEEN_PADS, PickReason.NOT_HELD),
    "closing": (PickReason.CLOSING_COLLIDES,),
    "lift": (PickReason.LIFT_COLLIDES,),
    "path": (
        PickReason.START_IN_COLLISION,
        PickReason.BEFORE_COLLIDES,
        PickReason.NO_PATH_IN_BUDGET,
        PickReason.NOT_EVALUATED,
        PickReason.PATH_COLLIDES,
    ),
}
"""Columns of the printed table, and the reasons that each counts."""
GOING_IN = (PickReason.GRASP_COLLIDES, PickReason.APPROACH_COLLIDES)
"""Reasons of which the table says what is met."""
NOTES = (
    "Percent of the rows. picked: the arm goes from home to 10 cm before the grasp, straight in with the open gripper,"
    " closes, and goes 10 cm straight up. The object rests on the table, the person waits (docs/pick.md). Brackets: 95 %,"
    " Wilson. No part of SR, but where the benchmark asks for Pick. Here the arm is planned in the true world, also where methods"
    " see.",
    "Then the share that fails in each stage, the first one counts: reach, the open gripper at the grasp, straight"
    " ways, the way in, what lies between the pads, the closing fingers, the lift, the path from home. Of the grasp and the way"
    " in: what the robot meets.",
)


def write_tables(
    run: Run, benchmark: BenchmarkChoice, *, device: str, seed: int = 0
) -> dict[str, Path]:
    """Method -> its file RUN/picked/METHOD.parquet. A file that was made of the same rows by the same code is kept.

    Args:
        run: with poses.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.
        seed: of the moments' draw.

    Raises:
        RunError: the run holds no rows or no poses, or its poses have errors.
    """
    judge, names = judge_of(run, benchmark, device)
    config = judge.evaluator.config
    for section in ("execution_error", "object_errors"):
        if getattr(config, section).any:
            raise RunError(
                f"{run.folder}: its {section} moves the grasps after the method has answered, and picking takes them as they"
                " are stored; sweep without it"
            )
    code, written = code_digest(CODE, VERSIONS), {}
    for name in names:
        path = written[name] = side_path(run.entry(name), FOLDER)
        made_of = {"rows": run.digest(name), "code": code, "seed": seed, "device": device[:3]}
        if about_side(path, MADE_OF) == made_of and run.keeps(name, path, SCHEMA):
            LOG.info(f"{name}: {path} has these rows")
            continue
        with side_writer(path, SCHEMA, {MADE_OF: made_of}) as writer:
            for table in _tables(run, name, judge, seed):
                writer.write(table)
    return written


def _tables(run: Run, method: str, judge: Judge, seed: int) -> Iterator[pa.Table]:
    scene = judge.evaluator.scene
    shards = sorted(run.entry(method).shards)
    with progress(method, len(run.trials(method, ["trial_id"]))) as advance:
        for index in shards:
            rows = run.shard("trials", method, index)
            words = {
                r["trial_id"]: r
                for r in rows.select(["trial_id", "object", "split", "outcome"]).to_pylist()
            }
            poses = run.shard("poses", method, index).sort_by("trial_id")
            for i in range(0, len(poses), ROWS):
                part = poses.slice(i, ROWS)
                ids = part["trial_id"].to_numpy()
                trials = judge.trials(ids)
                grasp = torch.tensor(
                    part["T_obj_ee"].to_pylist(), dtype=torch.float32, device=scene.device
                )
                grasp = grasp.reshape(-1, 4, 4)
                found = picked(scene, grasp, moments(scene, trials, seed=seed), trials)
                advance(len(part))
                own = [words[k] for k in ids.tolist()]
                margin = found.margin_m.cpu().numpy()
                pair = [CollidingPair(k).name.lower() for k in found.pair.tolist()]
                yield pa.table(
                    {
                        "trial_id": ids,
                        "object": [r["object"] for r in own],
                        "split": [r["split"] for r in own],
                        "success": [r["outcome"] == "success" for r in own],
                        "picked": found.picked.cpu().numpy(),
                        "pick_m": pa.array(margin, pa.float32(), mask=~np.isfinite(margin)),
                        "pick_reason": [PickReason(k).name.lower() for k in found.reason.tolist()],
                        "pick_pair": [None if p == "none" else p for p in pair],
                        "pick_part": [scene.part_names[k] if k >= 0 else None for k in found.body.tolist()],
                    },
                    schema=SCHEMA,
                )  # fmt: skip


def render(files: dict[str, Path]) -> str:
    """Rates of objects that can be picked, of each method, and what the others fail by, as text that ends in a newline."""
    short = short_names(list(files))
    rates, met = [], []
    for name, path in files.items():
        table = pq.read_table(path)
        label, won = plain(short[name]), table["success"].to_numpy()
        got = table["picked"].to_numpy()
        reason, pair = (
            np.array(table[k].to_pylist(), object) for k in ("pick_reason", "pick_pair")
        )
        shares = [
            percent_text(np.isin(reason, [r.name.lower() for r in of])) for of in CAUSES.values()
        ]
        both = [rate_text(got & won), str(int(won.sum())), rate_text(got[won])]
        rates.append([label, str(len(got)), rate_text(got), *shares, *both])
        way = np.isin(reason, [r.name.lower() for r in GOING_IN])
        met.append([label, *(percent_text(way & (pair == p)) for p in MET)])
    head = ["Method", "n", "picked", *CAUSES, "picked and success", "successes", "of these picked"]
    parts = [
        "Objects that the arm can pick from the table, percent",
        aligned(head, rates, 1),
        "What the robot meets at the grasp and on the way in",
        aligned(["Method", *MET.values()], met, 1),
        notes_list(NOTES),
    ]
    return "\n\n".join(parts) + "\n"


MET = {"table": "table", "hand": "person", "self": "itself", "object_robot": "object"}
"""Pairs of the grasp and the way in, and what is met."""
