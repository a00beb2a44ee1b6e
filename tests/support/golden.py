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
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

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
ROWS = 16
"""Rows of a method in each case beyond r2h-v0."""


class Sweep(NamedTuple):
    """A case that a command makes: what is swept, by which methods, with which flags."""

    benchmark: str
    methods: tuple[str, ...]
    flags: tuple[str, ...] = ("--execute.sim", "none")


SWEEPS = {
    FAMILIES: Sweep(FAMILIES, (*METHODS, "learned")),  # learned was trained for this benchmark
    "r2h-v1": Sweep("r2h-v1", ("random", "fc", "intent")),
    "release": Sweep("r2h-release", ("random", "contact"), ("--execute.sim", "none", "--preset", "release")),
    "r2h-v3": Sweep("r2h-v3", ("random", "oracle", "fc")),
    "sees": Sweep(FAMILIES, ("robust", "learned"), ("--execute.sim", "none", "--sees", "cell-v1,region=told")),
    "closed": Sweep(
        FAMILIES, ("oracle",), ("--execute.sim", "none", "--receiver-motion", "moves", "--policy", "servo")
    ),
    "physics": Sweep(FAMILIES, ("random", "fc"), ("--execute.sim", "none", "--stability", "physics")),
    "mesh": Sweep(FAMILIES, ("random", "fc")),
    "ur3e_2f85": Sweep(FAMILIES, ("random", "fc"), ("--execute.sim", "none", "--robot", "ur3e_2f85")),
    "panda_hand": Sweep(FAMILIES, ("random", "fc"), ("--execute.sim", "none", "--robot", "panda_hand")),
}
CASES = (*ENGINES, "pose", "gradients", "redraws", *SWEEPS)
PARTS = dict.fromkeys(ENGINES, "oracle") | {
    case: sweep.methods[-1] for case, sweep in SWEEPS.items() if case != FAMILIES and len(sweep.methods) > 1
}
"""Case -> the method whose rows stand for all where all would take too long. The default benchmark is always whole."""


def compute(case: str, folder: Path, method: str | None = None) -> dict[str, dict[str, str]]:
    """Digest and outcomes of each part of a case of `CASES`, or of one `method`'s; an engine's whole also of an export."""
    if case in SWEEPS:
        return _swept(case, folder, (method,) if method else SWEEPS[case].methods)
    made = {"pose": _candidates, "gradients": _gradients, "redraws": _redraws}
    return made[case]() if case in made else sweep_digests(case, folder, (method,) if method else METHODS)


def _swept(case: str, folder: Path, methods: tuple[str, ...]) -> dict[str, dict[str, str]]:
    """Rows of a case of `SWEEPS`, with who the receivers are."""
    benchmark, _, flags = SWEEPS[case]
    if case == "mesh":
        flags += _mesh_flags(folder)
    line = ["--method", *methods, "--benchmark", benchmark, "--trials", str(ROWS // 2), *flags]
    return _rows(case, line, methods, folder, TIMES)


def _mesh_flags(folder: Path) -> tuple[str, ...]:
    """An object of a user's own: a bar with a knob, open at one face, so that it is repaired on the way."""
    import trimesh

    bar = trimesh.creation.box((0.02, 0.015, 0.16))
    bar.update_faces(np.arange(len(bar.faces)) != 3)
    knob = trimesh.creation.icosphere(2, 0.02)
    knob.apply_translation((0, 0, 0.08))
    meshes = folder / "meshes"
    meshes.mkdir()
    trimesh.util.concatenate([bar, knob]).export(meshes / "bar.obj")
    (meshes / "bar.yaml").write_text("split: S1\nreceiver: z<0.3\nmass: 0.2\n")
    trimesh.creation.capsule(0.1, 0.025).export(meshes / "stick.stl")
    (meshes / "stick.yaml").write_text("split: S0\nmass: 0.2\n")
    return ("--objects", str(meshes))


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
        "--execute.sim",
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

    _run(main, ["export", "scene", str(run), "--trial", "3", "--method", method, "--out", str(out)])
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
    names = [f.name for f in fields(scores) if f.name not in NOT_COMPARED]
    parts: list[Any] = []
    for name in sorted(names):
        values = getattr(scores, name).numpy()
        parts += [name, str(values.dtype), list(values.shape), hashlib.sha256(values.tobytes()).hexdigest()]
    return {"pose": {"digest": _digest(parts), "outcomes": " ".join(map(str, scores.outcome.tolist()))}}


def _gradients() -> dict[str, dict[str, str]]:
    """Gradients of the soft score by both poses, of the first candidates of `golden_poses.npz` (r2h-v0): their digest, and in
    place of outcomes the sign of each, to one digit, of the sum over a row."""
    import torch
    from problems import default_evaluator

    from r2h_batch import load_benchmark

    with np.load(POSES) as mix:
        ids, T_obj_ee, T_world_ee = (torch.from_numpy(mix[k][:ROWS]) for k in ("trial_id", "T_obj_ee", "T_world_ee"))
    moved = T_obj_ee.clone().requires_grad_(), T_world_ee.clone().requires_grad_()
    scores = default_evaluator().score(*moved, load_benchmark("r2h-v0").trials_with_ids(ids), stages="pose")
    found = torch.autograd.grad(scores.soft(temperature_m=0.005, log=True).sum(), moved)
    bits = [hashlib.sha256(g.contiguous().numpy().tobytes()).hexdigest() for g in found]
    words = " ".join(f"{np.sign(g):+.0f}" for g in torch.cat([x[:, :3, 3] for x in found]).flatten().tolist())
    return {"gradients": {"digest": _digest(bits), "outcomes": words}}


def _redraws() -> dict[str, dict[str, str]]:
    """r2h-v3's trials: where hands and objects are, how often each was drawn again, which certificates are in force."""
    from r2h_batch import load_benchmark

    benchmark = load_benchmark("r2h-v3")
    trials = benchmark.trials(ROWS)
    ids = trials.trial_id.numpy()
    redraws, answers = benchmark.redraws(ids), benchmark.certificates(ids)
    placed = [x.numpy().tobytes().hex() for x in (trials.T_world_hand, trials.object_index, trials.hand_index)]
    solved = [str(np.asarray(x).tolist()) for x in (answers.known, answers.T_obj_ee, answers.T_world_ee)]
    words = " ".join(map(str, redraws.tolist()))
    return {"redraws": {"digest": _digest([*placed, words, *solved]), "outcomes": words}}


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
