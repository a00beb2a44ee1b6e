"""Attacks on each kind of file that the program reads: docs/results/attacks.md.

    python bench/attacks.py [--only KIND ...]

For each kind of file the bench makes a sound one, reads it, damages it in ways that somebody thought of who had not written
its reader, and reads that, as the command line does. Each attack runs in a process of its own. It must end within 60 s with
an exit code and at most one line, and may take at most 1 GiB of memory more than the process had. `read` counts damaged
files that were read after all: some damage leaves a sound file, such as a flipped digit.
"""

import argparse
import io
import json
import os
import pickle
import re
import signal
import struct
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _report import ROOT, arguments, made_by, markdown_table, page_from, resident_mib

from r2h_batch.__main__ import main as command
from r2h_batch.base.command_line import exit_code_of
from r2h_batch.data.grasp_files import read_file_of
from r2h_batch.data.hdf5 import read_datasets
from r2h_batch.data.people import LENGTHS_M, built_in_people, read_people
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_srdf import read_srdf
from r2h_batch.data.safe_pickle import read_npy, read_pickle_file
from r2h_batch.methods.ranker.network import read_weights
from r2h_batch.observe.rig import load_rig
from r2h_batch.protocols.hidden import commitment_of, read_commitment
from r2h_batch.protocols.load import load_benchmark
from r2h_batch.protocols.trials_file import read_trials_file
from r2h_batch.runs.files import sha256_of
from r2h_batch.runs.store import load_run
from r2h_batch.scene.grasp_set import read_grasps
from r2h_batch.scene.hand_file import read_hand, read_hand_set
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.robot import read_robot
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.options import load_config
from r2h_batch.sweep.study.report import read_counts
from r2h_batch.sweep.submission_judge import unpack
from r2h_batch.trials.predictions import load_answers

STORED, PAGE = ROOT / "bench" / "results" / "attacks.json", ROOT / "docs" / "results" / "attacks.md"
MEASURES = ("bench/attacks.py", "r2h_batch/base/io", "r2h_batch/runs", "r2h_batch/protocols", "r2h_batch/data")
MOST_SECONDS, MOST_MIB = 60.0, 1024
SEED = 52
SPARSE_BYTES = 3 << 30
WORKERS = 3
"""Kinds of files that are attacked side by side."""
PROGRESS = re.compile(r", \d+ s$")
"""A line that says for how long something has been going on."""

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


ZIP: dict[str, Damage] = {
    "64 MiB of zeros, deflated": lambda p: member(p, "run/x", bytes(64 << 20), method=zipfile.ZIP_DEFLATED),
    "a name that leads out": lambda p: member(p, "run/../../x", b"x"),
    "an absolute name": lambda p: member(p, "/tmp/x", b"x"),
    "a name with a backslash": lambda p: member(p, "run\\..\\x", b"x"),
    "a member twice": lambda p: member(p, first_member(p), b"{}"),
    "100,001 members": lambda p: many_members(p, 100_001),
    "a link as a member": lambda p: linked_member(p),
    "a false size": rewritten(lambda d: d.replace(struct.pack("<I", zlib.crc32(b"{}")), b"\xff" * 4)),
    "no end": rewritten(lambda d: d[:-22]),
}


def many_members(path: Path, count: int, data: bytes = b"") -> None:
    """Adds so many members."""
    with zipfile.ZipFile(path, "a") as archive:
        for k in range(count):
            archive.writestr(f"run/{k}", data)


def linked_member(path: Path) -> None:
    """Adds a member that an unpacker may make a link of."""
    info = zipfile.ZipInfo("run/shards")
    info.create_system, info.external_attr = 3, 0o120777 << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(info, "/etc")


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
    "a table twice": rewritten(lambda d: d + d),
    "NaN": rewritten(lambda d: d.replace(b"0", b"nan")),
    "numbers of 400 digits": rewritten(lambda d: d.replace(b"0", b"1" * 400)),
    "an unknown field": rewritten(lambda d: d + b"no_such = 1\n"),
    "a million cameras": rewritten(lambda d: d + b"[[cameras]]\n" * 100_000),
}

# ---- kinds of meshes, whose headers say counts

OBJ = "\n".join(
    ["v 0 0 0", "v .05 0 0", "v 0 .05 0", "v 0 0 .05", "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4", ""]
).encode()
STL = bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 0.05, 0, 0, 0, 0.05, 0, 0)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    b"property list uchar int vertex_indices\nend_header\n0 0 0\n.05 0 0\n0 .05 0\n3 0 1 2\n"
)
OFF = b"OFF\n3 1 0\n0 0 0\n.05 0 0\n0 .05 0\n3 0 1 2\n"


def mesh(data: bytes, ending: str, own: Mapping[str, Damage]) -> Kind:
    """A kind of mesh."""
    return Kind(ending, lambda p: p.write_bytes(data), lambda p: load_mesh_file(p, "attack"), own)


MESHES = {
    "OBJ mesh": mesh(
        OBJ,
        ".obj",
        {
            "faces of vertices that are not there": rewritten(lambda d: d + b"f 1 2 99999999\n"),
            "NaN": rewritten(lambda d: d.replace(b".05", b"nan")),
            "vertices at 1e300": rewritten(lambda d: d.replace(b".05", b"1e300")),
            "a face of 300,000 corners": rewritten(lambda d: d + b"f" + b" 1 2 3" * 100_000 + b"\n"),
            "a material of another folder": rewritten(lambda d: b"mtllib ../../../etc/passwd\n" + d),
            "1,000,000 vertices": rewritten(lambda d: d + b"v 0 0 0\n" * 1_000_000),
        },
    ),
    "STL mesh": mesh(
        STL,
        ".stl",
        {
            "a count of 2^32 - 1": rewritten(lambda d: d[:80] + b"\xff" * 4 + d[84:]),
            "NaN": rewritten(lambda d: d[:84] + struct.pack("<12f", *[np.nan] * 12) + d[-2:]),
            "text that begins as one": rewritten(lambda d: b"solid x\n" + b"facet normal 0 0 1\n" * 1000),
        },
    ),
    "PLY mesh": mesh(
        PLY,
        ".ply",
        {
            "10^12 vertices": rewritten(lambda d: d.replace(b"vertex 3", b"vertex 1000000000000")),
            "-1 faces": rewritten(lambda d: d.replace(b"face 1", b"face -1")),
            "a list of 2^30 corners": rewritten(lambda d: d.replace(b"3 0 1 2", b"1073741824 0 1 2")),
            "1,000 properties": rewritten(lambda d: d.replace(b"property float z\n", b"property float z\n" * 1000)),
        },
    ),
    "OFF mesh": mesh(
        OFF,
        ".off",
        {
            "10^12 vertices": rewritten(lambda d: d.replace(b"3 1 0", b"1000000000000 1 0")),
            "a face of itself": rewritten(lambda d: d.replace(b"3 0 1 2", b"3 9 9 9")),
        },
    ),
}


def glb(path: Path) -> None:
    """A binary glTF of one triangle."""
    import trimesh

    corners = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    triangle = trimesh.Trimesh(corners, np.array([[0, 1, 2]]), process=False)
    triangle.export(path, file_type="glb")


MESHES["GLB mesh"] = Kind(
    ".glb",
    glb,
    lambda p: load_mesh_file(p, "attack"),
    {
        "a length of 2^32 - 1": rewritten(lambda d: d[:8] + b"\xff" * 4 + d[12:]),
        "a chunk of 2^32 - 1": rewritten(lambda d: d[:12] + b"\xff" * 4 + d[16:]),
        "a buffer that is a file": rewritten(lambda d: d.replace(b'"byteLength"', b'"uri":"/x"  ')),
        "10^9 corners": rewritten(lambda d: d.replace(b'"count":3', b'"count":9')),
    },
)

# ---- sound files of the other kinds


@cache
def work() -> Path:
    """A folder with a small run, its transfers as a stranger may write them, and its submission."""
    folder = Path(tempfile.mkdtemp(prefix="attacks-"))
    os.chdir(folder)
    words = "--benchmark r2h-v1 --method random --trials 3 --sim none --out run"
    with redirect_stdout(io.StringIO()):
        sweep(words.split())
    forge_transfers(folder / "run")
    (folder / "run" / "ids.csv").write_text("trial_id,id,variant\n0,a,x\n2,b,x\n4,c,x\n1,d,y\n3,e,y\n5,f,y\n")
    with zipfile.ZipFile(folder / "run.zip", "w") as archive:
        archive.writestr("submission.json", "{}")
        for file in sorted((folder / "run").rglob("*")):
            if file.is_file() and file.parent.name in ("run", "methods", "random"):
                archive.write(file, Path("run") / file.relative_to(folder / "run"))
    return folder


def forge_transfers(run: Path) -> None:
    """Transfers of a run as their reader takes them."""
    import pyarrow as pa

    from r2h_batch.report.transfers import MADE_OF
    from r2h_batch.runs.side import side_writer

    stored = load_run(run)
    rows = stored.trials("random", ["trial_id", "outcome"]).to_pylist()
    n = len(rows)
    table = pa.table(
        {
            "trial_id": pa.array([r["trial_id"] for r in rows], pa.int64()),
            "release": ["load-share"] * n,
            "scenario": ["take"] * n,
            "person": pa.array([0] * n, pa.int16()),
            "success": [r["outcome"] == "success" for r in rows],
            "received": [True] * n,
            "outcome": ["taken"] * n,
        }
    )
    about = {MADE_OF: {"rows": stored.digest("random")}}
    with side_writer(run / "transfer" / "random.parquet", table.schema, about) as writer:
        writer.write(table)


def of_run(name: str) -> Callable[[Path], object]:
    """Writes a file of the run in the place of an attack: the run is copied beside it."""
    import shutil

    def make(path: Path) -> None:
        copy = path.parent / "run"
        shutil.copytree(work() / "run", copy)
        (found,) = copy.glob(name)
        found.rename(path)
        (path.parent / "own").write_text(str(found))  # where its reader looks for it

    return make


def put_back(path: Path) -> Path:
    """The run with the attack's file in the place of its own. A shard's name has the digest of what it holds now."""
    run, own = path.parent / "run", Path((path.parent / "own").read_text())
    if (
        own.parent.parent.name == "shards"
        and path.is_file()
        and path.stat().st_size < SPARSE_BYTES
        and not path.is_symlink()
    ):
        own = own.with_name(f"{own.name[:6]}-{sha256_of(path)[:16]}.parquet")
    path.rename(own)
    return run


def reported(path: Path) -> int:
    """Reads the run by `report`."""
    return command(["report", str(put_back(path))])


def labelled(path: Path) -> object:
    """The labels of a run."""
    return load_run(put_back(path)).labels


def copied(place: str) -> Callable[[Path], object]:
    """A file of the package's data."""
    return lambda path: path.write_bytes((ROOT / "assets" / place).read_bytes())


def submission(path: Path) -> object:
    """A submission, unpacked and verified."""
    folder = path.parent / "unpacked"
    folder.mkdir()
    run = load_run(unpack(path, folder), verify=False)
    run.verify(whole=True)
    return run


def some_answers(path: Path) -> None:
    """Predictions of three trials of each split."""
    trials = np.arange(6)
    T = np.tile(np.eye(4, dtype=np.float32), (6, 1, 1))
    arrays: dict[str, Any] = {"trial_id": trials, "T_obj_ee": T, "T_world_ee": T}
    if path.suffix == ".npz":
        with path.open("wb") as file:
            np.savez(file, **arrays)
    elif path.suffix == ".json":
        path.write_text(json.dumps({k: v.tolist() for k, v in arrays.items()}))
    elif path.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = {k: v.reshape(6, -1).tolist() if v.ndim > 1 else v.tolist() for k, v in arrays.items()}
        pq.write_table(pa.table(columns), path)
    else:
        head = ["trial_id", *(f"{k}_{j}" for k in ("T_obj_ee", "T_world_ee") for j in range(16))]
        rows = [[i, *T[i].ravel().tolist() * 2] for i in trials.tolist()]
        path.write_text("\n".join(",".join(map(str, row)) for row in (head, *rows)) + "\n")


@cache
def v1() -> Any:
    """The benchmark whose trials are listed."""
    return load_benchmark("r2h-v1")


def some_trials(path: Path) -> None:
    """Listed trials with bodies."""
    trials = v1().trials(3)
    arrays = {
        "object": np.array(trials.object_names),
        "T_world_hand": trials.T_world_hand.numpy(),
        "hand": trials.hand_index.numpy().astype(np.int64),
        "receiver": trials.receiver.numpy(),
    }
    if path.suffix == ".npz":
        with path.open("wb") as file:
            np.savez(file, **arrays)
    else:
        path.write_text(json.dumps({k: v.tolist() for k, v in arrays.items()}))


def listed(path: Path) -> object:
    """Reads listed trials."""
    return read_trials_file(path, v1().objects, v1().hand_set)


def commitment(path: Path) -> None:
    """A commitment to trials."""
    path.write_text(commitment_of(v1().with_seed("0123456789abcdef" * 2), 5).model_dump_json(indent=1))


URDF = b"""<robot name="x"><link name="base"/><link name="a"><inertial><mass value="1.0"/><inertia ixx="0.1" ixy="0"
ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial><visual><geometry><mesh filename="a.stl"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"
effort="10" velocity="1"/></joint></robot>"""
SRDF = b"""<robot name="x"><group name="arm"><chain base_link="base" tip_link="a"/></group><disable_collisions link1="base"
link2="a" reason="Adjacent"/></robot>"""
ISAAC = """format: isaac_grasp
format_version: 1.0
grasps:
  a:
    confidence: 1.0
    position: [0.0, 0.0, 0.1]
    orientation: {w: 1.0, xyz: [0.0, 0.0, 0.0]}
"""
COUNTS = "method,dimension,n1,n2,n3,n4,n5\na,comfort,1,2,3,4,5\nb,comfort,5,4,3,2,1\n"
YAML_FILE = "protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: hammer}\n"
CONFIG = "method: [random]\ntrials: 3\nbenchmark: r2h-v1\n"


RIG = """name = "mine"
width = 320
height = 240
focal_px = 300.0
[[cameras]]
name = "a"
position = [-0.1, 0.75, 0.8]
target = [0.4, 0.0, 0.2]
"""


def some_grasps(path: Path) -> None:
    """Five grasps."""
    with path.open("wb") as file:
        np.savez(file, T_obj_ee=np.tile(np.eye(4, dtype=np.float32), (5, 1, 1)), width=np.full(5, 0.05, np.float32))


def some_people(path: Path) -> None:
    """Two shipped people as a table."""
    people = built_in_people()
    head = ["sex", "age", *LENGTHS_M]
    rows = [
        ["male" if people.sex[k] == 0 else "female", people.age[k], *(people.lengths[n][k] for n in LENGTHS_M)]
        for k in range(2)
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in (head, *rows)) + "\n")


def text(words: str | bytes) -> Callable[[Path], object]:
    """A file with this text."""
    return lambda path: path.write_bytes(words if isinstance(words, bytes) else words.encode())


def hdf5(path: Path) -> None:
    """An HDF5 file with grasps."""
    import h5py

    with h5py.File(path, "w") as file:
        file["grasps/transforms"] = np.tile(np.eye(4), (5, 1, 1))


def robot(path: Path) -> None:
    """A stored robot's file of this ending, and the other one beside it."""
    for ending in (".npz", ".yaml"):
        place = path if ending == path.suffix else path.with_name(f"robot{ending}")
        place.write_bytes((ROOT / "assets" / "robot" / "panda_hand" / f"robot{ending}").read_bytes())


def robot_read(path: Path) -> object:
    """Reads a robot's folder."""
    path.rename(path.with_name(f"robot{path.suffix}"))
    return read_robot(path.parent)


def kinds() -> dict[str, Kind]:
    """Every kind of file that is attacked."""
    table = parquet()
    shard = "shards/random/*.parquet"
    return {
        "predictions .npz": Kind(".npz", some_answers, load_answers, NPZ),
        "predictions .json": Kind(".json", some_answers, load_answers, JSON),
        "predictions .csv": Kind(".csv", some_answers, load_answers, CSV),
        "predictions .parquet": Kind(".parquet", some_answers, load_answers, table),
        "trials .npz": Kind(".npz", some_trials, listed, NPZ),
        "trials .json": Kind(".json", some_trials, listed, JSON),
        "benchmark.yaml": Kind(".yaml", text(YAML_FILE), lambda p: command(["benchmark", "check", str(p)]), YAML),
        "sweep's --config": Kind(".yaml", text(CONFIG), load_config, YAML),
        "commitment": Kind(".json", commitment, read_commitment, JSON),
        "run.json": Kind(".json", of_run("run.json"), reported, JSON),
        "a method's file": Kind(".json", of_run("methods/random.json"), reported, JSON),
        "shard": Kind(".parquet", of_run(shard), reported, table),
        "transfers": Kind(".parquet", of_run("transfer/random.parquet"), reported, table),
        "ids.csv": Kind(".csv", of_run("ids.csv"), labelled, CSV),
        "submission": Kind(".zip", lambda p: p.write_bytes((work() / "run.zip").read_bytes()), submission, ZIP),
        "grasps": Kind(".npz", some_grasps, read_grasps, NPZ),
        "hand": Kind(".npz", copied("people/hand.npz"), read_hand, NPZ),
        "hand set": Kind(".npz", copied("hand/handset.npz"), read_hand_set, NPZ),
        "weights": Kind(".safetensors", copied("ranker/ranker.safetensors"), read_weights, WEIGHTS),
        "people": Kind(".csv", some_people, read_people, CSV),
        "study table": Kind(".csv", text(COUNTS), read_counts, CSV),
        "rig": Kind(".toml", text(RIG), load_rig, TOML),
        "URDF": Kind(".urdf", text(URDF), read_model, XML),
        "SRDF": Kind(".srdf", text(SRDF), read_srdf, XML),
        "robot.npz": Kind(".npz", robot, robot_read, NPZ),
        "robot.yaml": Kind(".yaml", robot, robot_read, YAML),
        "pickle": Kind(".pkl", lambda p: p.write_bytes(pickle.dumps({"a": 1}, 2)), read_pickle_file, PICKLE),
        ".npy": Kind(".npy", lambda p: p.write_bytes(claims("(8,)")), read_npy, {}),
        "HDF5": Kind(".h5", hdf5, lambda p: read_datasets(p, {"grasps/transforms": 1 << 20}), {}),
        "grasps of Isaac": Kind(".yaml", text(ISAAC), lambda p: read_file_of("isaac", p, "acronym-panda"), YAML),
        **MESHES,
    }


# ---- one attack


class Found(NamedTuple):
    """The end of an attack."""

    ended: str
    seconds: float
    mib: int
    said: str


def attacked(kind: Kind, damage: Damage | None) -> Found:
    """Damages a sound file and reads it in a process of its own."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / f"file{kind.ending}"
        kind.make(path)
        if damage is not None:
            damage(path)
        said, start, before = Path(place) / "said", time.monotonic(), resident_mib()
        child = os.fork()
        if not child:
            _read(kind, path, said)
        ended, peak = _wait(child, start)
        peak = max(0, peak - round(before))
        words = said.read_text(errors="replace") if said.exists() else ""
    seconds = time.monotonic() - start
    if "Traceback (most recent call last)" in words:
        ended = "traceback"
    elif ended == "refused" and sum(not PROGRESS.search(line) for line in words.strip().splitlines()) != 1:
        ended = "more than a line"
    said_of = words.strip().replace(f"{place}/", "").replace(place, ".")
    return Found(ended, round(seconds, 2), peak, said_of[:200] if ended in ("read", "refused") else said_of[-300:])


def _read(kind: Kind, path: Path, said: Path) -> None:
    """In the child: reads as a command does, with what it says in a file. Never returns."""
    os.setsid()
    out = os.open(said, os.O_CREAT | os.O_WRONLY)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(out, 2)
    sys.stderr = os.fdopen(2, "w", errors="replace")
    code = 99
    try:
        code = exit_code_of("attack", lambda: found if isinstance(found := kind.read(path), int) else 0)
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)


def _wait(child: int, start: float) -> tuple[str, int]:
    """How the child ended, and the largest memory that it or what it started had, MiB."""
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() - start > MOST_SECONDS:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hang", 0
        time.sleep(0.01)
    mib = used.ru_maxrss >> 10
    code = os.waitstatus_to_exitcode(status)
    names = {0: "read", 1: "refused", 2: "refused"}
    return names.get(code, "crash" if code < 0 else "traceback"), mib


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Every attack, and how each ended."""
    every = kinds()
    work()
    names = [name for name in every if not options.only or name in options.only]
    shares = [names[k::WORKERS] for k in range(WORKERS)]
    with tempfile.TemporaryDirectory() as place:
        parts = [Path(place) / f"{k}.json" for k in range(WORKERS)]
        for worker in [_started(share, every, part) for share, part in zip(shares, parts, strict=True)]:
            os.waitpid(worker, 0)
        found = {name: row for part in parts for name, row in json.loads(part.read_text()).items()}
    rows = {name: found[name] for name in names}
    return {"kinds": rows, **made_by(MEASURES)}


def _started(names: list[str], every: Mapping[str, Kind], part: Path) -> int:
    """A process that attacks these kinds and writes what it found; its number."""
    if worker := os.fork():
        return worker
    rows: dict[str, dict[str, Any]] = {}
    for name in names:
        sound = attacked(every[name], None)
        if sound.ended != "read":
            print(f"{name}: the sound file is {sound.ended}: {sound.said}", file=sys.stderr)
        own = {k: f._asdict() for k, f in _attacks(name, every[name])}
        rows[name] = {"sound": sound.ended, "attacks": own}
        print(f"{name}: {len(own)} attacks", flush=True)
    part.write_text(json.dumps(rows))
    os._exit(0)


def _attacks(name: str, kind: Kind) -> Iterator[tuple[str, Found]]:
    for what, damage in {**ANY, **kind.own}.items():
        try:
            found = attacked(kind, damage)
        except (ValueError, KeyError, OSError, UnicodeError) as error:  # the damage does not fit this file
            print(f"{name}: {what}: not tried ({error})", file=sys.stderr)
            continue
        if found.ended not in ("read", "refused") or found.mib > MOST_MIB:
            print(f"{name}: {what}: {found.ended}, {found.mib} MiB: {found.said}", flush=True)
        yield what, found


def markdown(data: Mapping[str, Any]) -> str:
    """docs/results/attacks.md."""
    lines, every = [], []
    for name, own in data["kinds"].items():
        found = [*own["attacks"].values()]
        every += found
        count = {end: sum(f["ended"] == end for f in found) for end in ("refused", "read")}
        lines.append(
            [
                name,
                str(len(found)),
                str(count["refused"]),
                str(count["read"]),
                str(len(found) - sum(count.values())),
                f"{max(f['seconds'] for f in found):.1f}",
                str(max(f["mib"] for f in found)),
            ]
        )
    bad = sum(f["ended"] not in ("refused", "read") for f in every)
    large = sum(f["mib"] > MOST_MIB for f in every)
    names = sorted({what for own in data["kinds"].values() for what in own["attacks"]})
    parts = [
        "# Attacks on files",
        "See what happens to damaged and hostile files of every kind that the program reads. `python bench/attacks.py`"
        " makes each of them and reads it in a process of its own (`bench/results/attacks.json`). Of"
        f" {len(every)} attacks {bad} end with a traceback, a crash, more than a line or after {MOST_SECONDS:g} s, and"
        f" {large} take more than {MOST_MIB} MiB. [What else was tried](../faults.md).",
        markdown_table(
            ["file", "attacks", "refused in one line", "read", "neither", "longest, s", "memory, MiB at most"], lines
        ),
        "`read`: the damage left a file that says something, such as a flipped digit or a second copy that nobody looks at."
        " Memory: of the process that reads, or of the largest that it starts, beyond what the bench itself has (under 1 GiB).",
        f"Damage: {'; '.join(names)}.",
    ]
    _, mark, strangers = PAGE.read_text().partition("## Attacks of a stranger")  # bench/strangers.py writes it
    return "\n\n".join([*parts, f"{mark}{strangers}".strip()]).rstrip() + "\n"


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--only", nargs="+", help="these kinds of files alone; prints, and writes nothing")
    if "--only" in sys.argv:
        own = parser.parse_args()
        for name, row in measure(own)["kinds"].items():
            for what, found in row["attacks"].items():
                print(
                    f"{name}: {what}: {found['ended']} {found['seconds']:.1f} s {found['mib']} MiB {found['said'][:160]!r}"
                )
    else:
        page_from(parser, STORED, PAGE, measure, markdown)
