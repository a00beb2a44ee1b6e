"""A user's own contact predictor: an ONNX network, weights of the built-in VoxNet, a Python
function, or, from a source that the user trusts, a TorchScript file."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.onnx import OnnxNetwork
from r2h_batch.base.io.read import archive_members, open_archive, printable, read_file
from r2h_batch.base.user_code import HOW, load_function
from r2h_batch.methods.predictors.grid import ContactPredictor
from r2h_batch.methods.predictors.voxnet import MAX_BYTES as MAX_VOXNET_BYTES
from r2h_batch.methods.predictors.voxnet import voxnet_of

MAX_BYTES = 4 << 30
MAX_MEMBERS = 20_000
_HOW = (
    "give an ONNX file (.onnx), VoxNet weights (.safetensors), or a function of your own code,"
    f" {HOW}"
)
_TRUST = (
    "a TorchScript file is a program, which can write any file; export the network as ONNX"
    " (torch.onnx.export), or, if you trust its source, add --trust-code (Python: trust_code=True)"
)


def load_predictor(spec: str, *, trust_code: bool = False) -> ContactPredictor:
    """The contact predictor that a file or a Python function holds.

    Files of networks are data: `.onnx` runs on the CPU through onnxruntime (extra `onnx`),
    `.safetensors` holds weights of the built-in VoxNet. A TorchScript file is a program: it runs
    with the rights of its user. Pickles (torch.save, .pkl) are refused.

    Args:
        spec: the file, or `package.module:function`, or `FILE.py:function`. What a predictor takes and returns:
            `r2h_batch.methods.predictors.grid`.
        trust_code: whether a TorchScript file may be loaded.

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
    return voxnet_of(path, data) if of_voxnet else _script(path, data, trust_code)


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


def _script(path: Path, data: bytes, trust_code: bool) -> ContactPredictor:
    """A ScriptModule in evaluation mode on the CPU."""
    where = f"predictor {printable(path)}"
    if not zipfile.is_zipfile(io.BytesIO(data)):
        pickled = data[:1] == b"\x80"
        kind = "a pickle, which runs code when read" if pickled else "no network that is known here"
        raise FileError(f"{where}: {kind}; {_HOW}")
    with _of_predictor(), open_archive(path, MAX_BYTES) as archive:
        members = archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
    names = [m.filename for m in members]
    if not any(n.endswith("constants.pkl") for n in names) or not any("/code/" in n for n in names):
        kind = "a torch.save file (a pickle, which runs code when read)"
        raise FileError(f"{where}: {kind}; {_HOW}")
    if not trust_code:
        raise FileError(f"{where}: {_TRUST}")
    try:
        return torch.jit.load(io.BytesIO(data), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        why = printable(str(error).strip().partition("\n")[0])[:200]
        raise FileError(f"{where}: not a readable TorchScript file ({why}); {_HOW}") from error


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
