"""Run folders of strangers."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from _attack import TAG, Attack, Command, Ended, Place, small
from _strange_names import in_json

REPORT = ["report", "run", "--format", "csv", "--out", "told.csv"]
VERIFY = ["results", "verify", "run"]
AGAIN = ["results", "reevaluate", "run", "--rows", "2"]
HEADER: dict[str, tuple[str, Any]] = {
    "-5 trials": ("trials", {"S0": -5, "S1": 3}),
    "10^12 trials": ("trials", {"S0": 10**12, "S1": 10**12}),
    "10^400 trials": ("trials", {"S0": 10**400, "S1": 3}),
    "trials as truth values": ("trials", {"S0": True, "S1": True}),
    "trials of a third split": ("trials", {"S0": 3, "S1": 3, "S2": 3}),
    "trials of one split alone": ("trials", {"S0": 3}),
    "trials as a word": ("trials", "three"),
    "0 trials of a shard": ("shard_trials", 0),
    "-1 trials of a shard": ("shard_trials", -1),
    "half a trial of a shard": ("shard_trials", 0.5),
    "10^30 trials of a shard": ("shard_trials", 10**30),
    "a seed of 10^400": ("seed", 10**400),
    "a format of the future": ("format", 5),
    "a format as a word": ("format", "4"),
    "a format of true": ("format", True),
    "a protocol that is a path": ("protocol", "../../outside/secret.txt"),
    "a protocol that is code": ("protocol", "os:system"),
    "objects of no name": ("objects", [{"split": "S0"}]),
    "a million objects": ("objects", [{"name": "x", "split": "S0", "built_in": True, "digest": "0"}] * 1_000_000),
    "hands of 10^18": ("hands", [["right", 10**18]]),
    "a hash of another run": ("hash", "0" * 64),
    "a hash of one letter": ("hash", "a"),
    "a hash that is a path": ("hash", "../../outside/secret.txt"),
    "digests as numbers": (
        "digests",
        dict.fromkeys(("trials", "benchmark", "objects", "hand_set", "people", "code"), 1),
    ),
    "a configuration of nothing": ("configuration", {}),
    "a configuration of NaN": ("configuration", {"thresholds": {"w_max_m": float("nan")}}),
    "stored as a word": ("stored", "poses"),
    "stored columns of no such name": ("stored", ["__class__", "../x"]),
    "a robot that is a path": ("robot", {"name": "../../outside/folder", "digest": "0" * 64}),
    "a motion of another engine": ("motion", {"engine": "os.system", "model": "x", "step_s": -1, "sample_s": 0}),
    "a field that nobody knows": ("__class__", {"__init__": 1}),
    "created before time": ("created", "-9999-99-99T99:99:99Z"),
    "created in other digits": ("created", "\u0662\u0660\u0662\u0666-11-25T21:38:53Z"),
    "versions as a list": ("versions", ["0.3.0"]),
    "a version of the future": ("versions", {"r2h_batch": "999.0.0"}),
    "a version that is none": ("versions", {"r2h_batch": "'; drop"}),
    "a command of a million words": ("command", ["x"] * 1_000_000),
}


def header(key: str, value: Any, *commands: Command) -> Attack:
    """A run whose run.json has another value in one field."""
    return Attack(
        in_json("run.json", lambda d: d.update({key: value}), *(commands or (VERIFY, ["ls", "runs"], REPORT)))
    )


def named_in(key: str) -> Attack:
    """A run that names a file beside the folder in one field."""
    return Attack(
        in_json(
            "run.json",
            lambda d: (
                d.setdefault("benchmark", {}).update({key: "../outside/secret.txt"})
                if isinstance(d.get("benchmark"), dict)
                else d.update({key: "../outside/secret.txt"})
            ),
            AGAIN,
            REPORT,
        )
    )


def shard_of(run: Path) -> Path:
    """The only shard of a small run."""
    (found,) = (run / "shards" / "random").glob("*.parquet")
    return found


def rewrite(run: Path, change: Callable[[Any], Any], number: str = "000000", **options: Any) -> Path:
    """The run's shard with another table, under a name with its digest."""
    import pyarrow.parquet as pq

    old = shard_of(run)
    table = pq.ParquetFile(old).read()
    new = change(table)
    if new.schema.metadata is None or b"r2h_batch" not in new.schema.metadata:
        new = new.replace_schema_metadata(table.schema.metadata)
    old.unlink()
    part = old.with_name("part")
    pq.write_table(new, part, **{"write_page_checksum": True, **options})
    return part.rename(old.with_name(f"{number}-{hashlib.sha256(part.read_bytes()).hexdigest()[:16]}.parquet"))


def forged(change: Callable[[Any], Any], *commands: Command, must: str = "either", **options: Any) -> Attack:
    """A run with a forged shard, whose name has the right digest."""

    def does(place: Place) -> list[Command]:
        rewrite(small(place), change, **options)
        return [*(commands or (VERIFY, [*REPORT[:2], "--by-object"], REPORT))]

    return Attack(does, must, unclaimed)


def unclaimed(place: Place, ended: Ended) -> str:
    """No table of the forged rows says a success rate of 100."""
    told = place.work / "told.csv"
    return "a table of forged rows" if told.exists() and ",100.0" in told.read_text() else ""


def column(name: str, values: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Another column."""
    return lambda t: t.set_column(t.column_names.index(name), name, [values(t)])


def shards() -> dict[str, Attack]:
    """Forged shards."""
    import pyarrow as pa

    def renamed(t: Any) -> Any:
        return t.rename_columns([c.upper() for c in t.column_names])

    def receipt(change: Callable[[dict[str, Any]], object]) -> Callable[[Any], Any]:
        def apply(t: Any) -> Any:
            own = json.loads(t.schema.metadata[b"r2h_batch"])
            change(own)
            return t.replace_schema_metadata({**t.schema.metadata, b"r2h_batch": json.dumps(own).encode()})

        return apply

    won = column("outcome", lambda t: pa.array(["success"] * len(t)))
    return {
        "every outcome a success": forged(won),
        "an outcome that nobody knows": forged(column("outcome", lambda t: pa.array([TAG] * len(t)))),
        "outcomes in another case": forged(column("outcome", lambda t: pa.array(["Success"] * len(t)))),
        "outcomes of nothing": forged(column("outcome", lambda t: pa.array([None] * len(t), pa.string()))),
        "objects of another name": forged(column("object", lambda t: pa.array([TAG] * len(t)))),
        "objects that are formulas": forged(column("object", lambda t: pa.array(["=1+1"] * len(t)))),
        "a third split": forged(column("split", lambda t: pa.array(["S2"] * len(t)))),
        "a third side": forged(column("side", lambda t: pa.array(["\x1b[2Jmiddle"] * len(t)))),
        "ids of 32 bits": forged(column("trial_id", lambda t: t["trial_id"].cast(pa.int32()))),
        "ids as floats": forged(column("trial_id", lambda t: t["trial_id"].cast(pa.float64()))),
        "ids of 2^63 - 1": forged(column("trial_id", lambda t: pa.array([2**63 - 1] * len(t)))),
        "ids of nothing": forged(column("trial_id", lambda t: pa.array([None] * len(t), pa.int64()))),
        "margins of NaN": forged(column("margin_reach_m", lambda t: pa.array([float("nan")] * len(t), pa.float32()))),
        "margins of 1e38": forged(column("margin_reach_m", lambda t: pa.array([1e38] * len(t), pa.float32()))),
        "margins of 8 bytes": forged(column("margin_reach_m", lambda t: t["margin_reach_m"].cast(pa.float64()))),
        "times of -1 s": forged(column("t_exec_s", lambda t: pa.array([-1.0] * len(t), pa.float32()))),
        "times of infinity": forged(column("t_plan_s", lambda t: pa.array([float("inf")] * len(t), pa.float32()))),
        "kinds of margin that nobody knows": forged(column("margin_kind_reach", lambda t: pa.array([TAG] * len(t)))),
        "words as categories": forged(column("outcome", lambda t: t["outcome"].combine_chunks().dictionary_encode())),
        "large words": forged(column("outcome", lambda t: t["outcome"].cast(pa.large_string()))),
        "words as bytes": forged(column("outcome", lambda t: t["outcome"].cast(pa.binary()))),
        "columns in capitals": forged(renamed),
        "columns in another order": forged(lambda t: t.select(t.column_names[::-1])),
        "a column twice": forged(lambda t: t.append_column("outcome", [pa.array(["success"] * len(t))])),
        "10,000 more columns": forged(
            lambda t: pa.table(
                {**{c: t[c] for c in t.column_names}, **{f"x{k}": pa.nulls(len(t)) for k in range(10_000)}}
            )
        ),
        "a column 200 structs deep": forged(lambda t: t.append_column("x", [_deep(len(t))])),
        "an index of pandas that is a program": forged(
            lambda t: t.replace_schema_metadata(
                {
                    **t.schema.metadata,
                    b"pandas": b'{"index_columns":["__import__(\'os\')"],"columns":[],"column_indexes":[]}',
                }
            )
        ),
        "a type that is a pickle": forged(
            lambda t: t.append_column(
                pa.field(
                    "x",
                    pa.int8(),
                    metadata={
                        b"ARROW:extension:name": b"arrow.py_extension_type",
                        b"ARROW:extension:metadata": b"cos\nsystem\n(S'false'\ntR.",
                    },
                ),
                pa.nulls(len(t), pa.int8()),
            )
        ),
        "rows in another order": forged(lambda t: t.take(pa.array(range(len(t))[::-1]))),
        "a row of another trial": forged(lambda t: pa.concat_tables([t.slice(1), t.slice(1, 1)])),
        "one row in 1,000 groups": forged(lambda t: t, row_group_size=1),
        "packed by brotli": forged(lambda t: t, compression="brotli"),
        "packed by LZ4": forged(lambda t: t, compression="lz4"),
        "64 MiB of nothing in its metadata": forged(
            lambda t: t.replace_schema_metadata({**t.schema.metadata, b"x": bytes(64 << 20)})
        ),
        "a receipt of another method": forged(receipt(lambda r: r.update(method="oracle"))),
        "a receipt of another range": forged(receipt(lambda r: r.update({k: [5, 9] for k in r if "range" in k}))),
        "a receipt of nothing": forged(receipt(lambda r: r.clear())),
        "a receipt of lists": forged(receipt(lambda r: r.update({k: [[]] for k in r}))),
        "a receipt of other outcomes": forged(receipt(lambda r: r.update(outcomes={"success": 6}))),
        "a receipt 100,000 deep": forged(
            lambda t: t.replace_schema_metadata({**t.schema.metadata, b"r2h_batch": b"[" * 100_000})
        ),
    }


def _deep(rows: int) -> Any:
    import pyarrow as pa

    deep = pa.nulls(rows, pa.int8())
    for _ in range(200):
        deep = pa.StructArray.from_arrays([deep], ["a"])
    return deep


def laid(change: Callable[[Place, Path], object], *commands: Command, must: str = "either") -> Attack:
    """A run folder in which something else lies."""

    def does(place: Place) -> list[Command]:
        change(place, small(place))
        return [*(commands or (VERIFY, REPORT))]

    return Attack(does, must, unclaimed)


def number(new: str) -> Attack:
    """A copy of the shard under another number."""

    def change(place: Place, run: Path) -> None:
        old = shard_of(run)
        shutil.copy(old, old.with_name(f"{new}{old.name[6:]}"))

    return laid(change)


SHARD_FILES: dict[str, Attack] = {
    "a number out of range": number("000007"),
    "a negative number": number("-00001"),
    "a number of 30 digits": number("9" * 30),
    "a number in other digits": number("\u0660\u0660\u0660\u0660\u0660\u0661"),
    "a number of five digits": number("00000"),
    "a digest in capitals": laid(
        lambda p, r: (s := shard_of(r)).rename(s.with_name(s.name[:7] + s.name[7:23].upper() + ".parquet"))
    ),
    "no digest": laid(lambda p, r: (s := shard_of(r)).rename(s.with_name("000000.parquet"))),
    "a shorter digest": laid(lambda p, r: (s := shard_of(r)).rename(s.with_name(s.name[:9] + ".parquet"))),
    "two shards of one number": laid(lambda p, r: _second(r)),
    "Arrow's own format": laid(lambda p, r: _ipc(r)),
    "a folder of shards in a shard": laid(lambda p, r: _folder(r)),
    "an empty shard with the digest of nothing": laid(lambda p, r: _empty(r)),
    "1 TiB without bytes": laid(lambda p, r: os.truncate(shard_of(r), 1 << 40)),
    "100,000 files beside it": laid(lambda p, r: _crowded(r)),
    "1,000 methods": laid(
        lambda p, r: [shutil.copy(r / "methods/random.json", r / f"methods/m{k}.json") for k in range(1000)]
    ),
    "shards of a method without a file": laid(lambda p, r: shutil.copytree(r / "shards/random", r / "shards/oracle")),
    "a method's file without shards": laid(
        lambda p, r: shutil.copy(r / "methods/random.json", r / "methods/oracle.json")
    ),
}


def _crowded(run: Path) -> None:
    for k in range(1, 100_000):
        (run / "shards/random" / f"{k:06}-{k:016x}.parquet").touch()


def _folder(run: Path) -> None:
    shard = shard_of(run)
    shard.unlink()
    shard.mkdir()


def _empty(run: Path) -> None:
    shard_of(run).unlink()
    (run / "shards/random/000000-e3b0c44298fc1c14.parquet").touch()


def _second(run: Path) -> None:
    keep = shard_of(run)
    data = keep.read_bytes()
    new = rewrite(run, lambda t: t)
    if new != keep:
        keep.write_bytes(data)


def _ipc(run: Path) -> None:
    import pyarrow.feather as feather
    import pyarrow.parquet as pq

    old = shard_of(run)
    table = pq.read_table(old)
    old.unlink()
    part = old.with_name("part")
    feather.write_feather(table, part)
    part.rename(old.with_name(f"000000-{hashlib.sha256(part.read_bytes()).hexdigest()[:16]}.parquet"))


# ---- files beside the shards, with the right digests


def side(kind: str, columns: Callable[[int], dict[str, Any]]) -> Attack:
    """A file whose rows, trials and successes are right and whose other columns are a stranger's."""

    def does(place: Place) -> list[Command]:
        import pyarrow as pa
        import pyarrow.parquet as pq

        from r2h_batch.runs import load_run

        run = small(place)
        stored = load_run(run)
        rows = stored.trials("random", ["trial_id", "outcome"]).to_pylist()
        n = len(rows)
        base = {
            "trial_id": pa.array([r["trial_id"] for r in rows], pa.int64()),
            "success": [r["outcome"] == "success" for r in rows],
            "evaluated": [True] * n,
            "received": [True] * n,
        }
        table = pa.table({**base, **columns(n)})
        (run / kind).mkdir(exist_ok=True)
        about = {key: json.dumps({"rows": stored.digest("random")}).encode() for key in (b"r2h_batch", b"made_of")}
        pq.write_table(table.replace_schema_metadata(about), run / kind / "random.parquet")
        return [VERIFY, REPORT, ["report", "run", "--format", "html", "--out", "told.html"]]

    return Attack(does)


SIDES: dict[str, Attack] = {
    "a word that is a tag": side("reception", lambda n: {"word": [TAG] * n}),
    "efforts of NaN": side("reception", lambda n: {"effort": [float("nan")] * n}),
    "1,000 more columns": side("reception", lambda n: {f"x{k}": [0] * n for k in range(1000)}),
    "reception: 10^9 grasps": side("reception", lambda n: {"grasps": [10**9] * n, "reception": [1.0] * n}),
}

KINDS = {
    "numbers of a run.json": {k: header(*v) for k, v in HEADER.items()},
    "files named by a run": {
        f"a secret as {k}": named_in(k)
        for k in ("hands", "hand_model", "objects", "trials_file", "benchmark", "people", "grasps", "robot")
    },
    "forged shards": shards(),
    "files of shards": SHARD_FILES,
    "forged files beside the shards": SIDES,
}
