"""A method's answers as a file: read with every check before any array is allocated, aligned to
trials, written."""

import json
import os
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any
from uuid import uuid4

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from r2h_batch.io.read import (
    DAMAGED_ARCHIVE,
    FileError,
    archive_members,
    open_archive,
    open_file,
    printable,
)
from r2h_batch.io.tables import read_csv_arrays, read_json_arrays
from r2h_batch.types import Predictions
from r2h_batch.validate import instance_of, text
from r2h_batch.validate import path as path_rule
from r2h_batch.validate_tensors import check_tensor
from r2h_batch.verdicts import MOST_SECONDS

MAX_MEMBERS = 16
MAX_BYTES = 8 << 30
"""Declared size above which a file is refused: about 60 million trials."""
MAX_HEADER_BYTES = 100_000
"""Of a .safetensors file: some thousand times what eight names and shapes need."""
MAX_METHOD_CHARS = 100

_FLOATS = ("float32", "float64")
_SHAPES = {"T_obj_ee": (4, 4), "T_world_ee": (4, 4), "t_method_s": ()}
_KEYS = "trial_id (N,) integer, T_obj_ee (N,4,4) and T_world_ee (N,4,4) float32; optional t_method_s (N,), method"
_HOW = "write np.savez(FILE, trial_id=..., T_obj_ee=..., T_world_ee=...) or r2h_batch.predictions.write_predictions"
_HOW_TEXT = {
    ".csv": "write the columns trial_id, T_obj_ee_0 to _15 and T_world_ee_0 to _15 (row by row), a line for each trial",
    ".json": 'write {"predictions": [{"trial_id": ..., "T_obj_ee": 4 x 4, "T_world_ee": 4 x 4}, ...]}',
}
_SAFETENSORS_DTYPES = {
    **{f"{k}{b}": f"{n}{b}" for k, n in (("I", "int"), ("U", "uint")) for b in (8, 16, 32, 64)},
    **{"F32": "float32", "F64": "float64", "F16": "float16"},
}


class PredictionsError(ValueError):
    """A predictions file that cannot be scored: the message names the file, what was found and what
    is allowed."""


@dataclass(frozen=True)
class _Array:
    """What a file declares about one array, and how to read it."""

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[], np.ndarray]


def load_predictions(path: str | Path) -> Predictions:
    """Predictions of a .npz, .safetensors, .csv or .json file, rows as in the file; the method's
    name defaults to the stem.

    CSV: columns trial_id, T_obj_ee_0 to _15 and T_world_ee_0 to _15 (row by row), optional
    t_method_s. JSON: an object with `method` and a list `predictions` of objects with the same
    names, poses as 16 numbers or 4 x 4. Poses are taken as they are: a row whose pose is not finite
    or not rigid is the evaluator's INVALID_INPUT.
    """
    path = path_rule("path", path)
    try:
        if path.suffix.lower() in (".csv", ".json"):
            method, values = _text(path)
            found = {k: _Array(v.shape, v.dtype.name, partial(_same, v)) for k, v in values.items()}
            return _checked(path, found, path.stem if method is None else method)
        with _npz(path) if _kind(path) == "npz" else _safetensors(path) as (method, arrays):
            return _checked(path, arrays, path.stem if method is None else method)
    except FileError as error:
        raise PredictionsError(f"{error}; {_HOW_TEXT.get(path.suffix.lower(), _HOW)}") from error


def _text(path: Path) -> tuple[str | None, dict[str, np.ndarray]]:
    """The arrays that a CSV or JSON file says, and the method's name."""
    widths, optional = (
        {"trial_id": 1, "T_obj_ee": 16, "T_world_ee": 16, "t_method_s": 1},
        ("t_method_s",),
    )
    said: dict[str, str] = {}
    if path.suffix.lower() == ".csv":
        values = read_csv_arrays(path, widths, optional)
    else:
        values, said = read_json_arrays(path, widths, optional, words=("method",))
    for name in ("T_obj_ee", "T_world_ee"):
        values[name] = values[name].reshape(-1, 4, 4)
    return said.get("method"), values


def _same(array: np.ndarray) -> np.ndarray:
    return array


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write a .npz or .safetensors file that `load_predictions` reads back equal; an existing file
    is replaced."""
    path = path_rule("path", path)
    instance_of(Predictions, "r2h_batch.Predictions(trial_id, T_obj_ee, T_world_ee)")(
        "predictions", predictions
    )
    for name in ("trial_id", "T_obj_ee", "T_world_ee"):
        check_tensor(f"predictions.{name}", getattr(predictions, name), "a torch tensor of N rows")
    text("predictions.method", predictions.method)
    arrays = {
        "trial_id": predictions.trial_id,
        "T_obj_ee": predictions.T_obj_ee,
        "T_world_ee": predictions.T_world_ee,
        "t_method_s": predictions.t_method_s,
    }
    data = {
        k: np.ascontiguousarray(v.detach().cpu().numpy())
        for k, v in arrays.items()
        if v is not None
    }
    temporary = path.with_name(f".{path.name}.{uuid4().hex}.tmp")
    try:
        if path.suffix == ".npz":
            with temporary.open("wb") as file:
                np.savez(file, method=np.array(predictions.method), **data)  # type: ignore[arg-type]
        elif path.suffix == ".safetensors":
            save_file(data, temporary, metadata={"method": predictions.method})
        else:
            raise PredictionsError(
                f"{path}: predictions are written as .npz or .safetensors, not {path.suffix!r}"
            )
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def align(
    predictions: Predictions, trial_id: torch.Tensor, *, source: str, allow_missing: bool = False
) -> torch.Tensor:
    """Row of `predictions` that answers each planned trial (N,) int64, -1 where there is none (only
    if allowed).

    Duplicate, unknown or missing ids are refused with the first ten listed; the order of the rows
    does not matter.
    """
    given, planned = predictions.trial_id.cpu().numpy(), trial_id.cpu().numpy()
    ids, first, copies = np.unique(given, return_index=True, return_counts=True)
    _refuse(source, "given more than once", ids[copies > 1], "give one row for each trial")
    unknown = "give only planned trials, or plan more of them (--splits, --trials)"
    _refuse(source, "not in the plan", np.setdiff1d(ids, planned), unknown)
    if len(ids) == 0:
        return torch.full((len(planned),), -1, dtype=torch.int64, device="cpu")
    at = np.minimum(np.searchsorted(ids, planned), len(ids) - 1)
    found = ids[at] == planned
    if not allow_missing:
        how = "predict every planned trial, or count them as failures with --allow-missing"
        _refuse(source, "planned but missing", planned[~found], how)
    return torch.from_numpy(np.where(found, first[at], -1).astype(np.int64))


LOOKS_RIGID, FAR_M = 1e-2, 10.0
_PIECE = 65_536


def doubts(predictions: Predictions) -> list[str]:
    """What somebody would want to hear about the poses before they are scored: how many are none,
    or in other units."""
    lines = []
    for name, what in (("T_obj_ee", "grasps"), ("T_world_ee", "handover poses")):
        T, n = getattr(predictions, name).numpy(), len(predictions)
        pieces = [_odd(T[k : k + _PIECE]) for k in range(0, n, _PIECE)]
        off, transposed, far = (np.concatenate([p[i] for p in pieces]) for i in range(3))
        for odd, words in (
            (
                off,
                "are no rigid pose and count as invalid"
                + (": transposed?" if (off & transposed).any() else ""),
            ),
            (far, f"are more than {FAR_M:g} m away: lengths are in metres"),
        ):
            if odd.any():
                first = int(predictions.trial_id[int(odd.argmax())])
                lines.append(
                    f"{int(odd.sum())} of {n} {what} ({name}; the first of trial {first}) {words}"
                )
    return lines


def _odd(T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) which are no rigid pose, which of these have their place in the last row, and which
    rigid ones are far away."""
    with np.errstate(all="ignore"):
        R = T[:, :3, :3].astype(np.float64)
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        off = ~(
            (off < LOOKS_RIGID)
            & (np.abs(T[:, 3] - [0, 0, 0, 1]).max(1) < LOOKS_RIGID)
            & (np.linalg.det(R) > 0)
        )
        return (
            off,
            (T[:, :3, 3] == 0).all(1) & (T[:, 3, :3] != 0).any(1),
            ~off & (np.abs(T[:, :3, 3]).max(1) > FAR_M),
        )


def _refuse(source: str, what: str, ids: np.ndarray, how: str) -> None:
    if len(ids):
        listed = ", ".join(map(str, ids[:10].tolist())) + (", ..." if len(ids) > 10 else "")
        count = "1 trial id is" if len(ids) == 1 else f"{len(ids)} trial ids are"
        raise PredictionsError(f"{source}: {count} {what}: {listed}; {how}")


def _kind(path: Path) -> str:
    with open_file(path, MAX_BYTES) as file:
        magic = file.read(16)
    if not magic:
        raise PredictionsError(f"{path}: the file is empty (0 bytes); {_HOW}")
    if magic[:1] == b"\x80" and magic[1:2] in b"\x00\x01\x02\x03\x04\x05":
        raise PredictionsError(
            f"{path}: a pickle, which can run code when read, is refused; load it yourself and {_HOW}"
        )
    if magic.startswith(b"\x93NUMPY"):
        raise PredictionsError(
            f"{path}: a single .npy array; predictions need several named ones: {_HOW}"
        )
    if magic.startswith(b"PK"):
        return "npz"
    if path.suffix == ".safetensors" or magic[8:9] == b"{":
        return "safetensors"
    raise PredictionsError(f"{path}: neither .npz, .safetensors, .csv nor .json; {_HOW}")


@contextmanager
def _npz(path: Path) -> Iterator[tuple[str | None, dict[str, _Array]]]:
    with open_archive(path, MAX_BYTES) as archive:
        names = [m.orig_filename for m in archive.infolist()]
        if any(
            PurePosixPath(n).name == "data.pkl" or n.endswith((".pkl", ".pickle", ".pt"))
            for n in names
        ):
            raise PredictionsError(
                f"{path}: a torch or pickle archive, which can run code when read, is refused; {_HOW}"
            )
        members = archive_members(archive, path, count=MAX_MEMBERS, size=MAX_BYTES)
        if unknown := [
            n for n in names if n not in [f"{k}.npy" for k in ("trial_id", "method", *_SHAPES)]
        ]:
            raise PredictionsError(
                f"{path}: unknown member {unknown[0]!r}; allowed keys are {_KEYS}"
            )
        arrays = {m.filename.removesuffix(".npy"): _npy(path, archive, m) for m in members}
        method = None
        if (name := arrays.pop("method", None)) is not None:
            if not name.dtype.startswith(("<U", ">U", "|U")) or name.shape not in ((), (1,)):
                raise PredictionsError(
                    f"{path}: 'method' is {name.dtype} {name.shape}; it must be one string: np.array('NAME')"
                )
            if np.dtype(name.dtype).itemsize > 4 * MAX_METHOD_CHARS:
                raise PredictionsError(
                    f"{path}: 'method' is longer than {MAX_METHOD_CHARS} characters"
                )
            try:
                # numpy makes a str of any four bytes, and Python ends with a SystemError on those
                # that are none
                method = (
                    _read(path, "method", name)
                    .tobytes()
                    .decode(f"utf-32-{sys.byteorder[0]}e")
                    .rstrip("\0")
                )
            except ValueError as error:  # four bytes that are no character
                raise PredictionsError(f"{path}: 'method' is no text ({error})") from error
        yield method, arrays


def _npy(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> _Array:
    """What a member's header declares, if the member holds just that."""
    key = member.filename.removesuffix(".npy")
    try:
        with archive.open(member) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a header that Python takes with a frown
            version = np.lib.format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"format version {version}")
            read = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, fortran, dtype = read(file)
            header = file.tell()
    except DAMAGED_ARCHIVE:
        raise
    except Exception as error:  # the header is Python text: its parser raises whatever it meets
        why = printable(str(error).partition("\n")[0])  # numpy goes on to recommend allow_pickle
        raise PredictionsError(
            f"{path}: {key!r} is not a plain array ({why[:200]}); {_HOW}"
        ) from error
    if dtype.hasobject:
        raise PredictionsError(
            f"{path}: {key!r} has dtype object, which is a pickle and is refused; {_HOW}"
        )
    size = header + int(np.prod([int(s) for s in shape], dtype=object)) * dtype.itemsize
    if size != member.file_size:
        raise PredictionsError(
            f"{path}: {key!r} claims {shape} {dtype} ({size} bytes) but holds {member.file_size} bytes"
        )

    def load() -> np.ndarray:
        with archive.open(member) as file:
            file.read(header)
            data = file.read(size - header)
            if len(data) != size - header or file.read(1):
                raise EOFError(f"{key!r} is not as long as its header says")
        return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")

    return _Array(tuple(shape), dtype.str if dtype.kind == "U" else dtype.name, load)


@contextmanager
def _safetensors(path: Path) -> Iterator[tuple[str | None, dict[str, _Array]]]:
    _check_safetensors_header(path)
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {}
            for key in file.keys():  # noqa: SIM118 (not a mapping)
                part = file.get_slice(key)
                dtype = _SAFETENSORS_DTYPES.get(part.get_dtype(), part.get_dtype())
                arrays[key] = _Array(tuple(part.get_shape()), dtype, partial(file.get_tensor, key))
            yield (file.metadata() or {}).get("method"), arrays
    except (SafetensorError, OSError) as error:
        why = printable(error)
        raise PredictionsError(
            f"{path}: truncated or damaged safetensors ({why}); write or copy it again"
        ) from error


def _check_safetensors_header(path: Path) -> None:
    """Refuse a header that is longer than it can honestly be, or that names more than a predictions
    file holds."""
    with open_file(path, MAX_BYTES) as file:
        length = int.from_bytes(file.read(8), "little")
        if length > MAX_HEADER_BYTES:
            raise PredictionsError(
                f"{path}: damaged safetensors: a header of {length} bytes; at most {MAX_HEADER_BYTES} are allowed"
            )
        text = file.read(length)
    try:
        header = json.loads(text, object_pairs_hook=_once)
        names = header.keys() - {"__metadata__"}
    except (ValueError, RecursionError, AttributeError) as error:
        why = printable(error)[:200]
        raise PredictionsError(
            f"{path}: damaged safetensors ({why}); write or copy it again"
        ) from error
    if len(names) > MAX_MEMBERS:
        raise PredictionsError(
            f"{path}: {len(names)} arrays; at most {MAX_MEMBERS} are allowed ({_KEYS})"
        )
    _check_keys(path, names)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"duplicate key {max(names, key=names.count)!r}")
    return found


def _checked(path: Path, arrays: Mapping[str, _Array], method: str) -> Predictions:
    _check_keys(path, arrays.keys())
    if not method.strip() or len(method) > MAX_METHOD_CHARS or not method.isprintable():
        raise PredictionsError(
            f"{path}: method {method[:120]!r} must be 1 to {MAX_METHOD_CHARS} printable characters"
        )
    ids = arrays["trial_id"]
    if len(ids.shape) != 1 or not ids.dtype.startswith(("int", "uint")):
        raise PredictionsError(
            f"{path}: 'trial_id' is {ids.dtype} {ids.shape}; it must be (N,) of an integer type"
        )
    n = ids.shape[0]
    if n == 0:
        raise PredictionsError(f"{path}: no rows; give one row for each planned trial")
    for key, tail in _SHAPES.items():
        if key in arrays and (arrays[key].shape != (n, *tail) or arrays[key].dtype not in _FLOATS):
            found, allowed = f"{arrays[key].dtype} {arrays[key].shape}", (n, *tail)
            raise PredictionsError(
                f"{path}: {key!r} is {found}; it must be {' or '.join(_FLOATS)} {allowed}"
            )
    trial_id = _read(path, "trial_id", ids)
    if trial_id.dtype == np.uint64 and trial_id.max() > np.iinfo(np.int64).max:
        raise PredictionsError(f"{path}: 'trial_id' {trial_id.max()} does not fit int64")
    given = {k: _read(path, k, arrays[k]) for k in _SHAPES if k in arrays}
    if (
        "t_method_s" in given
        and (odd := (given["t_method_s"] < 0) | (given["t_method_s"] > MOST_SECONDS)).any()
    ):
        seconds = given["t_method_s"][int(odd.argmax())]
        raise PredictionsError(
            f"{path}: 't_method_s' of row {int(odd.argmax())} is {seconds:g}; 0 to {MOST_SECONDS:g} seconds are allowed,"
            " NaN where it was not measured"
        )
    with np.errstate(
        over="ignore"
    ):  # what float32 does not hold becomes infinite: no pose, which is the evaluator's to say
        floats = {k: torch.from_numpy(v.astype(np.float32)) for k, v in given.items()}
    return Predictions(
        trial_id=torch.from_numpy(trial_id.astype(np.int64)),
        T_obj_ee=floats["T_obj_ee"],
        T_world_ee=floats["T_world_ee"],
        t_method_s=floats.get("t_method_s"),
        method=method,
    )


def _check_keys(path: Path, keys: Iterable[str]) -> None:
    keys = set(keys)
    if unknown := keys - {"trial_id", *_SHAPES}:
        raise PredictionsError(f"{path}: unknown key {min(unknown)!r}; allowed keys are {_KEYS}")
    if missing := {"trial_id", "T_obj_ee", "T_world_ee"} - keys:
        raise PredictionsError(f"{path}: key {min(missing)!r} is missing; needed are {_KEYS}")


def _read(path: Path, key: str, array: _Array) -> np.ndarray:
    data = array.read()
    return np.ascontiguousarray(data.astype(data.dtype.newbyteorder("=")))
