"""Answers of strangers: files of predictions, of motions and of trials."""

import json
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from _attack import SHORT_SWEEP, Attack, Command, Ended, Place, swept

SWEEP = [*SHORT_SWEEP, "--predictions", "mine.npz", "--out", "run"]
BOX = "".join(f"v {x} {y} {z}\n" for x in (-0.03, 0.03) for y in (-0.02, 0.02) for z in (-0.04, 0.04)) + "".join(
    f"f {f}\n" for f in ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
)


def solutions() -> Path:
    """A run of the oracle on six trials of r2h-v1: all succeed, so that a damaged answer that passes is seen."""
    return swept("solutions", "--benchmark r2h-v1 --method oracle --trials 3")


@cache
def poses() -> dict[str, Any]:
    """Answers to six trials of r2h-v1."""
    import pyarrow.parquet as pq

    (shard,) = (solutions() / "shards" / "oracle").glob("*.parquet")
    rows = [{**r, **r["poses"]} for r in pq.read_table(shard, columns=["trial_id", "poses"]).to_pylist()]
    return {
        "trial_id": np.array([r["trial_id"] for r in rows]),
        "T_obj_ee": np.array([r["T_obj_ee"] for r in rows], np.float32).reshape(-1, 4, 4),
        "T_world_ee": np.array([r["T_world_ee"] for r in rows], np.float32).reshape(-1, 4, 4),
    }


def write_npz(path: Path, **changed: Any) -> None:
    """A file of answers with other arrays; None leaves one out."""
    arrays = {k: v for k, v in {**poses(), **changed}.items() if v is not None}
    with path.open("wb") as file:
        np.savez(file, **arrays)


def digest(place: Place, name: str = "run") -> str:
    """Digest of the only method's rows of a run."""
    from r2h_batch.runs import load_run

    run = load_run(place.work / name)
    (method,) = run.methods
    return run.digest(method)


@cache
def expected() -> str:
    """Digest of the sound answers' rows."""
    from r2h_batch.runs import load_run

    return load_run(solutions()).digest("oracle")


def same(place: Place, ended: Ended) -> str:
    """The rows are those of the sound answers."""
    return "" if ended.how == "refused" or digest(place) == expected() else "other rows"


def nothing_passed(place: Place, ended: Ended) -> str:
    """No row of the run is a success."""
    import pyarrow.parquet as pq

    if ended.how == "refused":
        return ""
    files = [*(place.work / "run" / "shards").rglob("*.parquet")]
    won = [o for f in files for o in pq.read_table(f, columns=["outcome"])["outcome"].to_pylist() if o == "success"]
    return f"{len(won)} successes" if won or not files else ""


def anything(place: Place, ended: Ended) -> str:
    """No row is asked for."""
    return ""


def answered(must: str = "either", then: Callable[[Place, Ended], str] = same, **changed: Any) -> Attack:
    """A sweep of answers with other arrays."""

    def does(place: Place) -> list[Command]:
        arrays = {k: v(poses()) if callable(v) else v for k, v in changed.items()}
        write_npz(place.work / "mine.npz", **arrays)
        return [SWEEP]

    return Attack(does, must, then)


def bits(value: int) -> Callable[[dict[str, Any]], np.ndarray]:
    """The handover poses with these 32 bits as the first number of row 2."""

    def change(own: dict[str, Any]) -> np.ndarray:
        T = own["T_world_ee"].copy()
        T.view(np.uint32)[2, 0, 3] = value
        return T

    return change


def first(key: str, place: tuple[int, ...], value: float) -> Callable[[dict[str, Any]], np.ndarray]:
    """An array with this number at one place of every row."""

    def change(own: dict[str, Any]) -> np.ndarray:
        T = own[key].astype(np.float64)
        T[(slice(None), *place)] = value
        return T.astype(np.float32)

    return change


def bent(scale: float) -> Callable[[dict[str, Any]], np.ndarray]:
    """Grasps whose rotation is scaled."""

    def change(own: dict[str, Any]) -> np.ndarray:
        T = own["T_obj_ee"].copy()
        T[:, :3, :3] *= scale
        return T

    return change


def mirrored(own: dict[str, Any]) -> np.ndarray:
    """Grasps with a left-handed frame."""
    T = own["T_obj_ee"].copy()
    T[:, :3, 0] *= -1
    return T


def every_row(change: Callable[[np.ndarray], np.ndarray]) -> Attack:
    """The same change of all arrays of the answers; refused."""
    keys = ("trial_id", "T_obj_ee", "T_world_ee")
    changed: dict[str, Any] = {k: lambda own, k=k: change(own[k]) for k in keys}
    return answered("refused", same, **changed)


NUMBERS: dict[str, Attack] = {
    "a NaN with a payload": answered(then=anything, T_world_ee=bits(0x7FC0BEEF)),
    "a signalling NaN": answered(then=anything, T_world_ee=bits(0x7F800001)),
    "the smallest subnormal": answered(then=anything, T_world_ee=bits(1)),
    "3.4e38": answered(then=nothing_passed, T_world_ee=first("T_world_ee", (0, 3), 3.4e38)),
    "-inf": answered(then=nothing_passed, T_world_ee=first("T_world_ee", (1, 3), -np.inf)),
    "999 m": answered(then=nothing_passed, T_world_ee=first("T_world_ee", (2, 3), 999.0)),
    "a last row of 0, 0, 0, 1.01": answered(then=nothing_passed, T_world_ee=first("T_world_ee", (3, 3), 1.01)),
    "a last row that moves": answered(then=nothing_passed, T_world_ee=first("T_world_ee", (3, 0), 0.2)),
    "a rotation of 0.99": answered(then=nothing_passed, T_obj_ee=bent(0.99)),
    "a rotation of 1.01": answered(then=nothing_passed, T_obj_ee=bent(1.01)),
    "a rotation of zeros": answered(then=nothing_passed, T_obj_ee=bent(0.0)),
    "a rotation of 1e30": answered(then=nothing_passed, T_obj_ee=bent(1e30)),
    "a mirror image": answered(then=nothing_passed, T_obj_ee=mirrored),
}
TYPES: dict[str, Attack] = {
    "big-endian floats": answered(T_obj_ee=lambda o: o["T_obj_ee"].astype(">f4")),
    "floats of 8 bytes": answered(T_obj_ee=lambda o: o["T_obj_ee"].astype("<f8")),
    "floats of 16 bytes": answered(T_obj_ee=lambda o: o["T_obj_ee"].astype(np.longdouble)),
    "Fortran's order": answered(T_obj_ee=lambda o: np.asfortranarray(o["T_obj_ee"])),
    "big-endian ids": answered(trial_id=lambda o: o["trial_id"].astype(">i8")),
    "ids beyond 2^63": answered("refused", trial_id=lambda o: o["trial_id"].astype(np.uint64) + np.uint64(2**63)),
    "ids that are -1": answered("refused", trial_id=lambda o: o["trial_id"] * 0 - 1),
    "ids that wrap at 2^32": answered("refused", trial_id=lambda o: o["trial_id"] + 2**32),
    "ids as floats": answered(trial_id=lambda o: o["trial_id"].astype(float)),
    "ids as floats of a half": answered("refused", trial_id=lambda o: o["trial_id"] + 0.5),
    "ids as dates": answered("refused", trial_id=lambda o: o["trial_id"].astype("datetime64[s]")),
    "ids as truth values": answered("refused", trial_id=lambda o: o["trial_id"] > 0),
    "ids in two columns": answered("refused", trial_id=lambda o: o["trial_id"][:, None]),
    "a record of fields": answered(
        "refused", T_obj_ee=lambda o: np.zeros(6, [("a", "f4", (4, 4)), ("b", "O")])["a"].view([("a", "f4")])
    ),
    "poses of 3 x 4": answered("refused", T_obj_ee=lambda o: o["T_obj_ee"][:, :3]),
    "poses one after another": answered("refused", T_obj_ee=lambda o: o["T_obj_ee"].reshape(-1, 4)),
    "the method's time of -1 s": answered("refused", t_method_s=lambda o: -np.ones(6, np.float32)),
    "the method's time of 1e30 s": answered(then=anything, t_method_s=lambda o: np.full(6, 1e30, np.float32)),
    "two names of the method": answered("refused", method=np.array(["a", "b"])),
    "a method's name in bytes": answered(then=anything, method=np.array(b"mine\xff")),
    "a benchmark of another name": answered("refused", benchmark=np.array("r2h-v0")),
    "a benchmark that is a path": answered("refused", benchmark=np.array("../../outside/secret.txt")),
    "a row less": every_row(lambda x: x[:-1]),
    "65,536 times the rows": every_row(lambda x: np.tile(x, (65536,) + (1,) * (x.ndim - 1))),
}


def archive(change: Callable[[Path, dict[str, bytes]], object]) -> Callable[[Place], list[Command]]:
    """A file of answers whose archive somebody wrote by hand."""

    def does(place: Place) -> list[Command]:
        path = place.work / "mine.npz"
        write_npz(path)
        with zipfile.ZipFile(path) as held:
            members = {n: held.read(n) for n in held.namelist()}
        path.unlink()
        change(path, members)
        return [SWEEP]

    return does


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED, comment: bytes = b"") -> None:
    """Writes an archive."""
    with zipfile.ZipFile(path, "w", method) as out:
        for name, data in members.items():
            out.writestr(name, data)
        out.comment = comment


def overlapping(path: Path, members: dict[str, bytes]) -> None:
    """Many directory entries of one member, as in a flat bomb."""
    zipped(path, members)
    data = path.read_bytes()
    end = data.rfind(b"PK\5\6")
    (start,) = struct.unpack("<I", data[end + 16 : end + 20])
    entry = data[start : start + 46 + struct.unpack("<H", data[start + 28 : start + 30])[0]]
    count = 60_000
    tail = b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, count, count, len(entry) * count, start, 0)
    path.write_bytes(data[:start] + entry * count + tail)


def patched(old: bytes, new: bytes, count: int = -1) -> Callable[[Path, dict[str, bytes]], None]:
    """An archive with other bytes."""

    def write(path: Path, members: dict[str, bytes]) -> None:
        zipped(path, members)
        path.write_bytes(path.read_bytes().replace(old, new, count))

    return write


def behind(prefix: bytes = b"", suffix: bytes = b"") -> Callable[[Path, dict[str, bytes]], None]:
    """An archive in the middle of other bytes."""

    def write(path: Path, members: dict[str, bytes]) -> None:
        zipped(path, members)
        path.write_bytes(prefix + path.read_bytes() + suffix)

    return write


ARCHIVES: dict[str, Attack] = {
    "packed by bzip2": Attack(archive(lambda p, m: zipped(p, m, zipfile.ZIP_BZIP2)), then=same),
    "packed by lzma": Attack(archive(lambda p, m: zipped(p, m, zipfile.ZIP_LZMA)), then=same),
    "64 MiB of zeros by lzma": Attack(
        archive(lambda p, m: zipped(p, {**m, "x.npy": bytes(64 << 20)}, zipfile.ZIP_LZMA)), then=same
    ),
    "60,000 entries of one member": Attack(archive(overlapping), "refused"),
    "the flag of encryption": Attack(
        archive(lambda p, m: _after(_flagged, p, m)),
        "refused",
    ),
    "a shell script before it": Attack(archive(behind(b"#!/bin/sh\nexit 1\n")), then=same),
    "a second archive behind it": Attack(archive(lambda p, m: _twice(p, m))),
    "64 KiB of comment": Attack(archive(lambda p, m: zipped(p, m, comment=b"PK\5\6" * 16000)), then=same),
    "a name of the directory in another case": Attack(
        archive(lambda p, m: zipped(p, {k.replace("T_", "t_"): v for k, v in m.items()})), "refused"
    ),
    "members without .npy": Attack(archive(lambda p, m: zipped(p, {k[:-4]: v for k, v in m.items()})), "refused"),
    "members in a folder": Attack(archive(lambda p, m: zipped(p, {"a/" + k: v for k, v in m.items()})), "refused"),
    "other names in the local heads": Attack(archive(patched(b"T_obj_ee", b"T_obj_xx", 1)), "refused"),
    "a method's number of 99": Attack(
        archive(
            lambda p, m: _after(
                lambda d: d.replace(b"PK\1\2\x14\3\x14\0\0\0\0\0", b"PK\1\2\x14\3\x14\0\0\0\x63\0"), p, m
            )
        ),
        "refused",
    ),
    "two disks": Attack(archive(lambda p, m: _after(lambda d: d.replace(b"PK\5\6\0\0\0\0", b"PK\5\6\1\0\1\0"), p, m))),
    "a header of version 9": Attack(
        archive(lambda p, m: zipped(p, {k: v.replace(b"NUMPY\1", b"NUMPY\x09") for k, v in m.items()})), "refused"
    ),
    "a header of 60 kB of spaces": Attack(
        archive(lambda p, m: zipped(p, {k: _padded(v) for k, v in m.items()})), then=same
    ),
    "a header with a key twice": Attack(
        archive(lambda p, m: zipped(p, {k: _again(v) for k, v in m.items()})), "either"
    ),
    "a shape of True": Attack(
        archive(lambda p, m: zipped(p, {k: v.replace(b"(6,", b"(6*") for k, v in m.items()})), "refused"
    ),
}


def _after(change: Callable[[bytes], bytes], path: Path, members: dict[str, bytes]) -> None:
    """An archive whose bytes are changed."""
    zipped(path, members)
    path.write_bytes(change(path.read_bytes()))


def _flagged(data: bytes) -> bytes:
    found = bytearray(data)
    for mark, offset in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        at = found.find(mark)
        while at >= 0:
            found[at + offset] |= 1
            at = found.find(mark, at + 4)
    return bytes(found)


def _twice(path: Path, members: dict[str, bytes]) -> None:
    zipped(path, members)
    one = path.read_bytes()
    T = np.zeros((6, 4, 4), np.float32)
    np.savez(path.with_name("second.npz"), trial_id=np.arange(6), T_obj_ee=T, T_world_ee=T)
    path.write_bytes(one + path.with_name("second.npz").read_bytes())


def _padded(data: bytes) -> bytes:
    old = struct.unpack("<H", data[8:10])[0]
    head = data[10 : 10 + old].rstrip() + b" " * 60_000 + b"\n"
    return data[:8] + struct.pack("<H", len(head)) + head + data[10 + old :]


def _again(data: bytes) -> bytes:
    old = struct.unpack("<H", data[8:10])[0]
    head = data[10 : 10 + old].replace(b"{", b"{'shape': (10000000,), ", 1)
    return data[:8] + struct.pack("<H", len(head)) + head + data[10 + old :]


def as_text(
    ending: str, change: Callable[[str], str | bytes], must: str = "either", then: Callable[[Place, Ended], str] = same
) -> Attack:
    """Answers as JSON or CSV, with another text."""

    def does(place: Place) -> list[Command]:
        own = {k: v.reshape(len(v), -1) if ending == "csv" else v for k, v in poses().items()}
        if ending == "json":
            text = json.dumps({k: v.tolist() for k, v in own.items()}, indent=0)
        else:
            head = ["trial_id", *(f"{k}_{j}" for k in ("T_obj_ee", "T_world_ee") for j in range(16))]
            rows = [
                [i, *own["T_obj_ee"][k].tolist(), *own["T_world_ee"][k].tolist()]
                for k, i in enumerate(poses()["trial_id"].tolist())
            ]
            text = "\n".join(",".join(map(str, r)) for r in (head, *rows)) + "\n"
        new = change(text)
        (place.work / f"mine.{ending}").write_bytes(
            new if isinstance(new, bytes) else new.encode("utf-8", "surrogatepass")
        )
        return [[w.replace("mine.npz", f"mine.{ending}") for w in SWEEP]]

    return Attack(does, must, then)


TEXTS: dict[str, Attack] = {
    "JSON: as it is": as_text("json", lambda t: t, "read"),
    "JSON: a mark of byte order": as_text("json", lambda t: "\ufeff" + t),
    "JSON: a key twice": as_text("json", lambda t: t[:-1] + ', "trial_id": [0, 0, 0, 0, 0, 0]}', "refused"),
    "JSON: a key twice, one with an escape": as_text(
        "json", lambda t: t[:-1] + ', "trial\\u005fid": [0, 1, 2, 3, 4, 4]}', "refused"
    ),
    "JSON: true for 1": as_text("json", lambda t: t.replace("1.0", "true"), "refused"),
    "JSON: text for a number": as_text("json", lambda t: t.replace("1.0", '"1.0"'), "refused"),
    "JSON: a comma too many": as_text("json", lambda t: t[:-1] + ",}", "refused"),
    "JSON: two values": as_text("json", lambda t: t + t, "refused"),
    "JSON: comments": as_text("json", lambda t: t + "// x", "refused"),
    "JSON: half a surrogate": as_text("json", lambda t: t[:-1] + ', "method": "\\ud800"}', "either", anything),
    "JSON: 5,000 digits": as_text("json", lambda t: t.replace("1.0", "1" * 5000, 1), "refused"),
    "JSON: 1e400": as_text("json", lambda t: t.replace("1.0", "1e400", 1), "either", anything),
    "JSON: ids of 1e0": as_text("json", lambda t: t.replace("[\n0,\n", "[\n0e0,\n", 1)),
    "JSON: rows of other lengths": as_text("json", lambda t: t.replace("1.0\n", "1.0, 2.0\n", 1), "refused"),
    "JSON: a key of 16 MiB": as_text("json", lambda t: t[:-1] + f', "{"k" * (16 << 20)}": 1}}', "refused"),
    "JSON: a million keys": as_text(
        "json", lambda t: t[:-1] + "".join(f', "k{k}": 1' for k in range(1_000_000)) + "}", "refused"
    ),
    "JSON: lines of it": as_text("json", lambda t: "\n".join([t.replace("\n", "")] * 3), "refused"),
    "CSV: as it is": as_text("csv", lambda t: t, "read"),
    "CSV: a mark of byte order": as_text("csv", lambda t: "\ufeff" + t),
    "CSV: lines end with CR": as_text("csv", lambda t: t.replace("\n", "\r")),
    "CSV: semicolons": as_text("csv", lambda t: t.replace(",", ";"), "refused"),
    "CSV: commas as decimal points": as_text("csv", lambda t: t.replace("0.", '"0,'), "refused"),
    "CSV: underlines in numbers": as_text("csv", lambda t: t.replace("1.0", "1_0.0"), "refused"),
    "CSV: digits of full width": as_text("csv", lambda t: t.replace(",1.0", ",\uff11.0"), "refused"),
    "CSV: numbers in base 16": as_text("csv", lambda t: t.replace("1.0", "0x1p0"), "refused"),
    "CSV: infinity": as_text("csv", lambda t: t.replace("1.0", "Infinity"), "either", nothing_passed),
    "CSV: a column twice": as_text("csv", lambda t: _column(t, "T_obj_ee_0", "9"), "refused"),
    "CSV: a header in capitals": as_text("csv", lambda t: t.replace("trial_id", "TRIAL_ID", 1), "refused"),
    "CSV: a short row": as_text("csv", lambda t: t.rstrip("\n").rpartition(",")[0] + "\n", "refused"),
    "CSV: a long row": as_text("csv", lambda t: t.rstrip("\n") + ",1\n", "refused"),
    "CSV: a line within quotes": as_text("csv", lambda t: t.replace("trial_id", '"trial\n_id"', 1), "refused"),
    "CSV: spaces around words": as_text("csv", lambda t: t.replace(",", " , ")),
    "CSV: ids as 1.0": as_text("csv", lambda t: t.replace("\n1,", "\n1.0,")),
    "CSV: Latin-1": as_text("csv", lambda t: t.replace("trial_id", "trial_id\u00e9").encode("latin-1"), "refused"),
    "CSV: a cell of 200 kB": as_text("csv", lambda t: t.replace("1.0", "1." + "0" * 200_000, 1)),
    "CSV: an empty cell": as_text("csv", lambda t: t.replace("1.0", "", 1), "refused"),
}


def _column(text: str, name: str, value: str) -> str:
    head, *rows = text.splitlines()
    return "\n".join([f"{head},{name}", *(f"{r},{value}" for r in rows)]) + "\n"


def moved(
    change: Callable[[dict[str, Any]], dict[str, Any]],
    must: str = "either",
    then: Callable[[Place, Ended], str] = nothing_passed,
) -> Attack:
    """A file of motions: a straight line for the first trial, with other arrays."""

    def does(place: Place) -> list[Command]:
        ids, T = np.arange(2), np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
        q = np.linspace(0, 0.1, 4)[:, None] + np.array([-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483])
        own = {"trial_id": ids, "T_obj_ee": T, "q": q, "time_s": np.array([0, 1.0, 0, 1.0]), "length": np.array([2, 2])}
        with (place.work / "mine.npz").open("wb") as file:
            np.savez(file, **change(own))
        return [
            [
                "sweep",
                "--motions",
                "mine.npz",
                "--benchmark",
                "r2h-v1",
                "--trials",
                "1",
                "--sim",
                "none",
                "--out",
                "run",
            ]
        ]

    return Attack(does, must, then)


MOTIONS: dict[str, Attack] = {
    "as it is": moved(lambda a: a, "read"),
    "a length of -1 beside a longer one": moved(lambda a: {**a, "length": np.array([-1, 5])}, "refused"),
    "lengths whose sum wraps": moved(lambda a: {**a, "length": np.array([2**63 - 1, 2**63 - 1])}, "refused"),
    "lengths as floats": moved(lambda a: {**a, "length": np.array([2.5, 1.5])}, "refused"),
    "times that go back": moved(lambda a: {**a, "time_s": a["time_s"][::-1]}),
    "times that stand still": moved(lambda a: {**a, "time_s": a["time_s"] * 0}),
    "a joint of 1e38": moved(lambda a: {**a, "q": a["q"] * np.float64(1e38)}),
    "joints of NaN": moved(lambda a: {**a, "q": a["q"] * np.nan}),
    "a motion in 1e-30 s": moved(lambda a: {**a, "time_s": a["time_s"] * 1e-30}),
    "a motion of 1e30 s": moved(lambda a: {**a, "time_s": a["time_s"] * 1e30}),
    "7 joints": moved(lambda a: {**a, "q": np.c_[a["q"], a["q"][:, 0]]}, "refused"),
    "ids and names": moved(lambda a: {**a, "id": np.array(["a", "b"])}, "either"),
    "a plan of other length": moved(
        lambda a: {**a, "planned_q": a["q"], "planned_length": np.array([4, 1])}, "refused"
    ),
    "a plan of NaN": moved(lambda a: {**a, "planned_q": a["q"] * np.nan, "planned_length": np.array([2, 2])}),
}


def listed(change: Callable[[dict[str, Any]], dict[str, Any]], must: str = "refused") -> Attack:
    """A file of trials with other arrays."""

    def does(place: Place) -> list[Command]:
        T = np.tile(np.eye(4), (2, 1, 1))
        T[:, :3, 3] = [[0.6, 0.1, 0.3], [0.6, -0.1, 0.3]]
        own = {"object": np.array(["cup", "hammer"]), "T_world_hand": T, "hand": np.array([0, 250])}
        with (place.work / "two.npz").open("wb") as file:
            np.savez(file, **change(own))
        return [
            [
                "sweep",
                "--method",
                "random",
                "--benchmark",
                "r2h-v1",
                "--trials-file",
                "two.npz",
                "--sim",
                "none",
                "--out",
                "run",
            ],
            ["report", "run", "--format", "csv", "--out", "told.csv"],
        ]

    return Attack(does, must)


def skin(**changed: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Hands as meshes."""

    def change(own: dict[str, Any]) -> dict[str, Any]:
        V = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])
        F = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        mesh = {
            "skin": np.stack([V, V]),
            "skin_side": np.array([0, 1]),
            "skin_faces": F,
            "skin_piece": np.zeros(4, int),
            "T_hand_palm": np.tile(np.eye(4), (2, 1, 1)),
        }
        return {**own, "hand": np.array([0, 1]), **mesh, **changed}

    return change


TRIALS: dict[str, Attack] = {
    "as it is": listed(lambda a: a, "read"),
    "an id twice, composed otherwise": listed(lambda a: {**a, "id": np.array(["e\u0301", "\u00e9"])}, "either"),
    "ids that are numbers of other trials": listed(lambda a: {**a, "id": np.array(["1", "0"])}, "either"),
    "ids of formulas": listed(
        lambda a: {**a, "id": np.array(["=1+1", "@x"]), "variant": np.array(["+1", "-x"])}, "either"
    ),
    "an object in another case": listed(lambda a: {**a, "object": np.array(["Cup", "hammer"])}),
    "a hand of -1": listed(lambda a: {**a, "hand": np.array([-1, 250])}),
    "a hand of 2^40": listed(lambda a: {**a, "hand": np.array([2**40, 250])}),
    "a hand of 0.5": listed(lambda a: {**a, "hand": np.array([0.5, 250])}),
    "a hand that is a mirror image": listed(lambda a: {**a, "T_world_hand": a["T_world_hand"] * [[-1, 1, 1, 1]]}),
    "a hand 1e5 m away": listed(
        lambda a: {
            **a,
            "T_world_hand": a["T_world_hand"] * 1.0
            + 1e5 * np.eye(4)[:, [1, 2, 0, 3]] * 0
            + np.pad(np.full((3, 1), 1e5), ((0, 1), (3, 0))),
        },
        "either",
    ),
    "a skin of no faces": listed(skin(skin_faces=np.zeros((0, 3), int), skin_piece=np.zeros(0, int))),
    "a skin with faces of other corners": listed(skin(skin_faces=np.full((4, 3), 2**31 - 1))),
    "a skin with faces of -1": listed(skin(skin_faces=np.array([[0, 2, -1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))),
    "a skin of one point": listed(skin(skin=np.zeros((2, 4, 3)))),
    "a skin of 10 m": listed(skin(skin=200 * skin()({})["skin"])),
    "a skin of a billion pieces": listed(skin(skin_piece=np.array([0, 1, 2, 10**9]))),
    "a skin with NaN": listed(skin(skin=np.full((2, 4, 3), np.nan))),
    "a palm that is none": listed(skin(T_hand_palm=np.zeros((2, 4, 4)))),
    "sides of 7": listed(skin(skin_side=np.array([7, -7]))),
}

KINDS = {
    "numbers of answers": NUMBERS,
    "types of answers": TYPES,
    "archives of answers": ARCHIVES,
    "answers as text": TEXTS,
    "motions": MOTIONS,
    "trials' arrays": TRIALS,
}
