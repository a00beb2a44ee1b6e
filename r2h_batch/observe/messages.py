"""Arrays by name through a pipe, without pickle."""

import io
import json
import struct
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import AnswerError

_LENGTH = struct.Struct("<Q")


def send(pipe: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as one message.

    Args:
        pipe: to the other process.
        arrays: by name; texts are arrays too.
    """
    message = io.BytesIO()
    np.save(message, np.array(json.dumps(list(arrays))), allow_pickle=False)
    for array in arrays.values():
        np.save(message, array, allow_pickle=False)
    pipe.write(_LENGTH.pack(message.tell()))
    pipe.write(message.getbuffer())
    pipe.flush()


def receive(pipe: IO[bytes], most: int) -> dict[str, NDArray[Any]] | None:
    """The arrays of the next message; None: the other process has ended, or the pipe does not wait for it.

    Args:
        pipe: from the other process.
        most: bytes of a message; more are not read.

    Raises:
        AnswerError: a longer message, or bytes that no `send` wrote. The pipe is of no use then.
    """
    head = pipe.read(_LENGTH.size) or b""  # None: somebody made the pipe not wait
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    if size > most:
        raise AnswerError(f"a message of {size} bytes; at most {most} are taken")
    data = pipe.read(size) or b""
    if len(data) < size:
        return None
    message = io.BytesIO(data)
    try:
        names = json.loads(str(np.load(message, allow_pickle=False)))
        return {str(name): np.load(message, allow_pickle=False) for name in names}
    except (ValueError, TypeError, EOFError, OverflowError, MemoryError, RecursionError) as error:
        raise AnswerError("bytes that are no message") from error
