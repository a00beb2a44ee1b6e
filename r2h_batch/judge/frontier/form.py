"""Which form planning and Safe take on a device: all edges level by level, or one thread a trial."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

Form = Literal["frontier", "one_thread"]
FORMS: tuple[Form, ...] = get_args(Form)
_form: Form | None = None


@contextmanager
def planning_form(form: Form) -> Iterator[None]:
    """Inside, planning and Safe take this form on every device (tests, benches; one thread of a program only).

    Outside, CUDA takes "frontier", all edges level by level, and a CPU "one_thread", one thread a trial.
    """
    global _form
    before, _form = _form, form
    try:
        yield
    finally:
        _form = before


def uses_frontier(device: str) -> bool:
    """Whether planning on this device goes level by level."""
    return _form == "frontier" if _form else device != "cpu"
