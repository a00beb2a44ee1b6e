"""The meaning of "unchanged": digests of rows, candidates and an export. `python tests/support/golden.py --write`.

`golden.json` holds, for each case, a sha256 over everything but times and machine facts, and the outcomes one by one.
The digests hold on processors of the kind named in the file, with the versions named there: torch and the physics
engines take other instructions on other ones. There, outcomes are compared instead.
"""

import argparse
import hashlib
import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

GOLDEN = Path(__file__).resolve().parents[1] / "golden.json"
POSES = Path(__file__).with_name("golden_poses.npz")

METHODS = ("random", "oracle", "fc", "handover-va", "contact", "intent")
KINEMATIC_TRIALS = 64
SIMULATED_TRIALS = 8
TIMES = ("t_plan_s", "t_method_s", "planned_q")
"""Times; and motions, which only files have."""
NOT_COMPARED = (
    *(*TIMES, "body_m"),
    *("age_years", "sex", "stature_m", "hand_length_m", "seated", "redrawn"),
)
"""Times; and what trials of r2h-v0, which most of these are, do not have."""
MACHINE_FACTS = ("t_plan_s", "versions", "git_commit", "digests", "configuration")
"""Fields of trial.json on where and with what it was made. The digest of the code changes with every comment."""

ENGINES = ("none", "mujoco", "mjwarp")
FAMILIES = "r2h-v2"
CASES = (*ENGINES, "pose", FAMILIES)
FAMILIES_TRIALS = 16


def compute(case: str, folder: Path) -> dict[str, dict[str, str]]:
    """Digest and outcomes of each part of a case of `CASES`; an engine's also of an export."""
    if case == FAMILIES:
        return _families(folder)
    return _candidates() if case == "pose" else sweep_digests(case, folder)


def _families(folder: Path) -> dict[str, dict[str, str]]:
    """Rows of methods in r2h-v2, with who the receivers are; motion as planned."""
    methods = (*METHODS, "learned")  # trained for this benchmark
    line = [
        "--method",
        *methods,
        "--benchmark",
        FAMILIES,
        "--trials",
        str(FAMILIES_TRIALS // 2),
        "--sim",
        "none",
    ]
    return _rows(FAMILIES, line, methods, folder, TIMES)


def sweep_digests(
    sim: str, folder: Path, methods: Sequence[str] = METHODS, more: Sequence[str] = ()
) -> dict[str, dict[str, str]]:
    """Built-in methods through the command, in this process: kernels, objects and tables are loaded once. `more` flags."""
    trials = KINEMATIC_TRIALS if sim == "none" else SIMULATED_TRIALS
    line = [
        "--method",
        *methods,
        *more,
        "--benchmark",
        "r2h-v0",
        "--trials",
        str(trials // 2),
        "--sim",
        sim,
    ]
    found = _rows(sim, line, methods, folder, NOT_COMPARED)
    if sim == "mujoco" and len(methods) > 1:
        found["export"] = _export(folder / sim, methods[1], folder / "export")
    return found


def _rows(
    case: str, line: list[str], methods: Sequence[str], folder: Path, not_compared: Iterable[str]
) -> dict[str, dict[str, str]]:
    """A part for each method of a sweep, with all tables that it stores."""
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.command import main as sweep

    _run(sweep, [*line, "--save-paths", "--out", str(folder / case)])
    stored = load_run(folder / case)
    found = {}
    for short, name in zip(methods, stored.methods, strict=True):
        tables = [stored.trials(name), stored.details(name), stored.poses(name), stored.paths(name)]
        rows = [_without(row, not_compared) for table in tables for row in table.to_pylist()]
        outcomes = " ".join(row["outcome"] for row in stored.trials(name).to_pylist())
        found[f"{case}.{short}"] = {"digest": _digest(rows), "outcomes": outcomes}
    return found


def _run(command: Callable[[list[str]], int], line: list[str]) -> None:
    """Runs a command quietly; what it said comes with the error if it fails."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = command(line)
    if code:
        raise RuntimeError(f"{' '.join(line)}: exit code {code}\n{said.getvalue()}")


def _export(run: Path, method: str, out: Path) -> dict[str, str]:
    from r2h_batch.__main__ import main

    _run(main, ["scene", str(run), "--trial", "3", "--method", method, "--out", str(out)])
    described = json.loads((out / "trial.json").read_text())
    parts: list[Any] = [_without(described, MACHINE_FACTS)]
    for file in sorted(f for f in out.rglob("*") if f.is_file() and f.name != "trial.json"):
        parts += [str(file.relative_to(out)), hashlib.sha256(_rounded(file)).hexdigest()]
    return {"digest": _digest(parts), "outcomes": described["outcome"]}


def _rounded(file: Path) -> bytes:
    """A file's bytes; numbers of text files to 6 digits, for eigenvectors come from a LAPACK that looks at the processor."""
    if file.suffix not in (".xml", ".csv", ".obj"):
        return file.read_bytes()
    return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.5e}", file.read_text()).encode()


def _candidates() -> dict[str, dict[str, str]]:
    """`stages="pose"` over the candidates of `golden_poses.npz`, of r2h-v0: half of oracle, half of random."""
    import torch
    from problems import default_evaluator

    from r2h_batch import load_benchmark

    with np.load(POSES) as mix:
        ids, T_obj_ee, T_world_ee = (torch.from_numpy(mix[k]) for k in ("trial_id", "T_obj_ee", "T_world_ee"))
    scores = default_evaluator().score(
        T_obj_ee, T_world_ee, load_benchmark("r2h-v0").trials_with_ids(ids), stages="pose"
    )
    names = [n for n in scores.__dataclass_fields__ if n not in NOT_COMPARED]
    parts: list[Any] = []
    for name in sorted(names):
        values = getattr(scores, name).numpy()
        parts += [name, str(values.dtype), list(values.shape), hashlib.sha256(values.tobytes()).hexdigest()]
    return {"pose": {"digest": _digest(parts), "outcomes": " ".join(map(str, scores.outcome.tolist()))}}


def _without(row: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {k: v for k, v in row.items() if k not in names}


def _digest(parts: list[Any]) -> str:
    """sha256 over JSON: floats are written so that they read back to the same bits."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def holds(stored: dict[str, Any], name: str) -> str:
    """The field that must be equal on this machine: the digest where this part was made with the same, else the outcomes."""
    return "digest" if stored["cases"][name].get("made_with", stored["made_with"]) == made_with() else "outcomes"


def made_with() -> dict[str, Any]:
    """Processor and versions: where the digests hold to the last bit."""
    from importlib import metadata

    packages = ("torch", "warp-lang", "mujoco", "mujoco-warp", "numpy", "scikit-learn", "trimesh")
    return {"processor": _processor(), "versions": {p: metadata.version(p) for p in packages}}


def _processor() -> str:
    """Vendor and the instructions that libraries choose their code by."""
    text = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    values = {k.strip(): v for k, _, v in (line.partition(":") for line in text.splitlines())}
    flags = [f for f in ("fma", "avx2", "avx512f", "avx512_bf16", "amx_tile") if f in values.get("flags", "").split()]
    return " ".join([values.get("vendor_id", "unknown").strip(), *flags])


def main() -> None:
    """Print what differs from golden.json; with --write, replace it."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)}; default: all")
    parser.add_argument("--write", action="store_true", help="replace golden.json, or these cases in it")
    options = parser.parse_args()
    write, cases = options.write, options.cases or CASES
    with tempfile.TemporaryDirectory() as folder:
        found: dict[str, dict[str, str]] = {}
        for case in cases:
            found |= compute(case, Path(folder))
    stored = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {"made_with": made_with(), "cases": {}}
    before = stored["cases"]
    changed = [k for k in found if any(found[k][part] != before.get(k, {}).get(part) for part in found[k])]
    for name in changed:
        old, new = before.get(name, {}).get("outcomes", "").split(), found[name]["outcomes"].split()
        print(
            f"{name}: other rows, {sum(a != b for a, b in zip(old, new, strict=False))} of {len(new)} outcomes differ"
        )
    if write:
        whole = {"made_with": made_with(), "cases": found}
        if options.cases:  # the others stay, with what they were made with
            own = {} if stored["made_with"] == made_with() else {"made_with": made_with()}
            whole = stored | {"cases": before | {name: part | own for name, part in found.items()}}
        GOLDEN.write_text(json.dumps(whole, indent=1) + "\n")
        print(f"{GOLDEN.name} written")
    else:
        print(f"{len(found) - len(changed)} of {len(found)} parts equal")
        sys.exit(bool(changed))


if __name__ == "__main__":
    main()
