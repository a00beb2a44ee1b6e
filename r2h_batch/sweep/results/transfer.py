"""The transfer of a stored run: what happens after the arm stands still (`results transfer`)."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from r2h_batch.base.io.cache import code_digest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.registry import ENGINES
from r2h_batch.closed_loop.transfer.cases import (
    Case,
    Processes,
    Simulates,
    Simulator,
    Transferred,
    processes,
)
from r2h_batch.closed_loop.transfer.handed import Handed, handed_of
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.closed_loop.transfer.outcome import FACTOR, Outcome
from r2h_batch.closed_loop.transfer.own_release import release_of
from r2h_batch.closed_loop.transfer.person import SCENARIOS
from r2h_batch.closed_loop.transfer.simulate import NEAR_N, SLIDES_M
from r2h_batch.judge.reception import reception
from r2h_batch.protocols.choice import BenchmarkChoice
from r2h_batch.report.statistics.aggregate import clustered_rate
from r2h_batch.report.text import aligned, notes_list, percent_text, plain, rate_text, short_names
from r2h_batch.report.transfers import FOLDER, MADE_OF
from r2h_batch.runs.side import about_side, side_path, side_writer
from r2h_batch.runs.store import Run
from r2h_batch.scene.scene import Scene
from r2h_batch.sweep.results.reception import judge_of_bodies, judged_again
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.scoring import progress

_FLOAT, _YES = pa.float32(), pa.bool_()
_PERSON = ("grip", "arm_n_m", "pull_n", "pause_s", "age")
SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("release", pa.string(), nullable=False),
        pa.field("scenario", pa.string(), nullable=False),
        pa.field("person", pa.int16(), nullable=False),
        pa.field("success", _YES, nullable=False),
        pa.field("received", _YES, nullable=False),
        pa.field("outcome", pa.string(), nullable=False),
        pa.field("false_release", _YES, nullable=False),
        pa.field("undecided", _YES),
        pa.field("surplus_n", _FLOAT),
        pa.field("decided_s", _FLOAT),
        *(pa.field(k, _FLOAT) for k in ("release_share", "transfer_s", "t10_s", "t50_s", "t90_s")),
        *(pa.field(k, _FLOAT) for k in ("pull_n", "grip_n", "hand_n", "slip_m", "turn_deg")),
        *(pa.field(k, _FLOAT) for k in ("robot_slip_m", "untouched_slip_m", "closing_m", "time_s")),
        *(pa.field(f"person_{k}", _FLOAT) for k in _PERSON),
    ]
)
"""A row for each stored row that has a pose and each case; numbers as in `closed_loop.transfer.simulate.Transfers`,
null where nothing is received or it did not happen. person_...: what the person was drawn with."""

CODE = (
    "r2h_batch.closed_loop.transfer",
    "r2h_batch.judge.closed_pose",
    "r2h_batch.judge.grasp_physics",
    "r2h_batch.judge.reception",
    "r2h_batch.trials.holding.capacity",
    "r2h_batch.trials.holding.contact_forces",
)
VERSIONS = ("mujoco", "numpy", "scipy", "torch")
"""Packages whose versions may change a transfer, beside the engine's."""

NOTES = (
    "n counts received rows; nobody takes the others. taken: in the person's hand, slipped by less than 2 cm and turned by"
    " less than 30 degrees. Outcomes are percent of n. Brackets: 95 % over trials, each with persons of its own (Wilson; where"
    " a trial has several persons, a t interval over trials).",
    f"undecided: a slip or turn that decides is between 1/{FACTOR:g} and {FACTOR:g} times of its limit, the policy decided by"
    f" less than {NEAR_N:g} N, the object hung on the opening fingers, or it slid by more than {1e3 * SLIDES_M:g} mm under a"
    " finger and half the time step ends otherwise.",
    "Persons: percent taken by the weaker and the firmer half of the grips, and by the stiffer half of the arms. touch: a finger"
    " presses and does not grip; nobody: nobody comes. There kept is right.",
    "Medians: share of the weight that the person carries when the policy lets go; seconds from the beginning of the grip"
    " until the gripper is free; the pull beyond the weight; slip and turn in the hand. Times are inputs, not validated.",
    "No part of SR, but where the benchmark asks for Taken. No success rate of real people, no statement about pain or"
    " safety (docs/transfer.md).",
)


def write_tables(
    run: Run,
    benchmark: BenchmarkChoice,
    *,
    release: Sequence[str],
    scenario: Sequence[str],
    persons: int,
    seed: int,
    count: int,
    sim: str,
    device: str,
) -> dict[str, Path]:
    """Method -> its file RUN/transfer/METHOD.parquet, each with every case asked for.

    A file that was made of the same rows by the same code keeps its cases, and only missing ones are simulated.

    Args:
        run: with poses, of trials with receivers' bodies.
        benchmark: where its files are now, if they are not where the sweep found them.
        release: policies, as `release_of` takes them.
        scenario: names of `person.SCENARIOS`.
        persons: drawn for each trial.
        seed: of the sensor's noise.
        count: processes, of engine mujoco.
        sim: engine, mujoco or mjwarp.
        device: cpu, cuda or cuda:N, for the reception and mjwarp.

    Raises:
        RunError: the run lacks something.
    """
    judge, names = judge_of_bodies(run, benchmark, device)
    policies = {spec: release_of(spec)[1] for spec in release}
    cases = [Case(*c) for c in product(release, scenario, range(persons))]
    scene = judge.evaluator.scene
    simulator = _simulator(sim, scene, seed, device)
    (packages,) = (engine.packages for engine in ENGINES if engine.name == sim)
    code = code_digest(CODE, (*VERSIONS, *packages))
    written = {}
    with processes(simulator, count) as transfer:
        for name in names:
            entry = run.entry(name)
            path = side_path(entry, FOLDER)
            made_of = {"rows": run.digest(name), "code": code, "seed": seed, "sim": sim}
            stored = Stored.read(run, name, path, made_of)
            todo = [c for c in cases if stored.policies.get(c) != policies[c.release]]
            written[name] = path
            if not todo:
                LOG.info(f"{name}: {path} has these transfers")
                continue
            if not any("details" in s.kinds for s in entry.shards.values()):
                LOG.info(
                    f"{name}: no details, so goal postures are the pose stage's (sweep --save-paths keeps the planned ones)"
                )
            after = stored.policies | {c: policies[c.release] for c in todo}
            rows = _rows(run, name, judge, transfer, todo)
            total = len(run.trials(name, ["trial_id"]))
            _write(path, made_of, after, stored, todo, _with_progress(rows, name, total))
    return written


def _simulator(sim: str, scene: Scene, seed: int, device: str) -> Simulates:
    given = scene.robot, tuple(scene.objects), Setting(), seed
    if sim == "mujoco":
        return Simulator(*given)
    from r2h_batch.closed_loop.transfer.batched import BatchedSimulator  # MuJoCo-Warp: seconds

    return BatchedSimulator(*given, device)


class Stored:
    """A file of transfers as it is."""

    def __init__(self, path: Path, policies: dict[Case, str]) -> None:
        self.path, self.policies = path, policies

    @staticmethod
    def read(run: Run, method: str, path: Path, made_of: dict[str, Any]) -> "Stored":
        """The cases of a file, none if it is missing, was made of other rows or by other code, or is not as it was
        written."""
        about = about_side(path, MADE_OF)
        same = about and {k: about.get(k) for k in made_of} == made_of
        if not same or not run.keeps(method, path, SCHEMA):
            return Stored(path, {})
        try:
            cases = {Case(*c): str(text) for *c, text in about["cases"]}
        except (KeyError, TypeError, ValueError):
            return Stored(path, {})
        return Stored(path, cases)

    def rows(self, but: Sequence[Case]) -> Iterator[pa.Table]:
        """Its rows, a group at a time, without some cases."""
        if not self.policies:
            return
        file = pq.ParquetFile(self.path)
        out = {tuple(c) for c in but}
        for k in range(file.num_row_groups):
            table = file.read_row_group(k).replace_schema_metadata(None)
            keys = zip(*(table[c].to_pylist() for c in Case._fields), strict=True)
            yield table.filter(pa.array([key not in out for key in keys], pa.bool_()))


def _write(
    path: Path,
    made_of: dict[str, Any],
    policies: dict[Case, str],
    stored: Stored,
    todo: Sequence[Case],
    rows: Iterator[pa.Table],
) -> None:
    """Writes a file in one step: what is stored, and the new rows as they come."""
    about = made_of | {"cases": [[*case, text] for case, text in policies.items()]}
    with side_writer(path, SCHEMA, {MADE_OF: about}) as writer:
        for table in stored.rows(todo):
            writer.write(table)
        for table in rows:
            writer.write(table)


def _with_progress(
    parts: Iterator[tuple[int, pa.Table]], name: str, total: int
) -> Iterator[pa.Table]:
    with progress(name, total) as advance:
        for handovers, table in parts:
            advance(handovers)
            yield table


def _rows(
    run: Run, method: str, judge: Judge, transfer: Processes, cases: Sequence[Case]
) -> Iterator[tuple[int, pa.Table]]:
    """Tables of a method's transfers with the number of handovers in each: first those that nobody receives of a
    part of the run, then those that are received."""
    objects = judge.evaluator.scene
    for trial_id, scores, won in judged_again(run, method, judge):
        found = reception(scores)
        inputs = scores.inputs
        assert inputs is not None
        got = found.received.cpu().numpy()
        yield int((~got).sum()), not_received(trial_id[~got], won, cases)
        handed = handed_of(found, trial_id, inputs.trials, objects)
        for rows, made in transfer([handed], cases):
            yield len(rows), table_of(rows, made, won)


def not_received(trial_id: np.ndarray, success: dict[int, bool], cases: Sequence[Case]) -> pa.Table:
    """Rows of handovers that nobody takes."""
    n = len(trial_id)
    tables = []
    for case in cases:
        columns: dict[str, Any] = {
            **_columns_of(case, trial_id, success),
            "received": np.zeros(n, bool),
            "outcome": [str(Outcome.NOT_RECEIVED)] * n,
            "false_release": np.zeros(n, bool),
        }
        tables.append(_table(columns, n))
    return pa.concat_tables(tables)


def table_of(handed: Handed, made: Sequence[Transferred], success: dict[int, bool]) -> pa.Table:
    """Rows of simulated transfers, case by case."""
    tables = []
    for one in made:
        t, n = one.transfers, len(handed)
        numbers = (
            *(
                "surplus_n",
                "decided_s",
                "release_share",
                "transfer_s",
                "pull_n",
                "grip_n",
                "hand_n",
            ),
            *("slip_m", "turn_deg", "robot_slip_m", "untouched_slip_m", "time_s"),
        )
        columns: dict[str, Any] = {
            **_columns_of(one.case, handed.trial_id, success),
            "received": np.ones(n, bool),
            "outcome": t.outcome,
            "false_release": np.array([o == Outcome.FALSE_RELEASE for o in t.outcome], bool),
            "undecided": t.undecided,
            **{k: getattr(t, k) for k in numbers},
            **{f"t{s}_s": t.share_s[:, k] for k, s in enumerate((10, 50, 90))},
            "closing_m": handed.closing_m,
            **{f"person_{k}": getattr(one.persons, k) for k in _PERSON},
        }
        tables.append(_table(columns, n))
    return pa.concat_tables(tables)


def _columns_of(case: Case, trial_id: np.ndarray, success: dict[int, bool]) -> dict[str, Any]:
    n = len(trial_id)
    return {
        "trial_id": trial_id,
        "release": [case.release] * n,
        "scenario": [case.scenario] * n,
        "person": np.full(n, case.person, np.int16),
        "success": np.array([success[i] for i in trial_id.tolist()], bool),
    }


def _table(columns: dict[str, Any], n: int) -> pa.Table:
    """A table of `SCHEMA`; columns that are missing, and NaN, are null."""
    arrays = []
    for field in SCHEMA:
        values = columns.get(field.name)
        if values is None:
            arrays.append(pa.nulls(n, field.type))
        elif field.type == _FLOAT:
            numbers = np.asarray(values, np.float32)
            arrays.append(pa.array(numbers, field.type, mask=np.isnan(numbers)))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=SCHEMA)


def render(files: dict[str, Path], cases: Sequence[Case]) -> str:
    """Outcomes of the transfers of each method, policy and scenario, as text that ends in a newline."""
    short = short_names(list(files))
    funnel, ends, others, went = [], [], [], []
    policies = list(dict.fromkeys((c.release, c.scenario) for c in cases))
    for name, path in files.items():
        table = pq.read_table(path)
        for release, scenario in policies:
            rows = _of(table, release, scenario)
            label = [plain(short[name]), plain(release), scenario]
            grips = SCENARIOS[scenario].grips
            good = str(Outcome.TAKEN if grips else Outcome.KEPT)
            got, n = rows["received"], len(rows["received"])
            done = got & (rows["outcome"] == good)
            own = rows["trial_id"][got]
            funnel.append(
                [
                    *label, str(n), percent_text(rows["success"]), percent_text(got), good, percent_text(done),
                    percent_text(done & rows["success"]),
                ]
            )  # fmt: skip
            count = int(got.sum())
            halves = _halves(rows, done, got) if grips else ["-"] * 3
            ends.append(
                [
                    *label,
                    str(count),
                    _over_trials(done[got], own),
                    percent_text(rows["undecided"][got].astype(bool)),
                    *halves,
                ]
            )
            others.append({o: percent_text(rows["outcome"][got] == o) for o in OTHERS})
            went.append([*label, *_medians(rows, done), *_forces(rows["hand_n"][got])])
    key = ["Method", "release", "scenario"]
    steps = [*key, "n", "SR", "received", "end", "so ended", "and success"]
    how = [*key, "n", "taken or kept", "undecided", "weak grip", "firm grip", "stiff arm"]
    numbers = [
        "share",
        "time, s",
        "t10",
        "t50",
        "t90",
        "pull, N",
        "grip, N",
        "slip, mm",
        "turn, deg",
    ]
    force = [f"force {p} %, N" for p in FORCE_PERCENT]
    nothing = ("0.0", "-")
    shown = [o for o in OTHERS if any(row[o] not in nothing for row in others)]
    ends = [[*e, *(row[o] for o in shown)] for e, row in zip(ends, others, strict=True)]
    parts = [
        "From success to taken, percent of all",
        aligned(steps, funnel, 3),
        "How transfers end",
        aligned([*how, *(o.replace("_", " ") for o in shown)], ends, 3),
        "How they went (medians of the taken or kept; force on the person: of all received)",
        aligned([*key, *numbers, *force], went, 3),
        notes_list(NOTES),
    ]
    return "\n\n".join(parts) + "\n"


FORCE_PERCENT = (50, 90, 99)
"""Percentiles of the largest force of a transfer. The largest of all belongs to headphones that hook, and to the time step."""
OTHERS = tuple(
    str(o) for o in Outcome if o not in (Outcome.NOT_RECEIVED, Outcome.TAKEN, Outcome.KEPT)
)


def _of(table: pa.Table, release: str, scenario: str) -> dict[str, np.ndarray]:
    keys = zip(table["release"].to_pylist(), table["scenario"].to_pylist(), strict=True)
    rows = table.filter(pa.array([k == (release, scenario) for k in keys], pa.bool_()))
    return {k: rows[k].to_numpy(zero_copy_only=False) for k in rows.column_names}


def _over_trials(hits: np.ndarray, trial_id: np.ndarray) -> str:
    """The rate and its 95 % interval; where trials have several persons, they are the clusters."""
    trials, of = np.unique(trial_id, return_inverse=True)
    if len(trials) == len(hits):
        return rate_text(hits)
    rate = clustered_rate(np.bincount(of, weights=hits).astype(np.int64), np.bincount(of))
    ends = f"[{rate.low:.1f}, {rate.high:.1f}]" if rate is not None else "[-]"
    return f"{percent_text(hits)} {ends}"


def _forces(hand_n: np.ndarray) -> list[str]:
    """Percentiles of the largest force on the person, N; in touch and nobody nobody grips."""
    known = hand_n.astype(float)[hand_n.astype(float) > 0]
    return [f"{np.percentile(known, p):.1f}" if len(known) else "-" for p in FORCE_PERCENT]


def _halves(rows: dict[str, np.ndarray], done: np.ndarray, got: np.ndarray) -> list[str]:
    """Percent of the weaker and the firmer half of the grips, and of the stiffer half of the arms."""
    if not got.any():
        return ["-"] * 3
    grip, arm = rows["person_grip"].astype(float), rows["person_arm_n_m"].astype(float)
    weak = got & (grip <= np.median(grip[got]))
    stiff = got & (arm > np.median(arm[got]))
    return [percent_text(done[half]) for half in (weak, got & ~weak, stiff)]


def _medians(rows: dict[str, np.ndarray], done: np.ndarray) -> list[str]:
    def median(name: str, scale: float, digits: int) -> str:
        x = rows[name][done].astype(float)
        x = x[np.isfinite(x)]
        return f"{scale * np.median(x):.{digits}f}" if len(x) else "-"

    names = (
        ("release_share", 1, 2),
        ("transfer_s", 1, 2),
        ("t10_s", 1, 2),
        ("t50_s", 1, 2),
        ("t90_s", 1, 2),
    )
    more = (("pull_n", 1, 1), ("grip_n", 1, 1), ("slip_m", 1e3, 1), ("turn_deg", 1, 1))
    return [median(*x) for x in (*names, *more)]
