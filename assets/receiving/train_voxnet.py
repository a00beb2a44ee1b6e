"""Trains the built-in contact networks: ``python -m r2h_batch.assets.receiving.train_voxnet``. Some
thirty CPU minutes.

Once with all objects, for objects of users (voxnet.safetensors). And without each object in turn,
for that object: what a method is shown of a built-in object comes from a network that never saw it
(voxnet_left_out.safetensors, float16). voxnet.json says how well both predict. Same kind of machine
and versions, same weights.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import platform
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from safetensors.torch import save_file
from scipy.stats import rankdata
from torch import Tensor

from r2h_batch.assets.receiving.contact_maps import contact_map
from r2h_batch.base.io.log import LOG
from r2h_batch.methods.predictors.contacts import CONTACT_THRESHOLD
from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.methods.predictors.voxnet import LEFT_OUT_FILE, STORED_FILE, VoxNet, halved
from r2h_batch.scene.objects import OBJECT_NAMES, VOXELS, ObjectModel, load_objects
from r2h_batch.trials.holding.receiving import receiving_digest

__all__ = ["main", "train"]

STEPS, LEFT_OUT_STEPS, BATCH, RATE = 900, 350, 4, 4e-3
TILT_DEG, ZOOM = 12.0, (0.75, 1.0)
ANY_ORIENTATION_SHARE = 0.1
"""Share of examples in any of the 48 orientations along the axes; the others are only mirrored in
y: the built-in objects' frames follow one convention (tools along x, vessels upright), and most of
what is to be known needs it."""
SIZE = (0.8, 1.25)
"""Objects are also taken as larger or smaller than they are: a person holds them at the same
places."""
OUT = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Examples:
    """O objects: the network's input, the voxel of each cloud point, and its contact."""

    grid: Float32[Tensor, "o 5 64 64 64"]
    voxel: Int64[Tensor, "o p 3"]
    contact: Float32[Tensor, "o p"]


def examples(objects: Sequence[ObjectModel]) -> Examples:
    """The objects as they are."""
    return Examples(
        contact_grids(objects),
        torch.stack([voxel_of_points(o) for o in objects]),
        torch.stack([torch.from_numpy(contact_map(o)) for o in objects]),
    )


def train(data: Examples, steps: int, seed: int, *, report: str = "") -> tuple[VoxNet, list[float]]:
    """A network after `steps` batches, and the loss of each: cross entropy of contact at the
    cloud's points."""
    torch.manual_seed(seed)
    generator = torch.Generator(device="cpu").manual_seed(seed)
    net = VoxNet()
    torch.nn.init.constant_(net.out.bias, float(torch.logit(data.contact.mean())))  # type: ignore[arg-type]
    optimizer = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.15)
    order = torch.zeros(0, dtype=torch.int64, device="cpu")
    losses: list[float] = []
    begin = time.perf_counter()
    for step in range(steps):
        if len(order) < BATCH:
            order = torch.cat(
                [
                    order,
                    torch.randperm(len(data.grid), generator=generator, dtype=torch.int64, device="cpu"),
                ]
            )
        rows, order = order[:BATCH], order[BATCH:]
        grid, voxel, inside = zip(*(augmented(data, int(i), generator) for i in rows), strict=True)
        logits = net.logits_at(torch.stack(grid), torch.stack(voxel))
        loss = torch.nn.functional.binary_cross_entropy_with_logits(
            logits, data.contact[rows], weight=torch.stack(inside)
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if report and (step + 1) % 50 == 0:
            rate = (time.perf_counter() - begin) / (step + 1)
            LOG.info(f"{report}: step {step + 1}, loss {np.mean(losses[-50:]):.4f}, {rate:.2f} s a step")
    return net.eval(), losses


def augmented(data: Examples, i: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """One example turned or mirrored along the axes, tilted, zoomed and resized: grid, points in
    it, which are inside.

    The points are given by their voxels (P, 3).
    """
    u = torch.rand(8, generator=generator, dtype=torch.float32, device="cpu")
    frame = torch.eye(3, dtype=torch.float32, device="cpu")
    if u[6] < ANY_ORIENTATION_SHARE:
        mirrored = torch.rand(3, generator=generator, dtype=torch.float32, device="cpu") < 0.5
        flip = 1.0 - 2.0 * mirrored.float()
        frame = torch.diag(flip)[torch.randperm(3, generator=generator, dtype=torch.int64, device="cpu")]
    elif u[7] < 0.5:
        frame[1, 1] = -1.0
    turn = torch.nn.functional.normalize(u[:3] - 0.5, dim=0) * np.radians(TILT_DEG) * (2 * u[3] - 1)
    zoom = ZOOM[0] + (ZOOM[1] - ZOOM[0]) * u[4]
    A = zoom * (torch.linalg.matrix_exp(_skew(turn)) @ frame)
    point = (data.voxel[i].float() + 0.5) * (2.0 / VOXELS) - 1.0
    moved = point @ A.T
    back = torch.linalg.inv(A)
    # grid_sample's x is the last axis
    theta = torch.zeros(1, 3, 4, dtype=torch.float32, device="cpu")
    theta[0, :, :3] = back.flip(0).flip(1)
    where = torch.nn.functional.affine_grid(theta, [1, 1, VOXELS, VOXELS, VOXELS], align_corners=False)
    occupancy = torch.nn.functional.grid_sample(data.grid[i : i + 1, :1], where, align_corners=False)[0, 0]
    grid = data.grid[i].clone()
    grid[0] = (occupancy > 0.4).float()
    grid[4] = grid[4] * (SIZE[0] + (SIZE[1] - SIZE[0]) * u[5]) / zoom
    inside = (moved.abs() < 1).all(1)
    return grid, ((moved + 1) * (VOXELS / 2)).long().clamp(0, VOXELS - 1), inside.float()


def figures(net: VoxNet, data: Examples, i: int) -> dict[str, float]:
    """IoU of contact at the threshold, area under the ROC curve, mean absolute error, on the object
    as it is."""
    with torch.no_grad():
        field = net(data.grid[i : i + 1])[0]
    x, y, z = data.voxel[i].T
    found, true = field[x, y, z].numpy(), data.contact[i].numpy()
    a, b = found >= CONTACT_THRESHOLD, true >= CONTACT_THRESHOLD
    return {
        "iou": round(float((a & b).sum() / max(1, (a | b).sum())), 3),
        "auc": round(_auc(found, b), 3),
        "mean_error": round(float(np.abs(found - true).mean()), 3),
        "touched_share": round(float(b.mean()), 3),
    }


def _auc(score: Any, positive: Any) -> float:
    """Share of (positive, negative) pairs in the right order; ties count half."""
    ranks, n = rankdata(score), int(positive.sum())
    if n in (0, len(positive)):
        return float("nan")
    return float((ranks[positive].sum() - n * (n + 1) / 2) / (n * (len(positive) - n)))


def _skew(v: Tensor) -> Tensor:
    x, y, z = v.tolist()
    return torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float32, device="cpu")


@dataclass(frozen=True)
class Run:
    """One training: the objects left out (row numbers; none: the stored weights), steps, seed."""

    left_out: tuple[int, ...]
    steps: int
    seed: int


def trained(run: Run) -> tuple[dict[str, Tensor], list[float], dict[str, dict[str, float]]]:
    """Weights, losses, and figures of the objects left out, or of all; on one thread: the same
    however many run."""
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    objects = load_objects()
    data = examples(objects)
    kept = torch.tensor([i for i in range(len(objects)) if i not in run.left_out], dtype=torch.int64, device="cpu")
    part = Examples(data.grid[kept], data.voxel[kept], data.contact[kept])
    name = ", ".join(objects[i].name for i in run.left_out) or "none"
    net, losses = train(part, run.steps, run.seed, report=f"left out {name}")
    if run.left_out:
        # judged as it is stored
        net.load_state_dict({k: v.float() for k, v in halved(net.state_dict()).items()})
    judged = run.left_out or range(len(objects))
    return dict(net.state_dict()), losses, {objects[i].name: figures(net, data, i) for i in judged}


def main(argv: Sequence[str] | None = None) -> None:
    """Writes the three files and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--left-out-steps", type=int, default=LEFT_OUT_STEPS)
    parser.add_argument(
        "--left-out-only",
        action="store_true",
        help="keep the weights of all objects, train the others again",
    )
    parser.add_argument(
        "--jobs",
        type=int,
        default=2,
        help="trainings at a time, one thread each; the result is the same",
    )
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args(argv)
    begin = time.perf_counter()
    runs = [Run((i,), args.left_out_steps, args.seed + 1 + i) for i in range(len(OBJECT_NAMES))]
    runs = runs if args.left_out_only else [Run((), args.steps, args.seed), *runs]
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        results = list(pool.map(trained, runs))
    cost = {
        "seconds": round(time.perf_counter() - begin),
        "cpu_seconds": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime),
        "jobs": args.jobs,
        "torch": torch.__version__,
        "machine": platform.machine(),
    }
    log_file = args.out / "voxnet.json"
    log = json.loads(log_file.read_text()) if args.left_out_only else _stored(args, *results.pop(0), cost)
    log |= _left_out(args, results, cost)
    log_file.write_text(json.dumps(log, indent=1) + "\n")
    for name in OBJECT_NAMES:
        left, stored = (json.dumps(log[k][name]) for k in ("left_out_figures", "stored_weights"))
        print(f"{name:16s} left out {left}  stored weights {stored}")
    print(json.dumps({k: log[k] for k in ("left_out_mean", "stored_weights_mean", "cost", "left_out_cost")}))


Figures = dict[str, dict[str, float]]


def _stored(
    args: argparse.Namespace,
    weights: dict[str, Tensor],
    losses: list[float],
    fitted: Figures,
    cost: dict[str, Any],
) -> dict[str, Any]:
    """Writes the weights of all objects; what the log says of them."""
    return {
        "sha256": _saved(weights, args.out / STORED_FILE),
        "parameters": sum(v.numel() for v in weights.values()),
        "receiving_digest": receiving_digest(),
        "threshold": CONTACT_THRESHOLD,
        "seed": args.seed,
        "steps": args.steps,
        "batch": BATCH,
        "loss": [round(float(np.mean(losses[k : k + 20])), 4) for k in range(0, len(losses), 20)],
        "stored_weights": fitted,
        "stored_weights_mean": _mean(fitted),
        "cost": cost,
    }


def _left_out(args: argparse.Namespace, results: list[Any], cost: dict[str, Any]) -> dict[str, Any]:
    """Writes the weights that never saw one object each; what the log says of them."""
    found = {name: figure for _, _, figures in results for name, figure in figures.items()}
    weights = {
        f"{name}/{k}": v
        for name, (state, _, _) in zip(OBJECT_NAMES, results, strict=True)
        for k, v in halved(state).items()
    }
    return {
        "left_out_sha256": _saved(weights, args.out / LEFT_OUT_FILE),
        "left_out_steps": args.left_out_steps,
        "left_out_figures": {n: found[n] for n in OBJECT_NAMES},
        "left_out_mean": _mean(found),
        "left_out_cost": cost,
    }


def _saved(weights: dict[str, Tensor], path: Path) -> str:
    """The sha256 of the file that now holds the weights."""
    save_file({k: v.contiguous() for k, v in weights.items()}, path)
    path.chmod(0o644)  # safetensors writes for its owner only
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _mean(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    keys = next(iter(figures.values()))
    return {k: round(float(np.nanmean([f[k] for f in figures.values()])), 3) for k in keys}


if __name__ == "__main__":
    main()
