"""Lifting in physics: what is between the pads comes along, what is not stays where it lies."""

from functools import cache

import numpy as np
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.lift_physics import lift_in_physics
from r2h_batch.judge.pick import picked
from r2h_batch.observe import moments
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.runs.store import load_run


@cache
def taken():
    """Stored grasps of Handover-VA that Pick accepts: robot's scene, objects, grasps, rests."""
    scene = Evaluator(load_benchmark("r2h-v2"), EvalConfig(execute=ExecConfig(sim="none"))).scene
    run = load_run(next(f for f in stored_rows() if f.name == "r2h-v2"))
    name = next(e.name for e in run.entries if "VA" in e.name)
    rows = run.poses(name).slice(0, 12).to_pylist()
    trials = load_benchmark("r2h-v2").trials_with_ids(torch.tensor([r["trial_id"] for r in rows]))
    grasps = torch.tensor([r["T_obj_ee"] for r in rows]).reshape(-1, 4, 4)
    rests = moments(scene, trials)
    got = picked(scene, grasps, rests, trials).picked.nonzero().flatten()[:4]
    return scene, trials.object_index[got].numpy(), grasps[got].double().numpy(), rests[got].double().numpy()


def lifted(grasps):
    scene, objects, _, rests = taken()
    place = scene.config.workplace
    top = place.table_center[2] + place.table_half[2]
    return lift_in_physics(scene.objects, objects, grasps, rests, scene.robot, table_m=top)


def test_what_pick_accepts_comes_up_with_the_gripper():
    _, _, grasps, rests = taken()
    result = lifted(grasps)
    rise = result.T_world_obj[:, 2, 3] - rests[:, 2, 3]
    assert len(rise) == 4 and result.held.sum() >= 3
    for i in each(np.flatnonzero(result.held)):
        assert abs(rise[i] - 0.1) < 0.02
        assert np.linalg.norm(result.T_world_obj[i, :2, 3] - rests[i, :2, 3]) < result.moved_m[i] + 0.02


def test_what_is_not_between_the_pads_stays_on_the_table():
    """The gripper closes 25 cm to the side, and turned: the object neither moves nor sinks."""
    _, _, grasps, rests = taken()
    for turn in each((np.eye(3), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))):
        aside = grasps.copy()
        aside[:, :3, :3] = aside[:, :3, :3] @ turn
        aside[:, :3, 3] += 0.25 * rests[:, 0, :3]  # along the world's x
        result = lifted(aside)
        assert not result.held.any()
        assert np.allclose(result.T_world_obj, rests, atol=2e-3)
        assert np.allclose(result.slip_m, 0.1, atol=2e-3) and result.moved_m.max() < 2e-3
