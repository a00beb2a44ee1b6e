"""Shared by benches: figures as lines and JSON with commit, versions and hardware; pages; quiet sweeps; memory."""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stdout
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from io import StringIO
from pathlib import Path
from typing import Any

from _source import ROOT, digests

STARTED, LOAD = time.time(), os.getloadavg()[0]
"""When this bench started, and the other work on the machine then: the bench's own work is in every later load."""

FIGURES_SINCE = (
    (1, ("*",), "all benches measured again on one commit, with a digest of the source that they measured"),
)
"""(version, benches, reason): a person adds a line when a change moves figures of these benches ("*": of all). Figures of an
earlier version may not stand on a page (tests/test_figures.py)."""

PACKAGES = (
    "warp-lang",
    "torch",
    "numpy",
    "mujoco",
    "mujoco-warp",
    "pytorch-kinematics",
    "ur-analytic-ik",
    "ompl",
    "python-fcl",
)


class Report:
    """Collects figures; every figure is printed the moment it is known.

    Args:
        measures: files and folders whose code the figures depend on.
    """

    def __init__(self, measures: Sequence[str] = ()) -> None:
        self.measures = measures
        self.values: dict[str, float | int | str | bool] = {}
        self.beside: dict[str, Any] = {}

    def add(self, name: str, value: float | int | str | bool) -> None:
        """Prints and keeps one figure; `name` is `bench.metric`, a name can be given once."""
        if name in self.values:
            raise ValueError(f"{name} was reported already")
        value = value.item() if hasattr(value, "item") else value
        self.values[name] = value
        print(name, f"{value:.6g}" if isinstance(value, float) else value, flush=True)

    def write(self, path: str | Path | None) -> None:
        """Writes the figures, what stands beside them, and where they come from (unless that stands there already: parts of an
        earlier JSON); nothing if `path` is None."""
        if path is None:
            return
        data = ({"values": self.values} if self.values else {}) | self.beside
        data |= {} if "commit" in data else made_by(self.measures)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps(data, indent=1) + "\n")


class Parts:
    """Figures that are measured once: a bench that was stopped goes on with those that are missing.

    Args:
        folder: where they are kept; None: nowhere.
        of: what they depend on. A part of anything else is measured again.
    """

    def __init__(self, folder: Path | None, of: dict[str, Any]) -> None:
        self.folder, self.of = folder, of
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, measured: Callable[[], Any]) -> Any:
        """A part as it is kept, or measured and kept."""
        path = None if self.folder is None else self.folder / f"{name.replace('/', '_')}.json"
        if path is not None and path.is_file():
            kept = json.loads(path.read_text())
            if kept["of"] == self.of:
                print(name, "is kept in", path, flush=True)
                return kept["part"]
        begin = time.time()
        part = measured()
        print(f"{name}: {time.time() - begin:.0f} s", flush=True)
        if path is not None:
            path.write_text(json.dumps({"of": self.of, "part": part}))
        return part


def swept(folder: Path, *words: object) -> Path:
    """Runs a sweep into a folder, or goes on with it, without its table; the folder."""
    from r2h_batch.sweep.command import main

    with redirect_stdout(StringIO()):
        code = main([*map(str, words), "--out", str(folder)])
    return sys.exit(code) if code else folder


def memory_over(trials: int, some_more: Callable[[int], int]) -> dict[str, Any]:
    """Resident MiB after each tenth of `trials` trials; `some_more` takes how many are done and says how many it did."""
    mib: list[int] = []
    done, begin = 0, time.process_time()
    while done < trials:
        done += some_more(done)
        if done * 10 >= trials * (len(mib) + 1):
            mib.append(round(resident_mib()))
            print(done, mib[-1], flush=True)
    return {"trials": done, "mib": mib, "s": time.process_time() - begin}


def resident_mib(pid: int | None = None) -> float:
    """Resident memory of a process, MiB; None: this one. NaN where it is gone."""
    try:
        pages = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return float("nan")
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]], *, left: bool = False) -> str:
    """A Markdown table whose columns but the first are right-aligned, or none of them."""
    rule = f"|---|{'|'.join(['---' if left else '--:'] * (len(head) - 1))}|"
    first, *lines = (f"| {' | '.join(map(str, line))} |" for line in (head, *rows))
    return "\n".join([first, rule, *lines])


def lines_of(text: str, head: str) -> list[list[str]]:
    """Cells of the rows of the Markdown table that follows the line `head`."""
    body = text.split(f"{head}\n\n", 1)[1].split("\n\n", 1)[0].splitlines()
    return [[c.strip() for c in line.strip("|").split("|")] for line in body]


def made_by(measures: Sequence[str] = ()) -> dict[str, object]:
    """Commit, files changed since, date, versions, hardware and digests of the measured code: where figures come from."""
    # benches write these four themselves, one after the other
    own = (":!bench/results", ":!bench/options", ":!docs", ":!README.md")
    changed = (_git("status", "--porcelain", "--untracked-files=no", "--", ".", *own) or "").splitlines()
    return {
        "commit": _git("rev-parse", "HEAD"),
        "changed_files": len([line for line in changed if line]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version()} | {p: v for p in PACKAGES if (v := _version(p))},
        "hardware": hardware(),
        "seconds": round(time.time() - STARTED),
        "figures_since": FIGURES_SINCE[-1][0],
        "measures": list(measures),
        "source": digests(measures),
    }


def hardware() -> dict[str, object]:
    """CPU model, cores this process may use, load at the start (other work on the machine), GPU if there is one."""
    gpus = _run("nvidia-smi", "--query-gpu=name", "--format=csv,noheader")
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_at_start": round(LOAD, 2),
        "devices": ["cpu", *(gpus.splitlines() if gpus else [])],
        "platform": f"{platform.system()} {platform.machine()}",
    }


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git(*args: str) -> str | None:
    return _run("git", "-C", str(ROOT), *args)


def _run(*command: str) -> str | None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
