"""How the rows of a call reach the stages: in chunks that bound the memory, large CPU batches sorted, small ones recorded.

No number depends on any of this.
"""

from functools import partial

import torch
from torch import Tensor

from r2h_batch.base.launch import memory
from r2h_batch.base.launch.repeated import RepeatedCalls
from r2h_batch.config import EvalConfig
from r2h_batch.judge.scores import scores_of
from r2h_batch.types import Scores, Trials
from r2h_batch.work import Stage, Work

POSE_CHUNK_CUDA = 1 << 16
"""Rows of one launch of the pose stage on CUDA, about 4 KB of working memory each."""

ROW_BYTES, MOVED_ROW_BYTES = 32 << 10, 192 << 10
"""Working memory of a row with a path, and of one whose motion is recorded, without the trees of the
planner's search."""

SORTED_ROWS = 256
"""CPU batches of this size or more are sorted by object, then by hand. Neighbouring rows then share
cached data and branches. This is five to ten per cent faster, and another five where candidates share
trials."""

SMALL_ROWS = 255
"""CPU calls of up to SMALL_ROWS rows whose stages all allow it are recorded and replayed (`base.launch.repeated`)."""

SIZES_KEPT = 8
"""Each thread keeps recordings of small calls of at most so many batch sizes."""


def rows_at_once(config: EvalConfig, device: str, *, paths: bool) -> int:
    """How many rows are judged together.

    Args:
        config: its `chunk`, and whether motions are recorded.
        device: `cpu`, `cuda` or `cuda:N`; on CUDA there are more where there is memory for it.
        paths: whether they have paths; without one a row needs a quarter of the memory.
    """
    chunk = config.chunk
    if not paths:
        return max(chunk, POSE_CHUNK_CUDA) if device != "cpu" else 4 * chunk
    moves = config.execute.engine(torch.device(device).type) != "none"
    return memory.rows_at_once(device, chunk, MOVED_ROW_BYTES if moves else ROW_BYTES)


def judged(
    work: Work, stages: tuple[Stage, ...], calls: RepeatedCalls, *, at_once: int, sort: bool
) -> Scores:
    """The scores of all rows after these stages.

    Args:
        work: B rows, before any stage.
        stages: a list of `r2h_batch.stages`.
        calls: what small calls with these stages left to be replayed.
        at_once: rows of a chunk.
        sort: whether a large batch may be sorted.
    """
    n, order = len(work.trials), None
    if sort and n >= SORTED_ROWS and not work.T_obj_ee.is_cuda:
        trials = work.trials
        pairs = trials.object_index.long() * len(work.scene.hands.set) + trials.hand_index
        order = torch.argsort(pairs, stable=True)
        work = work[order]

    def chunk(first: int, last: int) -> Scores:
        return scored(work if last - first == n else work[first:last], stages, calls)

    chunks = memory.in_chunks(n, at_once, chunk)
    scores = chunks[0] if len(chunks) == 1 else Scores.concatenate(chunks)
    return scores if order is None else scores[torch.argsort(order)]


def scored(work: Work, stages: tuple[Stage, ...], calls: RepeatedCalls) -> Scores:
    """The scores of one chunk; a small one is recorded, and replayed where it comes back."""
    trials, own = work.trials, work.own(stages)
    poses = work.T_obj_ee.contiguous(), work.T_world_ee.contiguous()
    if not all(stage.records for stage in own):
        found = work.of(*poses, trials._changed(Tensor.contiguous)).through(stages).fields
        return scores_of(trials.trial_id, found)
    of_trials = trials._tensors()
    of_trials.pop("person", None)  # no stage looks at it
    if any(stage.rests for stage in own):  # drawn by code that no recording repeats
        of_trials = {"T_world_obj": work.of(*poses, trials).resting, **of_trials}
    inputs = *poses, *(x.contiguous() for x in of_trials.values())
    if 0 < len(trials) <= SMALL_ROWS and not work.T_obj_ee.is_cuda:
        kept = calls(partial(fields_of, work, stages, tuple(of_trials)), *inputs)
        return scores_of(trials.trial_id, {name: x.clone() for name, x in kept.items()})
    return scores_of(trials.trial_id, fields_of(work, stages, tuple(of_trials), *inputs))


def fields_of(
    work: Work,
    stages: tuple[Stage, ...],
    names: tuple[str, ...],
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    *values: Tensor,
) -> dict[str, Tensor]:
    """The fields of `Scores` of these poses and trials, which are all that may differ from call to call; stages that
    can be recorded launch nothing but kernels. `names`: what the values are, of trials and `T_world_obj`."""
    given = dict(zip(names, values, strict=True))
    T_world_obj = given.pop("T_world_obj", work.T_world_obj)
    return (
        work.of(T_obj_ee, T_world_ee, Trials(**given), T_world_obj=T_world_obj)
        .through(stages)
        .fields
    )
