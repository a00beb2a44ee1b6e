"""Things of strangers: benchmark files, meshes, robots, rigs, people, tables of studies, networks, checkpoints, HDF5."""

import json
import os
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _attack import TAG, Attack, Command, Place, small, solved
from _source import ROOT
from _strange_answers import BOX

# ---- benchmark files

ONE = ["--benchmark", "r2h-v1", "--method", "random", "--trials", "1", "--sim", "none", "--out", "run"]
CHECK = ["benchmark", "check", "mine.yaml"]
BASE = "protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: hammer}\n"


def benchmark(text: str | bytes, must: str = "refused", beside: Callable[[Place], object] = lambda p: None) -> Attack:
    """A benchmark file."""

    def does(place: Place) -> list[Command]:
        beside(place)
        data = text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass")
        (place.work / "mine.yaml").write_bytes(data.replace(b"CALL", place.call.encode()))
        return [CHECK]

    return Attack(does, must)


BENCHMARKS: dict[str, Attack] = {
    "a radius of 10^9 m": benchmark(BASE + "thresholds: {reach_radius_m: 1.0e9}\n"),
    "a radius of 0": benchmark(BASE + "thresholds: {reach_radius_m: 0}\n"),
    "a gripper of 1 km": benchmark(BASE + "thresholds: {w_max_m: 1000.0}\n"),
    "thresholds that cross": benchmark(BASE + "thresholds: {w_max_m: 0.001, w_min_m: 0.05}\n"),
    "a table of half sides below 0": benchmark(BASE + "table: {center: [0, 0, 0], half: [-1, -1, -1]}\n"),
    "a table of four numbers": benchmark(BASE + "table: {center: [0, 0, 0, 0], half: [1, 1, 1]}\n"),
    "a table around the robot": benchmark(BASE + "table: {center: [0, 0, 0.5], half: [1, 1, 0.5]}\n", "either"),
    "a home beyond the limits": benchmark(BASE + "home: [99, 0, 0, 0, 0, 0]\n"),
    "a home of 5 joints": benchmark(BASE + "home: [0, 0, 0, 0, 0]\n"),
    "no objects": benchmark("protocol: r2h-v1\nobjects: []\n", "either"),
    "an object twice": benchmark("protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: cup}\n"),
    "100,000 objects": benchmark(
        "protocol: r2h-v1\nobjects:\n" + "".join(f"- {{built_in: cup, name: c{k}}}\n" for k in range(100_000))
    ),
    "an object that is built in and a file": benchmark(BASE + "- {built_in: bowl, file: x.obj}\n"),
    "a file behind a link": benchmark(
        BASE + "hand_set: x.npz\n", beside=lambda p: (p.work / "x.npz").symlink_to(p.outside / "secret.txt")
    ),
    "a file in a folder behind a link": benchmark(
        BASE + "hand_set: x/secret.txt\n", beside=lambda p: (p.work / "x").symlink_to(p.outside)
    ),
    "a file of home": benchmark(BASE + "hand_set: ~/.ssh/id_rsa\n"),
    "a file of a variable": benchmark(BASE + "hand_set: $HOME/x.npz\n"),
    "a file with a NUL byte": benchmark(BASE + 'hand_set: "a\\0b"\n'),
    "itself as its people": benchmark(BASE + "people: mine.yaml\n"),
    "itself as an object": benchmark(BASE + "- {file: mine.yaml, name: x, split: S0}\n"),
    "a robot of code": benchmark(BASE + "robot: os:system\n"),
    "a robot out of the folder": benchmark(BASE + "robot: ../outside/folder\n"),
    "a protocol of code": benchmark("protocol: os:system\n"),
    "a tag of Python": benchmark(BASE + "people: !!python/object/new:os.system [CALL]\n"),
    "a tag of bytes": benchmark(BASE + "people: !!binary aGVsbG8=\n"),
    "a set": benchmark(BASE + "people: !!set {adults}\n"),
    "two documents": benchmark(BASE + "---\n" + BASE),
    "a key that is a list": benchmark(BASE + "? [a, b]\n: 1\n"),
    "a key that is true": benchmark(BASE + "yes: 1\n"),
    "a merge": benchmark(BASE + "<<: {robot: ur3e_2f85}\n"),
    "tabs": benchmark(BASE + "\trobot: ur3e_2f85\n"),
    "a mark of byte order": benchmark("\ufeff" + BASE, "either"),
    "UTF-32": benchmark(BASE.encode("utf-32")),
    "a date": benchmark(BASE + "people: 2026-01-01\n"),
    "16 MiB of one word": benchmark(BASE + "people: " + "x" * (16 << 20) + "\n"),
    "100,000 keys": benchmark(BASE + "".join(f"k{k}: 1\n" for k in range(100_000))),
    "an anchor that nobody uses": benchmark(BASE + "people: &a adults\n"),
    "a verb that is a list": benchmark(
        "protocol: r2h-v1\nobjects:\n- {built_in: cup, words: {names: [[]], parts: 3, verbs: x}}\n"
    ),
    "a mass of 10^300": benchmark("protocol: r2h-v1\nobjects:\n- {built_in: cup, mass: 1.0e+300}\n"),
    "a mass below 0": benchmark("protocol: r2h-v1\nobjects:\n- {built_in: cup, mass: -1}\n"),
    "an instruction that is a tag": benchmark(
        f"protocol: r2h-v1\nobjects:\n- {{built_in: cup, instruction: {json.dumps(TAG)}}}\n", "either"
    ),
    "a hand set of a million files": benchmark(BASE + "hand_set: [" + "x.npz, " * 1_000_000 + "]\n"),
    "a hand set with a step below 0": benchmark(BASE + "hand_set:\n- {file: x.npz, count: -5}\n"),
}

# ---- meshes


def mesh(
    name: str,
    data: bytes | Callable[[Path], object],
    must: str = "either",
    line: str = "",
    beside: Callable[[Place], object] = lambda p: None,
) -> Attack:
    """A mesh as the only object of a benchmark file."""

    def does(place: Place) -> list[Command]:
        beside(place)
        path = place.work / name
        path.write_bytes(data) if isinstance(data, bytes) else data(path)
        own = line or "split: S0"
        (place.work / "mine.yaml").write_text(f"protocol: r2h-v1\nobjects:\n- {{file: {name}, name: thing, {own}}}\n")
        return [CHECK]

    return Attack(does, must)


def faces_of(points: np.ndarray, faces: np.ndarray) -> bytes:
    """An OBJ of these."""
    return (
        "".join(f"v {x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in points)
        + "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    ).encode()


def boxes(count: int, step: float) -> bytes:
    """So many small boxes in a row."""
    one = np.array([[float(n) for n in x.split()[1:]] for x in BOX.splitlines() if x[0] == "v"]) / 20
    faces = np.array([[int(n) for n in x.split()[1:4]] for x in BOX.splitlines() if x[0] == "f"])
    more = np.array([[int(x.split()[k]) for k in (1, 3, 4)] for x in BOX.splitlines() if x[0] == "f"])
    F = np.r_[faces, more] - 1
    at = [[(k % 30) * step, (k // 30 % 30) * step, (k // 900) * step] for k in range(count)]
    return faces_of(np.concatenate([one + np.array(a) for a in at]), np.concatenate([F + 8 * k for k in range(count)]))


def stl_of(count: int, size: int) -> Callable[[Path], object]:
    """A binary STL that claims so many faces, as long as that without its bytes."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(bytes(80) + struct.pack("<I", count))
            file.truncate(size)

    return write


def glb_of(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
    """A binary glTF of a box with another head."""

    def write(path: Path) -> None:
        import trimesh

        data = trimesh.creation.box((0.06, 0.04, 0.08)).export(file_type="glb")
        size = struct.unpack("<I", data[12:16])[0]
        tree = json.loads(data[20 : 20 + size])
        change(tree)
        head = json.dumps(tree).encode()
        head += b" " * (-len(head) % 4)
        rest = data[20 + size :]
        body = struct.pack("<II", len(head), 0x4E4F534A) + head + rest
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)

    return write


def nested(depth: int, width: int) -> Callable[[dict[str, Any]], object]:
    """Nodes that show the mesh width^depth times."""

    def change(tree: dict[str, Any]) -> None:
        nodes: list[dict[str, Any]] = [{"mesh": 0}]
        for _ in range(depth):
            nodes.append({"children": [len(nodes) - 1] * width})
        tree["nodes"], tree["scenes"] = nodes, [{"nodes": [len(nodes) - 1]}]

    return change


def ply(form: str, points: int, faces: int, corners: str = "uchar int") -> bytes:
    """The head of a PLY."""
    axes = "".join(f"property float {k}\n" for k in "xyz")
    head = f"element vertex {points}\n{axes}element face {faces}\nproperty list {corners} vertex_indices\n"
    return f"ply\nformat {form}\n{head}end_header\n".encode()


def loop(tree: dict[str, Any]) -> None:
    """A node below itself."""
    tree["nodes"] = [{"mesh": 0, "children": [1]}, {"children": [0]}]
    tree["scenes"] = [{"nodes": [0]}]


MESHES: dict[str, Attack] = {
    "OBJ: as it is": mesh("a.obj", BOX.encode(), "read"),
    "OBJ: 10^5 faces at one edge": mesh(
        "a.obj",
        faces_of(
            np.random.default_rng(0).uniform(0, 0.1, (50_002, 3)), np.array([[0, 1, k] for k in range(2, 50_002)])
        ),
    ),
    "OBJ: 2,000 boxes apart": mesh("a.obj", boxes(2000, 0.006)),
    "OBJ: 500 boxes in one place": mesh("a.obj", boxes(500, 0.0)),
    "OBJ: a face of vertex 0": mesh("a.obj", BOX.encode() + b"f 0 1 2\n"),
    "OBJ: faces counted from the end": mesh("a.obj", BOX.encode() + b"f -1 -2 -99999\n", "refused"),
    "OBJ: one vertex at 1 km": mesh("a.obj", BOX.encode() + b"v 1000 0 0\nf 1 2 9\n"),
    "OBJ: flat": mesh("a.obj", BOX.replace("-0.04", "0.0").replace("0.04", "0.0").encode(), "refused"),
    "OBJ: inside out": mesh(
        "a.obj", "\n".join(x if x[:1] != "f" else "f " + " ".join(x.split()[:0:-1]) for x in BOX.splitlines()).encode()
    ),
    "OBJ: of 1 micrometre": mesh("a.obj", BOX.encode(), "refused", "split: S0, scale: 0.00001"),
    "OBJ: a scale of 0": mesh("a.obj", BOX.encode(), "refused", "split: S0, scale: 0"),
    "OBJ: a scale of -1": mesh("a.obj", BOX.encode(), "refused", "split: S0, scale: -1"),
    "OBJ: a scale of 1e300": mesh("a.obj", BOX.encode(), "refused", "split: S0, scale: 1.0e300"),
    "OBJ: groups of tags": mesh("a.obj", f"g {TAG}\n{BOX}".encode()),
    "OBJ: 20,000 groups": mesh(
        "a.obj", b"".join(b"g p%d\nf 1 2 4\n" % k for k in range(20_000)).join([BOX.encode(), b""])
    ),
    "OBJ: continued lines without end": mesh("a.obj", BOX.encode() + b"v 0 \\\n" * 200_000),
    "OBJ: a material that is a device": mesh("a.obj", b"mtllib /dev/zero\nusemtl x\n" + BOX.encode(), "either"),
    "OBJ: a picture beside the folder": mesh(
        "a.obj",
        b"mtllib a.mtl\nusemtl x\n" + BOX.encode(),
        "either",
        beside=lambda p: (p.work / "a.mtl").write_text("newmtl x\nmap_Kd ../outside/secret.txt\n"),
    ),
    "OBJ: curves and calls": mesh(
        "a.obj", b"call ../outside/secret.txt\ncsh -touch x\nload x\n" + BOX.encode(), "either"
    ),
    "OBJ: an STL's bytes": mesh("a.obj", stl_of(12, 684), "refused"),
    "OBJ: a region that is a program": mesh(
        "a.obj", BOX.encode(), "refused", "split: S1, receiver: \"__import__('os')\""
    ),
    "OBJ: a region of NaN": mesh("a.obj", BOX.encode(), "refused", "split: S1, receiver: 'z<nan'"),
    "OBJ: a region below everything": mesh("a.obj", BOX.encode(), "refused", "split: S1, receiver: 'z<-5'"),
    "OBJ: a region of all": mesh("a.obj", BOX.encode(), "either", "split: S1, receiver: 'z<9'"),
    "OBJ: a region in other digits": mesh("a.obj", BOX.encode(), "refused", "split: S1, receiver: 'z<0.\u0663'"),
    "OBJ: a region file of pickles": mesh(
        "a.obj",
        BOX.encode(),
        "refused",
        "split: S1, receiver: r.npy",
        lambda p: np.save(p.work / "r.npy", np.array([{"a": 1}], object), allow_pickle=True),
    ),
    "OBJ: a region file of boxes of NaN": mesh(
        "a.obj",
        BOX.encode(),
        "refused",
        "split: S1, receiver: r.npy",
        lambda p: np.save(p.work / "r.npy", np.full((2, 5, 3), np.nan)),
    ),
    "OBJ: a region file of 10^7 boxes": mesh(
        "a.obj",
        BOX.encode(),
        "refused",
        "split: S1, receiver: r.npy",
        lambda p: np.save(p.work / "r.npy", np.zeros((1_000_000, 5, 3))),
    ),
    "OBJ: a region file of faces of -1": mesh(
        "a.obj",
        BOX.encode(),
        "refused",
        "split: S1, receiver: r.npy",
        lambda p: np.save(p.work / "r.npy", np.array([-1, 2**40])),
    ),
    "OBJ: a region file beside the folder": mesh(
        "a.obj", BOX.encode(), "refused", "split: S1, receiver: ../outside/secret.txt"
    ),
    "STL: 10^8 faces without bytes": mesh("a.stl", stl_of(10**8, 84 + 50 * 10**8), "refused"),
    "STL: 2 million faces of nothing": mesh("a.stl", stl_of(2 * 10**6, 84 + 50 * 2 * 10**6), "refused"),
    "STL: text of 1 million facets": mesh(
        "a.stl",
        b"solid x\n"
        + b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n" * 300_000,
        "either",
    ),
    "PLY: 10^8 faces": mesh(
        "a.ply",
        ply("binary_little_endian 1.0", 3, 100_000_000) + bytes(36),
        "refused",
    ),
    "PLY: the other byte order": mesh(
        "a.ply",
        ply("binary_big_endian 1.0", 3, 1) + struct.pack("<9f", *range(9)) + b"\3" + struct.pack("<3i", 0, 1, 2),
        "refused",
    ),
    "PLY: corners as floats": mesh(
        "a.ply",
        ply("ascii 1.0", 3, 1, "float float") + b"0 0 0\n.05 0 0\n0 .05 0\n3 0 1 2\n",
        "refused",
    ),
    "PLY: a format of 9.9": mesh("a.ply", b"ply\nformat ascii 9.9\nelement vertex 1e9\nend_header\n", "refused"),
    "OFF: fewer numbers than it says": mesh("a.off", b"OFF\n8 12 0\n0 0 0\n", "refused"),
    "GLB: a node below itself": mesh("a.glb", glb_of(loop), "refused"),
    "GLB: 10^12 copies by nodes": mesh("a.glb", glb_of(nested(12, 10)), "refused"),
    "GLB: 5,000 nodes deep": mesh("a.glb", glb_of(nested(5000, 1))),
    "GLB: a scale of 1e30": mesh("a.glb", glb_of(lambda t: t["nodes"][0].update(scale=[1e30] * 3)), "refused"),
    "GLB: a matrix of NaN": mesh("a.glb", glb_of(lambda t: t["nodes"][0].update(matrix=["NaN"] * 16)), "refused"),
    "GLB: a buffer that is a file": mesh(
        "a.glb", glb_of(lambda t: t["buffers"][0].update(uri="../outside/secret.txt")), "either"
    ),
    "GLB: a picture that is a file": mesh(
        "a.glb", glb_of(lambda t: t.update(images=[{"uri": "file:///etc/passwd"}])), "either"
    ),
    "GLB: an accessor beyond its buffer": mesh(
        "a.glb", glb_of(lambda t: [a.update(count=10**9) for a in t["accessors"]]), "refused"
    ),
    "GLB: an offset below 0": mesh(
        "a.glb", glb_of(lambda t: [v.update(byteOffset=-4) for v in t["bufferViews"]]), "refused"
    ),
    "GLB: a sparse accessor": mesh(
        "a.glb",
        glb_of(
            lambda t: t["accessors"][0].update(
                sparse={
                    "count": 10**9,
                    "indices": {"bufferView": 9, "componentType": 5125},
                    "values": {"bufferView": 9},
                }
            )
        ),
        "either",
    ),
    "GLB: packed by Draco": mesh(
        "a.glb",
        glb_of(
            lambda t: t["meshes"][0]["primitives"][0].update(
                extensions={"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
            )
        ),
        "either",
    ),
    "a mesh that is a folder": mesh("a.obj", lambda p: p.mkdir(), "refused"),
}

# ---- robots


def arm(
    text: str,
    must: str = "refused",
    words: str = "--urdf a.urdf --base base --flange a --out arm",
    beside: Callable[[Place], object] = lambda p: None,
    name: str = "a.urdf",
) -> Attack:
    """A robot's file to import."""

    def does(place: Place) -> list[Command]:
        beside(place)
        (place.work / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        return [["import", "robot", *words.split()]]

    return Attack(does, must)


def chain(joint: str = "", link: str = "", joints: int = 6) -> str:
    """An arm of so many joints, with odd words in each."""
    inertia = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    body = '<collision><geometry><box size=".05 .05 .1"/></geometry></collision>'
    parts = ['<robot name="x"><link name="base"/>']
    before = "base"
    for k in range(joints):
        now = "a" if k == joints - 1 else f"l{k}"
        parts.append(f'<link name="{now}">{inertia}{link or body}</link>')
        own = joint or '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="1"/>'
        parts.append(
            f'<joint name="j{k}" type="revolute"><origin xyz="0 0 .15" rpy="{1.57 * (k % 2)} 0 0"/>'
            f'<parent link="{before}"/><child link="{now}"/>{own}</joint>'
        )
        before = now
    return "".join(parts) + "</robot>"


def of_mesh(file: str) -> str:
    """An arm whose links have this mesh."""
    return chain(link=f'<visual><geometry><mesh filename="{file}"/></geometry></visual>')


def stored_robot(
    change: Callable[[dict[str, Any]], object] | None = None, lines: Callable[[str], str] | None = None
) -> Attack:
    """A folder of a robot with other arrays or another text."""

    def does(place: Place) -> list[Command]:
        folder = Path(shutil.copytree(ROOT / "assets" / "robot" / "panda_hand", place.work / "mine"))
        if change:
            with np.load(folder / "robot.npz") as held:
                arrays = dict(held)
            change(arrays)
            with (folder / "robot.npz").open("wb") as file:
                np.savez(file, **arrays)
        if lines:
            path = folder / "robot.yaml"
            path.write_text(lines(path.read_text()))
        return [["sweep", "--robot", "mine", *ONE]]

    return Attack(does)


def mjcf(text: str, must: str = "refused", beside: Callable[[Place], object] = lambda p: None) -> Attack:
    """A robot in MuJoCo's XML."""
    return arm(f"<mujoco>{text}</mujoco>", must, "--mjcf a.xml --base base --flange a --out arm", beside, "a.xml")


def every_array(value: float) -> Callable[[dict[str, Any]], object]:
    """The number everywhere in the arrays of floats."""
    return lambda a: a.update({k: np.full_like(v, value) for k, v in a.items() if v.dtype.kind == "f"})


def no_bodies(arrays: dict[str, Any]) -> None:
    """A robot that meets nothing: its checked pairs are gone."""
    for k, v in arrays.items():
        if "pair" in k and v.ndim:
            arrays[k] = v[:0]


def meshes_elsewhere(place: Place) -> None:
    """A folder of meshes that is a link to one beside the working folder."""
    (place.outside / "folder" / "a.stl").write_bytes(BOX.encode())
    (place.work / "m").symlink_to(place.outside / "folder")


ROBOTS: dict[str, Attack] = {
    "URDF: XInclude": arm(
        chain().replace(
            "<link",
            '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="../outside/secret.txt" parse="text"/><link',
            1,
        )
    ),
    "URDF: a style sheet": arm('<?xml version="1.0"?><?xml-stylesheet href="file:///etc/passwd"?>' + chain(), "either"),
    "URDF: UTF-7": arm('<?xml version="1.0" encoding="utf-7"?>' + chain()),
    "URDF: a space of names": arm(chain().replace("<robot", '<robot xmlns="http://x"'), "either"),
    "URDF: parameters of entities": arm('<!DOCTYPE x [<!ENTITY % a SYSTEM "../outside/secret.txt">%a;]>' + chain()),
    "URDF: a program of xacro": arm(
        chain().replace("<link", '<xacro:macro name="x">${__import__("os")}</xacro:macro><link', 1), "either"
    ),
    "URDF: an axis of 0": arm(chain('<axis xyz="0 0 0"/><limit lower="-3" upper="3" effort="10" velocity="1"/>')),
    "URDF: an axis of NaN": arm(chain('<axis xyz="nan 0 0"/><limit lower="-3" upper="3" effort="10" velocity="1"/>')),
    "URDF: an axis of 1e200": arm(
        chain('<axis xyz="1e200 1e200 0"/><limit lower="-3" upper="3" effort="10" velocity="1"/>'), "either"
    ),
    "URDF: limits that cross": arm(chain('<axis xyz="0 0 1"/><limit lower="3" upper="-3" effort="10" velocity="1"/>')),
    "URDF: limits of nothing": arm(chain('<axis xyz="0 0 1"/><limit lower="0" upper="0" effort="10" velocity="1"/>')),
    "URDF: limits of 1e30": arm(
        chain('<axis xyz="0 0 1"/><limit lower="-1e30" upper="1e30" effort="1e30" velocity="1e30"/>'), "either"
    ),
    "URDF: a speed of 0": arm(chain('<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="0"/>')),
    "URDF: a speed below 0": arm(chain('<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="-1"/>')),
    "URDF: joints that mimic each other": arm(
        chain('<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="10" velocity="1"/><mimic joint="j0"/>')
    ),
    "URDF: 10,000 links": arm(chain(joints=10_000)),
    "URDF: a cylinder of -1 m": arm(
        chain(link='<collision><geometry><cylinder radius="-1" length="1"/></geometry></collision>')
    ),
    "URDF: a sphere of 1e30 m": arm(chain(link='<collision><geometry><sphere radius="1e30"/></geometry></collision>')),
    "URDF: a box of NaN": arm(chain(link='<collision><geometry><box size="nan nan nan"/></geometry></collision>')),
    "URDF: a mesh out of its folder": arm(of_mesh("../outside/secret.txt")),
    "URDF: a mesh of a package that leads out": arm(
        of_mesh("package://x/../../outside/secret.txt"),
        words="--urdf a.urdf --base base --flange a --out arm --package x=.",
    ),
    "URDF: a mesh of the net": arm(of_mesh("http://127.0.0.1:9/a.stl")),
    "URDF: a mesh that is a device": arm(of_mesh("file:///dev/zero")),
    "URDF: a mesh behind a link": arm(
        of_mesh("a.stl"), beside=lambda p: (p.work / "a.stl").symlink_to(p.outside / "secret.txt")
    ),
    "URDF: a mesh behind a linked folder": arm(
        of_mesh("m/a.stl"),
        beside=meshes_elsewhere,
    ),
    "URDF: a mesh of 10^8 faces without bytes": arm(
        of_mesh("a.stl"), beside=lambda p: stl_of(10**8, 84 + 50 * 10**8)(p.work / "a.stl")
    ),
    "URDF: a scale of 1e300": arm(
        of_mesh('a.obj" scale="1e300 1e300 1e300'), beside=lambda p: (p.work / "a.obj").write_text(BOX)
    ),
    "URDF: names that are tags": arm(chain().replace('"l1"', '"&lt;img src=x onerror=owned()&gt;"'), "either"),
    "URDF: names with escapes": arm(chain().replace('"l1"', '"a\x85\u202eb"'), "either"),
    "URDF: a flange that is a path": arm(
        chain(), words="--urdf a.urdf --base base --flange ../../outside/folder --out arm"
    ),
    "import: a package that leads out": arm(
        chain(), words="--from ../../outside:secret.txt --base base --flange a --out arm"
    ),
    "import: a file that leads out of its package": arm(
        chain(), words="--from numpy:../../../../../../etc/passwd --base base --flange a --out arm"
    ),
    "import: a package of Python's own": arm(chain(), words="--from os:system --base base --flange a --out arm"),
    "MJCF: an include that leads out": mjcf('<include file="../outside/secret.txt"/>'),
    "MJCF: an include of itself": mjcf('<include file="a.xml"/>'),
    "MJCF: a folder of meshes that leads out": mjcf(
        '<compiler meshdir="../outside"/><asset><mesh name="m" file="secret.txt"/></asset>'
    ),
    "MJCF: a plugin": mjcf('<extension><plugin plugin="mujoco.sdf.bolt"/></extension>'),
    "MJCF: a replicate of 10^9": mjcf(
        '<worldbody><replicate count="1000000000"><body name="base"><geom size="1"/></body></replicate></worldbody>'
    ),
    "MJCF: a field of heights of 10^5 squared": mjcf(
        '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>'
    ),
    "MJCF: a texture of 10^5 squared": mjcf(
        '<asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>'
    ),
    "MJCF: a flexible thing of 10^9": mjcf(
        '<worldbody><flexcomp name="f" type="grid" count="1000 1000 1000" dim="3"/></worldbody>'
    ),
    "MJCF: a model to attach": mjcf(
        '<asset><model name="m" file="../outside/secret.txt"/></asset>'
        '<worldbody><attach model="m" body="x" prefix="p"/></worldbody>'
    ),
    "MJCF: a composite of 10^6": mjcf(
        '<worldbody><body name="base"><composite type="cable" count="1000000 1 1" prefix="a">'
        '<geom size="1"/></composite></body></worldbody>'
    ),
    "MJCF: 3,000 bodies deep": mjcf(
        "<worldbody>"
        + "".join(f'<body name="b{k}"><geom size=".1"/>' for k in range(3000))
        + "</body>" * 3000
        + "</worldbody>"
    ),
    "MJCF: memory of 1 TB": mjcf(
        '<size memory="1000G"/><worldbody><body name="base"><geom size=".1"/></body></worldbody>'
    ),
    "robot.npz: NaN everywhere": stored_robot(every_array(float("nan"))),
    "robot.npz: zeros everywhere": stored_robot(every_array(0.0)),
    "robot.npz: 1e30 everywhere": stored_robot(every_array(1e30)),
    "robot.npz: no pairs are checked": stored_robot(no_bodies),
    "robot.yaml: limits that cross": stored_robot(lines=lambda t: t.replace("-", "")),
    "robot.yaml: a speed of 10^9": stored_robot(lines=lambda t: t + "\nspeed: 1000000000\n"),
}

# ---- rigs

RIG = """name = "mine"
width = 320
height = 240
focal_px = 300.0
object_px = 64
hand_px = 32
[[cameras]]
name = "a"
position = [-0.1, 0.75, 0.8]
target = [0.4, 0.0, 0.2]
"""


def rig(change: Callable[[str], str], must: str = "refused") -> Attack:
    """A rig file, looked through."""

    def does(place: Place) -> list[Command]:
        small(place)
        (place.work / "rig.toml").write_text(change(RIG))
        return [["view", "run", "--trial", "0", "--sees", "seen.png", "--rig", "rig.toml"]]

    return Attack(does, must)


CAMERA = RIG[RIG.index("[[") :]
RIGS: dict[str, Attack] = {
    "as it is": rig(lambda t: t, "read"),
    "no camera": rig(lambda t: t[: t.index("[[")]),
    "nine cameras": rig(lambda t: t + CAMERA * 8),
    "two cameras of one name": rig(lambda t: t + CAMERA),
    "10^9 pixels wide": rig(lambda t: t.replace("320", "1000000000")),
    "a window of 10^6": rig(lambda t: t.replace("object_px = 64", "object_px = 1000000")),
    "a focal length of 0": rig(lambda t: t.replace("300.0", "0.0")),
    "a focal length of 1e-300": rig(lambda t: t.replace("300.0", "1e-300")),
    "a focal length below 0": rig(lambda t: t.replace("300.0", "-300.0")),
    "it looks at itself": rig(lambda t: t.replace("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.8]")),
    "it looks straight down": rig(lambda t: t.replace("[0.4, 0.0, 0.2]", "[-0.1, 0.75, 0.0]"), "either"),
    "it stands in the robot": rig(lambda t: t.replace("[-0.1, 0.75, 0.8]", "[0.0, 0.0, 0.1]")),
    "it stands 1e30 m away": rig(lambda t: t.replace("[-0.1, 0.75, 0.8]", "[1e30, 0.0, 0.0]")),
    "it looks away": rig(lambda t: t.replace("[0.4, 0.0, 0.2]", "[-0.1, 9.75, 0.8]")),
    "infinity": rig(lambda t: t.replace("0.75", "inf")),
    "whole numbers as truth": rig(lambda t: t.replace("320", "true")),
    "a whole number of 70 bits": rig(lambda t: t.replace("320", str(2**70))),
    "a date": rig(lambda t: t.replace("320", "1979-05-27T07:32:00Z")),
    "a name that is a tag": rig(lambda t: t.replace('"mine"', json.dumps(TAG)), "either"),
    "a name with escapes": rig(lambda t: t.replace('"mine"', '"a\\u001b[2J"'), "either"),
    "errors below 0": rig(lambda t: t.replace("[[", "[sensor]\nlost = -1.0\n[[", 1)),
    "errors of 2": rig(lambda t: t.replace("[[", "[sensor]\nedge_lost = 2.0\n[[", 1)),
    "errors of 1e300": rig(lambda t: t.replace("[[", "[sensor]\ncalibration_m = 1e300\n[[", 1)),
    "a step of 0": rig(lambda t: t.replace("[[", "[sensor]\nstep_m = 0.0\n[[", 1)),
    "10,000 tables deep": rig(lambda t: t + "[" + ".".join(["a"] * 10_000) + "]\n"),
    "10,000 dotted keys": rig(lambda t: ".".join(["a"] * 10_000) + " = 1\n" + t),
    "a key with an escape": rig(lambda t: '"wid\\u0074h" = 5\n' + t),
}

# ---- tables of people and of studies


def table(
    name: str,
    change: Callable[[str], str | bytes],
    base: Callable[[Place], str],
    command: Sequence[str],
    must: str = "refused",
) -> Attack:
    """A table with other text."""

    def does(place: Place) -> list[Command]:
        new = change(base(place))
        (place.work / name).write_bytes(new if isinstance(new, bytes) else new.encode("utf-8", "surrogatepass"))
        return [command]

    return Attack(does, must)


def crowd(place: Place) -> str:
    """Two shipped people as a table."""
    from r2h_batch.data.people import LENGTHS_M, built_in_people

    people = built_in_people()
    rows: list[list[str]] = [["sex", "age", *LENGTHS_M]]
    for k in range(2):
        lengths = [f"{float(people.lengths[n][k]):.4f}" for n in LENGTHS_M]
        rows.append(["female" if people.sex[k] else "male", f"{float(people.age[k]):.1f}", *lengths])
    return "\n".join(",".join(row) for row in rows) + "\n"


def person(change: Callable[[str], str | bytes], must: str = "refused") -> Attack:
    """A table of people."""
    return table("p.csv", change, crowd, ["import", "people", "p.csv"], must)


def cell(row: int, column: int, value: str) -> Callable[[str], str]:
    """Another text in one cell."""

    def change(text: str) -> str:
        rows = [r.split(",") for r in text.splitlines()]
        rows[row][column] = value
        return "\n".join(",".join(r) for r in rows) + "\n"

    return change


PEOPLE: dict[str, Attack] = {
    "as it is": person(lambda t: t, "read"),
    "a column twice": person(lambda t: "\n".join(r + "," + r.split(",")[2] for r in t.splitlines()) + "\n"),
    "a column in capitals": person(lambda t: t.replace("stature", "STATURE")),
    "a stature of 1e308": person(cell(1, 2, "1e308")),
    "a stature in other digits": person(cell(1, 2, "\u0661.\u0667")),
    "a stature with an underline": person(cell(1, 2, "1_7")),
    "a stature in feet": person(cell(1, 2, "5'11\"")),
    "a stature with a decimal comma": person(cell(1, 2, '"1,75"')),
    "a stature of infinity": person(cell(1, 2, "inf")),
    "an age of -3": person(cell(1, 1, "-3")),
    "an age of NaN": person(cell(1, 1, "nan")),
    "an age of 200": person(cell(1, 1, "200")),
    "a sex in capitals": person(cell(1, 0, "MALE"), "either"),
    "a sex that is a formula": person(cell(1, 0, "=1+1")),
    "a sex with an escape": person(cell(1, 0, "\x1b[2J")),
    "semicolons": person(lambda t: t.replace(",", ";")),
    "Latin-1": person(lambda t: t.replace("male", "m\u00e4le").encode("latin-1")),
    "a row of blanks": person(lambda t: t + "," * (t.splitlines()[0].count(",")) + "\n"),
    "300,000 people": person(lambda t: t + t.splitlines()[1].join(["", "\n"]) * 300_000, "either"),
}


def real(change: Callable[[str], str | bytes], must: str = "refused") -> Attack:
    """Outcomes of a real robot."""
    text = "trial_id,method,outcome,failed_criterion,seconds\n" + "".join(
        f"{k},{m},success,,5\n" for m in ("oracle", "random") for k in range(4)
    )
    return table("o.csv", change, lambda p: (solved(p), text)[1], ["study", "real", "run", "o.csv"], must)


STUDIES: dict[str, Attack] = {
    "as it is": real(lambda t: t, "read"),
    "a trial twice": real(lambda t: t + "0,oracle,failure,plan,5\n"),
    "a trial that nobody ran": real(lambda t: t + "99,oracle,failure,plan,5\n"),
    "a method that nobody ran": real(lambda t: t + "0,=1+1,failure,plan,5\n"),
    "an id of 1.0": real(lambda t: t.replace("\n1,", "\n1.0,"), "either"),
    "an id in other digits": real(lambda t: t.replace("\n1,", "\n\u0661,")),
    "an id with an underline": real(lambda t: t.replace("\n1,", "\n0_1,")),
    "an id of +1": real(lambda t: t.replace("\n1,", "\n+1,"), "either"),
    "an id of 5,000 digits": real(lambda t: t.replace("\n1,", "\n" + "1" * 5000 + ",")),
    "an outcome in capitals": real(lambda t: t.replace("success", "SUCCESS", 1), "either"),
    "an outcome of 1": real(lambda t: t.replace("success", "1", 1)),
    "a success that failed at Plan": real(lambda t: t.replace("success,,", "success,plan,", 1)),
    "a failure at nothing": real(lambda t: t.replace("success,,", "failure,luck,", 1)),
    "-5 seconds": real(lambda t: t.replace(",5\n", ",-5\n", 1)),
    "NaN seconds": real(lambda t: t.replace(",5\n", ",nan\n", 1)),
    "1e300 seconds": real(lambda t: t.replace(",5\n", ",1e300\n", 1)),
    "seconds of other digits": real(lambda t: t.replace(",5\n", ",\u0665\n", 1)),
    "a mark of byte order": real(lambda t: "\ufeff" + t, "either"),
    "a header alone": real(lambda t: t.splitlines()[0] + "\n"),
    "no outcome at all": real(lambda t: t.replace("success", "")),
    "a column of a tag": real(lambda t: t.replace("seconds", TAG)),
    "200,000 rows of one trial": real(lambda t: t + "0,oracle,success,,5\n" * 200_000),
    "both kinds of table": real(lambda t: t.replace("seconds", "real_sr")),
}

# ---- networks, checkpoints, HDF5


def weights(change: Callable[[dict[str, Any], bytearray], object], must: str = "refused") -> Attack:
    """Weights of the ranker with another head."""

    def does(place: Place) -> list[Command]:
        data = (ROOT / "assets" / "ranker" / "ranker.safetensors").read_bytes()
        size = struct.unpack("<Q", data[:8])[0]
        head, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
        change(head, body)
        new = json.dumps(head).encode()
        (place.work / "w.safetensors").write_bytes(struct.pack("<Q", len(new)) + new + bytes(body))
        return [
            ["sweep", "--benchmark", "r2h-v1", "--method", "learned,weights=w.safetensors", *ONE[4:]],
            ["report", "run", "--format", "html", "--out", "told.html"],
        ]

    return Attack(does, must)


def tensors(head: dict[str, Any]) -> list[str]:
    """Names of the arrays in a head."""
    return [k for k in head if k != "__metadata__"]


def filled(pattern: bytes) -> Callable[[dict[str, Any], bytearray], object]:
    """Every number with these bytes."""
    return lambda h, b: b.__setitem__(slice(None), pattern * (len(b) // len(pattern)))


WEIGHTS: dict[str, Attack] = {
    "arrays that overlap": weights(
        lambda h, b: [h[k].update(data_offsets=h[tensors(h)[0]]["data_offsets"]) for k in tensors(h)]
    ),
    "an array beyond the file": weights(lambda h, b: h[tensors(h)[0]].update(data_offsets=[0, 10**15])),
    "an array that ends before it begins": weights(lambda h, b: h[tensors(h)[0]].update(data_offsets=[400, 0])),
    "a shape of -1": weights(lambda h, b: h[tensors(h)[0]].update(shape=[-1, -1])),
    "a shape of 2^40": weights(lambda h, b: h[tensors(h)[0]].update(shape=[2**40, 2**40])),
    "a type that nobody knows": weights(lambda h, b: h[tensors(h)[0]].update(dtype="X99")),
    "an array that nobody asked for": weights(
        lambda h, b: (
            h.update(x={"dtype": "F32", "shape": [1], "data_offsets": [len(b), len(b) + 4]}),
            b.__iadd__(bytes(4)),
        )
    ),
    "numbers of 3e38": weights(filled(struct.pack("<f", 3e38)), "either"),
    "numbers of infinity": weights(filled(struct.pack("<f", float("inf")))),
    "zeros": weights(filled(bytes(4)), "either"),
    "words that are no text": weights(lambda h, b: h.update(__metadata__={"x": 1})),
    "words that are tags": weights(
        lambda h, b: h.update(__metadata__=dict.fromkeys(h.get("__metadata__") or {"trained_on": ""}, TAG)), "either"
    ),
    "100,000 arrays": weights(
        lambda h, b: h.update(
            {f"x{k}": {"dtype": "F32", "shape": [0], "data_offsets": [len(b), len(b)]} for k in range(100_000)}
        )
    ),
}


def checkpoint(make: Callable[[Path, Place], object], must: str = "either") -> Attack:
    """A folder of `train` with a stranger's files, trained on."""

    def does(place: Place) -> list[Command]:
        (place.work / "rank").mkdir()
        for name in ("checkpoint.pt", "checkpoint.safetensors", "labels.npz", "rank.safetensors", "checkpoint.npz"):
            make(place.work / "rank" / name, place)
        quick = ["--out", "rank", "--items", "1", "--steps", "1", "--rounds", "0"]
        return [["train", "rank", *quick, "--families", "cup x 1 seed 5"]]

    return Attack(does, must)


class Call:
    """Calls when it is unpickled."""

    def __init__(self, code: str) -> None:
        self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        return eval, (self.code,)


def pickled(path: Path, place: Place) -> None:
    """A pickle that leaves a file."""
    import pickle

    path.write_bytes(pickle.dumps(Call(place.call)))


CHECKPOINTS: dict[str, Attack] = {
    "pickles that call": checkpoint(pickled),
    "random bytes": checkpoint(lambda f, p: f.write_bytes(np.random.default_rng(0).bytes(5000))),
    "links to a file beside them": checkpoint(lambda f, p: f.symlink_to(p.outside / "victim.txt")),
    "folders": checkpoint(lambda f, p: f.mkdir()),
    "pipes": checkpoint(lambda f, p: os.mkfifo(f)),
}


def h5(write: Callable[[Any, Place], object], must: str = "refused") -> Attack:
    """Grasps of ACRONYM in an HDF5 file."""

    def does(place: Place) -> list[Command]:
        import h5py

        T = np.tile(np.eye(4), (5, 1, 1))
        with h5py.File(place.outside / "folder" / "other.h5", "w") as other:
            other["grasps/transforms"], other["grasps/qualities/flex/object_in_gripper"] = T, np.ones(5)
        with h5py.File(place.work / "g.h5", "w") as file:
            write(file, place)
            if "grasps/qualities/flex/object_in_gripper" not in file:
                file["grasps/qualities/flex/object_in_gripper"] = np.ones(5, int)
        return [["import", "grasps", "g.h5", "--from", "acronym", "--out", "g.npz"]]

    return Attack(does, must)


NAME = "grasps/transforms"


def _layout(file: Any, place: Place) -> None:
    import h5py

    layout = h5py.VirtualLayout((5, 4, 4), "f8")
    layout[:] = h5py.VirtualSource(place.outside / "folder" / "other.h5", NAME, (5, 4, 4))
    file.create_virtual_dataset(NAME, layout)


def _link(file: Any, place: Place) -> None:
    import h5py

    file[NAME] = h5py.ExternalLink(str(place.outside / "folder" / "other.h5"), NAME)


def _loop(file: Any, place: Place) -> None:
    import h5py

    file["grasps/transforms"] = h5py.SoftLink("/grasps/a")
    file["grasps/a"] = h5py.SoftLink("/grasps/transforms")


HDF5: dict[str, Attack] = {
    "a link to another file": h5(_link),
    "another file's bytes as its own": h5(
        lambda f, p: f.create_dataset(NAME, (5, 4, 4), "f8", external=[(str(p.outside / "secret.txt"), 0, 640)])
    ),
    "a dataset of another file's": h5(_layout),
    "links in a circle": h5(_loop),
    "10^12 numbers by a filling": h5(
        lambda f, p: f.create_dataset(NAME, (10**10, 4, 4), "f8", chunks=(1024, 4, 4), fillvalue=1.0)
    ),
    "1 GiB of zeros, deflated": h5(
        lambda f, p: f.create_dataset(
            NAME, data=np.zeros((2_000_000, 4, 4), np.float32), compression="gzip", chunks=(100_000, 4, 4)
        ),
        "either",
    ),
    "a filter that nobody has": h5(lambda f, p: _filter(f)),
    "texts in place of numbers": h5(lambda f, p: f.create_dataset(NAME, data=[["x" * 1000] * 16] * 5)),
    "records": h5(lambda f, p: f.create_dataset(NAME, data=np.zeros(5, [("a", "f4"), ("b", "i8")]))),
    "complex numbers": h5(lambda f, p: f.create_dataset(NAME, data=np.zeros((5, 4, 4), complex))),
    "big-endian halves": h5(
        lambda f, p: f.create_dataset(NAME, data=np.tile(np.eye(4), (5, 1, 1)).astype(">f2")), "either"
    ),
    "a group in place of numbers": h5(lambda f, p: f.create_group(NAME)),
    "100,000 groups beside it": h5(
        lambda f, p: (
            [f.create_group(f"x/{k}") for k in range(20_000)],
            f.create_dataset(NAME, data=np.tile(np.eye(4), (5, 1, 1))),
        ),
        "either",
    ),
}


def _filter(file: Any) -> None:
    import h5py

    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((5, 4, 4))
    plist.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, ())
    group = file.require_group("grasps")
    h5py.h5d.create(group.id, b"transforms", h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple((5, 4, 4)), plist)


KINDS = {
    "benchmark files": BENCHMARKS,
    "meshes": MESHES,
    "robots": ROBOTS,
    "rigs": RIGS,
    "tables of people": PEOPLE,
    "tables of a real robot": STUDIES,
    "weights": WEIGHTS,
    "checkpoints": CHECKPOINTS,
    "HDF5 files": HDF5,
}
