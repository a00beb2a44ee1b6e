"""How fast and how faithfully do the engines move the arm, and what does the executed motion change?

python bench/execute.py [--trials N] [--ask speed models auto parity tracking batches] [--json FILE]

Trials and predictions are those of bench/mix.npz (half oracle, half random; S0 and S1 by turns). Speed counts process time,
so other work on the machine counts little; `trial` = the whole Evaluator.score. Tracking errors are those of the point
between the fingertips, against the reference at the same time. A trial is in the band when one of its margins is within
0.1 mm of 0 in either run. `auto` takes more trials than the rest (--auto-trials), with the answers of the method `contact`.
"""

import argparse
import copy
import time
from typing import Any, Literal
from unittest import mock

import numpy as np
import torch
from _mix import load_mix, on
from _report import Report
from run import DEVICE, Bench

import r2h_batch.judge.motion.execute as execution
from r2h_batch import load_benchmark
from r2h_batch.base.launch import launch_trials
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.motion import sim_mjwarp, sim_mujoco
from r2h_batch.judge.motion.execute import Executed, execute
from r2h_batch.judge.motion.time_law import servo_law
from r2h_batch.kernels.motion.time_law import servo_commands
from r2h_batch.scene.robot import ee_pose
from r2h_batch.types import Scores, Trials

MEASURES = (
    "bench/execute.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)
ASK = ("speed", "models", "auto", "parity", "tracking", "batches")
TIP_M = np.array([0.0, 0.0, 0.02, 1.0])  # fingertips in the ee frame


class Mix:
    """The frozen trials, scored under any execution; in the order in which an evaluator takes them, so that rows of scores and
    of what was executed are the same trials."""

    def __init__(self, n: int, device: str, threads: int | None) -> None:
        self.device, self.threads, self.n = device, threads, n
        g, h, trials = load_mix(n=n)[0]
        rows = in_order(trials)
        self.g, self.h, self.trials = on((g[rows], h[rows], trials[rows]), device)

    def score(self, config: ExecConfig) -> tuple[Scores, Executed, dict[str, Any]]:
        """Scores, the executed motion, what execute was given, process seconds under `seconds`, and under `rows` which
        rows were simulated in the whole scene (True) and with the arm alone (False)."""
        evaluator = Evaluator(load_benchmark(), EvalConfig(execute=config), device=self.device, threads=self.threads)
        seen: dict[str, Any] = {}

        def watched(scene: Any, body_poses: Any, path: Any, length: Any, motion: Any, c: Any, **k: Any) -> Executed:
            start, wall = time.process_time(), time.perf_counter()
            seen.update(body_poses=body_poses, path=path, length=length, motion=motion, scene=scene)
            seen["executed"] = execute(scene, body_poses, path, length, motion, c, **k)
            seen["execute_s"], seen["execute_wall_s"] = time.process_time() - start, time.perf_counter() - wall
            return seen["executed"]

        few = slice(0, 8)
        evaluator.score(self.g[few], self.h[few], self.trials[few])
        if config.sim != "none" and config.model != "arm":  # once in a process (docs/choices.md)
            start = time.process_time()
            evaluator.scene.model(self.trials.hand_index.tolist())
            seen["compile_s"] = time.process_time() - start
        engine = {"mujoco": sim_mujoco, "mjwarp": sim_mjwarp}.get(config.sim, sim_mujoco)
        simulate, rows = engine.simulate, seen.setdefault("rows", {True: set(), False: set()})

        def counted(job: Any, **k: Any) -> Any:
            rows[job.scene.full] |= set(job.rows.tolist())
            return simulate(job, **k)

        with mock.patch.object(execution, "execute", watched), mock.patch.object(engine, "simulate", counted):
            start = time.process_time()
            scores = evaluator.score(self.g, self.h, self.trials)
            seen["seconds"] = time.process_time() - start
        assert torch.equal(seen["length"], scores.path_len), "rows of scores and of motions are other trials"
        return scores, seen["executed"], seen


def in_order(trials: Trials) -> torch.Tensor:
    """The rows object by object, and of each hand by hand."""
    hands = int(trials.hand_index.max()) + 1
    return torch.argsort(trials.object_index.long() * hands + trials.hand_index, stable=True)


def report_changes(report: Report, name: str, a: Scores, b: Scores) -> None:
    """Trials whose verdict differs, those of them outside the 0.1 mm band, and the largest difference of Safe's margins."""
    differ = a.outcome != b.outcome
    outside = differ & ~(a.borderline | b.borderline)
    report.add(f"{name}.verdicts_that_differ", int(differ.sum()))
    report.add(f"{name}.outside_the_band", f"{int(outside.sum())} {a.trial_id[outside].tolist()}")
    safe = torch.nan_to_num(a.margin[:, 4] - b.margin[:, 4]).abs()
    report.add(f"{name}.safe_margin_max_difference_m", float(safe.max()))


def steps_of(executed: Executed) -> int:
    """Steps of all trials."""
    return int((executed.length.clamp(min=1) - 1).sum()) * ExecConfig().record_steps


def same(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Where two tensors hold the same number, or neither holds one."""
    return (a == b) | (a.isnan() & b.isnan())


def speed(mix: Mix, report: Report) -> None:
    engines: tuple[Literal["mujoco", "mjwarp"], ...] = ("mujoco", "mjwarp")
    models: tuple[Literal["auto", "scene", "arm"], ...] = ("auto", "scene", "arm")
    cases: list[tuple[Literal["none", "mujoco", "mjwarp"], Literal["auto", "scene", "arm"]]] = [
        ("none", "auto"),
        *((engine, model) for engine in engines for model in models),
    ]
    for engine, model in cases:
        slow = (engine, mix.device) == ("mjwarp", "cpu") and model != "arm"
        most = 128 if slow else mix.n  # some 4 a second
        part = Mix(min(mix.n, most), mix.device, mix.threads)
        _, executed, seen = part.score(ExecConfig(sim=engine, model=model))
        name = f"execute.speed.{engine}" + (f".{model}" if engine != "none" else "")
        report.add(f"{name}.whole_trials_per_core_s", part.n / seen["seconds"])
        report.add(f"{name}.whole_trial_core_ms", 1e3 * seen["seconds"] / part.n)
        if engine == "none":
            continue
        # compiled once in a process, where a motion needs it: not counted below
        if (engine, model) == ("mujoco", "auto"):
            report.add("execute.speed.scene_model_compile_core_s", seen["compile_s"])
            report.add(f"{name}.in_the_scene_too", len(seen["rows"][True]))
        moved = int((executed.length > 0).sum())
        report.add(f"{name}.moved_trials", moved)
        report.add(f"{name}.moved_trials_per_core_s", moved / seen["execute_s"])
        report.add(f"{name}.steps_per_core_s", steps_of(executed) / seen["execute_s"])
        report.add(f"{name}.steps_per_s", steps_of(executed) / seen["execute_wall_s"])


def models(mix: Mix, report: Report) -> None:
    """The whole scene against the arm alone with a rigid gripper, in MuJoCo C: what the linkage and the contacts change."""
    a, ea, sa = mix.score(ExecConfig(sim="mujoco", model="arm"))
    b, eb, sb = mix.score(ExecConfig(sim="mujoco", model="scene"))
    moved = ea.length > 0
    report.add("execute.models.moved_trials", int(moved.sum()))
    report.add("execute.models.scene_time_over_arm_time", sb["execute_s"] / sa["execute_s"])
    report.add("execute.models.dq_max_rad", float((ea.path - eb.path).abs().max()))
    sway = (eb.slack_m - ea.slack_m)[moved] * 1e6
    report.add("execute.models.finger_sway_mean_um", float(sway.mean()))
    report.add("execute.models.finger_sway_max_um", float(sway.max()))
    report_changes(report, "execute.models", a, b)


def auto(mix: Mix, report: Report) -> None:
    """`model="auto"` against the whole scene, in MuJoCo C: as many trials as asked for, answered by the method `contact`."""
    from r2h_batch.methods import contact

    evaluator = Evaluator(load_benchmark(), device=mix.device, threads=mix.threads)
    mix = copy.copy(mix)
    trials = load_benchmark().trials_with_ids(torch.arange(mix.n))
    mix.trials = trials[in_order(trials)].to(mix.device)
    answers = contact.predict(mix.trials, evaluator.scene, seed=0)
    mix.g, mix.h = answers.T_obj_ee.to(mix.device), answers.T_world_ee.to(mix.device)
    a, ea, sa = mix.score(ExecConfig(sim="mujoco", model="auto"))
    b, _, sb = mix.score(ExecConfig(sim="mujoco", model="scene"))
    moved = ea.length > 0
    report.add("execute.auto.trials", mix.n)
    report.add("execute.auto.moved_trials", int(moved.sum()))
    report.add("execute.auto.in_the_scene_too", len(sa["rows"][True]))
    report.add("execute.auto.by_the_arm_alone_share", 1.0 - len(sa["rows"][True]) / int(moved.sum()))
    report.add("execute.auto.scene_time_over_auto_time", sb["execute_s"] / sa["execute_s"])
    report_changes(report, "execute.auto", a, b)
    report.add("execute.auto.plan_reasons_that_differ", int((a.plan_reason != b.plan_reason).sum()))
    late = torch.nan_to_num(a.t_exec_s - b.t_exec_s).abs()
    report.add("execute.auto.t_exec_max_difference_s", float(late.max()))
    report.add("execute.auto.t_exec_that_differ", int((late > 0).sum()))


def parity(mix: Mix, report: Report) -> None:
    a, ea, _ = mix.score(ExecConfig(sim="mujoco", model="scene"))
    b, eb, _ = mix.score(ExecConfig(sim="mjwarp", model="scene"))
    moved = ea.length > 0
    report.add("execute.parity.trials", mix.n)
    report.add("execute.parity.moved_trials", int(moved.sum()))
    report.add("execute.parity.same_length", bool(torch.equal(ea.length, eb.length)))
    worst = (ea.path - eb.path).abs().amax((1, 2))[moved].cpu().numpy()
    report.add("execute.parity.dq_max_rad", float(worst.max()))
    report.add("execute.parity.dq_p99_of_trials_rad", float(np.percentile(worst, 99)))
    report.add("execute.parity.t_exec_max_difference_s", float((a.t_exec_s - b.t_exec_s)[moved].abs().max()))
    report_changes(report, "execute.parity", a, b)


def batches(mix: Mix, report: Report) -> None:
    """The same trials in batches of other sizes and in another order: rows that differ in any bit of a verdict or margin."""
    for engine in ("mujoco", "mjwarp"):
        n = min(mix.n, 256)
        evaluator = Evaluator(
            load_benchmark(), EvalConfig(execute=ExecConfig(sim=engine)), device=mix.device, threads=mix.threads
        )
        whole = evaluator.score(mix.g[:n], mix.h[:n], mix.trials[:n])
        order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
        cases = {"permuted": [order], "7": torch.arange(n).split(7), "1": torch.arange(min(n, 24)).split(1)}
        for name, parts in cases.items():
            differ = 0
            for rows in parts:
                s = evaluator.score(mix.g[rows], mix.h[rows], mix.trials[rows])
                alike = (s.outcome == whole.outcome[rows]) & same(s.margin, whole.margin[rows]).all(1)
                differ += int((~(alike & same(s.t_exec_s, whole.t_exec_s[rows]))).sum())
            report.add(f"execute.batches.{engine}.{name}.rows_that_differ", differ)


def tracking(mix: Mix, report: Report) -> None:
    config = ExecConfig(sim="mujoco", model="scene")
    scores, executed, seen = mix.score(config)
    rows = torch.nonzero(executed.length > 0).flatten()
    assert executed.sample_s is not None, "engines record samples; only `none` does not"
    law = servo_law(config, np.ones(6), lead_s=0.0, step_s=executed.sample_s)
    reference = torch.zeros((len(rows), executed.path.shape[1], 6), dtype=torch.float64)
    launch_trials(
        servo_commands,
        len(rows),
        inputs={
            "law": law,
            "trial": rows.to(torch.int32),
            "path": seen["path"].contiguous(),
            "time": seen["motion"].time_s.contiguous(),
            "length": seen["length"].contiguous(),
        },
        outputs={"command": reference},
        device="cpu",
        width=reference.shape[1],
    )
    robot, error = seen["scene"].robot, []
    for i, row in enumerate(rows.tolist()):
        n = int(executed.length[row])
        tips = [
            (ee_pose(robot, q) @ TIP_M)[:, :3]
            for q in (executed.path[row, :n].double().numpy(), reference[i, :n].numpy())
        ]
        error.append(np.linalg.norm(tips[0] - tips[1], axis=1))
    each = np.concatenate(error) * 1e3
    report.add("execute.tracking.known_object.trials", len(error))
    for key, value in (("mean", each.mean()), ("p95", np.percentile(each, 95)), ("max", each.max())):
        report.add(f"execute.tracking.known_object.{key}_mm", float(value))
    report.add("execute.tracking.known_object.slack_mean_um", float(executed.slack_m[rows].mean()) * 1e6)
    report.add("execute.tracking.known_object.slack_max_um", float(executed.slack_m[rows].max()) * 1e6)
    report.add("execute.tracking.known_object.not_settled", int((~executed.settled[rows]).sum()))
    certified = executed.deviation_m < scores.margin[:, 1] - 1e-4  # the margin is located to 0.1 mm
    report.add("execute.tracking.known_object.deviation_max_mm", float(executed.deviation_m[rows].max()) * 1e3)
    report.add("execute.tracking.known_object.deviation_mean_mm", float(executed.deviation_m[rows].mean()) * 1e3)
    report.add("execute.tracking.known_object.certified_free_share", float(certified[rows].double().mean()))
    t = scores.t_exec_s[~scores.t_exec_s.isnan()].numpy()
    for key, value in (("mean", t.mean()), *((f"p{p}", np.percentile(t, p)) for p in (5, 50, 95, 100))):
        report.add(f"execute.t_exec.known_object.{key}_s", float(value))


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    mix = Mix(options.trials, options.device, options.threads)
    for name in options.ask:
        asked = Mix(options.auto_trials, options.device, options.threads) if name == "auto" else mix
        globals()[name](asked, report)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--trials": {"default": 256},
        "--threads": {"type": int, "help": "CPU threads (default: one per core)"},
        "--auto-trials": {"default": 2000, "help": "of `auto` against `scene`"},
        "--ask": {"nargs": "+", "choices": ASK, "default": ASK},
    },
    peer="MuJoCo C and MuJoCo-Warp, each with arm alone and whole scene",
)

if __name__ == "__main__":
    BENCH.main()
