"""ONNX networks, each call in a process of its own: a graph may loop for ever or take all memory.

`python -m r2h_batch.base.io.onnx` is the child.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import answer_parent, read_in_child, temporary_file
from r2h_batch.base.io.read import printable

if TYPE_CHECKING:
    from torch import Tensor

MOST_SECONDS = 600.0
"""CPU time of one call of a network."""

_MODULE = "r2h_batch.base.io.onnx"


class OnnxNetwork:
    """A network in onnxruntime, on one thread: its bits do not depend on the machine's cores.

    Args:
        path: the file's name, for messages.
        data: its content.

    Raises:
        FileError: no network with one input and one output of float32, or it takes too much time or
            memory to load.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self.where, self.data = printable(path), data
        if find_spec("onnxruntime") is None:
            raise FileError(f"{self.where}: ONNX needs: pip install 'r2h_batch[onnx]'")
        self._answer(None)

    def __call__(self, grid: Tensor) -> Tensor:
        """The network's output for a grid; `FileError` as above."""
        import torch  # the child does without

        (found,) = self._answer(grid.detach().cpu().numpy())
        return torch.as_tensor(found)

    def _answer(self, grid: np.ndarray | None) -> list[Any]:
        with temporary_file() as file:
            np.save(file, np.frombuffer(self.data, np.uint8), allow_pickle=False)
            if grid is not None:
                np.save(file, grid, allow_pickle=False)
            file.seek(0)
            try:
                return read_in_child(
                    _MODULE,
                    file,
                    {},
                    count=int(grid is not None),
                    seconds=MOST_SECONDS,
                    doing=f"asking {self.where}",
                )
            except FileError as error:
                raise FileError(f"{self.where}: {error}") from None


def _child(data: bytes, _: Mapping[str, Any]) -> list[Any]:
    """The network's answer, if there is a grid behind its file."""
    import onnxruntime

    file = io.BytesIO(data)
    network = np.load(file, allow_pickle=False).tobytes()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.load_model_format", "ONNX")
    # weights in other files: nothing lies below a device, so every such file is refused
    outside = "session.model_external_initializers_file_folder_path"
    options.add_session_config_entry(outside, os.devnull)
    try:
        session = onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no class but this one
        if "xternal data" in str(error):
            raise FileError("keeps weights in other files") from None
        raise FileError(f"not a readable ONNX file ({_why(error)})") from None
    ends = len(session.get_inputs()), len(session.get_outputs())
    if ends != (1, 1):
        raise FileError(f"{ends[0]} inputs and {ends[1]} outputs; need one of each")
    if (kind := session.get_inputs()[0].type) != "tensor(float)":
        raise FileError(f"its input is a {kind}; it must be a tensor(float)")
    if file.tell() == len(data):
        return []
    grid = np.load(file, allow_pickle=False)
    try:
        return list(session.run(None, {session.get_inputs()[0].name: grid}))
    except Exception as error:
        raise FileError(f"cannot answer {len(grid)} grids ({_why(error)})") from None


def _why(error: Exception) -> str:
    words = " ".join(printable(error).split())
    memory = any(word in words for word in ("allocat", "bad_alloc", "_arena.cc"))
    return "asks for too much memory" if memory else words[:200]


if __name__ == "__main__":
    sys.exit(answer_parent(_child))
