"""Trains the ranker of method `learned`: labels of the stream, then rounds of pairs that it likes itself."""

import math
import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from r2h_batch.base.errors import FileError, UserError
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.read import open_file
from r2h_batch.base.io.write import atomic_path
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.base.validate import validate_fields
from r2h_batch.methods.learned import trained_on as trained_on_of
from r2h_batch.methods.learned import weights_file
from r2h_batch.methods.ranker import features
from r2h_batch.methods.ranker.network import UNNAMED, Ranker, read_weights, save_weights
from r2h_batch.methods.ranker.search import scored_by
from r2h_batch.training.mining import mine
from r2h_batch.training.pairs import Pairs, stream
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.verdicts import CRITERIA

WEIGHTS, CHECKPOINT, LESSONS = "rank.safetensors", "checkpoint.pt", "lessons-{}.pt"
TRIALS, PAIRS, POSES = 256, 16, 4
"""Trials of an item; pairs of a trial; pairs of one candidate."""
RATE, DECAY, WARM_UP, LEAST_RATE = 2e-3, 1e-3, 100, 0.02
CRITERIA_WEIGHT = 0.3
BLIND = 0.25
"""Share of the trials whose region is hidden while it learns."""
BATCH, MINED_BATCH = 64, 24
"""Trials of a step; how many of them are mined, where some are."""
MOST_BYTES = 4 << 30
"""A stored file has no more."""
SHIPPED = "shipped"
"""Names the weights of method learned."""
EVERY = 100
"""Steps between two lines and two checkpoints."""


@contextmanager
def stored_state(path: Path) -> Iterator[Mapping[str, Any]]:
    """The state that this command has stored at a place, for as long as it is taken over.

    Raises:
        FileError: the file is something else or damaged, whether torch finds it or who takes it over does.
    """
    try:
        with open_file(path, MOST_BYTES) as file, warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of a pickle that torch did not write: it is refused below
            kept = torch.load(file, weights_only=True)
        yield kept
    except UserError:
        raise
    except Exception as error:  # torch's readers raise whatever their parts do
        words = "damaged, or not written by this command; remove it, or give another --out"
        raise FileError(f"{path}: {words}") from error


AtLeastOne = Annotated[int, Field(ge=1)]
NotNegative = Annotated[int, Field(ge=0)]
Told = Callable[[str], None]
Logged = Callable[[Mapping[str, float], int], None]


@dataclass(frozen=True)
class Recipe:
    """The choices that decide the weights, with the benchmark and the code.

    Attributes:
        families: instances, as `training.stream` reads them.
        leave_out: categories or instances that are not learned from.
        regions: more of each instance with a region at random.
        seed: of trials, pairs, weights and batches.
        items: items of 256 trials drawn at random.
        steps: of the optimiser on them.
        rounds: rounds of mined pairs.
        mined_items: items of each.
        mined_steps: steps after each.
        start: weights to begin with: a file, or `SHIPPED`; empty: at random.
        renew: items after which the next instances take the place of those before, as in `stream`. The steps begin with the
            first of them, while others are drawn. 0: all instances from the first item on.
    """

    families: str = "* x 5 seed 5"
    leave_out: Annotated[
        tuple[str, ...], Field(description="categories or names of instances")
    ] = ()
    regions: NotNegative = 2
    seed: NotNegative = 0
    items: AtLeastOne = 24
    steps: AtLeastOne = 1200
    rounds: NotNegative = 3
    mined_items: AtLeastOne = 4
    mined_steps: AtLeastOne = 300
    start: str = ""
    renew: NotNegative = 0

    def __post_init__(self) -> None:
        validate_fields(self)

    @property
    def all_steps(self) -> int:
        """Steps from the first to the last."""
        return self.steps + self.rounds * self.mined_steps

    @property
    def stages(self) -> "tuple[Stage, ...]":
        """Labels and steps in turn: items at random, all at once or as their instances come; then rounds of mined ones."""
        found: list[Stage] = []
        for first in range(0, self.items, self.renew or self.items):
            last = min(first + (self.renew or self.items), self.items)
            name = f"0-{len(found)}" if self.renew else "0"
            end = self.steps * last // self.items
            found.append(Stage(0, name, range(first, last), found[-1].end if found else 0, end))
        for number in range(1, 1 + self.rounds):
            first = self.items + (number - 1) * self.mined_items
            items, begin = range(first, first + self.mined_items), found[-1].end
            found.append(Stage(number, str(number), items, begin, begin + self.mined_steps))
        return tuple(found)


class Stage(NamedTuple):
    """Items that are labelled, and the steps after them.

    Attributes:
        number: of the round; 0: items at random.
        name: of its file of labels.
        items: their numbers.
        begin: step before it.
        end: its last step.
    """

    number: int
    name: str
    items: range
    begin: int
    end: int


@dataclass(frozen=True)
class Lessons:
    """Features and labels of N trials: G candidates of each, K pairs, K / G of each candidate."""

    cloud: Tensor
    candidate: Tensor
    pair: Tensor
    truth: Tensor
    """(N, K, 1 + C) success and criteria: 1, 0, NaN not evaluated"""

    @classmethod
    def of(cls, items: Iterable[Mapping[str, Tensor]], poses: int) -> "Lessons":
        """The lessons of a stream's items.

        Args:
            items: with `features.SEE`.
            poses: pairs of one candidate.
        """
        rows = []
        for item in items:
            pick = item["pick"][:, ::poses]
            grasp = item["T_obj_ee"][:, ::poses]
            opening = item["opening_m"].gather(1, item["pick"])
            rows.append(
                (
                    features.cloud_in_gripper(item, grasp).half(),
                    features.of_candidate(item, grasp, pick),
                    features.of_pair(item, item["T_obj_ee"], item["T_world_ee"], opening),
                    torch.cat([item["success"][..., None].float(), item["labels"]], -1),
                )
            )
        return cls(*(torch.cat(column) for column in zip(*rows, strict=True)))

    def __len__(self) -> int:
        return len(self.truth)

    def and_more(self, others: "Lessons") -> "Lessons":
        """These trials and others with as many pairs.

        Args:
            others: come after these.
        """
        both = zip(vars(self).values(), vars(others).values(), strict=True)
        return Lessons(*(torch.cat(pair) for pair in both))

    def logits(self, net: Ranker, rows: Tensor, blind: Tensor) -> tuple[Tensor, Tensor]:
        """Logits and truth (n K, 1 + C) of some trials.

        Args:
            net: the ranker.
            rows: (n,) trials.
            blind: (n,) bool: whose region is hidden.
        """
        cloud, candidate, pair = features.hidden(
            self.cloud[rows].float(), self.candidate[rows], self.pair[rows], blind
        )
        poses = pair.shape[1] // candidate.shape[1]
        code = net.code(cloud).repeat_interleave(poses, 1)
        found = net(code, candidate.repeat_interleave(poses, 1), pair)
        return found.flatten(0, 1), self.truth[rows].flatten(0, 1)


def _counted(
    items: Iterable[Mapping[str, Tensor]], told: Callable[[int], None]
) -> Iterator[Mapping[str, Tensor]]:
    for item in items:
        yield item
        told(1)


class Training:
    """A network and its optimiser on the way through a recipe; the same bits whether it was interrupted or not."""

    def __init__(self, recipe: Recipe, pairs: Pairs, out: Path, tell: Told, log: Logged) -> None:
        """Begins, or goes on where `out` has a checkpoint.

        Args:
            recipe: what to do.
            pairs: the stream.
            out: folder of the checkpoint.
            tell: prints a line.
            log: takes numbers at a step.
        """
        self.recipe, self.pairs, self.out, self.tell, self.log = recipe, pairs, out, tell, log
        self.random = torch.Generator().manual_seed(recipe.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            self.net = Ranker(CRITERIA)
        if recipe.start:
            self.net.load_state_dict(begun(recipe.start).state_dict())
        self.adam = torch.optim.AdamW(self.net.parameters(), lr=RATE, weight_decay=DECAY)
        self.step, self.shown = 0, 0.0
        self.spent: dict[str, float] = {}
        self.lessons: list[Lessons] = []
        if (path := out / CHECKPOINT).exists():
            with stored_state(path) as kept:
                if kept["recipe"] != plain(recipe, pairs):
                    raise FileError(
                        f"{path}: is of another recipe or benchmark; give another --out, or the same flags"
                    )
                self.net.load_state_dict(kept["net"])
                self.adam.load_state_dict(kept["adam"])
                self.random.set_state(kept["random"])
                self.step, self.shown, self.spent = (
                    int(kept["step"]),
                    float(kept["shown"]),
                    dict(kept["spent"]),
                )
            tell(f"{path}: goes on at step {self.step}")
        else:  # from now on the folder says whose it is: labels take minutes
            self.keep()

    def keep(self) -> None:
        """Write the checkpoint."""
        with atomic_path(self.out / CHECKPOINT) as temporary:
            state = {
                "recipe": plain(self.recipe, self.pairs), "net": self.net.state_dict(), "adam": self.adam.state_dict(),
                "random": self.random.get_state(), "step": self.step, "shown": self.shown, "spent": self.spent,
            }  # fmt: skip
            torch.save(state, temporary)

    def run(self) -> Ranker:
        """The network at the end of the recipe."""
        recipe = self.recipe
        with one_torch_thread("cpu"):
            for stage in recipe.stages:
                self._learn_from(stage)
                start = time.process_time()
                while self.step < stage.end:
                    self.learn()
                    if self.step % EVERY == 0 or self.step == stage.end:
                        self._spend("train", start)
                        start = time.process_time()
                        self.keep()
                        self.tell(f"step {self.step} of {recipe.all_steps}: loss {self.shown:.4f}")
                        self.log({"loss": self.shown}, self.step)
        return self.net.eval()

    def _spend(self, what: str, start: float) -> None:
        self.spent[what] = self.spent.get(what, 0.0) + time.process_time() - start

    def _learn_from(self, stage: Stage) -> None:
        """Labels of a stage, drawn or read again."""
        path, recipe, start = (
            self.out / LESSONS.format(stage.name),
            self.recipe,
            time.process_time(),
        )
        first = not self.lessons
        if path.exists() and self.step >= stage.begin:
            with stored_state(path) as kept:
                found = Lessons(**kept)
        else:
            with progress("labels", len(stage.items), "items") as told:
                if stage.number == 0:
                    items = (self.pairs.item(i) for i in stage.items)
                    found = Lessons.of(_counted(items, told), POSES)
                else:
                    mined = mine(
                        self.pairs, scored_by(self.net.eval()), first=192, second=96, first_item=stage.items.start,
                        items=len(stage.items),
                    )  # fmt: skip
                    found = Lessons.of(_counted(mined, told), 1)
            with atomic_path(path) as temporary:
                torch.save(vars(found), temporary)
        if first and not self.step and not recipe.start:
            x = torch.cat([found.candidate.repeat_interleave(POSES, 1), found.pair], -1).flatten(
                0, 1
            )
            self.net.mean.copy_(x.mean(0))
            self.net.std.copy_(x.std(0).clamp(min=1e-3))
        self.net.train()
        if stage.number == 0 and not first:
            self.lessons[0] = self.lessons[0].and_more(found)
        else:
            self.lessons.append(found)
        self._spend("mine" if stage.number else "labels", start)
        passed = found.truth.nanmean((0, 1)).tolist()
        words = ", ".join(
            f"{n} {100 * p:.1f}" for n, p in zip(("success", *CRITERIA), passed, strict=True)
        )
        what = f"mined, round {stage.number}" if stage.number else "at random"
        self.tell(f"{found.truth.shape[0] * found.truth.shape[1]} pairs {what}: {words} %")
        self.log({f"passed/{what}": passed[0]}, self.step)

    def learn(self) -> None:
        """One step of the optimiser."""
        part = self.step / self.recipe.all_steps
        rate = max(LEAST_RATE, 0.5 + 0.5 * math.cos(math.pi * part))
        for group in self.adam.param_groups:
            group["lr"] = RATE * min(1.0, (self.step + 1) / WARM_UP) * rate
        mined = self.lessons[1:]
        sizes = [BATCH - (MINED_BATCH if mined else 0)] + [MINED_BATCH // max(1, len(mined))] * len(
            mined
        )
        found = []
        for own, size in zip(self.lessons, sizes, strict=True):
            rows = torch.randint(
                len(own), (size,), generator=self.random, dtype=torch.int64, device="cpu"
            )
            blind = (
                torch.rand(size, generator=self.random, dtype=torch.float32, device="cpu") < BLIND
            )
            found.append(own.logits(self.net, rows, blind))
        z, truth = (torch.cat(column) for column in zip(*found, strict=True))
        bce, known = nn.functional.binary_cross_entropy_with_logits, ~truth[:, 1:].isnan()
        loss = bce(z[:, 0], truth[:, 0])
        loss = loss + CRITERIA_WEIGHT * bce(z[:, 1:][known], truth[:, 1:][known])
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        self.adam.step()
        self.shown = loss.item() if self.step == 0 else 0.98 * self.shown + 0.02 * loss.item()
        self.step += 1


def begun(start: str) -> Ranker:
    """The network that a training begins with.

    Args:
        start: a file of weights, or `SHIPPED`.

    Raises:
        FileError: the file is missing, or its network learned other criteria.
    """
    if start != SHIPPED and not Path(start).is_file():
        raise FileError(
            f"{start}: no such file; give rank.safetensors of another training, or {SHIPPED}"
        )
    with weights_file("" if start == SHIPPED else start) as path:
        net = read_weights(path)
    if net.criteria not in (CRITERIA, UNNAMED):
        raise FileError(
            f"{start}: learned {', '.join(net.criteria)}; give weights that learned {', '.join(CRITERIA)}"
        )
    return net


def plain(recipe: Recipe, pairs: Pairs) -> dict[str, Any]:
    """A recipe, its benchmark and the criteria of its labels as JSON.

    Args:
        recipe: any.
        pairs: its stream.
    """
    told = {k: v for k, v in asdict(recipe).items() if k != "renew" or v}
    return {
        **told,
        "leave_out": list(recipe.leave_out),
        "benchmark": pairs.benchmark.digest,
        "criteria": list(CRITERIA),
    }


def _trained(
    recipe: Recipe,
    pairs: Pairs,
    out: Path,
    tell: Told,
    log: Logged,
    learned_from: dict[str, Any],
    begin: tuple[float, float],
) -> Path:
    """The file of weights; `begin`: CPU time, of this process and of those before, when the drawing of instances began."""
    training = Training(recipe, pairs, out, tell, log)
    drawn = time.process_time() - begin[0]
    training.spent["instances"] = training.spent.get("instances", 0.0) + drawn
    net = training.run()
    pairs.close()
    training.spent["instances"] += _cpu_of_others() - begin[1]
    training.keep()
    seconds = {k: round(v, 1) for k, v in training.spent.items()}
    path = out / WEIGHTS
    if recipe.start:
        before = trained_on_of("" if recipe.start == SHIPPED else recipe.start)
        learned_from = {
            **learned_from,
            "objects": [*dict.fromkeys([*before, *learned_from["objects"]])],
        }
    save_weights(
        net, path, plain(recipe, pairs) | {"trained_on": learned_from, "cloud": features.SPREAD}
    )
    tell(f"{path}: CPU seconds {', '.join(f'{k} {v}' for k, v in seconds.items())}")
    return path


def train_ranker(
    benchmark: Benchmark,
    recipe: Recipe,
    out: Path,
    *,
    tell: Told = print,
    log: Logged = lambda numbers, step: None,
    workers: int | None = None,
) -> Path:
    """Train a ranker from nothing, or go on where the folder has a checkpoint.

    Args:
        benchmark: whose people, robot and limits it learns for; its objects are never learned from.
        recipe: what to do.
        out: folder of checkpoint, labels and weights.
        tell: prints a line.
        log: takes numbers at a step.
        workers: processes that draw instances, as in `stream`; they decide nothing about the weights.

    Returns:
        The file of weights, which says what it was trained on.
    """
    start = time.process_time(), _cpu_of_others()
    pairs = stream(
        benchmark, recipe.families, leave_out=recipe.leave_out, pairs=PAIRS, poses=POSES, regions=recipe.regions,
        trials=TRIALS, seed=recipe.seed, see=features.SEE, renew=recipe.renew, workers=workers,
    )  # fmt: skip
    try:
        return _trained(recipe, pairs, out, tell, log, trained_on(benchmark, pairs), start)
    finally:
        pairs.close()


def _cpu_of_others() -> float:
    """CPU seconds of the processes that this one has waited for."""
    spent = os.times()
    return spent.children_user + spent.children_system


def trained_on(benchmark: Benchmark, pairs: Pairs) -> dict[str, Any]:
    """The benchmark and the instances that were learned from, by name.

    Args:
        benchmark: the benchmark that was learned for.
        pairs: the stream.
    """
    own = pairs.names
    if not pairs.renew:  # those that the gripper can hold
        own = tuple(o.name for o in pairs.objects if "_region" not in o.name)
    return {"benchmark": benchmark.name, "objects": [*own]}
