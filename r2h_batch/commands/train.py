"""The command `train`: a method that learns from the benchmark's own labels."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.write import check_output_folder


def rank(
    *,
    out: Path,
    benchmark: str = "",
    families: str = "* x 5 seed 5",
    leave_out: tuple[str, ...] = (),
    regions: int = 2,
    seed: int = 0,
    items: int = 24,
    steps: int = 1200,
    rounds: int = 3,
    mined_items: int = 4,
    mined_steps: int = 300,
    start: str = "",
    renew: int = 0,
    workers: int | None = None,
    log: Literal["", "tensorboard", "wandb", "mlflow", "trackio"] = "",
) -> int:
    """Train the ranker of method learned on new instances of the families, and write its weights.

    It sees the object's cloud, the grasp candidates, the estimated hand and the receiver's region. The labels are the
    evaluator's. The same command goes on where an interrupted one stopped.

    Args:
        out: folder of rank.safetensors, and of checkpoint and labels.
        benchmark: its people, robot and limits; a name of ls benchmarks or your benchmark.yaml. Its objects are refused.
        families: instances to learn from, as behind --objects families:.
        leave_out: categories or instances that are not learned from.
        regions: more of each instance, with a receiver's region at random.
        seed: of trials, pairs, weights and batches.
        items: items of 256 trials with 16 random pairs each.
        steps: steps of the optimiser on them.
        rounds: rounds of pairs that the network likes best, judged.
        mined_items: items of each round.
        mined_steps: steps after each round.
        start: weights to begin with, rank.safetensors of another training, or shipped.
        renew: items after which the next instance of each category takes the place of the one before; training begins with
            the first ones while others are drawn. 0: it begins when all are drawn.
        workers: processes that draw instances; without it one for each core but one. They decide nothing about the weights.
        log: write the loss to TensorBoard, Weights & Biases, MLflow or Trackio too.
    """
    from r2h_batch.base.loggers import Logger
    from r2h_batch.training.rank import CHECKPOINT, Recipe, train_ranker
    from r2h_batch.trials.load import load_benchmark

    recipe = Recipe(
        families=families, leave_out=leave_out, regions=regions, seed=seed, items=items, steps=steps, rounds=rounds,
        mined_items=mined_items, mined_steps=mined_steps, start=start, renew=renew,
    )  # fmt: skip
    if not (out / CHECKPOINT).is_file():
        check_output_folder(out, overwrite=None)
        out.mkdir(parents=True, exist_ok=True)  # before minutes of work, not after
    with Logger(log, out, vars(recipe)) if log else nullcontext() as logger:
        numbers: Callable[[Mapping[str, float], int], Any] = (
            logger.log if logger else lambda numbers, step: None
        )
        found = load_benchmark(benchmark) if benchmark else load_benchmark()
        path = train_ranker(found, recipe, out, tell=LOG.info, log=numbers, workers=workers)
    print(path)
    return 0


COMMANDS = {"rank": rank}
