"""The contact network: its file, its training, and what is read from it."""

import hashlib
import json
from importlib import resources

import numpy as np
import pytest
import torch

from r2h_batch.assets.receiving.contact_maps import contact_map, touched_points
from r2h_batch.assets.receiving.train_voxnet import Examples, augmented, examples, figures, train
from r2h_batch.bodies.objects import VOXELS, load_objects
from r2h_batch.predictors import predict_contacts
from r2h_batch.predictors.contacts import CONTACT_THRESHOLD
from r2h_batch.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.predictors.voxnet import VoxNet, load_voxnet
from r2h_batch.receiver.receiving import CONTACT_M, load_receiving, receiving_digest
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import make_trials

FOLDER = resources.files("r2h_batch.assets.receiving")


@pytest.fixture(scope="module")
def scene():
    return Scene(objects=load_objects(["bowl", "hammer", "bottle"]))


@pytest.fixture(scope="module")
def trials(scene):
    return make_trials(trials=12, objects=scene.objects)


@pytest.fixture(scope="module")
def log():
    return json.loads((FOLDER / "voxnet.json").read_text())


def wrong_shape(grid: torch.Tensor) -> torch.Tensor:
    return grid[:, 0, 0]


def logits(grid: torch.Tensor) -> torch.Tensor:
    return 5 * grid[:, 1]


def test_the_stored_weights_are_the_logged_ones_and_were_trained_on_these_grasps(log) -> None:
    stored = (FOLDER / "voxnet.safetensors").read_bytes()
    assert len(stored) < 2_000_000
    assert hashlib.sha256(stored).hexdigest() == log["sha256"]
    assert log["receiving_digest"] == receiving_digest()
    assert log["parameters"] == sum(p.numel() for p in load_voxnet().parameters())


def test_weights_without_each_object_are_stored_and_small(log) -> None:
    stored = (FOLDER / "voxnet_left_out.safetensors").read_bytes()
    assert len(stored) < 4_000_000
    assert hashlib.sha256(stored).hexdigest() == log["left_out_sha256"]
    weights = [load_voxnet(o.name).state_dict()["out.weight"] for o in load_objects()]
    assert len({tuple(w.flatten().tolist()) for w in weights}) == len(weights)


def test_the_log_has_every_object_left_out_and_all_weights_do_what_it_says(log) -> None:
    objects = load_objects()
    assert set(log["left_out_figures"]) == {o.name for o in objects}
    assert log["left_out_mean"]["auc"] > 0.5 < log["stored_weights_mean"]["auc"]
    some = [objects[1], objects[6]]
    data = examples(some)
    for i, model in enumerate(some):
        found = figures(load_voxnet(), data, i)
        for name in ("iou", "auc"):
            assert abs(found[name] - log["stored_weights"][model.name][name]) < 0.01
    found = figures(load_voxnet(objects[6].name), data, 1)
    assert abs(found["auc"] - log["left_out_figures"][objects[6].name]["auc"]) < 0.01


def test_a_contact_map_says_where_the_grasps_touch() -> None:
    (model,) = load_objects(["hammer"])
    touched, grasps = touched_points(model), load_receiving([model])
    row = 5
    nearest = np.linalg.norm(model.points[:, None] - grasps.vertices[row].numpy()[None], axis=2).min(1)
    assert (nearest[touched[row]] < CONTACT_M + 0.004).all()  # 4 mm: half of the longest edge of the skin
    assert touched[row][nearest < CONTACT_M].all()
    contact = contact_map(model)
    assert contact.min() == 0.0 and contact.max() == 1.0
    handle = model.receiver_face[model.point_face]
    assert contact[handle].mean() > 5 * contact[~handle].mean()


def test_logits_at_voxels_are_the_dense_ones() -> None:
    net, generator = VoxNet(), torch.Generator().manual_seed(0)
    grid = torch.rand(2, 5, VOXELS, VOXELS, VOXELS, generator=generator)
    voxel = torch.randint(0, VOXELS, (2, 50, 3), generator=generator)
    i, j, k = voxel.unbind(-1)
    dense = net.logits(grid)[torch.arange(2)[:, None], i, j, k]
    assert (dense - net.logits_at(grid, voxel)).abs().max() < 1e-5


def test_augmentation_moves_points_and_solid_together() -> None:
    objects = load_objects(["hammer", "power_drill"])
    data = Examples(
        contact_grids(objects),
        torch.stack([voxel_of_points(o) for o in objects]),
        torch.zeros(2, len(objects[0].points)),
    )
    assert all(data.grid[i, 0][tuple(data.voxel[i].T)].mean() > 0.999 for i in (0, 1))
    generator = torch.Generator().manual_seed(1)
    for turn in range(8):
        grid, voxel, inside = augmented(data, turn % 2, generator)
        assert inside.mean() > 0.98
        near = torch.nn.functional.max_pool3d(grid[None, :1], 3, stride=1, padding=1)[0, 0]
        assert near[tuple(voxel[inside > 0].T)].mean() > 0.98
        assert torch.equal(grid[1:4], data.grid[0, 1:4])


def test_training_is_the_same_twice_and_learns() -> None:
    objects = load_objects(["hammer"])
    data = examples(objects)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        first, _ = train(data, 3, seed=5)
        again, _ = train(data, 3, seed=5)
        _, losses = train(data, 30, seed=5)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    assert np.mean(losses[-5:]) < 0.8 * losses[0]


def test_contacts_are_read_at_the_clouds_points_and_do_not_depend_on_the_batch(scene, trials) -> None:
    found = predict_contacts(trials, scene)
    assert found.shape == (len(trials), 2048) and found.dtype == torch.float32
    for row in (0, 13, 23):
        model = scene.objects[int(trials.object_index[row])]
        net = load_voxnet(model.name)  # which never saw it
        with torch.no_grad():
            field = net(contact_grids([model]))[0]
        assert torch.equal(found[row], field[tuple(voxel_of_points(model).T)])
        if row == 0:
            with torch.no_grad():
                field = load_voxnet()(contact_grids([model]))[0]
            seen = predict_contacts(trials[:1], scene, left_out=False)[0]
            assert torch.equal(seen, field[tuple(voxel_of_points(model).T)]) and not torch.equal(seen, found[0])
    order = torch.randperm(len(trials), generator=torch.Generator().manual_seed(0))[:5]
    assert torch.equal(predict_contacts(trials[order], scene), found[order])
    hammer = scene.objects[1]
    handle = torch.from_numpy(hammer.receiver_face[hammer.point_face])
    row = found[int(torch.nonzero(trials.object_index == 1)[0])]
    assert (row[handle] >= CONTACT_THRESHOLD).float().mean() > (row[~handle] >= CONTACT_THRESHOLD).float().mean()


def test_wrong_answers_of_a_predictor_are_refused(scene, trials) -> None:
    with pytest.raises(ValueError, match=r"wrong_shape returned shape \(1, 64, 64\).*need a tensor \(1, 64, 64, 64\)"):
        predict_contacts(trials, scene, predictor=wrong_shape)
    with pytest.raises(ValueError, match=r"logits returned values from .*\(apply a sigmoid"):
        predict_contacts(trials, scene, predictor=logits)
