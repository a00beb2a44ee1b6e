"""Which trials several runs share, and what keeps them from being compared."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from r2h_batch.config import EvalConfig
from r2h_batch.runs.store import Run
from r2h_batch.schedule import PROTOCOLS
from r2h_batch.validate import check_arguments, sequence_of
from r2h_batch.verdicts import SPLITS

__all__ = ["Common", "common_trials"]

FINER = ("apart_from_objects", "each_object")
"""Digests that say in parts what others say whole; older runs lack them."""


@dataclass(frozen=True)
class Common:
    """The first `trials[split]` trials of each split, which all runs hold; `notes`: what a reader
    should know about that."""

    trials: Mapping[str, int]
    notes: tuple[str, ...]


@check_arguments(
    runs=sequence_of(Run, "what load_run(FOLDER) gives"),
    proven=sequence_of(Path, "folders", least=0),
)
def common_trials(runs: Sequence[Run], *, proven: Collection[Path] = ()) -> Common:
    """What all runs were asked; `ValueError` where they were not asked, or not judged, the same.

    Trials follow from protocol, objects and hands, and a plan is the first N of each split: so runs
    of different size share the smaller plan. `proven`: folders whose rows are known to come out the
    same under this code (the project's tests judge the shipped baselines again), so their digest of
    the code may be another one.
    """
    first, notes = runs[0], []
    for run in runs[1:]:
        if what := _differing(first, run, proven):
            advice = (
                "the shipped baselines have the default options, with --sim mujoco and with --sim none: sweep like that"
                if {first.folder, run.folder} & set(proven)
                else "sweep both methods with the same version and options"
            )
            raise ValueError(
                f"{first.folder} and {run.folder} differ in {what}: their trials cannot be paired; {advice}"
            )
    plans = [run.header["trials"] for run in runs]
    trials = {s: min(p[s] for p in plans) for s in SPLITS if all(p.get(s) for p in plans)}
    if not trials:
        raise ValueError(
            f"{' and '.join(str(r.folder) for r in runs)} share no split; sweep the same --splits"
        )
    if any({s: n for s, n in p.items() if n} != trials for p in plans):
        shared = ", ".join(f"{n} {s}" for s, n in trials.items())
        notes.append(
            f"The runs hold different trials; compared are the first {shared}, which all of them hold."
        )
    if len({run.header["digests"].get("code") for run in runs}) > 1:
        notes.append(
            "The shipped baselines were scored by other code, under which the project's tests judge them again."
        )
    return Common(trials, tuple(notes))


def _differing(a: Run, b: Run, proven: Collection[Path]) -> str:
    """What two runs were asked or judged differently, in words; empty where nothing is."""
    mine, other = a.header, b.header
    if mine["protocol"] != other["protocol"]:
        return "protocol"
    same_plan = mine["trials"] == other["trials"]
    if not same_plan and not (
        mine["protocol"] in PROTOCOLS and {"objects", "hand_set"} <= mine["digests"].keys()
    ):
        return f"trials ({', '.join(s for s in mine['trials'] if mine['trials'][s] != other['trials'].get(s))})"
    skipped = set(FINER) if same_plan else {"trials", *FINER}
    if a.folder in proven or b.folder in proven:
        skipped.add("code")
    digests, others = (
        {k: v for k, v in h["digests"].items() if k not in skipped} for h in (mine, other)
    )
    for key, left, right in (
        ("digests", digests, others),
        ("configuration", _whole(mine["configuration"]), _whole(other["configuration"])),
    ):
        if left != right:
            return (
                f"{key} ({', '.join(k for k in {**left, **right} if left.get(k) != right.get(k))})"
            )
    return ""


def _whole(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A run's configuration with today's defaults for fields that its version did not have: they
    say what it did."""
    whole = asdict(EvalConfig())
    for key, value in configuration.items():
        whole[key] = (
            {**whole[key], **value}
            if isinstance(value, dict) and isinstance(whole.get(key), dict)
            else value
        )
    return {k: list(v) if isinstance(v, tuple) else _listed(v) for k, v in whole.items()}


def _listed(value: Any) -> Any:
    """As JSON would give it back."""
    return (
        {k: list(v) if isinstance(v, tuple) else v for k, v in value.items()}
        if isinstance(value, dict)
        else value
    )
