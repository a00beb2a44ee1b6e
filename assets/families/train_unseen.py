"""Trains the contact predictors that never saw some categories (needs the ``build`` extra):
``python -m r2h_batch.assets.families.train_unseen``.

Each of four groups of the sixteen categories is left out in turn (`r2h_batch.methods.predictors.unseen.LEFT_OUT`). The trees
of a group learn from the shipped instances of the other twelve categories and from things outside of the sixteen
(`other_things`), all categories alike. ``unseen.json`` says how well they find where people touch, and the receiver's region,
on the categories that they never saw; also without the other things, and without those that look like a left-out category.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from sklearn.ensemble import GradientBoostingRegressor

from r2h_batch.assets.families.other_things import LIKE, THINGS
from r2h_batch.assets.families.train_contacts import area
from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.receiving.contact_maps import contact_map
from r2h_batch.methods.predictors.contacts import CONTACT_THRESHOLD
from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.methods.predictors.shape_features import shape_features
from r2h_batch.methods.predictors.unseen import LEFT_OUT, STORED_FILE, FromShape
from r2h_batch.scene.arrays import read_arrays
from r2h_batch.scene.families.draw import TRAINING, draw_instance, model_of
from r2h_batch.scene.objects import INSTANCE_NAMES, ObjectModel, load_objects

HERE = Path(__file__).resolve().parent
DRAWN = 2
"""Instances of each other thing."""
POINTS = 192
"""Points of an object that the trees learn from, drawn from its cloud: neighbours say the same."""
TREES, RATE, LEAVES, LEAST = 120, 0.08, 12, 40
"""Trees, how much each adds, its leaves, and the least number of points in one."""
FEATURES, ROWS = 0.2, 0.5
"""Share of the features that a split looks at, and of the points that a tree sees."""


class Example(NamedTuple):
    """An object as the trees see it, at its cloud's points."""

    category: str
    features: NDArray[np.float32]
    contact: NDArray[np.float32]
    region: NDArray[np.bool_] | None
    """None: the object has none (S0)"""


def example_of(model: ObjectModel, category: str) -> Example:
    """Features and contact of an object's cloud."""
    (grid,) = contact_grids([model])
    features, voxel = shape_features(grid)
    row = torch.full(grid.shape[1:], -1)
    row[tuple(voxel.T)] = torch.arange(len(voxel))
    at = voxel_of_points(model)
    found = row[tuple(at.T)]
    if bool((beside := found < 0).any()):  # a point of a sharp edge in a voxel that is not full
        found[beside] = torch.cdist(at[beside].float(), voxel.float()).argmin(1)
    region = model.receiver_face[model.point_face] if model.split == "S1" else None
    return Example(category, features[found].numpy(), contact_map(model), region)


def make_examples(path: Path) -> dict[str, Example]:
    """All examples by object, kept in a file: contacts take three CPU seconds an object."""
    stored = dict(read_arrays(path)) if path.exists() else {}
    jobs = [(n, n.rpartition("_")[0]) for n in INSTANCE_NAMES] + [
        (f"{c}_t{i:02d}", c) for i in range(DRAWN) for c in THINGS
    ]
    found: dict[str, Example] = {}
    for k, (name, category) in enumerate(jobs):
        if f"{name}/contact" not in stored:
            model = (
                load_objects([name])[0]
                if name in INSTANCE_NAMES
                else model_of(draw_instance(THINGS[category], TRAINING, int(name[-2:])))
            )
            made = example_of(model, category)
            stored |= {f"{name}/features": made.features, f"{name}/contact": made.contact}
            if made.region is not None:
                stored[f"{name}/region"] = made.region
            print(f"{k + 1} of {len(jobs)}: {name}", flush=True)
            if k % 20 == 0 or k == len(jobs) - 1:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_npz(path, stored)
        found[name] = Example(
            category, stored[f"{name}/features"], stored[f"{name}/contact"], stored.get(f"{name}/region")
        )
    return found


def train(examples: Sequence[Example], seed: int) -> FromShape:
    """Trees that learned from these examples, in which all categories weigh the same."""
    many = Counter(e.category for e in examples)
    draw = np.random.default_rng(seed)
    rows = [np.sort(draw.choice(len(e.contact), POINTS, replace=False)) for e in examples]
    trees = GradientBoostingRegressor(
        n_estimators=TREES, learning_rate=RATE, max_leaf_nodes=LEAVES, min_samples_leaf=LEAST, max_depth=None,
        max_features=FEATURES, subsample=ROWS, random_state=seed,
    )  # fmt: skip
    trees.fit(
        np.concatenate([e.features[r] for e, r in zip(examples, rows, strict=True)]),
        np.concatenate([e.contact[r] for e, r in zip(examples, rows, strict=True)]),
        sample_weight=np.repeat([1.0 / many[e.category] for e in examples], POINTS),
    )
    return FromShape(stored_trees(trees))


def stored_trees(trees: GradientBoostingRegressor) -> dict[str, torch.Tensor]:
    """The trees as arrays (`FromShape`)."""
    found = [t.tree_ for t in trees.estimators_[:, 0]]
    most = max(t.node_count for t in found)
    names = ("feature", "left", "right", "threshold", "value")
    arrays = {k: np.zeros((len(found), most), np.int16 if k in names[:3] else np.float32) for k in names}
    for row, t in enumerate(found):
        n, leaf = t.node_count, t.children_left < 0
        own = np.arange(n)
        arrays["feature"][row, :n] = np.where(leaf, 0, t.feature)
        arrays["left"][row, :n] = np.where(leaf, own, t.children_left)
        arrays["right"][row, :n] = np.where(leaf, own, t.children_right)
        arrays["threshold"][row, :n] = t.threshold
        arrays["value"][row, :n] = RATE * t.value[:, 0, 0]
    start = np.asarray(trees.init_.constant_, np.float32).reshape(1)
    return {k: torch.from_numpy(v) for k, v in (arrays | {"start": start}).items()}


def areas(net: FromShape, examples: Sequence[Example]) -> dict[str, float]:
    """Mean area under the curve of contact, and of the region where there is one."""
    contact, region = [], []
    for e in examples:
        answer = net.of_features(torch.from_numpy(e.features)).numpy()
        contact.append(area(answer, e.contact >= CONTACT_THRESHOLD))
        if e.region is not None:
            region.append(area(answer, e.region))
    found = {"contact": round(float(np.nanmean(contact)), 3)}
    return found | ({"region": round(float(np.nanmean(region)), 3)} if region else {})


POOLS = ("all", "without_look_alikes", "without_other_things")


def pool(name: str, group: Sequence[str], examples: Sequence[Example]) -> list[Example]:
    """The examples for the trees of a group: all but the group; also without what looks like one; also without all things."""
    dropped = {
        "all": set(),
        "without_look_alikes": {thing for c in group for thing in LIKE.get(c, ())},
        "without_other_things": set(THINGS),
    }[name]
    return [e for e in examples if e.category not in dropped | set(group)]


def mean_region(found: Mapping[str, Mapping[str, float]]) -> float:
    """Mean over the categories that have a region."""
    return round(float(np.mean([v["region"] for v in found.values() if "region" in v])), 3)


def main() -> None:
    """Writes the trees and the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--examples", type=Path, default=Path("build/unseen/examples.npz"), help="made where it is not there"
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    examples = make_examples(args.examples)
    weights: dict[str, torch.Tensor] = {}
    report: dict[str, Any] = {
        "trees": TREES, "seed": args.seed, "instances_of_other_things": DRAWN,
        "training_categories": len({e.category for e in examples.values()}) - len(LEFT_OUT[0]), "left_out": {}, "mean_region": {},
    }  # fmt: skip
    for name in POOLS:
        found: dict[str, dict[str, float]] = {}
        for k, group in enumerate(LEFT_OUT):
            net = train(pool(name, group, [*examples.values()]), args.seed)
            if name == "all":
                weights |= {f"{k}/{key}": value for key, value in net.stored.items()}
            for c in group:
                found[c] = areas(net, [e for e in examples.values() if e.category == c])
                print(name, c, found[c], flush=True)
        if name == "all":
            save_file(weights, HERE / STORED_FILE)
            (HERE / STORED_FILE).chmod(0o644)
            report["sha256"] = hashlib.sha256((HERE / STORED_FILE).read_bytes()).hexdigest()
        report["left_out"][name] = found
        report["mean_region"][name] = mean_region(found)
        report["cpu_seconds"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_utime)
        (HERE / "unseen.json").write_text(json.dumps(report, indent=1) + "\n")
    print(report["mean_region"])


if __name__ == "__main__":
    main()
