"""Shards of views in HDF5 (`r2h-batch observe export`), read back by plain h5py."""

import shutil

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.learning.pairs import stream
from r2h_batch.learning.rank import SHIPPED, WEIGHTS, Recipe, begun, train_on_views
from r2h_batch.learning.seen_views import Views
from r2h_batch.methods.learned import trained_on
from r2h_batch.methods.ranker.network import about_weights, read_weights
from r2h_batch.observe.sees import Sees

h5py = pytest.importorskip("h5py")
FAMILIES = "cup x 1 seed 91"


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    out = tmp_path_factory.mktemp("views")
    line = ["observe", "export", "--out", str(out), "--trials", "6", "--pairs", "4", "--families", FAMILIES]
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
    line = ["observe", "export", "--out", str(tmp_path), "--trials", "6", "--pairs", "4", "--families", held]
    assert main([*line, "--sees", "cell-v1,region=told", "--believed", "4"]) == 0
    with h5py.File(tmp_path / "shard-000000.h5") as file, h5py.File(shards[0] / "shard-000000.h5") as other:
        own = {k: torch.from_numpy(file[f"believed/{k}"][()]) for k in ("row", "T_world_obj", "cloud", "region")}
        points, mask = (torch.from_numpy(file[f"cloud/{k}"][()]) for k in ("points", "mask"))
        told = {k: file[k][()] for k in ("object/region", "cloud/region")}
        assert "object/region" not in other and "cloud/region" not in other
        ids, label = file["truth/trial_id"][()], file["object/label"][()]
    pairs = stream(load_benchmark("r2h-v2"), held, pairs=4, trials=6)
    trials = pairs.benchmark.trials_with_ids(torch.from_numpy(ids))
    seen, _ = Sees.parse("cell-v1,region=told").look(pairs.evaluator.scene, trials)
    assert np.array_equal(told["object/region"], seen.region.numpy()) and told["object/region"].shape == label.shape
    assert 0 < told["cloud/region"].mean() < 1
    for i in each(range(len(own["row"]))):  # what a ranker learns from has the region where its points were seen
        T, row = own["T_world_obj"][i].double(), own["row"][i]
        solid = own["cloud"][i].double() @ T[:3, :3].T + T[:3, 3]
        close, nearest = torch.cdist(solid, points[row].double()[mask[row]]).min(1)
        seen_part = torch.from_numpy(told["cloud/region"][row])[mask[row]][nearest].bool()
        some = close < 0.004
        assert some.sum() > 10 and 0 < own["region"][i].bool().sum() < len(solid)
        assert (own["region"][i].bool() == seen_part)[some].float().mean() > 0.9, i
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


@pytest.fixture(scope="module")
def believed(tmp_path_factory):
    out = tmp_path_factory.mktemp("believed")
    line = ["observe", "export", "--out", str(out), "--trials", "6", "--pairs", "4", "--families", FAMILIES]
    assert main([*line, "--believed", "8"]) == 0
    return out


def test_pairs_of_believed_objects_lie_where_they_were_seen_and_have_the_verdicts_of_the_true_ones(believed):
    with h5py.File(believed / "shard-000000.h5") as file:
        x = {k: torch.from_numpy(file[f"believed/{k}"][()]) for k in file["believed"]}
        true, ids = (torch.from_numpy(file[f"truth/{k}"][()]) for k in ("T_world_obj", "trial_id"))
        points, mask = file["cloud/points"][()], file["cloud/mask"][()]
    row = x["row"]
    assert len(row) >= 5 and x["success"].shape == (len(row), 8) and not x["region"].any()
    for i in each(range(len(row))):
        T = x["T_world_obj"][i].double()
        solid = x["cloud"][i].double() @ T[:3, :3].T + T[:3, 3]
        seen = torch.from_numpy(points[row[i]][mask[row[i]]]).double()
        assert torch.cdist(seen, solid).amin(1).median() < 0.012
        assert torch.equal(x["candidates"][i][x["pick"][i]], x["T_obj_ee"][i])
    pairs = stream(load_benchmark("r2h-v2"), FAMILIES, pairs=4, trials=6)
    T_true = torch.linalg.inv(true[row].double()) @ x["T_world_obj"].double()
    grasp = (T_true[:, None] @ x["T_obj_ee"].double()).float()
    trials = pairs.benchmark.trials_with_ids(ids[row])
    scores = pairs.evaluator.score(grasp, x["T_world_ee"], trials, stages="pose")
    assert (scores.success.view(-1, 8) == x["success"]).float().mean() > 0.97  # poses are rounded otherwise here
    assert 0 < int(x["success"].sum()) < x["success"].numel()
    wrong = pairs.evaluator.score(x["T_obj_ee"], x["T_world_ee"], trials, stages="pose")
    assert (wrong.success.view(-1, 8) == x["success"]).float().mean() < 0.9


def test_a_ranker_learns_from_shards_and_begins_with_given_weights(believed, tmp_path):
    recipe = Recipe(steps=3, start=SHIPPED, seed=4)
    path = train_on_views(believed, recipe, tmp_path / "a", tell=lambda words: None)
    again = train_on_views(believed, recipe, tmp_path / "b", tell=lambda words: None)
    assert path.read_bytes() == again.read_bytes()
    net, before = read_weights(path), begun(SHIPPED)
    assert torch.equal(net.mean, before.mean) and torch.equal(net.std, before.std)
    moved = [float((a - b).detach().abs().max()) for a, b in zip(net.parameters(), before.parameters(), strict=True)]
    assert 0 < max(moved) < 0.1
    about = about_weights(path)
    assert len(about["views"]) == 64 and '"rig": "cell-v1"' in about["sees"] and about["rounds"] == 0
    assert trained_on(str(path)) == [*trained_on(), "cup_s1091_00"]
    line = ["train", "rank", "--views", str(believed), "--steps", "2", "--out", str(tmp_path / "c")]
    assert main(line) == 0
    alone = tmp_path / "c" / WEIGHTS
    assert trained_on(str(alone)) == ["cup_s1091_00"] and not torch.equal(read_weights(alone).mean, before.mean)
    item = Views(believed).item(0)
    passed = item["success"].float().mean()
    assert 0 < passed < 1 and item["labels"].shape == (*item["success"].shape, 5)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--views", "{empty}"), "holds no shard-NNNNNN.h5; write some with r2h-batch observe export --believed 64"),
        (("--views", "{plain}"), "shard-000000.h5: has no believed/"),
        (("--views", "{text}"), "shard-000000.h5: not a readable shard"),
        (("--views", "{believed}", "--leave-out", "cup"), "--leave-out does not go with --views"),
        (("--views", "{believed}", "--benchmark", "r2h-v2"), "--benchmark does not go with --views"),
        (
            ("--views", "{believed}", "--start", "shippd"),
            "shippd: no such file; give rank.safetensors of another training, or shipped",
        ),
    ],
)
def test_what_a_ranker_cannot_learn_from_is_refused_in_one_line(shards, believed, tmp_path, more, words, capsys):
    for name in ("empty", "text"):
        (tmp_path / name).mkdir()
    (tmp_path / "text" / "shard-000000.h5").write_text("no shard")
    places = {"plain": shards[0], "believed": believed, "empty": tmp_path / "empty", "text": tmp_path / "text"}
    capsys.readouterr()
    assert main(["train", "rank", "--out", str(tmp_path / "x"), *(m.format(**places) for m in more)]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and words in error[0]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("sees", "other", "shard-000001.h5: is of another benchmark or other cameras than shard-000000.h5"),
        ("benchmark_digest", "0", "shard-000001.h5: is of another benchmark or other cameras than shard-000000.h5"),
        ("format", "r2h-observe-0", "shard-000001.h5: is not of format r2h-observe-1"),
        ("criteria", ["plan"], "shard-000001.h5: has other criteria than stability, plan"),
    ],
)
def test_shards_that_do_not_belong_together_are_refused(believed, tmp_path, name, value, words):
    for number in (0, 1):
        shutil.copy(believed / "shard-000000.h5", tmp_path / f"shard-00000{number}.h5")
    assert len(Views(tmp_path).files) == 2
    with h5py.File(tmp_path / "shard-000001.h5", "r+") as file:
        file.attrs[name] = value
    with pytest.raises(ValueError, match=words) as error:
        Views(tmp_path)
    assert "\n" not in str(error.value)


def test_pairs_of_believed_objects_come_in_fours(shards, tmp_path, capsys):
    capsys.readouterr()
    assert main([*shards[1][:2], "--out", str(tmp_path), "--believed", "6"]) == 2
    assert "--believed is 6; it must be a multiple of 4" in capsys.readouterr().err
