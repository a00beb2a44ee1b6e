"""What is kept on disk: made once, by one process, and made again whenever it cannot be read or depends on other things."""

import multiprocessing
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from r2h_batch.bodies.hand import load_hand
from r2h_batch.bodies.objects import load_objects
from r2h_batch.files.kept import cache_folder, kept
from r2h_batch.receiver import receiving

KEY = "ab" * 32


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
        found = kept("things", KEY, make)
        assert found["x"].tolist() == [0, 1, 2, 3, 4] and found["n"].tolist() == ["a", "b"]
    assert make.times == 1
    kept("things", "cd" * 32, make)
    assert make.times == 2
    (file,) = (folder / "things").glob(f"{KEY}.npz")
    data = bytearray(file.read_bytes())
    data[60] ^= 1
    file.write_bytes(data)
    assert kept("things", KEY, make)["x"].tolist() == [0, 1, 2, 3, 4] and make.times == 3
    np.savez(file, x=np.array([object()], object))
    assert kept("things", KEY, make)["x"].shape == (5,) and make.times == 4  # a pickle is not opened
    monkeypatch.setenv("R2H_BATCH_CACHE", "off")
    assert cache_folder() is None and kept("things", KEY, make) and make.times == 5
    monkeypatch.setenv("R2H_BATCH_CACHE", "/dev/null/no")
    assert kept("things", KEY, make) and make.times == 6
    assert not list(folder.rglob(".*"))


def _one(folder: str, queue: "multiprocessing.Queue[int]") -> None:
    os.environ["R2H_BATCH_CACHE"] = folder

    def make() -> dict[str, np.ndarray]:
        with (Path(folder) / "made").open("a") as f:
            f.write(f"{os.getpid()}\n")
        return {"x": np.arange(200_000)}

    queue.put(int(kept("things", KEY, make)["x"].sum()))


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
        return {k: np.zeros(1) for k in receiving.FIELDS}

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
