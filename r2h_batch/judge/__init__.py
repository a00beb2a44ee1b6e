"""Grasp, IK, plan, goal, criteria: one stage, one file. presented, pick and reception measure what is no part of the verdict."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.judge.pick import Picked, PickReason, picked
    from r2h_batch.judge.plan import plan_paths

__all__ = ["PickReason", "Picked", "picked", "plan_paths"]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__, {"PickReason": "pick", "Picked": "pick", "picked": "pick", "plan_paths": "plan"}
    )
