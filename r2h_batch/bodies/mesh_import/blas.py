"""NumPy's and SciPy's BLAS on one thread while an object is built: its idle threads spin on cores
that others work on.

After each product that OpenBLAS shares among threads those that have ended early go on turning, in
case there is more to do. What is built of a mesh multiplies small matrices, on all cores at once
already: a fifth of a build's CPU time was this.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["one_blas_thread"]

_taken = threading.Lock()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """BLAS works on one thread in the whole process, then on as many as before. Also a decorator.

    Of calls inside each other or at the same time the first sees to it: who comes later would find
    one thread to go back to.
    """
    if not _taken.acquire(blocking=False):
        yield
        return
    try:
        # looks at every library of the process: 4 ms
        from threadpoolctl import (
            ThreadpoolController,
        )

        with ThreadpoolController().select(user_api="blas").limit(limits=1):
            yield
    finally:
        _taken.release()
