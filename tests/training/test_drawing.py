"""Instances that other processes draw: the same items whoever draws them, in groups that take turns; processes that end."""

import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import islice

import pytest
import torch
from alive import alive, all_end, children_of, until
from rounds import each
from torch.utils.data import DataLoader

from r2h_batch import load_benchmark
from r2h_batch.scene.families.kept import was_drawn
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.training import stream
from r2h_batch.training.drawing import Drawing
from r2h_batch.training.rank import CHECKPOINT, Recipe, Training, train_ranker
from r2h_batch.trials.family_objects import drawn_instance, planned_objects

FAMILIES = "knife,bottle x 3 seed 9"
SIZES = {"pairs": 4, "trials": 8, "items": 7, "renew": 2}
MANY = "* x 20 seed 11"
"""More than is drawn while a test waits."""


def forget():
    """Drops the instances of this process: what comes next is read from disk, or drawn."""
    drawn_instance.cache_clear()


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """A cache on disk that holds nothing."""
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache"
    forget()


def there(planned):
    return [was_drawn(p.family, p.series, p.index) for p in planned]


def differing(a, b):
    """Names of the tensors that are not the same bits."""
    return [
        k
        for k in a.keys() | b.keys()
        if not (k in a and k in b and torch.equal(a[k].nan_to_num(-9.0), b[k].nan_to_num(-9.0)))
    ]


FEW, MORE = ((0, "fork"), (2, "fork")), ((0, "spawn"), (1, "spawn"), (2, "fork"))
"""Processes that draw, and how those of a loader are started (spawned ones: tests/test_examples.py too). Each draws all anew."""


@pytest.mark.parametrize("ways", [FEW, pytest.param(MORE, marks=pytest.mark.slow)], ids=["few", "more"])
def test_items_are_the_same_bits_for_any_number_of_processes_that_draw_and_that_load(ways, cold, monkeypatch):
    runs, count = [], 3 if ways is FEW else 6
    families, sizes = (FAMILIES, SIZES) if ways is MORE else ("knife x 3 seed 9", {**SIZES, "items": 5})
    for workers, how in each(ways):
        monkeypatch.setenv("R2H_BATCH_CACHE", str(cold / str(workers)))
        forget()
        pairs = stream(load_benchmark(), families, workers=workers, **sizes)
        assert len(pairs.left_out.names if pairs.left_out else pairs.names) == count
        loaded = [*DataLoader(pairs, None, num_workers=2, multiprocessing_context=how)]
        for way, run in {
            "in turn": [*pairs],
            how: loaded,
            "by number": [pairs.item(i) for i in range(sizes["items"])],
        }.items():
            runs.append(run)
            differ = [(i, k) for i, (a, b) in enumerate(zip(runs[0], run, strict=True)) for k in differing(a, b)]
            assert len(run) == sizes["items"] and not differ, (
                f"drawn by {workers} more processes, loaded {way}: item and tensor {differ}"
            )
        pairs.close()
    plain = stream(load_benchmark(), families, **{**sizes, "renew": 0})  # else nothing would change
    assert differing(runs[0][3], plain.item(3))


def test_the_next_instances_take_the_place_of_those_before_and_the_first_come_again(cold):
    pairs = stream(load_benchmark(), FAMILIES, leave_out=["bottle_*_01"], regions=1, workers=0, **SIZES)
    names = [[o.name for o in pairs.world(i).benchmark.objects] for i in range(7)]
    index = [{n.split("_")[2] for n in some} for some in names]
    assert index == [{"00"}, {"00"}, {"01"}, {"01"}, {"02"}, {"02"}, {"00"}] and names[6] == names[0]
    assert names[0] == ["knife_s1009_00", "bottle_s1009_00", "knife_s1009_00_region0", "bottle_s1009_00_region0"]
    assert names[2] == ["knife_s1009_01", "knife_s1009_01_region0"]
    assert pairs.left_out.names == ("bottle_s1009_01",)
    assert {o.name for o in pairs.left_out.objects} == {"bottle_s1009_01", "bottle_s1009_01_region0"}
    assert pairs.names == tuple(f"{c}_s1009_{i:02d}" for i in range(3) for c in ("knife", "bottle"))[:3] + (
        "knife_s1009_02",
        "bottle_s1009_02",
    )
    for item in each(islice(pairs, 3, 6)):
        objects = pairs.world(int(item["index"])).benchmark.objects
        points = torch.tensor(objects[int(item["object_index"][0])].points)
        assert (torch.cdist(item["cloud"][0], points).amin(1) < 1e-4).all()
    with pytest.raises(ValueError, match="renew draws instances of families"):
        stream(load_benchmark(), pairs.world(0).benchmark.objects, renew=2)


def test_other_processes_draw_what_comes_later_while_this_one_has_the_first(cold):
    planned = planned_objects(f"families:{FAMILIES}")
    first = [k for k, p in enumerate(planned) if p.index == 0]
    drawing = Drawing(planned, load_robot(), "filtered", workers=2)
    assert len(drawing.running) == 2
    found = drawing.objects(first)
    assert [o.name for o in found] == ["knife_s1009_00", "bottle_s1009_00"]
    assert until(lambda: all(there(planned)) and not drawing.running, 90)
    drawn = len([*(cold / "candidates").glob("*.npz")])
    assert drawn == 6
    drawing.close()
    again = Drawing(planned, load_robot(), "filtered", workers=2)
    assert not again.running  # nothing is left to draw


@pytest.mark.alone
def test_the_loader_says_that_a_process_was_killed_and_what_it_had_begun_is_drawn_here(cold):
    planned = planned_objects(f"families:{FAMILIES}")
    drawing = Drawing(planned, load_robot(), "filtered", workers=1)
    (pid,) = drawing.running
    with pytest.raises(RuntimeError, match="killed by signal"):  # torch's word
        os.kill(pid, signal.SIGKILL)
        time.sleep(20)
    assert until(lambda: not drawing.running, 10)
    found = drawing.objects(range(6))
    assert all(isinstance(o, ObjectModel) for o in found) and all(there(planned))
    drawing.close()


def test_a_process_that_may_start_none_draws_alone(cold):
    """A stream that is made in a worker of somebody's DataLoader."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork"), initializer=daemonic) as pool:
        assert pool.submit(drawn_in_a_daemon).result() == ([], "knife_s1009_00")


def daemonic():
    multiprocessing.current_process()._config["daemon"] = True


def drawn_in_a_daemon():
    drawing = Drawing(planned_objects("families:knife x 1 seed 9"), load_robot(), "filtered", workers=1)
    return [*drawing.running], drawing.objects([0])[0].name


def test_without_a_cache_on_disk_nobody_else_draws(monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", "off")
    forget()
    drawing = Drawing(planned_objects("families:knife x 1 seed 9"), load_robot(), "filtered", workers=2)
    assert not drawing.running and [o.name for o in drawing.objects([0])] == ["knife_s1009_00"]
    drawing.close()
    forget()


PROGRAM = """
import json, multiprocessing, os, sys, time
from r2h_batch import load_benchmark
from r2h_batch.training import stream
if __name__ == "__main__":
    {first}
    pairs = stream(load_benchmark(), {families!r}, renew=1, workers=2, pairs=4, trials=8)
    print(json.dumps({{"running": pairs.drawing}}), flush=True)
    sys.stdin.readline()
    {then}
"""
SPAWN = "multiprocessing.set_start_method('spawn')"
DATA_LOADER = "from torch.utils.data import DataLoader; [0 for x in DataLoader(pairs, batch_size=None, num_workers=2)]"
ENDS = {
    "the end of the program": ("", ""),
    "the end of the program, spawned": (SPAWN, ""),
    "an error": ("", "raise RuntimeError('mine')"),
    "the stream is used no longer": ("", "del pairs; time.sleep(60)"),
    "it is closed": ("", "pairs.close(); print(json.dumps(pairs.drawing), flush=True); time.sleep(60)"),
    "a fork ends": (
        "",
        "own = multiprocessing.get_context('fork').Process(target=int); own.start(); own.join();"
        " print(json.dumps(pairs.drawing), flush=True); time.sleep(60)",
    ),
    "ctrl-c": ("", "[None for item in pairs]"),
    "ctrl-c to its workers": ("", DATA_LOADER),
    "a kill": ("", "[None for item in pairs]"),
    "a kill, spawned": (SPAWN, "[None for item in pairs]"),
    "a kill, of a server's forks": (SPAWN.replace("spawn", "forkserver"), "[None for item in pairs]"),
}


RARE = ("the end of the program, spawned", "an error", "a kill, spawned", "a kill, of a server's forks")
RARE += ("the stream is used no longer", "ctrl-c to its workers")
"""Ways of which `make test` has another one: the same end, of processes that were started otherwise, of a program that
ends, without a loader's workers."""


def marked(how):
    rare, closed = [pytest.mark.slow] * (how in RARE), [pytest.mark.whole(part="training")] * (how == "it is closed")
    return pytest.param(how, marks=[*rare, *closed])


@pytest.mark.alone
@pytest.mark.parametrize("how", [marked(how) for how in ENDS])
def test_processes_end_with_the_program_however_that_ends(how, tmp_path):
    first, then = ENDS[how]
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(families=MANY, first=first, then=then))
    env = {**os.environ, "R2H_BATCH_CACHE": str(tmp_path / "cache")}
    child = subprocess.Popen(
        [sys.executable, str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=env, start_new_session=True,
    )  # fmt: skip
    try:
        pids = json.loads(child.stdout.readline())["running"]
        assert len(pids) == 2 and all(map(alive, pids))
        child.stdin.write("go on\n"), child.stdin.flush()
        if how == "a fork ends":
            assert json.loads(child.stdout.readline()) == pids and all(map(alive, pids))
            child.terminate()
        elif how == "it is closed":
            assert json.loads(child.stdout.readline()) == [] and not any(map(alive, pids))
        elif how.startswith(("ctrl-c", "a kill")):
            assert until(lambda: len([*(tmp_path / "cache" / "objects").glob("*.npz")]) > 2, 180)
            pids += children_of(child.pid)
            os.killpg(child.pid, signal.SIGINT) if how.startswith("ctrl-c") else child.kill()
        assert all_end(pids, 60)
        if how in ("the stream is used no longer", "it is closed"):
            child.kill()
        error = child.communicate(timeout=60)[1]
        assert "DataLoader worker" not in error
        assert error.count("Traceback") <= (1 if "workers" not in how else 9), error
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


@pytest.mark.whole(part="training")
def test_weights_do_not_depend_on_who_draws_or_on_an_interruption(cold, tmp_path, monkeypatch):
    recipe = Recipe(
        families=FAMILIES, regions=0, items=3, steps=7, rounds=1, mined_items=1, mined_steps=2, renew=2, seed=3
    )
    stages = [(s.name, [*s.items], s.begin, s.end) for s in recipe.stages]
    assert stages == [("0-0", [0, 1], 0, 4), ("0-1", [2], 4, 7), ("1", [3], 7, 9)]
    monkeypatch.setattr("r2h_batch.training.rank.TRIALS", 16)
    found = []
    for workers in each([0, 2]):
        monkeypatch.setenv("R2H_BATCH_CACHE", str(cold / str(workers)))
        forget()
        out = tmp_path / f"of {workers}"
        path = train_ranker(load_benchmark(), recipe, out, tell=lambda s: None, workers=workers)
        found.append(path.read_bytes())
    step = Training.learn

    def stopped(self):
        if self.step == 5:
            raise KeyboardInterrupt
        step(self)
        self.keep()

    monkeypatch.setattr(Training, "learn", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_ranker(load_benchmark(), recipe, tmp_path / "parts", tell=lambda s: None)
    monkeypatch.setattr(Training, "learn", step)
    assert (tmp_path / "parts" / CHECKPOINT).is_file()
    parts = train_ranker(load_benchmark(), recipe, tmp_path / "parts", tell=lambda s: None)
    assert found[0] == found[1] == parts.read_bytes()
    about = json.loads(found[0][8 : 8 + int.from_bytes(found[0][:8], "little")])["__metadata__"]
    assert all(f"{c}_s1009_0{i}" in str(about) for c in ("knife", "bottle") for i in range(3))
