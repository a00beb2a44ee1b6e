"""Which object goes to which hand, and where it stands."""

from typing import TYPE_CHECKING

from r2h_batch import lazy_names

if TYPE_CHECKING:
    from r2h_batch.trials.protocol import (
        PROTOCOL,
        PROTOCOLS,
        make_trials,
        trials_digest,
        trials_with_ids,
    )
    from r2h_batch.verdicts import SPLITS

__all__ = ["PROTOCOL", "PROTOCOLS", "SPLITS", "make_trials", "trials_digest", "trials_with_ids"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "PROTOCOL": "protocol",
            "PROTOCOLS": "protocol",
            "SPLITS": "protocol",
            "make_trials": "protocol",
            "trials_digest": "protocol",
            "trials_with_ids": "protocol",
        },
    )
