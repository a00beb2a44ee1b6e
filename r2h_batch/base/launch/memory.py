"""How many rows of a batch go to a device at once: as many as its memory is good for, half as many
when it was not."""

import logging
from collections.abc import Callable
from typing import TypeVar

import torch

CUDA_ROWS = 1 << 15
"""Rows of one launch on CUDA at most: more of them fill no further multiprocessor, and the slowest
is waited for anyway."""

SHARE = 4
"""One part in this many of the free memory is what the rows may take: planning's trees want their
own, and torch rounds up."""

Part = TypeVar("Part")
_log = logging.getLogger(__name__)


def rows_at_once(device: str, chunk: int, row_bytes: int) -> int:
    """Rows that a device holds at once: on a CPU `chunk`, on CUDA as memory allows, `chunk` at
    least."""
    if device == "cpu":
        return chunk
    free, _ = torch.cuda.mem_get_info(torch.device(device))
    return max(chunk, min(CUDA_ROWS, free // SHARE // row_bytes))


def in_chunks(n: int, rows: int, judge: Callable[[int, int], Part]) -> list[Part]:
    """`judge(first, last)` of `n` rows, `rows` at a time, one part at least; half as many from
    where memory ran out.

    Rows do not depend on where the cuts are, so neither do results. Raises what `judge` does, once
    a single row is too much.
    """
    parts: list[Part] = []
    first = 0
    while first < n or not parts:
        last = min(first + rows, n)
        try:
            parts.append(judge(first, last))
        except (MemoryError, RuntimeError) as error:
            if last - first <= 1 or not _out_of_memory(error):
                raise
            rows = (last - first) // 2
            _log.warning(
                "out of memory with %d rows: going on with %d at a time", last - first, rows
            )
        else:
            first = last
            continue
        if torch.cuda.is_initialized():
            # the failed part's tensors are free, but only for torch: Warp wants some too
            torch.cuda.empty_cache()
    return parts


def _out_of_memory(error: MemoryError | RuntimeError) -> bool:
    """Whether the error says that memory is full: torch's (OutOfMemoryError; on a CPU "can't
    allocate memory") or Warp's ("Failed to allocate N bytes on device")."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return not (torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing())
    return "allocate" in str(error).lower() or "out of memory" in str(error).lower()
