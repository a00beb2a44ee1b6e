"""Trains a small generator of handovers on new instances of the families, and judges it beside random pairs.

    python examples/train_generator.py            # about five minutes of a core, figure and JSON in runs/generator

It sees what methods see: cloud, receiver's region, candidates, estimated hand. It learns from pairs that pass the pose stage
(`training.stream`), and is judged on the benchmark's objects, of which it has seen none. Best of K and guidance ask the judge
while they answer, so they are upper bounds, no methods. Random pairs stand beside both.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from generator import Generator, at_middle, from_middle, held, middle_of, palm_of, to_numbers, to_pose
from torch import Tensor

from r2h_batch import Evaluator, Trials, load_benchmark, reward
from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods.ranker.observe import observe
from r2h_batch.methods.ranker.proposals import NUMBERS, propose
from r2h_batch.report.statistics import wilson_interval
from r2h_batch.training import Seen, stream

BENCHMARK = "r2h-v2"
TEMPERATURE_M = 0.005
TOGETHER = 64
"""Trials whose candidates are ranked at once."""

Poses = tuple[Tensor, Tensor]
"""T_obj_ee and T_world_ee, (N, K, 4, 4)."""


def lessons(families: str, items: int, seed: int) -> list[Tensor]:
    """Clouds (N, K, P, 8), palms (N, 8), middles (N, K, 3), whether the pair passes, numbers of the pose (N, K, 9)."""
    rows = []
    for item in stream(load_benchmark(BENCHMARK), families, items=items, seed=seed):
        cloud, middle = held(item, item["T_obj_ee"])
        T_world_palm, palm = palm_of(item)
        T_palm_ee = se3.matmul(se3.inverse(T_world_palm)[:, None], item["T_world_ee"])
        target = to_numbers(at_middle(T_palm_ee, middle))
        rows.append((cloud.half(), palm, middle, item["success"], target))
    return [torch.cat(column) for column in zip(*rows, strict=True)]


def train(data: list[Tensor], *, steps: int, batch: int, seed: int) -> Generator:
    """The generator after `steps` of Adam."""
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    model = Generator()
    adam = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=1e-4)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, max(steps, 1))
    shown = 0.0
    for step in range(steps):
        rows = torch.randint(0, len(data[0]), (batch,), generator=random)
        cloud, palm, middle, passed, target = (x[rows] for x in data)
        loss = model.loss(model.known(cloud.float(), palm, middle), passed, target, random)
        adam.zero_grad()
        loss.backward()
        adam.step()
        decay.step()
        shown = loss.item() if step == 0 else 0.98 * shown + 0.02 * loss.item()
        if step % 200 == 0:
            print(f"step {step}: loss {shown:.3f}", flush=True)
    return model.eval()


class Sampler:
    """Answers of the generator, and of chance, to trials that both see."""

    def __init__(self, model: Generator, evaluator: Evaluator, trials: Trials, seed: int) -> None:
        self.model, self.evaluator, self.trials = model, evaluator, trials
        self.random = torch.Generator().manual_seed(seed)
        self.seen, _ = observe(trials, evaluator.scene, Seen())
        self.T_world_palm, self.palm = palm_of(self.seen)

    def chance(self, k: int) -> Poses:
        """Random candidates, and the random poses that the generator learned from."""
        weights = self.seen["exists"].float()
        T_obj_ee = self._taken(torch.multinomial(weights, k, replacement=True, generator=self.random))
        u = torch.rand((len(self.trials), k, NUMBERS), generator=self.random, dtype=torch.float64)
        hand = self.seen["ball_center"], self.seen["palm_normal"]
        return T_obj_ee, propose(middle_of(self.seen), *hand, T_obj_ee, u)

    @torch.no_grad()
    def generated(self, k: int) -> tuple[Poses, Tensor, Tensor]:
        """Candidates by their share, a pose of each; also the pose's numbers (N, K, 9) and the middles (N, K, 3)."""
        pick = torch.cat([self._chosen(rows, k) for rows in torch.arange(len(self.trials)).split(TOGETHER)])
        T_obj_ee = self._taken(pick)
        cloud, middle = held(self.seen, T_obj_ee)
        known = self.model.known(cloud, self.palm, middle)
        x = self.model.poses(known.flatten(0, 1), self.random).view(*pick.shape, 9)
        return (T_obj_ee, self._world(x, middle)), x, middle

    def guided(self, steps: int) -> Poses:
        """One sample each, whose pose's numbers climb the judge's soft score; the best on the way is kept."""
        (T_obj_ee, _), x, middle = self.generated(1)
        z = x.detach().requires_grad_(True)
        climb = torch.optim.Adam([z], lr=0.12, betas=(0.8, 0.95))
        best, kept = torch.full((len(z),), -torch.inf), z.detach().clone()
        for _ in range(steps):
            T_world_ee = self._world(z, middle)
            poses = T_obj_ee[:, 0].contiguous(), T_world_ee[:, 0].contiguous()
            scores = self.evaluator.score(*poses, self.trials, "pose")
            soft = scores.soft(temperature_m=TEMPERATURE_M, log=True)
            better = soft.detach() > best
            best = torch.where(better, soft.detach(), best)
            kept = torch.where(better[:, None, None], z.detach(), kept)
            climb.zero_grad()
            (-soft.sum()).backward()
            climb.step()
        return T_obj_ee, self._world(kept, middle)

    def best(self, poses: Poses) -> Poses:
        """The pair of each trial that the judge's pose stage likes best."""
        k, rows = poses[0].shape[1], torch.arange(len(self.trials))
        pick = reward.best_of_k(reward.quality(self.evaluator.score(*poses, self.trials, stages="pose")), k)
        return poses[0][rows, pick][:, None], poses[1][rows, pick][:, None]

    def _taken(self, pick: Tensor) -> Tensor:
        return self.seen["candidates"][torch.arange(len(pick))[:, None], pick].contiguous()

    def _chosen(self, rows: Tensor, k: int) -> Tensor:
        """(n, k) candidates of some trials."""
        own = {name: x[rows] for name, x in self.seen.items()}
        cloud, middle = held(own, own["candidates"])
        logit = self.model.choice(self.model.known(cloud, self.palm[rows], middle))[..., 0]
        share = logit.masked_fill(~own["exists"], -torch.inf).softmax(1)
        return torch.multinomial(share, k, replacement=True, generator=self.random)

    def _world(self, x: Tensor, middle: Tensor) -> Tensor:
        T = se3.matmul(self.T_world_palm[:, None], from_middle(to_pose(x), middle))
        return T if x.requires_grad else se3.orthonormalise(T)


def judged(evaluator: Evaluator, ways: dict[str, Poses], trials: Trials) -> dict[str, dict[str, Any]]:
    """How many trials each way passes, on the whole benchmark, with 95 % intervals; printed as they come."""
    rates: dict[str, dict[str, Any]] = {}
    for name, (T_obj_ee, T_world_ee) in ways.items():
        scores = evaluator.score(T_obj_ee[:, 0].contiguous(), T_world_ee[:, 0].contiguous(), trials)
        passed = int(scores.success.sum())
        low, high = map(float, wilson_interval(passed, len(trials)))
        rates[name] = {"passed": passed, "trials": len(trials), "rate": passed / len(trials), "low": low, "high": high}
        rates[name]["outcomes"] = torch.bincount(scores.outcome.long(), minlength=8).tolist()
        print(f"{name:20s} {passed / len(trials):6.1%}  [{low:.1%}, {high:.1%}] of {len(trials)} trials", flush=True)
    return rates


def options(argv: list[str] | None) -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", default="* x 5 seed 5", help="instances that it learns from")
    parser.add_argument("--items", type=int, default=24, help="of the stream, 4,096 pairs each")
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--batch", type=int, default=32, help="trials of a step, 16 pairs each")
    parser.add_argument("--trials", type=int, default=250, help="of each split")
    parser.add_argument("--candidates", type=int, default=16, help="K of best of K, and the steps of guidance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/generator"), help="training_loop.png, results/training_loop.json"
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> dict[str, object]:
    args = options(argv)
    torch.set_num_threads(1)  # the networks are small: more threads mostly wait for each other, or for busy cores
    core = {}
    start = time.process_time()
    data = lessons(args.families, args.items, args.seed)
    core["labels"] = time.process_time() - start
    print(f"{data[3].numel()} pairs, {data[3].float().mean():.1%} pass, {core['labels']:.0f} core-seconds", flush=True)
    start = time.process_time()
    model = train(data, steps=args.steps, batch=args.batch, seed=args.seed)
    core["train"] = time.process_time() - start
    print(f"trained in {core['train']:.0f} core-seconds", flush=True)

    start = time.process_time()
    benchmark = load_benchmark(BENCHMARK)
    evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    trials = benchmark.trials(args.trials)
    sampler = Sampler(model, evaluator, trials, args.seed + 1)
    k = args.candidates
    some, many = sampler.chance(k), sampler.generated(k)[0]
    ways = {
        "random": (some[0][:, :1], some[1][:, :1]),
        "generator": (many[0][:, :1], many[1][:, :1]),
        f"best of {k} random": sampler.best(some),
        f"best of {k}": sampler.best(many),
        f"guided, {k} steps": sampler.guided(k),
    }
    core["sample"] = time.process_time() - start
    rates = judged(evaluator, ways, trials)
    result = {
        "benchmark": BENCHMARK,
        "pairs": data[3].numel(),
        "core_seconds": {name: round(s, 1) for name, s in core.items()},
        "rates": rates,
        "options": {k: v for k, v in vars(args).items() if not isinstance(v, Path)},
    }
    (args.out / "results").mkdir(parents=True, exist_ok=True)
    (args.out / "results" / "training_loop.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(rates, args.out / "training_loop.png")
    return result


def draw(rates: dict[str, dict[str, Any]], path: Path) -> None:
    """Bars with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    at = range(len(rates))
    heights = [100 * r["rate"] for r in rates.values()]
    spread = [
        [100 * (r["rate"] - r["low"]) for r in rates.values()],
        [100 * (r["high"] - r["rate"]) for r in rates.values()],
    ]
    axes.bar(at, heights, width=0.55, color=["#9aa5b1", "#4c78a8", "#9aa5b1", "#4c78a8", "#54a24b"])
    axes.errorbar(at, heights, yerr=spread, fmt="none", ecolor="#222222", capsize=5, lw=1.2)
    for i, (h, up) in enumerate(zip(heights, spread[1], strict=True)):
        axes.annotate(f"{h:.1f} %", (i, h + up + 2), ha="center")
    axes.set_xticks(list(at), list(rates))
    axes.set_ylim(0, 110)
    axes.set_ylabel("success, objects not seen (%)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=160)
    plt.close(figure)


if __name__ == "__main__":
    main()
