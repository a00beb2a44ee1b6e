"""Stored rows of the built-in methods: which folder holds those of a benchmark."""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from r2h_batch.base.errors import FileError
from r2h_batch.base.registry import DEFAULT_BENCHMARK, METHOD_NAMES, protocol_of

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

BASELINES = "baselines"
"""The word for the shipped rows of all built-in methods: `compare runs/mine baselines`."""

SHIPPED = Path(__file__).parent / "rows"
"""Rows of the default benchmark, 500 trials of each split: moved by MuJoCo C (with poses), and with `--execute.sim none`
(`make tables` scores them again); and of r2h-v3 in both tracks, told the truth and seeing (bench/r2h_v3.py)."""

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
    that sees the same and was moved by the same engine if there is one; else of the same rule, objects and hands.

    Args:
        header: run.json; None: simulated rows of the default benchmark.

    Raises:
        FileError: none is stored; the line says the command that makes it.
    """
    if header is None:
        return baselines_of(None, DEFAULT_BENCHMARK)
    likeness = {folder: _likeness(header, own) for folder, own in _headers().items()}
    suited = [
        folder for folder, (benchmark, preset, *_) in likeness.items() if benchmark and preset
    ]
    if not suited:
        flags = " ".join((header.get("benchmark") or {}).get("flags", ()))
        preset = header.get("configuration", {}).get("name", "default")
        raise FileError(_none_stored(str(header.get("protocol", "")), flags, preset))
    return max(suited, key=lambda folder: likeness[folder])


def baselines_of(digest: str | None, name: str) -> Path:
    """The stored run of a benchmark with the default preset, told the truth, simulated if there is one.

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
        and "sees" not in own["digests"]
        and (own["digests"]["benchmark"] == digest if digest else own["protocol"] == name)
    ]
    if not found:
        raise FileError(_none_stored(name, f"--benchmark {name}", "default"))
    simulated = [f for f in found if _headers()[f]["configuration"]["execute"]["sim"] != "none"]
    return (simulated or found)[0]


class Known(Protocol):
    """What a benchmark (`trials.benchmark.Benchmark`) is known by: counting knows no more of it."""

    @property
    def name(self) -> str: ...
    @property
    def digest(self) -> str: ...


def load_baselines(benchmark: Known) -> "Run":
    """The stored rows of the built-in methods on a benchmark.

    Args:
        benchmark: such as `load_benchmark(NAME)`.

    Raises:
        FileError: none are stored; the line says the command that makes them.
    """
    return load_rows(baselines_of(benchmark.digest, benchmark.name), verify=False)


def load_rows(folder: Path, *, verify: bool = True) -> "Run":
    """A stored run, and beside a shipped one the rows of built-in methods that came later.

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


def _likeness(header: Mapping[str, Any], own: Mapping[str, Any]) -> tuple[int, int, int, int]:
    """How well stored rows suit a run: its benchmark (2: the same digest, 1: the same rule, objects and hands), its preset,
    what its methods see, its engine."""
    digests, theirs = header.get("digests", {}), own["digests"]
    same = digests.get("benchmark") == theirs["benchmark"]
    alike = protocol_of(header) == own["protocol"] and all(
        digests.get(k) == theirs[k] for k in ("objects", "hand_set")
    )
    configuration = header.get("configuration", {})
    preset = configuration.get("name", "default") == own["configuration"]["name"]
    sees = digests.get("sees") == theirs.get("sees")
    engines = ((c.get("execute") or {}).get("sim") for c in (configuration, own["configuration"]))
    return 2 if same else int(alike), int(preset), int(sees), int(len({*engines}) == 1)


def _none_stored(name: str, flags: str, preset: str) -> str:
    out = f"runs/baselines-{name}"
    more = "" if preset == "default" else f" --preset {preset}"
    line = f"r2h-batch sweep --method {' '.join(METHOD_NAMES)} {flags}{more} --out {out}".replace(
        "  ", " "
    )
    own = re.sub(r"--benchmark \S+", "", flags).strip()
    own = f" with {own}" if own else ""
    return f"no rows of the built-in methods are stored for benchmark {name}{more}{own}; make them with `{line}`, then say {out}"
