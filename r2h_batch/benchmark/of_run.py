"""The benchmark that a run was made on, read again and compared with the run's digests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from r2h_batch.benchmark.benchmark import Benchmark
from r2h_batch.benchmark.given import Given
from r2h_batch.benchmark.trials_file import LISTED
from r2h_batch.bodies.objects import object_digest
from r2h_batch.files import FileError
from r2h_batch.turns import PROTOCOLS

__all__ = ["benchmark_of_run"]


def benchmark_of_run(header: Mapping[str, Any], given: Given, where: str) -> Benchmark:
    """What `given` says, if it is what the run of this header was made on; `FileError`, one line, tells what to give.

    Nothing that run.json names is opened: a folder may come from anybody.
    """
    protocol = header["protocol"]
    if protocol not in (*PROTOCOLS, LISTED):
        raise FileError(f"{where}: protocol {protocol!r}; this version makes the trials of {', '.join(PROTOCOLS)}")
    asked = header["benchmark"]["flags"] if "benchmark" in header else None
    if asked is not None:  # the run names these itself: nobody has to give them again
        asked = [f for f in asked if not f.startswith(("--protocol ", "--receiver "))]
    own = [o["name"] for o in header.get("objects", []) if not o["built_in"]]
    if asked is None and len(given.object_mesh) != len(own):
        raise FileError(
            f"{where}: has the user's objects {', '.join(own) or 'none'}; give their --object-mesh as in the sweep"
        )
    if asked is not None and {f.split()[0] for f in asked} != {f.split()[0] for f in given.flags()}:
        raise FileError(f"{where}: give what its sweep was given: {' '.join(asked) or 'no flag for objects or hands'}")
    pieces = header["configuration"]["plan"]["object_collision"] == "pieces"  # as the sweep builds them
    if protocol != LISTED:
        given = replace(given, protocol=protocol)
    if header["configuration"].get("receiver") == "body":
        given = replace(given, receiver="body")
    benchmark = given.read(pieces=pieces)
    found = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
    if "benchmark" in header["digests"]:  # runs from before there were any lack it
        found["benchmark"] = benchmark.digest
    differing = [k for k, v in found.items() if header["digests"].get(k) != v]
    if differing:
        files = f"; its sweep was given {' '.join(asked)}" if asked else ""
        raise FileError(
            f"{where}: was made with other {', '.join(differing)}{files}; take the same files, and r2h_batch"
            f" {header['versions'].get('r2h_batch')} at commit {header.get('git_commit')}"
        )
    return benchmark
