"""What a run folder says about itself: run.json, its methods, and one receipt with sha256 per stored shard.

runs/NAME/run.json                              what is run: protocol, digests, configuration, versions, shard size
runs/NAME/methods/METHOD.json                   a method or predictions file, and where its answers come from
runs/NAME/manifest/METHOD/000017.json           receipt of a shard: its range, outcomes, and each file with its sha256
runs/NAME/trials/METHOD/000017-SHA.parquet      its rows; details/, poses/ and paths/ beside it where they were asked for
runs/NAME/failures/METHOD/000017-SHA.parquet    the trials of it whose simulation failed, if there are any
runs/NAME/quarantine/METHOD/000017.json         a shard that failed three times, and how

A shard is stored when its receipt is there. Nothing else is ever changed, so any number of processes may share a folder.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2h_batch.rows import DETAIL_SCHEMA, FAILURE_SCHEMA, PATH_SCHEMA, POSE_SCHEMA, TRIAL_SCHEMA
from r2h_batch.storage import sha256_of

FORMAT = 3
"""Version of the run folder: of the JSON files' fields and of the schemas."""

SCHEMAS = {
    "trials": TRIAL_SCHEMA,
    "details": DETAIL_SCHEMA,
    "poses": POSE_SCHEMA,
    "paths": PATH_SCHEMA,
    "failures": FAILURE_SCHEMA,
}

SHARD_TRIALS = 100_000
"""Largest shard unless the user says otherwise."""

IDENTITY = ("format", "protocol", "trials", "configuration", "digests", "seed", "device", "versions", "stored")
"""Fields of run.json that must agree for two sweeps to share a folder; of `device` only its kind (cpu, cuda)."""


class RunError(ValueError):
    """A run folder that cannot be written or read: the message names the file and what to do."""


def run_hash(header: Mapping[str, Any]) -> str:
    """sha256 (hex) over what decides the rows: the identity of a run and its shard size."""
    data: dict[str, Any] = {k: header.get(k) for k in IDENTITY}
    if "predictors" in header:  # folders from before there were any keep their hash
        data["predictors"] = header["predictors"]
    data["device"] = (header.get("device") or {}).get("kind")
    data["shard_trials"] = header["shard_trials"]
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the identity's fields in which two headers differ."""

    def value(header: Mapping[str, Any], key: str) -> Any:
        return (header.get(key) or {}).get("kind") if key == "device" else header.get(key)

    return [k for k in (*IDENTITY, "predictors") if value(old, k) != value(new, k)]


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; `RunError` names the file when it is none."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise RunError(f"{path}: cannot be read ({error or type(error).__name__})") from error
    if not isinstance(data, dict):
        raise RunError(f"{path}: must hold a JSON object, not a {type(data).__name__}")
    return data


def read_header(folder: Path) -> dict[str, Any]:
    """run.json of a folder, checked to be of this format and unchanged."""
    path = folder / "run.json"
    if not path.exists():
        raise RunError(f"{folder}: no run.json, so it is not a run folder")
    header = read_json(path)
    if header.get("format") != FORMAT:
        raise RunError(f"{path}: format {header.get('format')!r}; this version reads format {FORMAT}")
    try:
        good = header["hash"] == run_hash(header) and sum(header["trials"].values()) >= 0
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RunError(f"{path}: a field is missing, of another type or no number ({error})") from error
    if not good:
        raise RunError(f"{path}: its fields do not agree with its own hash; restore it, or sweep into another --out")
    return header


@dataclass(frozen=True)
class Shard:
    """A fixed range of the plan: positions `first` to `last` - 1, number `index`."""

    index: int
    first: int
    last: int

    @property
    def name(self) -> str:
        """Its number as it stands in file names."""
        return f"{self.index:06d}"


def shards_of(header: Mapping[str, Any]) -> list[Shard]:
    """All shards of a plan, in order: the same for every process that reads the same run.json."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    return [Shard(i, first, min(first + size, planned)) for i, first in enumerate(range(0, planned, size))]


def planned_in(header: Mapping[str, Any], shard: Shard) -> dict[str, int]:
    """Trials of each split in a shard; the plan goes through the splits one after the other."""
    counts, start = {}, 0
    for split, n in header["trials"].items():
        overlap = min(shard.last, start + n) - max(shard.first, start)
        if overlap > 0:
            counts[split] = overlap
        start += n
    return counts


def read_methods(folder: Path) -> list[dict[str, Any]]:
    """Entries of the methods in the order in which they were added; `slug` is their part of the file names."""
    entries = [{**read_json(p), "slug": p.stem} for p in (folder / "methods").glob("[!.]*.json")]
    return sorted(entries, key=lambda e: (e["order"], e["name"]))


def receipt_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "manifest" / slug / f"{shard.name}.json"


def quarantine_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "quarantine" / slug / f"{shard.name}.json"


def read_receipt(folder: Path, header: Mapping[str, Any], entry: Mapping[str, Any], shard: Shard) -> dict[str, Any]:
    """A shard's receipt, checked against run and method; `RunError` where it belongs to neither."""
    path = receipt_path(folder, entry["slug"], shard)
    receipt = read_json(path)
    expected = {"run": header["hash"], "method": entry["name"], "first": shard.first, "last": shard.last}
    for key, value in expected.items():
        if receipt.get(key) != value:
            raise RunError(f"{path}: foreign, its {key} is {receipt.get(key)!r} and not {value!r}")
    counts = {s: sum(c.values()) for s, c in receipt["outcomes"].items()}
    if counts != planned_in(header, shard):
        raise RunError(f"{path}: holds {counts} trials, planned were {planned_in(header, shard)}")
    return receipt


def problems(folder: Path, header: Mapping[str, Any]) -> Iterator[tuple[str, Shard | None, Path, str]]:
    """(method, shard, file, what is wrong) of everything stored that cannot be trusted; shard None: in no receipt."""
    for entry in read_methods(folder):
        known = set()
        for shard in shards_of(header):
            path = receipt_path(folder, entry["slug"], shard)
            if not path.exists():
                continue
            try:
                files = read_receipt(folder, header, entry, shard)["files"]
            except (RunError, KeyError, AttributeError, TypeError) as error:
                yield entry["name"], shard, path, str(error).removeprefix(f"{path}: ")
                continue
            for stored in files.values():
                file = folder / stored["path"]
                known.add(file)
                if what := _damage(file, stored):
                    yield entry["name"], shard, file, what
        for kind in SCHEMAS:
            for file in sorted((folder / kind / entry["slug"]).glob("[!.]*.parquet")):
                if file not in known:
                    yield entry["name"], None, file, "foreign: no receipt names it"


def _damage(file: Path, stored: Mapping[str, Any]) -> str | None:
    if not file.is_file():
        return "missing"
    if (size := file.stat().st_size) != stored["bytes"]:
        return f"{'truncated' if size < stored['bytes'] else 'too long'}: {size} bytes, written were {stored['bytes']}"
    return None if sha256_of(file) == stored["sha256"] else "flipped bits: differs from its sha256"
