"""A user's own contact predictor: a TorchScript file, weights of the built-in VoxNet, or a Python
function."""

from __future__ import annotations

import importlib
import io
import zipfile
from pathlib import Path

import torch

from r2h_batch.io.read import FileError, archive_members, open_archive, printable, read_file
from r2h_batch.predictors.grid import ContactPredictor, PredictorError
from r2h_batch.predictors.voxnet import read_voxnet

__all__ = ["load_predictor"]

MAX_BYTES = 4 << 30
MAX_MEMBERS = 20_000
_HOW = "give a TorchScript file (torch.jit.save), VoxNet weights as .safetensors, or package.module:function"


def load_predictor(spec: str) -> ContactPredictor:
    """The contact predictor of a TorchScript file, of a .safetensors file (VoxNet's), or
    ``package.module:function``.

    What it takes and returns: `r2h_batch.predictors.grid`. Pickles (torch.save, .pkl) are refused:
    they run code.
    """
    path = Path(spec)
    if not path.exists() and ":" in spec and not path.suffix:
        return _function(spec)
    if not path.exists():
        if ":" in spec:
            return _function(spec)
        raise PredictorError(f"predictor {spec}: no such file; {_HOW}")
    try:
        if path.suffix == ".safetensors":
            return read_voxnet(path)
        return _torchscript(path)
    except FileError as error:
        raise PredictorError(f"predictor {error}; {_HOW}") from None


def _torchscript(path: Path) -> ContactPredictor:
    """A ScriptModule in evaluation mode on the CPU."""
    data = read_file(path, MAX_BYTES)
    if not zipfile.is_zipfile(io.BytesIO(data)):
        magic = data[:2]
        kind = (
            "a pickle, which runs code when read"
            if magic[:1] == b"\x80"
            else "neither TorchScript nor safetensors"
        )
        raise PredictorError(f"predictor {path}: {kind}; {_HOW}")
    with open_archive(path, MAX_BYTES) as archive:
        names = [
            m.filename for m in archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
        ]
    if not any(n.endswith("constants.pkl") for n in names) or not any("/code/" in n for n in names):
        raise PredictorError(
            f"predictor {path}: a torch.save file (a pickle, which runs code when read); {_HOW}"
        )
    try:
        return torch.jit.load(io.BytesIO(data), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        why = printable(str(error).strip().partition("\n")[0])[:200]
        raise PredictorError(
            f"predictor {path}: not a readable TorchScript file ({why}); {_HOW}"
        ) from error


def _function(spec: str) -> ContactPredictor:
    module_name, _, name = spec.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise PredictorError(
            f"predictor {spec}: module {module_name!r} cannot be imported ({error}); {_HOW}"
        ) from error
    found = getattr(module, name, None)
    if not callable(found):
        what = "has no" if found is None else f"has no function but a {type(found).__name__} called"
        raise PredictorError(f"predictor {spec}: module {module_name} {what} {name!r}; {_HOW}")
    return found
