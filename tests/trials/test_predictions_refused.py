"""Predictions files that are damaged, hostile or something else: refused before any harm, naming the file."""

import io
import pickle
import struct
import tracemalloc
import zipfile
from contextlib import contextmanager

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from made_runs import with_a_fatal_footer
from prediction_files import arrays, members, npy, refused, store, zipped
from rounds import each

from r2h_batch.base.errors import FileError
from r2h_batch.trials.predictions import load_predictions


@contextmanager
def memory_below(size):
    tracemalloc.start()
    yield
    assert tracemalloc.get_traced_memory()[1] < size
    tracemalloc.stop()


class _Touch:
    """Unpickling this creates a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickles_and_other_formats_are_refused_unread_saying_what_to_write(tmp_path):
    touched = tmp_path / "touched"
    bomb = np.array([_Touch(touched)] * 5, dtype=object)
    (tmp_path / "p.pkl").write_bytes(pickle.dumps({"T_obj_ee": bomb}))
    np.savez(tmp_path / "object.npz", **arrays(trial_id=bomb))
    zipped(tmp_path / "method.npz", [*members(), ("method.npy", npy(np.array(_Touch(touched), dtype=object)))])
    torch.save({"T_obj_ee": _Touch(touched)}, tmp_path / "new.pt")
    torch.save({"T_obj_ee": _Touch(touched)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    for name in ("p.pkl", "object.npz", "method.npz", "new.pt", "old.pt"):
        refused(tmp_path / name, "pickle", "np.savez(FILE, trial_id=")
    assert not touched.exists()
    np.save(tmp_path / "one.npy", np.zeros(4))
    (tmp_path / "p.txt").write_bytes(b"trial_id,x\n1,2\n")
    (tmp_path / "empty.npz").touch()
    for name, words in {
        "one.npy": "single .npy",
        "p.txt": "neither .npz, .parquet, .csv nor",
        "empty.npz": "empty",
    }.items():
        refused(tmp_path / name, words, "np.savez")


# --- row 13: bombs --------------------------------------------------------------------------------------------------


def bomb(path, compression, claim: int | None = None):
    """An npz whose poses unpack to 19 MB, and whose directory may claim that they are `claim` bytes long when packed."""
    zipped(path, [*members(T_obj_ee=None), ("T_obj_ee.npy", npy(np.zeros((300_000, 4, 4), np.float32)))], compression)
    if claim is not None:
        data = bytearray(path.read_bytes())
        entry = data.rfind(b"T_obj_ee.npy") - 46
        data[entry + 20 : entry + 24] = struct.pack("<I", claim)
        path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("compression", "claim", "words"),
    [
        (zipfile.ZIP_DEFLATED, None, "at most 200 times"),
        (zipfile.ZIP_BZIP2, None, "allowed are stored and deflated"),
        (zipfile.ZIP_DEFLATED, 200_000, ""),
    ],
)
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, compression, claim, words):
    path = bomb(tmp_path / "p.npz", compression, claim)
    with memory_below(4 << 20):
        refused(path, words)


@pytest.mark.parametrize("shape", [(10**9, 4, 4), (10**18, 10**18, 16), (-5, -4, 4)])
def test_an_array_header_that_lies_about_its_shape_is_refused_before_allocation(tmp_path, shape):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    zipped(tmp_path / "p.npz", [*members(T_obj_ee=None), ("T_obj_ee.npy", header.getvalue() + bytes(5 * 64))])
    with memory_below(4 << 20):
        refused(tmp_path / "p.npz", "T_obj_ee")


LINK = zipfile.ZipInfo("T_obj_ee.npy")
LINK.external_attr = 0o120777 << 16


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ([members()[1]], "duplicate member 'T_obj_ee.npy'"),
        ([(f"a{i}.npy", npy(np.zeros(1))) for i in range(65)], "at most 64"),
        *(([(name, b"x")], "outside the archive") for name in ("../a.npy", "C:x.npy")),
        ([(LINK, "/etc/passwd")], "symbolic link"),
        ([("notes.txt", b"x")], "is not an .npy array"),
        ([("sub/T_obj_ee.npy", npy(np.zeros(1)))], "unknown array 'sub/T_obj_ee', did you mean T_obj_ee?; allowed are trial_id"),
    ],
)  # fmt: skip
def test_an_archive_with_other_members_is_refused_and_nothing_is_extracted(tmp_path, more, words):
    refused(zipped(tmp_path / "p.npz", [*members(), *more]), words)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


def test_members_that_share_their_bytes_are_refused(tmp_path):
    """Both poses are the same 2 MB of the file: its directory says so."""
    path = zipped(tmp_path / "p.npz", [(f"{k}.npy", npy(arrays(30_000)[k])) for k in ("trial_id", "T_obj_ee")])
    raw = bytearray(path.read_bytes())
    end, last = raw.rfind(b"PK\x05\x06"), raw.rfind(b"PK\x01\x02")
    entry = bytes(raw[last:end]).replace(b"T_obj_ee.npy", b"T_world_ee.npy")
    entry = entry[:28] + struct.pack("<H", len("T_world_ee.npy")) + entry[30:]
    files, size = struct.unpack("<HI", raw[end + 10 : end + 16])
    raw[end + 8 : end + 16] = struct.pack("<HHI", files + 1, files + 1, size + len(entry))
    path.write_bytes(raw[:end] + entry + raw[end:])
    assert len(zipfile.ZipFile(path).infolist()) == 3
    refused(path, "overlap")


@pytest.mark.parametrize(
    "text",
    [*(b"{" * 3000, b"__import__('os')", b""), b"{'descr': 'nonsense', 'fortran_order': False, 'shape': (5, 4, 4)}"],
    ids=lambda t: repr(t[:40]),
)
def test_an_array_header_that_cannot_be_parsed_is_one_line(tmp_path, text, recwarn):
    header = b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text
    refused(zipped(tmp_path / "p.npz", [*members(T_obj_ee=None), ("T_obj_ee.npy", header)]), "T_obj_ee")
    assert not list(recwarn)


# --- row 15: damage -------------------------------------------------------------------------------------------------


def test_a_file_cut_at_any_place_is_refused_and_named(tmp_path):
    data = store(tmp_path / "whole.npz", arrays(3), "m").read_bytes()
    path = tmp_path / "cut.npz"
    for n in each(range(0, len(data), 7)):
        path.write_bytes(data[:n])
        refused(path)


def test_any_flipped_bit_is_refused_or_harmless_and_never_another_error(tmp_path):
    data = store(tmp_path / "whole.npz", arrays(2)).read_bytes()
    path, accepted = tmp_path / "flip.npz", 0
    for at in range(0, len(data), 3):
        damaged = bytearray(data)
        damaged[at] ^= 1 << (at % 8)
        path.write_bytes(damaged)
        try:
            read = load_predictions(path)
        except FileError:
            continue
        accepted += 1
        for key, value in arrays(2).items():
            assert np.array_equal(getattr(read, key).numpy(), value)
    assert accepted < len(data) / 6


def answers(path, counts=(16, 16), **how):
    """A Parquet file of answers whose grasps have so many numbers a row."""
    grasps = pa.array([np.eye(4, dtype=np.float32).reshape(-1).tolist()[:n] + [0.0] * (n - 16) for n in counts])
    poses = pa.array([np.eye(4, dtype=np.float32).reshape(-1).tolist()] * len(counts))
    table = pa.table({"trial_id": np.arange(len(counts)), "T_obj_ee": grasps, "T_world_ee": poses})
    pq.write_table(table, path, compression="none", use_dictionary=False, **how)
    return path


def test_rows_of_15_and_17_numbers_in_a_parquet_file_are_refused_by_their_row(tmp_path):
    assert load_predictions(answers(tmp_path / "good.parquet")).T_obj_ee.shape == (2, 4, 4)
    with pytest.raises(FileError, match="'T_obj_ee' has 15 numbers in row 1; it needs 16 numbers a row"):
        load_predictions(answers(tmp_path / "shifted.parquet", (16, 15, 17)))


def test_a_flipped_bit_in_a_parquet_file_with_page_checksums_is_never_read_as_another_pose(tmp_path):
    path = answers(tmp_path / "m.parquet", write_page_checksum=True)
    data, good = path.read_bytes(), load_predictions(path)
    tried = 0
    for byte in range(4, len(data) - 8, 37):
        path.write_bytes(data[:byte] + bytes([data[byte] ^ 4]) + data[byte + 1 :])
        if byte > len(data) - 8 - int.from_bytes(data[-8:-4], "little"):
            break  # the footer, which can end the process that reads it
        tried += 1
        try:
            found = load_predictions(path)
        except FileError as error:
            assert str(path) in str(error)
        else:
            assert torch.equal(found.T_obj_ee, good.T_obj_ee) and torch.equal(found.T_world_ee, good.T_world_ee)
    assert tried >= 10


@pytest.mark.usefixtures("own_process")
def test_a_parquet_file_that_aborts_its_reader_is_one_line(tmp_path):
    """pyarrow aborts when it is asked for the size of a column whose type no version has."""
    path = tmp_path / "m.parquet"
    path.write_bytes(with_a_fatal_footer(answers(path).read_bytes()))
    with pytest.raises(FileError, match=rf"^{path}: .*ends its reader") as caught:
        load_predictions(path)
    assert "\n" not in str(caught.value)
