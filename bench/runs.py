"""Run folders at size: bytes a trial, seconds and memory to write, verify, aggregate and report N synthetic trials.

`python bench/runs.py --trials 10000000`. Each step is a process of its own, so that its peak memory is its own. Margins and
times are drawn independently from smooth distributions with full float32 mantissas, clearances cut at 5 cm as real ones are:
they compress no better than real rows. Ids, objects and sides are the protocol's, so rows are compared with the plan.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
from _report import ROOT, Report, arguments

from r2h_batch.runs.rows import OUTCOME_NAMES, TRIAL_SCHEMA
from r2h_batch.runs.store import SHARD_TRIALS
from r2h_batch.schedule import PROTOCOL
from r2h_batch.verdicts import CRITERIA, SIDES, SPLITS, CollidingPair, PlanReason

OBJECTS = [f"object_{i:02d}" for i in range(16)]
BLOCK = 256  # trials that share one amortised time


def rows(first: int, last: int, n_s0: int) -> pa.Table:
    """Synthetic trials of a range of the plan: independent margins, so they compress no better than real ones."""
    random = np.random.default_rng(first)
    position = np.arange(first, last)
    n, s1 = last - first, position >= n_s0
    turn = np.where(s1, position - n_s0, position)
    objects = np.where(s1, 6 + turn % 10, turn % 6)
    scale = np.array([0.02, 0.02, 0.04, 0.02, 0.02]) * (0.5 + objects[:, None] / 16)
    margin = (random.normal(0.6, 1.0, (n, 5)) * scale).astype(np.float32)
    margin[:, [1, 3, 4]] = np.minimum(margin[:, [1, 3, 4]], np.float32(0.05))
    found = margin[:, 1] > 0
    margin[~found, 1] = -np.inf
    evaluated = np.ones((n, 5), bool)
    evaluated[:, 3], evaluated[:, 4] = s1, found
    passed = evaluated & (margin > 0)
    failed = evaluated & ~passed
    outcome = np.where(failed.any(1), failed.argmax(1) + 1, 0)
    block = position // BLOCK

    def words(codes: np.ndarray, names: list[str]) -> pa.DictionaryArray:
        return pa.DictionaryArray.from_arrays(pa.array(codes.astype(np.int32), mask=codes < 0), pa.array(names))

    def floats(values: np.ndarray, given: np.ndarray) -> pa.Array:
        return pa.array(values.astype(np.float32), mask=~given)

    always = np.ones(n, bool)
    reason = np.where(found, 0, random.choice([2, 3, 3, 4], n))
    pair = np.where(reason == 3, random.integers(1, len(CollidingPair), n), -1)
    columns = {
        "trial_id": pa.array(2 * turn + s1),
        "object": words(objects, OBJECTS),
        "split": words(s1.astype(int), list(SPLITS)),
        "side": words((turn // np.where(s1, 10, 6) + objects) % 2, list(SIDES)),
        "outcome": words(outcome, list(OUTCOME_NAMES)),
        **{f"passed_{c}": pa.array(passed[:, i], mask=~evaluated[:, i]) for i, c in enumerate(CRITERIA)},
        **{f"margin_{c}_m": floats(margin[:, i], evaluated[:, i]) for i, c in enumerate(CRITERIA)},
        "plan_reason": words(reason, [r.name.lower() for r in PlanReason]),
        "plan_pair": words(pair, [p.name.lower() for p in CollidingPair]),
        "nearest_pair": words(np.where(found, 1, -1), [p.name.lower() for p in CollidingPair]),
        "width_m": floats(0.08 * random.random(n), always),
        "borderline": pa.array((np.abs(np.where(evaluated, margin, 1)) < 1e-4).any(1)),
        "presented": pa.array(random.random(n) < 0.8, mask=~s1),
        "presented_angle_deg": floats(180 * random.random(n), s1),
        "presented_distance_m": floats(0.2 * random.random(n), s1),
        "t_plan_s": floats(1e-3 + 1e-4 * random.random(block[-1] - block[0] + 1)[block - block[0]], always),
        "t_exec_s": floats(random.gamma(20, 0.42, n), found),
        "t_method_s": floats(np.full(n, 0.0002), always),
        "body_m": floats(np.full(n, np.nan), ~always),
    }
    return pa.table([columns[f.name] for f in TRIAL_SCHEMA], schema=TRIAL_SCHEMA)


def header(trials: int) -> dict:
    """run.json of the synthetic run."""
    n_s0 = trials // 2
    return {
        "protocol": PROTOCOL,
        "trials": {"S0": n_s0, "S1": trials - n_s0},
        "objects": [{"name": n, "split": SPLITS[i >= 6], "built_in": False} for i, n in enumerate(OBJECTS)],
        "configuration": {"name": "default"},
        "digests": {"trials": "synthetic"},
        "seed": 0,
        "device": {"kind": "cpu", "name": "none"},
        "versions": {"r2h_batch": "bench"},
        "shard_trials": SHARD_TRIALS,
    }


def write(folder: Path, trials: int) -> dict:
    """Through the real writer; making the rows is not counted."""
    from r2h_batch.runs.store import open_run

    run = open_run(folder, header(trials))
    run.register("synthetic", {"kind": "bench"})
    seconds = 0.0
    for shard in run.todo("synthetic"):
        table = rows(shard.first, shard.last, trials // 2)
        start = time.perf_counter()
        with run.write("synthetic", shard) as writer:
            writer.append(trials=table)
        seconds += time.perf_counter() - start
    size = sum(p.stat().st_size for p in (folder / "trials").rglob("*.parquet"))
    everything = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    return {"seconds": seconds, "bytes_per_trial": size / trials, "bytes_per_trial_with_manifest": everything / trials}


def verify(folder: Path, _: int) -> dict:
    from r2h_batch.runs.store import problems, read_header

    start = time.perf_counter()
    assert not list(problems(folder, read_header(folder)))
    return {"seconds": time.perf_counter() - start}


def aggregate(folder: Path, _: int) -> dict:
    """Table I's rows from the stored ones."""
    from r2h_batch.runs.store import load_run
    from r2h_batch.statistics.aggregate import summarise
    from r2h_batch.statistics.tally import tally

    start = time.perf_counter()
    run = load_run(folder, verify=False)
    summarise([tally(run, m) for m in run.methods])
    return {"seconds": time.perf_counter() - start}


def digest(folder: Path, _: int) -> dict:
    from r2h_batch.runs.store import load_run

    start = time.perf_counter()
    load_run(folder, verify=False).digest("synthetic")
    return {"seconds": time.perf_counter() - start}


def report(folder: Path, _: int) -> dict:
    """The whole command, imports and sha256 included."""
    return _command(folder)


def page(folder: Path, _: int) -> dict:
    """As `report`, with margins, times, objects and trials to search: the HTML page."""
    return _command(folder, "--format", "html")


def _command(folder: Path, *flags: str) -> dict:
    start = time.perf_counter()
    line = [sys.executable, "-m", "r2h_batch.report", str(folder), *flags]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return {"seconds": time.perf_counter() - start, "peak_mb": peak}


STEPS = {f.__name__: f for f in (write, verify, aggregate, digest, report, page)}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=10_000_000)
    parser.add_argument("--folder", type=Path, help="keep the run here (default: a temporary folder)")
    parser.add_argument("--step", choices=STEPS, help="run one step only and print its figures as JSON")
    given = parser.parse_args()
    if given.step:
        found = STEPS[given.step](given.folder, given.trials)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"peak_mb": peak, **found}))
        return
    figures = Report()
    figures.add("runs.trials", given.trials)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary) / "run"
        for step in STEPS:
            line = [sys.executable, __file__, "--step", step, "--folder", str(folder), "--trials", str(given.trials)]
            done = subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT)
            for name, value in json.loads(done.stdout.splitlines()[-1]).items():
                figures.add(f"runs.{step}_{name}", value)
    figures.write(given.json)


if __name__ == "__main__":
    main()
