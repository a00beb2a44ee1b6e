"""Where the eyes of a receiver are: those of the built-in people, turned with the torso."""

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.scene.arrays import asset, read_arrays
from r2h_batch.scene.person import eyes_of


def test_eyes_are_where_those_of_the_built_in_people_are():
    skin, people = (read_arrays(asset("people", f"{name}.npz")) for name in ("skin", "people"))
    n = len(skin["weights"])
    basis = skin["basis"] * skin["scale"].astype(float)[:, None, None]
    # the last vertices are those of the two eyes, 72 each
    own = [slice(n - 144, n - 72), slice(n - 72, n)]
    own = [
        skin["points"][k].mean(0) + np.tensordot(skin["person"].astype(float), basis[:, k].mean(1), 1) for k in own
    ]  # fmt: skip
    theirs = np.stack(sorted(own, key=lambda x: -x[:, 1].mean()), 1)
    receiver = torch.zeros((len(people["age"]), 5, 4))
    receiver[:, 1, 2] = -torch.from_numpy((1 - 0.104) * people["acromion_radiale"])  # the elbow below the shoulder
    receiver[:, 3, 2] = torch.from_numpy(0.5 * (people["acromial_height"] + people["iliac_height"]))
    receiver[:, 4, 2] = torch.from_numpy(0.5 * (people["acromial_height"] - people["iliac_height"]))
    receiver[:, 3, 3] = 1.0
    off = eyes_of(receiver).numpy() - theirs
    assert np.abs(off.mean((0, 1))).max() < 0.002
    assert np.abs(off[..., 2]).max() < 0.022 and np.sqrt((off[..., 2] ** 2).mean()) < 0.0055
    assert np.sqrt((off[..., 0] ** 2).mean()) < 0.015 and np.abs(off[..., 1]).max() < 0.007


def test_eyes_turn_with_the_torso():
    trials = load_benchmark("r2h-v2").trials(30)
    s, c = np.sin(0.7), np.cos(0.7)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    turned = trials.receiver.clone()
    turned[:, :4, :3] = trials.receiver[:, :4, :3] @ R.T
    fx, fy = trials.receiver[:, 3, 3], trials.receiver[:, 4, 3]
    turned[:, 3, 3], turned[:, 4, 3] = c * fx - s * fy, s * fx + c * fy
    assert (eyes_of(turned) - eyes_of(trials.receiver) @ R.double().T).abs().max() < 1e-6
