"""The command `why`: one trial in words."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r2h_batch.runs.explain import Explanation
    from r2h_batch.view.stored import Reader


def why(run: Path, trial: str, /, *, method: str = "", code: tuple[str, ...] = ()) -> int:
    """Say why one trial of a run passed or failed: the criterion, its margin, what decides it, what would have passed, and
    the command that draws it.

    Args:
        run: run folder of a sweep.
        trial: the trial's number, or what its owner calls it.
        method: the sweep's word (fc) or the table's name; without it a line for each method, and all of the only one.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    from r2h_batch.base.io.read import printable
    from r2h_batch.runs.plugged import criteria_since
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    number = stored.trial_id(trial)
    words = [method] if method else stored.methods
    names = stored.holding(number, words, judged=False)  # before torch is imported

    from r2h_batch.view.stored import Reader

    reader = Reader(stored, code)
    other = ", ".join(criteria_since(stored.header))
    for k, name in enumerate(names):
        print(("\n" if k else "") + str(explanation(reader, number, name)))
        if other:  # the verdict is that of then
            print(f"  {'criteria:':<12}{printable(other)}")
    return 0


def explanation(reader: "Reader", trial: int, method: str) -> "Explanation":
    """The explanation of a stored row; a plan without a path is judged again for the pair that its margin is about.

    Args:
        reader: of the run folder.
        trial: the trial's number.
        method: the method's name.
    """
    from r2h_batch.runs.explain import explained
    from r2h_batch.view.captions import pair_of, postures

    own = reader.run.explain(trial, method)
    if own.why == "invalid input":
        return replace(own, witness=_no_pose(reader, trial, method), picture="")
    if own.criterion != "plan":
        return own
    from r2h_batch.view.drawing import Drawing

    stored = reader.trial(trial, method)
    found, asked = Drawing(stored).witness, stored.asked
    if found is None:
        return own
    counts = f"; {postures(asked)}" if asked is not None and sum(asked.met.values()) > 1 else ""
    limits = reader.run.header["configuration"]["thresholds"]
    return explained(
        stored.row,
        method,
        limits,
        own.picture,
        pair=pair_of(stored),
        head_m=stored.head_clearance_m,
        witness=found.caption + counts,
    )


def _no_pose(reader: "Reader", trial: int, method: str) -> str:
    """Which of the stored matrices is no pose, and what would make it right; empty where none is stored."""
    import numpy as np

    from r2h_batch.trials.predictions import FAULTS, faults
    from r2h_batch.view.stored import POSES, _rows

    if "poses" not in reader.run.header["stored"]:
        return ""
    found = []
    for row in _rows(reader.run.poses(method), trial):
        for name in POSES:
            T = np.array(row[name], np.float32).reshape(1, 4, 4)
            if kind := int(faults(T)[0]):
                found.append(f"{name} is no pose: matrices like it {FAULTS[kind]}")
    return "; ".join(found)
