"""A user's own contact predictor: an ONNX network, weights of the built-in VoxNet, or a Python function."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import Tensor

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.onnx import OnnxNetwork
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.base.user_code import HOW, load_function
from r2h_batch.methods.predictors.grid import ContactPredictor
from r2h_batch.methods.predictors.voxnet import MAX_BYTES as MAX_VOXNET_BYTES
from r2h_batch.methods.predictors.voxnet import voxnet_of

MAX_BYTES = 4 << 30
_HOW = (
    "give an ONNX file (.onnx), VoxNet weights (.safetensors), or a function of your own code,"
    f" {HOW}"
)


def load_predictor(spec: str) -> ContactPredictor:
    """The contact predictor that a file or a Python function holds.

    Files of networks are data: `.onnx` runs on the CPU through onnxruntime (extra `onnx`),
    `.safetensors` holds weights of the built-in VoxNet. Programs (TorchScript) and pickles (torch.save, .pkl)
    are refused.

    Args:
        spec: the file, or `package.module:function`, or `FILE.py:function`. What a predictor takes and returns:
            `r2h_batch.methods.predictors.grid`.

    Raises:
        FileError: the file or the function cannot be used.
    """
    path = Path(spec)
    if ":" in spec and not path.exists():
        return _function(spec)
    of_voxnet = path.suffix == ".safetensors"
    with _of_predictor():
        data = read_file(path, MAX_VOXNET_BYTES if of_voxnet else MAX_BYTES)
        if path.suffix == ".onnx":
            return _OnnxNetwork(path, data)
    if of_voxnet:
        return voxnet_of(path, data)
    raise _no_network(path, data)


@contextmanager
def _of_predictor() -> Iterator[None]:
    """A refused file is said to be the predictor's, with what may be given."""
    try:
        yield
    except FileError as error:
        raise FileError(f"predictor {error}; {_HOW}") from None


class _OnnxNetwork:
    """The network in an ONNX file; its errors are a predictor's."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.network = OnnxNetwork(path, data)

    def __call__(self, grid: Tensor) -> Tensor:
        with _of_predictor():
            return self.network(grid)


def _no_network(path: Path, data: bytes) -> FileError:
    """Says which kind of file it is, and which kinds may be given."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        kind = "a file of PyTorch, a program or a pickle, which runs code when read"
        how = "r2h_batch 0.3 read TorchScript, this version does not; export the network as ONNX (torch.onnx.export)"
        return FileError(f"predictor {printable(path)}: {kind}; {how}")
    pickled = data[:1] == b"\x80"
    kind = "a pickle, which runs code when read" if pickled else "no network that is known here"
    return FileError(f"predictor {printable(path)}: {kind}; {_HOW}")


def _function(spec: str) -> ContactPredictor:
    where = f"predictor {printable(spec)}"
    try:
        found = load_function(spec).function
    except ImportError as error:
        why = " ".join(printable(error).split())[:200]
        raise FileError(f"{where}: {why}; {_HOW}") from error
    if not callable(found):
        raise FileError(f"{where}: is a {type(found).__name__}, no function; {_HOW}")
    return found
