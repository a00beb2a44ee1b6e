"""A method's answers as a file: read with every check before any array is allocated, aligned to trials, written."""

import os
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from uuid import uuid4

import numpy as np
import torch

from r2h_batch.types import Predictions

MAX_MEMBERS = 16
MAX_BYTES = 8 << 30
"""Declared size above which a file is refused: about 60 million trials."""
MAX_RATIO = 200
RATIO_FREE_BYTES = 1 << 20
"""Members declared smaller than this may compress as well as they like."""
MAX_METHOD_CHARS = 100

_FLOATS = ("float32", "float64")
_SHAPES = {"T_obj_ee": (4, 4), "T_world_ee": (4, 4), "t_method_s": ()}
_KEYS = "trial_id (N,) integer, T_obj_ee (N,4,4) and T_world_ee (N,4,4) float32; optional t_method_s (N,), method"
_HOW = "write np.savez(FILE, trial_id=..., T_obj_ee=..., T_world_ee=...) or r2h_batch.predictions.write_predictions"
_SAFETENSORS_DTYPES = {
    **{f"{k}{b}": f"{n}{b}" for k, n in (("I", "int"), ("U", "uint")) for b in (8, 16, 32, 64)},
    **{"F32": "float32", "F64": "float64", "F16": "float16"},
}


class PredictionsError(ValueError):
    """A predictions file that cannot be scored: the message names the file, what was found and what is allowed."""


@dataclass(frozen=True)
class _Array:
    """What a file declares about one array, and how to read it."""

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[], np.ndarray]


def load_predictions(path: str | Path) -> Predictions:
    """Predictions of a .npz or .safetensors file, rows as in the file; the method's name defaults to the stem.

    Poses are taken as they are: a row whose pose is not finite or not rigid is the evaluator's INVALID_INPUT.
    """
    path = Path(path)
    kind = _kind(path)
    method, arrays = _npz(path) if kind == "npz" else _safetensors(path)
    return _checked(path, arrays, path.stem if method is None else method)


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write a .npz or .safetensors file that `load_predictions` reads back equal; an existing file is replaced."""
    path = Path(path)
    arrays = {
        "trial_id": predictions.trial_id,
        "T_obj_ee": predictions.T_obj_ee,
        "T_world_ee": predictions.T_world_ee,
        "t_method_s": predictions.t_method_s,
    }
    data = {k: np.ascontiguousarray(v.detach().cpu().numpy()) for k, v in arrays.items() if v is not None}
    temporary = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    try:
        if path.suffix == ".npz":
            with temporary.open("wb") as file:
                np.savez(file, method=np.array(predictions.method), **data)  # type: ignore[arg-type]
        elif path.suffix == ".safetensors":
            from safetensors.numpy import save_file

            save_file(data, temporary, metadata={"method": predictions.method})
        else:
            raise PredictionsError(f"{path}: predictions are written as .npz or .safetensors, not {path.suffix!r}")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def align(
    predictions: Predictions, trial_id: torch.Tensor, *, source: str, allow_missing: bool = False
) -> torch.Tensor:
    """Row of `predictions` that answers each planned trial (N,) int64, -1 where there is none (only if allowed).

    Duplicate, unknown or missing ids are refused with the first ten listed; the order of the rows does not matter.
    """
    given, planned = predictions.trial_id.cpu().numpy(), trial_id.cpu().numpy()
    ids, first, copies = np.unique(given, return_index=True, return_counts=True)
    _refuse(source, "given more than once", ids[copies > 1], "give one row for each trial")
    unknown = "give only planned trials, or plan more of them (--splits, --trials)"
    _refuse(source, "not in the plan", np.setdiff1d(ids, planned), unknown)
    if len(ids) == 0:
        return torch.full((len(planned),), -1, dtype=torch.int64)
    at = np.minimum(np.searchsorted(ids, planned), len(ids) - 1)
    found = ids[at] == planned
    if not allow_missing:
        how = "predict every planned trial, or count them as failures with --allow-missing"
        _refuse(source, "planned but missing", planned[~found], how)
    return torch.from_numpy(np.where(found, first[at], -1).astype(np.int64))


def _refuse(source: str, what: str, ids: np.ndarray, how: str) -> None:
    if len(ids):
        listed = ", ".join(map(str, ids[:10].tolist())) + (", ..." if len(ids) > 10 else "")
        raise PredictionsError(f"{source}: {len(ids)} trial ids are {what}: {listed}; {how}")


def _kind(path: Path) -> str:
    if not path.exists():
        raise PredictionsError(f"{path}: no such file; predictions are a .npz or .safetensors file")
    if not path.is_file():
        raise PredictionsError(f"{path}: not a regular file; predictions are a .npz or .safetensors file")
    with path.open("rb") as file:
        magic = file.read(16)
    if not magic:
        raise PredictionsError(f"{path}: the file is empty (0 bytes); {_HOW}")
    if magic[:1] == b"\x80" and magic[1:2] in b"\x00\x01\x02\x03\x04\x05":
        raise PredictionsError(
            f"{path}: a pickle, which can run code when read, is refused; load it yourself and {_HOW}"
        )
    if magic.startswith(b"\x93NUMPY"):
        raise PredictionsError(f"{path}: a single .npy array; predictions need several named ones: {_HOW}")
    if magic.startswith(b"PK"):
        return "npz"
    if path.suffix == ".safetensors" or magic[8:9] == b"{":
        return "safetensors"
    raise PredictionsError(f"{path}: neither .npz nor .safetensors; {_HOW}")


def _npz(path: Path) -> tuple[str | None, dict[str, _Array]]:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_members(path, members)
            arrays = {m.filename.removesuffix(".npy"): _npy_header(path, archive, m) for m in members}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise PredictionsError(f"{path}: truncated or damaged npz ({error}); write or copy it again") from error
    method = None
    if (name := arrays.pop("method", None)) is not None:
        if not name.dtype.startswith(("<U", ">U", "|U")) or name.shape not in ((), (1,)):
            raise PredictionsError(
                f"{path}: 'method' is {name.dtype} {name.shape}; it must be one string: np.array('NAME')"
            )
        if np.dtype(name.dtype).itemsize > 4 * MAX_METHOD_CHARS:
            raise PredictionsError(f"{path}: 'method' is longer than {MAX_METHOD_CHARS} characters")
        method = str(_read(path, "method", name).reshape(()).item())
    return method, arrays


def _check_members(path: Path, members: list[zipfile.ZipInfo]) -> None:
    """Refuse, from the archive's directory alone, everything that a predictions file never contains."""
    names = [m.orig_filename for m in members]
    if any(PurePosixPath(n).name == "data.pkl" or n.endswith((".pkl", ".pickle", ".pt")) for n in names):
        raise PredictionsError(f"{path}: a torch or pickle archive, which can run code when read, is refused; {_HOW}")
    if len(members) > MAX_MEMBERS:
        raise PredictionsError(f"{path}: {len(members)} members; at most {MAX_MEMBERS} are allowed ({_KEYS})")
    for m, name in zip(members, names):
        parts = PurePosixPath(name.replace("\\", "/"))
        if ".." in parts.parts or parts.is_absolute() or name[1:2] == ":" or "\0" in name:
            raise PredictionsError(f"{path}: member {name!r} points outside the archive; nothing is extracted")
        if stat.S_ISLNK(m.external_attr >> 16):
            raise PredictionsError(f"{path}: member {name!r} is a symbolic link; only arrays are allowed")
        if name.removesuffix(".npy") not in ("trial_id", "method", *_SHAPES) or not name.endswith(".npy"):
            raise PredictionsError(f"{path}: unknown member {name!r}; allowed keys are {_KEYS}")
        if m.flag_bits & 1:
            raise PredictionsError(f"{path}: member {name!r} is encrypted; {_HOW}")
        if m.file_size > RATIO_FREE_BYTES and m.file_size > MAX_RATIO * max(m.compress_size, 1):
            raise PredictionsError(
                f"{path}: member {name!r} declares {m.file_size} bytes from {m.compress_size}; at most {MAX_RATIO}"
                " times is allowed: write it with np.savez instead of np.savez_compressed"
            )
    if len(set(names)) != len(names):
        raise PredictionsError(f"{path}: duplicate member {max(names, key=names.count)!r}; every key may appear once")
    if (total := sum(m.file_size for m in members)) > MAX_BYTES:
        raise PredictionsError(
            f"{path}: declares {total} bytes; at most {MAX_BYTES} are allowed: split it into several runs"
        )


def _npy_header(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> _Array:
    key = member.filename.removesuffix(".npy")
    try:
        with archive.open(member) as file:
            version = np.lib.format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"format version {version}")
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
            header = file.tell()
    except ValueError as error:
        why = str(error).partition("\n")[0]  # numpy goes on to recommend allow_pickle
        raise PredictionsError(f"{path}: {key!r} is not a plain array ({why}); {_HOW}") from error
    if dtype.hasobject:
        raise PredictionsError(f"{path}: {key!r} has dtype object, which is a pickle and is refused; {_HOW}")
    size = header + int(np.prod([int(s) for s in shape], dtype=object)) * dtype.itemsize
    if size != member.file_size:
        raise PredictionsError(
            f"{path}: {key!r} claims {shape} {dtype} ({size} bytes) but holds {member.file_size} bytes"
        )

    def load() -> np.ndarray:
        with zipfile.ZipFile(path) as again, again.open(member.filename) as file:
            return np.asarray(np.lib.format.read_array(file, allow_pickle=False))

    return _Array(tuple(shape), dtype.str if dtype.kind == "U" else dtype.name, load)


def _safetensors(path: Path) -> tuple[str | None, dict[str, _Array]]:
    from safetensors import SafetensorError, safe_open

    def load(key: str) -> np.ndarray:
        with safe_open(path, framework="numpy") as again:
            return np.asarray(again.get_tensor(key))

    try:
        with safe_open(path, framework="numpy") as file:
            metadata, arrays = file.metadata() or {}, {}
            for key in file.keys():  # noqa: SIM118 (not a mapping)
                part = file.get_slice(key)
                dtype = _SAFETENSORS_DTYPES.get(part.get_dtype(), part.get_dtype())
                arrays[key] = _Array(tuple(part.get_shape()), dtype, partial(load, key))
    except (SafetensorError, OSError) as error:
        raise PredictionsError(f"{path}: truncated or damaged safetensors ({error}); write or copy it again") from error
    return metadata.get("method"), arrays


def _checked(path: Path, arrays: Mapping[str, _Array], method: str) -> Predictions:
    _check_keys(path, arrays.keys())
    if not method.strip() or len(method) > MAX_METHOD_CHARS or not method.isprintable():
        raise PredictionsError(f"{path}: method {method[:120]!r} must be 1 to {MAX_METHOD_CHARS} printable characters")
    ids = arrays["trial_id"]
    if len(ids.shape) != 1 or not ids.dtype.startswith(("int", "uint")):
        raise PredictionsError(f"{path}: 'trial_id' is {ids.dtype} {ids.shape}; it must be (N,) of an integer type")
    n = ids.shape[0]
    if n == 0:
        raise PredictionsError(f"{path}: no rows; give one row for each planned trial")
    for key, tail in _SHAPES.items():
        if key in arrays and (arrays[key].shape != (n, *tail) or arrays[key].dtype not in _FLOATS):
            found, allowed = f"{arrays[key].dtype} {arrays[key].shape}", (n, *tail)
            raise PredictionsError(f"{path}: {key!r} is {found}; it must be {' or '.join(_FLOATS)} {allowed}")
    trial_id = _read(path, "trial_id", ids)
    if trial_id.dtype == np.uint64 and trial_id.max() > np.iinfo(np.int64).max:
        raise PredictionsError(f"{path}: 'trial_id' {trial_id.max()} does not fit int64")
    floats = {k: torch.from_numpy(_read(path, k, arrays[k]).astype(np.float32)) for k in _SHAPES if k in arrays}
    seconds = floats.get("t_method_s")
    if seconds is not None and bool(((seconds < 0) | torch.isinf(seconds)).any()):
        raise PredictionsError(
            f"{path}: 't_method_s' has negative or infinite seconds; use NaN where it was not measured"
        )
    return Predictions(
        trial_id=torch.from_numpy(trial_id.astype(np.int64)),
        T_obj_ee=floats["T_obj_ee"],
        T_world_ee=floats["T_world_ee"],
        t_method_s=seconds,
        method=method,
    )


def _check_keys(path: Path, keys: Iterable[str]) -> None:
    keys = set(keys)
    if unknown := keys - {"trial_id", *_SHAPES}:
        raise PredictionsError(f"{path}: unknown key {min(unknown)!r}; allowed keys are {_KEYS}")
    if missing := {"trial_id", "T_obj_ee", "T_world_ee"} - keys:
        raise PredictionsError(f"{path}: key {min(missing)!r} is missing; needed are {_KEYS}")


def _read(path: Path, key: str, array: _Array) -> np.ndarray:
    try:
        data = array.read()
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, OSError) as error:
        raise PredictionsError(f"{path}: {key!r} is truncated or damaged ({error}); write or copy it again") from error
    return np.ascontiguousarray(data.astype(data.dtype.newbyteorder("=")))
