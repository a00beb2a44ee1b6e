"""Trains the contact network for objects that are not one of the sixteen of r2h-v1:
``python -m r2h_batch.assets.families.train_contacts --training build/families``.

It learns from training instances of the families only, in the object's own axes
(``r2h_batch.methods.predictors.principal_axes``). Its report, ``voxnet_axes.json``, says how well it predicts where people
touch, and the receiver's region: on the shipped instances as they lie and turned, on the sixteen built-in
objects, and, with ``--left-out``, on categories that it never saw.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from scipy.stats import rankdata
from torch import Tensor

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.receiving.contact_maps import contact_map
from r2h_batch.methods.predictors.contacts import CONTACT_THRESHOLD, SHIPPED_FILE
from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.methods.predictors.principal_axes import (
    FLIPS,
    STORED_FILE,
    InPrincipalAxes,
    load_axes_network,
    turned_grid,
)
from r2h_batch.methods.predictors.voxnet import VoxNet
from r2h_batch.scene.arrays import read_arrays
from r2h_batch.scene.objects import INSTANCE_NAMES, VOXELS, ObjectModel, load_objects, read_object, with_words
from r2h_batch.scene.solid import solid_occupancy

HERE = Path(__file__).resolve().parent
STEPS, BATCH, RATE = 1000, 4, 3e-3
SIZE = (0.85, 1.15)
"""Objects are also taken as smaller or larger than they are: people hold them at the same places."""
TURNS = {
    "as it lies": np.eye(3),
    "a turn of 0.7 rad about (1, 1, 1)": None,
}


class Examples:
    """Objects as the network sees them: occupancy in the four turned grids (bits), voxels of the cloud, contact."""

    def __init__(self, objects: Sequence[ObjectModel]) -> None:
        self.objects = list(objects)
        self.contact = [torch.from_numpy(contact_map(o)) for o in self.objects]
        self.turned: list[list[tuple[NDArray[np.uint8], float, Tensor]]] = []
        for o in self.objects:
            (grid,) = contact_grids([o])
            point = (voxel_of_points(o).float() + 0.5) * (2.0 / VOXELS) - 1.0
            views = []
            for flip in FLIPS:
                seen, affine = turned_grid(grid, flip)
                at = point @ affine[:, :3].T + affine[:, 3]
                voxel = ((at + 1) * (VOXELS / 2)).long().clamp(0, VOXELS - 1)
                views.append((np.packbits(seen[0].numpy() > 0.5), float(seen[4, 0, 0, 0]), voxel))
            self.turned.append(views)
        self.place = grid[1:4].clone()

    def input(self, i: int, flip: int, size: float) -> tuple[Tensor, Tensor]:
        """The network's input of an object in one of its four grids, and the voxels of its cloud."""
        bits, scale, voxel = self.turned[i][flip]
        full = np.unpackbits(bits, count=VOXELS**3).reshape((VOXELS,) * 3)
        grid = torch.empty((5, VOXELS, VOXELS, VOXELS))
        grid[0], grid[1:4], grid[4] = torch.from_numpy(full), self.place, scale * size
        return grid, voxel


def train(data: Examples, rows: Sequence[int], steps: int, seed: int) -> tuple[VoxNet, list[float]]:
    """A network after `steps` batches of the given objects, and the loss of each."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    net = VoxNet()
    mean = torch.cat([data.contact[i] for i in rows]).mean()
    torch.nn.init.constant_(net.out.bias, float(torch.logit(mean)))  # type: ignore[arg-type]
    optimizer = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.15)
    order: list[int] = []
    losses: list[float] = []
    for step in range(steps):
        while len(order) < BATCH:
            order += [rows[int(k)] for k in torch.randperm(len(rows), generator=generator)]
        chosen, order = order[:BATCH], order[BATCH:]
        u = torch.rand((BATCH, 2), generator=generator)
        seen = [
            data.input(i, int(4 * a), SIZE[0] + (SIZE[1] - SIZE[0]) * float(b))
            for i, (a, b) in zip(chosen, u, strict=True)
        ]
        grid, voxel = (torch.stack(part) for part in zip(*seen, strict=True))
        contact = torch.stack([data.contact[i] for i in chosen])
        loss = torch.nn.functional.binary_cross_entropy_with_logits(net.logits_at(grid, voxel), contact)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if (step + 1) % 50 == 0:
            print(f"step {step + 1}, loss {np.mean(losses[-50:]):.4f}", flush=True)
    return net.eval(), losses


def area(score: NDArray[Any], positive: NDArray[Any]) -> float:
    """Area under the ROC curve; NaN where one class is empty."""
    n = int(positive.sum())
    if n in (0, len(positive)):
        return float("nan")
    return float((rankdata(score)[positive].sum() - n * (n + 1) / 2) / (n * (len(positive) - n)))


def turned(model: ObjectModel, R: NDArray[np.float64]) -> ObjectModel:
    """The object turned by R and voxelised anew, with its cloud in the same order."""

    mesh = model.mesh
    mesh.vertices = mesh.vertices @ R.T
    occupied, origin, pitch = solid_occupancy(mesh, VOXELS)
    points = (model.points @ R.T).astype(np.float32)
    return replace(
        model, points=points, voxels=np.packbits(occupied.reshape(-1)), voxel_origin=origin, voxel_pitch=pitch
    )


def figures(net: VoxNet, objects: Sequence[ObjectModel]) -> dict[str, dict[str, float]]:
    """Turn -> mean area under the curve of contact (all objects), and of the receiver's region (S1)."""
    whole = InPrincipalAxes(net)
    found: dict[str, dict[str, float]] = {}
    axis = np.array([1.0, 1.0, 1.0]) / np.sqrt(3)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    for name, R in TURNS.items():
        turn = np.eye(3) + np.sin(0.7) * K + (1 - np.cos(0.7)) * K @ K if R is None else R
        contact, region = [], []
        for o in objects:
            model = o if name == "as it lies" else turned(o, turn)
            x, y, z = voxel_of_points(model).T
            with torch.no_grad():
                answer = whole(contact_grids([model]))[0, x, y, z].numpy()
            contact.append(area(answer, contact_map(o) >= CONTACT_THRESHOLD))
            if o.split == "S1":
                region.append(area(answer, o.receiver_face[o.point_face]))
        found[name] = {"contact": round(float(np.nanmean(contact)), 3)}
        if region:
            found[name]["region"] = round(float(np.nanmean(region)), 3)
    return found


def answer(whole: InPrincipalAxes, objects: Sequence[ObjectModel], known: Mapping[str, NDArray[Any]]) -> None:
    """Stores what the network answers for these objects, beside known answers, so that nobody computes it on first use."""
    answers: dict[str, NDArray[Any]] = {**known, "network": np.array(whole.digest)}
    for o in objects:
        x, y, z = voxel_of_points(o).T
        with torch.no_grad():
            answers[o.name] = whole(contact_grids([o]))[0, x, y, z].numpy()
    write_npz(HERE / SHIPPED_FILE, answers)


def main() -> None:
    """Writes the weights, the answers for the shipped instances and the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--training", type=Path, default=Path("build/families"))
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--left-out", nargs="*", default=[],
        help="also train without these categories in turn, several together as A,B,C, for the report alone",
    )  # fmt: skip
    parser.add_argument("--left-out-steps", type=int, default=STEPS)
    parser.add_argument("--only-left-out", action="store_true", help="keep the stored weights")
    parser.add_argument(
        "--answers", nargs="+", metavar="INSTANCE", help="only the stored network's answers for these anew"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    if args.answers:
        answer(load_axes_network(), load_objects(args.answers), read_arrays(HERE / SHIPPED_FILE))
        return
    files = sorted(args.training.glob("*_t[0-9][0-9].npz"))
    category = [f.stem.rpartition("_")[0] for f in files]
    data = Examples([with_words(read_object(str(f)), c) for f, c in zip(files, category, strict=True)])
    path = HERE / "voxnet_axes.json"
    report = json.loads(path.read_text()) if args.only_left_out else {}
    if not args.only_left_out:
        net, losses = train(data, range(len(files)), args.steps, args.seed)
        save_file({k: v.contiguous() for k, v in net.state_dict().items()}, HERE / STORED_FILE)
        (HERE / STORED_FILE).chmod(0o644)
        tests = load_objects(INSTANCE_NAMES)
        answer(InPrincipalAxes(net), tests, {})
        report |= {
            "sha256": hashlib.sha256((HERE / STORED_FILE).read_bytes()).hexdigest(),
            "training_instances": len(files), "steps": args.steps, "seed": args.seed,
            "loss": [round(float(np.mean(losses[k : k + 50])), 4) for k in range(0, len(losses), 50)],
            "unseen_instances": figures(net, tests), "built_in_objects": figures(net, load_objects()),
            "exact_maps": {"region": round(float(np.nanmean([
                area(contact_map(o), o.receiver_face[o.point_face]) for o in tests if o.split == "S1"
            ])), 3)},
        }  # fmt: skip
        report["cpu_seconds"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_utime)
        path.write_text(json.dumps(report, indent=1) + "\n")
    for group in args.left_out:
        names = group.split(",")
        if unknown := [n for n in names if n not in category]:
            parser.error(
                f"--left-out: no training instance of {unknown[0]!r}; there are {', '.join(sorted(set(category)))}"
            )
        seen = [i for i, c in enumerate(category) if c not in names]
        net, _ = train(data, seen, args.left_out_steps, args.seed)
        for name in names:
            tests = load_objects([n for n in INSTANCE_NAMES if n.rpartition("_")[0] == name])
            others = [n for n in names if n != name]
            more = {"together_with": others, "steps": args.left_out_steps, "instances": len(seen)}
            found = figures(net, tests) | more
            report.setdefault("left_out", {})[name] = found
            print(name, found, flush=True)
        path.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
