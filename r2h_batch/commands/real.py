"""The command `export real`: stored trials for a robot in a laboratory. Light until there is work."""

import re
from pathlib import Path
from typing import Annotated

import tyro

from r2h_batch.base.command_line import check_range, counted
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.write import check_output_folder

MOST_TRIALS = 1000
LEAST_TCP_SPEED, MOST_TCP_SPEED = 0.01, 1.5


def real(
    run: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    trials: str = "0-39",
    method: tuple[str, ...] = (),
    tcp_speed: float = 0.25,
    rate_hz: float = 125.0,
    code: tuple[str, ...] = (),
) -> int:
    """Write trials of a run for a real arm: both paths (CSV, ROS 2, URScript), sheets in true size, objects, a table to fill in.

    Read SAFETY.txt of the folder first. Trials without a path are named and left out; a robot cannot run them.

    Args:
        run: run folder of a sweep; what it does not store is computed again.
        out: a new or empty folder.
        trials: trial ids: 0-39, or 3,7,12-20.
        method: the sweep's word (fc) or the table's name; none: all of the run.
        tcp_speed: highest speed of the TCP, m/s; faster paths are slowed down as a whole.
            0.25 is the reduced speed of ISO 10218-1.
        rate_hz: postures a second.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
    """
    wanted = ids_of(trials)
    if not LEAST_TCP_SPEED <= tcp_speed <= MOST_TCP_SPEED:
        raise UsageError(
            f"--tcp-speed is {tcp_speed:g}; it must be from {LEAST_TCP_SPEED} to {MOST_TCP_SPEED} m/s"
        )
    if not 10 <= rate_hz <= 500:
        raise UsageError(f"--rate-hz is {rate_hz:g}; it must be from 10 to 500")
    check_output_folder(out, overwrite=None)
    from r2h_batch.base.io.write import write_text
    from r2h_batch.runs.store import UNJUDGED, load_run

    stored_run = load_run(run)  # what is not there is told before torch is imported
    names = [stored_run.complete(word) for word in method or stored_run.methods]
    found = {
        name: {r["trial_id"]: r["outcome"] for r in table.to_pylist()}
        for name in names
        for table in [stored_run.trials(name, ["trial_id", "outcome"])]
    }
    missing = [i for i in wanted if not any(i in rows for rows in found.values())]
    if missing:
        raise UsageError(f"--trials: the run has no trial {_short(missing)}")
    from r2h_batch.base.io.progress import progress
    from r2h_batch.view.lab.folder import SAFETY, write_objects, write_outcomes, write_trial
    from r2h_batch.view.stored import Reader

    reader = Reader(stored_run, code)
    rows, models, without = [], {}, []
    with progress("trials for the robot", len(wanted) * len(names), "trials") as advance:
        for i in wanted:
            for name in names:
                advance(1)
                if found[name].get(i, "missing") in UNJUDGED:
                    without.append(f"{i} of {name}")
                    continue
                stored = reader.trial(i, name)
                if not stored.moves:
                    without.append(f"{i} of {name}")
                    continue
                folder = out / "trials" / _folder(i, name)
                rows.append(write_trial(stored, folder, step_s=1 / rate_hz, tcp_speed=tcp_speed))
                models[stored.object_model.name] = stored.object_model
    if not rows:
        raise UsageError("--trials: none of them has a path; choose others")
    write_objects(list(models.values()), out / "objects")
    write_outcomes(rows, out / "outcomes.csv")
    write_text(out / "SAFETY.txt", SAFETY)
    print(f"{counted(len(rows), 'trials')} in {out}; read {out / 'SAFETY.txt'} first")
    if without:
        print(f"left out, because they have no path: {_short(without)}")
    print(
        f"fill in {out / 'outcomes.csv'}, then: r2h-batch study real {run} {out / 'outcomes.csv'}"
    )
    return 0


def ids_of(text: str) -> list[int]:
    """Trial ids in order from words like 0-39 or 3,7,12-20.

    Raises:
        UsageError: the text is something else, or names more than `MOST_TRIALS`.
    """
    ids: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"(\d{1,12})(?:-(\d{1,12}))?", part.strip(), re.ASCII)
        if match is None:
            raise UsageError(f"--trials is {text[:60]!r}; write ids like 0-39 or 3,7,12-20")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise UsageError(f"--trials: {part.strip()} runs backwards; write {last}-{first}")
        check_range(
            "--trials",
            last - first + 1 + len(ids),
            1,
            MOST_TRIALS,
            ": a laboratory's day has no more",
        )
        ids |= set(range(first, last + 1))
    return sorted(ids)


def _folder(trial: int, method: str) -> str:
    return f"{trial}-{re.sub(r'[^A-Za-z0-9_-]+', '_', method)[:60]}"


def _short(items: list[str] | list[int]) -> str:
    shown = ", ".join(map(str, items[:10]))
    return f"{shown} and {len(items) - 10} more" if len(items) > 10 else shown
