"""What an optimiser can sell as a success: for each aim a fixed search for the worst pose that a benchmark accepts.

`python bench/adversary.py --json bench/results/adversary.json` draws random poses of each trial (a grasp candidate, the object
turned anyhow, one of its points anywhere in the hand's ball), keeps those that pass the pose stage, and goes on from the worst of
them by small twists that pass too, for every aim alone. The worst few are judged with all stages. How bad a pose is stands in
bench/_aims.py. --pictures FOLDER draws the worst of each aim.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _aims import AIMS, Aim, Setting, held, setting
from _report import Report, markdown_table
from run import Bench
from torch import Tensor

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base import se3, twist
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.types import Predictions, Trials

MEASURES = (
    *(
        "bench/adversary.py",
        "bench/_aims.py",
        "kernels/judge",
        "kernels/plan",
        "r2h_batch/judge",
        "r2h_batch/scene",
        "r2h_batch/trials",
    ),
    *("r2h_batch/evaluate.py", "r2h_batch/launching.py", "r2h_batch/stages.py", "r2h_batch/work.py"),
)
BENCHMARKS = ("r2h-v2", "r2h-v3")
KEPT, PARENTS, JUDGED = 48, 16, 12
"""Poses that go on from one round to the next, those that have children, and those that all stages judge."""
STEP_M, STEP_RAD, SHRINKS = 0.03, 0.25, 0.7
"""Standard deviations of a child's twist in the first round; each round shrinks them."""


def rotations(n: int, g: torch.Generator) -> Tensor:
    """(n, 3, 3) uniform."""
    q = torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=1)
    w, x, y, z = q.T
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
    ]
    rows += [2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, 1).view(n, 3, 3)


def drawn(evaluator: Evaluator, trials: Trials, poses: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Grasps and handover poses (N, poses, 4, 4): a point of the object anywhere in the ball, the object turned anyhow."""
    table, scene = candidate_table(evaluator.scene), evaluator.scene
    have, exists = table.rows(trials.object_index)
    _, _, ball = scene.palm(trials.hand_index, trials.T_world_hand)
    grasps, hands = [], []
    for i in range(len(trials)):
        own = have[i][exists[i]]
        A = table.T_obj_ee[own[torch.randint(len(own), (poses,), generator=g)]].float()
        points = torch.from_numpy(np.array(scene.objects[int(trials.object_index[i])].points)).float()
        R, p = rotations(poses, g), points[torch.randint(len(points), (poses,), generator=g)]
        away = torch.nn.functional.normalize(torch.randn(poses, 3, generator=g), dim=1)
        away = 0.0999 * away * torch.rand(poses, 1, generator=g) ** (1 / 3)
        T = se3.from_rotation(R, ball[i] + away - (R @ p[:, :, None])[:, :, 0])
        grasps.append(se3.orthonormalise(A))
        hands.append(se3.orthonormalise(se3.matmul(T, A)))
    return torch.stack(grasps), torch.stack(hands)


@dataclass(frozen=True)
class Pool:
    """Poses of one trial that pass."""

    T_obj_ee: Tensor
    T_world_ee: Tensor
    opening_m: Tensor
    shift_m: Tensor
    body_m: Tensor

    def __getitem__(self, rows: Tensor) -> "Pool":
        return Pool(*(x[rows] for x in vars(self).values()))

    def __add__(self, other: "Pool") -> "Pool":
        ours, theirs = vars(self).values(), vars(other).values()
        return Pool(*(torch.cat(x) for x in zip(ours, theirs, strict=True)))


@dataclass(frozen=True)
class Found:
    """The worst success of a trial: its row, how bad it is, and its poses."""

    row: int
    bad: float
    T_obj_ee: Tensor
    T_world_ee: Tensor


class Search:
    """The worst successes of one trial."""

    def __init__(self, evaluator: Evaluator, trial: Trials, setting: Setting, options: argparse.Namespace) -> None:
        self.evaluator, self.trial, self.setting, self.options = evaluator, trial, setting, options

    def worst(self, aim: Aim, pool: Pool, g: torch.Generator, row: int) -> Found | None:
        """The worst pose that all stages pass, of those that evolution leads to; None: there is none."""
        pool, bad = self._worst_first(aim, pool)
        for r in range(self.options.rounds):
            pool, bad = self._worst_first(aim, pool + self._children(pool, SHRINKS**r, g))
        last = pool[torch.arange(min(JUDGED, len(bad)))]
        passes = self.evaluator.score(last.T_obj_ee[None], last.T_world_ee[None], self.trial).success
        if not passes.any():
            return None
        k = int(torch.nonzero(passes)[0, 0])
        return Found(row, float(bad[k]), last.T_obj_ee[k], last.T_world_ee[k])

    def _worst_first(self, aim: Aim, pool: Pool) -> tuple[Pool, Tensor]:
        bad = aim.bad(self.setting, held(self.setting, **vars(pool)))
        top = bad.argsort(descending=True)[:KEPT]
        return pool[top], bad[top]

    def _children(self, pool: Pool, shrunk: float, g: torch.Generator) -> Pool:
        """Those that pass the pose stage."""
        n = self.options.children
        scale = shrunk * torch.tensor([STEP_M] * 3 + [STEP_RAD] * 3)  # a twist: three metres, then three radians
        parents = pool[torch.randint(min(PARENTS, len(pool.body_m)), (n,), generator=g)]
        moved = se3.orthonormalise(twist.retract(parents.T_world_ee, torch.randn(n, 6, generator=g) * scale))
        scores = self.evaluator.score(parents.T_obj_ee[None], moved[None], self.trial, stages="pose")
        pool = Pool(parents.T_obj_ee, moved, scores.opening_m, scores.grasp_shift_m, scores.body_m)
        return pool[torch.nonzero(scores.success)[:, 0]]


def attacked(name: str, options: argparse.Namespace, report: Report) -> None:
    """Every aim against one benchmark."""
    benchmark = load_benchmark(name)
    evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")), threads=1)
    ids = 2 * options.first + torch.arange(options.trials)
    trials, g = benchmark.trials_with_ids(ids), torch.Generator().manual_seed(options.seed)
    A, B = drawn(evaluator, trials, options.poses, g)
    parts = []
    for lo in range(0, len(trials), 8):  # a call of some thousand rows
        scores = evaluator.score(A[lo : lo + 8], B[lo : lo + 8], trials[lo : lo + 8], stages="pose")
        own = (scores.success, scores.opening_m, scores.grasp_shift_m, scores.body_m)
        parts.append([x.view(-1, options.poses) for x in own])
    success, *rest = (torch.cat(x) for x in zip(*parts, strict=True))
    report.add(f"adversary.{name}.pass_share", float(success.double().mean()))
    found: dict[str, list[Found]] = {aim: [] for aim in AIMS}
    concerned = dict.fromkeys(AIMS, 0)
    for i in range(len(trials)):
        s, ok = setting(evaluator, trials, i), success[i]
        pool = Pool(A[i], B[i], *(x[i] for x in rest))[ok]
        search = Search(evaluator, trials[i : i + 1], s, options)
        for name_of, aim in AIMS.items():
            if aim.concerns(s):
                concerned[name_of] += 1
                one = search.worst(aim, pool, g, i) if ok.any() else None
                found[name_of] += [one] if one else []
    for name_of, aim in AIMS.items():
        told(report, figure_of(name, name_of), aim, found[name_of], concerned[name_of])
    if options.pictures:
        draw(evaluator, trials, found, options.pictures / name)


def figure_of(benchmark: str, aim: str) -> str:
    """What the figures of an aim begin with."""
    return f"adversary.{benchmark}.{aim.replace(' ', '_')}"


def told(report: Report, figure: str, aim: Aim, found: Sequence[Found], concerned: int) -> None:
    """The figures of one aim: trials that it concerns, those with a success, how many are faults, the worst and the median."""
    bad = np.array([f.bad for f in found])
    report.add(f"{figure}.trials", concerned)
    report.add(f"{figure}.successes", len(bad))
    report.add(f"{figure}.faults", int((bad > aim.fault).sum()))
    if len(bad):
        sign = -1 if aim.fault < 0 else 1  # distances: the smallest is the worst
        report.add(f"{figure}.worst", sign * float(bad.max()))
        report.add(f"{figure}.median", sign * float(np.median(bad)))


def draw(evaluator: Evaluator, trials: Trials, found: Mapping[str, Sequence[Found]], folder: Path) -> None:
    """The worst pose of each aim, from two sides and from the person's eyes."""
    import rating

    from r2h_batch.view.drawing import Drawing
    from r2h_batch.view.pictures import save_picture
    from r2h_batch.view.stored import judged_again

    folder.mkdir(parents=True, exist_ok=True)
    for aim, successes in found.items():
        if successes:
            one = max(successes, key=lambda f: f.bad)
            trial = trials[one.row : one.row + 1]
            answer = Predictions(trial.trial_id, one.T_obj_ee[None], one.T_world_ee[None], method=aim)
            drawing = Drawing(judged_again(evaluator, trial, answer, aim))
            save_picture(folder / f"{aim.replace(' ', '_')}.png", rating.picture(drawing))


def run(options: argparse.Namespace, report: Report) -> None:
    """Attacks each benchmark."""
    torch.set_num_threads(1)
    for name in ("trials", "poses", "rounds", "children", "seed", "first"):
        report.add(f"adversary.{name}", getattr(options, name))
    for name in options.benchmarks:
        attacked(name, options, report)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--benchmarks": {"nargs": "+", "default": list(BENCHMARKS), "help": "which benchmarks to attack"},
        "--trials": {"default": 64, "help": "of both splits together"},
        "--first": {"default": 0, "help": "number of the first trial of each split"},
        "--poses": {"default": 256, "help": "random poses of each trial"},
        "--rounds": {"default": 6, "help": "of evolution, for each aim and trial"},
        "--children": {"default": 64, "help": "of a round"},
        "--seed": {"default": 0, "help": "of the search"},
        "--pictures": {"type": Path, "help": "folder for a picture of the worst of each aim"},
    },
    peer="the same search on the other benchmark",
)


def shown(data: Mapping[str, Any]) -> dict[str, str]:
    """A line for each aim: on each benchmark the faults among the trials that it concerns, and the worst."""
    values = data["values"]
    names = [n for n in BENCHMARKS if f"adversary.{n}.pass_share" in values]
    head = ["aim", "what is measured", *(f"{n}: {w}" for n in names for w in ("faults", "worst"))]
    lines = []
    for aim, a in AIMS.items():
        cells: list[object] = [aim, a.what]
        for figure in (figure_of(n, aim) for n in names):
            worst = values.get(f"{figure}.worst")
            cells.append(f"{values[f'{figure}.faults']} of {values[f'{figure}.trials']}")
            cells.append("-" if worst is None else f"{worst:.1f} {a.unit}")
        lines.append(cells)
    shares = " and ".join(f"{100 * values[f'adversary.{n}.pass_share']:.0f} % ({n})" for n in names)
    return {
        "aims": markdown_table(head, lines),
        "pass_share_line": f"Of the random poses {shares} pass the pose stage.",
    }


if __name__ == "__main__":
    BENCH.main()
