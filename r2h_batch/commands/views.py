"""The command `export views`: data that depth cameras give, to learn from. Light until there is work."""

from pathlib import Path

from r2h_batch.base.command_line import check_range
from r2h_batch.base.io.log import LOG

MOST_TRIALS = 1000
"""Images of so many trials are half a gigabyte in memory."""


def views(
    *,
    out: Path,
    shards: int = 1,
    first_shard: int = 0,
    trials: int = 250,
    pairs: int = 16,
    families: str = "* x 5 seed 5",
    benchmark: str = "",
    sees: str = "cell-v1",
    seed: int = 0,
) -> int:
    """Write what depth cameras see of trials with new instances, with labelled grasps and handover poses, as HDF5.

    Shards that are there already stay, so the same command goes on. Several machines write shards of their own with
    --first-shard. README.md in the folder says what is in a shard.

    Args:
        out: folder.
        shards: how many to write.
        first_shard: number of the first one.
        trials: of a shard.
        pairs: labelled pairs of a trial.
        families: instances to look at, as behind --objects families:.
        benchmark: its people, robot and limits; a name of ls benchmarks or your benchmark.yaml. Its objects are refused.
        sees: cameras and errors, as in sweep.
        seed: of trials and pairs.
    """
    for flag, value, low, high in (
        ("--shards", shards, 1, 10**5),
        ("--first-shard", first_shard, 0, 10**6),
        ("--trials", trials, 1, MOST_TRIALS),
        ("--pairs", pairs, 1, 1000),
    ):
        check_range(flag, value, low, high)
    from r2h_batch.observe.sees import Sees
    from r2h_batch.training.pairs import stream
    from r2h_batch.training.views import write_views
    from r2h_batch.trials.load import load_benchmark

    shown = Sees.parse(sees)
    found = load_benchmark(benchmark) if benchmark else load_benchmark()
    own = stream(found, families, pairs=pairs, trials=trials, seed=seed)
    numbers = range(first_shard, first_shard + shards)
    for file in write_views(own, shown, out, shards=numbers, tell=LOG.info):
        print(file)
    return 0
