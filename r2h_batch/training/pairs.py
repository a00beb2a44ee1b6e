"""Labelled pairs (grasp candidate, handover pose) of new instances, without end: a torch `IterableDataset`.

Item i is a function of (seed, i): the same bits in any process, for any number of DataLoader workers. Its trials have ids
that no benchmark uses, so nothing that a method is tested on can be learned.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from r2h_batch.base import rng
from r2h_batch.base.io.progress import busy
from r2h_batch.base.validate import (
    check_arguments,
    instance_of,
    integer,
    optional,
    sequence_of,
)
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods.candidates import without_candidates
from r2h_batch.methods.ranker.observe import Seen, observe
from r2h_batch.methods.ranker.proposals import NUMBERS, propose
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.training import reward
from r2h_batch.training.instances import Instances, Source, sources
from r2h_batch.training.regions import MOST_REGIONS, with_regions
from r2h_batch.trials.benchmark import MOST_TRIALS, Benchmark
from r2h_batch.types import Trials
from r2h_batch.verdicts import SPLITS

FIRST_ID = 1 << 40
"""Trials of streams have ids from here on; those of `Benchmark.trials` end at 2 * `MOST_TRIALS`."""
IDS_OF_SEED, MOST_SEEDS = 1 << 40, 1 << 20
"""Ids of one seed: the first half belongs to what is learned from, the second to what is left out."""
DRAWN_AT_ONCE = 1024
"""Trials drawn in one call: a trial costs a third of what it costs alone. It decides nothing about them."""
MOST_WORKERS = 256
KEPT_WORLDS = 2
"""Groups of instances whose tables are kept."""
_PICK, _POSE = 0, 1  # purposes of the random counters


@dataclass(frozen=True)
class World:
    """Benchmark and judge of an item's trials.

    Attributes:
        benchmark: with the item's instances.
        evaluator: judges its pairs.
        splits: that its instances have, as places in `SPLITS`.
    """

    benchmark: Benchmark
    evaluator: Evaluator
    splits: tuple[int, ...]

    @classmethod
    def of(cls, source: Source, group: int) -> "World":
        """The world of a group of instances, without those that the gripper cannot hold.

        Args:
            source: gives the instances.
            group: which of them.
        """
        objects = source.group(group)
        if source.regions:
            objects = with_regions(objects, source.regions)
        own = source.benchmark.with_objects(objects)
        evaluator = Evaluator(own, threads=1)
        if none := without_candidates(evaluator.scene):
            held = tuple(o for i, o in enumerate(objects) if i not in none)
            own = source.benchmark.with_objects(held)
            evaluator = Evaluator(own, threads=1)
        there = {o.split for o in own.objects}
        return cls(own, evaluator, tuple(k for k, s in enumerate(SPLITS) if s in there))


class Pairs(IterableDataset[dict[str, Tensor]]):
    """A stream of items (`stream` makes one), each a dict of tensors of N trials with K pairs each.

    Give a DataLoader `batch_size=None`.

    | key | shape | what |
    |---|---|---|
    | `index` | () | the item's number |
    | `trial_id`, `object_index` | (N,) | the trial; its object's place in `objects` |
    | `cloud`, `normals` | (N, P, 3) | points and outward normals of the object, m, frame obj |
    | `part`, `region` | (N, P) | part label and receiver's region of each point, with misplaced borders |
    | `contact` | (N, P) | with `Seen(contacts=True)` only |
    | `hand` | (N, H, 3) | points of the estimated hand, m, world |
    | `T_world_hand`, `side` | (N, 4, 4), (N,) | where the estimated hand stands; 0 right, 1 left |
    | `palm_point`, `palm_normal`, `wrist_to_middle`, `ball_center` | (N, 3) | of the estimated hand, world |
    | `candidates` | (N, C, 4, 4) | T_obj_ee of the grasp candidates |
    | `opening_m`, `score`, `exists` | (N, C) | of each candidate; where none exists the first one is repeated |
    | `pick` | (N, K) | the candidate of each pair |
    | `T_obj_ee`, `T_world_ee` | (N, K, 4, 4) | grasp and handover pose of each pair |
    | `success` | (N, K) | whether the pose stage passes |
    | `labels`, `margin` | (N, K, 5) | of each criterion: 1 passed, 0 failed, NaN not evaluated; margins, NaN too |

    Verdicts are those of the true hand; what is seen is the estimated one.

    With `renew` instances take the place of others from item to item: `object_index` then counts those of `world(index)`.

    Attributes:
        benchmark: that of the trials: people, robot and limits of the given one, with the new instances (of item 0).
        objects: the instances (of item 0).
        names: what all of them are called, without those with other regions.
        left_out: the stream of those that `leave_out` names, with people of its own; None where it names none.
        evaluator: judges the pairs (of item 0).
    """

    def __init__(
        self,
        source: Source,
        left_out: Source | None,
        *,
        pairs: int,
        poses: int,
        trials: int,
        seed: int,
        first_item: int,
        items: int | None,
        first_id: int,
        see: Seen,
        renew: int,
    ) -> None:
        """As `stream`, with the source of its instances.

        Args:
            source: gives instances of a benchmark whose people, robot and limits it has.
            left_out: gives those of `left_out`.
            pairs: K.
            poses: pairs of one candidate.
            trials: N.
            seed: key of all draws.
            first_item: number of the first item.
            items: number of items; None: no end.
            first_id: the first trial id.
            see: how much an item holds.
            renew: items with the same instances; 0: all have them.
        """
        self._source, self._worlds = source, dict[int, World]()
        self.pairs, self.poses, self.trials, self.seed, self.see = pairs, poses, trials, seed, see
        self.first_item, self.items, self.first_id, self.renew = first_item, items, first_id, renew
        self.names = source.names
        self.left_out: Pairs | None = None
        if left_out is not None:
            self.left_out = type(self)(
                left_out, None, pairs=pairs, poses=poses, trials=trials, seed=seed, first_item=first_item, items=items,
                first_id=first_id + IDS_OF_SEED // 2, see=see, renew=renew,
            )  # fmt: skip

    @property
    def benchmark(self) -> Benchmark:
        """That of item 0."""
        return self.world(0).benchmark

    @property
    def objects(self) -> Instances:
        """The instances of item 0."""
        return self.world(0).benchmark.objects

    @property
    def evaluator(self) -> Evaluator:
        """The judge of item 0."""
        return self.world(0).evaluator

    def world(self, index: int) -> "World":
        """Benchmark and judge of an item; its instances are drawn where they are not there yet.

        Args:
            index: number of the item.
        """
        group = index // self.renew % len(self._source.groups) if self.renew else 0
        if group not in self._worlds:
            found = World.of(self._source, group)
            while len(self._worlds) >= KEPT_WORLDS:
                del self._worlds[next(iter(self._worlds))]
            self._worlds[group] = found
        return self._worlds[group]

    @property
    def drawing(self) -> tuple[int, ...]:
        """Ids of the processes that draw instances ahead."""
        return self._source.drawing.running if self._source.drawing is not None else ()

    def close(self) -> None:
        """End the processes that draw instances ahead, if there are some left; the stream still works."""
        if self._source.drawing is not None:
            self._source.drawing.close()

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """The items in their order; of W workers each yields every W-th, so that a DataLoader gives the same order."""
        worker = get_worker_info()
        start, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        at, end = self.first_item + start, None
        if self.items is not None:
            end = self.first_item + self.items
        many = max(1, DRAWN_AT_ONCE // self.trials)
        while end is None or at < end:
            indices = [i for i in range(at, at + many * step, step) if end is None or i < end]
            for _, own in groupby(indices, lambda i: i // self.renew if self.renew else 0):
                some = list(own)
                with busy("an item of pairs"):
                    every = self._drawn(some)
                for i, drawn in zip(some, every, strict=True):
                    with busy("an item of pairs"):
                        item = self._item(i, drawn)
                    yield item
            at += many * step

    def item(self, index: int) -> dict[str, Tensor]:
        """One item by its number.

        Args:
            index: 0, 1, 2, ...
        """
        index = integer(0)("index", index)
        with busy("an item of pairs"):
            return self._item(index, *self._drawn([index]))

    def _drawn(self, indices: Sequence[int]) -> list[Trials]:
        """The trials of each of these items, which have the same instances."""
        world = self.world(indices[0])
        n, splits = self.trials, len(world.splits)
        place = np.concatenate([np.arange(i * n, (i + 1) * n, dtype=np.int64) for i in indices])
        if 2 * place[-1] >= IDS_OF_SEED // 2:
            most = IDS_OF_SEED // 4 // n
            raise ValueError(
                f"item {indices[-1]} is beyond the {most} of a seed; take another seed"
            )
        parity = np.array(world.splits)[place % splits]
        ids = torch.from_numpy(self.first_id + 2 * (place // splits) + parity)
        trials = world.benchmark.trials_with_ids(ids)
        # copies: a worker's other thread moves an item's memory when it sends it, and may free what another item reads
        rows = torch.arange(len(place), dtype=torch.int64, device="cpu").split(n)
        return [trials[own] for own in rows]

    def _item(self, index: int, trials: Trials) -> dict[str, Tensor]:
        """These trials as methods see them, pairs of them, and the verdicts.

        An item is always computed alone, on one thread: torch's sums and sines have other last bits in other shapes.
        """
        evaluator = self.world(index).evaluator
        with torch.no_grad(), evaluator.working():
            seen, middle = observe(trials, evaluator.scene, self.see, seed=self.seed)
            pick, T_world_ee = self.chosen(trials, seen, middle)
            n, k = pick.shape
            rows = torch.arange(n, dtype=torch.int64, device="cpu")[:, None]
            T_obj_ee = seen["candidates"][rows, pick]
            scores = evaluator.kinematic.score(T_obj_ee, T_world_ee, trials, stages="pose")
            margin = torch.where(scores.evaluated, scores.margin, torch.nan)
        return {
            "index": torch.tensor(index, dtype=torch.int64, device="cpu"), "trial_id": trials.trial_id,
            "object_index": trials.object_index, **seen,
            "pick": pick, "T_obj_ee": T_obj_ee, "T_world_ee": T_world_ee, "success": scores.success.view(n, k),
            "labels": reward.labels(scores).view(n, k, -1), "margin": margin.view(n, k, -1),
        }  # fmt: skip

    def chosen(
        self, trials: Trials, seen: Mapping[str, Tensor], middle: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The pairs of some trials: the candidate (N, K) and T_world_ee (N, K, 4, 4) of each.

        Args:
            trials: N trials.
            seen: what methods see of them.
            middle: (N, 3) what is brought to the palm, frame obj.
        """
        return pairs_at_random(
            self.seed, trials.trial_id, seen, middle, pairs=self.pairs, poses=self.poses
        )


def pairs_at_random(
    seed: int,
    trial_id: Tensor,
    seen: Mapping[str, Tensor],
    middle: Tensor,
    *,
    pairs: int,
    poses: int,
) -> tuple[Tensor, Tensor]:
    """Pairs of some trials: the candidate (N, K) and T_world_ee (N, K, 4, 4) of each.

    Args:
        seed: key of the draws.
        trial_id: (N,) a row depends on seed and id alone.
        seen: what methods see of them.
        middle: (N, 3) what is brought to the palm, frame obj.
        pairs: K.
        poses: pairs of one candidate.
    """
    key, n, ids = rng.key_of(f"stream {seed}"), len(trial_id), trial_id.numpy()
    u = np.ascontiguousarray(rng.uniforms(key, ids, pairs // poses, purpose=_PICK).T)
    drawn = rng.choice(u, seen["exists"].sum(1, keepdim=True).numpy())
    pick = torch.from_numpy(drawn).repeat_interleave(poses, dim=1)
    rows = torch.arange(n, dtype=torch.int64, device="cpu")[:, None]
    T_obj_ee = seen["candidates"][rows, pick]
    numbers = rng.uniforms(key, ids, pairs * NUMBERS, purpose=_POSE)
    u = np.ascontiguousarray(numbers.T).reshape(n, pairs, NUMBERS)
    hand = seen["ball_center"], seen["palm_normal"]
    return pick, propose(middle, *hand, T_obj_ee, torch.from_numpy(u))


@check_arguments(
    benchmark=instance_of(Benchmark, "load_benchmark(NAME or FILE)"),
    leave_out=sequence_of(str, "categories or names of instances", least=0),
    pairs=integer(1),
    poses=integer(1),
    regions=integer(0, MOST_REGIONS),
    trials=integer(1, DRAWN_AT_ONCE),
    seed=integer(0, MOST_SEEDS - 1),
    first_item=integer(0),
    items=optional(integer(1)),
    first_id=integer(0, 1 << 61),
    see=optional(instance_of(Seen, "Seen(...)")),
    renew=integer(0),
    workers=optional(integer(0, MOST_WORKERS)),
)
@busy("a stream of pairs")
def stream(
    benchmark: Benchmark,
    families: str | Sequence[ObjectModel] = "* x 8 seed 5",
    *,
    leave_out: Sequence[str] = (),
    pairs: int = 16,
    poses: int = 1,
    regions: int = 0,
    trials: int = 256,
    seed: int = 0,
    first_item: int = 0,
    items: int | None = None,
    first_id: int = FIRST_ID,
    see: Seen | None = None,
    renew: int = 0,
    workers: int | None = None,
) -> Pairs:
    """Labelled pairs to learn from: what methods see, candidates, poses, labels and margins (`Pairs` names the tensors).

    Instances are drawn once (0.9 s of a core each, with their candidates) and then read from disk. Other processes help. With
    `renew` they go on while you learn from the items that are there. How many they are decides nothing about an item.

    Args:
        benchmark: its people, robot, workplace and limits are those of the trials; its objects are refused.
        families: `CATEGORY,... x COUNT seed SEED` of new instances, as behind `--objects families:`; or your own objects.
        leave_out: categories (`cup`), instances (`cup_s1005_03`) or patterns (`*_03`) that are not learned from;
            `Pairs.left_out` is the stream of these.
        pairs: pairs of each trial.
        poses: pairs of one candidate; a divisor of `pairs`.
        regions: how many more times each instance is there, each time with a receiver's region at random: a part, all
            but a part, one side of a plane.
        trials: trials of an item.
        seed: another one has other trials and pairs.
        first_item: number of the first item; a run that goes on gives the number after its last one.
        items: number of items; None: no end.
        first_id: the first trial id of seed 0; ids that a benchmark draws are refused.
        see: how much of a trial an item holds; None: `Seen()`.
        renew: items after which the next instance of each category takes the place of the one before; after the last one the
            first comes again. 0: each item has trials with all instances, so the first item waits for all of them.
        workers: processes that draw instances; None: one for each core but one. They end with the last instance, with
            `Pairs.close()`, and with this process.

    Raises:
        FileError: families has no such form.
        ValueError: an object is one that methods are tested with, an id is the benchmark's own, `leave_out` names nothing.
    """
    if first_id < 2 * MOST_TRIALS:
        raise ValueError(
            f"first_id is {first_id}; ids below {2 * MOST_TRIALS:,} are those that methods are tested on, leave it out or"
            f" take {FIRST_ID} or more"
        )
    if pairs % poses:
        raise ValueError(f"poses is {poses}; it must divide pairs, which is {pairs}")
    first_id += first_id % 2 + IDS_OF_SEED * seed
    source, left_out = sources(
        benchmark, families, leave_out, regions=regions, renewed=renew > 0, workers=workers
    )
    pairs_ = Pairs(
        source, left_out, pairs=pairs, poses=poses, trials=trials, seed=seed, first_item=first_item, items=items,
        first_id=first_id, see=see or Seen(), renew=renew,
    )  # fmt: skip
    for each in (pairs_, pairs_.left_out):
        if each is not None and not renew:  # what is wrong with them is said here
            each.world(0)
    if not renew:
        pairs_.close()
    return pairs_
