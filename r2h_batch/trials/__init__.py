"""Which object goes to which hand, where it stands, how it is held; the benchmark file; predictions."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.trials.holding.receiving import load_receiving
    from r2h_batch.trials.noise import PredictorNoise
    from r2h_batch.trials.predictions import load_predictions, write_predictions

__all__ = [
    "PredictorNoise",
    "load_predictions",
    "load_receiving",
    "write_predictions",
]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "PredictorNoise": "noise",
            "load_predictions": "predictions",
            "load_receiving": "holding.receiving",
            "write_predictions": "predictions",
        },
    )
