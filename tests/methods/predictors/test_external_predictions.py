"""Predictions of somebody's own networks: shown the truth as a file, a method answers as when it is shown the truth."""

import re

import numpy as np
import pytest
import torch
from refusals import one_line
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError
from r2h_batch.methods import contact, fc, handover_va, intent
from r2h_batch.methods.part_roles import roles_of
from r2h_batch.methods.predictors import (
    PredictorNoise,
    predict_contacts,
    predict_parts,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.methods.predictors import read_observations as read_files
from r2h_batch.runs.store import load_run
from r2h_batch.trials.holding.receiving import load_receiving

TRUTH = PredictorNoise().scaled(0)
COUNT = 3


def openpose(joints, tips):
    """MANO's 16 joints and five tips (index, middle, pinky, ring, thumb) in OpenPose's order of 21."""
    chains = [[13, 14, 15], [1, 2, 3], [4, 5, 6], [10, 11, 12], [7, 8, 9]]
    tip_of = [4, 0, 1, 3, 2]
    parts = [joints[:, :1]] + [x for c, t in zip(chains, tip_of, strict=True) for x in (joints[:, c], tips[:, [t]])]
    return np.concatenate(parts, 1)


@pytest.fixture(scope="module")
def asked():
    return load_benchmark("r2h-v1").trials(COUNT)


@pytest.fixture
def seen_in(scene, tmp_path):
    """Observations out of a file with these arrays."""

    def read(kind, arrays, **more):
        path = tmp_path / f"{kind}{len(list(tmp_path.iterdir()))}.npz"
        np.savez(path, **arrays)
        return read_files(scene.objects, scene.hands.model, **{kind: str(path)}, **more)

    return read


def hand_arrays(kind, hand, model, form):
    """A file's fields for a predicted hand, as MANO's numbers or as a skin with 21 joints."""
    if form == "skin":
        tips = hand.vertices[:, model.tip_vertices.long()].numpy()
        return {f"{kind}_joints": openpose(hand.joints.numpy(), tips), f"{kind}_vertices": hand.vertices.numpy()}
    frame = {"receiving": "T_obj_hand", "target": "T_world_hand"}[kind]
    return {f"{kind}_{frame}": hand.T.numpy(), **{f"{kind}_{k}": v for k, v in form.items()}}


def truth(scene, trials, receive, form="mano"):
    """Hands without error, in the file's form; shuffled, for rows go by their ids."""
    model, grasps = scene.hands.model, load_receiving(scene.objects)
    taking, target = receive(trials, scene, noise=TRUTH), predict_target(trials, scene, noise=TRUTH)
    own = scene.hands.set
    rows = {"receiving": (grasps, taking.grasp), "target": (own, trials.hand_index.long())}
    arrays = {"trial_id": trials.trial_id.numpy()}
    for kind, hand in (("receiving", taking), ("target", target)):
        bank, at = rows[kind]
        said = form if form == "skin" else {k: getattr(bank, k)[at].numpy() for k in ("pose", "shape")}
        arrays |= hand_arrays(kind, hand, model, said)
    order = np.random.default_rng(0).permutation(len(trials))
    return {k: v[order] for k, v in arrays.items()}


def same(a, b):
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("T_obj_ee", "T_world_ee"))


@pytest.mark.parametrize("method, receive", [
    (fc, predict_receiving), pytest.param(contact, predict_receiving, marks=pytest.mark.whole(part="methods")),
    (intent, retrieve_receiving),
])  # fmt: skip
def test_hands_as_manos_numbers_are_the_hands_that_were_meant(scene, asked, seen_in, method, receive):
    seen = seen_in("hands", truth(scene, asked, receive) | {"source": np.array("text2hoi")})
    assert seen.sources() == {"receiving": "text2hoi", "target": "text2hoi"}
    assert same(method.predict(asked, scene, noise=TRUTH), method.predict(asked, scene, seen=seen))


def test_skins_with_21_joints_say_the_same_hand(scene, asked, seen_in):
    seen = seen_in("hands", truth(scene, asked, predict_receiving, "skin"))
    for predicted in (predict_receiving, predict_target):
        mine, other = predicted(asked, scene, seen=seen), predicted(asked, scene, noise=TRUTH)
        for name in ("vertices", "joints", "palm_normal", "palm_point", "wrist_to_middle"):
            assert torch.allclose(getattr(mine, name), getattr(other, name), atol=1e-6), name
        assert torch.equal(mine.side, other.side)


@pytest.mark.parametrize("form", ["mano", "skin"])
def test_hands_in_another_frame_and_other_units_are_the_same_hands_once_they_say_so(scene, asked, seen_in, form):
    arrays, turn = truth(scene, asked, predict_receiving, form), np.diag([-1.0, -1, 1, 1])
    said = {"frame": "base", "length_unit": "cm", "angle_unit": "deg"}
    other = {k: v.astype(np.float64) if v.dtype.kind == "f" else v for k, v in arrays.items()}
    for name in other.keys() - {"trial_id"}:
        kind, _, rest = name.partition("_")
        if rest == "pose":
            other[name] = np.rad2deg(other[name])
        elif rest.startswith("T_"):
            other[name] = turn @ other[name] if kind == "target" else other[name]
            other[name][:, :3, 3] *= 100
        elif rest in ("joints", "vertices"):
            other[name] = 100 * (other[name] @ turn[:3, :3] if kind == "target" else other[name])
    ours, theirs = (seen_in("hands", a) for a in (arrays, other | {k: np.array(v) for k, v in said.items()}))
    for predicted in (predict_receiving, predict_target):
        mine, found = predicted(asked, scene, seen=ours), predicted(asked, scene, seen=theirs)
        for name in ("vertices", "joints", "palm_normal", "palm_point"):
            assert torch.allclose(getattr(mine, name), getattr(found, name), atol=2e-6), name


def test_parts_and_roles_by_object_or_by_trial_are_those_that_were_meant(scene, asked, seen_in, tmp_path):
    parts, wanted = predict_parts(asked, scene, noise=TRUTH), handover_va.predict(asked, scene, noise=TRUTH)
    target = {k: v for k, v in truth(scene, asked, predict_receiving).items() if "receiving" not in k}
    np.savez(tmp_path / "t.npz", **target)
    by_trial = {"trial_id": asked.trial_id.numpy(), "label": parts.label.numpy(), "usage": parts.usage.numpy()}
    seen_in("parts", by_trial).check_parts(asked, scene.objects)
    most = max(len(o.part_names) for o in scene.objects) - 1  # some object has it, the bowl has not
    with pytest.raises(FileError, match=rf"label of trial \d+ \(\w+\) goes to {most}; it has \d parts?, 0 to"):
        seen_in("parts", by_trial | {"label": by_trial["label"] * 0 + most}).check_parts(asked, scene.objects)
    roles = [
        np.where(o.receiver_face[o.point_face], 1, 0) if o.split == "S1" else role[o.point_part]
        for o, role in zip(scene.objects, roles_of(scene.objects), strict=True)
    ]
    for arrays in (by_trial, {"object_index": np.arange(16), "role": np.stack(roles)}):
        seen = seen_in("parts", arrays, hands=str(tmp_path / "t.npz"))
        assert same(handover_va.predict(asked, scene, seen=seen), wanted)


def test_contacts_by_object_by_trial_and_on_another_cloud_are_those_that_were_meant(scene, asked, seen_in):
    names, probability = np.array([o.name for o in scene.objects]), predict_contacts(asked, scene)
    touched = np.stack([np.linspace(0, 1, 2048)] * 16).astype(np.float32)
    points, turned = np.stack([o.points for o in scene.objects]), np.random.default_rng(1).permutation(2048)
    everywhere = torch.from_numpy(touched[:1]).expand(2 * COUNT, -1)
    for arrays, expected in (
        ({"object": names[::-1], "probability": touched}, everywhere),
        ({"object": names, "probability": touched[:, turned], "points": points[:, turned]}, everywhere),
        ({"trial_id": asked.trial_id.numpy(), "probability": probability.numpy()}, probability),
    ):
        assert torch.equal(predict_contacts(asked, scene, seen=seen_in("contacts", arrays)), expected)


def test_a_sweep_says_whose_predictions_its_methods_saw(scene, tmp_path, capsys):
    trials = load_benchmark("r2h-v1").trials(2)
    arrays = truth(scene, trials, predict_receiving)
    np.savez(tmp_path / "text2hoi.npz", **{k: v for k, v in arrays.items() if "target" not in k})
    line = [
        "sweep",
        "--benchmark",
        "r2h-v1",
        "--method",
        "fc",
        "--trials",
        "2",
        "--execute.sim",
        "none",
        "--predicted-hands",
    ]
    line.append(str(tmp_path / "text2hoi.npz"))
    assert main([*line, "--out", str(tmp_path / "run")]) == 0
    name = "FC-Handover (hand: text2hoi, target hand: oracle + noise)"
    said = capsys.readouterr()
    assert f"{name}: 4 trials" in said.err and "|FC-Handover|estimates|" in said.out  # a short name in the short table
    assert main(["report", str(tmp_path / "run"), "--full"]) == 0
    assert f"FC-Handover: {name}" in " ".join(capsys.readouterr().out.split())
    run = load_run(tmp_path / "run")
    assert run.methods == (name,)
    assert len(run.header["predictors"]["predicted_hands"]["sha256"]) == 64
    assert main([*line, "--trials", "3", "--out", str(tmp_path / "more")]) == 2
    assert "2 planned trials are missing: 4, 5" in capsys.readouterr().err
    assert main(["sweep", "--benchmark", "r2h-v1", "--method", "random", "--predicted-hands", "x.npz"]) == 2
    assert "is seen by --method fc" in capsys.readouterr().err
    both = ["--predictor", "net.pt", "--predicted-contacts", "x.npz"]
    assert main(["sweep", "--benchmark", "r2h-v1", "--method", "contact", *both]) == 2
    assert "both say the contacts" in capsys.readouterr().err


def test_files_that_are_no_predictions_are_refused_in_one_line(scene, asked, seen_in):
    ids, n, big = asked.trial_id.numpy(), 2 * COUNT, np.zeros((2 * COUNT, 2048), int)
    mano, skins = (truth(scene, asked, predict_receiving, form) for form in ("mano", "skin"))
    skin = skins["receiving_vertices"]
    cases = {
        "receiving hands: pose holds a number that is not finite in row 0": (
            "hands", mano | {"receiving_pose": np.full((n, 48), np.nan, np.float32)}),
        "turns joint 0 by 60.62 rad": ("hands", mano | {"receiving_pose": np.full((n, 48), 35.0)}),
        "give either T_obj_hand": ("hands", mano | {"receiving_joints": skin}),
        "need MANO's 16 or OpenPose's 21": ("hands", skins | {"receiving_joints": skin[:, :17]}),
        "lengths are in metres": ("hands", skins | {"receiving_vertices": 1000 * skin}),
        "give that hand with --hand-model": ("hands", skins | {"receiving_vertices": skin[:, :778]}),
        "frame is 'hand', which these hands define": ("hands", skins | {"frame": np.array("hand")}),
        "declares time_unit, which nothing in this file has": ("hands", skins | {"time_unit": np.array("s")}),
        "another frame?": ("hands", skins | {"receiving_vertices": skin + 3}),
        "has label without usage": ("parts", {"trial_id": ids, "label": big}),
        "role goes from 3 to 3": ("parts", {"trial_id": ids, "role": big + 3}),
        "no row for object bowl": ("parts", {"object": np.array(["game_controller"]), "role": big[:1]}),
        "need 0 to 1 (a sigmoid?)": ("contacts", {"trial_id": ids, "probability": big + 1.5}),
        "rows go by one of": ("contacts", {"probability": big + 0.5}),
    }  # fmt: skip
    for words, (kind, arrays) in each(cases.items()):
        with one_line(re.escape(words)):
            seen_in(kind, arrays)
