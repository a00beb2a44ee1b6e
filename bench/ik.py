"""How fast, how complete is the IK? Against pytorch-kinematics' PseudoInverseIK and against closed forms.

python bench/ik.py [--targets N] [--device cpu|cuda:0] [--json FILE]

Half of the targets come from random joint angles, half are handover-like: ee origin 0.45-0.80 m from joint 1's axis,
0.1-0.7 m high, any orientation (an eighth of these is out of reach). On a CPU, times are process time of one thread, so
that other work on the machine counts little. Every time is the best of several.

missed, branch_completeness: against ur-analytic-ik.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pytorch_kinematics
import torch
import ur_analytic_ik
from _report import Report
from run import DEVICE, Bench

from r2h_batch.base import se3
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.judge.ik import IkResult, reference_chain, solve_ik
from r2h_batch.scene.robot import Robot, ee_pose
from r2h_batch.scene.robot_file import load_robot

MEASURES = (
    "bench/ik.py",
    "kernels/ik",
    "kernels/robot",
    "r2h_batch/judge/ik.py",
    "r2h_batch/base/launch",
)
REPEATS = 5


def make_targets(n: int, seed: int = 0) -> torch.Tensor:
    """T_world_ee (n, 4, 4): random joint angles, then handover-like poses."""
    rng = np.random.default_rng(seed)
    m = n - n // 2
    R = np.linalg.qr(rng.normal(size=(m, 3, 3)))[0]
    R[:, :, 0] *= np.linalg.det(R)[:, None]
    r, azimuth = rng.uniform(0.45, 0.80, m), rng.uniform(-np.pi, np.pi, m)
    T = np.tile(np.eye(4), (m, 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(0.1, 0.7, m)], 1)
    any_q = ee_pose(load_robot(), rng.uniform(-np.pi, np.pi, (n // 2, 6)))
    return torch.from_numpy(np.concatenate([any_q, T]).astype(np.float32))


def best_time(run: Callable[[], object], clock: Callable[[], float], repeats: int = REPEATS) -> float:
    """The shortest of several runs: noise only adds."""
    times = []
    for _ in range(repeats):
        start = clock()
        run()
        times.append(clock() - start)
    return min(times)


def closed_form(targets: torch.Tensor) -> list[list[np.ndarray]]:
    """All solutions of ur-analytic-ik (C++). Its base is world turned by pi."""
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    T = turn @ se3.orthonormalise(targets.double()).cpu().numpy() @ np.linalg.inv(load_robot().T_flange_ee)
    return [ur_analytic_ik.ur5e.inverse_kinematics(np.ascontiguousarray(pose)) for pose in T]


def completeness(report: Report, result: IkResult, oracle: list[list[np.ndarray]]) -> None:
    q, valid, reachable = result.q.double().cpu().numpy(), result.valid.cpu().numpy(), result.reachable.cpu().numpy()
    missed = branches = found = 0
    for i, solutions in enumerate(oracle):
        missed += bool(solutions) and not reachable[i]
        branches += len(solutions)
        mine = q[i][valid[i]]
        for s in solutions:
            found += (
                bool((np.abs((mine - s + np.pi) % (2 * np.pi) - np.pi).max(axis=1, initial=0) < 1e-3).any())
                if len(mine)
                else 0
            )
    report.add("ik.missed", missed)
    report.add("ik.branch_completeness", found / branches)


def pseudo_inverse(robot: Robot, targets: torch.Tensor, restarts: int) -> torch.Tensor:
    """Whether PseudoInverseIK finds each target (N,) at its default tolerances (1 mm and 0.01 rad)."""
    limits = torch.from_numpy(np.stack([robot.lower, robot.upper], 1)).to(targets)
    torch.manual_seed(0)  # its seeds come from the global generator
    solver = pytorch_kinematics.PseudoInverseIK(
        reference_chain(robot, device=targets.device), max_iterations=30, num_retries=restarts, joint_limits=limits,
        regularlization=1e-6, early_stopping_any_converged=True, early_stopping_no_improvement="all",
    )  # fmt: skip
    return solver.solve(pytorch_kinematics.Transform3d(matrix=targets)).converged_any


def run(args: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    torch.set_num_threads(1)
    targets = make_targets(args.targets).to(args.device)
    on_cpu = targets.device.type == "cpu"
    clock = time.process_time if on_cpu else time.perf_counter

    def solve() -> IkResult:
        with on_threads(1):
            result = solve_ik(targets)
        if not on_cpu:
            torch.cuda.synchronize()
        return result

    report.add("ik.targets", args.targets)
    seconds = best_time(solve, clock) / args.targets
    oracle = closed_form(targets)
    completeness(report, solve(), oracle)
    some = torch.randperm(args.targets, generator=torch.Generator().manual_seed(0))[: args.reference_targets]
    some = some.to(targets.device)
    solvable = torch.tensor([bool(s) for s in oracle], device=targets.device)[some]
    reference = partial(pseudo_inverse, load_robot(), targets[some].contiguous(), 20)
    report.add("ik.success_of_pytorch_kinematics", float((reference() & solvable).sum() / solvable.sum()))
    report.add("ik.ratio_to_pytorch_kinematics", best_time(reference, clock, repeats=3) / len(some) / seconds)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--targets": {"default": 100_000, "help": "default: 100000"},
        "--reference-targets": {"default": 1000, "help": "for PseudoInverseIK; default: 1000"},
    },
    peer="pytorch-kinematics' PseudoInverseIK, ur-analytic-ik",
)

if __name__ == "__main__":
    BENCH.main()
