"""Every kind of file that the program reads: how a sound one is made, and how a command reads it.

Each is damaged by tests/test_damaged_files.py in the ways of its format (tests/support/damage.py).
"""

import json
import pickle
import struct
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import made_runs
import numpy as np
from damage import (
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

from r2h_batch.__main__ import main as command
from r2h_batch.data.grasp_files import read_file_of
from r2h_batch.data.hdf5 import read_datasets
from r2h_batch.data.people import LENGTHS_M, built_in_people, read_people
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_srdf import read_srdf
from r2h_batch.data.safe_pickle import read_npy, read_pickle_file
from r2h_batch.methods.ranker.network import read_weights
from r2h_batch.observe.rig import load_rig
from r2h_batch.runs.files import sha256_of
from r2h_batch.runs.store import load_run
from r2h_batch.scene.grasp_set import read_grasps
from r2h_batch.scene.hand_file import read_hand, read_hand_set
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.robot_file import read_robot
from r2h_batch.sweep.options import load_config
from r2h_batch.sweep.study.report import read_ratings
from r2h_batch.trials.load import load_benchmark
from r2h_batch.trials.predictions import load_answers
from r2h_batch.trials.trials_file import read_trials_file

ROOT = Path(__file__).resolve().parents[2]

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
    return Kind(ending, lambda p: p.write_bytes(data), lambda p: load_mesh_file(p, "damaged"), own)


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
    lambda p: load_mesh_file(p, "damaged"),
    {
        "a length of 2^32 - 1": rewritten(lambda d: d[:8] + b"\xff" * 4 + d[12:]),
        "a chunk of 2^32 - 1": rewritten(lambda d: d[:12] + b"\xff" * 4 + d[16:]),
        "a buffer that is a file": rewritten(lambda d: d.replace(b'"byteLength"', b'"uri":"/x"  ')),
        "10^9 corners": rewritten(lambda d: d.replace(b'"count":3', b'"count":9')),
    },
)

# ---- parts of a run


def of_run(name: str) -> Callable[[Path], object]:
    """A file of a run in the place of the damaged one; the run stands beside it."""

    def make(path: Path) -> None:
        run = path.parent / "run"
        made_runs.write(run)
        (run / "ids.csv").write_text("trial_id,id,variant\n0,a,x\n2,b,x\n4,c,x\n1,d,y\n3,e,y\n5,f,y\n")
        (found,) = run.glob(name)
        found.rename(path)
        (path.parent / "own").write_text(str(found))  # where its reader looks for it

    return make


def put_back(path: Path) -> Path:
    """The run with the damaged file in the place of its own. A shard's name has the digest of what it holds now."""
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


# ---- files of users


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


# ---- a laboratory's table, people, tensors, cameras: numbers that are none of theirs


def lab_table(path: Path) -> None:
    """The table of `export real`, filled in; its run beside it."""
    made_runs.write(path.parent / "run")
    rows = [(x, "m", "success", "", 4.5) for x in range(4)]
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
    "a method that is not there": cells((",m,", ",nobody,")),
    "a method that looks the same": cells((",m,", ",\u043er\u0430\u0441le,")),
    "a method of a formula": cells((",m,", ",=cmd|' /C calc'!A0,")),
    "a method of a tag": cells((",m,", ",<img src=x onerror=alert(1)>,")),
    "no outcome at all": cells(("success", "")),
    "columns in another order": rewritten(lambda d: b"\n".join(b",".join(x.split(b",")[::-1]) for x in d.split(b"\n"))),
    "a column twice": cells(("seconds", "seconds,seconds"), ("4.5", "4.5,9")),
    "half a surrogate": cells((",m,", ",orac\ud800le,")),
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

RIGS: dict[str, Damage] = {
    "a camera that looks at itself": cells(("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.8]")),
    "a camera that looks straight down": cells(("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.0]")),
    "a camera in the table": cells(("[-0.1, 0.75, 0.8]", "[0.2, 0.0, -0.02]")),
    "a camera in the robot": cells(("[-0.1, 0.75, 0.8]", "[0.0, 0.0, 0.1]")),
    "a camera 1 km away": cells(("[-0.1, 0.75, 0.8]", "[1000.0, 0.0, 0.0]")),
    "a camera that looks away": cells(("[0.4, 0.0, 0.2]", "[-0.6, 1.5, 1.4]")),
    "a place of two numbers": cells(("[-0.1, 0.75, 0.8]", "[-0.1, 0.75]")),
    "a place of words": cells(("[-0.1, 0.75, 0.8]", '["a", "b", "c"]')),
    "images of 0 pixels": cells(("width = 320", "width = 0")),
    "images of one pixel": cells(("width = 320", "width = 1"), ("height = 240", "height = 1")),
    "images of 100,000 pixels a side": cells(("width = 320", "width = 100000"), ("height = 240", "height = 100000")),
    "images of -64 pixels": cells(("width = 320", "width = -64")),
    "images of 64.5 pixels": cells(("width = 320", "width = 320.5")),
    "a focal length of 0": cells(("300.0", "0.0")),
    "a focal length below 0": cells(("300.0", "-300.0")),
    "a focal length of 1e300": cells(("300.0", "1e300")),
    "a focal length of true": cells(("300.0", "true")),
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
    "a name of an escape": cells(('"mine"', '"\\u001b[2J"')),
    "a name that leads out": cells(('"mine"', '"../../x"')),
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


def kinds() -> dict[str, Kind]:
    """Name -> kind of file."""
    table = parquet()
    shard = "shards/m/*.parquet"
    return {
        "predictions .npz": Kind(".npz", some_answers, load_answers, NPZ),
        "predictions .json": Kind(".json", some_answers, load_answers, JSON),
        "predictions .csv": Kind(".csv", some_answers, load_answers, CSV),
        "predictions .parquet": Kind(".parquet", some_answers, load_answers, table),
        "trials .npz": Kind(".npz", some_trials, listed, NPZ),
        "trials .json": Kind(".json", some_trials, listed, JSON),
        "benchmark.yaml": Kind(".yaml", text(YAML_FILE), lambda p: command(["ls", "benchmark", str(p)]), YAML),
        "sweep's --config": Kind(".yaml", text(CONFIG), load_config, YAML),
        "run.json": Kind(".json", of_run("run.json"), reported, JSON),
        "a method's file": Kind(".json", of_run("methods/m.json"), reported, JSON),
        "shard": Kind(".parquet", of_run(shard), reported, table),
        "ids.csv": Kind(".csv", of_run("ids.csv"), labelled, CSV),
        "grasps": Kind(".npz", some_grasps, read_grasps, NPZ),
        "hand": Kind(".npz", copied("people/hand.npz"), read_hand, NPZ),
        "hand set": Kind(".npz", copied("hand/handset.npz"), read_hand_set, NPZ),
        "weights": Kind(".safetensors", copied("ranker/ranker.safetensors"), read_weights, {**WEIGHTS, **TENSORS}),
        "people": Kind(".csv", some_people, read_people, {**CSV, **PERSON}),
        "study table": Kind(".csv", text(RATINGS), read_ratings, CSV),
        "rig": Kind(".toml", text(RIG), load_rig, {**TOML, **RIGS}),
        "URDF": Kind(".urdf", text(URDF), read_model, XML),
        "SRDF": Kind(".srdf", text(SRDF), read_srdf, XML),
        "robot.npz": Kind(".npz", robot, robot_read, NPZ),
        "robot.yaml": Kind(".yaml", robot, robot_read, YAML),
        "pickle": Kind(".pkl", lambda p: p.write_bytes(pickle.dumps({"a": 1}, 2)), read_pickle_file, PICKLE),
        ".npy": Kind(".npy", lambda p: p.write_bytes(claims("(8,)")), read_npy, {}),
        "HDF5": Kind(".h5", hdf5, lambda p: read_datasets(p, {"grasps/transforms": 1 << 20}), {}),
        "grasps of Isaac": Kind(".yaml", text(ISAAC), lambda p: read_file_of("isaac", p, "acronym-panda"), YAML),
        **MESHES,
        "real table": Kind(".csv", lab_table, studied, {**CSV, **TABLE}),
    }
