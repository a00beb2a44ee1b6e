"""A method's answers as a file: read with bounds, aligned to trials, written."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save_file

from r2h_batch.io.read import FileError, open_file, printable, read_npz, read_safetensors
from r2h_batch.io.tables import read_csv_arrays, read_json_arrays
from r2h_batch.io.write import atomic_path, write_npz
from r2h_batch.types import Predictions
from r2h_batch.validate import instance_of, text
from r2h_batch.validate import path as path_rule
from r2h_batch.validate_tensors import check_tensor
from r2h_batch.verdicts import MOST_SECONDS

MAX_BYTES = 8 << 30
"""Largest declared size of a file: about 60 million trials."""
MAX_METHOD_CHARS = 100

_NEEDED = ("trial_id", "T_obj_ee", "T_world_ee")
_SHAPES = {"T_obj_ee": (4, 4), "T_world_ee": (4, 4), "t_method_s": ()}
_WIDTHS = {"trial_id": 1, "T_obj_ee": 16, "T_world_ee": 16, "t_method_s": 1}
_KEYS = "trial_id (N,) integer, T_obj_ee (N,4,4) and T_world_ee (N,4,4) float32; optional t_method_s (N,), method"
_HOW = {
    "": "write np.savez(FILE, trial_id=..., T_obj_ee=..., T_world_ee=...) or r2h_batch.predictions.write_predictions",
    ".csv": "write the columns trial_id, T_obj_ee_0 to _15 and T_world_ee_0 to _15 (row by row), a line for each trial",
    ".json": 'write {"predictions": [{"trial_id": ..., "T_obj_ee": 4 x 4, "T_world_ee": 4 x 4}, ...]}',
}


class PredictionsError(ValueError):
    """A predictions file that cannot be scored. The message says what was found and what is
    allowed."""


def load_predictions(path: str | Path) -> Predictions:
    """Read predictions from a .npz, .safetensors, .csv or .json file.

    CSV: columns trial_id, T_obj_ee_0 to _15 and T_world_ee_0 to _15 (row by row), optional
    t_method_s. JSON: an object with `method` and a list `predictions` of objects with the same
    names, poses as 16 numbers or 4 x 4.

    Args:
        path: the file.

    Returns:
        The predictions, rows as in the file. The method's name defaults to the file's stem. Poses
        that are not finite or not rigid stay: the evaluator counts them as INVALID_INPUT.

    Raises:
        PredictionsError: the file cannot be scored.
    """
    path = path_rule("path", path)
    suffix = path.suffix.lower()
    try:
        return _checked(path, *_arrays(path, suffix))
    except FileError as error:
        raise PredictionsError(f"{error}; {_HOW.get(suffix, _HOW[''])}") from error


def _arrays(path: Path, suffix: str) -> tuple[dict[str, Any], str]:
    """The arrays of a file, as they are, and the method's name."""
    if suffix == ".csv":
        return read_csv_arrays(path, _WIDTHS, ["t_method_s"]), path.stem
    if suffix == ".json":
        arrays, words = read_json_arrays(path, _WIDTHS, ["t_method_s"], words=["method"])
        return arrays, words.get("method", path.stem)
    shown = printable(path)
    with open_file(path, MAX_BYTES) as file:
        magic = file.read(16)
    if magic.startswith(b"PK"):
        arrays = read_npz(path, most=MAX_BYTES, most_each=MAX_BYTES)
        method = arrays.pop("method", np.array(path.stem))
        if method.dtype.kind != "U" or method.size != 1:
            found = f"'method' is {method.dtype} {method.shape}"
            raise FileError(f"{shown}: {found}; it must be one string: np.array('NAME')")
        return arrays, str(method.item())
    if suffix == ".safetensors" or magic[8:9] == b"{":
        arrays, metadata = read_safetensors(path, most=MAX_BYTES)
        return arrays, metadata.get("method", path.stem)
    what = "neither .npz, .safetensors, .csv nor .json"
    if not magic:
        what = "the file is empty (0 bytes)"
    elif magic[:1] == b"\x80" and magic[1] < 6:
        what = "a pickle, which can run code when read, is refused; load it yourself"
    elif magic.startswith(b"\x93NUMPY"):
        what = "a single .npy array; predictions need several named ones"
    raise FileError(f"{shown}: {what}")


def _checked(path: Path, arrays: dict[str, Any], method: str) -> Predictions:
    shown = printable(path)
    for name in ("T_obj_ee", "T_world_ee"):
        if path.suffix.lower() in (".csv", ".json") and name in arrays:
            arrays[name] = arrays[name].reshape(-1, 4, 4)
    if unknown := sorted(set(arrays) - set(_WIDTHS)):
        raise FileError(f"{shown}: unknown key {unknown[0]!r}; allowed keys are {_KEYS}")
    if missing := [k for k in _NEEDED if k not in arrays]:
        raise FileError(f"{shown}: key {missing[0]!r} is missing; needed are {_KEYS}")
    if not method.strip() or len(method) > MAX_METHOD_CHARS or not method.isprintable():
        found = f"method {printable(method[:120])!r}"
        raise FileError(f"{shown}: {found} must be 1 to {MAX_METHOD_CHARS} printable characters")
    ids = arrays.pop("trial_id")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        found = f"'trial_id' is {ids.dtype} {ids.shape}"
        raise FileError(f"{shown}: {found}; it must be (N,) of an integer type")
    n = len(ids)
    if n == 0:
        raise FileError(f"{shown}: no rows; give one row for each planned trial")
    if ids.dtype == np.uint64 and ids.max() > np.iinfo(np.int64).max:
        raise FileError(f"{shown}: 'trial_id' {ids.max()} does not fit int64")
    for key, value in arrays.items():
        allowed = (n, *_SHAPES[key])
        if value.shape != allowed or value.dtype.name not in ("float32", "float64"):
            found = f"{key!r} is {value.dtype} {value.shape}"
            raise FileError(f"{shown}: {found}; it must be float32 or float64 {allowed}")
    if (seconds := arrays.get("t_method_s")) is not None:
        odd = (seconds < 0) | (seconds > MOST_SECONDS)
        if odd.any():
            row = int(odd.argmax())
            found = f"'t_method_s' of row {row} is {seconds[row]:g}"
            raise FileError(
                f"{shown}: {found}; 0 to {MOST_SECONDS:g} seconds are allowed, NaN where not measured"
            )
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, an invalid pose
        floats = {k: torch.from_numpy(np.array(v, np.float32)) for k, v in arrays.items()}
    return Predictions(trial_id=torch.from_numpy(ids.astype(np.int64)), method=method, **floats)


def write_predictions(path: str | Path, predictions: Predictions) -> None:
    """Write predictions to a .npz or .safetensors file; `load_predictions` reads them back equal.

    Args:
        path: the file; an existing one is replaced.
        predictions: the predictions.

    Raises:
        PredictionsError: the file has another ending.
    """
    path = path_rule("path", path)
    instance_of(Predictions, "r2h_batch.Predictions(trial_id, T_obj_ee, T_world_ee)")(
        "predictions", predictions
    )
    method, data = text("predictions.method", predictions.method), {}
    for name in _WIDTHS:
        value = getattr(predictions, name)
        if value is not None or name in _NEEDED:
            value = check_tensor(f"predictions.{name}", value, "a torch tensor of N rows")
            data[name] = np.ascontiguousarray(value.detach().cpu().numpy())
    if path.suffix == ".npz":
        write_npz(path, {"method": np.array(method), **data})
    elif path.suffix == ".safetensors":
        with atomic_path(path) as temporary:
            save_file(data, temporary, metadata={"method": method})
    else:
        allowed = "predictions are written as .npz or .safetensors"
        raise PredictionsError(f"{printable(path)}: {allowed}, not {path.suffix!r}")


def align(
    predictions: Predictions, trial_id: torch.Tensor, *, source: str, allow_missing: bool = False
) -> torch.Tensor:
    """The row of `predictions` that answers each planned trial. The order of rows does not matter.

    Args:
        predictions: the answers.
        trial_id: (N,) int64, the planned trials.
        source: where the answers come from, for messages.
        allow_missing: whether planned trials may have no answer.

    Returns:
        (N,) int64 row numbers, -1 where there is no answer.

    Raises:
        PredictionsError: ids are given twice, are not planned, or are missing.
    """
    answered, planned = predictions.trial_id.cpu().numpy(), trial_id.cpu().numpy()
    ids, first, copies = np.unique(answered, return_index=True, return_counts=True)
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


LOOKS_RIGID, FAR_M, OBJECT_M = 1e-2, 10.0, 0.35
_PIECE = 65_536  # rows looked at together, which bounds the memory


def doubts(predictions: Predictions) -> list[str]:
    """Warnings about the poses, one line each: how many are not rigid, are far away as in other
    units, or look as if grasp and handover were exchanged."""
    lines = []
    for name, what in (("T_obj_ee", "grasps"), ("T_world_ee", "handover poses")):
        T, n = getattr(predictions, name).numpy(), len(predictions)
        pieces = [_odd(T[k : k + _PIECE]) for k in range(0, n, _PIECE)]
        off, transposed, far = (np.concatenate([p[i] for p in pieces]) for i in range(3))
        hint = ": transposed?" if (off & transposed).any() else ""
        for odd, words in (
            (off, f"are no rigid pose and count as invalid{hint}"),
            (far, f"are more than {FAR_M:g} m away: lengths are in metres"),
        ):
            if odd.any():
                first = int(predictions.trial_id[int(odd.argmax())])
                where = f"({name}; the first of trial {first})"
                lines.append(f"{int(odd.sum())} of {n} {what} {where} {words}")
    grasp, handover = (
        np.linalg.norm(T[:, :3, 3].numpy(), axis=1)
        for T in (predictions.T_obj_ee, predictions.T_world_ee)
    )
    swapped = (grasp > OBJECT_M) & (handover < grasp) & (grasp < FAR_M)
    if 2 * int(swapped.sum()) > n:
        lines.append(
            f"most grasps (T_obj_ee) are more than {OBJECT_M:g} m from the object's origin, and"
            " handover poses (T_world_ee) nearer to the robot's base: exchanged?"
        )
    return lines


def _odd(T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of (n, 4, 4) poses (n,) masks: not rigid; with the translation in the last row; rigid and far
    away."""
    with np.errstate(all="ignore"):
        R = T[:, :3, :3].astype(np.float64)
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        last_row = np.abs(T[:, 3] - [0, 0, 0, 1]).max(1)
        rigid = (error < LOOKS_RIGID) & (last_row < LOOKS_RIGID) & (np.linalg.det(R) > 0)
        transposed = (T[:, :3, 3] == 0).all(1) & (T[:, 3, :3] != 0).any(1)
        return ~rigid, transposed, rigid & (np.abs(T[:, :3, 3]).max(1) > FAR_M)


def _refuse(source: str, what: str, ids: np.ndarray, how: str) -> None:
    if len(ids):
        listed = ", ".join(map(str, ids[:10].tolist())) + (", ..." if len(ids) > 10 else "")
        count = "1 trial id is" if len(ids) == 1 else f"{len(ids)} trial ids are"
        raise PredictionsError(f"{source}: {count} {what}: {listed}; {how}")
