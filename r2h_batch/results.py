"""The run folder: `run.json` beside one Parquet file per method, written whole or not at all, read back checked.

runs/NAME/run.json                what was run: protocol, digests, configuration, versions, device, command, methods
runs/NAME/trials/METHOD.parquet   one row per planned trial, `rows.TRIAL_SCHEMA`
runs/NAME/poses/METHOD.parquet    the two poses that were scored, `rows.POSE_SCHEMA`
runs/NAME/paths/METHOD.parquet    with --save-paths: waypoints and times, `rows.PATH_SCHEMA`
"""

import fcntl
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import pyarrow as pa
import pyarrow.parquet as pq

from r2h_batch.rows import PATH_SCHEMA, POSE_SCHEMA, TRIAL_SCHEMA

FORMAT = 1
"""Version of the run folder: of run.json's fields and of the three schemas."""

SCHEMAS = {"trials": TRIAL_SCHEMA, "poses": POSE_SCHEMA, "paths": PATH_SCHEMA}

IDENTITY = ("format", "protocol", "trials", "configuration", "digests", "seed", "device", "versions", "save_paths")
"""Fields of run.json that must agree for two sweeps to share a folder."""


class RunError(ValueError):
    """A run folder that cannot be written or read: the message names the file and what to do."""


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid4().hex}.tmp")


def _write_json(path: Path, data: Mapping[str, Any]) -> None:
    temporary = _temporary(path)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(data, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync(path.parent)


def _read_header(folder: Path) -> dict[str, Any]:
    path = folder / "run.json"
    try:
        header = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"{folder}: no run.json, so it is not a run folder") from None
    except (ValueError, OSError) as error:
        raise RunError(f"{path}: cannot be read ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        found = header.get("format") if isinstance(header, dict) else header
        raise RunError(f"{path}: format {found!r}; this version reads format {FORMAT}")
    return header


@dataclass(frozen=True)
class Run:
    """A stored run: `header` is run.json, the methods' tables are read on demand."""

    folder: Path
    header: dict[str, Any]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods whose rows are complete, in the order in which they were run."""
        return tuple(m["name"] for m in self.header["methods"])

    def trials(self, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        """One row per planned trial, `rows.TRIAL_SCHEMA` or some of its columns."""
        return self._read("trials", method, columns)

    def poses(self, method: str) -> pa.Table:
        """The scored poses, `rows.POSE_SCHEMA`: no rows for missing trials."""
        return self._read("poses", method, None)

    def paths(self, method: str) -> pa.Table:
        """Waypoints and times of the trials that have a path, `rows.PATH_SCHEMA`."""
        return self._read("paths", method, None)

    def entry(self, method: str) -> dict[str, Any]:
        """What run.json says about a method."""
        for entry in self.header["methods"]:
            if entry["name"] == method:
                return entry
        raise RunError(f"{self.folder}: no method {method!r}; it has {', '.join(self.methods) or 'none'}")

    def verify(self) -> None:
        """Raise unless every file of every method is there with the sha256 that run.json gives."""
        for entry in self.header["methods"]:
            for stored in entry["files"].values():
                path = self.folder / stored["path"]
                if not path.is_file():
                    raise RunError(f"{path}: missing; run the sweep again with another --out")
                if _sha256(path) != stored["sha256"]:
                    raise RunError(
                        f"{path}: differs from the sha256 in run.json; run the sweep again with another --out"
                    )

    def _read(self, kind: str, method: str, columns: Sequence[str] | None) -> pa.Table:
        stored = self.entry(method)["files"].get(kind)
        if stored is None:
            raise RunError(f"{self.folder}: method {method!r} has no {kind}; sweep again with --save-paths")
        path = self.folder / stored["path"]
        try:
            table = pq.read_table(path, columns=None if columns is None else list(columns), partitioning=None)
        except (OSError, pa.ArrowException) as error:
            raise RunError(f"{path}: cannot be read ({error})") from error
        schema = SCHEMAS[kind]
        for name in schema.names if columns is None else columns:
            if name not in table.column_names or table.schema.field(name).type != schema.field(name).type:
                raise RunError(f"{path}: column {name!r} is missing or of another type than format {FORMAT} says")
        return table


def load_run(folder: str | Path, *, verify: bool = True) -> Run:
    """The run stored in `folder`; with `verify`, every file is compared with its sha256 first."""
    folder = Path(folder)
    run = Run(folder, _read_header(folder))
    if verify:
        run.verify()
    return run


class MethodWriter:
    """Streams one method's rows into temporary files; `RunFolder.write` turns them into the method's files."""

    def __init__(self, writers: Mapping[str, pq.ParquetWriter]) -> None:
        self._writers = writers
        self.outcomes: dict[str, Counter[str]] = {}

    def append(self, **tables: pa.Table) -> None:
        """Add rows: `trials`, and `poses` and `paths` where there are any."""
        for kind, table in tables.items():
            for field in SCHEMAS[kind]:
                if not field.nullable and table[field.name].null_count:
                    raise ValueError(f"{kind}: column {field.name!r} has {table[field.name].null_count} empty rows")
            self._writers[kind].write_table(table)
        if "trials" in tables:
            keys = pa.table({k: tables["trials"][k].cast(pa.string()) for k in ("split", "outcome")})
            for row in keys.group_by(["split", "outcome"]).aggregate([([], "count_all")]).to_pylist():
                self.outcomes.setdefault(row["split"], Counter())[row["outcome"]] += row["count_all"]


class RunFolder:
    """A run folder being written, locked against other sweeps; made by `open_run`."""

    def __init__(self, folder: Path, header: dict[str, Any], command: Sequence[str]) -> None:
        self.folder, self.header, self.command = folder, header, list(command)

    def stored(self, method: str, source: Mapping[str, Any]) -> bool:
        """Whether the method's rows are complete; an error if they came from another source."""
        for entry in self.header["methods"]:
            if entry["name"] == method:
                if entry["source"] != dict(source):
                    raise RunError(f"{self.folder}: already holds {method!r} from another source; choose another --out")
                return True
        return False

    @contextmanager
    def write(self, method: str, source: Mapping[str, Any]) -> Iterator[MethodWriter]:
        """A writer for a method's rows; when the block ends well they appear at once, else nothing does."""
        name = self._file_name(method)
        kinds = [k for k in SCHEMAS if k != "paths" or self.header["save_paths"]]
        finals = {k: self.folder / k / f"{name}.parquet" for k in kinds}
        temporary = {k: _temporary(p) for k, p in finals.items()}
        metadata = {"r2h_batch.format": str(FORMAT), "r2h_batch.method": method}
        try:
            with ExitStack() as stack:
                writers = {}
                for kind, path in temporary.items():
                    path.parent.mkdir(exist_ok=True)
                    schema = SCHEMAS[kind].with_metadata(metadata)
                    writers[kind] = stack.enter_context(pq.ParquetWriter(path, schema, compression="zstd"))
                writer = MethodWriter(writers)
                yield writer
            planned = {s: n for s, n in self.header["trials"].items() if n}
            found = {s: counts.total() for s, counts in writer.outcomes.items()}
            if found != planned:
                raise RunError(f"{self.folder}: {method!r} has {found} rows, planned were {planned}")
            files = {k: {"path": f"{k}/{p.name}", "sha256": _commit(temporary[k], p)} for k, p in finals.items()}
        finally:
            for path in temporary.values():
                path.unlink(missing_ok=True)
        outcomes = {s: dict(sorted(c.items())) for s, c in sorted(writer.outcomes.items())}
        entry = {"name": method, "source": dict(source), "command": self.command, "rows": sum(found.values())}
        self.header["methods"].append({**entry, "outcomes": outcomes, "files": files})
        _write_json(self.folder / "run.json", self.header)

    def _file_name(self, method: str) -> str:
        """A portable file name for a method, unlike that of any other method in the folder."""
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", method).strip("._")[:60] or "method"
        taken = {Path(m["files"]["trials"]["path"]).stem.lower() for m in self.header["methods"]}
        if name.lower() in taken:
            name += "-" + hashlib.sha256(method.encode()).hexdigest()[:8]
        return name


def _commit(temporary: Path, final: Path) -> str:
    """Make a finished temporary file appear under its name, durably; returns its sha256."""
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    digest = _sha256(temporary)
    os.replace(temporary, final)
    _sync(final.parent)
    return digest


@contextmanager
def open_run(folder: str | Path, header: Mapping[str, Any]) -> Iterator[RunFolder]:
    """The folder, locked and ready to take methods: new or of the same configuration; anything else is refused."""
    folder = Path(folder)
    other = "choose another --out"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        foreign = not (folder / "run.json").exists() and [
            p.name for p in folder.iterdir() if not p.name.startswith(".")
        ]
        if foreign:
            raise RunError(f"{folder}: not empty and not a run folder (it has {min(foreign)!r}); {other}")
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise RunError(f"{folder}: cannot be written ({error.strerror or error}); {other}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise RunError(f"{folder}: another sweep is writing to it; {other}") from None
        for stale in folder.glob("**/.*.tmp"):
            stale.unlink()
        new = {"format": FORMAT, **json.loads(json.dumps(header, allow_nan=False)), "methods": []}
        if (folder / "run.json").exists():
            old = _read_header(folder)
            if differing := [k for k in IDENTITY if old.get(k) != new.get(k)]:
                raise RunError(f"{folder}: a run with another {', '.join(differing)}; {other}")
            Run(folder, old).verify()
            new = old
        else:
            _write_json(folder / "run.json", new)
        yield RunFolder(folder, new, header.get("command", ()))
