"""Predictions files: every fault of rows 12 to 16 of the fault matrix is refused with a line that says what to do."""

import io
import pickle
import struct
import subprocess
import sys
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
import torch
from made_runs import make_predictions, make_trials
from safetensors.numpy import save, save_file

from r2h_batch import predictions
from r2h_batch.predictions import MAX_MEMBERS, PredictionsError, align, load_predictions, write_predictions
from r2h_batch.types import Predictions

FORMATS = (".npz", ".safetensors")


def arrays(n: int = 5, **changes) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    data = {
        "trial_id": np.arange(n),
        "T_obj_ee": rng.normal(size=(n, 4, 4)).astype(np.float32),
        "T_world_ee": rng.normal(size=(n, 4, 4)).astype(np.float32),
    }
    return {k: v for k, v in {**data, **changes}.items() if v is not None}


def store(path, data, method=None):
    if path.suffix == ".npz":
        np.savez(path, **data, **({} if method is None else {"method": np.array(method)}))
    else:
        data = {k: np.ascontiguousarray(v) for k, v in data.items()}
        save_file(data, path, metadata=None if method is None else {"method": method})
    return path


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), allow_pickle=True)
    return buffer.getvalue()


def zipped(path, members, compression=zipfile.ZIP_STORED):
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", compression) as archive:
        warnings.simplefilter("ignore")  # duplicate names are on purpose
        for name, data in members:
            archive.writestr(name, data)
    return path


def members(**changes):
    return [(f"{k}.npy", npy(v)) for k, v in arrays(**changes).items()]


def refused(path, *parts) -> str:
    """The message; it is one line, names the file and has every part."""
    with pytest.raises(PredictionsError) as error:
        load_predictions(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    for part in parts:
        assert part in message, message
    return message


# --- what is accepted -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("n", [1, 2, 33])
@pytest.mark.parametrize("timed", [False, True])
def test_written_predictions_are_read_back_equal(tmp_path, suffix, n, timed):
    seconds = torch.arange(n, dtype=torch.float32) if timed else None
    made = make_predictions(make_trials(n, 0), method="Contact-Handover (é)")
    made = Predictions(made.trial_id, made.T_obj_ee, made.T_world_ee, seconds, made.method)
    write_predictions(tmp_path / f"p{suffix}", made)
    read = load_predictions(tmp_path / f"p{suffix}")
    assert read.method == made.method
    for name in ("trial_id", "T_obj_ee", "T_world_ee"):
        assert getattr(read, name).numpy().tobytes() == getattr(made, name).numpy().tobytes()
        assert getattr(read, name).dtype == getattr(made, name).dtype
    assert (read.t_method_s is None) if seconds is None else torch.equal(read.t_method_s, seconds)
    assert [p.name for p in tmp_path.iterdir()] == [f"p{suffix}"]


def test_other_suffixes_are_not_written(tmp_path):
    with pytest.raises(PredictionsError, match=r"\.npz or \.safetensors"):
        write_predictions(tmp_path / "p.pt", make_predictions(make_trials(1, 0)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", FORMATS)
def test_float64_poses_other_integers_and_no_method_name_are_taken(tmp_path, suffix):
    data = arrays(trial_id=np.arange(5, dtype=np.uint16), T_obj_ee=np.full((5, 4, 4), 1 / 3))
    read = load_predictions(store(tmp_path / f"my_rule{suffix}", data))
    assert read.method == "my_rule"
    assert read.trial_id.dtype == torch.int64 and read.T_obj_ee.dtype == torch.float32
    assert (read.T_obj_ee == np.float32(1 / 3)).all()


def test_fortran_order_big_endian_and_compressed_arrays_are_taken(tmp_path):
    data = arrays()
    poses = np.asfortranarray(data["T_obj_ee"]).astype(">f4", order="K")
    np.savez_compressed(tmp_path / "p.npz", **{**data, "T_obj_ee": poses})
    assert np.array_equal(load_predictions(tmp_path / "p.npz").T_obj_ee.numpy(), data["T_obj_ee"])


def test_poses_that_are_not_numbers_are_the_evaluators_business(tmp_path):
    data = arrays()
    data["T_obj_ee"][1] = np.nan
    assert torch.isnan(load_predictions(store(tmp_path / "p.npz", data)).T_obj_ee[1]).all()


def test_unmeasured_times_are_nan(tmp_path):
    path = store(tmp_path / "p.npz", arrays(t_method_s=np.array([0.0, 1.0, np.nan, 2.0, 3.0])))
    assert torch.isnan(load_predictions(path).t_method_s).tolist() == [False, False, True, False, False]


# --- schema ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"trial_id": None}, ["'trial_id' is missing"]),
        ({"T_obj_ee": None}, ["'T_obj_ee' is missing"]),
        ({"T_world_ee": None}, ["'T_world_ee' is missing"]),
        ({"T_obj_eee": np.zeros(3)}, ["unknown", "T_obj_eee", "allowed keys are trial_id"]),
        ({"T_obj_ee": np.zeros((5, 3, 4), np.float32)}, ["'T_obj_ee'", "(5, 3, 4)", "(5, 4, 4)"]),
        ({"T_world_ee": np.zeros((4, 4, 4), np.float32)}, ["'T_world_ee'", "(4, 4, 4)", "(5, 4, 4)"]),
        ({"T_world_ee": np.zeros((4, 4), np.float32)}, ["'T_world_ee'", "(5, 4, 4)"]),
        ({"T_obj_ee": np.zeros((5, 4, 4), int)}, ["'T_obj_ee'", "int64", "float32 or float64"]),
        ({"T_obj_ee": np.zeros((5, 4, 4), np.float16)}, ["'T_obj_ee'", "float16", "float32 or float64"]),
        ({"trial_id": np.arange(5.0)}, ["'trial_id'", "float64", "integer"]),
        ({"trial_id": np.zeros((5, 1), int)}, ["'trial_id'", "(5, 1)", "(N,)"]),
        ({"trial_id": np.zeros(5, bool)}, ["'trial_id'", "integer"]),
        ({"trial_id": np.full(5, 2**63, np.uint64)}, ["does not fit int64"]),
        ({"t_method_s": np.zeros(4)}, ["'t_method_s'", "(4,)", "(5,)"]),
        ({"t_method_s": np.full(5, -1.0)}, ["'t_method_s'", "negative"]),
        ({"t_method_s": np.full(5, np.inf)}, ["'t_method_s'", "infinite"]),
    ],
    ids=str,
)
def test_a_wrong_schema_is_refused_naming_file_key_and_what_is_allowed(tmp_path, suffix, changes, parts):
    refused(store(tmp_path / f"p{suffix}", arrays(**changes)), *parts)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_without_rows_is_refused(tmp_path, suffix):
    refused(store(tmp_path / f"p{suffix}", arrays(0)), "no rows")


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("method", ["", "  ", "a\nb", "x" * 101])
def test_a_method_name_that_no_table_can_show_is_refused(tmp_path, suffix, method):
    refused(store(tmp_path / f"p{suffix}", arrays(), method), "method")


@pytest.mark.parametrize("method", [np.array(["a", "b"]), np.array(3), np.array(b"bytes")])
def test_a_method_that_is_not_one_string_is_refused(tmp_path, method):
    np.savez(tmp_path / "p.npz", **arrays(), method=method)
    refused(tmp_path / "p.npz", "'method'", "one string")


# --- row 12: pickles ------------------------------------------------------------------------------------------------


class _Touch:
    """Unpickling this creates a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickle_object_npz_and_torch_files_are_refused_unread_saying_how_to_convert(tmp_path):
    touched = tmp_path / "touched"
    bomb = np.array([_Touch(touched)] * 5, dtype=object)
    (tmp_path / "p.pkl").write_bytes(pickle.dumps({"T_obj_ee": bomb}))
    np.savez(tmp_path / "object.npz", **arrays(trial_id=bomb))
    zipped(tmp_path / "method.npz", [*members(), ("method.npy", npy(np.array(_Touch(touched), dtype=object)))])
    torch.save({"T_obj_ee": _Touch(touched)}, tmp_path / "new.pt")
    torch.save({"T_obj_ee": _Touch(touched)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    torch.save({str(i): torch.zeros(2) for i in range(40)}, tmp_path / "model.npz")
    np.save(tmp_path / "one.npy", np.zeros(4))
    for name in ("p.pkl", "object.npz", "new.pt", "old.pt", "model.npz"):
        refused(tmp_path / name, "pickle", "refused", "np.savez(FILE, trial_id=")
    refused(tmp_path / "method.npz", "pickle")
    refused(tmp_path / "one.npy", "single .npy", "np.savez")
    assert not touched.exists()


# --- row 13: bombs --------------------------------------------------------------------------------------------------


def declare(path, name: str, size: int) -> None:
    """Let the archive's directory and local header claim another uncompressed size for a member."""
    data = bytearray(path.read_bytes())
    for signature, at_size, at_name in ((b"PK\x01\x02", 24, 46), (b"PK\x03\x04", 22, 30)):
        at = data.find(signature)
        while at >= 0:
            if data[at + at_name : at + at_name + len(name)] == name.encode():
                data[at + at_size : at + at_size + 4] = struct.pack("<I", size)
            at = data.find(signature, at + 4)
    path.write_bytes(data)


def test_a_highly_compressed_member_is_refused_before_it_is_unpacked(tmp_path):
    huge = np.zeros((1_000_000, 4, 4), np.float32)
    np.savez_compressed(tmp_path / "p.npz", **arrays(T_obj_ee=huge))
    del huge
    tracemalloc.start()
    refused(tmp_path / "p.npz", "T_obj_ee", "at most 200 times", "np.savez instead")
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_small_constant_arrays_may_compress_well(tmp_path):
    np.savez_compressed(tmp_path / "p.npz", **arrays(500, T_obj_ee=np.tile(np.eye(4, dtype=np.float32), (500, 1, 1))))
    assert len(load_predictions(tmp_path / "p.npz")) == 500


def test_a_declared_size_beyond_the_limit_is_refused(tmp_path, monkeypatch):
    store(tmp_path / "p.npz", arrays(200))
    monkeypatch.setattr(predictions, "MAX_BYTES", 20_000)
    refused(tmp_path / "p.npz", "at most 20000 are allowed")


@pytest.mark.parametrize("shape", [(10**9, 4, 4), (10**18, 10**18, 16), (6, 4, 4), (4, 4, 4), (-5, -4, 4)])
def test_an_array_header_that_lies_about_its_shape_is_refused_before_allocation(tmp_path, shape):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    zipped(tmp_path / "p.npz", [*members(T_obj_ee=None), ("T_obj_ee.npy", header.getvalue() + bytes(5 * 64))])
    tracemalloc.start()
    refused(tmp_path / "p.npz", "'T_obj_ee'")
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("size", [100, 500, 100_000])
def test_a_directory_that_lies_about_a_members_size_is_refused(tmp_path, size):
    zipped(tmp_path / "p.npz", members())
    declare(tmp_path / "p.npz", "T_obj_ee.npy", size)
    refused(tmp_path / "p.npz")


def test_duplicate_members_are_refused(tmp_path):
    refused(zipped(tmp_path / "p.npz", [*members(), members()[1]]), "duplicate member 'T_obj_ee.npy'")


def test_too_many_members_are_refused(tmp_path):
    many = [(f"a{i}.npy", npy(np.zeros(1))) for i in range(MAX_MEMBERS + 1)]
    refused(zipped(tmp_path / "p.npz", many), f"at most {MAX_MEMBERS}")


def test_a_long_header_is_refused(tmp_path):
    text = b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1," * 30_000 + b"), }"
    header = b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text) + 1) + text + b"\n"
    refused(zipped(tmp_path / "p.npz", [*members(T_obj_ee=None), ("T_obj_ee.npy", header)]), "'T_obj_ee'")


def test_an_encrypted_member_is_refused(tmp_path):
    path = zipped(tmp_path / "p.npz", members())
    data = bytearray(path.read_bytes())
    for signature, at in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        data[data.find(signature) + at] |= 1
    path.write_bytes(data)
    refused(path, "is encrypted; write np.savez")


# --- row 14: names that lead out ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["../T_obj_ee.npy", "a/../../x.npy", "/etc/passwd", "..\\x.npy", "C:\\x.npy", "C:x.npy", "\\\\host\\x.npy"]
)
def test_members_that_point_outside_are_refused_and_nothing_is_extracted(tmp_path, name):
    refused(zipped(tmp_path / "p.npz", [*members(), (name, b"x")]), "outside the archive")
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


def test_a_symbolic_link_in_the_archive_is_refused(tmp_path):
    link = zipfile.ZipInfo("T_obj_ee.npy")
    link.external_attr = 0o120777 << 16
    refused(zipped(tmp_path / "p.npz", [*members(T_obj_ee=None), (link, "/etc/passwd")]), "symbolic link")


@pytest.mark.parametrize("name", ["sub/T_obj_ee.npy", "T_obj_ee", "notes.txt", "T_OBJ_EE.npy"])
def test_members_that_are_no_known_array_are_refused(tmp_path, name):
    refused(zipped(tmp_path / "p.npz", [*members(), (name, b"x")]), "unknown member", "allowed keys are trial_id")


# --- row 15: damage -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_cut_at_any_place_is_refused_and_named(tmp_path, suffix):
    data = store(tmp_path / f"whole{suffix}", arrays(3), "m").read_bytes()
    path = tmp_path / f"cut{suffix}"
    for n in range(0, len(data), 7):
        path.write_bytes(data[:n])
        refused(path)


def test_a_flipped_bit_in_the_data_of_an_npz_is_refused(tmp_path):
    path = store(tmp_path / "p.npz", arrays(200))
    data = bytearray(path.read_bytes())
    data[data.find(b"T_world_ee") + 2000] ^= 4
    path.write_bytes(data)
    refused(path, "CRC", "write or copy it again")


def test_any_flipped_bit_is_refused_or_harmless_and_never_another_error(tmp_path):
    data = store(tmp_path / "whole.npz", arrays(2)).read_bytes()
    path, accepted = tmp_path / "flip.npz", 0
    for at in range(len(data)):
        damaged = bytearray(data)
        damaged[at] ^= 1 << (at % 8)
        path.write_bytes(damaged)
        try:
            read = load_predictions(path)
        except PredictionsError:
            continue
        accepted += 1
        for key, value in arrays(2).items():
            assert np.array_equal(getattr(read, key).numpy(), value)
    assert accepted < len(data) / 2


@pytest.mark.parametrize(
    "content",
    [
        b"\xff" * 64,
        struct.pack("<Q", 2**62) + b"{}",
        struct.pack("<Q", 4) + b"{{{{",
        save(arrays()) + b"tail",
        struct.pack("<Q", 90)
        + b'{"trial_id":{"dtype":"I64","shape":[9223372036854775807],"data_offsets":[0,8]}}'.ljust(98),
    ],
)
def test_damaged_safetensors_are_refused(tmp_path, content):
    (tmp_path / "p.safetensors").write_bytes(content)
    refused(tmp_path / "p.safetensors", "safetensors")


@pytest.mark.parametrize(
    ("name", "content"), [("p.csv", b"trial_id,x\n1,2\n"), ("p.json", b"[1, 2]"), ("p.h5", b"\x89HDF\r\n")]
)
def test_other_formats_are_refused_saying_what_to_write(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, "neither .npz nor .safetensors", "np.savez")


def test_nothing_a_folder_and_an_empty_file_are_refused(tmp_path):
    (tmp_path / "empty.npz").touch()
    refused(tmp_path / "none.npz", "no such file")
    refused(tmp_path, "not a regular file")
    refused(tmp_path / "empty.npz", "empty")


# --- row 16: rows that do not match the plan ------------------------------------------------------------------------


def predictions_for(ids) -> Predictions:
    ids = torch.tensor(ids, dtype=torch.int64)
    poses = torch.zeros(len(ids), 4, 4)
    return Predictions(ids, poses, poses)


def test_rows_in_any_order_are_aligned_by_trial_id():
    planned = torch.tensor([10, 11, 12, 500, 501])
    given = predictions_for([501, 11, 500, 12, 10])
    rows = align(given, planned, source="p.npz")
    assert torch.equal(given.trial_id[rows], planned)


@pytest.mark.parametrize("allow_missing", [False, True])
@pytest.mark.parametrize(
    ("given", "count", "what", "listed"),
    [
        ([0, 1, 2, 3, 1, 1, 2], 2, "given more than once", "1, 2;"),
        ([*range(40), *range(30)], 30, "given more than once", "0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...;"),
        ([*range(41)], 1, "not in the plan", "40;"),
        (
            [*range(40), -1, *range(100, 120)],
            21,
            "not in the plan",
            "-1, 100, 101, 102, 103, 104, 105, 106, 107, 108, ...;",
        ),
    ],
)
def test_duplicate_and_unknown_ids_are_refused_with_the_first_ten(given, count, what, listed, allow_missing):
    with pytest.raises(PredictionsError) as error:
        align(predictions_for(given), torch.arange(40), source="my.npz", allow_missing=allow_missing)
    assert str(error.value).startswith(f"my.npz: {count} trial ids are {what}: {listed}")


def test_missing_ids_are_refused_with_the_first_ten_and_the_flag_that_allows_them():
    with pytest.raises(PredictionsError) as error:
        align(predictions_for(range(20, 40)), torch.arange(40), source="my.npz")
    assert str(error.value).startswith(
        "my.npz: 20 trial ids are planned but missing: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...;"
    )
    assert "--allow-missing" in str(error.value)


def test_allowed_missing_ids_have_row_minus_1():
    rows = align(predictions_for([3, 0]), torch.arange(5), source="p", allow_missing=True)
    assert rows.tolist() == [1, -1, -1, 0, -1]
    assert align(predictions_for([]), torch.arange(2), source="p", allow_missing=True).tolist() == [-1, -1]


def test_a_large_file_is_read_in_little_more_memory_than_it_needs(tmp_path):
    """In a process of its own: 200,000 rows hold 27 MB; reading them may peak at a few times that, not at a hundred."""
    n = 200_000
    store(tmp_path / "p.npz", arrays(n))
    code = (
        "import resource, sys; from r2h_batch.predictions import load_predictions;"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; load_predictions(sys.argv[1]);"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "p.npz")], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) * 1024 < 6 * n * 136
