"""Which trials several runs share, and whether they can be compared."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from r2h_batch.base.registry import FOREIGN, benchmark_in_words, is_drawn, protocol_of
from r2h_batch.base.validate import boolean, check_arguments, sequence_of
from r2h_batch.config import EvalConfig
from r2h_batch.report.statistics.codes import judged_by, never_judged
from r2h_batch.runs.before import has_head
from r2h_batch.runs.plugged import other_criteria
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, REGISTRY, SPLITS

FINER = ("apart_from_objects", "each_object")
"""Parts of the digests. They are not compared, because older runs do not store them."""
HEADS = "their persons' heads"
"""A difference between a run of r2h_batch 0.3 and a later one."""


@dataclass(frozen=True)
class Common:
    """Trials that all runs hold: the first `trials[split]` trials of each split.

    `notes`: what a reader should know about that.
    """

    trials: Mapping[str, int]
    notes: tuple[str, ...]


@check_arguments(
    runs=sequence_of(Run, "what load_run(FOLDER) gives"),
    proven=sequence_of(Path, "folders", least=0),
    across_robots=boolean,
)
def common_trials(
    runs: Sequence[Run], *, proven: Collection[Path] = (), across_robots: bool = False
) -> Common:
    """Find the trials that all runs share.

    Trials follow from protocol, objects and hands, and a run holds the first N of each split. So
    runs of different size share the trials of the smaller one.

    Args:
        runs: what `load_run` gives.
        proven: folders whose verdicts the tests check with the current code (the shipped baselines).
            Their digest of the code may differ.
        across_robots: also take runs of several robots: a trial of theirs is the same object, hand
            and random draw; where the person and the table stand may differ.

    Raises:
        ValueError: if the runs hold other trials, or were judged otherwise: robot, benchmark, trials,
            digests and configuration are compared; versions, device, seed and predictors are not.
            Of two runs of which one holds the release's own verdicts, robot and names of trials are compared.
    """
    notes = []
    # every pair: a run that is compared by less (shipped, or of the release) proves nothing of two others
    for first, run in combinations(runs, 2):
        if what := _differing(first, run, proven, across_robots):
            advice = "sweep both methods with the same version and options"
            if {first.folder, run.folder} & set(proven):
                shipped = "stored rows have default options, with --execute.sim mujoco and with --execute.sim none"
                advice = f"{shipped}: sweep like that"
            if what.startswith(HEADS):
                advice = "sweep the older one again"
            if what.startswith("benchmark"):
                advice = "sweep both with the same --benchmark"
            if what.startswith("what"):
                advice = "sweep both with the same --sees"
            if what.startswith("robot"):
                advice = "to pair trials by number, add --across-robots to compare"
            found = f"{first.folder} and {run.folder} differ in {what}"
            raise ValueError(f"{found}: their trials cannot be paired; {advice}")
    asked = [run.header["trials"] for run in runs]
    trials = {s: min(p[s] for p in asked) for s in SPLITS if all(p.get(s) for p in asked)}
    if not trials:
        folders = " and ".join(str(r.folder) for r in runs)
        raise ValueError(f"{folders} share no split; sweep the same --splits")
    if any({s: n for s, n in p.items() if n} != trials for p in asked):
        shared = ", ".join(f"{n} {s}" for s, n in trials.items())
        notes.append(
            f"The runs hold different trials; compared are the first {shared}, which all of them hold."
        )
    if len({protocol_of(run.header) for run in runs}) > 1:
        notes.append(
            f"Trials are paired by their names: {FOREIGN} holds the release's own verdicts, by its definitions."
        )
    if len(robots := list(dict.fromkeys(run.robot for run in runs))) > 1:
        notes.append(
            f"Robots {', '.join(robots)}: a trial is the same object, hand and draw; where person and table stand"
            " follows each robot's reach, unless the sweep said persons=as-for-ur5e."
        )
    judged = [run for run in runs if run.header["protocol"] != FOREIGN]
    if len({run.header["digests"].get("code") for run in judged}) > 1:
        notes.append(
            "The shipped baselines were scored by an earlier version of the code; "
            "the project's tests check that this version gives the same verdicts."
        )
    bare = [run.folder.name for run in judged if not has_head(run.header)]
    if 0 < len(bare) < len(judged):
        notes.append(
            f"body_m of {' and '.join(bare)} is of arm and torso alone, that of the others of the head too; no verdict asks it."
        )
    notes += _lacking(runs)
    return Common(trials, tuple(notes))


def _lacking(runs: Sequence[Run]) -> list[str]:
    """A note for each run whose rows are older than a criterion by which another run was judged, or that is known here."""
    since = {entry.name: entry.since for entry in REGISTRY}
    judged = [{name for m in run.methods for name in judged_by(run, m)} for run in runs]
    notes = []
    for run, own in zip(runs, judged, strict=True):
        if not any(c in other for c in CRITERIA if c not in own for other in judged):
            notes += never_judged(run)
        if lacks := [c for c in CRITERIA if c not in own and any(c in other for other in judged)]:
            named = ", ".join(f"{c} (since {since[c]})" for c in lacks)
            notes.append(
                f"The rows of {run.folder.name} lack {named}: their SR counts trials as successes that were not"
                " judged by it."
            )
        if unknown := [words for words in run.lacking if words.startswith("criterion ")]:
            notes.append(
                f"The rows of {run.folder.name} were judged by {' and '.join(unknown)} too, not installed here: their"
                " SR counts what failed it as failed."
            )
    return notes


def _differing(a: Run, b: Run, proven: Collection[Path], across_robots: bool) -> str:
    """The first difference between what two runs were asked, or how they were judged; else empty."""
    left, right = a.header, b.header
    robots = a.robot != b.robot
    if robots and not across_robots:
        return f"robot ({a.robot}, {b.robot})"
    if protocol_of(left) != protocol_of(right):
        if FOREIGN not in (left["protocol"], right["protocol"]):
            return (
                f"benchmark ({', '.join(benchmark_in_words(h['protocol']) for h in (left, right))})"
            )
        names = [{i: name for i, (name, _) in run.labels.items()} for run in (a, b)]
        return "" if names[0] == names[1] else "the names of their trials"
    same_trials = left["trials"] == right["trials"]
    follow = is_drawn(left) and {"objects", "hand_set"} <= left["digests"].keys()
    if not same_trials and not follow:
        return f"trials ({_other_keys(left['trials'], right['trials'])})"
    skipped = set(FINER) if same_trials else {"trials", *FINER}
    if a.folder in proven or b.folder in proven:
        skipped.add("code")
    if robots and follow:
        skipped |= {"robot", "benchmark", "trials"}
    if criteria := other_criteria(left, right):
        return criteria[0]
    if left["digests"].get("sees") != right["digests"].get("sees"):
        return f"what their methods see ({seeing(left)}, {seeing(right)})"
    counts = left["configuration"].get("receiver") == "body" or "sees" in left["digests"]
    if has_head(left) != has_head(right) and counts:
        bare = b if has_head(left) else a
        return f"{HEADS} (the receivers of {bare.folder.name} have none)"
    digests = [{k: v for k, v in h["digests"].items() if k not in skipped} for h in (left, right)]
    if digests[0] != digests[1]:
        return f"digests ({_other_keys(*digests)})"
    configurations = [complete(h["configuration"]) for h in (left, right)]
    for configuration in configurations if robots else ():
        del configuration["workplace"], configuration["execute"]["max_velocity_rad_s"]
    if configurations[0] != configurations[1]:
        return f"configuration ({_other_keys(*configurations)})"
    return ""


def seeing(header: Mapping[str, Any]) -> str:
    """The sight of a run's methods, in words.

    Args:
        header: of the run.
    """
    sees = header.get("sees")
    if sees is None:
        return "the truth"
    more = ", region told" if "region" in sees else ""
    return f"{sees['rig']}, noise {sees['noise']:g}, labels {sees['labels']}, object {sees['object']}, seed {sees['seed']}{more}"


def _other_keys(left: Mapping[str, Any], right: Mapping[str, Any]) -> str:
    return ", ".join(k for k in {**left, **right} if left.get(k) != right.get(k))


def complete(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A run's configuration as JSON. Fields that its version did not have get today's defaults, as which older versions
    behaved.

    Args:
        configuration: that of a run's header.
    """
    whole = asdict(EvalConfig())
    for key, value in configuration.items():
        parts = isinstance(value, dict) and isinstance(whole.get(key), dict)
        whole[key] = {**whole[key], **value} if parts else value
    return json.loads(json.dumps(whole))
