"""Damage to files, by format, and what a kind of file is: what tests/test_damaged_files.py damages."""

import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SEED = 52
SPARSE_BYTES = 3 << 30

Damage = Callable[[Path], object]
"""Damages the sound file at this path."""


class Kind(NamedTuple):
    """A kind of file.

    `make` writes a sound one at the path, `read` reads it, and `own` are the attacks that need to know the format.
    """

    ending: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    own: Mapping[str, Damage]


# ---- damage to any file


def rewritten(change: Callable[[bytes], bytes]) -> Damage:
    """Other bytes in the place of the file's."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


def flipped(count: int) -> Damage:
    """So many flipped bits, the same ones each time."""

    def change(data: bytes) -> bytes:
        draw, found = np.random.default_rng([SEED, count, len(data)]), bytearray(data)
        for bit in draw.integers(0, 8 * len(data), count):
            found[bit // 8] ^= 1 << int(bit % 8)
        return bytes(found)

    return rewritten(change)


def replaced_by(make: Callable[[Path], object]) -> Damage:
    """Something else under the file's name."""

    def damage(path: Path) -> None:
        path.unlink()
        make(path)

    return damage


def sparse(path: Path) -> None:
    """A file of 3 GiB that takes no disk."""
    with path.open("wb") as file:
        file.truncate(SPARSE_BYTES)


ANY: dict[str, Damage] = {
    "nothing": rewritten(lambda _: b""),
    "its first half": rewritten(lambda d: d[: len(d) // 2]),
    "1 bit flipped": flipped(1),
    "64 bits flipped": flipped(64),
    "random bytes": rewritten(lambda d: np.random.default_rng(SEED).bytes(1 << 16)),
    "3 GiB of zeros": replaced_by(sparse),
    "a link to /dev/zero": replaced_by(lambda p: p.symlink_to("/dev/zero")),
    "a pipe": replaced_by(os.mkfifo),
    "a link to itself": replaced_by(lambda p: p.symlink_to(p.name)),
}

# ---- damage to a format


def arrays_changed(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Damage:
    """Other arrays in an .npz."""

    def damage(path: Path) -> None:
        with np.load(path, allow_pickle=True) as data:
            arrays = change(dict(data))
        with path.open("wb") as file:
            np.savez(file, **arrays)

    return damage


def each_float(value: float) -> Damage:
    """The number everywhere in the arrays of floats."""

    def filled(x: Any) -> Any:
        return np.full_like(x, value) if np.issubdtype(x.dtype, np.floating) else x

    return arrays_changed(lambda a: {k: filled(np.asarray(x)) for k, x in a.items()})


def member(path: Path, name: str, data: bytes, *, count: int = 1, method: int = zipfile.ZIP_STORED) -> None:
    """Adds a member to an archive, so many times."""
    with zipfile.ZipFile(path, "a", method) as archive:
        for _ in range(count):
            archive.writestr(name, data)


def claims(shape: str, dtype: str = "<f8") -> bytes:
    """An .npy whose header claims a shape that its bytes do not have."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + bytes(64)


def first_member(path: Path) -> str:
    """Name of an archive's first member."""
    with zipfile.ZipFile(path) as archive:
        return archive.namelist()[0]


def instead(path: Path, data: bytes, method: int = zipfile.ZIP_STORED) -> None:
    """Other bytes for the first member of an archive."""
    with zipfile.ZipFile(path) as archive:
        held = {n: archive.read(n) for n in archive.namelist()}
    held[first_member(path)] = data
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, own in held.items():
            archive.writestr(name, own)


NPZ: dict[str, Damage] = {
    "NaN everywhere": each_float(np.nan),
    "1e300 everywhere": each_float(1e300),
    "no rows": arrays_changed(lambda a: {k: np.asarray(x)[:0] if np.ndim(x) else x for k, x in a.items()}),
    "numbers as text": arrays_changed(lambda a: {k: np.asarray(x).astype("U") for k, x in a.items()}),
    "complex numbers": arrays_changed(
        lambda a: {k: x.astype(complex) if np.asarray(x).dtype.kind == "f" else x for k, x in a.items()}
    ),
    "the largest whole numbers": arrays_changed(
        lambda a: {k: np.full_like(x, np.iinfo(x.dtype).max) if x.dtype.kind in "iu" else x for k, x in a.items()}
    ),
    "one more axis": arrays_changed(lambda a: {k: np.asarray(x)[None] for k, x in a.items()}),
    "pickled objects": arrays_changed(lambda a: {**a, next(iter(a)): np.array([{"a": 1}], object)}),
    "a header that claims 10^15 numbers": lambda p: instead(p, claims("(1000000, 1000000000)")),
    "a header with a negative length": lambda p: instead(p, claims("(-1, 16)")),
    "a header that is a program": lambda p: instead(p, claims("__import__('os').system('true')")),
    "64 MiB of zeros, deflated": lambda p: instead(p, bytes(64 << 20), zipfile.ZIP_DEFLATED),
    "an array twice": lambda p: member(p, first_member(p), claims("(8,)")),
    "an absolute name": lambda p: member(p, "/etc/passwd.npy", claims("(8,)")),
    "1,000 more arrays": lambda p: many_members(p, 1000, claims("(8,)")),
}


def json_changed(change: Callable[[Any], Any]) -> Damage:
    """Another value in a JSON file."""
    return lambda p: p.write_text(json.dumps(change(json.loads(p.read_text()))))


def leaves(value: Any, new: Any) -> Any:
    """The JSON value with something else in place of every number."""
    if isinstance(value, dict):
        return {k: leaves(v, new) for k, v in value.items()}
    if isinstance(value, list):
        return [leaves(v, new) for v in value]
    return new if isinstance(value, (int, float)) and not isinstance(value, bool) else value


JSON: dict[str, Damage] = {
    "100,000 brackets": rewritten(lambda _: b"[" * 100_000),
    "objects in objects, 50,000 deep": rewritten(lambda _: b'{"a":' * 50_000 + b"1" + b"}" * 50_000),
    "a list": rewritten(lambda d: b"[" + d + b"]"),
    "null": rewritten(lambda _: b"null"),
    "NaN for every number": json_changed(lambda x: leaves(x, float("nan"))),
    "1e999 for every number": rewritten(lambda d: d.replace(b": 1", b": 1e999")),
    "10^4000 for every number": json_changed(lambda x: leaves(x, 10**4000)),
    "text for every number": json_changed(lambda x: leaves(x, "x\x1b[2J")),
    "lists for every number": json_changed(lambda x: leaves(x, [[]])),
    "UTF-16": rewritten(lambda d: d.decode().encode("utf-16")),
    "bytes that are no UTF-8": rewritten(lambda d: d.replace(b'"', b'"\xff\xfe', 1)),
}
ALIASES = b"\na: &a [x, x, x]\n" + b"".join(
    b"%c: &%c [*%c, *%c, *%c]\n" % (k, k, k - 1, k - 1, k - 1) for k in range(98, 122)
)
ENTITIES = b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">%s]>' % b"".join(
    b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(9)
)
ATTRIBUTES = b" ".join(b'a%d="1"' % k for k in range(10_000))
YAML: dict[str, Damage] = {
    "aliases of aliases": rewritten(lambda d: d + ALIASES),
    "a tag that calls": rewritten(lambda d: d + b"\nx: !!python/object/apply:os.system ['true']\n"),
    "nested 20,000 deep": rewritten(lambda d: d + b"\nx: " + b"[" * 20_000),
    "an absolute path": rewritten(lambda d: d + b"\nhand_set: /etc/passwd\n"),
    "a path that leads out": rewritten(lambda d: d + b"\nhand_set: ../../../etc/passwd\n"),
    "an address": rewritten(lambda d: d + b"\nhand_set: http://x/y.npz\n"),
    "a key twice": rewritten(lambda d: d + d),
    "a million lines": rewritten(lambda d: d + b"\n# x" * 1_000_000),
    "escape sequences": rewritten(lambda d: d + b'\n"\\e]0;owned\\a": 1\n'),
    "numbers in base 60": rewritten(lambda d: d + b"\nformat: 1:30\n"),
}  # fmt: skip
CSV: dict[str, Damage] = {
    "one line of 64 MiB": rewritten(lambda d: d + b"x" * (64 << 20)),
    "a quote that never ends": rewritten(lambda d: d + b'"' + b"a,b\n" * 100_000),
    "100,000 columns": rewritten(lambda d: d + b"," * 100_000),
    "NUL bytes": rewritten(lambda d: d.replace(b",", b"\0,")),
    "formulas and escapes": rewritten(lambda d: d.replace(b"\n", b"\n=1+1\x1b[2J,", 2)),
    "NaN": rewritten(lambda d: d.replace(b"1", b"nan")),
    "other digits": rewritten(lambda d: d.replace(b"1", "\u0661".encode())),
    "UTF-16": rewritten(lambda d: d.decode().encode("utf-16")),
    "no header": rewritten(lambda d: d.partition(b"\n")[2]),
    "a name that is no UTF-8": rewritten(lambda d: b"\x80" + d),
    "every row twice": rewritten(lambda d: d + d.partition(b"\n")[2]),
}
XML: dict[str, Damage] = {
    "entities of entities": rewritten(lambda d: ENTITIES + d),
    "an entity that is a file": rewritten(lambda d: b'<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + d),
    "elements 100,000 deep": rewritten(lambda _: b"<robot>" * 100_000),
    "NaN for every number": rewritten(lambda d: d.replace(b'"0', b'"nan')),
    "1e308 for every number": rewritten(lambda d: d.replace(b"1", b"1e308")),
    "an absolute mesh": rewritten(lambda d: d.replace(b'filename="', b'filename="/etc/')),
    "10,000 attributes": rewritten(lambda d: d.replace(b"<robot", b"<robot " + ATTRIBUTES, 1)),
}  # fmt: skip


def parquet_changed(change: Callable[[Any], Any], **options: Any) -> Damage:
    """Another table in a Parquet file, with the metadata that it had."""
    import pyarrow.parquet as pq

    def damage(path: Path) -> None:
        table = pq.read_table(path, partitioning=None)
        new = change(table)
        pq.write_table(new.replace_schema_metadata(table.schema.metadata), path, **options)

    return damage


def column_as(kind: str) -> Callable[[Any], Any]:
    """The first column as another type."""
    import pyarrow as pa

    return lambda t: t.set_column(0, t.column_names[0], t.column(0).cast(pa.string()).cast(kind))


def constant(value: Any) -> Callable[[Any], Any]:
    """Every row of the first column of text as one value."""
    import pyarrow as pa

    def change(table: Any) -> Any:
        k = next((i for i, f in enumerate(table.schema) if "string" in str(f.type)), 0)
        return table.set_column(k, table.column_names[k], pa.array([value] * len(table)))

    return change


def parquet() -> dict[str, Damage]:
    """Damage to a Parquet file."""
    import pyarrow as pa

    return {
        "300,000 rows in a dictionary": parquet_changed(lambda t: t.take(pa.array([0] * 300_000))),
        "no rows": parquet_changed(lambda t: t.slice(0, 0)),
        "rows twice": parquet_changed(lambda t: pa.concat_tables([t, t])),
        "numbers as text": parquet_changed(column_as("string")),
        "a word of 32 MiB in each row": parquet_changed(constant("x" * (32 << 20))),
        "words that move the cursor": parquet_changed(constant("\x1b]0;owned\x07")),
        "a column of nulls": parquet_changed(lambda t: t.set_column(0, t.column_names[0], pa.nulls(len(t)))),
        "no columns but one": parquet_changed(lambda t: t.select([0])),
        "a footer that claims 2 GiB": rewritten(lambda d: d[:-8] + struct.pack("<i", 2**31 - 1) + d[-4:]),
        "a footer of negative length": rewritten(lambda d: d[:-8] + struct.pack("<i", -7) + d[-4:]),
    }


def many_members(path: Path, count: int, data: bytes = b"") -> None:
    """Adds so many members."""
    with zipfile.ZipFile(path, "a") as archive:
        for k in range(count):
            archive.writestr(f"run/{k}", data)


def pickled(value: Any) -> Damage:
    """Another pickle."""
    return rewritten(lambda _: pickle.dumps(value, 2))


PICKLE: dict[str, Damage] = {
    "a call": rewritten(lambda _: b"cos\nsystem\n(S'true'\ntR."),
    "a loop of references": rewritten(lambda _: b"(lp0\ng0\na."),
    "lists 100,000 deep": rewritten(lambda _: b"(" * 100_000 + b"l" * 100_000 + b"."),
    "2^40 by references": rewritten(lambda _: b"]" + b"(ooooooo" + b"2" * 100 + b"t" * 40 + b"."),
    "a string of 2^31": rewritten(lambda _: b"\x80\x02X\xff\xff\xff\x7fabc."),
    "another thing": pickled({"a": [1, 2]}),
}

WEIGHTS: dict[str, Damage] = {
    "a header of 2^60 bytes": rewritten(lambda d: struct.pack("<Q", 1 << 60) + d[8:]),
    "a header of 0 bytes": rewritten(lambda d: bytes(8) + d[8:]),
    "other names": rewritten(lambda d: d.replace(b"weight", b"weighs")),
    "another type": rewritten(lambda d: d.replace(b'"F32"', b'"F16"')),
    "NaN": rewritten(lambda d: d[:-4000] + b"\xff" * 4000),
    "a program in place of it": pickled({"state": "os.system"}),
}
TOML: dict[str, Damage] = {
    "brackets 30,000 deep": rewritten(lambda d: d + b"x = " + b"[" * 30_000),
    "10,000 tables deep": rewritten(lambda d: d + b"[" + b"a." * 10_000 + b"a]\n"),
    "10,000 dotted keys": rewritten(lambda d: b"a." * 10_000 + b"a = 1\n" + d),
    "a table twice": rewritten(lambda d: d + d),
    "NaN": rewritten(lambda d: d.replace(b"0", b"nan")),
    "numbers of 400 digits": rewritten(lambda d: d.replace(b"0", b"1" * 400)),
    "an unknown field": rewritten(lambda d: d + b"no_such = 1\n"),
    "a million cameras": rewritten(lambda d: d + b"[[cameras]]\n" * 100_000),
}
