"""Where the search for the hand's nearest point starts: never below it, and with no trace in what is found."""

import numpy as np
import pytest
import torch
import warp as wp
from problems import default_evaluator, make_batch

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.judge.goal_distance import goal_safe_distance
from r2h_batch.kernels.judge.hand_distance import posture_distance
from r2h_batch.kernels.judge.nearness import guessed_distance
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.joints import FIELDS, vecq
from r2h_batch.kernels.robot.posture import load
from r2h_batch.kernels.robot.world import TrialBodies, World, forward_kinematics

wp.set_module_options(OPTIONS | {"max_unroll": 0})

CAP_M = 0.05


@wp.kernel
def _from_cap(
    first: int, cap: float, world: World, mesh: HandMesh, bodies: TrialBodies, q_in: wp.array2d(dtype=float),
    distance_out: wp.array(dtype=float), body_out: wp.array(dtype=int), point_out: wp.array(dtype=wp.vec3),
    inside_out: wp.array(dtype=int), guess_out: wp.array(dtype=float),
):  # fmt: skip
    """The same as `goal_safe_distance` without a guess; and the guess."""
    trial = first + wp.tid()
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    mask[0] = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
    q = load(q_in, trial)
    found = posture_distance(world, mesh, bodies, trial, q, vecq(), cap, 0.0, mask, R, p, w, v, tri)
    distance_out[trial] = found.distance
    body_out[trial] = found.body
    inside_out[trial] = found.inside
    if found.body >= 0:
        point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (found.point - bodies.p_hand_world[trial])
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, R, p)
    guess_out[trial] = guessed_distance(world, mesh, bodies, trial, cap, R, p, tri)


def _near_hands(n: int, seed: int) -> dict:
    """Postures at and about the goals of n trials: most of them near the hand or in it."""
    evaluator = default_evaluator()
    scene = evaluator.scene
    b = make_batch(scene, n, seed=seed)
    scores = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials, stages="pose")
    opening = torch.nan_to_num(scores.opening_m, nan=0.05).clamp(0.0, 0.085)
    g = torch.Generator().manual_seed(seed)
    q = torch.nan_to_num(scores.q_goal) + 0.05 * torch.randn(n, 6, generator=g)
    body_poses = scene.body_poses(
        b.trials.object_index, b.trials.hand_index, b.T_obj_ee, b.trials.T_world_hand, opening
    )
    return {"world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies, "cap": CAP_M, "q": q}


@pytest.mark.parametrize("n", [384, pytest.param(8192, marks=pytest.mark.slow)])
def test_the_guess_bounds_the_distance_and_leaves_no_trace_in_what_is_found(n):
    asked = _near_hands(n, seed=3)
    point = torch.full((n, 3), torch.nan)
    found = {"distance": torch.empty(n), "body": torch.empty(n, dtype=torch.int32), "point": point}
    from_cap = {k: v.clone() for k, v in found.items()}
    extra = {"inside": torch.empty(n, dtype=torch.int32), "guess": torch.empty(n)}
    launch_trials(_from_cap, n, inputs=asked, outputs=from_cap | extra, device="cpu")
    active = torch.ones(n, dtype=torch.bool)
    launch_trials(goal_safe_distance, n, inputs=asked | {"active": active}, outputs=found, device="cpu")
    for name in found:
        assert found[name].numpy().tobytes() == from_cap[name].numpy().tobytes(), name
    distance, guess = from_cap["distance"].numpy(), extra["guess"].numpy()
    near = distance < CAP_M
    apart, met = near & (distance > 0), distance < 0
    assert apart.sum() > n / 10 and met.sum() > n / 20
    # never too small; a search that starts 10 um above what it is to find cannot miss it
    assert (guess[apart] > distance[apart]).all() and (guess[met] > 0).all()
    assert (guess[~near] > CAP_M - 1e-3).mean() > 0.9  # and where nothing is near it mostly says so
    # quick is what it is for: mostly it is the answer but for a few millimetres
    assert np.median(guess[apart] - distance[apart]) < 1.5e-3
    assert (guess[met] < 5e-3).mean() > 0.5
