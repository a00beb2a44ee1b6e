"""Handovers in closed loop: receivers who move, robots that look, and what came of it."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.closed_loop.env import End, Episodes, HandoverEnv, LoopConfig
    from r2h_batch.closed_loop.episodes import play
    from r2h_batch.closed_loop.policies import Servo

__all__ = ["End", "Episodes", "HandoverEnv", "LoopConfig", "Servo", "play"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "End": "env",
            "Episodes": "env",
            "HandoverEnv": "env",
            "LoopConfig": "env",
            "Servo": "policies",
            "play": "episodes",
        },
    )
