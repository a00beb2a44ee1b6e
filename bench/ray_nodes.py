"""Sweeps over two real Ray nodes, on which processes die and memory and disks fill up: the rows are those of one process.

`python bench/ray_nodes.py --json bench/results/ray_nodes.json`: for each fault a head and a second node by `ray start`, a sweep
on both, the fault once shards are stored and both nodes score, the same command again, and the digest against that of one.
Full disks are small tmpfs mounts, which need root.
"""

import argparse
import contextlib
import logging
import multiprocessing
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from _report import Report
from run import Bench
from soak import compare, ended, stored_shards, sweep

STORE_BYTES = 80_000_000
"""Size of each node's object store: about the least that Ray takes."""

WAIT_S = 400


class Node:
    """One `ray start`, in a session of its own, so that its processes and no others can be found and ended."""

    def __init__(self, *words: str) -> None:
        line = [str(Path(sys.executable).with_name("ray")), "start", "--num-cpus", "1", "--disable-usage-stats"]
        line += ["--object-store-memory", str(STORE_BYTES), *words]
        started = subprocess.Popen(
            line, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.session = started.pid
        # the daemons keep the pipe open: what it said is read only where it failed
        assert started.wait(WAIT_S) == 0, started.stdout.read() if started.stdout else ""

    def processes(self, program: str = "") -> list[int]:
        """Ids of the node's processes whose command line holds a word."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                session = int((folder / "stat").read_text().rpartition(")")[2].split()[3])
                words = (folder / "cmdline").read_bytes().decode(errors="replace")
                if session == self.session and program in words:
                    found.append(int(folder.name))
        return found

    def kill(self, program: str = "") -> None:
        for pid in self.processes(program):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


class Cluster:
    """A head and a second node on this machine."""

    def __init__(self, folder: Path, *, spill: bool = True) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.address = f"127.0.0.1:{port}"
        words = ["--head", "--port", str(port), "--node-ip-address", "127.0.0.1", "--include-dashboard=false"]
        words += ["--temp-dir", str(folder)]
        if not spill:
            words += ["--system-config", '{"automatic_object_spilling_enabled": false}']
        self.nodes = [Node(*words)]
        self.nodes.append(Node("--address", self.address, "--node-ip-address", "127.0.0.1"))

    @property
    def scoring(self) -> bool:
        """Whether an actor scores on each node."""
        return all(n.processes("ray::Worker") for n in self.nodes)

    def stop(self) -> None:
        for node in self.nodes:
            node.kill()


def wait_for(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"waited {WAIT_S} s for {what}"
        time.sleep(0.05)


@contextlib.contextmanager
def disk(folder: Path, size: str) -> Iterator[Path]:
    """A tmpfs of that size."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill_stores(address: str, full: object) -> None:
    """Hold objects on both nodes, twice as large as their stores, until this process is ended."""
    import numpy as np
    import ray

    ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)

    @ray.remote(num_cpus=0, scheduling_strategy="SPREAD")
    def block() -> np.ndarray:
        return np.zeros(1_000_000)

    held = [block.remote() for _ in range(4 * STORE_BYTES // 8_000_000)]
    ray.wait(held, num_returns=len(held), timeout=60)
    full.set()  # type: ignore[attr-defined]
    time.sleep(3600)


@contextlib.contextmanager
def full_stores(address: str) -> Iterator[None]:
    """Both object stores are full meanwhile."""
    spawn = multiprocessing.get_context("spawn")
    full = spawn.Event()
    holder = spawn.Process(target=fill_stores, args=(address, full))
    holder.start()
    try:
        wait_for(lambda: full.is_set() or not holder.is_alive(), "full object stores")
        assert holder.is_alive(), "nothing fills the object stores"
        yield
    finally:
        holder.kill()
        holder.join()


def said(report: Report, name: str, process: subprocess.Popen[str], out: Path) -> int:
    """Exit code of a sweep; reports it with its last line and how many shards are stored."""
    start = time.monotonic()
    text, _ = process.communicate(timeout=WAIT_S)
    lines = [line for line in text.splitlines() if line.startswith(("sweep: ", "random: "))]
    report.add(f"{name}.exit", process.returncode)
    report.add(f"{name}.seconds_to_end", round(time.monotonic() - start, 1))
    report.add(f"{name}.shards", len(stored_shards(out)))
    report.add(f"{name}.says", lines[-1].replace(str(out.parent), "...") if lines else "")
    report.add(f"{name}.traceback", "Traceback" in text)
    return int(process.returncode)


def on(cluster: Cluster, out: Path, given: argparse.Namespace) -> subprocess.Popen[str]:
    return sweep(out, given, "1/1", "--engine", "ray", "--address", cluster.address, "--workers", "2", "ray_timeout=15")


def again(report: Report, name: str, cluster: Cluster, out: Path, given: argparse.Namespace) -> None:
    """The same command, which must complete the run."""
    if said(report, f"{name}.again", on(cluster, out, given), out) != 0:
        raise SystemExit(f"{name}: the same command did not go on")


def dies(report: Report, name: str, base: Path, plain: Path, given: argparse.Namespace) -> None:
    """One process of a cluster, or the driver, is killed while both nodes score; then the same command again."""
    out, cluster = base / name, Cluster(base / f"r_{name}")
    try:
        driver = on(cluster, out, given)
        wait_for(
            lambda: driver.poll() is not None or (len(stored_shards(out)) >= 2 and cluster.scoring),
            "both nodes at work",
        )
        assert driver.poll() is None, driver.communicate()[0][-2000:]
        report.add(f"{name}.shards_before", len(stored_shards(out)))
        match name:
            case "second_raylet":
                cluster.nodes[1].kill("/raylet/raylet")
            case "head_raylet":
                cluster.nodes[0].kill("/raylet/raylet")
            case "gcs":
                cluster.nodes[0].kill("/gcs/gcs_server")
            case "driver":
                driver.kill()
        code = said(report, name, driver, out)
        if name in ("head_raylet", "gcs"):
            cluster.stop()
            cluster = Cluster(base / f"r2_{name}")
        if code != 0:
            again(report, name, cluster, out, given)
        compare(report, name, plain, out)
    finally:
        cluster.stop()


def full_store(report: Report, name: str, base: Path, plain: Path, given: argparse.Namespace) -> None:
    """Object stores are full and nothing may spill; their overflow lies on a disk with room or without."""
    out = base / name
    with disk(base / f"r_{name}", "64m" if name.endswith("disk") else "4g") as folder:
        cluster = Cluster(folder, spill=False)
        try:
            with full_stores(cluster.address):
                report.add(f"{name}.session_folder_used", round(shutil.disk_usage(folder).used / 2**20))
                said(report, name, on(cluster, out, given), out)
            again(report, name, cluster, out, given)
            compare(report, name, plain, out)
        finally:
            cluster.stop()


def full_disk(report: Report, name: str, base: Path, plain: Path, given: argparse.Namespace) -> None:
    """The disk of the run folder fills up, then it has room."""
    cluster = Cluster(base / f"r_{name}")
    try:
        with disk(base / name, "1m") as folder:
            out = folder / "run"
            said(report, name, on(cluster, out, given), out)
            subprocess.run(["mount", "-o", "remount,size=1g", str(folder)], check=True)
            again(report, name, cluster, out, given)
            compare(report, name, plain, out)
    finally:
        cluster.stop()


FAULTS = {
    "second_raylet": dies,
    "head_raylet": dies,
    "gcs": dies,
    "driver": dies,
    "full_store": full_store,
    "full_store_and_disk": full_store,
    "full_disk": full_disk,
}


def run(given: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    os.environ.update(RAY_AUTH_MODE="disabled", RAY_USAGE_STATS_ENABLED="0")
    with tempfile.TemporaryDirectory(prefix="ray") as temporary:
        base = Path(temporary)
        ended(sweep(base / "plain", given))
        for name in given.faults:
            FAULTS[name](report, name, base, base / "plain", given)
            report.write(given.json)


BENCH = Bench(
    __doc__,
    run,
    (),
    {
        "--faults": {"nargs": "+", "choices": FAULTS, "default": list(FAULTS)},
        "--trials": {"default": 10_000, "help": "of each of two splits"},
        "--shard-trials": {"default": 1000},
    },
    peer="the run of one process",
)

if __name__ == "__main__":
    BENCH.main()
