"""What a run folder says about itself: run.json, its methods, and one receipt with sha256 per
stored shard.

runs/NAME/run.json                              what is run: protocol, digests, configuration,
versions, shard size runs/NAME/methods/METHOD.json                   a method or predictions file,
and where its answers come from runs/NAME/manifest/METHOD/000017.json           receipt of a shard:
its range, outcomes, and each file with its sha256 runs/NAME/trials/METHOD/000017-SHA.parquet
its rows; details/, poses/ and paths/ beside it where they were asked for
runs/NAME/failures/METHOD/000017-SHA.parquet    the trials of it whose simulation failed, if there
are any runs/NAME/quarantine/METHOD/000017.json         a shard that failed three times, and how

A shard is stored when its receipt is there. Nothing else is ever changed, so any number of
processes may share a folder.
"""

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2h_batch.files import printable
from r2h_batch.results.planned import stored_wrong
from r2h_batch.results.records import (
    SLUG,
    Header,
    Method,
    Receipt,
    RunError,
    bounded,
    checked,
    read_json,
)
from r2h_batch.results.rows import (
    DETAIL_SCHEMA,
    FAILURE_SCHEMA,
    PATH_SCHEMA,
    POSE_SCHEMA,
    TRIAL_SCHEMA,
)
from r2h_batch.results.storage import in_the_way, sha256_of

__all__ = [
    "FORMAT",
    "IDENTITY",
    "SCHEMAS",
    "SHARD_TRIALS",
    "RunError",
    "Shard",
    "checked_header",
    "differing",
    "planned_in",
    "problems",
    "quarantine_path",
    "read_header",
    "read_json",
    "read_methods",
    "read_receipt",
    "receipt_path",
    "run_hash",
    "shards_of",
    "stored_in",
]

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

IDENTITY = (
    "format",
    "protocol",
    "trials",
    "configuration",
    "digests",
    "seed",
    "device",
    "versions",
    "stored",
)
"""Fields of run.json that must agree for two sweeps to share a folder; of `device` only its kind
(cpu, cuda)."""


def run_hash(header: Mapping[str, Any]) -> str:
    """sha256 (hex) over what decides the rows: the identity of a run and its shard size."""
    data: dict[str, Any] = {k: header.get(k) for k in IDENTITY}
    for key in ("predictors", "hands"):  # folders from before there were any keep their hash
        if key in header:
            data[key] = header[key]
    data["device"] = (header.get("device") or {}).get("kind")
    data["shard_trials"] = header["shard_trials"]
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the identity's fields in which two headers differ, and of what differs in them."""

    def value(header: Mapping[str, Any], key: str) -> Any:
        return (header.get(key) or {}).get("kind") if key == "device" else header.get(key)

    names = []
    for key in (*IDENTITY, "predictors"):
        mine, other = value(old, key), value(new, key)
        if mine != other:
            parts = isinstance(mine, Mapping) and isinstance(other, Mapping)
            inner = (
                sorted(k for k in {**mine, **other} if mine.get(k) != other.get(k)) if parts else []
            )
            names.append(f"{key} ({', '.join(inner)})" if inner else key)
    return names


def read_header(folder: Path) -> dict[str, Any]:
    """run.json of a folder, checked to be of this format and unchanged, in a folder that holds its
    own files."""
    path = folder / "run.json"
    if not os.path.lexists(path):
        raise RunError(f"{printable(folder)}: no run.json, so it is not a run folder")
    data = read_json(path)
    if data.get("format") != FORMAT:
        raise RunError(
            f"{path}: format {printable(data.get('format'))!r:.40}; this version reads format {FORMAT}"
        )
    header = checked_header(data, path)
    if header["hash"] != run_hash(header):
        raise RunError(
            f"{path}: its fields do not agree with its own hash; restore it, or sweep into another --out"
        )
    _refuse_links(folder)
    return header


def checked_header(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The fields of a run.json, to be read or written, within their bounds; else `RunError`."""
    header = checked(Header, dict(data), path)
    bounded(header, path)
    return header


def _refuse_links(folder: Path) -> None:
    """A link inside a run folder would have files elsewhere read, renamed and written."""
    for kind in (*SCHEMAS, "manifest", "methods", "quarantine", ".claims"):
        inside = [folder / kind]
        if kind != ".claims" and inside[0].is_dir() and not inside[0].is_symlink():
            inside += [Path(entry.path) for entry in os.scandir(inside[0]) if entry.is_symlink()]
        for path in inside:
            if path.is_symlink():
                raise RunError(
                    f"{printable(path)}: a symbolic link; a run folder holds its own files"
                )


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
    return [
        Shard(i, first, min(first + size, planned))
        for i, first in enumerate(range(0, planned, size))
    ]


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
    """Entries of the methods in the order in which they were added; `slug` is their part of the
    file names."""
    entries = []
    for path in sorted((folder / "methods").glob("[!.]*.json")):
        if not SLUG.fullmatch(path.stem):
            raise RunError(
                f"{printable(path)}: foreign, no method's file has such a name; take it away"
            )
        entries.append({**checked(Method, read_json(path), path), "slug": path.stem})
    names = [e["name"] for e in entries]
    if len(set(names)) != len(names):
        raise RunError(
            f"{folder / 'methods'}: two files name the method {max(names, key=names.count)!r}; take one away"
        )
    return sorted(entries, key=lambda e: (e["order"], e["name"]))


def stored_in(folder: Path, header: Mapping[str, Any], slug: str) -> list[Shard]:
    """Shards of a method that have a receipt, in order: what is read grows with what is stored, not
    with the plan."""
    try:
        found = {
            name[:6] for name in os.listdir(folder / "manifest" / slug) if _RECEIPT.fullmatch(name)
        }
    except FileNotFoundError:
        return []
    except OSError as error:
        for place in (folder / "manifest", folder / "manifest" / slug):
            if what := in_the_way(place, folder=True):
                raise RunError(what) from None
        raise RunError(
            f"{folder / 'manifest' / slug}: cannot be read ({error.strerror or error})"
        ) from None
    shards = (shard_at(header, int(number)) for number in sorted(found))
    return [s for s in shards if s is not None]


_RECEIPT = re.compile(r"[0-9]{6}\.json", re.ASCII)


def shard_at(header: Mapping[str, Any], index: int) -> Shard | None:
    """The shard of a number; None beyond the plan."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    return (
        Shard(index, index * size, min((index + 1) * size, planned))
        if index * size < planned
        else None
    )


def receipt_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "manifest" / slug / f"{shard.name}.json"


def quarantine_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "quarantine" / slug / f"{shard.name}.json"


def read_receipt(
    folder: Path, header: Mapping[str, Any], entry: Mapping[str, Any], shard: Shard
) -> dict[str, Any]:
    """A shard's receipt, checked against run and method; `RunError` where it belongs to neither."""
    path = receipt_path(folder, entry["slug"], shard)
    receipt = checked(Receipt, read_json(path), path)
    expected = {
        "run": header["hash"],
        "method": entry["name"],
        "first": shard.first,
        "last": shard.last,
    }
    for key, value in expected.items():
        if receipt[key] != value:
            raise RunError(f"{path}: foreign, its {key} is {receipt[key]!r} and not {value!r}")
    counts = {s: sum(c.values()) for s, c in receipt["outcomes"].items()}
    if counts != planned_in(header, shard):
        raise RunError(f"{path}: holds {counts} trials, planned were {planned_in(header, shard)}")
    kinds = {"trials", *header["stored"]}
    if set(receipt["files"]) - {"failures"} != kinds:
        raise RunError(
            f"{path}: names files of {sorted(receipt['files'])}, stored are {sorted(kinds)}"
        )
    for kind, file in receipt["files"].items():
        own = f"{kind}/{entry['slug']}/{shard.name}-{file['sha256'][:16]}.parquet"
        if file["path"] != own:
            raise RunError(
                f"{path}: names the file {file['path'][:200]!r}; the only one it may name is {own}"
            )
    return receipt


def problems(
    folder: Path, header: Mapping[str, Any]
) -> Iterator[tuple[str, Shard | None, Path, str]]:
    """(method, shard, file, what is wrong) of everything stored that cannot be trusted; shard None:
    in no receipt."""
    for entry in read_methods(folder):
        known: set[Path] = set()
        for shard in stored_in(folder, header, entry["slug"]):
            for file, what in checked_shard(folder, header, entry, shard):
                known.add(file)
                if what is not None:
                    yield entry["name"], shard, file, what
        for kind in SCHEMAS:
            for file in sorted((folder / kind / entry["slug"]).glob("[!.]*.parquet")):
                if file not in known:
                    yield entry["name"], None, file, "foreign: no receipt names it"


def checked_shard(
    folder: Path, header: Mapping[str, Any], entry: Mapping[str, Any], shard: Shard
) -> Iterator[tuple[Path, str | None]]:
    """Each file that the receipt of a stored shard names, or the receipt itself, and what is wrong
    with it (None: nothing)."""
    path = receipt_path(folder, entry["slug"], shard)
    try:
        files = read_receipt(folder, header, entry, shard)["files"]
    except RunError as error:
        yield path, str(error).removeprefix(f"{path}: ")
        return
    for stored in files.values():
        file = folder / stored["path"]
        kind = file.parent.parent.name
        yield (
            file,
            _damage(file, stored) or stored_wrong(header, shard.first, shard.last, kind, file),
        )


def _damage(file: Path, stored: Mapping[str, Any]) -> str | None:
    try:
        found = file.lstat()
    except OSError:
        return "missing"
    if not stat.S_ISREG(found.st_mode):
        return "no regular file"
    if (size := found.st_size) != stored["bytes"]:
        return f"{'truncated' if size < stored['bytes'] else 'too long'}: {size} bytes, written were {stored['bytes']}"
    return None if sha256_of(file) == stored["sha256"] else "flipped bits: differs from its sha256"
