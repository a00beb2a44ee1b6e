"""A user's own contact predictor: a TorchScript file, weights of the built-in VoxNet, or a Python function."""

from __future__ import annotations

import importlib
import zipfile
from pathlib import Path

import torch

from r2h_batch.predictors.contacts import ContactPredictor

__all__ = ["PredictorError", "load_predictor"]

_HOW = "give a TorchScript file (torch.jit.save), VoxNet weights as .safetensors, or package.module:function"


class PredictorError(ValueError):
    """A predictor that cannot be used; the message names it, what was found and what is allowed."""


def load_predictor(spec: str) -> ContactPredictor:
    """The contact predictor of a TorchScript file, of a .safetensors file (VoxNet's), or ``package.module:function``.

    What it takes and returns: `r2h_batch.predictors.contacts`. Pickles (torch.save, .pkl) are refused: they run code.
    """
    path = Path(spec)
    if not path.exists() and ":" in spec and not path.suffix:
        return _function(spec)
    if not path.exists():
        if ":" in spec:
            return _function(spec)
        raise PredictorError(f"predictor {spec}: no such file; {_HOW}")
    if not path.is_file():
        raise PredictorError(f"predictor {spec}: not a regular file; {_HOW}")
    if path.suffix == ".safetensors":
        from r2h_batch.predictors.voxnet import read_voxnet

        return read_voxnet(path)
    return _torchscript(path)


def _torchscript(path: Path) -> ContactPredictor:
    """A ScriptModule in evaluation mode on the CPU."""
    if not zipfile.is_zipfile(path):
        with path.open("rb") as file:
            magic = file.read(2)
        kind = "a pickle, which runs code when read" if magic[:1] == b"\x80" else "neither TorchScript nor safetensors"
        raise PredictorError(f"predictor {path}: {kind}; {_HOW}")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    if not any(n.endswith("constants.pkl") for n in names) or not any("/code/" in n for n in names):
        raise PredictorError(f"predictor {path}: a torch.save file (a pickle, which runs code when read); {_HOW}")
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise PredictorError(f"predictor {path}: not a readable TorchScript file ({error}); {_HOW}") from error


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
