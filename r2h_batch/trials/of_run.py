"""The benchmark of a stored run: that of its run.json, from the files of its folder or those that it names."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import BEFORE, LISTED, protocol_of
from r2h_batch.runs.before import tell_changed
from r2h_batch.scene.objects import object_digest
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.choice import BenchmarkChoice, words_of
from r2h_batch.trials.edit import edited
from r2h_batch.trials.registry import BENCHMARK
from r2h_batch.trials.run_files import placed
from r2h_batch.verdicts import ASKED_NAMES, MAY_ASK

IN_HEADER = ("receiver", "until")
"""Flags whose words run.json has elsewhere: in its configuration, in what its benchmark asks for."""


def benchmark_of_run(
    header: Mapping[str, Any], where: str, code: Collection[str] = ()
) -> Benchmark:
    """The benchmark of a stored run.

    Its files lie in the run folder (`run_files`), or where run.json says. A run folder may come from anybody, so digests
    decide: other files are refused, and no code is imported that the user does not name.

    Args:
        header: run.json.
        where: the run folder.
        code: functions of benchmarks and families that may run: `FILE.py:function`, `package.module:function`.

    Raises:
        FileError: a file is missing, or another one; the message says what to do.
    """
    protocol, digests = protocol_of(header), header["digests"]
    said = _said(header, where)
    given = placed(said, Path(where), code)
    if not given.benchmark and protocol != LISTED:
        if protocol not in BENCHMARK:
            known = f"this installation has {', '.join(BENCHMARK)}"
            raise FileError(f"{where}: benchmark {printable(protocol)!r}; {known}")
        given = replace(given, benchmark=protocol)
    asked = tuple(header.get("asks", ()))
    asks = tuple(name for name in asked if name in ASKED_NAMES)
    given = replace(given, receiver=header["configuration"].get("receiver", "hand"), until="")
    pieces = header["configuration"]["plan"]["object_collision"] == "pieces"
    benchmark = edited(given, pieces=pieces)
    if asks in MAY_ASK:  # r2h-v3 of before asked for less
        benchmark = replace(benchmark, asks=asks)
    head_m = header.get("head_clearance_m", 0.0)
    if benchmark.head_clearance_m != head_m:  # nor did it keep off the head
        benchmark = replace(benchmark, head_clearance_m=head_m)
    found = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
    if "benchmark" in digests:  # older runs lack it
        found["benchmark"] = benchmark.digest
        if changed := benchmark.digests_before(asked).get(digests["benchmark"]):
            found["benchmark"] = digests["benchmark"]
            benchmark = benchmark.drawn_before()
            tell_changed(Path(where), changed)
    differing = [k for k, v in found.items() if digests.get(k) != v]
    pairs = zip(header.get("objects", ()), benchmark.objects, strict=False)
    if other := [o.name for entry, o in pairs if entry.get("digest", "") != object_digest(o)]:
        differing = [
            f"objects ({', '.join(other[:10])})" if k == "objects" else k for k in differing
        ]
    if differing:
        flags = " ".join(said.flags())
        files = f"; its sweep was given {flags}" if flags else ""
        version = f"{header['versions'].get('r2h_batch')} at commit {header.get('git_commit')}"
        how = f"take the same files, and r2h_batch {version}"
        raise FileError(f"{where}: was made with other {', '.join(differing)}{files}; {how}")
    return benchmark


def _said(header: Mapping[str, Any], where: str) -> BenchmarkChoice:
    """The flags of the run's sweep as run.json has them, without those that it says elsewhere.

    Raises:
        FileError: the run is too old to have them, and its objects are somebody's own.
    """
    own = [o["name"] for o in header.get("objects", ()) if not o["built_in"]]
    if own and "benchmark" not in header:
        raise FileError(
            f"{where}: does not say where the meshes of {printable(', '.join(own))[:200]} were, it is older than r2h_batch 0.3;"
            " sweep again"
        )
    pairs = [f[2:].partition(" ") for f in (header.get("benchmark") or {}).get("flags", ())]
    known = {f.name: f for f in fields(BenchmarkChoice) if f.name not in IN_HEADER}
    lists = {name for name, field in known.items() if field.default == ()}
    said: dict[str, Any] = {k.replace("-", "_"): v for k, _, v in pairs}
    values: dict[str, Any] = {}
    for name, text in said.items():
        words = words_of(text)
        if name in lists:
            values[name] = tuple(words)
        elif name in known:  # older versions wrote one with spaces without quotes
            values[name] = words[0] if len(words) == 1 else text
    if values.get("benchmark") in BEFORE:
        values["benchmark"] = BEFORE[values["benchmark"]]
    return BenchmarkChoice(**values)
