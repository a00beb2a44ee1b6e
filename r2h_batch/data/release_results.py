"""Verdicts of the authors' release (its results.json) as a run folder of ours."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import AfterValidator, Field

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_json
from r2h_batch.base.registry import FOREIGN
from r2h_batch.base.schedule import trial_ids
from r2h_batch.data.release_files import Entry, Name, Receiver, validated
from r2h_batch.runs import provenance
from r2h_batch.runs.rows import TRIAL_SCHEMA
from r2h_batch.runs.store import write_labels
from r2h_batch.runs.writing import open_run
from r2h_batch.verdicts import MOST_SECONDS, PAPER, REGISTRY, SPLITS


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must be printable characters in one line")
    return text


MAX_BYTES = 32 << 20
"""Largest results.json: 100,000 trials. Reading takes up to 28 bytes of memory for each."""

Text = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_printable)]
Seconds = Annotated[float, Field(ge=0, le=MOST_SECONDS)]


class Metrics(Entry):
    """The five flags; Affordance is null in S0."""

    stability: bool
    plan: bool
    reach: bool
    affordance: bool | None
    safe: bool


class ResultRow(Entry):
    """The fields of a row of results.json that decide what is counted."""

    trial_id: Text
    object_id: Annotated[Name, AfterValidator(_printable)]
    split: Literal["S0", "S1"]
    variant: Text
    metrics: Metrics
    success: bool
    first_failure: Literal["stability", "plan", "reach", "affordance", "safe"] | None
    width_m: Annotated[float, Field(ge=0, le=10)] | None = None
    planning_time_s: Seconds | None = None
    execution_time_s: Seconds | None = None
    receiver: Receiver | None = None


def write_results(path: Path, out: Path) -> dict[str, int]:
    """The verdicts of the release's results.json, or of the folder that has it, as a run folder: its
    variants are the methods, for `report` and `compare`. Nothing is judged here.

    Variants are paired by object: the k-th trial of an object is one trial of all variants.

    Returns:
        counts: trials of all variants, variants.

    Raises:
        FileError: one line that names the row and the field.
    """
    file = path / "results.json" if path.is_dir() else path
    data, where = read_json(file, most=MAX_BYTES), printable(file)
    if not isinstance(data, list) or not data:
        raise FileError(f"{where}: must hold a list of results")
    results = [validated(row, f"{where}[{k}]", ResultRow) for k, row in enumerate(data)]
    by_key: dict[tuple[str, str, int], dict[str, ResultRow]] = {}
    seen: Counter[tuple[str, str, str]] = Counter()
    for k, r in enumerate(results):
        flags = r.metrics.model_dump()
        failure = next((c for c in PAPER if flags[c] is False), None)
        if (r.first_failure, r.success) != (failure, failure is None):
            raise FileError(f"{where}[{k}]: first_failure or success is not what its metrics say")
        if (flags["affordance"] is None) != (r.split == "S0"):
            raise FileError(f"{where}[{k}]: metrics.affordance is a flag in S1 and null in S0")
        place = (r.variant, r.split, r.object_id)
        by_key.setdefault((r.split, r.object_id, seen[place]), {})[r.variant] = r
        seen[place] += 1
    # as `sweep --trials-from` numbers the trials of these names: compare pairs them
    keys = sorted(by_key, key=lambda key: (key[0], next(iter(by_key[key].values())).trial_id))
    trials = {s: n for s in SPLITS if (n := sum(key[0] == s for key in keys))}
    objects = sorted({key[:2] for key in keys})
    header = {
        "protocol": FOREIGN,
        "trials": trials,
        "configuration": {"name": "verdicts of the release"},
        "digests": {"trials": hashlib.sha256(json.dumps(keys).encode()).hexdigest()},
        "seed": 0,
        "device": {"kind": "release", "name": "r2handoversim"},
        "versions": provenance.versions(),
        "stored": [],
        "objects": [{"name": o, "split": s, "built_in": False} for s, o in objects],
    }
    folder = open_run(out, header)
    ids = trial_ids(trials, 0, len(keys))
    variants = list(dict.fromkeys(r.variant for r in results))
    for variant in variants:
        folder.register(variant, {"kind": "results", "file": where})
        found = [by_key[key].get(variant) for key in keys]
        for shard in folder.todo(variant):
            rows = slice(shard.first, shard.last)
            with folder.write(variant, shard) as writer:
                writer.append(trials=foreign_rows(ids[rows], keys[rows], found[rows]))
    names = {int(i): next(iter(by_key[key].values())).trial_id for i, key in zip(ids, keys)}
    write_labels(folder.folder, {i: (name, "") for i, name in names.items()})
    return {"trials": len(results), "variants": len(variants)}


def foreign_rows(
    ids: Any, keys: Sequence[tuple[str, str, int]], results: Sequence[ResultRow | None]
) -> pa.Table:
    """Rows of `TRIAL_SCHEMA` from verdicts of another program: no margins, `missing` where there is
    no verdict, and no columns of criteria that are not the paper's."""
    rows = []
    for i, (split, object_id, _), r in zip(ids.tolist(), keys, results):
        row = {
            "trial_id": i,
            "object": object_id,
            "split": split,
            "side": "right",
            "outcome": "missing",
        }
        if r is not None:
            row |= {"side": r.receiver.side if r.receiver else "right"}
            row |= {"outcome": r.first_failure or "success", "width_m": r.width_m}
            row |= {f"passed_{c}": flag for c, flag in r.metrics.model_dump().items()}
            row |= {"t_plan_s": r.planning_time_s, "t_exec_s": r.execution_time_s}
        rows.append(row)
    further = [entry for entry in REGISTRY if entry.name not in PAPER]
    unknown = {name for e in further for name in (e.passed_column, e.margin_column, e.kind_column)}
    schema = pa.schema([field for field in TRIAL_SCHEMA if field.name not in unknown])
    columns = []
    for field in schema:
        values = pa.array([row.get(field.name) for row in rows])
        is_text = pa.types.is_dictionary(field.type)
        text = values.cast(pa.string()).dictionary_encode() if is_text else None
        columns.append(values.cast(field.type) if text is None else text)
    return pa.table(columns, schema=schema)
