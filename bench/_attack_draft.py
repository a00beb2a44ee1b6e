"""Attacks on files that came with later parts of the program: files beside the shards, told seeds, the draft from the table,
resumed runs, tables of real robots, rigs that see. Kinds of bench/attacks.py."""

import io
import json
import os
import shutil
import struct
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from _damage import CSV, JSON, Damage, Kind, arrays_changed, parquet, rewritten
from _source import ROOT

from r2h_batch.__main__ import main as command
from r2h_batch.data.people import LENGTHS_M, built_in_people, read_people
from r2h_batch.methods.ranker.network import read_weights
from r2h_batch.protocols.load import load_benchmark
from r2h_batch.protocols.trials_file import read_trials_file
from r2h_batch.runs.store import load_run

DRAFT = "r2h-v3-draft"
SHORT = ["--trials", "2", "--sim", "none", "--quiet"]


# ---- runs with files beside their shards


@cache
def runs() -> Path:
    """A folder with a run of the oracle on r2h-v1, its tables of `results`, and answers to the draft. Made once."""
    folder = Path(tempfile.mkdtemp(prefix="attacks-"))
    here = os.getcwd()
    os.chdir(folder)
    with redirect_stdout(io.StringIO()):
        command(["sweep", "--benchmark", "r2h-v1", "--method", "oracle", *SHORT, "--save-paths", "--out", "run"])
        command(["results", "reception", "run"])
        command(["sweep", "--benchmark", DRAFT, "--method", "random", *SHORT, "--out", "draft"])
    os.chdir(here)
    return folder


def of_run(name: str, run: str = "run") -> Callable[[Path], object]:
    """A file of a run in the place of an attack; the run is copied beside it."""

    def make(path: Path) -> None:
        copy = shutil.copytree(runs() / run, path.parent / "run")
        (found,) = copy.glob(name)
        found.rename(path)
        (path.parent / "own").write_text(str(found))

    return make


def then(*words: str) -> Callable[[Path], int]:
    """Puts the attack into its run and gives a command; `RUN` stands for the run."""

    def read(path: Path) -> int:
        os.rename(path, (path.parent / "own").read_text())
        os.chdir(path.parent)
        return command([str(path.parent / "run") if word == "RUN" else word for word in words])

    return read


def sealed(change: Callable[[Any], Any]) -> Damage:
    """Another table beside the shards, written as ours: somebody who knows our code."""

    def damage(path: Path) -> None:
        import pyarrow.parquet as pq

        from r2h_batch.runs.side import write_side

        table = pq.read_table(path, partitioning=None)
        write_side(path, change(table))

    return damage


def sealed_attacks(rate: str) -> dict[str, Damage]:
    """Forgeries."""
    import pyarrow as pa

    return {
        "written by us: trials of another run": sealed(
            lambda t: t.set_column(0, t.schema.field(0), pa.array([9_000 + k for k in range(len(t))], pa.int64()))
        ),
        "written by us: each row twice": sealed(lambda t: pa.concat_tables([t, t])),
        "written by us: 1,000,000 rows": sealed(lambda t: t.take(pa.array([0] * 1_000_000))),
        f"written by us: no {rate}": sealed(lambda t: t.drop_columns([rate])),
        f"written by us: {rate} as text": sealed(
            lambda t: t.set_column(t.column_names.index(rate), rate, pa.array(["x\x1b[2J"] * len(t)))
        ),
        "written by us: a word of 32 MiB": sealed(
            lambda t: t.append_column("more", pa.array(["x" * (32 << 20)] * len(t)))
        ),
        "written by us: 10,000 columns": sealed(
            lambda t: pa.table({**{n: t[n] for n in t.column_names}, **{f"c{k}": t[0] for k in range(10_000)}})
        ),
    }


def beside(folder: str, rate: str, *words: str) -> Kind:
    """A kind of file beside the shards."""
    return Kind(".parquet", of_run(f"{folder}/*.parquet"), then(*words), {**parquet(), **sealed_attacks(rate)})


# ---- answers to the draft, trials for it


def draft_answers(path: Path) -> None:
    """The random method's answers to four trials of the draft."""
    run = load_run(runs() / "draft")
    rows = run.poses(run.entries[0].name).to_pylist()
    poses: dict[str, Any] = {
        k: np.array([r[k] for r in rows], np.float32).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")
    }
    with path.open("wb") as file:
        np.savez(file, trial_id=np.array([r["trial_id"] for r in rows]), **poses)


def swept(path: Path) -> int:
    """Judges answers to the draft."""
    os.chdir(path.parent)
    return command(["sweep", "--benchmark", DRAFT, "--predictions", path.name, *SHORT, "--out", "out"])


def moved(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Other poses."""
    return arrays_changed(lambda a: {**a, name: change(np.array(a[name]))})


def at(x: np.ndarray, value: float, *place: int) -> np.ndarray:
    """The array with a number in every row."""
    index: Any = (slice(None), *place)
    x[index] = value
    return x


ANSWERS: dict[str, Damage] = {
    "the grasp in the world, too": arrays_changed(lambda a: {**a, "T_world_grasp": a["T_obj_ee"]}),
    "the grasp in the world alone": arrays_changed(
        lambda a: {("T_world_grasp" if k == "T_obj_ee" else k): v for k, v in a.items()}
    ),
    "where the object rests, too": arrays_changed(lambda a: {**a, "T_world_obj": a["T_obj_ee"]}),
    "whether it picks, too": arrays_changed(lambda a: {**a, "pick": np.ones(len(a["trial_id"]), bool)}),
    "grasps 1 m below the table": moved("T_obj_ee", lambda x: at(x, -1.0, 2, 3)),
    "grasps 999 m away": moved("T_obj_ee", lambda x: at(x, 999.0, 0, 3)),
    "grasps of NaN": moved("T_obj_ee", lambda x: x * np.nan),
    "grasps that are the object's frame": moved(
        "T_obj_ee", lambda x: np.tile(np.eye(4, dtype=np.float32), (len(x), 1, 1))
    ),
    "handover poses below the floor": moved("T_world_ee", lambda x: at(x, -5.0, 2, 3)),
    "handover poses at the robot's base": moved(
        "T_world_ee", lambda x: np.tile(np.eye(4, dtype=np.float32), (len(x), 1, 1))
    ),
    "trials beyond the certified ones": moved("trial_id", lambda x: x + 100_000),
    "trials of r2h-v2": arrays_changed(lambda a: {**a, "benchmark": np.array("r2h-v2 0123456789abcdef")}),
    "a certificate": arrays_changed(
        lambda a: {**a, "redraws": np.zeros(len(a["trial_id"]), int), "solved": np.ones(4, bool)}
    ),
    "motions in place of poses": arrays_changed(
        lambda a: {**a, "q": np.zeros((8, 6)), "time_s": np.arange(8.0), "length": np.array([2, 2, 2, 2])}
    ),
}


def draft_trials(path: Path) -> None:
    """Listed trials for the draft."""
    trials: Any = load_benchmark(DRAFT).trials(2)
    with path.open("wb") as file:
        np.savez(
            file, object=np.array(trials.object_names), T_world_hand=trials.T_world_hand.numpy(),
            hand=trials.hand_index.numpy().astype(np.int64), receiver=trials.receiver.numpy(),
        )  # fmt: skip


def listed(path: Path) -> object:
    """Reads them."""
    draft = load_benchmark(DRAFT)
    return read_trials_file(path, draft.objects, draft.hand_set)


MOMENTS: dict[str, Damage] = {
    "moments, too": arrays_changed(lambda a: {**a, "T_world_obj": np.tile(np.eye(4), (4, 1, 1))}),
    "moments of NaN": arrays_changed(lambda a: {**a, "T_world_obj": np.full((4, 4, 4), np.nan)}),
    "redraws": arrays_changed(lambda a: {**a, "redraws": np.array([0, 1, 2, 10**9])}),
    "certified answers": arrays_changed(lambda a: {**a, "solved": np.ones(4, bool), "T_obj_ee": np.zeros((4, 4, 4))}),
    "a hand in the table": moved("T_world_hand", lambda x: at(at(x, 0.2, 0, 3), -0.03, 2, 3)),
    "a hand in the robot": moved("T_world_hand", lambda x: at(at(at(x, 0.0, 0, 3), 0.0, 1, 3), 0.3, 2, 3)),
    "a hand upside down, 3 m up": moved("T_world_hand", lambda x: at(x, 3.0, 2, 3)),
    "shoulders at the hands": moved("receiver", lambda x: at(x, 0.0, 0)),
    "a torso that is turned by NaN": moved("receiver", lambda x: at(x, np.nan, 3, 3)),
    "a torso of no size": moved("receiver", lambda x: at(x, 0.0, 4, 0)),
    "an arm of one point": moved("receiver", lambda x: np.repeat(x[:, :1], 5, 1)),
    "objects of another benchmark": arrays_changed(lambda a: {**a, "object": np.array(["cup"] * 4)}),
}

# ---- parts of a run that a sweep goes on with


def resumed(path: Path) -> int:
    """Goes on with the run."""
    os.rename(path, (path.parent / "own").read_text())
    os.chdir(path.parent)
    return command(["sweep", "--benchmark", "r2h-v1", "--method", "oracle", *SHORT, "--save-paths", "--out", "run"])


LEFT: dict[str, Damage] = {
    "a claim that is a folder": lambda p: (p.parent / "run" / ".claims" / "oracle" / "000000").mkdir(parents=True),
    "claims that lead out": lambda p: _claims(p).symlink_to(p.parent),
    "a claim of a process that never was": lambda p: _claim(p, json.dumps({"pid": 2**40, "host": "x\x1b[2J"})),
    "a claim of 16 MiB": lambda p: _claim(p, "x" * (16 << 20)),
    "a claim that is a pipe": lambda p: os.mkfifo(_claims(p, made=True) / "000000"),
    "a part of a shard": lambda p: (
        next((p.parent / "run" / "shards").iterdir()) / ".000001-x.parquet.tmp"
    ).write_bytes(b"x" * 99),
    "a shard of number -1": lambda p: (next((p.parent / "run" / "shards").iterdir()) / "-00001-0.parquet").write_bytes(
        b"PAR1"
    ),
    "another method's shards are a file": lambda p: (p.parent / "run" / "shards" / "random").write_text("x"),
    "failures of a link": lambda p: (p.parent / "run" / "failures").symlink_to("/etc"),
}


def _claims(path: Path, *, made: bool = False) -> Path:
    found = path.parent / "run" / ".claims"
    shutil.rmtree(found, ignore_errors=True)
    if made:
        found.mkdir()
    return found


def _claim(path: Path, text: str) -> None:
    (_claims(path, made=True) / "000000").write_text(text)


# ---- a laboratory's table, people, weights


def lab_table(path: Path) -> None:
    """The table of `real export`, filled in; its run beside it."""
    shutil.copytree(runs() / "run", path.parent / "run")
    rows = [(x, "oracle", "success", "", 4.5) for x in range(4)]
    head = "trial_id,method,outcome,failed_criterion,seconds"
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")


def studied(path: Path) -> int:
    """Compares it with the run."""
    return command(["study", "real", str(path.parent / "run"), str(path)])


def cells(*changes: tuple[str, str]) -> Damage:
    """Other words in a table."""

    def change(data: bytes) -> bytes:
        text = data.decode()
        for old, new in changes:
            text = text.replace(old, new)
        return text.encode("utf-8", "surrogatepass")

    return rewritten(change)


TABLE: dict[str, Damage] = {
    "seconds of -1": cells(("4.5", "-1")),
    "seconds of infinity": cells(("4.5", "inf")),
    "seconds of 10^400": cells(("4.5", "1" + "0" * 400)),
    "seconds with a comma": cells(("4.5", '"4,5"')),
    "an outcome in capitals": cells(("success", "SUCCESS")),
    "an outcome of 1": cells(("success", "1")),
    "a success that failed": cells(("success,,", "success,safe,")),
    "a failure by nothing": cells(("success", "failure")),
    "a failure by a criterion that is none": cells(("success,,", "failure,luck,")),
    "a failure by Pick, where none is asked": cells(("success,,", "failure,pick,")),
    "ids of -1": cells(("\n0,", "\n-1,")),
    "ids of 2^63": cells(("\n0,", f"\n{2**63},")),
    "ids of 0x0": cells(("\n0,", "\n0x0,")),
    "ids of 1e0": cells(("\n1,", "\n1e0,")),
    "one id twice": cells(("\n1,", "\n0,")),
    "trials of another run": cells(("\n", "\n77")),
    "a method that is not there": cells(("oracle", "nobody")),
    "a method that looks the same": cells(("oracle", "\u043er\u0430\u0441le")),
    "a method of a formula": cells(("oracle", "=cmd|' /C calc'!A0")),
    "a method of a tag": cells(("oracle", "<img src=x onerror=alert(1)>")),
    "no outcome at all": cells(("success", "")),
    "columns in another order": rewritten(lambda d: b"\n".join(b",".join(x.split(b",")[::-1]) for x in d.split(b"\n"))),
    "a column twice": cells(("seconds", "seconds,seconds"), ("4.5", "4.5,9")),
    "half a surrogate": cells(("oracle", "orac\ud800le")),
}


def first_person(k: int, value: str) -> Damage:
    """Another k-th cell of the first person."""
    return rewritten(lambda d: _cell(d, k, value))


PERSON: dict[str, Damage] = {
    what: first_person(k, v)
    for what, (k, v) in {
        "an age of -3": (1, "-3"),
        "an age of 900": (1, "900"),
        "an age of 1e3": (1, "1e3"),
        "a sex of 2": (0, "2"),
        "a sex of a tag": (0, "<b>"),
        "a stature of 0": (2, "0"),
        "a stature of 17.5, in decimetres": (2, "17.5"),
        "a stature of 1750, in millimetres": (2, "1750"),
        "a length of -0.3": (3, "-0.3"),
        "a length of nan": (3, "nan"),
        "a length of 1e-300": (3, "1e-300"),
        "a length of 5 m": (4, "5"),
    }.items()
}


def _cell(data: bytes, k: int, value: str) -> bytes:
    """The second line with another k-th cell."""
    head, first, *rest = data.decode().splitlines()
    row = first.split(",")
    row[k] = value
    return "\n".join([head, ",".join(row), *rest, ""]).encode()


def header(change: Callable[[dict[str, Any]], Any]) -> Damage:
    """Weights with another header."""

    def damage(data: bytes) -> bytes:
        (n,) = struct.unpack("<Q", data[:8])
        new = change(json.loads(data[8 : 8 + n]))
        text = new if isinstance(new, bytes) else json.dumps(new).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + n :]

    return rewritten(damage)


def each_tensor(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Another entry for each tensor."""
    return lambda h: {k: v if k == "__metadata__" else change(v) for k, v in h.items()}


TENSORS: dict[str, Damage] = {
    "all tensors in one place": header(
        each_tensor(lambda t: {**t, "data_offsets": [0, t["data_offsets"][1] - t["data_offsets"][0]]})
    ),
    "tensors that end before they begin": header(each_tensor(lambda t: {**t, "data_offsets": t["data_offsets"][::-1]})),
    "tensors beyond the file": header(
        each_tensor(lambda t: {**t, "data_offsets": [x + 2**40 for x in t["data_offsets"]]})
    ),
    "tensors at -8": header(each_tensor(lambda t: {**t, "data_offsets": [x - 8 for x in t["data_offsets"]]})),
    "offsets of 0.5": header(each_tensor(lambda t: {**t, "data_offsets": [x + 0.5 for x in t["data_offsets"]]})),
    "shapes of -1": header(each_tensor(lambda t: {**t, "shape": [-1]})),
    "shapes of 2^62": header(each_tensor(lambda t: {**t, "shape": [2**62, 4]})),
    "shapes the other way round": header(each_tensor(lambda t: {**t, "shape": t["shape"][::-1]})),
    "shapes of no numbers": header(each_tensor(lambda t: {**t, "shape": []})),
    "types that nobody knows": header(each_tensor(lambda t: {**t, "dtype": "F128"})),
    "no types": header(each_tensor(lambda t: {k: v for k, v in t.items() if k != "dtype"})),
    "tensors that are lists": header(lambda h: {k: [] for k in h}),
    "a header that is a list": header(lambda h: [h]),
    "a header of brackets": header(lambda _: b"[" * 50_000),
    "a header with a key twice": header(lambda h: json.dumps(h)[:-1].encode() + b', "x": {}, "x": {}}'),
    "metadata of numbers": header(lambda h: {**h, "__metadata__": {"a": 1}}),
    "metadata with escapes": header(lambda h: {**h, "__metadata__": {"criteria": "\x1b]0;owned\x07"}}),
    "a tensor more": header(lambda h: {**h, "more": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}}),
    "a tensor less": header(lambda h: dict([*h.items()][:-1])),
}

# ---- what a sweep sees with, and lets go with

RIG = """name = "mine"
width = 64
height = 64
focal_px = 60.0
object_px = 64
hand_px = 64
[[cameras]]
name = "a"
position = [-0.1, 0.75, 0.8]
target = [0.4, 0.0, 0.2]
"""


def seen(path: Path) -> int:
    """Sweeps one trial a split with the rig."""
    os.chdir(path.parent)
    words = ["--benchmark", "r2h-v1", "--method", "contact", "--trials", "1", "--sim", "none", "--quiet"]
    return command(["sweep", *words, "--sees", path.name, "--out", "out"])


def rig(*changes: tuple[str, str]) -> Damage:
    """Another rig."""
    return cells(*changes)


RIGS: dict[str, Damage] = {
    "a camera that looks at itself": rig(("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.8]")),
    "a camera that looks straight down": rig(("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.0]")),
    "a camera in the table": rig(("[-0.1, 0.75, 0.8]", "[0.2, 0.0, -0.02]")),
    "a camera in the robot": rig(("[-0.1, 0.75, 0.8]", "[0.0, 0.0, 0.1]")),
    "a camera 1 km away": rig(("[-0.1, 0.75, 0.8]", "[1000.0, 0.0, 0.0]")),
    "a camera that looks away": rig(("[0.4, 0.0, 0.2]", "[-0.6, 1.5, 1.4]")),
    "a place of two numbers": rig(("[-0.1, 0.75, 0.8]", "[-0.1, 0.75]")),
    "a place of words": rig(("[-0.1, 0.75, 0.8]", '["a", "b", "c"]')),
    "images of 0 pixels": rig(("width = 64", "width = 0")),
    "images of one pixel": rig(("width = 64", "width = 1"), ("height = 64", "height = 1")),
    "images of 100,000 pixels a side": rig(("width = 64", "width = 100000"), ("height = 64", "height = 100000")),
    "images of -64 pixels": rig(("width = 64", "width = -64")),
    "images of 64.5 pixels": rig(("width = 64", "width = 64.5")),
    "a focal length of 0": rig(("60.0", "0.0")),
    "a focal length below 0": rig(("60.0", "-60.0")),
    "a focal length of 1e300": rig(("60.0", "1e300")),
    "a focal length of true": rig(("60.0", "true")),
    "two cameras of one name": rewritten(
        lambda d: d + b'[[cameras]]\nname = "a"\nposition = [0, 1, 1]\ntarget = [0, 0, 0]\n'
    ),
    "300 cameras": rewritten(
        lambda d: (
            d
            + b"".join(b'[[cameras]]\nname = "c%d"\nposition = [0, 1, 1]\ntarget = [0, 0, 0]\n' % k for k in range(300))
        )
    ),
    "no camera": rewritten(lambda d: d.partition(b"[[")[0]),
    "a name of an escape": rig(('"mine"', '"\\u001b[2J"')),
    "a name that leads out": rig(('"mine"', '"../../x"')),
}


def some_people(path: Path) -> None:
    """Two shipped people as a table."""
    people = built_in_people()
    head = ["sex", "age", *LENGTHS_M]
    rows = [
        ["male" if people.sex[k] == 0 else "female", people.age[k], *(people.lengths[n][k] for n in LENGTHS_M)]
        for k in range(2)
    ]
    path.write_text("\n".join(",".join(map(str, row)) for row in (head, *rows)) + "\n")


def weights(path: Path) -> None:
    """The shipped weights."""
    path.write_bytes((ROOT / "assets" / "ranker" / "ranker.safetensors").read_bytes())


def kinds() -> dict[str, Kind]:
    """The kinds of this file."""
    return {
        "reception": beside("reception", "received", "report", "RUN"),
        "answers to the draft": Kind(".npz", draft_answers, swept, ANSWERS),
        "trials for the draft": Kind(".npz", draft_trials, listed, MOMENTS),
        "progress.json": Kind(".json", of_run("progress.json"), resumed, {**JSON, **LEFT}),
        "results.json": Kind(".json", of_run("results.json"), resumed, JSON),
        "real table": Kind(".csv", lab_table, studied, {**CSV, **TABLE}),
        "lengths of people": Kind(".csv", some_people, read_people, PERSON),
        "tensors of weights": Kind(".safetensors", weights, read_weights, TENSORS),
        "rig of a sweep": Kind(".toml", lambda p: p.write_text(RIG), seen, RIGS),
    }
