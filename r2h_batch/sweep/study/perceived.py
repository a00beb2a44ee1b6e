"""People's ratings beside the measures of a run: the paper's ratings of four methods (`report
--perceived`), and your own ratings of single trials (`study trials`, `study rated`).

Measures stand side by side. None is a score of perceived quality, and none is fitted to ratings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from scipy import stats

from r2h_batch.base import se3
from r2h_batch.base.errors import FileError
from r2h_batch.judge.distance import hand_distance_at
from r2h_batch.judge.grasp import attach
from r2h_batch.judge.motion.time_law import time_at, time_path
from r2h_batch.report.text import aligned, csv_text, notes_list, plain, short_names
from r2h_batch.runs.store import Run
from r2h_batch.scene.hand import palm_frame
from r2h_batch.sweep.results.reception import table_of as reception_table
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.study.report import DRAWS, RATING_COLUMNS, SCALE, read_counts
from r2h_batch.sweep.study.table_file import LINE, NAME, number, read_table
from r2h_batch.types import Trials

PAPER = Path(__file__).parent / "paper" / "ratings.csv"
POSES = {"T_obj_ee": 16, "T_world_ee": 16, "T_world_hand": 16, "receiver": 20}
"""Columns of arrays in `study trials`, row by row: NAME_0 and so on, as in files of predictions."""
HEAD_UP_M, HEAD_AHEAD_M = 0.17, 0.08
"""The head's middle above the shoulders and in front of them [choice]. It is no body that collides."""
AT_PALM_DEG = 45.0
NEAR_M = 0.25
"""Largest distance at which the closing speed counts [choice]."""
PARTS = 64
"""Intervals of a straight segment of the motion; each gives a closing speed."""
LEAST_RATED = 3
"""Trials of one participant for a rank correlation."""


@dataclass(frozen=True)
class Measure:
    """A quantity of a trial.

    Attributes:
        heading: of its row.
        better: 1 where more is expected to please, -1 where less is; set before any result was seen.
        scale: from the stored unit to the printed one.
        digits: behind the point.
    """

    heading: str
    better: int
    scale: float = 1.0
    digits: int = 1


MEASURES = {
    "f_afford": Measure("F_afford, S1, %", -1, 100),
    "sr": Measure("SR, %", 1, 100),
    "f_safe": Measure("F_safe, %", -1, 100),
    "presented": Measure("Presented, S1, %", 1, 100),
    "received": Measure("received, of held with a goal, %", 1, 100),
    "turn_deg": Measure("turn of the hand, deg", -1),
    "rula": Measure("RULA at least effort", -1, digits=2),
    "body_met": Measure("motion meets arm or torso, %", -1, 100),
    "gap_m": Measure("least gap robot to hand, cm", 1, 100),
    "closing_m_s": Measure(f"closing speed within {100 * NEAR_M:.0f} cm, cm/s", -1, 100),
    "finger_palm": Measure(f"fingers within {AT_PALM_DEG:.0f} deg of the palm, %", -1, 100),
    "head_m": Measure("object to head, m", 1, digits=2),
    "t_exec_s": Measure("duration of the motion, s", -1),
}
"""Printed measures, in this order: F_afford first, the one that the paper itself names."""

NOTES = (
    "tau: Kendall's, between the order of the methods by a measure and by the mean rating (Fig. 7 of the paper); its sign is"
    " turned so that +1 says that the measure agrees with people as expected. ties: all methods have the same value.",
    "Four methods decide nothing: a given order comes by chance in 1 of 24 cases, and {count} measures times {dimensions}"
    " dimensions are looked at. Only F_afford was named by the paper beforehand. The methods here are stand-ins for theirs.",
    "No score is made of these measures, and none was tuned to the ratings. docs/statistics.md says what could decide.",
)


def measured_trials(run: Run, method: str, judge: Judge) -> pa.Table:
    """Each stored trial of a method with its poses, its receiver and `MEASURES`; null: not defined.

    Args:
        run: with poses; trials with a receiver's body (as of r2h-v2).
        method: name in the run.
        judge: the evaluator of the run.

    Raises:
        RunError: the run holds no poses.
        ValueError: its trials have no receiver's body.
    """
    reception = reception_table(run, method, judge).sort_by("trial_id")
    ids = reception["trial_id"].to_numpy()
    trials = judge.trials(ids)
    poses = _in_order(run.poses(method), ids)
    rows = _in_order(run.trials(method), ids)
    column = {n: rows[n].to_numpy(zero_copy_only=False) for n in rows.column_names}
    s1, outcome = column["split"] == "S1", column["outcome"]
    own = reception.to_pydict()
    distance = (column["margin_kind_safe"] == "distance") & (column["passed_safe"] != None)  # noqa: E711
    measures = {
        "f_afford": np.where(s1, outcome == "affordance", np.nan),
        "sr": (outcome == "success").astype(float),
        "f_safe": (outcome == "safe").astype(float),
        "presented": _floats(column["presented"]),
        "received": np.where(own["evaluated"], own["received"], np.nan),
        "turn_deg": _floats(own["turn_deg"]),
        "rula": _floats(own["rula"]),
        "body_met": np.where(np.isnan(body := _floats(column["body_m"])), np.nan, body <= 0),
        "gap_m": np.where(distance, _floats(column["margin_safe_m"]), np.nan),
        "closing_m_s": _closing_speed(trials, poses, judge),
        **_seen_by_the_person(trials, poses, judge),
        "t_exec_s": _floats(column["t_exec_s"]),
    }
    arrays = {
        **{k: np.array(poses[k].to_pylist(), np.float64).reshape(-1, 16) for k in list(POSES)[:2]},
        "T_world_hand": trials.T_world_hand.cpu().numpy().reshape(-1, 16),
        "receiver": _receiver(trials).cpu().numpy().reshape(-1, 20),
    }
    names = ("trial_id", "object", "split", "side", "outcome")
    found: dict[str, Any] = {name: column[name] for name in names}
    found |= {k: pa.array(np.asarray(v, float), from_pandas=True) for k, v in measures.items()}
    found |= {f"{name}_{i}": v for name, x in arrays.items() for i, v in enumerate(x.T)}
    return pa.table({"trial_id": found.pop("trial_id"), "method": [method] * len(ids), **found})


def _in_order(table: pa.Table, ids: NDArray[np.int64]) -> pa.Table:
    """The rows with these ids, ascending."""
    table = table.sort_by("trial_id")
    return table.filter(pa.array(np.isin(table["trial_id"].to_numpy(), ids)))


def _floats(values: Any) -> NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], np.float64)


def _receiver(trials: Trials) -> torch.Tensor:
    assert trials.receiver is not None  # reception has asked
    return trials.receiver


def _seen_by_the_person(trials: Trials, poses: pa.Table, judge: Judge) -> dict[str, NDArray[Any]]:
    """Whether the fingers point at the palm, and the way from the object to the head, of (N,) trials."""
    scene = judge.evaluator.scene
    grasp, ee = (
        torch.from_numpy(np.array(poses[k].to_pylist(), np.float64).reshape(-1, 4, 4))
        for k in ("T_obj_ee", "T_world_ee")
    )
    hands, rows = scene.hands.set, trials.hand_index.long().cpu()
    _, normal = palm_frame(hands.geometry.joints[rows].double(), hands.side[rows])
    palm = se3.rotate(trials.T_world_hand.cpu().double()[:, :3, :3], normal)
    at_palm = -se3.dot(ee[:, :3, 2], palm) >= np.cos(np.radians(AT_PALM_DEG))
    boxes = [o.hull_vertices for o in scene.objects]
    centre = torch.from_numpy(np.stack([0.5 * (v.min(0) + v.max(0)) for v in boxes])).double()
    T_world_obj = se3.matmul(ee, se3.inverse(grasp))
    middle = se3.apply(T_world_obj, centre[trials.object_index.long().cpu()])
    body = _receiver(trials).cpu().double()
    shoulder, torso, facing = body[:, 0, :3], body[:, 3, :3], body[:, 3:5, 3]
    head = torso.clone()
    ahead = HEAD_AHEAD_M + ((shoulder - torso)[:, :2] * facing).sum(1, keepdim=True)
    head[:, :2] += ahead * facing
    head[:, 2] = shoulder[:, 2] + HEAD_UP_M
    gap = middle - head
    head_m = se3.dot(gap, gap).sqrt().numpy()
    return {"finger_palm": at_palm.numpy().astype(float), "head_m": head_m}


def _closing_speed(trials: Trials, poses: pa.Table, judge: Judge) -> NDArray[np.float64]:
    """The largest speed (m/s) at which the planned motion brings robot and hand nearer while they are within `NEAR_M`;
    NaN where there is no motion or none so near."""
    evaluator = judge.evaluator.kinematic
    scene, execute = evaluator.scene, evaluator.config.execute
    stored = (poses[k].to_pylist() for k in ("T_obj_ee", "T_world_ee"))
    grasp, ee = (
        torch.tensor(T, dtype=torch.float32, device=scene.device).reshape(-1, 4, 4) for T in stored
    )
    scores = evaluator.score(grasp, ee, trials)
    length, weight = scores.path_len, scene.robot.joint_weight
    motion = time_path(scores.path, length, execute, weight)
    fastest = torch.full_like(motion.t_exec_s, -torch.inf)
    nearer, earlier = torch.full_like(fastest, torch.inf), torch.zeros_like(fastest)
    with evaluator.working():
        attached = attach(grasp, scores.grasp_shift_m.nan_to_num()).contiguous()
        bodies = scene.body_poses(
            trials.object_index, trials.hand_index, attached, trials.T_world_hand, scores.opening_m.nan_to_num()
        )  # fmt: skip
        for k in range(int(length.max()) - 1 if len(length) else 0):
            moves, segment = length > k + 1, torch.full_like(length, k)
            for part in range(PARTS + 1):
                s = torch.full_like(fastest, part / PARTS)
                q = scores.path[:, k] + s[:, None] * (scores.path[:, k + 1] - scores.path[:, k])
                near = hand_distance_at(scene, bodies, q.contiguous(), moves, cap_m=NEAR_M)
                at, gap = time_at(scores.path, length, motion, segment, s, execute), near.distance_m
                speed = (nearer - gap) / (at - earlier)
                known = moves & (at > earlier) & (nearer < NEAR_M)
                fastest = torch.where(known, torch.maximum(fastest, speed), fastest)
                nearer = torch.where(moves, gap, nearer)
                earlier = torch.where(moves, at, earlier)
    return torch.where(fastest.isfinite(), fastest, torch.nan).cpu().double().numpy()


def paper_means() -> dict[str, dict[str, float]]:
    """Dimension -> method -> mean rating of the paper's 30 participants (Fig. 7)."""
    found: dict[str, dict[str, float]] = {}
    for (method, dimension), counts in read_counts(PAPER).items():
        found.setdefault(dimension, {})[method] = float(counts @ SCALE / counts.sum())
    return found


def of_the_paper(run: Run) -> Run:
    """The run with the methods that the paper's people rated; what a name says in brackets is not read.

    Raises:
        FileError: fewer than three of them are complete.
    """
    theirs = next(iter(paper_means().values()))
    names = [name for name in run.methods if name.partition(" (")[0] in theirs]
    if len(names) < 3:
        raise FileError(
            f"{len(names)} of the methods that people rated are in the run ({', '.join(names) or 'none'}); an order"
            f" needs three of {', '.join(theirs)}"
        )
    return run.only(names)


def perceived(tables: Mapping[str, pa.Table]) -> str:
    """The table of measures beside the paper's ratings, as text that ends in a newline.

    Args:
        tables: method of the paper -> its `measured_trials`.
    """
    ratings = paper_means()
    tables = {name.partition(" (")[0]: table for name, table in tables.items()}
    names = [name for name in next(iter(ratings.values())) if name in tables]
    lines = [
        [f"people: {dimension}", *(f"{of[name]:.2f}" for name in names), *[""] * len(ratings)]
        for dimension, of in ratings.items()
    ]
    for key, measure in MEASURES.items():
        columns = [tables[name][key].to_numpy() for name in names]
        values = [float(np.nanmean(x)) if np.isfinite(x).any() else np.nan for x in columns]
        means = [[of[name] for name in names] for of in ratings.values()]
        taus = [_tau(values, mean, measure.better) for mean in means]
        digits = f".{measure.digits}f"
        shown = [f"{measure.scale * v:{digits}}" if np.isfinite(v) else "-" for v in values]
        lines.append([measure.heading, *shown, *taus])
    short = short_names(names)
    head = ["Measure", *(plain(short[n]) for n in names), *(f"tau {d}" for d in ratings)]
    counted = {"count": len(MEASURES), "dimensions": len(ratings)}
    notes = notes_list([note.format(**counted) for note in NOTES])
    return f"{aligned(head, lines, 1)}\n\n{notes}\n"


def _tau(measure: Sequence[float], ratings: Sequence[float], better: int) -> str:
    if not np.isfinite(measure).all():
        return "-"
    if np.ptp(measure) == 0:
        return "ties"
    tau = better * float(stats.kendalltau(measure, ratings).statistic)
    return f"{round(tau, 2) + 0.0:+.2f}"  # no -0.00


def trials_csv(tables: Mapping[str, pa.Table]) -> str:
    """The trials of all methods as CSV: trial_id, method, poses, receiver, `MEASURES`; n/a: not defined."""
    return csv_text([row for table in tables.values() for row in table.to_pylist()])


def rated(ratings: Path, trials: Path) -> tuple[str, str]:
    """Ratings of single trials beside what was measured of them.

    Args:
        ratings: CSV with the columns participant, method, trial_id, dimension, rating (1 to 5).
        trials: CSV that `study trials` wrote.

    Returns:
        A table of rank correlations within participants, and the ratings joined with the measures, a line
        for each rating, as CSV for a mixed model.

    Raises:
        FileError: a file that cannot be used, or a rating of a trial that is not in the other file.
    """
    trial_id = number(0, 2**62, whole=True)
    columns = {"trial_id": trial_id, **RATING_COLUMNS}
    names = {"trial_id": trial_id, "method": NAME, "object": NAME}
    # n/a is text: a measure that a trial does not have
    measured = {
        (r["method"], r["trial_id"]): r
        for r in read_table(trials, names | dict.fromkeys(MEASURES, NAME))
    }
    rows, seen = [], set()
    for r in read_table(ratings, columns):
        key = (r["method"], r["trial_id"])
        where, what = f"{ratings}: line {r[LINE]}", f"trial {r['trial_id']} of {r['method']}"
        if key not in measured:
            raise FileError(f"{where}: {trials.name} has no {what}")
        if (once := (r["participant"], r["dimension"], *key)) in seen:
            words = f"{r['participant']} rates {what} twice for {r['dimension']}"
            raise FileError(f"{where}: participant {words}")
        seen.add(once)
        known = measured[key]
        joined = {k: r[k] for k in columns} | {k: known[k] for k in ("object", *MEASURES)}
        rows.append(joined)
    return _correlations(rows), csv_text(rows)


def _correlations(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean over participants of Spearman's correlation over the trials that each rated, with a 95 % interval
    over participants (bootstrap)."""
    by: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for r in rows:
        by.setdefault(r["dimension"], {}).setdefault(r["participant"], []).append(r)
    lines = []
    for key, measure in MEASURES.items():
        cells = []
        for people in by.values():
            rhos = [rho for own in people.values() if (rho := _rho(own, key)) is not None]
            cells.append(_interval(measure.better * np.array(rhos)) if len(rhos) > 1 else "-")
        lines.append([measure.heading, *cells])
    notes = (
        "Mean over participants of Spearman's correlation over the trials that each of them rated, signed so that + says"
        f" 'as expected'; brackets: 95 %, bootstrap over participants. -: fewer than two participants rated {LEAST_RATED} trials"
        " that differ.",
        f"{len(MEASURES)} measures times {len(by)} dimensions are looked at; nothing is adjusted for that. Objects repeat"
        " within participants: fit a mixed model (participant and object as random effects) to the joined file before you"
        " conclude.",
    )
    return aligned(["Measure", *by], lines, 1) + "\n\n" + notes_list(notes) + "\n"


def _rho(rows: Sequence[Mapping[str, Any]], key: str) -> float | None:
    pairs = [(float(r[key]), r["rating"]) for r in rows if r[key] != "n/a"]
    if len(pairs) < LEAST_RATED:
        return None
    x, y = np.array(pairs, float).T
    return float(stats.spearmanr(x, y).statistic) if np.ptp(x) and np.ptp(y) else None


def _interval(rhos: NDArray[np.float64]) -> str:
    draws = np.random.default_rng(0).choice(rhos, (DRAWS, len(rhos))).mean(1)
    low, high = np.quantile(draws, [0.025, 0.975])
    return f"{rhos.mean():+.2f} [{low:+.2f}, {high:+.2f}]"
