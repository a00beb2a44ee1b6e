"""The command `results`: check a run folder, judge its rows again, count them at other thresholds.

verify RUN        find damaged and foreign shards
digest RUN        print the digest of each method's rows
reevaluate RUN    judge a sample of stored rows again from their stored poses
rethreshold RUN   print the rates at other thresholds
reception RUN     print how many receivers could take the object
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from r2h_batch.base.command_line import check_seed
from r2h_batch.base.errors import UsageError
from r2h_batch.sweep.results.rethreshold import rethreshold

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

LISTED = 200
"""Differences of one method that are printed; the count covers all of them."""


def verify(folder: Path, /) -> int:
    """Find damaged and foreign shards and mark them for rerun.

    Files beside the shards (reception) that are damaged, too large or of other trials are set aside. Temporary files that a
    killed process left are named and removed. The last line says what is not checked. Exit code 0: every stored shard is as it
    was written. Exit code 1: the same sweep will score some shards again, or a file was set aside.

    Args:
        folder: a run folder, as `r2h-batch sweep --out` writes it.
    """
    from r2h_batch.runs.header import read_header, shards_of
    from r2h_batch.runs.store import load_run
    from r2h_batch.runs.verify import mark_for_rerun, remains

    header = read_header(folder)
    if half := remains(folder, header):
        print("\n".join(half))
    lines = mark_for_rerun(folder, header)
    print("\n".join(lines or [f"{folder}: every stored shard is as it was written"]))
    run = load_run(folder, verify=False)
    lines += (strange := _strange_side_files(run))
    unchecked = (
        f"not checked: verdicts and margins (r2h-batch results reevaluate {folder} judges rows again);"
        " figures of files beside the shards; times, host, device; names in ids.csv"
    )
    print("\n".join([*strange, unchecked]))
    for name in run.unfinished:
        missing = [str(s.index) for s in run.missing(name)]
        shown = ", ".join(missing[:10]) + (", ..." if len(missing) > 10 else "")
        count = len(shards_of(run.header))
        print(f"{name}: {len(missing)} of {count} shards to be scored: {shown}")
    return 1 if lines else 0


def _strange_side_files(run: "Run") -> list[str]:
    """Sets aside the files beside the shards that tables refuse; one line for each."""
    from r2h_batch.runs.files import RunError
    from r2h_batch.runs.side import side_files
    from r2h_batch.runs.verify import Problem, set_aside

    lines = []
    for entry in run.entries:
        for path in side_files(entry):
            try:
                run.side(entry.name, path.parent.name)
            except RunError as error:
                what = str(error).removeprefix(f"{path}: ").partition("; take")[0]
                lines.append(set_aside(Problem(entry.name, None, path, what)))
    return lines


def digest(folder: Path, /) -> int:
    """Print the digest of each method's rows: equal digests mean equal verdicts on any machine.

    Args:
        folder: a run folder, as `r2h-batch sweep --out` writes it.
    """
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    for name in (e.name for e in run.entries):
        left = len(run.missing(name))
        print(f"{run.digest(name)}  {name}" + (f" (without {left} shards)" if left else ""))
    return 0


def reevaluate(
    folder: Path,
    /,
    *,
    rows: int = 200,
    method: tuple[str, ...] = (),
    seed: int | None = None,
    code: tuple[str, ...] = (),
    device: str = "cpu",
) -> int:
    """Verify a run folder, then judge a random sample of its rows again from their stored poses.

    A changed row gets another verdict, even if receipt and sha256 agree with it. Built-in methods
    answer the same trials again: that finds poses of another method. Built-in policies play closed
    loops again. Your own methods and policies do not run. Exit code 0: no row differs. Exit code 1:
    a row differs, or a shard must be scored again.

    Args:
        folder: a run folder, as `r2h-batch sweep --out` writes it.
        rows: rows of each method that the command judges again.
        method: only these methods, by the sweep's word (fc) or the table's name.
        seed: seed of the random sample; by default a new one each time.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
        device: cpu, cuda or cuda:N.
    """
    import numpy as np

    if rows < 0:
        raise UsageError(f"--rows is {rows}; it must be 0 or more")
    if seed is not None:
        check_seed(seed)
    exit_code = verify(folder)
    if not rows:
        return exit_code
    from r2h_batch.runs.files import RunError
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results import reevaluation as again
    from r2h_batch.sweep.results.judge import Judge, check_poses

    run = load_run(folder, verify=False).only(method)
    names = [e.name for e in run.entries if e.shards]
    if not names:
        raise RunError(f"{folder}: no shard of any method is stored")
    check_poses(run)
    draw = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
    judge = Judge(run, code=code, device=device)
    if judge.other:
        print(
            f"not as when it was scored: {', '.join(judge.other)}; so verdicts are compared exactly,"
            f" numbers within tolerances ({again.tolerances()}), and methods may answer"
            f" up to {again.MOST_OTHER_CHOICES:.0%} of the rows otherwise"
        )
    for name in names:
        found = again.reevaluate(run, name, rows, judge, seed=draw)
        exit_code = 1 if found.differences else exit_code
        differing = len({d.trial_id for d in found.differences})
        words = f"{differing or 'none'} {'differs' if differing < 2 else 'differ'}"
        print(
            f"{name}: {found.scored} of {found.stored} rows judged again (--seed {draw}):"
            f" {words}, {found.equal} are equal bit for bit; {found.asked}"
        )
        for difference in found.differences[:LISTED]:
            print(f"  {difference}")
        if (more := len(found.differences) - LISTED) > 0:
            print(f"  and {more} more differences")
    return exit_code


def reception(
    folder: Path,
    /,
    *,
    method: tuple[str, ...] = (),
    code: tuple[str, ...] = (),
    device: str = "cpu",
) -> int:
    """Print how many receivers could take the object, and how easily; write RUN/reception/METHOD.parquet.

    The command tries 256 receiving grasps for each stored pose; no predictor knows these grasps. The
    person's arm must bring the hand to a grasp, past the gripper and clear of the robot. The success
    rate does not depend on it. Receivers need a body: those of r2h-v2, the default, and of r2h-v1 have one; `--receiver hand`
    takes it away. Each method is written as soon as it is done; the same command again reads what is there of the same rows and
    code.

    Args:
        folder: a run folder, as `r2h-batch sweep --out` writes it.
        method: only these methods, by the sweep's word (fc) or the table's name.
        code: functions of your benchmark or families that the run names and that may run, such as FILE.py:function.
        device: cpu, cuda or cuda:N.
    """
    run = _opened(folder, method, "reception")
    from r2h_batch.sweep.results.questions import judge_of, kept_answers
    from r2h_batch.sweep.results.reception import QUESTION, render

    judge, names = judge_of(run, code, device)
    print(render(kept_answers(QUESTION, run, names, judge)), end="")
    return 0


def _opened(folder: Path, method: Sequence[str], side: str) -> "Run":
    """The run with these methods. Commands open it before they import what judges, so that a missing one is told at once.

    Raises:
        RunError: no such run or method, or a file stands where the folder `side` of the results goes.
    """
    from r2h_batch.runs.files import RunError, in_the_way
    from r2h_batch.runs.store import load_run

    if what := in_the_way(folder / side, folder=True):
        raise RunError(what)
    return load_run(folder).only(method)


COMMANDS = {
    "verify": verify,
    "digest": digest,
    "reevaluate": reevaluate,
    "rethreshold": rethreshold,
    "reception": reception,
}
