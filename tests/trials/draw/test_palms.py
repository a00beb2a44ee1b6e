"""Protocol r2h-release: palms, objects and place of the authors' release, in this project's frame (docs/release.md)."""

import numpy as np
import pytest
import torch
from rounds import each
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.scene.hand import load_hand, palm_frame
from r2h_batch.scene.objects import load_objects, stored_objects
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.draw import palms
from r2h_batch.trials.edit import edited
from r2h_batch.trials.yaml_file import read_benchmark

FROZEN = "9505c8b1c1d2cc85c643825972cbbbc4b7ebc017f4635707ba40fe71c237d8bb"
"""Digest of 504 trials a split."""
THEIRS = np.diag([-1.0, -1.0, 1.0, 1.0])  # our base in their frame: turned by 180 degrees, 0.75 m high
THEIRS[2, 3] = 0.75


def release_frames(trials):
    """The palm's frame of each trial in the release's world: x to the fingers, z out of the palm."""
    hand = load_hand()
    side = trials.hand_index.to(torch.int8)
    joints = hand.pose(torch.zeros(len(trials), 48), None, side).joints.double()
    point, z = (x.numpy() for x in palm_frame(joints, side))
    x = (joints[:, 4] - joints[:, 0]).numpy()
    x -= (x * z).sum(1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(trials), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = np.stack([x, np.cross(z, x), z], 2), point
    return THEIRS @ trials.T_world_hand.double().numpy() @ T


@pytest.mark.check
def test_the_draw_is_frozen_and_a_trial_is_the_same_alone():
    trials = load_benchmark("r2h-release").trials(504)
    assert trials_digest(trials) == FROZEN and trials.receiver is None
    rows = torch.tensor([777, 3])
    again = load_benchmark("r2h-release").trials_with_ids(trials.trial_id[rows])
    assert torch.equal(again.T_world_hand, trials.T_world_hand[rows])
    assert torch.equal(again.hand_index, trials.hand_index[rows])


def test_palms_lie_in_the_releases_box_of_places_and_turns():
    T = release_frames(load_benchmark("r2h-release").trials(300))
    place, turn = T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)
    low, high = [-0.72, -0.45, 0.88, -25, -25, -150], [-0.60, -0.30, 0.98, 25, 25, -50]
    drawn = np.concatenate([place, turn], 1)
    assert (drawn > np.array(low) - 1e-4).all() and (drawn < np.array(high) + 1e-4).all()
    spread = (drawn.max(0) - drawn.min(0)) / (np.array(high) - low)
    assert (spread > 0.9).all()


def test_the_arm_reaches_the_reference_grasp_of_every_trial_with_the_object_15_cm_above_the_palm():
    trials, objects = load_benchmark("r2h-release").trials(64), load_benchmark("r2h-release").objects
    T = np.linalg.inv(THEIRS) @ release_frames(trials)
    x, n = T[:, :3, 0], T[:, :3, 2]
    tool = np.stack([x, np.cross(-n, x), -n], 2)
    for i, o in each(enumerate(trials.object_index.tolist())):
        grasp = candidates_of(objects)[o].T_obj_ee[0].astype(float)
        center = (objects[o].vertices.min(0) + objects[o].vertices.max(0)) / 2
        T_world_obj = np.eye(4)
        T_world_obj[:3, :3] = tool[i] @ grasp[:3, :3].T
        T_world_obj[:3, 3] = T[i, :3, 3] + 0.15 * n[i] - T_world_obj[:3, :3] @ center
        wanted = torch.from_numpy((T_world_obj @ grasp).astype(np.float32))[None].contiguous()
        assert bool(solve_ik(wanted).reachable), (i, objects[o].name)


def test_the_closed_form_knows_what_the_arm_reaches():
    rng, n = np.random.default_rng(0), 4000
    R, p = Rotation.random(n, random_state=1).as_matrix(), rng.uniform([-1, -1, -0.6], [1, 1, 1.2], (n, 3))
    T = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    found = palms.is_reachable(R, p)
    assert np.array_equal(found, solve_ik(torch.from_numpy(T)).reachable.numpy()) and 0.3 < found.mean() < 0.5


def test_objects_hands_table_and_home_are_the_releases_by_flag_in_a_file_and_in_python(tmp_path):
    (tmp_path / "b.yaml").write_text("protocol: r2h-release\n")
    own = load_benchmark("r2h-release")
    by_flag = edited(BenchmarkChoice(benchmark="r2h-release"))
    assert own.digest == by_flag.digest == read_benchmark(tmp_path / "b.yaml").digest
    assert [sum(o.split == s for o in own.objects) for s in ("S0", "S1")] == [8, 8]
    bottle = next(o for o in own.objects if o.name == "bottle")
    assert bottle.split == "S0" and not bottle.receiver_face.any()
    assert bottle.instruction == "hand over the bottle to human"
    assert len(candidates_of((bottle,))[0]) == 100 and load_objects(["bottle"])[0].split == "S1"
    assert own.hand_set.side.tolist() == [0, 1] and not own.hand_set.pose.any()
    assert own.config().workplace.home_q == (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
    (tmp_path / "c.yaml").write_text("protocol: r2h-release\nobjects: [{built_in: can}, {built_in: hammer}]\n")
    mine = read_benchmark(tmp_path / "c.yaml")
    assert [o.name for o in mine.objects] == ["can", "hammer"] and mine.workplace == own.workplace
    assert set(stored_objects()) >= {"can", "dispenser", "bottle_S0"}
