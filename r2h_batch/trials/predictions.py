"""A method's answers as a file: read with bounds, aligned to trials, written.

An answer is a handover pose, which the evaluator plans a motion to, or a motion of the caller's own
planner, which is judged as it is.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.declared import (
    ALLOWED,
    DECLARED,
    FROM_BASE_M,
    FROM_HAND_M,
    OF_OBJECT_M,
    Declared,
    declaration,
    joint_columns,
    ours,
    taken,
    unit_of,
)
from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.arrays import RIGID, Spec, check_array, check_arrays, not_rigid
from r2h_batch.base.io.read import open_file, printable, read_npz
from r2h_batch.base.io.tables import MAX_CSV_BYTES, read_csv_arrays, read_json_arrays
from r2h_batch.base.io.write import write_npz
from r2h_batch.base.registry import READS
from r2h_batch.base.validate import instance_of, one_of, text
from r2h_batch.base.validate import path as path_rule
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import MOST_SECONDS

MAX_BYTES = 8 << 30
"""Largest declared size of a file: about 60 million trials."""
MAX_METHOD_CHARS = 100
MOST_SAMPLES = 4_500
"""Most samples of one motion: 9 s at 500 Hz, 75 s at 60 Hz."""

COARSE_S = 1e4
"""Beyond this, steps of float32 are longer than a millisecond."""

_NEEDED = ("trial_id", "T_obj_ee", "T_world_ee")
_POSES = ("T_obj_ee", "T_world_ee")
_SPECS: dict[str, Spec] = {
    "trial_id": ("iu", ("N",)), **dict.fromkeys(_POSES, ("f", ("N", 4, 4))), "t_method_s": ("f", ("N",)),
}  # fmt: skip
_CSV = {
    "trial_id": ("int64", 1), **dict.fromkeys(_POSES, ("float64", 16)), "t_method_s": ("float64", 1),
    **dict.fromkeys(("benchmark", "reads", *ALLOWED), ("string", 1)),
}  # fmt: skip
_CSV_QUATERNIONS = {**_CSV, **dict.fromkeys(_POSES, ("float64", 7))}
_MOTION_KEYS = ("q", "time_s", "length")
_LENGTH_OF = {"q": "length", "time_s": "length", "planned_q": "planned_length"}
_HOW_MOTIONS = (
    "motions need trial_id or id (N,), T_obj_ee (N,4,4), q (S,joints) rad and time_s (S,) s of all "
    "samples one after another, length (N,) samples of each; T_world_ee (N,4,4) where a length is 0"
)
_HOW = {
    "": "write np.savez(FILE, trial_id=..., T_obj_ee=..., T_world_ee=..., benchmark=trials.benchmark), or"
    " r2h_batch.trials.predictions.write_predictions",
    ".csv": "write the columns trial_id, T_obj_ee_0 to _15 and T_world_ee_0 to _15 (row by row), a line for each trial",
    ".json": 'write {"trial_id": [...], "T_obj_ee": [4 x 4, ...], "T_world_ee": [4 x 4, ...]}',
}


@dataclass(frozen=True, eq=False)
class Motions:
    """Joint motions of N answers, the samples of all of them one after another."""

    q: Float32[Tensor, "s j"]  # rad
    time_s: Float32[Tensor, " s"]  # from the motion's first sample on
    length: Int64[Tensor, " n"]  # samples; 0: the answer is a pose
    planned_q: Float32[Tensor, "p j"] | None = None  # rad, of plans that the motions differ from
    planned_length: Int64[Tensor, " n"] | None = None

    def padded(self, rows: Tensor, device: Any = "cpu") -> dict[str, Tensor]:
        """q (B, W, joints), time_s (B, W), length (B,) and, if there are plans, planned_q and
        planned_length of these answers, as `Evaluator.score_motion` takes them: samples beyond the
        length repeat the last one."""
        at, length = _slots(self.length, rows)
        found = {"q": self.q[at], "time_s": self.time_s[at], "length": length}
        if self.planned_q is not None and self.planned_length is not None:
            at, length = _slots(self.planned_length, rows)
            found |= {"planned_q": self.planned_q[at], "planned_length": length}
        return {name: value.to(device) for name, value in found.items()}


def _slots(length: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """(B, W) places of the rows' samples, the last one repeated, and (B,) lengths."""
    first, length = (length.cumsum(0) - length)[rows], length[rows]
    slot = torch.arange(int(length.max()), dtype=torch.int64, device="cpu")
    return first[:, None] + slot.minimum(length[:, None] - 1), length


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers of a file: poses, motions or both."""

    predictions: Predictions
    motions: Motions | None = None
    ids: tuple[str, ...] | None = None
    """texts that name the trials; None: `predictions.trial_id` does"""
    benchmark: str = ""
    """`Trials.benchmark` of the trials that they answer; empty: the file does not say"""
    frame: str = ""
    """what the file declares of `T_world_ee`: `hand` is still to be taken into the world (`in_world`)"""
    joint_names: tuple[str, ...] = ()
    """of the columns of q, where the file declares them"""
    reads: str = ""
    """what the method read, a word of `READS`; empty: the file does not say"""

    def in_world(self, poses: Predictions, trials: Trials) -> Predictions:
        """Poses of these answers in the world, each of the trial in its row."""
        if self.frame != "hand":
            return poses
        T_world_hand = trials.T_world_hand.to(poses.T_world_ee)
        return replace(poses, T_world_ee=se3.matmul(T_world_hand, poses.T_world_ee))

    def ordered(self, joints: Sequence[str], home: Sequence[float], source: str) -> "Answers":
        """The same with the joints in a robot's order, where the file names its columns.

        Args:
            joints: of the robot.
            home: the posture at which its motions begin as a rule, rad.
            source: where the answers come from, for messages.

        Raises:
            FileError: a joint is not named, or the motions begin at home as they stand, and not as they are named.
        """
        if not self.joint_names or self.motions is None:
            return self
        at, motions = joint_columns(self.joint_names, joints, source), self.motions
        length = motions.length[motions.length > 0]
        first = motions.q[length.cumsum(0) - length]
        if first.shape[1:] == (len(home),) and len(first):
            off = (first[:, [at, list(range(len(home)))]] - first.new_tensor(list(home))).abs()
            named, given = off.amax(2).unbind(1)
            if given.max() < AT_HOME_RAD < named.min():
                raise FileError(
                    f"{source}: all {len(first)} motions begin at home with the columns as they stand, and none with the"
                    f" order of joint_names: name the columns of q in their order; it seems to be {', '.join(joints)}"
                )
        plans = motions.planned_q
        motions = replace(
            motions, q=motions.q[:, at], planned_q=None if plans is None else plans[:, at]
        )
        return replace(self, motions=motions)

    def named(self, trial_ids: dict[str, int] | None, source: str) -> "Answers":
        """The same with the numbers of the trials that are named by text.

        Raises:
            FileError: the trials have no texts, or a text names none of them.
        """
        if self.ids is None:
            return self
        if trial_ids is None:
            raise FileError(f"{source}: names trials by id; these trials have numbers only")
        if unknown := [i for i in self.ids if i not in trial_ids]:
            raise FileError(f"{source}: no trial has the id {printable(unknown[0])[:80]!r}")
        numbers = torch.tensor([trial_ids[i] for i in self.ids], dtype=torch.int64, device="cpu")
        return replace(self, predictions=replace(self.predictions, trial_id=numbers), ids=None)


def load_predictions(path: str | Path) -> Predictions:
    """Read predictions from a .npz file, or a .json file of the same arrays as lists, or a .csv file
    with the columns trial_id, T_obj_ee_0 to _15, T_world_ee_0 to _15 (row by row) and t_method_s.
    Conventions that the file declares (docs/howto/method.md) are converted.

    Args:
        path: the file.

    Returns:
        The predictions, rows as in the file. The method's name defaults to the file's stem. Poses
        that are not finite or not rigid stay: the evaluator counts them as INVALID_INPUT.

    Raises:
        FileError: the file cannot be scored.
    """
    answers = load_answers(path)
    if answers.motions is not None:
        raise FileError(f"{printable(path)}: holds motions; judge them with --motions")
    if answers.ids is not None:
        raise FileError(f"{printable(path)}: names trials by id; give trial_id")
    if answers.frame == "hand":
        raise FileError(
            f"{printable(path)}: declares frame=hand; sweep the file, which knows its trials, or write T_world_ee ="
            " trials.T_world_hand @ T_hand_ee"
        )
    return answers.predictions


def load_answers(path: str | Path) -> Answers:
    """Read predictions as `load_predictions` does, or motions, from a .npz, .json or .parquet
    file (docs/run_folder.md, Motions file).

    Raises:
        FileError: the file cannot be scored.
    """
    path = path_rule("path", path)
    suffix = path.suffix.lower()
    how = _HOW.get(suffix, _HOW[""])
    try:
        arrays, method = _arrays(path, suffix)
        shown = printable(path)
        declared = taken(arrays, shown)
        benchmark = _same_text(arrays, "benchmark", shown)
        reads = _reads(arrays, shown)
        ids = None
        if "id" in arrays:
            check_array(f"{shown}: id", arrays["id"], ("U", ("N",)))
            ids = tuple(arrays.pop("id").tolist())
            if "trial_id" in arrays:
                raise FileError(f"{shown}: has trial_id and id; give one of the two")
            arrays["trial_id"] = np.arange(len(ids))
        for name in arrays.keys() & set(_POSES):
            arrays[name] = declared.poses(name, arrays[name])
        if "t_method_s" in arrays:
            arrays["t_method_s"] = declared.times(arrays["t_method_s"])
        if not arrays.keys() & set(_MOTION_KEYS):
            if declared.joint_names:
                raise FileError(f"{shown}: declares joint_names, and has no motions (q)")
            poses = _declared_poses(_checked(path, arrays, method), declared)
            return Answers(poses, None, ids, benchmark, declared.frame, reads=reads)
        how = _HOW_MOTIONS
        motions = _motions(arrays, shown, declared)
        if "T_world_ee" not in arrays:
            if not bool((motions.length > 0).all()):
                raise FileError(f"{shown}: length of some trial is 0, and there is no T_world_ee")
            arrays["T_world_ee"] = np.full((len(motions.length), 4, 4), np.nan, np.float32)
        poses = _declared_poses(_checked(path, arrays, method), declared)
        return Answers(poses, motions, ids, benchmark, declared.frame, declared.joint_names, reads)
    except FileError as error:
        raise FileError(f"{error}; {how}") from error


def _declared_poses(poses: Predictions, declared: Declared) -> Predictions:
    """Poses in the world, but for those in the hand's frame; their unit is looked at."""
    declared.check_lengths("T_obj_ee", poses.T_obj_ee.detach().cpu().numpy(), OF_OBJECT_M)
    far = FROM_HAND_M if declared.frame == "hand" else FROM_BASE_M
    declared.check_lengths("T_world_ee", poses.T_world_ee.detach().cpu().numpy(), far)
    if declared.frame != "base":
        return poses
    T_world_ee = declared.in_world(poses.T_world_ee.numpy())
    return replace(poses, T_world_ee=torch.from_numpy(T_world_ee))


def _motions(arrays: dict[str, Any], shown: str, declared: Declared) -> Motions:
    """The motions among the arrays, which lose them."""
    if missing := [k for k in _MOTION_KEYS if k not in arrays]:
        raise FileError(f"{shown}: has no {missing[0]}")
    n, lengths = len(arrays.get("trial_id", ())), dict[str, int]()
    length = _lengths("length", arrays.pop("length"), n, shown)
    q = _samples("q", arrays.pop("q"), (int(length.sum()), "joints"), "length", shown, lengths)
    if (n_names := len(declared.joint_names)) not in (0, q.shape[1]):
        raise FileError(f"{shown}: joint_names has {n_names} names, and q {q.shape[1]} columns")
    declared.check_angles("q", q, length)
    q = declared.angles(q)
    time_s = declared.times(arrays.pop("time_s"))
    time_s = _samples("time_s", time_s, (len(q),), "length", shown)
    if time_s.dtype.itemsize == 4 and len(time_s) and np.nanmax(np.abs(time_s)) > COARSE_S:
        step = float(np.spacing(np.float32(np.nanmax(np.abs(time_s)))))
        how = "write float64, or times from the motion's start"
        if unit := declared.other_time_unit(time_s, length):
            how = f"as {unit} they are those of motions: {declaration('time_unit', unit)}"
        raise FileError(
            f"{shown}: time_s is float32 and goes to {np.nanmax(np.abs(time_s)):.3g} s, where its steps are {step:.2g} s: {how}"
        )
    declared.check_times(time_s, length)
    first = np.repeat((np.cumsum(length) - length)[length > 0], length[length > 0])
    with np.errstate(over="ignore", invalid="ignore"):
        # a time of day in float32 would have steps of milliseconds
        found = [q.astype(np.float32), (time_s - time_s[first]).astype(np.float32), length]
        if "planned_q" in arrays or "planned_length" in arrays:
            plan = _lengths("planned_length", arrays.pop("planned_length", np.zeros(0)), n, shown)
            if (odd := (plan == 0) & (length > 0)).any():
                row = int(odd.argmax())
                raise FileError(f"{shown}: 'planned_length' of row {row} is 0; need its plan")
            planned = arrays.pop("planned_q", np.zeros(0))
            planned = _samples(
                "planned_q", planned, (int(plan.sum()), "joints"), "planned_length", shown, lengths
            )
            found += [declared.angles(planned).astype(np.float32), plan]
    return Motions(*map(torch.from_numpy, found))


def _lengths(key: str, value: Any, n: int, shown: str) -> Any:
    check_array(f"{shown}: {key}", value, ("iu", (n,)))
    odd = (value < 0) | (value == 1) | (value > MOST_SAMPLES)
    if odd.any():
        row = int(odd.argmax())
        found = f"{key!r} of row {row} is {value[row]}"
        raise FileError(f"{shown}: {found}; a motion has 2 to {MOST_SAMPLES} samples, 0: none")
    return value.astype(np.int64)


def _samples(
    key: str,
    value: Any,
    shape: tuple[int | str, ...],
    rows: str,
    shown: str,
    lengths: dict[str, int] | None = None,
) -> Any:
    what = f"{shown}: {key} (its rows are the sum of {rows})"
    check_array(what, value, ("f", shape), lengths, gaps=True)
    _check_precision(key, value, shown)
    return value


def _check_precision(key: str, value: Any, shown: str) -> None:
    if value.dtype.itemsize < 4:  # steps of 0.5 mm at 1 m
        raise FileError(f"{shown}: {key} is {value.dtype}; it must be float32 or float64")


def _arrays(path: Path, suffix: str) -> tuple[dict[str, Any], str]:
    """The arrays of a file, as they are, and the method's name."""
    shown = printable(path)
    if suffix == ".parquet":
        return _parquet(path), path.stem
    if suffix == ".csv":
        with open_file(path, MAX_CSV_BYTES) as file:
            quaternions = b"quaternion_order" in file.readline(1 << 20)
        arrays = read_csv_arrays(path, _CSV_QUATERNIONS if quaternions else _CSV)
        poses = {k: v.reshape(-1, 4, 4) for k, v in arrays.items() if v.shape[1:] == (16,)}
        return {**arrays, **poses}, path.stem
    with open_file(path, MAX_BYTES) as file:
        magic = file.read(16)
    if suffix == ".json" or magic.startswith(b"PK"):
        arrays = (
            read_json_arrays(path)
            if suffix == ".json"
            else read_npz(path, most=MAX_BYTES, most_each=MAX_BYTES)
        )
        return arrays, _one_text(arrays.pop("method", np.array(path.stem)), "method", shown)
    what = "neither .npz, .parquet, .csv nor .json"
    if not magic:
        what = "the file is empty (0 bytes)"
    elif magic[:1] == b"\x80" and magic[1] < 6:
        what = "a pickle, which can run code when read, is refused; load it yourself"
    elif magic.startswith(b"\x93NUMPY"):
        what = "a single .npy array; predictions need several named ones"
    raise FileError(f"{shown}: {what}")


def _one_text(value: Any, name: str, shown: str) -> str:
    """The text of an array of one."""
    if value.dtype.kind != "U" or value.size != 1:
        found = f"{name!r} is {value.dtype} {value.shape}"
        raise FileError(f"{shown}: {found}; it must be one string: np.array('NAME')")
    return str(value.item())


def _same_text(arrays: dict[str, Any], name: str, shown: str) -> str:
    """A text that a file declares, which its arrays lose: alone or, in tables, the same in every row. Empty where it does
    not."""
    return _one_text(np.unique(arrays.pop(name, np.array(""))), name, shown)


def _reads(arrays: dict[str, Any], shown: str) -> str:
    """What the method of a file read, as it says."""
    word = _same_text(arrays, "reads", shown)
    if word and word not in READS:
        raise FileError(
            f"{shown}: reads is {printable(word)[:40]!r}{nearest(word, list(READS))}; allowed are {', '.join(READS)}"
        )
    return word


def _parquet(path: Path) -> dict[str, Any]:
    """Motions, one a row: trial_id or id, T_obj_ee (16 numbers), q (lists of joint angles), time_s (a list)."""
    from r2h_batch.base.io.parquet import read_parquet_arrays  # 0.1 s, for few files

    texts = ["id", "benchmark", "reads", *DECLARED]
    arrays, counts = read_parquet_arrays(path, most=MAX_BYTES, rows=10_000_000, text=texts)
    if "joint_names" in counts:
        arrays["joint_names"] = _of_rows(arrays["joint_names"], counts["joint_names"], path)
    width = 7 if "quaternion_order" in arrays else 16
    for name, length in _LENGTH_OF.items():
        if name in counts:
            arrays.setdefault(length, counts[name])
    for name in arrays.keys() & {"T_obj_ee", "T_world_ee"}:
        widths = counts.get(name, np.ones(1))
        if (odd := widths != width).any():
            row = int(odd.argmax())
            found = f"{name!r} has {widths[row]} numbers in row {row}"
            need = f"it needs {width} numbers a row"
            if width == 16 and (widths == 7).all():
                need += ", or 7 and a column quaternion_order (wxyz or xyzw)"
            raise FileError(f"{printable(path)}: {found}; {need}")
    for name in arrays.keys() & {"T_obj_ee", "T_world_ee", "q", "planned_q"}:
        size, rows = arrays[name].size, int(np.sum(counts.get(name, 0)))
        of_pose = (4, 4) if width == 16 else (7,)
        shape = (rows, size // max(rows, 1)) if name in _LENGTH_OF else (size // width, *of_pose)
        if size != math.prod(shape):
            need = "lists of one angle a joint" if name in _LENGTH_OF else f"{width} numbers a row"
            raise FileError(f"{printable(path)}: {name!r} has {size} numbers; it needs {need}")
        arrays[name] = arrays[name].reshape(shape)
    return arrays


def _of_rows(values: Any, counts: Any, path: Path) -> Any:
    """(N, K) of the texts of N rows, K each."""
    if not len(counts) or (counts != counts[0]).any():
        raise FileError(
            f"{printable(path)}: 'joint_names' has lists of different lengths; all must have one"
        )
    return values.reshape(len(counts), -1)


def _checked(path: Path, arrays: dict[str, Any], method: str) -> Predictions:
    shown = printable(path)
    if not method.strip() or len(method) > MAX_METHOD_CHARS or not method.isprintable():
        found = f"method {printable(method[:120])!r}"
        raise FileError(f"{shown}: {found} must be 1 to {MAX_METHOD_CHARS} printable characters")
    optional, poses = ("t_method_s",), ("T_obj_ee", "T_world_ee", "t_method_s")
    others = ("method", "benchmark", "reads", *DECLARED)
    n = check_arrays(arrays, _SPECS, shown, optional=optional, only=True, gaps=poses, taken=others)[
        "N"
    ]
    ids = arrays.pop("trial_id")
    if n == 0:
        raise FileError(f"{shown}: no rows; give one row for each planned trial")
    if ids.dtype == np.uint64 and ids.max() > np.iinfo(np.int64).max:
        raise FileError(f"{shown}: 'trial_id' {ids.max()} does not fit int64")
    for key, value in arrays.items():
        _check_precision(key, value, shown)
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


def check_benchmark(answers: Answers, benchmark: str, source: str) -> None:
    """Refuses answers to trials of another benchmark: trial ids are 0, 1, 2 in every one.

    Args:
        answers: of a file.
        benchmark: `Benchmark.label` of the trials that are planned.
        source: where the answers come from, for messages.

    Raises:
        FileError: they say that they answer another one.
    """
    (name, _, digest), (ours, _, own) = (
        text.rpartition("@") for text in (answers.benchmark, benchmark)
    )
    if answers.benchmark and not name:
        raise FileError(
            f"{source}: its benchmark is {printable(answers.benchmark)[:80]!r}, which is no name@digest; write that of"
            f" the trials that it answers, load_benchmark(...).trials(...).benchmark: here it is {benchmark!r}"
        )
    if answers.benchmark and digest != own:
        found = f"answers trials of benchmark {printable(name)[:80]} ({printable(digest)[:8]})"
        raise FileError(
            f"{source}: {found}, and {ours} ({own[:8]}) is judged here; name its benchmark with --benchmark, or answer"
            f" load_benchmark({ours!r}).trials(...)"
        )


AT_HOME_RAD = 0.02
"""A posture whose angles are all so near to home is home [choice]."""
AT_HAND_M, TIMES_AS_FAR = 0.35, 3.0
"""Grippers of a handover lie so near to the hand, as a median; in a wrong frame so many times as far [choice]."""


def check_frame(answers: Answers, rows: Tensor, trials: Trials, source: str) -> str | None:
    """Looks whether the grippers lie far from the hands in the declared frame, and near to them in another one. The world is
    what files mean that say nothing, and what `write_predictions` says: then it is a line. Another frame is refused.

    Args:
        answers: of a file.
        rows: (n,) rows of the answers that are looked at.
        trials: the n trials that they answer.
        source: where the answers come from, for messages.

    Returns:
        The line; None where the frame is right.

    Raises:
        FileError: the frame cannot be the one that is declared.
    """
    if not answers.frame or not len(rows):
        return None
    T_world_hand = trials.T_world_hand.cpu()
    turned = Declared(frame="base")
    given = answers.predictions.T_world_ee[rows]
    raw = given if answers.frame != "base" else torch.from_numpy(turned.in_world(given.numpy()))
    read = {
        "world": raw,
        "base": torch.from_numpy(turned.in_world(raw.numpy())),
        "hand": se3.matmul(T_world_hand, raw),
    }
    own = "world" if answers.frame == "base_link" else answers.frame
    apart = {
        name: float((T[:, :3, 3] - T_world_hand[:, :3, 3]).norm(dim=1).nanmedian())
        for name, T in read.items()
    }
    near = min(apart, key=lambda name: apart[name])
    if apart[near] >= AT_HAND_M or apart[own] <= TIMES_AS_FAR * apart[near]:
        return None
    words = (
        f"{source}: frame is {answers.frame}, and the median gripper is then {apart[own]:.2f} m from the hand; with"
        f" {near} it is {apart[near]:.2f} m: declare the frame of the poses"
    )
    if own != "world":
        raise FileError(words)
    return words


def write_predictions(
    path: str | Path, predictions: Predictions, *, benchmark: str = "", reads: str = ""
) -> None:
    """Write predictions to a .npz file; `load_predictions` reads them back equal.

    Args:
        path: the file; an existing one is replaced.
        predictions: the predictions.
        benchmark: `Trials.benchmark` of the trials that they answer; a sweep on another benchmark then
            refuses the file.
        reads: what the method read: scene, estimates, cloud, cameras or judge; tables say it.

    Raises:
        FileError: the file has another ending.
    """
    path = path_rule("path", path)
    instance_of(Predictions, "r2h_batch.Predictions(trial_id, T_obj_ee, T_world_ee)")(
        "predictions", predictions
    )
    method, data = text("predictions.method", predictions.method), {}
    for name in _SPECS:
        value = getattr(predictions, name)
        if value is not None or name in _NEEDED:
            value = check_tensor(f"predictions.{name}", value, "a torch tensor of N rows")
            data[name] = np.ascontiguousarray(value.detach().cpu().numpy())
    if path.suffix != ".npz":
        shown = printable(path)
        raise FileError(f"{shown}: predictions are written as .npz, not {path.suffix!r}")
    told = {"benchmark": np.array(benchmark)} if text("benchmark", benchmark) else {}
    told |= {"reads": np.array(one_of(*READS)("reads", reads))} if text("reads", reads) else {}
    told |= ours("frame", "time_unit")
    with contextlib.suppress(FileError):  # whoever reads poses in other units is warned instead
        _declared_poses(predictions, Declared(length_unit="m"))
        told |= ours("length_unit")
    write_npz(path, {"method": np.array(method), **told, **data})


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
        FileError: ids are given twice, are not planned, or are missing.
    """
    answered, planned = predictions.trial_id.cpu().numpy(), trial_id.cpu().numpy()
    ids, first, copies = np.unique(answered, return_index=True, return_counts=True)
    _refuse(source, "given more than once", ids[copies > 1], "give one row for each trial")
    unknown = "give only planned trials, or plan more of them (--splits, --trials)"
    if len(ids) > 1 and np.array_equal(ids - 1, np.sort(planned)):
        unknown = "each is the id of a planned trial plus 1: ids begin at 0"
    _refuse(source, "not in the plan", np.setdiff1d(ids, planned), unknown)
    if len(ids) == 0:
        return torch.full((len(planned),), -1, dtype=torch.int64, device="cpu")
    at = np.minimum(np.searchsorted(ids, planned), len(ids) - 1)
    found = ids[at] == planned
    if not allow_missing:
        how = "predict every planned trial, plan fewer (--trials), or count them as failures with --allow-missing"
        _refuse(source, "planned but missing", planned[~found], how)
    return torch.from_numpy(np.where(found, first[at], -1).astype(np.int64))


LOOKS_RIGID, LAST_ROW, FAR_M, OBJECT_M = 1e-2, 1e-6, 10.0, 0.35
_PIECE = 65_536  # rows looked at together, which bounds the memory


SLOW_S = 100.0
"""A median time of a method's answer above this may be in milliseconds [choice]."""


def doubts(predictions: Predictions, motions: Motions | None = None) -> list[str]:
    """Warnings about the answers, one line each: times as in milliseconds; how many poses are not rigid, are far away as
    in other units, are the grasp once more, or look as if grasp and handover were exchanged; how many motions hold no numbers."""
    lines = []
    if motions is not None and (holes := _holes(motions)).any():
        first = int(predictions.trial_id[int(holes.int().argmax())])
        lines.append(
            f"{int(holes.sum())} of {len(predictions)} motions (the first of trial {first}) hold NaN or infinity and count as"
            " invalid"
        )
    seconds = predictions.t_method_s
    if seconds is not None and (median := float(seconds.nanmedian())) > SLOW_S:
        lines.append(
            f"the median of t_method_s is {median:.0f} s a trial: times are in seconds ({declaration('time_unit', 'ms')})"
        )
    posed = predictions if motions is None else predictions[motions.length == 0]
    named = (("T_obj_ee", "grasps", predictions), ("T_world_ee", "handover poses", posed))
    for name, what, given in named:
        T, n = getattr(given, name).numpy(), len(given)
        if not n:
            continue
        fault = np.concatenate([faults(T[k : k + _PIECE]) for k in range(0, n, _PIECE)])
        far = (fault == 0) & (np.abs(T[:, :3, 3]).max(1, initial=0.0) > FAR_M)
        metres = f"are more than {FAR_M:g} m away: lengths are in metres"
        if far.any() and name == "T_world_ee":
            unit = unit_of(
                float(np.median(np.linalg.norm(T[far, :3, 3].astype(np.float64), axis=1)))
            )
            metres += f" ({declaration('length_unit', unit)})" if unit else ""
        kinds = [(k, int((fault == k).sum())) for k in range(1, len(FAULTS)) if (fault == k).any()]
        of_each = "; ".join(
            f"{count if len(kinds) > 1 else 'all'} {FAULTS[k]}" for k, count in kinds
        )
        for odd, words in (
            (fault > 0, f"are not rigid poses and count as invalid: {of_each}"),
            (far, metres),
        ):
            if odd.any():
                first = int(given.trial_id[int(odd.argmax())])
                where = f"({name}; the first of trial {first})"
                lines.append(f"{int(odd.sum())} of {n} {what} {where} {words}")
    same = (posed.T_obj_ee - posed.T_world_ee).abs().amax((1, 2)) < RIGID
    if 2 * int(same.sum()) > len(posed):
        lines.append(
            f"{int(same.sum())} of {len(posed)} handover poses (T_world_ee) equal the grasps (T_obj_ee): T_world_ee is the"
            " gripper's pose in the world, not in the object's frame"
        )
    grasp, handover = (
        np.linalg.norm(T[:, :3, 3].numpy(), axis=1) for T in (posed.T_obj_ee, posed.T_world_ee)
    )
    swapped = (grasp > OBJECT_M) & (handover < grasp) & (grasp < FAR_M)
    if 2 * int(swapped.sum()) > len(posed):
        lines.append(
            f"most grasps (T_obj_ee) are more than {OBJECT_M:g} m from the object's origin, and"
            " handover poses (T_world_ee) nearer to the robot's base: exchanged?"
        )
    return lines


def _holes(motions: Motions) -> Tensor:
    """(n,) whether a sample or time of each motion is no finite number."""
    odd = ~(motions.q.isfinite().all(1) & motions.time_s.isfinite())
    of = torch.repeat_interleave(motions.length)
    found = torch.zeros(len(motions.length), dtype=torch.int64, device="cpu")
    return found.index_add_(0, of, odd.long()) > 0


FAULTS = (
    "",
    "hold NaN or infinity",
    "are transposed: pass T.transpose(-1, -2)",
    "have a last row that is not 0, 0, 0, 1",
    "are all zeros in the rotation",
    "mirror (determinant below 0): swap the sign of one axis",
    "scale: divide the rotation by the length of its columns",
    "have columns that are not of length 1 and at right angles: orthonormalise them",
)
"""What can be wrong with a pose, by its number in `faults`, and what would make it right."""


def faults(T: np.ndarray) -> np.ndarray:
    """(n,) what is wrong with each of the poses (n, 4, 4), as a number of `FAULTS`; 0: it is judged (`se3.is_pose`).

    Args:
        T: the poses, m.
    """
    close = np.array(T, np.float32)
    close[:, :3, 3] = np.nan_to_num(close[:, :3, 3]).clip(
        -1.0, 1.0
    )  # how far away is another question
    off = ~(np.isfinite(T).all((1, 2)) & se3.is_pose(torch.from_numpy(close)).numpy())
    found = np.zeros(len(T), np.int8)
    if not off.any():
        return found
    with np.errstate(all="ignore"):
        bad = T[off].astype(np.float64)
        R = bad[:, :3, :3]
        length = np.linalg.norm(R, axis=1)
        unit = R / length[:, :1, None]
        askew = np.abs(unit @ unit.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        found[off] = np.select(
            [
                ~np.isfinite(bad).all((1, 2)),
                ~not_rigid(bad.transpose(0, 2, 1)) | _moved_down(bad),
                np.abs(bad[:, 3] - [0, 0, 0, 1]).max(1) > LAST_ROW,
                (length < LOOKS_RIGID).all(1),
                (askew < LOOKS_RIGID) & (np.linalg.det(R) < 0),
                askew < RIGID,
            ],
            [1, 2, 3, 4, 5, 6],
            7,
        )
    return found


def _moved_down(T: np.ndarray) -> np.ndarray:
    """(n,) whether the translation stands in the last row, and the rotation is none either way."""
    return (T[:, :3, 3] == 0).all(1) & (T[:, 3, :3] != 0).any(1)


def _refuse(source: str, what: str, ids: np.ndarray, how: str) -> None:
    if len(ids):
        listed = ", ".join(map(str, ids[:10].tolist())) + (", ..." if len(ids) > 10 else "")
        count = "1 trial id is" if len(ids) == 1 else f"{len(ids)} trial ids are"
        raise FileError(f"{source}: {count} {what}: {listed}; {how}")
