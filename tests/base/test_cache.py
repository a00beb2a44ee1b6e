"""Entries of the disk cache: made once, by one process, and made again whenever it cannot be read or depends on other
things."""

import errno
import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest

# what goes to disk and back; the public way builds a mesh
from r2h_batch.base.io import cache as module
from r2h_batch.base.io.cache import SEAL, ArraySpec, cache_folder, cached
from r2h_batch.methods.candidates import CODE as CANDIDATES
from r2h_batch.scene.families.kept import CODE as INSTANCES
from r2h_batch.scene.mesh_import.cache import CODE as OBJECTS
from r2h_batch.trials.holding.held_out import MADE_BY as HELD_OUT
from r2h_batch.trials.holding.receiving import CODE as RECEIVING

KEY = "ab" * 32
FORM = {"x": ArraySpec("float64", ("rows",)), "n": ArraySpec("text", ("names",))}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Maker:
    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.times += 1
        return {"x": np.arange(5.0), "n": np.array(["a", "b"])}


def test_made_once_and_again_when_damaged_or_forbidden(folder, monkeypatch):
    make = Maker()
    for _ in range(2):
        found = cached("things", KEY, make, FORM)
        assert found["x"].tolist() == [0, 1, 2, 3, 4] and found["n"].tolist() == ["a", "b"]
    assert make.times == 1
    cached("things", "cd" * 32, make, FORM)
    assert make.times == 2
    (file,) = (folder / "things").glob(f"{KEY}.npz")
    data = bytearray(file.read_bytes())
    data[60] ^= 1
    file.write_bytes(data)
    assert cached("things", KEY, make, FORM)["x"].tolist() == [0, 1, 2, 3, 4] and make.times == 3
    np.savez(file, x=np.array([object()], object))
    assert cached("things", KEY, make, FORM)["x"].shape == (5,) and make.times == 4  # a pickle is not opened
    monkeypatch.setenv("R2H_BATCH_CACHE", "off")
    assert cache_folder() is None and cached("things", KEY, make, FORM) and make.times == 5
    monkeypatch.setenv("R2H_BATCH_CACHE", "/dev/null/no")
    with pytest.warns(UserWarning, match="the cache cannot be written there .Not a directory"):
        assert cached("things", KEY, make, FORM) and make.times == 6
    assert not list(folder.rglob(".*"))


def test_a_full_disk_is_told_and_leaves_no_part_of_an_entry(folder, monkeypatch):
    def full(path, arrays):
        path.parent.mkdir(parents=True, exist_ok=True)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    make = Maker()
    with monkeypatch.context() as patch, pytest.warns(UserWarning, match=r"cannot be written there \(No space left"):
        patch.setattr(module, "write_npz", full)
        assert cached("things", KEY, make, FORM)["x"].shape == (5,)
    assert not list(folder.rglob("*.npz")) and make.times == 1
    assert cached("things", KEY, make, FORM) and make.times == 2 and _entry(folder).exists()


def _entry(folder: Path) -> Path:
    (file,) = folder.glob(f"things/{KEY}.npz")
    return file


def test_an_entry_of_another_key_or_with_other_arrays_is_made_again(folder):
    """Files that read well: swapped, changed, of another form. Nobody's word is taken for what an entry is."""
    make = Maker()
    cached("things", "cd" * 32, make, FORM)
    cached("things", KEY, make, FORM)
    file = _entry(folder)
    good = dict(np.load(file))
    other = {**dict(np.load(file.with_name("cd" * 32 + ".npz")))}
    sealed = {"x": np.array([0.0, np.nan]), "n": np.array(["a"])}
    named = {"x": np.arange(5.0), "y": np.arange(5.0)}
    for wrong in (
        other, {**good, "x": good["x"] + 1}, {**good, "y": good["x"]}, {k: good[k] for k in ("x", "n")},
        *({**a, SEAL: np.array(f"things {KEY} {module._sha256(a)}")} for a in (sealed, named)),  # a seal that fits, to the wrong
    ):  # fmt: skip
        np.savez(file, **wrong)
        before = make.times
        assert cached("things", KEY, make, FORM)["x"].tolist() == [0, 1, 2, 3, 4] and make.times == before + 1
        assert cached("things", KEY, make, FORM)["x"].tolist() == [0, 1, 2, 3, 4] and make.times == before + 1
    assert dict(np.load(file))[SEAL] == good[SEAL]


def test_an_entry_with_infinite_numbers_is_read_and_not_made_again(folder):
    """Held-out grasps that friction cannot carry have infinite grips; on disk they were sampled anew by each process."""
    made = []

    def make():
        made.append(1)
        return {"x": np.array([1.0, np.inf]), "n": np.array(["a"])}

    form = {"x": ArraySpec("float64", ("n",)), "n": ArraySpec("text", (1,))}
    for _ in range(2):
        assert cached("things", KEY, make, form)["x"].tolist() == [1.0, np.inf] and len(made) == 1


@pytest.mark.parametrize("there", ["pipe", "link", "folder"])
def test_what_stands_in_the_locks_place_is_neither_followed_nor_waited_for(folder, tmp_path, there):
    lock, precious = folder / "things" / f"{KEY}.lock", tmp_path / "precious"
    lock.parent.mkdir(parents=True)
    if there == "pipe":
        os.mkfifo(lock)
    elif there == "link":
        lock.symlink_to(precious)
    else:
        lock.mkdir()
    make = Maker()
    for _ in range(2):
        assert cached("things", KEY, make, FORM)["x"].shape == (5,) and make.times == 1
    assert not precious.exists()


def _one(folder: str, queue: "multiprocessing.Queue[int]") -> None:
    os.environ["R2H_BATCH_CACHE"] = folder

    def make() -> dict[str, np.ndarray]:
        with (Path(folder) / "made").open("a") as f:
            f.write(f"{os.getpid()}\n")
        return {"x": np.arange(200_000)}

    queue.put(int(cached("things", KEY, make, {"x": ArraySpec("int64", ("rows",))})["x"].sum()))


def test_of_several_processes_one_makes_it_and_the_others_wait(folder):
    folder.mkdir()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    workers = [context.Process(target=_one, args=(str(folder), queue)) for _ in range(4)]
    for w in workers:
        w.start()
    assert {queue.get(timeout=60) for _ in workers} == {sum(range(200_000))}
    for w in workers:
        w.join()
    assert len((folder / "made").read_text().splitlines()) == 1


@pytest.mark.parametrize(
    ("made_by", "decide", "leave"),
    [
        (
            OBJECTS,
            ("scene/objects.py", "scene/mesh_import/closed.py", "kernels/geometry/mesh_distance.py"),
            ("scene/scene.py", "scene/model.py", "scene/robot.py"),
        ),
        (
            INSTANCES,
            ("scene/families/vessels.py", "scene/families/draw.py", "base/rng.py", "scene/objects.py"),
            ("scene/scene.py", "trials/family_objects.py"),
        ),
        (
            RECEIVING,
            ("trials/holding/sampler.py", "scene/hand.py", "kernels/receiver/close_hand.py"),
            ("scene/scene.py", "trials/holding/held_out.py", "trials/draw/rule.py"),
        ),
        (
            HELD_OUT,
            ("trials/holding/sampler.py", "trials/holding/held_out.py"),
            ("scene/scene.py", "trials/draw/rule.py"),
        ),
        (
            CANDIDATES,
            ("methods/grasps.py", "judge/grasp.py", "kernels/grasp/width.py"),
            ("scene/scene.py", "methods/oracle.py", "judge/plan.py"),
        ),
    ],
    ids=["objects", "instances", "receiving", "held_out", "candidates"],
)
def test_what_is_kept_is_made_again_after_an_edit_of_the_files_that_make_it_and_of_no_other(made_by, decide, leave):
    files = [f.as_posix() for f in module.code_files(made_by)]
    assert [name for name in decide if not any(f.endswith(f"/{name}") for f in files)] == []
    assert [name for name in leave if any(f.endswith(f"/{name}") for f in files)] == []
    assert len(set(files)) == len(files)


def test_a_name_of_no_module_is_refused_where_code_is_digested():
    with pytest.raises(ModuleNotFoundError, match=r"no module r2h_batch\.scene\.gone"):
        module.code_digest(("r2h_batch.scene.gone",), ())
