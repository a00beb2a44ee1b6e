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
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import _attack_draft
import numpy as np
from _damage import (
    ANY,
    CSV,
    JSON,
    NPZ,
    PICKLE,
    SPARSE_BYTES,
    TOML,
    WEIGHTS,
    XML,
    YAML,
    Damage,
    Kind,
    claims,
    parquet,
    rewritten,
)
from _report import ROOT, arguments, made_by, markdown_table, page_from, resident_mib

from r2h_batch.__main__ import main as command
from r2h_batch.base.command_line import exit_code_of
from r2h_batch.data.grasp_files import read_file_of
from r2h_batch.data.hdf5 import read_datasets
from r2h_batch.data.people import read_people
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_srdf import read_srdf
from r2h_batch.data.safe_pickle import read_npy, read_pickle_file
from r2h_batch.methods.ranker.network import read_weights
from r2h_batch.observe.rig import load_rig
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
from r2h_batch.sweep.study.report import read_ratings
from r2h_batch.trials.predictions import load_answers

STORED, PAGE = ROOT / "bench" / "results" / "attacks.json", ROOT / "docs" / "results" / "attacks.md"
MEASURES = (
    "bench/attacks.py", "bench/_damage.py", "bench/_attack_draft.py", "r2h_batch/base/io", "r2h_batch/runs",
    "r2h_batch/protocols", "r2h_batch/data",
)  # fmt: skip
MOST_SECONDS, MOST_MIB = 60.0, 1024
WORKERS = 3
"""Kinds of files that are attacked side by side."""
PROGRESS = re.compile(r", \d+ s$")
"""A line that says for how long something has been going on."""

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
    """A folder with a small run."""
    folder = Path(tempfile.mkdtemp(prefix="attacks-"))
    os.chdir(folder)
    words = "--benchmark r2h-v1 --method random --trials 3 --sim none --out run"
    with redirect_stdout(io.StringIO()):
        sweep(words.split())
    (folder / "run" / "ids.csv").write_text("trial_id,id,variant\n0,a,x\n2,b,x\n4,c,x\n1,d,y\n3,e,y\n5,f,y\n")
    return folder


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
RATINGS = "participant,method,dimension,rating\np,a,comfort,1\np,b,comfort,5\nq,a,comfort,2\nq,b,comfort,4\n"
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
        "run.json": Kind(".json", of_run("run.json"), reported, JSON),
        "a method's file": Kind(".json", of_run("methods/random.json"), reported, JSON),
        "shard": Kind(".parquet", of_run(shard), reported, table),
        "ids.csv": Kind(".csv", of_run("ids.csv"), labelled, CSV),
        "grasps": Kind(".npz", some_grasps, read_grasps, NPZ),
        "hand": Kind(".npz", copied("people/hand.npz"), read_hand, NPZ),
        "hand set": Kind(".npz", copied("hand/handset.npz"), read_hand_set, NPZ),
        "weights": Kind(".safetensors", copied("ranker/ranker.safetensors"), read_weights, WEIGHTS),
        "people": Kind(".csv", _attack_draft.some_people, read_people, CSV),
        "study table": Kind(".csv", text(RATINGS), read_ratings, CSV),
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
        **_attack_draft.kinds(),
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
    said_of = words.strip().replace(f"{ROOT}/", "").replace(f"{place}/", "").replace(place, ".")
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
    _attack_draft.runs()
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
