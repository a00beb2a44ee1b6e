"""Mined pairs, the ranker's training and its weights, and what it is told."""

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
from rounds import each
from safetensors.torch import save

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.methods.learned import trained_on
from r2h_batch.methods.ranker import features
from r2h_batch.methods.ranker.network import MAX_BYTES, Ranker, about_weights, read_weights, save_weights
from r2h_batch.methods.ranker.observe import observe
from r2h_batch.methods.ranker.search import NEAR_M, liked, scored_by
from r2h_batch.training import mine, stream
from r2h_batch.training.pairs import Pairs
from r2h_batch.training.rank import CHECKPOINT, SHIPPED, WEIGHTS, Lessons, Recipe, Training, begun, train_ranker
from r2h_batch.verdicts import CRITERIA

FAMILIES = "cup,hammer x 2 seed 5"
SMALL = Recipe(families=FAMILIES, regions=1, items=1, steps=4, rounds=1, mined_items=1, mined_steps=3)


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return stream(load_benchmark(), FAMILIES, pairs=8, poses=4, trials=12, see=features.SEE)


def height(seen, pick, T_obj_ee, T_world_ee):
    """A score that anybody can work out again: how high the gripper is."""
    return T_world_ee[..., 2, 3]


def test_mined_pairs_are_the_best_of_each_round_and_are_judged(pairs):
    item = next(iter(mine(pairs, height, first=20, second=10, top=2, items=1)))
    plain = pairs.item(0)
    assert torch.equal(item["trial_id"], plain["trial_id"]) and torch.equal(item["cloud"], plain["cloud"])
    z = item["T_world_ee"][..., 2, 3]
    alone = next(iter(mine(pairs, height, first=20, second=0, items=1)))["T_world_ee"]
    assert torch.equal(item["T_world_ee"][:, :4], alone[:, :4]) and (z[:, :4].diff(dim=1) <= 0).all()
    best = alone[:, :2, :3, 3]
    near = (item["T_world_ee"][:, 4:, None, :3, 3] - best[:, None]).norm(dim=-1).amin(-1)
    assert near.min() > 0 and near.max() <= NEAR_M * 3**0.5 + 1e-5
    assert (z[:, 4] > z[:, 0]).float().mean() > 0.9
    trials = pairs.benchmark.trials_with_ids(item["trial_id"])
    scores = pairs.evaluator.score(item["T_obj_ee"], item["T_world_ee"], trials, stages="pose")
    assert torch.equal(scores.success.view(12, 8), item["success"])
    with pytest.raises(ValueError, match="first is 4; an item holds 8 pairs"):
        mine(pairs, height, first=4)


@pytest.mark.parametrize(
    "kept",
    [
        b"no such thing",
        b"",
        b"as it was\n",
        b"cos\nsystem\n(S'true'\ntR.",
        bytes(range(256)) * 99,
        {"recipe": 3},
        {"x": torch.zeros(3)},
        [1, 2],
    ],
    ids=["words", "nothing", "a line", "a call", "bytes", "another recipe", "another state", "a list"],
)
def test_a_checkpoint_that_is_none_is_refused_in_one_line(kept, tmp_path):
    path = tmp_path / CHECKPOINT
    path.write_bytes(kept) if isinstance(kept, bytes) else torch.save(kept, path)
    with pytest.raises(FileError, match=CHECKPOINT) as refused:
        train_ranker(load_benchmark(), SMALL, tmp_path, tell=lambda s: None)
    assert "\n" not in str(refused.value) and "give another --out" in str(refused.value)


def test_an_interrupted_training_goes_on_with_the_same_bits_and_another_recipe_is_refused(tmp_path, monkeypatch):
    whole = train_ranker(load_benchmark(), SMALL, tmp_path / "whole", tell=lambda s: None)
    step, count = Training.learn, 0

    def stopped(self):
        nonlocal count
        count += 1
        if count == 6:
            raise KeyboardInterrupt
        step(self)
        self.keep()

    def at_once(*_):
        raise KeyboardInterrupt

    told: list[str] = []
    of_labels = [(Lessons, "of", at_once), (Training, "learn", at_once), (Training, "learn", stopped)]
    for place, name, stop in of_labels:  # before there are labels, before the first step, later
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(place, name, stop)
            train_ranker(load_benchmark(), SMALL, tmp_path / "parts", tell=told.append)
    parts = train_ranker(load_benchmark(), SMALL, tmp_path / "parts", tell=told.append)
    begun_again = [line.rpartition(" ")[2] for line in told if "goes on at step" in line]
    assert begun_again == ["0", "0", "5"] and parts.read_bytes() == whole.read_bytes()
    assert whole.stat().st_size <= MAX_BYTES // 2
    with pytest.raises(ValueError, match="is of another recipe"):
        train_ranker(load_benchmark(), replace(SMALL, seed=1), tmp_path / "parts", tell=lambda s: None)
    about = about_weights(whole)
    names = about["trained_on"]["objects"]
    assert names == ["cup_s1005_00", "cup_s1005_01", "hammer_s1005_00", "hammer_s1005_01"]
    net = read_weights(whole)
    assert not net.training and all(torch.isfinite(v).all() for v in net.state_dict().values())


def test_the_command_trains_leaves_out_and_says_what_is_wrong(tmp_path, capsys):
    words = ["train", "rank", "--families", FAMILIES, "--regions", "0", "--items", "1", "--steps", "2", "--rounds", "0"]
    assert main([*words, "--leave-out", "cup", "--out", str(tmp_path / "a")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "a" / WEIGHTS)
    assert about_weights(tmp_path / "a" / WEIGHTS)["trained_on"]["objects"] == ["hammer_s1005_00", "hammer_s1005_01"]
    assert (tmp_path / "a" / CHECKPOINT).is_file()
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine.txt").write_text("x")
    for more, said in each(
        [
            (["--out", str(tmp_path / "b")], "is not empty"),
            (["--out", str(tmp_path / "c"), "--leave-out", "cups"], "leave_out has 'cups'"),
            (["--out", str(tmp_path / "c"), "--steps", "0"], "steps"),
            (["--out", str(tmp_path / "a")], "is of another recipe"),
            (
                ["--out", str(tmp_path / "c"), "--start", "shippd"],
                "shippd: no such file; give rank.safetensors of another",
            ),
        ]
    ):
        assert main([*words, *more]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert said in error


def test_a_training_begins_with_given_weights_and_names_what_they_were_trained_on(tmp_path):
    short = replace(SMALL, families="cup x 1 seed 91", rounds=0, steps=3, start=SHIPPED)
    path = train_ranker(load_benchmark(), short, tmp_path, tell=lambda s: None)
    net, before = read_weights(path), begun(SHIPPED)
    assert torch.equal(net.mean, before.mean) and torch.equal(net.std, before.std)
    moved = [float((a - b).detach().abs().max()) for a, b in zip(net.parameters(), before.parameters(), strict=True)]
    assert 0 < max(moved) < 0.1
    assert trained_on(str(path)) == [*trained_on(), "cup_s1091_00"]


def test_a_folder_that_cannot_be_made_is_refused_before_the_work(monkeypatch, capsys):
    monkeypatch.setattr("r2h_batch.training.rank.train_ranker", lambda *_, **__: pytest.fail("it began"))
    assert main(["train", "rank", "--out", "/proc/none/rank"]) == 1  # nobody can make a folder there
    assert "/proc/none" in capsys.readouterr().err.strip().splitlines()[-1]


def test_features_do_not_depend_on_where_the_object_frame_lies_nor_on_the_batch(pairs):
    item = pairs.item(1)
    R = torch.from_numpy(np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]).float()
    R = R * torch.linalg.det(R)
    turned = {**item, "cloud": item["cloud"] @ R.mT, "normals": item["normals"] @ R.mT}
    T = item["T_obj_ee"].clone()
    T[..., :3, :] = R @ T[..., :3, :]
    opening = item["opening_m"].gather(1, item["pick"])
    for one, other in each(
        [
            (features.cloud_in_gripper(item, item["T_obj_ee"]), features.cloud_in_gripper(turned, T)),
            (
                features.of_candidate(item, item["T_obj_ee"], item["pick"]),
                features.of_candidate(turned, T, item["pick"]),
            ),
            (
                features.of_pair(item, item["T_obj_ee"], item["T_world_ee"], opening),
                features.of_pair(turned, T, item["T_world_ee"], opening),
            ),
        ]
    ):
        torch.testing.assert_close(one, other, atol=2e-4, rtol=0)
        assert one.std() > 0.1


def test_features_against_distances_in_float64(pairs):
    item = pairs.item(0)
    opening = item["opening_m"].gather(1, item["pick"])
    pair = features.of_pair(item, item["T_obj_ee"], item["T_world_ee"], opening).double()
    own = features.of_candidate(item, item["T_obj_ee"], item["pick"]).double()
    x = {k: v.double() for k, v in item.items()}
    seen_region = 0
    for n in each(range(12)):
        for k in each(range(8)):
            T = x["T_world_ee"][n, k] @ torch.linalg.inv(x["T_obj_ee"][n, k])
            world = x["cloud"][n, : features.POINTS] @ T[:3, :3].T + T[:3, 3]
            apart = (world[:, None] - x["hand"][n][None]).norm(dim=-1).amin(1)
            ball = (world - x["ball_center"][n]).norm(dim=-1)
            place = 3 + 12 + 1 + 8 + 9
            assert abs(pair[n, k, place] / 20 - apart.min()) < 1e-4
            assert abs(pair[n, k, place + 2] / 10 - ball.min()) < 1e-4
            region = item["region"][n, : features.POINTS]
            wanted = ball[region].min() if region.any() else 0.3
            assert abs(pair[n, k, features.REGION_TO_BALL] / 10 - wanted) < 1e-4
            whole = item["region"][n]
            seen_region += int(whole.any())
            R, t = x["T_obj_ee"][n, k, :3, :3], x["T_obj_ee"][n, k, :3, 3]
            finger = t + R @ torch.tensor([0.0, -(opening[n, k].double() / 2 + 0.015), 0.0]).double()
            nearest = (x["cloud"][n][whole] - finger).norm(dim=-1).min() if whole.any() else 0.3
            assert abs(own[n, k, 0] / 10 - min(nearest, 0.3)) < 1e-4
            assert own[n, k, 6] == float(whole.any())
    assert 0 < seen_region < 96


def test_hidden_regions_give_the_features_of_an_object_without_one(pairs):
    item = pairs.item(0)
    opening = item["opening_m"].gather(1, item["pick"])
    blind = {**item, "region": torch.zeros_like(item["region"])}

    def told(x):
        return (
            features.cloud_in_gripper(x, x["T_obj_ee"]), features.of_candidate(x, x["T_obj_ee"], x["pick"]),
            features.of_pair(x, x["T_obj_ee"], x["T_world_ee"], opening),
        )  # fmt: skip

    every = torch.ones(12, dtype=torch.bool)
    assert all(torch.equal(a, b) for a, b in zip(features.hidden(*told(item), every), told(blind), strict=True))
    assert not torch.equal(told(item)[1], told(blind)[1])


def test_the_thumbs_side_is_one_axis_for_both_hands(pairs):
    """A left hand that mirrors a right one has the mirrored features, so that what is learned of one holds for the other."""
    item = pairs.item(0)
    flip = torch.tensor([1.0, -1.0, 1.0])
    mirror = {**item, "hand": item["hand"] * flip, "side": 1 - item["side"]}
    for k in ("palm_point", "palm_normal", "wrist_to_middle", "ball_center"):
        mirror[k] = item[k] * flip
    T = item["T_world_ee"].clone()
    T[..., 1, 3] = -T[..., 1, 3]
    opening = item["opening_m"].gather(1, item["pick"])
    place = slice(3 + 12 + 1 + 8, 3 + 12 + 1 + 8 + 3)
    one = features.of_pair(item, item["T_obj_ee"], item["T_world_ee"], opening)[..., place]
    other = features.of_pair(mirror, item["T_obj_ee"], T, opening)[..., place]
    torch.testing.assert_close(one, other, atol=1e-5, rtol=0)


def test_a_search_takes_what_the_network_likes_best_and_near_is_near(pairs):
    trials = pairs.benchmark.trials_with_ids(pairs.item(0)["trial_id"])
    seen, middle = observe(trials, pairs.evaluator.scene, features.SEE)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        net = Ranker().eval().requires_grad_(False)
    pick, T, good = liked(seen, middle, trials.trial_id, scored_by(net), (1, 2), first=30, second=12, top=3)
    assert pick.shape == (12, 42) and good.shape == (12, 42) and T.shape == (12, 42, 4, 4)
    assert seen["exists"].gather(1, pick).all()
    rows = torch.arange(12)[:, None]
    for n in each(range(12)):
        code = net.code(features.cloud_in_gripper(seen, seen["candidates"])[n, pick[n, 5]])
        alone = {k: v[n : n + 1] for k, v in seen.items()}
        grasp = seen["candidates"][rows, pick][n : n + 1, 5:6]
        own = features.of_candidate(alone, grasp, pick[n : n + 1, 5:6])
        opening = seen["opening_m"][n : n + 1].gather(1, pick[n : n + 1, 5:6])
        pair = features.of_pair(alone, grasp, T[n : n + 1, 5:6], opening)
        assert abs(float(net(code[None, None], own, pair)[0, 0, 0]) - float(good[n, 5])) < 1e-4
    torch.testing.assert_close(T[..., :3, :3] @ T[..., :3, :3].mT, torch.eye(3).expand(12, 42, 3, 3), atol=1e-5, rtol=0)


def test_a_file_of_weights_names_its_criteria_whatever_the_reader_judges_by(tmp_path):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        net = Ranker((*CRITERIA, "upright")).eval().requires_grad_(False)
    save_weights(net, path := tmp_path / "net.safetensors", {"seed": 4})
    read = read_weights(path)
    assert read.criteria == (*CRITERIA, "upright") and about_weights(path)["seed"] == 4
    x = torch.randn(5, 96), torch.randn(5, 9), torch.randn(5, 58)
    assert read(*x).shape == (5, 7) and torch.equal(read(*x), net(*x))
    shipped = resources.files("r2h_batch.assets.ranker") / "ranker.safetensors"
    assert read_weights(Path(str(shipped))).criteria == CRITERIA[:5]


def told(path: Path, criteria: str) -> None:
    """Writes weights that say this about their criteria."""
    weights = {k: v.contiguous() for k, v in Ranker().state_dict().items()}
    path.write_bytes(save(weights, {"about": criteria}))


@pytest.mark.parametrize("what", ["text", "another", "nan", "missing", "fewer", "number", "no json"])
def test_wrong_weights_are_refused_in_one_line(tmp_path, what):
    path: Path = tmp_path / "net.safetensors"
    if what == "text":
        path.write_text(json.dumps({"a": 1}))
    elif what == "another":
        from safetensors.torch import save_file

        save_file({"x": torch.zeros(3)}, path)
    elif what == "nan":
        net = Ranker()
        net.std[3] = torch.nan
        save_weights(net, path, {})
    elif what != "missing":
        told(path, {"fewer": '{"criteria": ["plan"]}', "number": '{"criteria": 5}', "no json": "{"}[what])
    said = {"text": "not a readable", "another": "weights of another network", "nan": "NaN", "missing": "no such file"}
    said |= {"fewer": "or of other criteria than plan;", "number": "criteria is 5;", "no json": "is no JSON"}
    with pytest.raises(ValueError, match=said[what]) as error:
        read_weights(path)
    assert "\n" not in str(error.value)
