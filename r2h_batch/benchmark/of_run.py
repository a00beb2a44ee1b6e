"""The benchmark that a run was made on, read again and compared with the run's digests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from r2h_batch.benchmark.benchmark import Benchmark
from r2h_batch.benchmark.given import Given
from r2h_batch.benchmark.trials_file import LISTED
from r2h_batch.benchmark.unbuilt import is_unbuilt
from r2h_batch.bodies.objects import ObjectModel, object_digest
from r2h_batch.io.read import FileError
from r2h_batch.schedule import PROTOCOLS

__all__ = ["benchmark_of_run", "objects_digest"]


def objects_digest(digests: Iterable[str]) -> str:
    """sha256 (hex) over the digests of a run's objects, one by one and in order: what run.json is
    held to."""
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def benchmark_of_run(
    header: Mapping[str, Any], given: Given, where: str, only: frozenset[str] | None = None
) -> Benchmark:
    """What `given` says, if it is what the run of this header was made on; `FileError`, one line,
    tells what to give.

    `only`: names of the meshes that are built and compared, the others are left `unbuilt`; runs
    from before run.json had a digest of every object have all built. Nothing that run.json names is
    opened: a folder may come from anybody.
    """
    protocol = header["protocol"]
    if protocol not in (*PROTOCOLS, LISTED):
        raise FileError(
            f"{where}: protocol {protocol!r}; this version makes the trials of {', '.join(PROTOCOLS)}"
        )
    asked = header["benchmark"]["flags"] if "benchmark" in header else None
    if asked is not None:  # the run names these itself: nobody has to give them again
        asked = [f for f in asked if not f.startswith(("--protocol ", "--receiver "))]
    own = [o["name"] for o in header.get("objects", []) if not o["built_in"]]
    if asked is None and len(given.object_mesh) != len(own):
        raise FileError(
            f"{where}: has the user's objects {', '.join(own) or 'none'}; give their --object-mesh as in the sweep"
        )
    if asked is not None and {f.split()[0] for f in asked} != {f.split()[0] for f in given.flags()}:
        raise FileError(
            f"{where}: give what its sweep was given: {' '.join(asked) or 'no flag for objects or hands'}"
        )
    pieces = (
        header["configuration"]["plan"]["object_collision"] == "pieces"
    )  # as the sweep builds them
    if protocol != LISTED:
        given = replace(given, protocol=protocol)
    if header["configuration"].get("receiver") == "body":
        given = replace(given, receiver="body")
    if only is None or not _says_each_object(header, where):
        benchmark = given.read(pieces=pieces)
        found = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
        if "benchmark" in header["digests"]:  # runs from before there were any lack it
            found["benchmark"] = benchmark.digest
    else:
        benchmark = given.read(pieces=pieces, only=only)
        found = {
            "hand_set": benchmark.hand_set.digest,
            "apart_from_objects": benchmark.apart_from_objects,
        }
    differing = [k for k, v in found.items() if header["digests"].get(k) != v]
    if "objects" not in found:
        differing += _other_objects(header["objects"], benchmark.objects)
    if differing:
        files = f"; its sweep was given {' '.join(asked)}" if asked else ""
        raise FileError(
            f"{where}: was made with other {', '.join(differing)}{files}; take the same files, and r2h_batch"
            f" {header['versions'].get('r2h_batch')} at commit {header.get('git_commit')}"
        )
    return benchmark


def _says_each_object(header: Mapping[str, Any], where: str) -> bool:
    """Whether a run.json has the digest of every object; refused where they are not those that its
    hash covers."""
    whole = header["digests"].get("each_object")
    if whole is None:
        return False
    if whole != objects_digest(str(o.get("digest")) for o in header["objects"]):
        raise FileError(
            f"{where}: run.json's objects are not those of its digest each_object; restore it"
        )
    return True


def _other_objects(said: Sequence[Mapping[str, Any]], found: Sequence[ObjectModel]) -> list[str]:
    """What differs between a run's objects and these, of which only those that are built can be
    compared whole."""
    if [(o["name"], o["split"]) for o in said] != [(o.name, o.split) for o in found]:
        return ["objects"]
    pairs = zip(said, found, strict=True)
    other = [o.name for own, o in pairs if not is_unbuilt(o) and object_digest(o) != own["digest"]]
    return [f"objects ({', '.join(other[:10])})"] if other else []
