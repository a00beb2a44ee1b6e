"""What is kept on disk: made once, by one process, and made again whenever it cannot be read or depends on other things."""

import fcntl
import multiprocessing
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from r2h_batch.bodies.hand import load_hand
from r2h_batch.bodies.mesh_import.cache import FORM as OBJECT
from r2h_batch.bodies.mesh_import.cache import SAID, kept_with_warnings

# what goes to disk and back; the public way builds a mesh
from r2h_batch.bodies.objects import ObjectModel, _as_arrays, _from_arrays, load_objects, object_digest
from r2h_batch.io import cache as module
from r2h_batch.io.cache import SEAL, ArraySpec, cache_folder, cached, matches
from r2h_batch.receiver import receiving

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


def test_forms_say_types_shapes_and_what_indices_may_be():
    form = {
        "v": ArraySpec("float32", ("v", 3)),
        "f": ArraySpec("int32", ("f", 3), below="v"),
        "g": ArraySpec("float32", gaps=True),
    }
    good = {
        "v": np.zeros((4, 3), np.float32),
        "f": np.array([[0, 1, 3]], np.int32),
        "g": np.float32(np.nan).reshape(()),
    }
    assert matches(good, form)
    for name, wrong in {
        "v": [good["v"].astype(float), good["v"][:3], good["v"][:, :2], good["v"] * np.float32(np.nan)],
        "f": [good["f"] - 1, good["f"] + 1, good["f"][0], good["f"].astype(np.int64)],
        "g": [np.float32(np.inf).reshape(()), np.zeros(1, np.float32), np.array("a")],
    }.items():
        for value in wrong:
            assert not matches({**good, name: value}, form)


def test_an_object_that_is_none_is_built_again(folder):
    """An entry with a right seal whose words are no repair, or whose warnings are no list: as if it were not there."""
    (model,) = load_objects(["cup"])
    asked = []

    def built() -> dict[str, object]:
        asked.append(1)
        return _as_arrays(model)

    def again() -> ObjectModel:
        return _from_arrays(kept_with_warnings(KEY, built, _from_arrays))

    assert object_digest(again()) == object_digest(again()) == object_digest(model) and len(asked) == 1
    (file,) = folder.glob("objects/*.npz")
    good = {k: v for k, v in np.load(file).items() if k != SEAL}
    assert set(good) == set(OBJECT)
    for change in (
        {"repair": np.array("{}x")},
        {"repair": np.array('{"a": 1}')},
        {SAID: np.array("7")},
        {"mass": good["com"]},
    ):
        wrong = {**good, **change}
        np.savez(file, **wrong, **{SEAL: np.array(f"objects {KEY} {module._sha256(wrong)}")})
        before = len(asked)
        assert object_digest(again()) == object_digest(model) and len(asked) == before + 1


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


def test_a_process_that_holds_the_lock_and_does_nothing_is_waited_for_with_a_line_and_not_for_ever(
    folder, monkeypatch, capsys
):
    monkeypatch.setattr(module, "REPORT_AFTER_S", 0.05)
    monkeypatch.setattr(module, "GIVE_UP_AFTER_S", 0.2)
    (folder / "things").mkdir(parents=True)
    with (folder / "things" / f"{KEY}.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert cached("things", KEY, Maker(), FORM)["x"].shape == (5,)
    assert capsys.readouterr().err.count("another process is making this entry") == 1


def test_a_folder_of_a_name_too_long_is_one_warning_and_a_home_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("R2H_BATCH_CACHE", "x" * 5000)
    make = Maker()
    with pytest.warns(UserWarning, match="xx...xxx*: the cache cannot be written there .File name too long") as told:
        for _ in range(2):
            assert cached("things", KEY, make, FORM)["x"].shape == (5,) and not module.is_cached("things", KEY)
    assert len(told) == 1 and make.times == 2
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("R2H_BATCH_CACHE", "~/mine")
    assert cache_folder() == tmp_path / "mine"


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


def test_receiving_grasps_of_a_users_object_are_sampled_once_for_each_hand_and_shape(monkeypatch):
    asked = []

    def sampled(model, *, hand):
        asked.append((model.name, hand.digest[:4]))
        return {k: np.zeros((1, *c.shape[1:]), c.dtype) for k, c in receiving.FORM.items()}

    monkeypatch.setattr(receiving, "sample_receiving", sampled)
    (cup,) = load_objects(["cup"])
    own = replace(cup, vertices=(cup.vertices * np.float32(1.01)))
    hand = load_hand()
    other = replace(hand, vertices=hand.vertices * 1.01)
    find = receiving._of_object.__wrapped__  # what is remembered in this process is not what is asked here
    for _ in range(2):
        for model, mine in ((own, hand), (own, other), (replace(own, instruction="cup please"), hand)):
            assert set(find(model, mine)) == set(receiving.FIELDS)
    assert len(asked) == 3
    assert find(cup, hand)["side"].shape == (64,) and len(asked) == 3  # the built-in ones are stored
