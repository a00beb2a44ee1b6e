"""Arrays by name through a pipe, without pickle."""

import io
import json
import struct
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

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


def receive(pipe: IO[bytes]) -> dict[str, NDArray[Any]] | None:
    """The arrays of the next message; None: the other process has ended.

    Args:
        pipe: from the other process.
    """
    head = pipe.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    data = pipe.read(size)
    if len(data) < size:
        return None
    message = io.BytesIO(data)
    names = json.loads(str(np.load(message, allow_pickle=False)))
    return {name: np.load(message, allow_pickle=False) for name in names}
