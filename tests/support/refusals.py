"""Rules for every refusal of a user's file."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from r2h_batch.base.errors import FileError


@contextmanager
def one_line(words: str, error: type[Exception] = FileError) -> Iterator[None]:
    """A refusal in one line, in which the pattern `words` is found."""
    with pytest.raises(error, match=words) as refused:
        yield
    assert "\n" not in str(refused.value)
