"""Shards of views in HDF5 (`r2h-batch export views`), read back by plain h5py."""

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.observe.sees import Sees
from r2h_batch.training.pairs import stream

h5py = pytest.importorskip("h5py")
FAMILIES = "cup x 1 seed 91"


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    out = tmp_path_factory.mktemp("views")
    line = ["export", "views", "--out", str(out), "--trials", "6", "--pairs", "4", "--families", FAMILIES]
    assert main([*line, "--shards", "2"]) == 0
    return out, line


@pytest.mark.check
def test_a_shard_holds_what_the_cameras_saw_and_the_labels_of_the_stream(shards):
    with h5py.File(shards[0] / "shard-000001.h5") as file:
        data = {k: file[k][()] for k in ("object/depth", "object/label", "pairs/margin", "pairs/success")}
        step = file.attrs["depth_step_m"]
        points, mask, T = file["cloud/points"][()], file["cloud/mask"][()], file["truth/T_world_obj"][()]
        grasp, ids = file["pairs/T_world_grasp"][()], file["truth/trial_id"][()]
        assert file["truth/object"][0].decode().startswith("cup") and list(file.attrs["labels"])[3] == "object"
        assert file["oracle/success"].shape == (6, 1) and file["oracle/success"][()].sum() >= 4
    pairs = stream(load_benchmark("r2h-v2"), FAMILIES, pairs=4, trials=6)
    item = pairs.item(1)
    assert np.array_equal(ids, item["trial_id"].numpy())
    assert np.array_equal(data["pairs/success"], item["success"].numpy())
    assert np.array_equal(data["pairs/margin"], item["margin"].numpy(), equal_nan=True)
    trials = pairs.benchmark.trials_with_ids(torch.from_numpy(ids))
    seen, moment = Sees.parse("cell-v1").look(pairs.evaluator.scene, trials)
    assert np.array_equal(T, moment.numpy())
    assert np.abs(data["object/depth"] * step - seen.object.depth_m.double().numpy()).max() < 1e-6
    assert np.array_equal(data["object/label"], seen.object.label.numpy())
    own, there = seen.cloud(2048)
    assert np.array_equal(points, own.numpy()) and np.array_equal(mask, there.numpy())
    for i in each(range(6)):
        expected = T[i].astype(np.float64) @ item["T_obj_ee"][i].double().numpy()
        assert np.abs(grasp[i] - expected).max() < 1e-6


def test_a_told_region_is_in_the_shard_and_in_the_card_and_else_is_not(shards, tmp_path):
    held = "hammer x 1 seed 91"
    line = ["export", "views", "--out", str(tmp_path), "--trials", "6", "--pairs", "4", "--families", held]
    assert main([*line, "--sees", "cell-v1,region=told"]) == 0
    with h5py.File(tmp_path / "shard-000000.h5") as file, h5py.File(shards[0] / "shard-000000.h5") as other:
        told = {k: file[k][()] for k in ("object/region", "cloud/region")}
        assert "object/region" not in other and "cloud/region" not in other
        ids, label = file["truth/trial_id"][()], file["object/label"][()]
    pairs = stream(load_benchmark("r2h-v2"), held, pairs=4, trials=6)
    trials = pairs.benchmark.trials_with_ids(torch.from_numpy(ids))
    seen, _ = Sees.parse("cell-v1,region=told").look(pairs.evaluator.scene, trials)
    assert np.array_equal(told["object/region"], seen.region.numpy()) and told["object/region"].shape == label.shape
    assert 0 < told["cloud/region"].mean() < 1
    assert np.array_equal(told["cloud/region"], seen.cloud_region(2048).numpy())
    assert "`cloud/region`" in (tmp_path / "README.md").read_text()
    assert "region`" not in (shards[0] / "README.md").read_text()


def test_shards_that_are_there_stay_and_others_are_made_alike(shards, tmp_path, capsys):
    out, line = shards
    before = (out / "shard-000000.h5").stat().st_mtime_ns
    assert main([*line, "--shards", "1"]) == 0
    assert (out / "shard-000000.h5").stat().st_mtime_ns == before
    alone = [*line[:3], str(tmp_path / "alone"), *line[4:], "--first-shard", "1"]
    assert main(alone) == 0
    with h5py.File(out / "shard-000001.h5") as a, h5py.File(tmp_path / "alone" / "shard-000001.h5") as b:
        names: list[str] = []
        a.visititems(lambda name, x: names.append(name) if isinstance(x, h5py.Dataset) else None)
        for name in each(names, 20):
            assert a[name][()].tobytes() == b[name][()].tobytes(), name
    card = (out / "README.md").read_text()
    assert "r2h-observe-1" in card and all(
        f"`{k}" in card for k in ("object/depth", "cloud/points", "truth/", "pairs/")
    )


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--sees", "cell-v9"), "rig 'cell-v9'"),
        (("--trials", "0"), "--trials is 0; it must be 1 to 1000"),
        (("--sees", "cell-v1,noise=0"), "is of shards made otherwise; take another --out"),
        (("--families", "cup x 0"), "families: x 0 of one family is 0 objects"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(shards, more, words, capsys):
    capsys.readouterr()
    assert main([*shards[1], *more]) == 2
    error = capsys.readouterr().err
    assert words in error and error.strip().count("\n") == 0
