"""The stream of labelled pairs: the same items for any workers, labels that are the evaluator's, nothing that is tested."""

from collections import Counter
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from rounds import each
from scipy.optimize import linprog
from torch.utils.data import DataLoader

from r2h_batch import Evaluator, load_benchmark, reward
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.methods.handover_va import predict_parts, predict_target
from r2h_batch.methods.placing import center_of
from r2h_batch.methods.ranker.proposals import TILT_DEG
from r2h_batch.scene.objects import load_objects, turned
from r2h_batch.training import Seen, stream
from r2h_batch.training.instances import split, training_objects
from r2h_batch.training.pairs import FIRST_ID, IDS_OF_SEED, Pairs
from r2h_batch.training.regions import with_regions
from r2h_batch.types import CRITERIA

FAMILIES = "cup,hammer x 2 seed 5"
EXACT = "donot_use_mm_for_euclid_dist"
SIZES = {"pairs": 3, "trials": 6}


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return stream(load_benchmark(), FAMILIES, items=5, **SIZES)


def same(a: dict, b: dict) -> bool:
    assert a.keys() == b.keys()
    return all(torch.equal(a[k].nan_to_num(nan=-9.0), b[k].nan_to_num(nan=-9.0)) for k in a)


@pytest.mark.check
def test_items_are_the_same_by_number_for_any_number_of_workers_alone_and_anew(pairs):
    alone = [pairs.item(i) for i in range(5)]
    assert [int(x["index"]) for x in alone] == [0, 1, 2, 3, 4] and not same(alone[0], alone[1])
    for workers in each([0, 1, 2]):
        found = list(DataLoader(pairs, batch_size=None, num_workers=workers))
        assert len(found) == 5 and all(same(a, b) for a, b in zip(alone, found, strict=True))
    later = list(stream(load_benchmark(), FAMILIES, first_item=3, items=2, **SIZES))
    assert len(later) == 2 and all(same(a, b) for a, b in zip(alone[3:], later, strict=True))


def test_an_items_tensors_have_memory_of_their_own(pairs):
    """A DataLoader's worker moves the memory of an item that it sends, in another thread, while it makes the next one."""
    items = [*islice(pairs, 3)]
    spans = []
    for item in each(items):
        for name, x in each(item.items()):
            assert x.untyped_storage().nbytes() == x.numel() * x.itemsize, name
        spans += {x.untyped_storage().data_ptr() for x in item.values()}
    assert len(set(spans)) == len(spans)


def test_labels_and_margins_are_what_score_says_of_these_poses_and_trials(pairs):
    evaluator = Evaluator(pairs.benchmark)
    for item in each(islice(pairs, 2)):
        trials = pairs.benchmark.trials_with_ids(item["trial_id"])
        scores = evaluator.score(item["T_obj_ee"], item["T_world_ee"], trials, stages="pose")
        assert torch.equal(scores.success.view(6, 3), item["success"])
        assert torch.equal(
            torch.where(scores.evaluated, scores.passed.float(), -1).view(6, 3, -1), item["labels"].nan_to_num(nan=-1.0)
        )
        evaluated = scores.evaluated.view(6, 3, -1)
        assert torch.equal(item["margin"].isnan(), ~evaluated)
        assert torch.equal(item["margin"][evaluated], scores.margin.view(6, 3, -1)[evaluated])
        free = torch.tensor([pairs.objects[int(o)].split == "S0" for o in item["object_index"]])
        assert (
            torch.equal(item["labels"][..., CRITERIA.index("affordance")].isnan().all(1), free)
            and 0 < int(free.sum()) < 6
        )


def test_what_is_seen_is_what_the_methods_are_given(pairs):
    item, scene = pairs.item(1), pairs.evaluator.scene
    trials = pairs.benchmark.trials_with_ids(item["trial_id"])
    hand, parts = predict_target(trials, scene), predict_parts(trials, scene)
    assert torch.equal(item["T_world_hand"], hand.T_world_hand) and torch.equal(item["palm_normal"], hand.palm_normal)
    assert not torch.equal(hand.T_world_hand, trials.T_world_hand)
    clouds = [torch.tensor(pairs.objects[o].points, dtype=torch.float64) for o in item["object_index"].tolist()]
    own = torch.stack(  # which points of the object they are
        [
            torch.cdist(few.double(), every, compute_mode=EXACT).argmin(1)
            for few, every in zip(item["cloud"], clouds, strict=True)
        ]
    )
    assert torch.equal(item["region"], parts.usage.gather(1, own)) and torch.equal(
        item["part"], parts.label.gather(1, own)
    )
    near = torch.cdist(item["hand"], hand.vertices, compute_mode=EXACT).amin(2)
    assert item["hand"].shape == (6, 64, 3) and near.max() < 1e-5
    for n in each(range(6)):
        model = pairs.objects[int(item["object_index"][n])]
        assert torch.equal(item["cloud"][n], torch.tensor(model.points)[own[n]])
        assert torch.equal(item["normals"][n], torch.tensor(model.normals)[own[n]])
        chosen = item["candidates"][n][item["pick"][n]]
        assert torch.equal(chosen, item["T_obj_ee"][n]) and item["exists"][n][item["pick"][n]].all()


def test_a_small_cloud_is_of_the_whole_object_and_begins_a_larger_one():
    clouds = [stream(load_benchmark(), FAMILIES, see=Seen(cloud=c), **SIZES).item(1) for c in (64, 256)]
    assert torch.equal(clouds[0]["cloud"], clouds[1]["cloud"][:, :64])
    assert torch.equal(clouds[0]["region"], clouds[1]["region"][:, :64])
    objects = training_objects(load_benchmark(), FAMILIES)
    shares = []
    for n in each(range(6)):
        model = objects[int(clouds[0]["object_index"][n])]
        every = torch.tensor(model.points)
        sides = every.amax(0) - every.amin(0)
        few = clouds[0]["cloud"][n]
        assert ((few.amax(0) - few.amin(0)) / sides).min() > 0.7
        assert torch.cdist(every, few).amin(1).max() < 0.3 * sides.norm()
        shares.append(float(clouds[1]["region"][n].float().mean()))
        if model.receiver_face is not None and model.split == "S1":
            assert abs(shares[-1] - model.receiver_face[model.point_face].mean()) < 0.15
    assert max(shares) > 0.15
    piece = stream(load_benchmark(), FAMILIES, see=Seen(cloud=64, spread=False), **SIZES).item(1)
    first = [objects[o].points[:64] for o in piece["object_index"].tolist()]
    assert np.array_equal(piece["cloud"].numpy(), np.stack(first))


def test_poses_bring_the_objects_middle_to_the_palm_from_behind(pairs):
    items = [pairs.item(i) for i in range(5)]
    by_paper = [x["labels"][..., :5] for x in items]
    passes = torch.cat([(labels != 0).all(-1).flatten() for labels in by_paper]).float().mean()
    reach = torch.cat([x["labels"][..., CRITERIA.index("reach")].flatten() for x in items])
    assert 0.2 < passes < 0.8 and reach.nanmean() > 0.95
    T = torch.cat([x["T_world_ee"].reshape(-1, 4, 4) for x in items])
    torch.testing.assert_close(T[:, :3, :3] @ T[:, :3, :3].mT, torch.eye(3).expand(len(T), 3, 3), atol=1e-5, rtol=0.0)
    assert torch.linalg.det(T[:, :3, :3]).min() > 0.999
    tilts, heights = [], []
    for item in each(items):
        region, normal = item["region"].float(), item["palm_normal"].double()[:, None]
        whole = torch.from_numpy(np.stack([center_of(pairs.objects[o]) for o in item["object_index"].tolist()]))
        mean = (item["cloud"] * region[..., None]).sum(1) / region.sum(1, keepdim=True).clamp(min=1)
        middle = torch.where(region.sum(1, keepdim=True) > 0, mean.double(), whole)
        T_world_obj = item["T_world_ee"].double() @ torch.linalg.inv(item["T_obj_ee"].double())
        at = (T_world_obj[..., :3, :3] @ middle[:, None, :, None])[..., 0] + T_world_obj[..., :3, 3]
        off = at - item["ball_center"].double()[:, None]
        heights.append((off * normal).sum(-1))
        assert (off - heights[-1][..., None] * normal).norm(dim=-1).max() < 1e-5
        outward = item["ball_center"].double()[:, None] * torch.tensor([1.0, 1.0, 0.0])
        mix = torch.linspace(0, 1, 201).double()[:, None, None, None]
        about = mix * outward / outward.norm(dim=-1, keepdim=True) - (1 - mix) * normal
        cos = (about / about.norm(dim=-1, keepdim=True) * item["T_world_ee"][..., :3, 2]).sum(-1).amax(0)
        tilts.append(torch.rad2deg(cos.clamp(max=1).acos()))
    h, tilt = torch.cat(heights), torch.cat(tilts)
    assert -0.03 - 1e-6 < h.min() < -0.01 and 0.05 < h.max() < 0.07 + 1e-6
    assert 40 < tilt.max() < TILT_DEG + 0.5


def test_seeds_and_what_is_left_out_share_no_trial_and_no_object_with_what_is_learned():
    kept = stream(load_benchmark(), FAMILIES, leave_out=("*_01",), items=3, **SIZES)
    other = stream(load_benchmark(), FAMILIES, seed=1, items=3, **SIZES)
    assert kept.left_out is not None and kept.left_out.left_out is None
    assert [o.name for o in kept.objects] == ["cup_s1005_00", "hammer_s1005_00"]
    assert [o.name for o in kept.left_out.objects] == ["cup_s1005_01", "hammer_s1005_01"]
    ids = [{int(i) for x in s for i in x["trial_id"]} for s in (kept, kept.left_out, other)]
    assert len(ids[0] | ids[1] | ids[2]) == 3 * 18 and min(ids[0]) >= FIRST_ID
    tools = stream(load_benchmark(), FAMILIES, leave_out=("cup",), items=1, **SIZES)
    assert {o.category for o in tools.objects} == {"hammer"} and (tools.item(0)["trial_id"] % 2 == 1).all()
    assert len(set(tools.item(0)["trial_id"].tolist())) == 6


def test_contacts_are_seen_where_they_are_asked_for():
    see = Seen(cloud=32, hand=8, contacts=True)
    item = stream(load_benchmark(), "hammer x 1 seed 5", see=see, **SIZES).item(0)
    assert (
        item["contact"].shape == item["region"].shape == (6, 32)
        and 0 <= item["contact"].min() < item["contact"].max() <= 1
    )


def test_objects_that_methods_are_tested_with_are_refused_under_any_name_and_turned():
    (cup,) = load_objects(["cup_03"])
    new = training_objects(load_benchmark(), FAMILIES)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for model in each([cup, replace(cup, name="mine"), turned(cup, quarter)]):
        with pytest.raises(ValueError, match="which is cup_03 of the objects that methods are tested with"):
            stream(load_benchmark(), [*new, model])
    with pytest.raises(ValueError, match=f"which is {new[0].name} of the objects"):
        stream(load_benchmark().with_objects(new[:1]), new)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"first_id": 1000}, "ids below 2,000,000,000 are those that methods are tested on"),
        ({"leave_out": ("cups",)}, "leave_out has 'cups', which names no instance; there are cup, hammer"),
        ({"leave_out": ("*",)}, "leave_out names all instances"),
        ({"families": "cupp x 2"}, "^families: no family is called 'cupp', did you mean cup"),
        (
            {"families": "families:cup y 2"},
            "^families: 'cup y 2' names no families; write CATEGORY,.* \"cup,hammer x 20",
        ),
        ({"families": []}, "families names no objects"),
        ({"pairs": 0}, "pairs"),
        ({"pairs": 6, "poses": 4}, "poses is 4; it must divide pairs, which is 6"),
        ({"seed": -1}, "seed"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(given, said):
    with pytest.raises(ValueError, match=said) as error:
        stream(load_benchmark(), **{"families": FAMILIES, **given})
    assert "\n" not in str(error.value)


def test_an_item_beyond_the_ids_of_a_seed_is_refused(pairs):
    with pytest.raises(ValueError, match=r"beyond the .* of a seed; take another seed"):
        pairs.item(IDS_OF_SEED)


def test_a_split_goes_by_category_name_or_pattern():
    objects = training_objects(load_benchmark(), FAMILIES)
    for pattern, left in each([("cup", [0, 1]), ("hammer_s1005_01", [3]), ("*_00", [0, 2])]):
        kept, out = split(objects, [pattern])
        assert [objects.index(o) for o in out] == left and set(kept) | set(out) == set(objects)


def test_labels_say_nothing_of_a_criterion_that_was_not_evaluated(pairs):
    item = pairs.item(0)
    trials = pairs.benchmark.trials_with_ids(item["trial_id"])
    T_obj_ee = item["T_obj_ee"].clone()
    T_obj_ee[0, 0] = torch.nan
    scores = pairs.evaluator.score(T_obj_ee, item["T_world_ee"], trials, stages="pose")
    labels = reward.labels(scores)
    assert (
        labels[0].isnan().all()
        and torch.equal(labels.isnan(), ~scores.evaluated)
        and set(labels[scores.evaluated].tolist()) == {0.0, 1.0}
    )


def test_pairs_of_one_candidate_share_it_and_have_poses_of_their_own():
    item = stream(load_benchmark(), FAMILIES, pairs=6, poses=3, trials=6).item(0)
    pick = item["pick"].view(6, 2, 3)
    assert (pick == pick[..., :1]).all() and (pick[:, 0] != pick[:, 1]).any()
    assert (torch.pdist(item["T_world_ee"][:, :3].flatten(1)) > 1e-3).all()


def test_regions_at_random_are_new_objects_of_s1_with_the_grasps_of_the_old_ones():
    plain = training_objects(load_benchmark(), FAMILIES)
    found = with_regions(plain, 3)
    assert found[:4] == plain and len(found) == 16 and len({o.name for o in found}) == 16
    again = with_regions(plain, 3)
    shares = []
    for new, same_one in each(zip(found[4:], again[4:], strict=True)):
        assert new.split == "S1" and np.array_equal(new.receiver_face, same_one.receiver_face)
        assert np.array_equal(new.vertices, next(o for o in plain if new.name.startswith(o.name)).vertices)
        shares.append(float(new.receiver_face[new.point_face].mean()))
        assert new.receiver_face.any() and not new.receiver_face.all()
    assert 0.05 <= min(shares) < 0.4 < 0.6 < max(shares) <= 0.95
    pairs = stream(load_benchmark(), FAMILIES, regions=3, **SIZES)
    assert [o.name for o in pairs.objects] == [o.name for o in found]
    grasps = candidates_of(pairs.objects)
    for i in each(range(4, 16)):
        own = next(k for k, o in enumerate(plain) if found[i].name.startswith(o.name))
        assert np.array_equal(grasps[i].T_obj_ee, grasps[own].T_obj_ee)


def test_a_region_is_a_part_or_all_but_a_part_or_one_side_of_a_plane_a_third_each():
    plain = training_objects(load_benchmark(), FAMILIES)
    kinds: Counter[str] = Counter()
    for new in each(with_regions(plain, 16)[len(plain) :]):
        own = {*new.face_part[new.receiver_face].tolist()}
        rest = {*new.face_part[~new.receiver_face].tolist()}
        share = float(new.receiver_face[new.point_face].mean())
        if not own & rest:
            kinds["part" if len(own) == 1 else "all but a part"] += 1
            assert 1 in (len(own), len(rest)) and 0.05 <= share <= 0.95
        else:
            kinds["plane"] += 1
            assert 0.1 < share < 0.9
            # a plane w m + b = 0 with all middles of the region at least t on its one side, and all others on the other
            middle = new.vertices[new.faces].astype(float).mean(1)
            side = np.where(new.receiver_face, 1.0, -1.0)[:, None]
            rows = np.concatenate([-side * middle, -side, np.ones_like(side)], 1)
            found = linprog([0, 0, 0, 0, -1], A_ub=rows, b_ub=np.zeros(len(rows)), bounds=[(-1, 1)] * 5)
            assert found.x[4] > 1e-7
    assert len(kinds) == 3 and min(kinds.values()) >= 0.15 * 64
    shares = [float(o.receiver_face[o.point_face].mean()) for o in with_regions(plain, 16)[len(plain) :]]
    assert max(shares) > 0.85  # a cup's wall, so that the gripper must take the handle


def test_an_object_that_nothing_divides_is_there_once(monkeypatch):
    plain = training_objects(load_benchmark(), FAMILIES)[:1]
    monkeypatch.setattr("r2h_batch.training.regions.LEAST", 0.6)
    monkeypatch.setattr("r2h_batch.training.regions.MOST", 0.4)
    assert with_regions(plain, 3) == plain
