"""Trains a small network through the judge, with the whole step under torch.compile: python examples/compiled_step.py

The network sees the grasp, the hand and a random handover pose, and says a twist that corrects the pose. Its loss is the judge's
soft score, so the gradient of a step passes through the verdict. `--backend inductor` needs a C++ compiler.
"""

import argparse
import time

import torch
from torch import Tensor, nn

from r2h_batch import Evaluator, Trials, load_benchmark
from r2h_batch.base import twist
from r2h_batch.methods.random import predict


def main(argv: list[str] | None = None) -> dict[str, float]:
    """Share of poses that pass the pose stage before and after, on the trials that it learns from."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--trials", type=int, default=64, help="of each split")
    parser.add_argument("--backend", default="aot_eager", help="of torch.compile: aot_eager, or inductor")
    args = parser.parse_args(argv)
    torch.manual_seed(0)
    benchmark = load_benchmark()
    trials = benchmark.trials(args.trials)
    evaluator = Evaluator(benchmark, threads=1)
    start = predict(trials, evaluator.scene, seed=1)
    last = nn.Linear(128, 6)
    network = nn.Sequential(nn.Linear(36, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU(), last)
    nn.init.zeros_(last.weight), nn.init.zeros_(last.bias)  # it begins with the poses as they are
    adam = torch.optim.Adam(network.parameters(), lr=2e-3)
    scale = torch.tensor([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # a twist: three metres, then three radians

    def loss(T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials) -> tuple[Tensor, Tensor]:
        seen = torch.cat([T[:, :3].flatten(1) for T in (T_obj_ee, T_world_ee, trials.T_world_hand)], 1)
        T_better = twist.retract(T_world_ee, scale * network(seen))
        scores = evaluator.score(T_obj_ee, T_better, trials, stages="pose")
        return -scores.soft(temperature_m=0.01, log=True).mean(), scores.success

    compiled = torch.compile(loss, backend=args.backend, fullgraph=True)
    passed, clock = [], time.perf_counter()
    for step in range(args.steps):
        value, success = compiled(start.T_obj_ee, start.T_world_ee, trials)
        adam.zero_grad()
        value.backward()
        adam.step()
        passed.append(success.float().mean().item())
        if step % 50 == 0:
            print(f"step {step}: loss {value.item():.2f}, {passed[-1]:.1%} pass the pose stage", flush=True)
    print(
        f"{args.steps} compiled steps in {time.perf_counter() - clock:.1f} s: {passed[0]:.1%} passed, {passed[-1]:.1%} do now"
    )
    return {"before": passed[0], "after": passed[-1]}


if __name__ == "__main__":
    main()
