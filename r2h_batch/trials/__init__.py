"""What is asked: benchmarks, a file for each named one, those of files and of commands; how trials are drawn (`draw/`), how
things are held (`holding/`); what methods believe of a trial, and files of their answers."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.trials.benchmark import Benchmark
    from r2h_batch.trials.draw.rule import Batch, Placed, Rule
    from r2h_batch.trials.holding.receiving import load_receiving
    from r2h_batch.trials.load import load_benchmark
    from r2h_batch.trials.noise import PredictorNoise
    from r2h_batch.trials.predictions import load_predictions, write_predictions

__all__ = [
    "Batch",
    "Benchmark",
    "Placed",
    "PredictorNoise",
    "Rule",
    "load_benchmark",
    "load_predictions",
    "load_receiving",
    "write_predictions",
]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Batch": "draw.rule",
            "Benchmark": "benchmark",
            "Placed": "draw.rule",
            "PredictorNoise": "noise",
            "Rule": "draw.rule",
            "load_benchmark": "load",
            "load_predictions": "predictions",
            "load_receiving": "holding.receiving",
            "write_predictions": "predictions",
        },
    )
