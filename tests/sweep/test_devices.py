"""A GPU that is not there, has an old driver, or is lost in the middle: simulated with what torch and Warp raise, on a CPU."""

import sys

import pytest
import torch
from fake_bench import FakeEvaluator, best
from fake_bench import set_up as set_up_fake

from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs

OLD = (
    "The NVIDIA driver on your system is too old (found version 11040). Please update your GPU driver by downloading and "
    "installing a new version from the URL: ..."
)
NONE = "Found no NVIDIA driver on your system. Please check that you have an NVIDIA GPU and installed a driver from ..."


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError(NONE), "Found no NVIDIA driver on your system"),
        (RuntimeError(OLD), "The NVIDIA driver on your system is too old (found version 11040)"),
    ],
)
def test_a_gpu_that_cannot_be_had_is_refused_with_torchs_reason(error, words, tmp_path, monkeypatch, capsys):
    def init():
        raise error

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "init", init)
    line = [
        "--device",
        "cuda",
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "1",
        "--out",
        str(tmp_path / "run"),
    ]
    assert sweep.main(line) == 2
    assert capsys.readouterr().err == f"sweep: --device cuda: torch sees no CUDA device ({words}); use --device cpu\n"
    assert not (tmp_path / "run").exists()


LOST = {
    "torch": lambda: torch.AcceleratorError("CUDA error: unspecified launch failure\nCUDA kernel errors might be ..."),
    "warp's memory": lambda: RuntimeError("Failed to allocate 1024 bytes on device 'cuda:0'"),
}


@pytest.mark.parametrize(("what", "who"), [*zip(LOST, ["the evaluator", "the method"], strict=True)])
def test_a_gpu_that_is_lost_is_one_line_and_the_same_command_goes_on(what, who, tmp_path, monkeypatch, capsys):
    mine, real, calls = type(sys)("mine"), FakeEvaluator.score, []

    def once_it_was_there(by):
        calls.append(by)
        if calls.count(by) == 4 and by == who:  # shards were stored before
            raise LOST[what]()

    def method(trials, scene, *, seed):
        once_it_was_there("the method")
        return best(trials, scene, seed=seed)

    def score(self, *given, **options):
        once_it_was_there("the evaluator")
        return real(self, *given, **options)

    mine.best = method
    monkeypatch.setitem(sys.modules, "mine", mine)
    monkeypatch.setattr(FakeEvaluator, "score", score)
    monkeypatch.setattr(jobs, "set_up", set_up_fake)
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "mine:best",
        "--trials",
        "9",
        "--shard-trials",
        "3",
        "--out",
        str(tmp_path / "run"),
    ]
    assert sweep.main(line) == 1
    said = capsys.readouterr().err
    (last,) = [x for x in said.splitlines() if "shards that were complete are stored; run the same command" in x]
    assert str(LOST[what]()).partition("\n")[0] in last and "Traceback" not in said
    stored = {f.name: f.read_bytes() for f in (tmp_path / "run" / "shards").rglob("*.parquet")}
    assert 0 < len(stored) < 6
    assert sweep.main(line) == 0
    now = {f.name: f.read_bytes() for f in (tmp_path / "run" / "shards").rglob("*.parquet")}
    assert len(now) == 6 and stored.items() <= now.items()
    whole = [*line[:-1], str(tmp_path / "undisturbed")]
    assert sweep.main(whole) == 0
    assert load_run(tmp_path / "run").digest("mine:best") == load_run(tmp_path / "undisturbed").digest("mine:best")
