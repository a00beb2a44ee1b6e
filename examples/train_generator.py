"""Trains a small generator of handovers on what the evaluator lets pass, and samples it plain, best of N, and guided.

    python examples/train_generator.py            # about 10 minutes on two CPU cores, figure and JSON in runs/generator

The generator sees an object's point cloud and where the palm is; four objects are held out and only used to test.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from generator import CLOUD, SEEN, Flow, cloud_in, to_numbers, to_pose
from handovers import Clouds, Examples, collect, palm_frames
from torch import Tensor

from r2h_batch import Evaluator, Trials, load_benchmark, reward
from r2h_batch.base import se3
from r2h_batch.report.statistics import wilson_interval

HELD_OUT = ("cup", "game_controller", "screwdriver", "bottle")
TEMPERATURE_M = 0.005


@dataclass
class Generator:
    """The two flows, and how they are conditioned."""

    grasp: Flow
    pose: Flow
    clouds: Clouds
    random: torch.Generator

    def state(self, spent: dict[str, float]) -> dict[str, Any]:
        """All weights, and what training them took."""
        return {"grasp": self.grasp.state_dict(), "pose": self.pose.state_dict(), "spent": spent}

    def load(self, state: dict[str, Any]) -> dict[str, float]:
        """Takes over the weights of `state`; returns what training them took."""
        self.grasp.load_state_dict(state["grasp"])
        self.pose.load_state_dict(state["pose"])
        return state["spent"]

    def _seed(self, n: int) -> Tensor:
        return torch.randint(0, SEEN, (n, CLOUD // 2), generator=self.random)

    def around(self, objects: Tensor, point: Tensor) -> tuple[Tensor, Tensor]:
        """The frame at a surface point, and the cloud seen from it."""
        T_obj_point = self.clouds.point_frames(objects, point)
        return T_obj_point, cloud_in(T_obj_point, *self.clouds.rows(objects), self._seed(len(point)))

    def held(self, T_obj_ee: Tensor, objects: Tensor, stands: Tensor) -> tuple[Tensor, Tensor]:
        """The cloud as the gripper sees it, and what else decides the pose: the palm, where the object's middle is."""
        cloud = cloud_in(T_obj_ee, *self.clouds.rows(objects), self._seed(len(objects)))
        middle = se3.apply(se3.inverse(T_obj_ee), self.clouds.middle(objects))
        return cloud, torch.cat([stands, middle * 10], -1)

    def lessons(self, data: Examples, evaluator: Evaluator) -> list[Tensor]:
        """Inputs of training for all examples, computed once: clouds and numbers to be reached."""
        parts = []
        for rows in torch.arange(len(data.point)).split(1024):
            trials, T_obj_ee, T_world_ee = data.trials[rows], data.T_obj_ee[rows], data.T_world_ee[rows]
            objects = trials.object_index
            T_obj_point, cloud = self.around(objects, data.point[rows])
            elsewhere = torch.randint(0, SEEN, (len(rows),), generator=self.random)
            T_world_palm, stands = palm_frames(evaluator, trials)
            handed = self.from_ee(se3.matmul(se3.inverse(T_world_palm), T_world_ee), T_obj_ee, objects)
            grasp = to_numbers(se3.matmul(se3.inverse(T_obj_point), T_obj_ee))
            held = self.held(T_obj_ee, objects, stands)
            parts.append((cloud, self.around(objects, elsewhere)[1], grasp, *held, to_numbers(handed)))
        return [torch.cat(column) for column in zip(*parts, strict=True)]

    def loss(self, lessons: list[Tensor], rows: Tensor) -> Tensor:
        """Both flows' and the surface points' logits'."""
        cloud, other, grasp, held, more, handed = (x[rows] for x in lessons)
        code = self.grasp.encoder(cloud)
        softplus = torch.nn.functional.softplus
        chosen = softplus(-self.grasp.logit(code)) + softplus(self.grasp.logit(self.grasp.encoder(other)))
        condition = torch.cat([self.pose.encoder(held), more], -1)
        return (
            self.grasp.loss(grasp, code, self.random)
            + self.pose.loss(handed, condition, self.random)
            + 0.2 * chosen.mean()
        )

    def from_ee(self, T_palm_ee: Tensor, T_obj_ee: Tensor, objects: Tensor) -> Tensor:
        """The ee frame's turn, at the place of the object's middle: what is to be near the palm."""
        middle = se3.apply(se3.inverse(T_obj_ee), self.clouds.middle(objects))
        return se3.from_rotation(T_palm_ee[:, :3, :3], se3.apply(T_palm_ee, middle))

    def to_ee(self, T_palm_middle: Tensor, T_obj_ee: Tensor, objects: Tensor) -> Tensor:
        """The inverse of `from_ee`."""
        middle = se3.apply(se3.inverse(T_obj_ee), self.clouds.middle(objects))
        turned = se3.from_rotation(T_palm_middle[:, :3, :3], torch.zeros_like(middle))
        return se3.from_rotation(T_palm_middle[:, :3, :3], T_palm_middle[:, :3, 3] - se3.apply(turned, middle))

    def sample(self, evaluator: Evaluator, trials: Trials, *, guide_steps: int = 0) -> tuple[Tensor, Tensor]:
        """One handover for each trial; with guidance, the last numbers of both flows climb the soft score."""
        objects = trials.object_index
        with torch.no_grad():
            tries = torch.stack([torch.randint(0, SEEN, (len(objects),), generator=self.random) for _ in range(24)], 1)
            codes = (self.grasp.encoder(self.around(objects, tries[:, k])[1]) for k in range(24))
            logits = torch.cat([self.grasp.logit(code) for code in codes], 1)
            pick = torch.multinomial(torch.softmax(logits, 1), 1, generator=self.random)
            T_obj_point, cloud = self.around(objects, tries.gather(1, pick)[:, 0])
            T_world_palm, stands = palm_frames(evaluator, trials)
            x = self.grasp.sample(self.grasp.encoder(cloud), self.random)
            T_obj_ee = se3.matmul(T_obj_point, to_pose(x))
            held, more = self.held(T_obj_ee, objects, stands)
            y = self.pose.sample(torch.cat([self.pose.encoder(held), more], -1), self.random)

        def poses(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
            T_obj_ee = se3.matmul(T_obj_point, to_pose(x))
            T_world_ee = se3.matmul(T_world_palm, self.to_ee(to_pose(y), T_obj_ee, objects))
            return T_obj_ee.contiguous(), T_world_ee.contiguous()

        if guide_steps:
            x, y = guided(evaluator, trials, poses, x, y, guide_steps)
        with torch.no_grad():
            T_obj_ee, T_world_ee = poses(x, y)
        return se3.orthonormalise(T_obj_ee).contiguous(), se3.orthonormalise(T_world_ee).contiguous()


def guided(
    evaluator: Evaluator,
    trials: Trials,
    poses: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    x: Tensor,
    y: Tensor,
    steps: int,
) -> tuple[Tensor, Tensor]:
    """The flows' numbers moved along the gradient of the evaluator's soft score; the best on the way is kept."""
    z = torch.cat([x, y], 1).detach().requires_grad_(True)
    climb = torch.optim.Adam([z], lr=0.12, betas=(0.8, 0.95))
    best, kept = torch.full((len(z),), -torch.inf), z.detach().clone()
    for _ in range(steps):
        T_obj_ee, T_world_ee = poses(z[:, :9], z[:, 9:])
        scores = evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")
        soft = scores.soft(temperature_m=TEMPERATURE_M, log=True)
        better = soft.detach() > best
        best, kept = torch.where(better, soft.detach(), best), torch.where(better[:, None], z.detach(), kept)
        climb.zero_grad()
        (-soft.sum()).backward()
        climb.step()
    return kept[:, :9], kept[:, 9:]


def train(evaluator: Evaluator, data: Examples, clouds: Clouds, *, steps: int, batch: int, seed: int) -> Generator:
    """The generator after `steps` of Adam."""
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    model = Generator(Flow(0), Flow(8 + 3), clouds, random)
    lessons = model.lessons(data, evaluator)
    weights = [*model.grasp.parameters(), *model.pose.parameters()]
    adam = torch.optim.AdamW(weights, lr=1e-3, weight_decay=1e-4)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(adam, max(steps, 1))
    shown = 0.0
    for step in range(steps):
        rows = torch.randint(0, len(data.point), (batch,), generator=random)
        loss = model.loss(lessons, rows)
        adam.zero_grad()
        loss.backward()
        adam.step()
        decay.step()
        shown = loss.item() if step == 0 else 0.98 * shown + 0.02 * loss.item()
        if step % 200 == 0:
            print(f"step {step}: loss {shown:.3f}", flush=True)
    return model


def judged(evaluator: Evaluator, ways: dict, trials: Trials) -> dict[str, dict]:
    """How many trials each way passes, on the whole benchmark, with 95 % intervals; printed as they come."""
    rates: dict[str, dict[str, Any]] = {}
    for name, (g, h) in ways.items():
        scores = evaluator.score(g.contiguous(), h.contiguous(), trials)  # the whole benchmark
        passed = int(scores.success.sum())
        low, high = wilson_interval(passed, len(trials))
        rates[name] = {
            "passed": passed,
            "trials": len(trials),
            "rate": passed / len(trials),
            "low": float(low),
            "high": float(high),
        }
        rates[name]["outcomes"] = torch.bincount(scores.outcome.long(), minlength=8).tolist()
        print(
            f"{name:20s} {passed / len(trials):6.1%}  [{float(low):.1%}, {float(high):.1%}] of {len(trials)} trials",
            flush=True,
        )
    return rates


def options(argv: list[str] | None) -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--proposals", type=int, default=60_000)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--batch", type=int, default=192)
    parser.add_argument("--trials", type=int, default=500, help="of each split; those on held-out objects are judged")
    parser.add_argument("--candidates", type=int, default=16, help="N of best-of-N, and the steps of guidance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--weights", type=Path, help="kept here; where the file exists, nothing is trained")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/generator"), help="training_loop.png, results/training_loop.json"
    )
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> dict[str, object]:
    args = options(argv)
    torch.set_num_threads(1)  # the networks are small: more threads mostly wait for each other, or for busy cores
    random = torch.Generator().manual_seed(args.seed)
    evaluator = Evaluator(load_benchmark("r2h-v1"))
    clouds = Clouds.of(evaluator)
    names = [o.name for o in evaluator.scene.objects]
    held_out = torch.tensor([names.index(n) for n in HELD_OUT])
    training = torch.tensor([i for i in range(len(names)) if i not in held_out.tolist()])

    clock, cpu = [time.perf_counter()], [time.process_time()]
    data = collect(evaluator, clouds, args.proposals, training, random)
    clock.append(time.perf_counter())
    cpu.append(time.process_time())
    print(f"{len(data.point)} examples of {args.proposals} proposals in {clock[1] - clock[0]:.0f} s", flush=True)
    if args.weights is not None and args.weights.exists():
        model = train(evaluator, data, clouds, steps=0, batch=args.batch, seed=args.seed)
        spent = model.load(torch.load(args.weights, weights_only=True))
    else:
        model = train(evaluator, data, clouds, steps=args.steps, batch=args.batch, seed=args.seed)
        spent = {"seconds": time.perf_counter() - clock[-1], "core_seconds": time.process_time() - cpu[-1]}
        if args.weights is not None:
            torch.save(model.state(spent), args.weights)
    print("trained in {seconds:.0f} s ({core_seconds:.0f} core-seconds)".format(**spent), flush=True)
    clock.append(time.perf_counter())
    cpu.append(time.process_time())

    model.random.manual_seed(args.seed + 1)  # the same samples whether trained now or before
    trials = load_benchmark("r2h-v1").trials(args.trials, splits=["S0", "S1"])
    trials = trials[torch.isin(trials.object_index, held_out.int())]
    plain = model.sample(evaluator, trials)
    many = [model.sample(evaluator, trials) for _ in range(args.candidates)]
    T_obj_ee, T_world_ee = (torch.stack([pair[i] for pair in many], 1) for i in range(2))
    best = reward.best_of_k(
        reward.quality(evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")), args.candidates
    )
    rows = torch.arange(len(trials))
    ways = {
        "plain": plain,
        f"best of {args.candidates}": (T_obj_ee[rows, best], T_world_ee[rows, best]),
        f"guided, {args.candidates} steps": model.sample(evaluator, trials, guide_steps=args.candidates),
    }
    clock.append(time.perf_counter())
    cpu.append(time.process_time())
    rates = judged(evaluator, ways, trials)
    stages = ("collect", "train", "sample")
    seconds, core = (dict(zip(stages, np.diff(x).round(1).tolist(), strict=True)) for x in (clock, cpu))
    seconds["train"], core["train"] = round(spent["seconds"], 1), round(spent["core_seconds"], 1)
    result = {
        "held_out": HELD_OUT,
        "examples": len(data.point),
        "seconds": seconds,
        "core_seconds": core,
        "rates": rates,
        "options": {k: v for k, v in vars(args).items() if not isinstance(v, Path)},
    }
    (args.out / "results").mkdir(parents=True, exist_ok=True)
    (args.out / "results" / "training_loop.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(rates, args.out / "training_loop.png")
    return result


def draw(rates: dict, path: Path) -> None:
    """Bars with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    at = range(len(rates))
    heights = [100 * r["rate"] for r in rates.values()]
    spread = [
        [100 * (r["rate"] - r["low"]) for r in rates.values()],
        [100 * (r["high"] - r["rate"]) for r in rates.values()],
    ]
    axes.bar(at, heights, width=0.55, color=["#9aa5b1", "#4c78a8", "#54a24b"])
    axes.errorbar(at, heights, yerr=spread, fmt="none", ecolor="#222222", capsize=5, lw=1.2)
    for i, (h, up) in enumerate(zip(heights, spread[1], strict=True)):
        axes.annotate(f"{h:.1f} %", (i, h + up + 2), ha="center")
    axes.set_xticks(list(at), list(rates))
    axes.set_ylim(0, 110)
    axes.set_ylabel("success, held-out objects (%)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=160)
    plt.close(figure)


if __name__ == "__main__":
    main()
