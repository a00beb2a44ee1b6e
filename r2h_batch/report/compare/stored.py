"""Stored rows of the built-in methods: which folder holds those of a benchmark."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.registry import DEFAULT_PROTOCOL, METHOD_NAMES

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

SHIPPED = Path(__file__).parent / "rows"
"""Rows of the default benchmark, 500 trials of each split: moved by MuJoCo C (with poses), and with `--sim none`.
`make tables` scores them again."""

ALIKE_M, ALIKE_SHARE = 1e-3, 0.01
"""Answers nearer than this are the same; a method with this share of another one's answers has them from it [choice]."""

LATER = Path(__file__).parent / "later"
"""Rows of built-in methods that came after the others, in folders of the same names: of one later commit."""

ROWS = Path(__file__).resolve().parents[3] / "bench" / "rows"
"""Only in a checkout: rows of the other benchmarks and presets."""


@cache
def stored_rows() -> tuple[Path, ...]:
    """All folders of rows that the project's tests judge again, those of the default benchmark first."""
    return tuple(
        folder
        for place in (SHIPPED, ROWS)
        if place.is_dir()
        for folder in sorted(place.iterdir())
        if folder.is_dir()
    )


def baselines_for(header: Mapping[str, Any] | None = None) -> Path:
    """The stored run that the run of this run.json can be compared with: of the same benchmark, by its digest, and preset,
    moved by the same engine if there is one; else of the same rule, objects and hands.

    Args:
        header: run.json; None: simulated rows of the default benchmark.

    Raises:
        FileError: none is stored; the line says the command that makes it.
    """
    if header is None:
        return baselines_of(None, DEFAULT_PROTOCOL)
    likeness = {folder: _likeness(header, own) for folder, own in _headers().items()}
    suited = [folder for folder, (benchmark, preset, _) in likeness.items() if benchmark and preset]
    if not suited:
        flags = " ".join((header.get("benchmark") or {}).get("flags", ()))
        preset = header.get("configuration", {}).get("name", "default")
        raise FileError(_none_stored(str(header.get("protocol", "")), flags, preset))
    return max(suited, key=lambda folder: likeness[folder])


def baselines_of(digest: str | None, name: str) -> Path:
    """The stored run of a benchmark with the default preset, simulated if there is one.

    Args:
        digest: of the benchmark; None: of the rule `name`.
        name: of the benchmark, for the message.

    Raises:
        FileError: none is stored; the line says the command that makes it.
    """
    found = [
        folder
        for folder, own in _headers().items()
        if own["configuration"]["name"] == "default"
        and (own["digests"]["benchmark"] == digest if digest else own["protocol"] == name)
    ]
    if not found:
        raise FileError(_none_stored(name, f"--benchmark {name}", "default"))
    simulated = [f for f in found if _headers()[f]["configuration"]["execute"]["sim"] != "none"]
    return (simulated or found)[0]


def load_baselines(folder: Path, *, verify: bool = True) -> "Run":
    """A run, and beside a shipped one the rows of built-in methods that came later.

    Args:
        folder: a run folder, such as `baselines_for` gives.
        verify: as of `load_run`.

    Raises:
        RunError: the folder is no run folder, or a file is not as it was written.
    """
    from r2h_batch.runs.store import join, load_run

    later = LATER / folder.name
    folders = [folder, later] if folder.parent == SHIPPED and later.is_dir() else [folder]
    return join([load_run(f, verify=verify) for f in folders])


def is_stored(run: "Run") -> bool:
    """Whether a run is one of the stored ones."""
    return run.folder in stored_rows()


@cache
def _headers() -> dict[Path, dict[str, Any]]:
    from r2h_batch.runs.header import read_header

    return {folder: read_header(folder) for folder in stored_rows()}


def answers_of_shipped(run: "Run", method: str) -> dict[str, float]:
    """Built-in method -> the share of a method's answers that are its shipped ones, where that is `ALIKE_SHARE` or more.

    An answer is a shipped one if grasp and handover pose both have the ee within `ALIKE_M` of it. Other built-in methods agree
    in none of 1,000 trials of r2h-v2.

    Args:
        run: with poses.
        method: name in the run.
    """
    ids, places = _places(run, method)
    shares: dict[str, float] = {}
    for folder, header in _headers().items():
        digests = run.header.get("digests", {}), header["digests"]
        if "poses" not in header["stored"] or len({d.get("benchmark") for d in digests}) > 1:
            continue
        stored = load_baselines(folder, verify=False)
        for name in stored.methods:
            own, there = _places(stored, name)
            _, a, b = np.intersect1d(ids, own, return_indices=True)
            near = np.linalg.norm(places[a] - there[b], axis=2) <= ALIKE_M
            shares[name] = max(shares.get(name, 0.0), near.all(1).sum() / max(len(ids), 1))
    return {name: float(share) for name, share in shares.items() if share >= ALIKE_SHARE}


def _places(run: "Run", method: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Trials, and where the ee is on the object and in the world (n, 2, 3), m."""
    table = run.poses(method)
    T = [
        pc.list_flatten(table[k]).to_numpy().astype(np.float64).reshape(-1, 4, 4)
        for k in ("T_obj_ee", "T_world_ee")
    ]
    return table["trial_id"].to_numpy(), np.stack([x[:, :3, 3] for x in T], 1)


def _likeness(header: Mapping[str, Any], own: Mapping[str, Any]) -> tuple[int, int, int]:
    """How well stored rows suit a run: its benchmark (2: the same digest, 1: the same rule, objects and hands), its preset,
    its engine."""
    digests, theirs = header.get("digests", {}), own["digests"]
    same = digests.get("benchmark") == theirs["benchmark"]
    alike = header.get("protocol") == own["protocol"] and all(
        digests.get(k) == theirs[k] for k in ("objects", "hand_set")
    )
    configuration = header.get("configuration", {})
    preset = configuration.get("name", "default") == own["configuration"]["name"]
    engines = ((c.get("execute") or {}).get("sim") for c in (configuration, own["configuration"]))
    return 2 if same else int(alike), int(preset), int(len({*engines}) == 1)


def _none_stored(name: str, flags: str, preset: str) -> str:
    out = f"runs/baselines-{name}"
    more = "" if preset == "default" else f" --preset {preset}"
    line = f"r2h-batch sweep --method {' '.join(METHOD_NAMES)} {flags}{more} --out {out}".replace(
        "  ", " "
    )
    return f"no rows of the built-in methods are stored for benchmark {name}{more}; make them with `{line}`, then say {out}"
