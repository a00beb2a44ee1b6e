"""How a run folder grows: start of a resumed sweep, verify, report, compare.

`python bench/growth.py --json FILE`. Rows are synthetic, half of them of each of two methods, and go
through the real writer. Margins and times have full float32 mantissas and compress no better than real ones. Each step is a
process of its own, so that its peak memory is its own.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from _report import ROOT, Report
from run import Bench

from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.runs.rows import OUTCOME_NAMES, TRIAL_SCHEMA
from r2h_batch.runs.writing import SHARD_TRIALS
from r2h_batch.verdicts import CRITERIA, SIDES, SPLITS, CollidingPair, Nearer, PlanReason

MEASURES = ("bench/growth.py", "r2h_batch/runs", "r2h_batch/report", "r2h_batch/sweep/results", "r2h_batch/base/io")
METHODS = ("synthetic", "other")
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
        **{f"margin_kind_{c}": words(np.where(evaluated[:, i], 0, -1), ["distance"]) for i, c in enumerate(CRITERIA)},
        "plan_reason": words(reason, [r.name.lower() for r in PlanReason]),
        "plan_pair": words(pair, [p.name.lower() for p in CollidingPair]),
        "nearest_pair": words(np.where(found, 1, -1), [p.name.lower() for p in CollidingPair]),
        "width_m": floats(0.08 * random.random(n), always),
        "borderline": pa.array((np.abs(np.where(evaluated, margin, 1)) < 1e-4).any(1)),
        "presented_margin_m": floats(0.1 * random.random(n) - 0.02, always),
        "presented_by": words(random.integers(0, len(Nearer), n), [x.name.lower() for x in Nearer]),
        "tilt_deg": floats(180 * random.random(n), ~s1),
        "t_plan_s": floats(1e-3 + 1e-4 * random.random(block[-1] - block[0] + 1)[block - block[0]], always),
        "t_exec_s": floats(random.gamma(20, 0.42, n), found),
        "t_method_s": floats(np.full(n, 0.0002), always),
        "body_m": floats(np.full(n, np.nan), ~always),
    }
    people = ("age_years", "sex", "stature_m", "hand_length_m", "seated", "redrawn")  # null in runs without people
    columns |= {name: pa.nulls(n, TRIAL_SCHEMA.field(name).type) for name in people}
    return pa.table([columns[f.name] for f in TRIAL_SCHEMA], schema=TRIAL_SCHEMA)


def header(trials: int) -> dict:
    """run.json of the synthetic run."""
    n_s0 = trials // 2
    return {
        "protocol": DEFAULT_BENCHMARK,
        "trials": {"S0": n_s0, "S1": trials - n_s0},
        "objects": [{"name": n, "split": SPLITS[i >= 6], "built_in": False} for i, n in enumerate(OBJECTS)],
        "configuration": {"name": "default"},
        "digests": {"trials": "synthetic"},
        "seed": 0,
        "device": {"kind": "cpu", "name": "none"},
        "versions": {"r2h_batch": "bench"},
        "shard_trials": SHARD_TRIALS,
    }


def open_folder(folder: Path, trials: int, shard_trials: int) -> Any:
    """The synthetic run folder, with its methods."""
    from r2h_batch.runs.writing import open_run

    run = open_run(folder, {**header(trials), "shard_trials": shard_trials}, exact=False)
    for method in METHODS:
        run.register(method, {"kind": "bench"})
    return run


def write(folder: Path, trials: int, shard_trials: int) -> dict[str, float]:
    """Through the real writer; making the rows is not counted."""
    run, seconds = open_folder(folder, trials // 2, shard_trials), 0.0
    for method in METHODS:
        for shard in run.todo(method):
            table = rows(shard.first, shard.last, trials // 4)
            start = time.perf_counter()
            with run.write(method, shard) as writer:
                writer.append(trials=table)
            seconds += time.perf_counter() - start
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    return {"seconds": seconds, "bytes_per_trial": size / trials}


def resume(folder: Path, trials: int, shard_trials: int) -> dict[str, float]:
    """Seconds that the same command needs before its first trial: the folder opened and verified, shards still to do
    listed."""
    from r2h_batch.runs.verify import mark_for_rerun

    start = time.perf_counter()
    run = open_folder(folder, trials // 2, shard_trials)
    assert not mark_for_rerun(folder, run.header) and not any(run.todo(m) for m in METHODS)
    return {"seconds": time.perf_counter() - start}


def verify(folder: Path, trials: int, shard_trials: int) -> dict[str, float]:
    return command("results", "verify", str(folder))


def report(folder: Path, trials: int, shard_trials: int) -> dict[str, float]:
    return command("report", str(folder))


def compare(folder: Path, trials: int, shard_trials: int) -> dict[str, float]:
    return command("compare", str(folder))


def command(*words: str) -> dict[str, float]:
    """Wall seconds and peak MiB of a whole command, imports and sha256 included."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "r2h_batch", *words], check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
    return {
        "seconds": time.perf_counter() - start,
        "peak_mib": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
    }


STEPS = {f.__name__: f for f in (write, resume, verify, report, compare)}


def peak(report_: Report, trials: int, step: str) -> float:
    """Peak memory of a step, GB."""
    return float(report_.values[f"growth.{trials}.{step}_peak_mib"]) * 2**20 / 1e9


def run(given: argparse.Namespace, report_: Report) -> None:
    """Measures all of it."""
    if given.step:
        figures = STEPS[given.step](given.folder, given.trials[0], given.shard_trials)
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps({"peak_mib": own, **figures}))
        return
    seconds: dict[tuple[int, str], float] = {}
    with tempfile.TemporaryDirectory(dir=given.folder) as temporary:
        for trials in given.trials:
            folder = Path(temporary) / str(trials)
            for step in STEPS:
                line = [sys.executable, __file__, "--step", step, "--folder", str(folder), "--trials", str(trials)]
                line += ["--shard-trials", str(given.shard_trials)]
                done = subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT)
                for name, value in json.loads(done.stdout.splitlines()[-1]).items():
                    report_.add(f"growth.{trials}.{step}_{name}", value)
                    seconds[trials, step] = value if name == "seconds" else seconds.get((trials, step), 0.0)
    first, last = given.trials[0], given.trials[-1]
    if last > first:
        times = [seconds[last, step] / seconds[first, step] for step in STEPS]
        report_.add("growth.sizes_apart", last / first)
        report_.add("growth.least_times_longer", min(times))
        report_.add("growth.most_times_longer", max(times))
    for step in STEPS:  # the start of a process is in both sizes
        more = seconds[last, step] - (seconds[first, step] if last > first else 0.0)
        report_.add(f"growth.{step}_us_a_row", 1e6 * more / (last - first if last > first else last))
    report_.add("growth.rows", last)
    report_.add("growth.bytes_a_row", report_.values[f"growth.{last}.write_bytes_per_trial"])
    report_.add("growth.report_and_compare_peak_gb", max(peak(report_, last, s) for s in ("report", "compare")))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--trials": {"type": int, "nargs": "+", "default": [2_000_000, 20_000_000], "help": "sizes, small to large"},
        "--shard-trials": {"default": 100_000},
        "--folder": {"type": Path, "help": "where the run folders are made (default: a temporary folder)"},
        "--step": {"choices": STEPS, "help": "run one step only and print its figures as JSON"},
    },
    peer="the smaller size's time",
)

if __name__ == "__main__":
    BENCH.main()
