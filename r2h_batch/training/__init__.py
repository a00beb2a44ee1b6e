"""Gradients, rewards, torch.compile, captured calls; offers the stream of `learning`."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.learning.mining import mine
    from r2h_batch.learning.pairs import stream
    from r2h_batch.methods.ranker.observe import Seen
    from r2h_batch.training import reward

__all__ = ["Seen", "mine", "reward", "stream"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "Seen": ".methods.ranker.observe",
            "mine": ".learning.mining",
            "reward": "reward",
            "stream": ".learning.pairs",
        },
    )
