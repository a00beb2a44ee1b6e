"""Gradients, rewards, torch.compile, captured calls."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.training import reward

__all__ = ["reward"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(__name__, {"reward": "reward"})
