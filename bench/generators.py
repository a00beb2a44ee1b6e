"""A generator that learns from the verdict alone, on each of two benchmarks: does it succeed on the other one too?

`python bench/generators.py --json bench/results/generators.json` trains a small network on each benchmark: it moves a random
candidate of a trial and a first pose (turned anyhow, the object in the ball), each by a twist. Its loss is minus the log of
`soft` of the pose stage. Then both networks answer trials that neither has seen, of both benchmarks, and all stages judge them.
"""

import argparse
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from _report import Report, markdown_table
from run import Bench
from torch import Tensor, nn

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base import se3, twist
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods import random
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

MEASURES = (
    *("bench/generators.py", "kernels/judge", "kernels/plan", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/trials"),
    *("r2h_batch/evaluate.py", "r2h_batch/launching.py", "r2h_batch/stages.py", "r2h_batch/work.py"),
)
BENCHMARKS = ("r2h-v2", "r2h-v3")
TEMPERATURE_M = 0.02
Poses = tuple[Tensor, Tensor]
"""T_obj_ee and T_world_ee, (N, 4, 4)."""
WEIGHT = (1.0, 1.0, 1.0, 10.0, 10.0, 10.0)
"""10 cm count like one radian."""
OTHER_SEED = 1 << 20
"""Of the candidates and turns that trained networks are given."""


class Generator(nn.Module):
    """Moves a random candidate, and where it is held out first: turned anyhow, the middle of the wanted part in the ball. It
    knows the object by its number, the hand by where palm and ball are."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene, objects = scene, scene.objects
        wanted = [o.faces[o.receiver_face] if o.split == "S1" else o.faces for o in objects]
        middles = [o.vertices[faces].reshape(-1, 3).mean(0) for o, faces in zip(objects, wanted, strict=True)]
        self.middle = torch.from_numpy(np.stack(middles)).float()
        seen, last = 3 * 12 + 3 * 3 + len(objects), nn.Linear(256, 12)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(nn.Linear(seen, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), last)

    def start(self, trials: Trials, seed: int) -> Poses:
        """The poses that it moves."""
        made = random.predict(trials, self.scene, seed=seed)
        grasp, R = made.T_obj_ee, made.T_world_ee[:, :3, :3]
        _, _, ball = self.scene.palm(trials.hand_index, trials.T_world_hand)
        middle = se3.apply(se3.inverse(grasp), self.middle[trials.object_index.long()])
        return grasp, se3.from_rotation(R, ball - (R @ middle[:, :, None])[:, :, 0])

    def forward(self, trials: Trials, seed: int) -> Poses:
        """T_obj_ee and T_world_ee (N, 4, 4) of a seed."""
        poses = torch.stack(self.start(trials, seed), 1)
        _, normal, ball = self.scene.palm(trials.hand_index, trials.T_world_hand)
        middle, hand = self.middle[trials.object_index.long()], trials.T_world_hand
        T_hand_ee = se3.matmul(se3.inverse(hand), poses[:, 1])[:, :3].flatten(1)
        which = nn.functional.one_hot(trials.object_index.long(), len(self.middle)).float()
        seen = torch.cat([poses[:, :, :3].flatten(1), T_hand_ee, middle, normal, ball, which], 1)
        moved = torch.tensor(WEIGHT) * 0.1 * self.layers(seen).view(-1, 2, 6)
        made = twist.retract(poses, moved)
        return made[:, 0], made[:, 1]


def trained(evaluator: Evaluator, trials: Trials, options: argparse.Namespace) -> Generator:
    """The network after all steps; each has some of the trials, and new random pairs."""
    torch.manual_seed(options.seed)
    model = Generator(evaluator.scene)
    adam = torch.optim.Adam(model.parameters(), lr=options.rate)
    for step in range(options.steps):
        some = trials[torch.randperm(len(trials))[: options.batch]]
        T_obj_ee, T_world_ee = model(some, step)
        scores = evaluator.score(T_obj_ee, T_world_ee, some, stages="pose")
        loss = -scores.soft(temperature_m=TEMPERATURE_M, log=True).mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        adam.step()
        if step % 50 == 0 or step == options.steps - 1:
            share = float(scores.success.double().mean())
            print(f"step {step}: loss {loss.item():.3f}, {share:.0%} pass the pose stage", flush=True)
    return model.eval()


def run(options: argparse.Namespace, report: Report) -> None:
    """Trains on each benchmark, and judges on both."""
    torch.set_num_threads(1)
    for name in ("steps", "batch", "trials", "seed", "rate"):
        report.add(f"generators.{name}", getattr(options, name))
    judges, models = {}, {}
    for name in BENCHMARKS:
        benchmark = load_benchmark(name)
        evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")), threads=options.threads)
        asked = benchmark.trials_with_ids(torch.arange(options.trials))
        judges[name] = evaluator, asked
        lessons = benchmark.trials_with_ids(options.trials + torch.arange(options.lessons))
        print(f"on {name}", flush=True)
        models[name] = trained(evaluator, lessons, options)
        T_obj_ee, T_world_ee = Generator(evaluator.scene).start(asked, OTHER_SEED)
        report.add(f"generators.start.on.{name}", int(evaluator.score(T_obj_ee, T_world_ee, asked).success.sum()))
    for of, model in models.items():
        for name, (evaluator, asked) in judges.items():
            with torch.no_grad():
                T_obj_ee, T_world_ee = (se3.orthonormalise(T).contiguous() for T in model(asked, OTHER_SEED))
            success = evaluator.score(T_obj_ee, T_world_ee, asked).success
            report.add(f"generators.{of}.on.{name}", int(success.sum()))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--steps": {"default": 300, "help": "of Adam"},
        "--batch": {"default": 128, "help": "trials of a step"},
        "--lessons": {"default": 256, "help": "trials that it learns from"},
        "--trials": {"default": 128, "help": "trials that are asked afterwards, which it has not seen"},
        "--rate": {"default": 2e-4, "help": "of learning"},
        "--seed": {"default": 0, "help": "of the network and its lessons"},
        "--threads": {"type": int, "help": "CPU threads (default: one per core)"},
    },
    peer="the same network trained on the other benchmark, and before training",
)


def shown(data: Mapping[str, Any]) -> dict[str, str]:
    """Successes of each network on each benchmark, in percent."""
    values = data["values"]
    n = values["generators.trials"]
    lines = [
        [
            "before training" if of == "start" else f"trained on {of}",
            *(f"{100 * values[f'generators.{of}.on.{b}'] / n:.1f}" for b in BENCHMARKS),
        ]
        for of in ("start", *BENCHMARKS)
    ]
    return {"table": markdown_table(["SR, %", *(f"on {b}" for b in BENCHMARKS)], lines)}


if __name__ == "__main__":
    BENCH.main()
