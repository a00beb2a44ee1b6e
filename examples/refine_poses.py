"""Gradient ascent on the soft score: how many failing random candidates become handovers that pass the whole benchmark?

python examples/refine_poses.py --trials 500
"""

import argparse
import contextlib
import time

import torch

from r2h_batch import Evaluator, Predictions, Trials, load_benchmark
from r2h_batch.base import LOGGERS, Logger, twist
from r2h_batch.methods.random import predict

LEVER_M = 0.1
"""A radian counts as much as this many metres."""


def refine(
    evaluator: Evaluator,
    T_obj_ee: torch.Tensor,
    T_world_ee: torch.Tensor,
    trials: Trials,
    *,
    steps: int,
    rate_m: float,
    logger: Logger | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The poses with the best soft score on the way up; Adam on twists, so that every iterate is a pose."""
    scale = torch.tensor([1.0, 1.0, 1.0, *[1 / LEVER_M] * 3])
    pose = torch.stack([T_obj_ee, T_world_ee], 1)
    first, second = torch.zeros(len(pose), 2, 6), torch.zeros(len(pose), 2, 6)
    best, best_pose = torch.full((len(pose),), -torch.inf), pose
    for step in range(steps):
        pose = pose.detach().requires_grad_(True)
        scores = evaluator.score(pose[:, 0], pose[:, 1], trials, stages="pose")
        if logger is not None:
            logger.log(scores.scalars(), step)
        soft = scores.soft(temperature_m=0.005, log=True)
        better = soft.detach() > best
        best, best_pose = (
            torch.where(better, soft.detach(), best),
            torch.where(better[:, None, None, None], pose, best_pose),
        )
        (gradient,) = torch.autograd.grad(soft.sum(), pose)
        slope = twist.tangent(pose.detach(), gradient) * scale  # per metre, also of turning
        first, second = 0.8 * first + 0.2 * slope, 0.95 * second + 0.05 * slope.square().sum(-1, keepdim=True) / 6
        ahead = (first / (1 - 0.8 ** (step + 1))) / ((second / (1 - 0.95 ** (step + 1))).sqrt() + 1e-6)
        rate = rate_m * (1 - step / steps)
        pose = twist.retract(pose.detach(), rate * ahead.clamp(-3, 3) * scale)
    return best_pose[:, 0].detach().contiguous(), best_pose[:, 1].detach().contiguous()


def main(argv: list[str] | None = None) -> tuple[float, float]:
    """Success rates of the whole benchmark before and after, of candidates that failed it before."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200, help="per split")
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--rate-m", type=float, default=0.004)
    parser.add_argument("--log", choices=LOGGERS, help="write outcomes and margins of each step to runs/refine")
    args = parser.parse_args(argv)
    benchmark = load_benchmark()
    trials = benchmark.trials(args.trials, splits=["S0", "S1"])
    evaluator = Evaluator(benchmark)
    start: Predictions = predict(trials, evaluator.scene)
    before = evaluator.score(start.T_obj_ee, start.T_world_ee, trials)
    rows = ~before.success
    trials, start = trials[rows], start[rows]
    clock = time.perf_counter()
    with Logger(args.log, "runs/refine", vars(args)) if args.log else contextlib.nullcontext() as logger:
        refined = refine(
            evaluator, start.T_obj_ee, start.T_world_ee, trials, steps=args.steps, rate_m=args.rate_m, logger=logger
        )
    seconds = time.perf_counter() - clock
    after = evaluator.score(*refined, trials)
    rates = before.success.float().mean().item(), after.success.float().mean().item()
    print(f"{len(before)} random candidates, {before.success.sum()} pass the benchmark ({rates[0]:.1%})")
    print(
        f"{rows.sum()} failing ones refined in {args.steps} steps ({seconds:.1f} s): {after.success.sum()} pass ({rates[1]:.1%})"
    )
    return rates


if __name__ == "__main__":
    main()
