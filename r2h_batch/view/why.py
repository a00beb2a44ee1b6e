"""The command `why`: one trial in words, or the reasons of all."""

import sys
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r2h_batch.runs.explain import Explanation
    from r2h_batch.runs.store import Run
    from r2h_batch.view.stored import Reader


def why(
    run: Path, trial: str | None = None, /, *, method: str = "", code: tuple[str, ...] = ()
) -> int:
    """Say why trials of a run failed: all reasons with one trial each, or of one trial the criterion, its margin, what decides
    it, what would have passed, and the command that draws it.

    Args:
        run: run folder of a sweep.
        trial: the trial's number, or what its owner calls it; without it the reasons of all trials, how often each is, and one
            trial of each.
        method: the sweep's word (fc) or the table's name; without it every method.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    from r2h_batch.base.io.read import printable
    from r2h_batch.runs.plugged import criteria_since
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    if trial is None:
        return _every_reason(stored, method)
    number = stored.trial_id(trial)
    words = [method] if method else stored.methods
    names = stored.holding(number, words, judged=False)  # before torch is imported
    reader = reader_of(stored, code)
    other = ", ".join(criteria_since(stored.header))
    for k, name in enumerate(names):
        print(("\n" if k else "") + str(explanation(stored, number, name, reader)))
        if other:  # the verdict is that of then
            print(f"  {'criteria:':<12}{printable(other)}")
    return 0


def _every_reason(run: "Run", method: str) -> int:
    """Print why trials failed; 1 where a method is not complete, as `report` says it."""
    from r2h_batch.base.io.log import LOG
    from r2h_batch.report.reasons import brief

    methods = [run.complete(method)] if method or not run.methods else run.methods
    sys.stdout.write(brief(run, methods))
    for name in () if method else run.unfinished:
        LOG.info(f"why: {run.not_complete(name)}")
    return 1 if run.unfinished and not method else 0


def reader_of(run: "Run", code: Collection[str] = ()) -> "Callable[[], Reader]":
    """What reads trials of a run once one is asked for: it imports torch, which most rows do without.

    Args:
        run: one run.
        code: functions that the run names and that may run.
    """

    @cache
    def reader() -> "Reader":
        from r2h_batch.view.stored import Reader

        return Reader(run, code)

    return reader


def explain(
    run: "Run", trial: int | str, method: str | None = None, code: Collection[str] = ()
) -> "Explanation":
    """Why one trial passed or failed, as `r2h-batch why` says it; a failed plan is judged again for its pair of bodies.

    Args:
        run: what `load_run` gives.
        trial: its number, or what its owner calls it.
        method: the full name or the sweep's word (fc); None: the only method.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.

    Returns:
        The criterion that failed first, its margin, what decides it, what would have passed, and the command that
        shows it; as text it has a line for each.

    Raises:
        RunError: there is no such trial or method, or several methods and none is named.
    """
    from r2h_batch.runs.files import RunError

    names = list(run.methods)
    if method is None and len(names) != 1:
        raise RunError(
            f"{run.folder}: has {len(names)} complete methods; name one: {', '.join(names) or 'none'}"
        )
    name = names[0] if method is None else run.named(method)
    number, one, slug = run.trial_id(str(trial)), run.run_of(name), run.entry(name).slug
    own = next(e.name for e in one.entries if e.slug == slug)
    return replace(explanation(one, number, own, reader_of(one, code)), method=name)


def explanation(
    run: "Run", trial: int, method: str, reader: "Callable[[], Reader]"
) -> "Explanation":
    """The explanation of a stored row; a plan without a path is judged again for the pair that its margin is about.

    Args:
        run: one run.
        trial: the trial's number.
        method: the method's name.
        reader: of the run (`reader_of`).
    """
    from r2h_batch.runs.explain import explained
    from r2h_batch.runs.store import picture_command

    row = run.row(trial, method)
    limits = run.header.get("configuration", {}).get("thresholds", {})
    head_m = run.header.get("head_clearance_m", 0.0)
    own = explained(row, method, limits, picture_command(run, method, trial), head_m=head_m)
    if own.why == "invalid input":
        return replace(own, witness=_no_pose(run, trial, method), picture="")
    if own.criterion != "plan":
        return own
    from r2h_batch.base.io.log import LOG
    from r2h_batch.runs.files import RunError
    from r2h_batch.view.captions import pair_of, postures
    from r2h_batch.view.drawing import Drawing

    try:
        stored = reader().trial(trial, method)
    except RunError as error:
        LOG.info(f"{error}; the stored row alone is told, without the pair of bodies")
        return own
    found, asked = Drawing(stored).witness, stored.asked
    if found is None:
        return own
    counts = f"; {postures(asked)}" if asked is not None and sum(asked.met.values()) > 1 else ""
    return explained(
        stored.row,
        method,
        limits,
        own.picture,
        pair=pair_of(stored),
        head_m=stored.head_clearance_m,
        witness=found.caption + counts,
    )


def _no_pose(run: "Run", trial: int, method: str) -> str:
    """Which of the stored matrices is no pose, and what would make it right; empty where none is stored."""
    import numpy as np

    from r2h_batch.trials.predictions import FAULTS, faults
    from r2h_batch.view.stored import POSES, _rows

    if "poses" not in run.header["stored"]:
        return ""
    found = []
    for row in _rows(run.poses(method), trial):
        for name in POSES:
            T = np.array(row[name], np.float32).reshape(1, 4, 4)
            if kind := int(faults(T)[0]):
                found.append(f"{name} is no pose: matrices like it {FAULTS[kind]}")
    return "; ".join(found)
