"""Has this commit become slower? The same work of this commit and of another one, by turns, on one machine.

python bench/watch.py BASE [--minutes 6] [--figures NAME ...] [--json FILE]        (make watch BASE=...)

BASE is a commit, or the folder of a checkout. The commit's files are put into a temporary folder; its dependencies are those
of this environment. Each side has one process that stays, so kernels are compiled and loaded before anything is measured. A
round measures each figure once on both sides, and the side that goes first changes from round to round. Figures are process
time (of all threads), which other work on the machine changes less than wall time, and what matters is the ratio of a round:
both sides had the same minute. The table has the medians, and the ratio's median with an interval that holds it with 95 %
probability (order statistics: the rounds need not be normally distributed). All rows are of the default benchmark, so receivers
have arms and torsos. `pose.N`, `gradient.N`: a call of N rows; a gradient with its way back. `trial.*`: whole trials, planned
and measured for collisions; `plan`, `ik`, `reception`, `closed_loop`: these stages alone, a trial; `collision`: a random
posture. `start`: a new process, from start to first verdict. `sweep`: a new process that sweeps and stores. A figure that a
side cannot measure is named, and the exit code is 1: what nobody measured has not stayed as fast.

All of it takes --minutes. Compiling comes first; where it leaves too little, three rounds are measured all the same.
"""

import argparse
import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import r2h_batch as package

HERE, ROOT = Path(__file__).resolve(), Path(__file__).resolve().parents[1]
MEASURES = (
    "bench/watch.py",
    "bench/_is_free.py",
    "bench/mix.npz",
    "kernels",
    "r2h_batch/base",
    "r2h_batch/closed_loop",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/sweep",
)
ROWS = {
    "pose.1": 1, "pose.16": 16, "pose.64": 64, "pose.4096": 4096, "trial.kinematic": 256, "plan": 256,
    "collision": 8192, "ik": 4096, "reception": 4, "closed_loop": 1, "start": 1, "sweep": 64,
}  # fmt: skip
"""The figures, and how many rows each is divided by."""
MORE = {"gradient.1": 1, "gradient.512": 512, "trial.moved": 8}
"""Figures that --figures can name."""
BATCH: Any = package  # of either commit
LEAST_S = 0.1
"""A figure of a round takes at least so much process time: calls are repeated."""


def reception(scores: Any) -> Callable[[], object]:
    judge = importlib.import_module("r2h_batch.judge.reception")
    return lambda: judge.reception(scores)


def closed_loop(scores: Any) -> Callable[[], object]:
    """Whole episodes against hands that move."""
    from r2h_batch.closed_loop.env import HandoverEnv
    from r2h_batch.closed_loop.episodes import play
    from r2h_batch.closed_loop.policies import Servo

    env = HandoverEnv(scores, "moves", action="posture")
    return lambda: play(env, Servo)


def plan(evaluator: Any, T_obj_ee: Any, T_world_ee: Any, trials: Any) -> Callable[[], object]:
    """Paths to poses whose branches are known."""
    from r2h_batch.judge.attach import attach_object
    from r2h_batch.judge.ik import solve_ik
    from r2h_batch.judge.plan import plan_paths, random_key

    scene, config = evaluator.scene, evaluator.config
    held = attach_object(scene, T_obj_ee, T_world_ee, trials, config)
    ik, key = solve_ik(held.T_world_ee, active=held.active), random_key(trials.trial_id)
    return lambda: plan_paths(scene, held.planner_poses, ik.q, ik.valid, held.active, key, config.plan)


def collision(evaluator: Any, T_obj_ee: Any, T_world_ee: Any, trials: Any) -> Callable[[], object]:
    """Whether random postures are free, as many for each trial."""
    import torch
    from _is_free import is_free

    from r2h_batch.base.launch import launch_trials
    from r2h_batch.judge.attach import attach_object

    scene, n = evaluator.scene, ROWS["collision"]
    bodies = attach_object(scene, T_obj_ee, T_world_ee, trials, evaluator.config).body_poses.bodies
    low, high = (torch.tensor(x, dtype=torch.float32) for x in (scene.robot.lower, scene.robot.upper))
    q = low + (high - low) * torch.rand(n, 6, generator=torch.Generator().manual_seed(0))
    inputs = {"per_trial": n // len(trials), "world": scene.world, "bodies": bodies, "q": q}
    free = {"free": torch.zeros(n, dtype=torch.bool)}
    return lambda: launch_trials(is_free, n, inputs=inputs, outputs=free, device="cpu")


@cache
def judge_of(sim: str) -> Any:
    """An evaluator whose motions are taken as planned ("none"), or simulated by default."""
    from r2h_batch import EvalConfig
    from r2h_batch.config import ExecConfig

    config = EvalConfig(execute=ExecConfig(sim="none")) if sim == "none" else None
    return BATCH.Evaluator(BATCH.load_benchmark(), config)


@cache
def first_trials() -> Any:
    """The trials of bench/mix.npz, in the order of their numbers."""
    trials = BATCH.load_benchmark().trials(512)
    return trials[trials.trial_id.argsort()]


def work(figure: str) -> Callable[[], object]:
    """One call of a figure, by public names that both commits have."""
    import numpy as np
    import torch

    n = 64 if figure == "collision" else (ROWS | MORE)[figure]
    evaluator = judge_of("default" if figure == "trial.moved" else "none")
    with np.load(ROOT / "bench" / "mix.npz", allow_pickle=False) as mix:
        rows = torch.arange(n) % len(mix["trial_id"])
        T_obj_ee, T_world_ee = (torch.from_numpy(mix[k])[rows] for k in ("T_obj_ee", "T_world_ee"))
    stage = figure.partition(".")[0]
    trials = first_trials()[rows]
    if figure in ("plan", "collision"):
        made = plan if figure == "plan" else collision
        return made(evaluator, T_obj_ee, T_world_ee, trials)
    if figure in ("reception", "closed_loop"):
        scores = evaluator.score(T_obj_ee, T_world_ee, trials)
        return reception(scores) if figure == "reception" else closed_loop(scores)
    if figure == "ik":
        solve_ik = importlib.import_module("r2h_batch.judge.ik").solve_ik
        return lambda: solve_ik(T_world_ee)
    if stage == "trial":
        return lambda: evaluator.score(T_obj_ee, T_world_ee, trials)
    if stage == "pose":
        return lambda: evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")

    def gradient() -> None:
        poses = [T.clone().requires_grad_() for T in (T_obj_ee, T_world_ee)]
        evaluator.score(*poses, trials, stages="pose").margin.nan_to_num(0.0, 0.0, 0.0).sum().backward()

    return gradient


def of_a_process(words: list[str]) -> float:
    """Process time of a program, s."""
    before = os.times()
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode:
        raise RuntimeError(done.stderr[-300:])
    return after.children_user + after.children_system - before.children_user - before.children_system


def measured(figure: str, calls: dict[str, Any]) -> float:
    """Process time of one row, s."""
    n = (ROWS | MORE)[figure]
    if figure == "start":
        return of_a_process([str(HERE), "--once", "pose.1"])
    if figure == "sweep":
        with tempfile.TemporaryDirectory() as out:
            words = ["-m", "r2h_batch.sweep", "--benchmark", "r2h-v2", "--method", "random"]
            words += ["--trials", str(n // 2), "--execute.sim", "none"]
            return of_a_process([*words, "--out", f"{out}/run"]) / n
    if figure not in calls:
        call = work(figure)
        call()
        begin = time.process_time()
        call()
        calls[figure] = call, max(1, round(LEAST_S / max(time.process_time() - begin, 1e-6)))
    call, repeats = calls[figure]
    begin = time.process_time()
    for _ in range(repeats):
        call()
    return (time.process_time() - begin) / repeats / n


def serve() -> None:
    """Answers each line that names a figure with its time, or why there is none."""
    calls: dict[str, Any] = {}
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever else is printed is no answer
    for line in sys.stdin:
        try:
            answer: dict[str, Any] = {"s": measured(line.strip(), calls)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


class Side:
    """The process of one commit."""

    def __init__(self, folder: Path) -> None:
        self.missing: dict[str, str] = {}
        self._process = subprocess.Popen(
            [sys.executable, str(HERE), "--serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            cwd=folder, env=os.environ | {"PYTHONPATH": str(folder), "PYTHONWARNINGS": "ignore"},
        )  # fmt: skip

    def measure(self, figure: str) -> float | None:
        assert self._process.stdin is not None and self._process.stdout is not None
        print(figure, file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline() or '{"error": "the process ended"}')
        if "error" in answer:
            self.missing[figure] = answer["error"]
        return answer.get("s")

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


def by_turns(sides: list[Side], figures: list[str], until: float) -> dict[str, list[list[float]]]:
    """The times of all rounds for each figure, base and this commit; as many rounds as end by then (`time.monotonic`),
    three at least."""
    times: dict[str, list[list[float]]] = {}
    for figure in figures:  # compiles and loads
        first = [side.measure(figure) for side in sides]
        if None not in first:
            times[figure] = []
    longest, rounds = 0.0, 0
    while times and (rounds < 3 or time.monotonic() + longest < until):
        started = time.monotonic()
        for figure, rows in times.items():
            begins = rounds % 2
            pair = {k: sides[k].measure(figure) for k in (begins, 1 - begins)}
            rows.append([float(pair[0] or "nan"), float(pair[1] or "nan")])
        longest, rounds = max(longest, time.monotonic() - started), rounds + 1
        print(f"round {rounds}: {time.monotonic() - started:.0f} s", file=sys.stderr)
    return times


def interval(ratios: list[float]) -> tuple[float, float]:
    """Bounds that hold the median with 95 % probability, or with as much as so few rounds give."""
    from scipy.stats import binom

    ordered, n = sorted(ratios), len(ratios)
    k = max(int(binom.ppf(0.025, n, 0.5)), 1)
    return ordered[k - 1], ordered[n - k]


def table(times: dict[str, list[list[float]]]) -> tuple[list[list[str]], dict[str, dict[str, float]]]:
    """Lines of the table, and its numbers."""
    lines, values = [], {}
    for figure, rows in times.items():
        base, new = (1e6 * statistics.median(x) for x in zip(*rows, strict=True))
        ratios = [b / a for a, b in rows]
        low, high = interval(ratios)
        ratio = statistics.median(ratios)
        verdict = "slower" if low > 1.02 else "faster" if high < 0.98 else ""
        lines.append([figure, f"{base:,.4g}", f"{new:,.4g}", f"{ratio:.3f}", f"{low:.3f} to {high:.3f}", verdict])
        values[figure] = {"base_us": base, "us": new, "ratio": ratio, "low": low, "high": high, "rounds": len(rows)}
    return lines, values


def main() -> None:
    begin = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", nargs="?", help="a commit, or the folder of a checkout")
    parser.add_argument("--minutes", type=float, default=6, help="for all of it (default: 6)")
    parser.add_argument("--figures", nargs="+", choices=[*ROWS, *MORE], default=list(ROWS), metavar="NAME")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--once", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        return serve()
    if options.once:
        work(options.once)()
        return None
    if options.base is None:
        parser.error("BASE is missing: a commit, or the folder of a checkout")
    from _report import made_by, markdown_table

    with tempfile.TemporaryDirectory() as made:
        folder = Path(options.base)
        if not (folder / "r2h_batch").is_dir():
            folder = Path(made)
            files = subprocess.run(["git", "-C", str(ROOT), "archive", options.base], capture_output=True, check=True)
            subprocess.run(["tar", "-x", "-C", made], input=files.stdout, check=True)
        if not any((folder / "r2h_batch" / room / "load.py").exists() for room in ("trials", "protocols")):
            sys.exit(
                f"watch: {options.base} has no load_benchmark; take a later commit, or run that commit's own bench/watch.py"
            )
        sides = [Side(folder.resolve()), Side(ROOT)]
        try:
            times = by_turns(sides, options.figures, begin + 60 * options.minutes)
        finally:
            for side in sides:
                side.end()
    missing = {
        figure: f"{where}: {side.missing[figure]}"
        for side, where in zip(sides, (options.base, "here"), strict=True)
        for figure in options.figures
        if figure in side.missing
    }
    lines, values = table(times)
    head = ("figure", f"{options.base}, us a row", "here, us a row", "ratio", "95 %", "")
    print(markdown_table(head, lines))
    if options.json:
        options.json.write_text(
            json.dumps({"base": options.base, "values": values, "missing": missing, **made_by(MEASURES)}, indent=1)
            + "\n"
        )
    if missing:
        sys.exit("\n".join(f"watch: {figure} is not measured on both sides ({why})" for figure, why in missing.items()))
    return None


if __name__ == "__main__":
    main()
