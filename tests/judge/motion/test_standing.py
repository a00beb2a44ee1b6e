"""Worlds that stand between batches: built once, and no batch sees anything of the one before."""

from dataclasses import replace
from unittest import mock

import mujoco_warp as mjw
import pytest
import torch
import warp as wp
from motions import BRIEF_WARP, problems, reference_run, run
from rounds import each

from r2h_batch.judge.motion import sim_mjwarp
from r2h_batch.judge.motion.time_law import time_path

ARM = replace(BRIEF_WARP, model="arm")


@pytest.fixture(autouse=True)
def fresh_worlds():
    sim_mjwarp.forget_worlds()
    yield
    sim_mjwarp.forget_worlds()


def some_paths(keep: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    """The problems' paths, of which only those at `keep` are moved."""
    p = problems()
    length = torch.zeros_like(p.plan.length)
    length[keep] = p.plan.length[keep]
    return p.plan.path, length


@pytest.mark.parametrize("config", [ARM, pytest.param(BRIEF_WARP, marks=pytest.mark.slow)], ids=["arm", "scene"])
def test_a_second_batch_builds_nothing_and_moves_as_if_it_were_the_first(config):
    found = torch.nonzero(problems().plan.length > 0).flatten().tolist()
    assert len(found) >= 8
    batches = [
        found[:7],
        found[1:6],
        found[2:7],
    ]  # each in four worlds; a hand that the first lacks would build a new model
    with (
        mock.patch.object(mjw, "put_model", wraps=mjw.put_model) as models,
        mock.patch.object(wp, "ScopedCapture", wraps=wp.ScopedCapture) as graphs,
    ):
        kept = [run(config, *some_paths(rows)) for rows in batches]
    # the first has the most trials; samples need more room once
    assert models.call_count == 1 and graphs.call_count <= 2
    for rows, e in zip(batches, kept, strict=True):
        sim_mjwarp.forget_worlds()
        fresh = run(config, *some_paths(rows))
        assert torch.equal(e.path, fresh.path) and torch.equal(e.length, fresh.length)
        assert torch.equal(e.slack_m, fresh.slack_m) and torch.equal(e.settled, fresh.settled)


@pytest.mark.parametrize("config", [ARM, BRIEF_WARP], ids=["arm", "scene"])
def test_what_failed_in_a_world_is_gone_with_the_next_trial(config, monkeypatch):
    """The simulator reads speeds of the step before: a trial after one that was not finite was lost with it."""
    monkeypatch.setitem(sim_mjwarp.MAX_WORLDS, "cpu", 1)
    found = torch.nonzero(problems().plan.length == 2).flatten().tolist()
    path, length = some_paths(found[:2])
    good = run(config, path, length)
    sim_mjwarp.forget_worlds()
    for row in found[:2]:  # the longer one runs first
        for waypoint in (0, 1):
            broken, motion = path.clone(), time_path(path, length, config)
            broken[row, waypoint, 3] = torch.nan
            e = run(config, broken, length, motion)
            other = found[0] + found[1] - row
            n = int(good.length[other])
            assert not e.valid[row] and e.valid[other] and torch.equal(e.path[other, :n], good.path[other, :n])
    assert torch.equal(run(config, path, length).path, good.path)


def test_more_trials_than_there_was_room_for_find_more(monkeypatch):
    whole = reference_run(ARM)
    found = torch.nonzero(problems().plan.length > 0).flatten().tolist()
    monkeypatch.setitem(sim_mjwarp.MAX_WORLDS, "cpu", 1)  # one world for any number of trials
    for rows in (found[:1], found):
        e = run(ARM, *some_paths(rows))
        for i in each(rows):
            n = int(whole.length[i])
            assert int(e.length[i]) == n and torch.equal(e.path[i, :n], whole.path[i, :n])
