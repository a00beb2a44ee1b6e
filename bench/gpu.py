"""Everything that a machine with a GPU can show, in one command: `python bench/gpu.py --out DIR [--minutes 25]`, `make gpu`.

Parts run in the order of PARTS and stop being started when the minutes are over; gpu.json and gpu.md in DIR are written after
each, so a run that is cut short leaves what it had. A part that fails says so in both files and the next one runs; the exit
code is 1 then. Equality: outcomes may differ where a trial is `borderline` on either device, margins by MARGIN_M.
`--device cpu --trials 8` goes through the same lines on a machine without a GPU: that is what the suite does, no figure of it
means anything.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
import warp as wp
from _mix import Poses, load_mix, on, repeated
from _report import ROOT, Report
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.base import launch
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import planner
from r2h_batch.judge.search import Search
from r2h_batch.methods import random

RANDOM_TRIALS = 2048
MARGIN_M = 1e-4
CHUNKS = (2048, 8192, 32768)
BLOCKS = (32, 64, 128, 256)
WORLDS = (256, 1024, 4096, 16384)
SEARCH_ROWS = 32_000
"""Rows of which the search is measured."""
REPEATS = 3
KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))


@dataclass
class Machine:
    """Shared by the parts: the device, how many trials, the report, when to stop."""

    device: str
    trials: int
    until: float
    out: Path
    report: Report

    @property
    def cuda(self) -> bool:
        return self.device != "cpu"

    @cached_property
    def evaluator(self) -> Evaluator:
        return Evaluator(load_benchmark(), KINEMATIC, device=self.device)

    @cached_property
    def on_cpu(self) -> Evaluator:
        return Evaluator(load_benchmark(), KINEMATIC)

    @cached_property
    def mix(self) -> Poses:
        """The frozen mix of bench/throughput.py, on the CPU."""
        return load_mix(n=min(self.trials, 1024))[0]

    @cached_property
    def random(self) -> Poses:
        """RANDOM_TRIALS trials with the poses of the method `random`, on the CPU."""
        scene = self.on_cpu.scene
        trials = load_benchmark().trials_with_ids(torch.arange(min(self.trials, RANDOM_TRIALS)))
        answer = random.predict(trials, scene, seed=0)
        return answer.T_obj_ee, answer.T_world_ee, trials

    def there(self, batch: Poses) -> Poses:
        return on(batch, self.device)

    def repeated(self, batch: Poses, n: int) -> Poses:
        """The batch again and again until it has n rows, on the device."""
        return repeated(on(batch, self.device), n)

    def seconds(self, run: Callable[[], object]) -> float:
        """The median wall time of a call after one to warm up, waiting for the device."""
        times = []
        for _ in range(REPEATS + 1):
            self.wait()
            start = time.perf_counter()
            run()
            self.wait()
            times.append(time.perf_counter() - start)
        return statistics.median(times[1:])

    def wait(self) -> None:
        if self.cuda:
            torch.cuda.synchronize()

    def command(self, name: str, line: Sequence[str]) -> int:
        """Exit code of a command that has at most what is left of the minutes; its output is NAME.log in the folder."""
        left = max(self.until - time.monotonic(), 30.0)
        with (self.out / f"{name}.log").open("w") as log:
            try:
                done = subprocess.run(line, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT, timeout=left, check=False)
            except subprocess.TimeoutExpired:
                return 124
        return done.returncode


def machine(bench: Machine) -> None:
    """Reports the device: name, architecture, memory, driver."""
    bench.report.add("gpu.device", torch.cuda.get_device_name(bench.device) if bench.cuda else "cpu")
    bench.report.add("gpu.torch_cuda", str(torch.version.cuda))
    if bench.cuda:
        device = wp.get_device(str(wp.device_from_torch(torch.device(bench.device))))
        bench.report.add("gpu.arch", f"sm_{device.arch}")
        bench.report.add("gpu.memory_gib", device.total_memory / 2**30)
        bench.report.add("gpu.driver", str(wp.get_cuda_driver_version()))


FIRST_CALL = [sys.executable, __file__, "--first-call"]
"""Ends with 0 if `capture()` gave the bits of the plain call, with 3 if not; the device follows."""


def first_call(device: str) -> int:
    evaluator = Evaluator(load_benchmark(), device=device)
    trials = load_benchmark().trials(4, splits=("S0", "S1"))
    answer = random.predict(trials, Evaluator(load_benchmark()).scene, seed=0)
    batch = on((answer.T_obj_ee, answer.T_world_ee, trials), device)
    captured, plain = evaluator.capture(8)(*batch).margin.cpu(), evaluator.score(*batch, "pose").margin.cpu()
    same = captured.numpy().tobytes() == plain.numpy().tobytes()
    return 0 if same and plain.isfinite().any() else 3


def capture_first(bench: Machine) -> None:
    """`capture()` as the first call of a process, compilation included: the bits of the plain call?"""
    start = time.perf_counter()
    code = bench.command("capture_first", [*FIRST_CALL, bench.device])
    bench.report.add("gpu.capture_first_call_ok", code == 0)
    bench.report.add("gpu.capture_first_call_s", time.perf_counter() - start)
    if code:
        raise RuntimeError(f"exit code {code}; capture_first.log")


def compile_times(bench: Machine) -> None:
    """Seconds until the modules of a first full call are compiled or loaded, and the call itself."""
    start = time.perf_counter()
    bench.evaluator.score(*bench.there(bench.mix))
    bench.wait()
    bench.report.add("gpu.first_full_call_s", time.perf_counter() - start)


def marked_tests(bench: Machine) -> None:
    """`pytest -m gpu`."""
    code = bench.command("pytest_gpu", [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider"])
    last = (bench.out / "pytest_gpu.log").read_text().strip().splitlines()[-1:]
    bench.report.add("gpu.pytest", last[0] if last else f"exit code {code}")
    if code not in (0, 5):  # 5: none is left where there is no GPU
        raise RuntimeError(f"exit code {code}; pytest_gpu.log")


def equal_to_cpu(bench: Machine) -> None:
    """Whole trials here and on the CPU: outcomes, margins, paths."""
    for name, batch in (("mix", bench.mix), ("random", bench.random)):
        there = bench.evaluator.score(*bench.there(batch)).to("cpu")
        here = bench.on_cpu.score(*batch)
        sharp = ~(here.borderline | there.borderline)
        differ = (here.outcome != there.outcome) & sharp
        both = here.margin.isfinite() & there.margin.isfinite()
        off = (here.margin - there.margin).abs().where(both, torch.zeros(()))
        other_path = (here.path_len != there.path_len).nonzero().flatten()
        bench.report.add(f"gpu.{name}.trials", len(here))
        bench.report.add(f"gpu.{name}.outcomes_that_differ", int(differ.sum()))
        bench.report.add(f"gpu.{name}.borderline", int((~sharp).sum()))
        bench.report.add(f"gpu.{name}.margin_difference_max_m", float(off.max()))
        bench.report.add(f"gpu.{name}.paths_that_differ", " ".join(map(str, here.trial_id[other_path][:50].tolist())))
        same_path = here.path_len == there.path_len
        if differ.any() or off[same_path].max() > MARGIN_M:
            raise RuntimeError(f"{name}: {int(differ.sum())} outcomes differ, margins by {float(off.max()):.1e} m")


def equal_bits(bench: Machine) -> None:
    """Batches of 1 and 7 rows, the whole, and the whole in another order: the same bits."""
    batch = bench.there(bench.mix)
    whole = bench.evaluator.score(*batch).margin.cpu()
    order = torch.from_numpy(np.random.default_rng(0).permutation(len(whole)))
    parts = {"1": order[:1], "7": order[:7], "permuted": order}
    for name, rows in parts.items():
        at = rows.to(bench.device)
        part = bench.evaluator.score(batch[0][at], batch[1][at], batch[2][at]).margin.cpu()
        same = part.numpy().tobytes() == whole[rows].contiguous().numpy().tobytes()
        bench.report.add(f"gpu.same_bits.{name}", same)
        if not same:
            raise RuntimeError(f"rows of a batch of {name} have other bits")


def memcheck(bench: Machine) -> None:
    """compute-sanitizer over the first call, where the tool is."""
    tool = shutil.which("compute-sanitizer")
    if tool is None or not bench.cuda:
        bench.report.add("gpu.memcheck", "not here")
        return
    line = [tool, "--tool", "memcheck", "--error-exitcode", "9", *FIRST_CALL, bench.device]
    code = bench.command("memcheck", line)
    bench.report.add("gpu.memcheck", {0: "clean", 124: "out of time"}.get(code, f"exit code {code}"))


def throughput(bench: Machine) -> None:
    """Kinematic trials/s of the mix over chunk and block size."""
    best = 0.0
    for chunk in CHUNKS[: None if bench.cuda else 1]:
        n = chunk if bench.cuda else bench.trials
        batch = bench.repeated(bench.mix, n)
        evaluator = Evaluator(load_benchmark(), replace(KINEMATIC, chunk=chunk), device=bench.device)
        for block in BLOCKS[: None if bench.cuda else 1]:
            with mock.patch.multiple(launch, BLOCK_DIM=block, UNEVEN_BLOCK_DIM=block):
                rate = n / bench.seconds(partial(evaluator.score, *batch))
            bench.report.add(f"gpu.trials_per_s.chunk_{chunk}.block_{block}", rate)
            best = max(best, rate)
    bench.report.add("gpu.trials_per_s", best)


SEARCHED = {
    "straight_lines": (planner.Planner, "straight"),
    "search": (Search, "_connect"),
    "shortcuts": (Search, "_shorten"),
    "clearances": (planner.Planner, "clearance"),
}


def search(bench: Machine) -> None:
    """Time of the search for a trial, beside the other parts of planning: a launch takes as long as its longest problem."""
    n = SEARCH_ROWS if bench.cuda else bench.trials
    batch = bench.repeated(bench.random, n)
    evaluator = Evaluator(load_benchmark(), replace(KINEMATIC, chunk=n), device=bench.device)
    spent = dict.fromkeys(SEARCHED, 0.0)
    problems: list[int] = []
    over_trials = planner.over_trials

    def launched(kernel: Any, rows: int, device: str, **ways: Any) -> Callable[..., Any]:
        if kernel.key == "rrt_connect":
            problems.append(rows)
        return over_trials(kernel, rows, device, **ways)

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            bench.wait()
            start = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                bench.wait()
                spent[name] += time.perf_counter() - start

        return timed

    seconds = bench.seconds(partial(evaluator.score, *batch))
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(planner, "over_trials", launched))
        for name, (owner, method) in SEARCHED.items():
            stack.enter_context(mock.patch.object(owner, method, timed(name, getattr(owner, method))))
        scores = evaluator.score(*batch)
    bench.report.add("gpu.search.rows", n)
    bench.report.add("gpu.search.searched_paths", int((scores.path_len > 2).sum()))
    bench.report.add("gpu.search.whole_us_per_trial", seconds / n * 1e6)
    for name, took in spent.items():
        bench.report.add(f"gpu.search.{name}_us_per_trial", took / n * 1e6)
    bench.report.add("gpu.search.share_of_whole", (spent["search"] + spent["shortcuts"]) / seconds)
    bench.report.add("gpu.search.launches", len(problems))
    bench.report.add("gpu.search.most_problems_of_a_launch", max(problems, default=0))


def pose_stage(bench: Machine) -> None:
    """Candidates/s of stages="pose", plain and as a captured call."""
    for n in (64, 4096, 65536) if bench.cuda else (bench.trials,):
        batch = bench.repeated(bench.mix, n)
        rate = n / bench.seconds(partial(bench.evaluator.score, *batch, stages="pose"))
        bench.report.add(f"gpu.candidates_per_s.{n}", rate)
        captured = bench.evaluator.capture(n)
        rate = n / bench.seconds(partial(captured, *batch))
        bench.report.add(f"gpu.candidates_per_s.{n}.captured", rate)


def worlds(bench: Machine) -> None:
    """Moved trials/s of MuJoCo-Warp over the number of worlds."""
    from r2h_batch.judge.motion import sim_mjwarp

    kind = "cuda" if bench.cuda else "cpu"
    config = EvalConfig(execute=ExecConfig(sim="mjwarp", model="arm"), chunk=max(WORLDS))
    evaluator = Evaluator(load_benchmark(), config, device=bench.device)
    for count in WORLDS if bench.cuda else (4,):
        batch = bench.repeated(bench.mix, count if bench.cuda else 2)
        with mock.patch.dict(sim_mjwarp.MAX_WORLDS, {kind: count}):
            start = time.perf_counter()
            scores = evaluator.score(*batch)
            bench.wait()
        moved = int((scores.path_len > 0).sum())
        bench.report.add(f"gpu.mjwarp.moved_trials_per_s.{count}", moved / (time.perf_counter() - start))
        if time.monotonic() > bench.until:
            return


PARTS: tuple[Callable[[Machine], None], ...] = (
    machine, capture_first, compile_times, equal_to_cpu, equal_bits, search, throughput, pose_stage, worlds,
    marked_tests, memcheck,
)  # fmt: skip
"""In the order of what is missed most when the time ends."""


def table(report: Report, ends: dict[str, str]) -> str:
    """The figures and how each part ended, as Markdown."""
    lines = ["| figure | value |", "|---|--:|"]
    lines += [f"| {k} | {f'{v:.6g}' if isinstance(v, float) else v} |" for k, v in report.values.items()]
    lines += ["", "| part | ended |", "|---|---|", *(f"| {k} | {v} |" for k, v in ends.items())]
    return "\n".join(lines) + "\n"


def run(bench: Machine, parts: Sequence[Callable[[Machine], None]]) -> dict[str, str]:
    """How each part ended; figures so far are on disk after each."""
    ends = {part.__name__: "not started: out of time" for part in parts}
    for part in parts:
        if time.monotonic() < bench.until:
            start = time.perf_counter()
            try:
                part(bench)
                ends[part.__name__] = f"done, {time.perf_counter() - start:.1f} s"
            except Exception as error:
                ends[part.__name__] = f"FAILED: {type(error).__name__}: {error}".splitlines()[0]
                traceback.print_exc()
        bench.report.values |= {f"gpu.part.{k}": v for k, v in ends.items()}
        bench.report.write(bench.out / "gpu.json")
        (bench.out / "gpu.md").write_text(table(bench.report, ends))
    return ends


def judged(options: argparse.Namespace, report: Report) -> None:
    """All parts, or one call in a process of its own; ends with 1 if a part failed."""
    if options.first_call:
        sys.exit(first_call(options.first_call))
    if options.device != "cpu" and not torch.cuda.is_available():
        print("gpu.py: torch sees no CUDA device; --device cpu --trials 8 is a dry run", file=sys.stderr)
        sys.exit(2)
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("MUJOCO_GL", "egl")
    held = Machine(
        options.device, options.trials, time.monotonic() + 60 * options.minutes, options.out.resolve(), report
    )
    if any(end.startswith("FAILED") for end in run(held, PARTS).values()):
        sys.exit(1)


BENCH = Bench(
    __doc__,
    judged,
    flags={
        "--device": {"default": "cuda:0", "help": "cpu or cuda:0 (default: cuda:0)"},
        "--first-call": {"metavar": "DEVICE", "help": "one captured call in a process of its own"},
        "--out": {
            "type": Path,
            "default": Path("runs/gpu"),
            "metavar": "DIR",
            "help": "of gpu.json, gpu.md and the logs",
        },
        "--minutes": {"default": 25.0, "help": "no part is started after these (default: 25)"},
        "--trials": {"default": RANDOM_TRIALS, "help": "of each batch; fewer for a dry run"},
    },
    peer="the CPU",
)

if __name__ == "__main__":
    BENCH.main()
