"""Strangers' pickles: the data in them as Python would read it, and nothing else ever runs or is allocated."""

import contextlib
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from alive import all_end
from mano_files import first_ten, with_fake_chumpy
from rounds import each

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import STANDING_BYTES, STANDING_PER_BYTE
from r2h_batch.data import safe_pickle
from r2h_batch.data.safe_pickle import MADE_BYTES, MAX_DEPTH, MAX_VALUES, read_pickle

ARRAYS = {
    "float": np.arange(12.0).reshape(3, 4),
    "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    "big endian": np.arange(5, dtype=">i4"),
    "uint32": np.array([[1, 2], [3, 4]], np.uint32),
    "text": np.array(["ab", "cde"]),
    "scalar": np.float64(2.5),
    "objects": np.array([{"x": np.ones(2)}, None], object),
    "lists": np.array([None, [1, 2], [3, 4]], object)[1:],
    "empty": np.zeros((0, 3)),
}


def equal(a, b):
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, np.ndarray) and a.dtype == object:
        return a.shape == b.shape and all(equal(x, y) for x, y in zip(a.ravel(), b.ravel(), strict=True))
    if isinstance(a, (np.ndarray, np.generic)):
        return a.dtype.newbyteorder("=") == b.dtype.newbyteorder("=") and np.array_equal(a, b)
    return type(a) is type(b) and a == b


@pytest.mark.check
@pytest.mark.parametrize("protocol", range(6))
def test_data_comes_back_as_python_reads_it(protocol):
    shared = ["one"]
    value = {
        **ARRAYS,
        "twice": [shared, shared],
        "nested": [1, -(10**30), 2.5, "hörig", b"\x00\xff", (True, None, ()), {"a": {3: 4}}],
    }
    raw = pickle.dumps(value, protocol)
    found = read_pickle(raw)
    assert equal(found, pickle.loads(raw)) and found["twice"][0] is found["twice"][1]


class Runs:
    def __reduce__(self):
        return os.system, ("touch /tmp/r2h_batch_pickle_ran",)


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


def laughs():
    value = (1,)
    for _ in range(30):
        value = (value, value, value, value)
    return value


class Says:
    """A pickle of this asks for a call and a state."""

    def __init__(self, *reduced):
        self.reduced = reduced

    def __reduce__(self):
        return self.reduced


def array(shape, raw=b"\x00" * 8, dtype="f8"):
    """An array that says another shape than its bytes have."""
    function, arguments, _ = np.zeros(1).__reduce__()
    return Says(function, arguments, (1, shape, np.dtype(dtype), False, raw))


def pointers():
    """Objects that are bytes of the file: numpy's own unpickler takes them for addresses, and goes there."""
    function, arguments, _ = np.zeros(1).__reduce__()
    kind = Says(np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0))
    return Says(function, arguments, (1, (1,), kind, False, b"A" * 8))


def sparse(**state):
    matrix = scipy.sparse.csc_matrix(np.eye(3))
    matrix.__dict__.update(state)
    return matrix


def python2_arrays(dtype):
    """Arrays that share one string, as Python 2 kept bytes: each makes bytes of it again."""
    text = "A" * (1 << 20)
    return [array((1 << 17,), text, dtype) for _ in range(9000)]


DAG, KEYS = [0] * 2000, range(5000)
HOSTILE = {
    "a call of the system": (Runs(), "asks for posix.system"),
    "an allowed module's other name": (b"\x80\x02cnumpy\nload\n.", "asks for numpy.load"),
    "a dotted way out": (b"\x80\x04\x8c\x05numpy\x8c\x0eos.path.system\x93.", "asks for numpy.os.path.system"),
    "a list that holds itself": (b"\x80\x02]q\x00h\x00a.", "deep"),
    "too deep": (nested(MAX_DEPTH + 5), "deep"),
    "a huge shape": (array((10**6, 10**6)), "with 8 bytes"),
    "an overflowing shape": (array((2**62, 4)), "with 8 bytes"),
    "a shape of 4^30 numbers": (array(laughs()), "shape"),
    "objects in an array of numbers": (array((1,), dtype="O"), "items"),
    "addresses in an array of objects": (pointers(), "other items"),
    "an array whose type has fields": (array((1,), dtype=[("a", "f8")]), "numbers and text"),
    "bytes that claim 2^60": (b"\x80\x04\x8e" + (2**60).to_bytes(8, "little") + b"abc.", "asks for more memory"),
    "a place of 2^32 in the memory": (b"\x80\x02Nr\xff\xff\xff\xff.", "memory|not a readable pickle"),
    "a sparse matrix of 10^18": (sparse(_shape=(10**9, 10**9)), "makes far more bytes"),
    "a sparse matrix that points outside": (sparse(indices=np.array([0, 1, 99], np.int32)), "not a readable pickle"),
    "persistent ids": (b"P1\n.", "not a readable pickle"),
    "a call of data": (b"\x80\x02](tR.", "not a readable pickle"),
    "another state for a class": (
        b"\x80\x02cnumpy\nndarray\nN}X\x04\x00\x00\x00madecnumpy\ndtype\ns\x86b.",
        "not a readable",
    ),
    "a class of Python's own made anew": (b"\x80\x02c__builtin__\nobject\n)\x81.", "stores a name"),
    "one string in 9000 arrays": (python2_arrays(">f8"), "makes far more bytes than it holds"),
    "one list in 2000 arrays": ([array((2000,), DAG, "O") for _ in range(2000)], "unfolds to more"),
    "text": (b"hello", "no pickle .it begins with b.hello"),
    "more values than are allowed": (pickle.dumps(list(range(MAX_VALUES)), 2), "unfolds to more"),
    "lists that take all memory": (b"\x80\x02" + b"]" * (16 << 20), "memory|end|not a readable pickle"),
    "a key that hashes for ever": (b"\x80\x02}" + b")" + b"\x85" * 3_000_000 + b"Ns.", "reader|text nor a number"),
}
HARMLESS = {
    "keys whose hashes may collide": dict.fromkeys(KEYS),
    "such keys as pairs": OrderedDict([[float(k), 0] for k in KEYS]),
    "keys of one hash": {k * (2**61 - 1): 0 for k in range(3000)},
    "one tuple 4^30 times": laughs(),
    "instructions without end": None,
}


def memory_of(process):
    """Most resident memory so far, KiB."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused_in_one_line(name):
    value, message = HOSTILE[name]
    raw = value if isinstance(value, bytes) else pickle.dumps(value, 2)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileError, match=message) as refused:
        read_pickle(raw, where="hand.pkl")
    assert str(refused.value).startswith("hand.pkl: ") and "\n" not in str(refused.value)
    assert not os.path.exists("/tmp/r2h_batch_pickle_ran")
    here = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10
    assert here < 6 * len(raw) + MADE_BYTES + (64 << 20)
    child = safe_pickle._reader._child  # None: what is hostile has ended it
    assert child is None or memory_of(child.pid) << 10 < STANDING_BYTES + STANDING_PER_BYTE * (64 << 20)
    assert read_pickle(pickle.dumps({"a": np.ones(2)}))["a"].tolist() == [1, 1]  # the next file is read as ever


@pytest.mark.parametrize("name", HARMLESS)
def test_pickles_that_take_long_elsewhere_are_read_harmlessly(name):
    value = HARMLESS[name]
    raw = b"\x80\x02" + b"N0" * (1 << 20) + b"N." if value is None else pickle.dumps(value, 2)
    found = read_pickle(raw)
    while name.startswith("one tuple"):
        if len(found) == 1:
            return
        assert len(found) == 4 and all(part is found[0] for part in found)
        found = found[0]
    assert found == value


@pytest.mark.alone
def test_the_process_that_reads_is_not_shared_with_a_fork_and_ends_with_its_parent():
    read_pickle(pickle.dumps([1]))
    end = os.fork()
    if not end:  # a fork asks a process of its own
        found = read_pickle(pickle.dumps([2]))
        safe_pickle._reader.close()
        os._exit(found != [2])
    assert os.waitstatus_to_exitcode(os.waitpid(end, 0)[1]) == 0
    assert read_pickle(pickle.dumps([3])) == [3]
    code = (
        "import os, pickle, signal; from r2h_batch.data import safe_pickle as s; s.read_pickle(pickle.dumps(1));"
        " print(s._reader._child.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert done.returncode == -signal.SIGKILL and all_end([int(done.stdout)], 5)


def test_cut_and_changed_pickles_never_raise_anything_else():
    raw = pickle.dumps({**ARRAYS, "m": scipy.sparse.csc_matrix(np.eye(4))}, 2)
    for end in each(range(0, len(raw) - 1, 7)):
        with pytest.raises(FileError):
            read_pickle(raw[:end])
    rng = np.random.default_rng(1)
    for _ in range(1000):
        changed = bytearray(raw)
        changed[int(rng.integers(len(raw)))] = int(rng.integers(256))
        with contextlib.suppress(FileError):
            read_pickle(bytes(changed))


def test_chumpy_arrays_are_read_without_chumpy():
    source = np.random.default_rng(2).random((7, 3, 20))
    shape = (7, 3, 10)
    raw = with_fake_chumpy(
        lambda Ch, Select: {"x": Select(a=Ch(x=source), idxs=first_ten(source), preferred_shape=shape)}
    )
    assert "chumpy" not in sys.modules
    assert np.array_equal(read_pickle(raw)["x"], source[:, :, :10])
