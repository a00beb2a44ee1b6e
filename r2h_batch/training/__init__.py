"""What methods learn from: labelled pairs of new instances without end, pairs that a network likes best, rewards."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.methods.ranker.observe import Seen
    from r2h_batch.training import reward
    from r2h_batch.training.mining import mine
    from r2h_batch.training.pairs import stream

__all__ = ["Seen", "mine", "reward", "stream"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Seen": ".methods.ranker.observe",
            "mine": "mining",
            "reward": "reward",
            "stream": "pairs",
        },
    )
