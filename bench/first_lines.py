"""How soon each command and each long call in Python says something, and how long it is ever silent.

    python bench/first_lines.py --out OUT            # measures, writes the JSON and the page; 15 minutes on two idle cores
    python bench/first_lines.py --out OUT --only why # this one alone, on the runs that OUT holds; writes nothing
    python bench/first_lines.py --render             # the page again from the JSON

Each is a process of its own whose output is a pipe, so progress comes as lines. It runs twice: cold, with an empty cache of
tables and, the first one, without compiled kernels; then warm, with what the first time left. It is ended after LIMIT_S.
"""

import argparse
import json
import os
import resource
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from _report import ROOT, made_by, markdown_table

MEASURES = ("bench/first_lines.py", "r2h_batch")
STORED = ROOT / "bench" / "results" / "first_lines.json"
PAGE = ROOT / "docs" / "results" / "first_lines.md"
LONG_S = 5.0
"""Work that takes longer has a line by then [choice]: what a person waits for without a sign."""
LIMIT_S = 120.0
"""A command is ended after so long [choice]."""
ROUNDS = ("cold", "warm")
COMMANDS = {
    "sweep": "sweep --method contact random --trials 60 --sim none --out {new}/run",
    "sweep, simulated": "sweep --method oracle --trials 10 --out {new}/simulated",
    "sweep, moving hand": "sweep --method oracle --trials 10 --receiver-motion moves --policy servo --out {new}/moving",
    "sweep, families": "sweep --method random --objects families:cup,hammer:x:3 --trials 10 --sim none --out {new}/families",
    "sweep, cameras": "sweep --method fc --sees cell-v1 --trials 4 --sim none --out {new}/sees",
    "sweep, another arm": "sweep --robot ur3e_2f85 --method random --trials 10 --sim none --out {new}/ur3e",
    "report": "report {run} --by-object",
    "report, page with a gallery": "report {run} --format html --gallery 1 --method contact --out {new}/gallery.html",
    "figures": "figures {run} --out {new}/figures",
    "compare": "compare {run} baselines",
    "why": "why {run} 3 --method contact",
    "view, page": "view {run} --trial 3 --method contact --html {new}/trial.html",
    "view, film": "view {run} --trial 3 --method contact --video {new}/trial.mp4 --fps 5",
    "view, film of a moving hand": "view {moving} --trial 3 --receiver-motion moves --policy servo"
    " --video {new}/moving.mp4 --fps 5",
    "results verify": "results verify {run}",
    "results reevaluate": "results reevaluate {run} --rows 100",
    "results picked": "results picked {run} --method contact",
    "results viewed": "results viewed {run} --method contact",
    "results reception": "results reception {simulated}",
    "turn": "turn {simulated} --method oracle",
    "import robot": "import robot --from airo-models:ur3e.urdf --base base_link --flange tool0 --out {new}/arm",
    "train rank": "train rank --items 1 --steps 20 --rounds 0 --out {new}/trained",
    "observe export": "observe export --families cup,hammer:x:2 --trials 50 --out {new}/views",
    "real export": "real export {simulated} --method oracle --trials 0-1 --out {new}/lab",
}  # fmt: skip
"""As a person types them, smaller where one would take many minutes; `:x:` is `x` with spaces around it."""
TIMES = ("first_s", "silent_s", "whole_s", "cpu_s")


def scores() -> None:
    """`Evaluator.score`, whole trials."""
    from r2h_batch import load_benchmark
    from r2h_batch.methods.random import predict

    evaluator, trials = load_benchmark().evaluator(device="cpu"), load_benchmark().trials(60)
    poses = predict(trials, evaluator.scene)
    evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)


def receiving_hands() -> None:
    """`trials.holding.load_held_out`, what reception is judged with: one object of the default benchmark."""
    from r2h_batch import load_benchmark
    from r2h_batch.data.people import people_hand
    from r2h_batch.trials.holding.held_out import load_held_out

    load_held_out(load_benchmark().evaluator().scene.objects, people_hand(), only=[5])


def environment() -> None:
    """`gymnasium.make_vec`, a reset and 20 steps of 64 episodes."""
    import gymnasium

    import r2h_batch  # noqa: F401 registers the environment

    environments = gymnasium.make_vec("r2h_batch/Handover-v1", num_envs=64, method="oracle", motion="moves")
    environments.reset(seed=0)
    for _ in range(20):
        environments.step(environments.action_space.sample())


def pairs() -> None:
    """`training.stream`, the first item."""
    from r2h_batch import load_benchmark
    from r2h_batch.training import stream

    next(iter(stream(load_benchmark(), "cup,hammer x 2 seed 5", pairs=16, items=1)))


def seen() -> None:
    """`observe.observe` of 32 trials a split."""
    from r2h_batch import load_benchmark
    from r2h_batch.observe import load_rig, observe

    benchmark = load_benchmark()
    observe(benchmark.evaluator().scene, benchmark.trials(32), load_rig("cell-v1"))


def picks() -> None:
    """`judge.picked` of 60 trials a split."""
    import torch

    from r2h_batch import load_benchmark
    from r2h_batch.judge import picked
    from r2h_batch.methods.candidates import candidates_of
    from r2h_batch.observe import moments

    benchmark = load_benchmark()
    scene, trials = benchmark.evaluator().scene, benchmark.trials(60)
    candidates = candidates_of(scene.objects)
    grasps = torch.stack([torch.as_tensor(candidates[i].T_obj_ee[0]) for i in trials.object_index.tolist()])
    picked(scene, grasps, moments(scene, trials), trials)


CALLS: dict[str, Callable[[], None]] = {
    "Python: score": scores,
    "Python: receiving hands": receiving_hands,
    "Python: environment": environment,
    "Python: stream of pairs": pairs,
    "Python: cameras": seen,
    "Python: picked": picks,
}


def watched(line: list[str], env: Mapping[str, str], log: Path) -> dict[str, float | str]:
    """Seconds of TIMES of a command, its first line, and how it ended: an exit code, or `limit`."""
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    first, silent, said, end = 0.0, 0.0, b"", "limit"
    last = begin
    with log.open("wb") as file:
        child = subprocess.Popen(
            line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=env, cwd=ROOT, start_new_session=True
        )
        assert child.stdout is not None
        pipe = child.stdout.fileno()
        while (left := begin + LIMIT_S - time.perf_counter()) > 0:
            ready, _, _ = select.select([pipe], [], [], left)
            now = time.perf_counter()
            silent, last = max(silent, now - last), now
            if not ready:
                break
            some = os.read(pipe, 1 << 16)
            if not some:
                end = str(child.wait(60))
                break
            file.write(some)
            if b"\n" not in said:
                said += some
                first = now - begin
        if end == "limit":
            os.killpg(child.pid, signal.SIGKILL)  # its own processes too
            child.wait()
        child.stdout.close()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    times = (first, silent, time.perf_counter() - begin, cpu)
    return {**dict(zip(TIMES, times, strict=True)), "said": said.split(b"\n")[0].decode(errors="replace"), "end": end}


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """A row for each command and call, cold and warm."""
    out: Path = options.out.resolve()
    if not options.only:
        shutil.rmtree(out, ignore_errors=True)
    rows: dict[str, dict[str, Any]] = {}
    for name in options.only or (*COMMANDS, *CALLS):
        tables = out / "tables" / name
        shutil.rmtree(tables, ignore_errors=True)
        env = {**os.environ, "R2H_BATCH_CACHE": str(tables), "WARP_CACHE_PATH": str(out / "kernels")}
        env["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "osmesa")
        rows[name] = {}
        for turn in ROUNDS:
            new = out / turn
            new.mkdir(parents=True, exist_ok=True)
            if options.only:  # what the command wrote before, so that it does all of it again
                for word in _words(name, "{new}", ""):
                    if word.startswith("{new}/"):
                        _remove(new / word.removeprefix("{new}/"))
            line = [sys.executable, "-m", "r2h_batch", *_words(name, str(new), str(out / ROUNDS[0]))]
            if name in CALLS:
                line = [sys.executable, __file__, "--call", name]
            row = watched(line, env, out / f"{name}, {turn}.log")
            rows[name][turn] = row | {"said": str(row["said"]).replace(str(out), "OUT")}  # no folder of this machine
            print(name, turn, rows[name][turn], flush=True)
    return {"rows": rows, **made_by(MEASURES)}


def _words(name: str, new: str, first: str) -> list[str]:
    """Words of a command that writes into `new` and reads runs that the first round has made."""
    if name in CALLS:
        return []
    runs = {run: f"{first}/{run}" for run in ("run", "moving", "simulated")}
    words = [word.format(new=new, **runs) for word in shlex.split(COMMANDS[name])]
    return [word.replace(":x:", " x ") for word in words]


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


PAGE_TEXT = """# The first line

See how long a command, or a call in Python, says nothing. `python bench/first_lines.py --out OUT` measured seconds on the clock
on {cores} cores (bench/results/first_lines.json; {cpu}; load {load:.1f} at the start; commit {commit:.12}). Output went
into a pipe, where progress comes as lines; a terminal has a bar. *Cold*: the cache of tables is empty. The first command,
`sweep`, compiles the kernels too. *Warm*: the same command again. A command is ended after {limit:.0f} s.

Of {number} commands and calls, {long} take longer than {long_s:.0f} s. {late}

{table}

These ended within {long_s:.0f} s both times: {short}.
"""


def page(data: Mapping[str, Any]) -> str:
    """The page of the JSON."""
    rows: Mapping[str, Mapping[str, Mapping[str, Any]]] = data["rows"]
    long = {name: row for name, row in rows.items() if max(row[t]["whole_s"] for t in ROUNDS) > LONG_S}
    late = [
        n
        for n, row in long.items()
        if max(min(row[t]["first_s"] or LIMIT_S, row[t]["whole_s"]) for t in ROUNDS) > LONG_S
    ]
    head = ["", *(f"{what}, {t}" for t in ROUNDS for what in ("first line", "longest silence", "whole", "CPU seconds"))]
    cells = [
        [_named(name), *(_seconds(row[t], k) for t in ROUNDS for k in TIMES)] for name, row in long.items()
    ]  # fmt: skip
    made = data["hardware"]
    return PAGE_TEXT.format(
        cores=made["cores"],
        cpu=made["cpu"],
        load=made["load_at_start"],
        commit=data["commit"],
        limit=LIMIT_S,
        number=len(rows),
        long=len(long),
        long_s=LONG_S,
        late=f"These say their first line later than that: {', '.join(map(_named, late))}."
        if late
        else "All of these say their first line before.",
        table=markdown_table(head, cells),
        short=", ".join(_named(name) for name in rows if name not in long) or "none",
    )


def _named(name: str) -> str:
    return name if name in CALLS else f"`{name.split(', ')[0]}`{''.join(f', {w}' for w in name.split(', ')[1:])}"


def _seconds(row: Mapping[str, Any], key: str) -> str:
    if key == "whole_s" and row["end"] != "0":
        return f"over {LIMIT_S:.0f}" if row["end"] == "limit" else f"exit code {row['end']}"
    return f"{row[key]:.1f}"


def main() -> int:
    """Measures, or runs one call for a measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="runs, pages and films; emptied first, but with --only")
    parser.add_argument("--only", nargs="+", choices=[*COMMANDS, *CALLS], metavar="NAME", help="these alone")
    parser.add_argument("--call", choices=list(CALLS), help=argparse.SUPPRESS)
    parser.add_argument("--render", action="store_true", help="the page again from the JSON")
    options = parser.parse_args()
    if options.call:
        CALLS[options.call]()
        return 0
    if options.render:
        PAGE.write_text(page(json.loads(STORED.read_text())))
        return 0
    if options.out is None:
        parser.error("--out is missing: a folder for runs, pages and films")
    data = measured(options)
    failed = [n for n, row in data["rows"].items() for t in ROUNDS if row[t]["end"] not in ("0", "limit")]
    if failed:
        print(f"these failed, so nothing is written: {', '.join(failed)}; see their .log in {options.out}")
        return 1
    if not options.only:
        STORED.write_text(json.dumps(data, indent=1) + "\n")
        PAGE.write_text(page(data))
    return 0


if __name__ == "__main__":
    sys.exit(main())
