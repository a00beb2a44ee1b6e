"""A user's own contact predictor: an ONNX network, weights of the built-in VoxNet, a Python
function, or, from a source that the user trusts, a TorchScript file."""

from __future__ import annotations

import io
import os
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2h_batch.base.io.read import FileError, archive_members, open_archive, printable, read_file
from r2h_batch.base.user_code import HOW, load_function
from r2h_batch.methods.predictors.grid import ContactPredictor, PredictorError
from r2h_batch.methods.predictors.voxnet import read_voxnet

MAX_BYTES = 4 << 30
MAX_MEMBERS = 20_000
MOST_SECONDS = 600.0
"""Time limit of one call of an ONNX network."""
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
        PredictorError: the file or the function cannot be used.
    """
    path = Path(spec)
    if ":" in spec and not path.exists():
        return _function(spec)
    try:
        if path.suffix == ".safetensors":
            return read_voxnet(path)
        data = read_file(path, MAX_BYTES)
        return _onnx(path, data) if path.suffix == ".onnx" else _script(path, data, trust_code)
    except FileError as error:
        raise PredictorError(f"predictor {error}; {_HOW}") from None


class _OnnxNetwork:
    """A network in onnxruntime. A call that takes longer than `seconds` is ended: a graph may loop
    for ever."""

    def __init__(self, session: Any, options: Callable[[], Any], where: str) -> None:
        self.session, self.options, self.where = session, options, where
        self.seconds = MOST_SECONDS

    def __call__(self, grid: Tensor) -> Tensor:
        options = self.options()
        timer = threading.Timer(self.seconds, setattr, (options, "terminate", True))
        timer.start()
        name = self.session.get_inputs()[0].name
        try:
            (found,) = self.session.run(None, {name: grid.detach().cpu().numpy()}, options)
            return torch.as_tensor(found)
        except Exception as error:  # its errors share no class but this one
            why = " ".join(printable(error).split())[:200]
            if options.terminate:
                why = f"takes more than {self.seconds:g} s for {len(grid)} grids"
            raise PredictorError(f"{self.where}: {why}; {_HOW}") from None
        finally:
            timer.cancel()


def _onnx(path: Path, data: bytes) -> ContactPredictor:
    """The network on one thread, so that its bits do not depend on the machine's cores."""
    where = f"predictor {printable(path)}"
    try:
        import onnxruntime
    except ImportError:
        raise PredictorError(f"{where}: ONNX needs: pip install 'r2h_batch[onnx]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.add_session_config_entry("session.load_model_format", "ONNX")
    # weights in other files: nothing lies below a device, so every such file is refused
    outside = "session.model_external_initializers_file_folder_path"
    options.add_session_config_entry(outside, os.devnull)
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors share no class but this one
        if "xternal data" in str(error):
            raise PredictorError(f"{where}: keeps weights in other files; {_HOW}") from None
        why = " ".join(printable(error).split())[:200]
        raise PredictorError(f"{where}: not a readable ONNX file ({why}); {_HOW}") from None
    ends = len(session.get_inputs()), len(session.get_outputs())
    if ends != (1, 1):
        raise PredictorError(f"{where}: {ends[0]} inputs and {ends[1]} outputs; need one of each")
    if (kind := session.get_inputs()[0].type) != "tensor(float)":
        raise PredictorError(f"{where}: its input is a {kind}; it must be a tensor(float)")
    return _OnnxNetwork(session, onnxruntime.RunOptions, where)


def _script(path: Path, data: bytes, trust_code: bool) -> ContactPredictor:
    """A ScriptModule in evaluation mode on the CPU."""
    where = f"predictor {printable(path)}"
    if not zipfile.is_zipfile(io.BytesIO(data)):
        pickled = data[:1] == b"\x80"
        kind = "a pickle, which runs code when read" if pickled else "no network that is known here"
        raise PredictorError(f"{where}: {kind}; {_HOW}")
    with open_archive(path, MAX_BYTES) as archive:
        members = archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
    names = [m.filename for m in members]
    if not any(n.endswith("constants.pkl") for n in names) or not any("/code/" in n for n in names):
        kind = "a torch.save file (a pickle, which runs code when read)"
        raise PredictorError(f"{where}: {kind}; {_HOW}")
    if not trust_code:
        raise PredictorError(f"{where}: {_TRUST}")
    try:
        return torch.jit.load(io.BytesIO(data), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        why = printable(str(error).strip().partition("\n")[0])[:200]
        raise PredictorError(f"{where}: not a readable TorchScript file ({why}); {_HOW}") from error


def _function(spec: str) -> ContactPredictor:
    where = f"predictor {printable(spec)}"
    try:
        found = load_function(spec).function
    except (Exception, SystemExit) as error:  # a user's module runs when it is imported
        kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
        why = " ".join(f"{kind}{printable(error)}".split())[:200]
        raise PredictorError(f"{where}: {why}; {_HOW}") from error
    if not callable(found):
        raise PredictorError(f"{where}: is a {type(found).__name__}, no function; {_HOW}")
    return found
