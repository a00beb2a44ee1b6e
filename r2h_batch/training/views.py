"""Shards of what depth cameras see of new instances, with labelled pairs, in HDF5: data to learn methods that see from."""

import json
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.write import atomic_path, write_text
from r2h_batch.base.package import VERSION
from r2h_batch.methods import oracle
from r2h_batch.observe.seen import LABELS
from r2h_batch.observe.sees import Sees
from r2h_batch.observe.shards import CLOUD, DEPTH_STEP_M, FORMAT, seen_arrays, write_shard
from r2h_batch.training.pairs import Pairs
from r2h_batch.verdicts import CRITERIA

ORACLE_ROUNDS = 16
"""Proposals that the search for a good handover has for a trial: it finds one for nearly all."""

CARD = """# Views of handovers, to learn from

Written by r2h_batch {version}, format {format}: `shard-NNNNNN.h5`, {trials} trials each with {pairs} labelled pairs of grasp
and handover pose.

- benchmark of people, robot and limits: {benchmark}
- objects: {objects} new instances ({families}), seed {seed}
- seen: {sees}

| dataset | shape | what |
|---|---|---|
| `object/depth`, `hand/depth` | (N, C, H, W) uint16 | depth along the camera's z axis, {step} m; 0: nothing |
| `object/label`, `hand/label` | (N, C, H, W) uint8 | {labels}, in this order from 0 |
| `object/K`, `hand/K` | (N, C, 3, 3) | intrinsics of the windows, pixels |
| `T_world_camera` | (N, C, 4, 4) | believed poses of the cameras, m |
| `cloud/points`, `cloud/mask` | (N, {cloud}, 3), (N, {cloud}) | the object's points in the world, m |
{told}| `receiver/palm`, `normal`, `along`, `left` | (N, 3), (N,) | the estimated hand |
| `pairs/T_world_grasp`, `pairs/T_world_ee` | (N, K, 4, 4) | grasp at the moment, handover pose, m |
| `pairs/success`, `labels`, `margin` | (N, K), (N, K, 5) | verdicts of the pose stage ({criteria}; NaN: not evaluated) |
| `oracle/...` | as `pairs` with K = 1 | the best of {rounds} proposals that know the truth |
| `truth/...` | | trial, object, where object and hand are: for analysis, not for a method's input |

Verdicts are those of the true object and hand. Frames are `T_a_b`, axes as in the documentation (docs/observe.md).
"""


TOLD = """| `object/region`, `cloud/region` | as `object/label`, `cloud/mask` | in the receiver's region, for a part labeller |
"""


def write_views(
    pairs: Pairs,
    sees: Sees,
    out: Path,
    *,
    shards: range,
    tell: Callable[[str], None],
) -> list[Path]:
    """Write shards of a stream's items; those that are there already stay.

    Args:
        pairs: whose trials are looked at; an item is a shard.
        sees: how.
        out: folder.
        shards: numbers of the items.
        tell: gets a line for each shard.

    Returns:
        The files.

    Raises:
        UsageError: h5py is missing, or the folder's card is of other shards.
    """
    if find_spec("h5py") is None:
        raise UsageError("export views writes HDF5 with h5py: pip install 'r2h_batch[import]'")
    out.mkdir(parents=True, exist_ok=True)
    card = _card(pairs, sees)
    place = out / "README.md"
    if not place.exists():
        write_text(place, card)
    elif place.read_text(encoding="utf-8") != card:
        raise UsageError(f"{place} is of shards made otherwise; take another --out")
    files = []
    for index in shards:
        file = out / f"shard-{index:06d}.h5"
        files.append(file)
        if file.exists():
            tell(f"{file.name}: there already")
            continue
        with atomic_path(file) as temporary, progress(file.name, 1, "shard"):
            write_shard(temporary, _arrays(pairs, sees, index), _made_with(pairs, sees))
        tell(
            f"{file.name}: {pairs.trials} trials, {file.stat().st_size / pairs.trials / 1e3:.0f} kB each"
        )
    return files


def _card(pairs: Pairs, sees: Sees) -> str:
    names = sorted({o.name for o in pairs.objects})
    few = ", ".join(names[:3])
    return CARD.format(
        version=VERSION, format=FORMAT, trials=pairs.trials, pairs=pairs.pairs, seed=pairs.seed,
        benchmark=f"{pairs.benchmark.name}, digest {pairs.benchmark.digest}", objects=len(names),
        families=f"{few} and others" if len(names) > 3 else few, sees=json.dumps(sees.identity, sort_keys=True),
        step=DEPTH_STEP_M, labels=", ".join(LABELS), cloud=CLOUD, criteria=", ".join(CRITERIA), rounds=ORACLE_ROUNDS,
        told=TOLD if sees.region == "told" else "",
    )  # fmt: skip


def _arrays(pairs: Pairs, sees: Sees, index: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """The datasets of an item by path."""
    item, scene = pairs.item(index), pairs.evaluator.scene
    trials = pairs.benchmark.trials_with_ids(item["trial_id"])
    seen, T_world_obj = sees.look(scene, trials)
    T = T_world_obj.double()
    yield from seen_arrays(seen)

    def grasps(T_obj_ee: Tensor) -> NDArray[Any]:
        found: Tensor = se3.matmul(T[:, None].expand_as(T_obj_ee), T_obj_ee.double()).float()
        return found.numpy()

    yield "pairs/T_world_grasp", grasps(item["T_obj_ee"])
    for name in ("T_world_ee", "success", "labels", "margin"):
        yield f"pairs/{name}", item[name].numpy()
    best = oracle.predict(
        trials, scene, seed=pairs.seed, evaluator=pairs.evaluator, rounds=ORACLE_ROUNDS
    )
    scores = pairs.evaluator.kinematic.score(best.T_obj_ee, best.T_world_ee, trials, stages="pose")
    yield "oracle/T_world_grasp", grasps(best.T_obj_ee[:, None])
    yield "oracle/T_world_ee", best.T_world_ee[:, None].numpy()
    yield "oracle/success", scores.success[:, None].numpy()
    yield "truth/trial_id", trials.trial_id.numpy()
    names = [scene.objects[i].name for i in trials.object_index.tolist()]
    yield "truth/object", np.array(names, dtype="S")
    yield "truth/T_world_obj", T_world_obj.numpy()
    yield "truth/T_world_hand", trials.T_world_hand.numpy()


def _made_with(pairs: Pairs, sees: Sees) -> dict[str, str]:
    """Attributes of a shard that say where it is from."""
    return {
        "benchmark": pairs.benchmark.name, "benchmark_digest": pairs.benchmark.digest,
        "sees": json.dumps(sees.identity, sort_keys=True),
    }  # fmt: skip
