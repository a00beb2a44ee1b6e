"""One file per handover method: a batch of trials in, grasp and handover poses out."""

from typing import TYPE_CHECKING

from r2h_batch.base.package import lazy_names

if TYPE_CHECKING:
    from r2h_batch.methods import oracle, random
    from r2h_batch.methods.candidates import candidate_table, candidates_of, stacked
    from r2h_batch.methods.declared import method
    from r2h_batch.methods.placing import approach_frames, poses_at

__all__ = [
    "approach_frames",
    "candidate_table",
    "candidates_of",
    "method",
    "oracle",
    "poses_at",
    "random",
    "stacked",
]

if not TYPE_CHECKING:  # else any name would pass
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "approach_frames": "placing",
            "candidate_table": "candidates",
            "candidates_of": "candidates",
            "method": "declared",
            "oracle": "oracle",
            "poses_at": "placing",
            "random": "random",
            "stacked": "candidates",
        },
    )
