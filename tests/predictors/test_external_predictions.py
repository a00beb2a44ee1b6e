"""Predictions of somebody's own networks: shown the truth as a file, a method answers as when it is shown the truth."""

import numpy as np
import pytest
import torch

from r2h_batch import make_trials
from r2h_batch.__main__ import main
from r2h_batch.io.read import FileError
from r2h_batch.methods import contact, fc, handover_va, intent
from r2h_batch.methods.part_roles import roles_of
from r2h_batch.predictors import (
    PredictorNoise,
    predict_contacts,
    predict_parts,
    predict_receiving,
    predict_target,
    read_observations,
    retrieve_receiving,
)
from r2h_batch.receiver.receiving import load_receiving
from r2h_batch.runs.store import load_run

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
    return make_trials(trials=COUNT)


def hand_arrays(kind, hand, model, form):
    """What a file says of a predicted hand, as MANO's numbers or as a skin with 21 joints."""
    if form == "skin":
        tips = hand.vertices[:, model.tip_vertices.long()].numpy()
        joints = openpose(hand.joints.numpy(), tips)
        return {f"{kind}_joints": joints, f"{kind}_vertices": hand.vertices.numpy()}
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


def same(a, b, exact=True):
    for name in ("T_obj_ee", "T_world_ee"):
        x, y = getattr(a, name), getattr(b, name)
        assert torch.equal(x, y) if exact else torch.allclose(x, y, atol=2e-4)


def test_hands_as_manos_numbers_are_the_hands_that_were_meant(scene, asked, tmp_path):
    for method, receive in ((fc, predict_receiving), (contact, predict_receiving), (intent, retrieve_receiving)):
        np.savez(tmp_path / "h.npz", **truth(scene, asked, receive), source=np.array("text2hoi"))
        seen = read_observations(scene.objects, scene.hands.model, hands=str(tmp_path / "h.npz"))
        assert seen.sources() == {"receiving": "text2hoi", "target": "text2hoi"}
        same(method.predict(asked, scene, noise=TRUTH), method.predict(asked, scene, seen=seen))


def test_skins_with_21_joints_say_the_same_hand(scene, asked, tmp_path):
    arrays = truth(scene, asked, predict_receiving, "skin")
    np.savez(tmp_path / "h.npz", **arrays)
    seen = read_observations(scene.objects, scene.hands.model, hands=str(tmp_path / "h.npz"))
    for mine, other in (
        (predict_receiving(asked, scene, seen=seen), predict_receiving(asked, scene, noise=TRUTH)),
        (predict_target(asked, scene, seen=seen), predict_target(asked, scene, noise=TRUTH)),
    ):
        for name in ("vertices", "joints", "palm_normal", "palm_point", "wrist_to_middle"):
            assert torch.allclose(getattr(mine, name), getattr(other, name), atol=1e-6), name
        assert torch.equal(mine.side, other.side)


def test_parts_roles_and_contacts_by_object_by_trial_and_on_another_cloud(scene, asked, tmp_path):
    names = np.array([o.name for o in scene.objects])
    parts, wanted = predict_parts(asked, scene, noise=TRUTH), handover_va.predict(asked, scene, noise=TRUTH)
    target = {k: v for k, v in truth(scene, asked, predict_receiving).items() if "receiving" not in k}
    np.savez(tmp_path / "t.npz", **target)
    np.savez(tmp_path / "p.npz", trial_id=asked.trial_id.numpy(), label=parts.label.numpy(), usage=parts.usage.numpy())
    read_observations(scene.objects, scene.hands.model, parts=str(tmp_path / "p.npz")).check_parts(asked, scene.objects)
    most = max(len(o.part_names) for o in scene.objects) - 1  # some object has it, the bowl has not
    np.savez(
        tmp_path / "other.npz",
        trial_id=asked.trial_id.numpy(),
        label=parts.label.numpy() * 0 + most,
        usage=parts.usage.numpy(),
    )
    with pytest.raises(FileError, match=rf"label of trial \d+ \(\w+\) goes to {most}; it has \d parts?, 0 to"):
        read_observations(scene.objects, scene.hands.model, parts=str(tmp_path / "other.npz")).check_parts(
            asked, scene.objects
        )
    role = roles_of(scene.objects)
    by_object = [
        np.where(o.receiver_face[o.point_face], 1, 0) if o.split == "S1" else role[i, o.point_part]
        for i, o in enumerate(scene.objects)
    ]
    np.savez(tmp_path / "r.npz", object_index=np.arange(16), role=np.stack(by_object))
    for file in ("p.npz", "r.npz"):
        seen = read_observations(
            scene.objects, scene.hands.model, hands=str(tmp_path / "t.npz"), parts=str(tmp_path / file)
        )
        same(handover_va.predict(asked, scene, seen=seen), wanted)
    probability = predict_contacts(make_trials(trials=COUNT), scene)
    touched = np.stack([np.linspace(0, 1, 2048)] * 16).astype(np.float32)
    points = np.stack([o.points for o in scene.objects])
    turned = np.random.default_rng(1).permutation(2048)
    np.savez(tmp_path / "own.npz", object=names[::-1], probability=touched)
    np.savez(tmp_path / "cloud.npz", object=names, probability=touched[:, turned], points=points[:, turned])
    np.savez(tmp_path / "trial.npz", trial_id=asked.trial_id.numpy(), probability=probability.numpy())
    for file, expected in (("own.npz", touched), ("cloud.npz", touched), ("trial.npz", None)):
        seen = read_observations(scene.objects, scene.hands.model, contacts=str(tmp_path / file))
        found = predict_contacts(asked, scene, seen=seen)
        assert torch.equal(
            found, probability if expected is None else torch.from_numpy(touched[:1]).expand(2 * COUNT, -1)
        )


def test_a_sweep_says_whose_predictions_its_methods_saw(scene, tmp_path, capsys):
    trials = make_trials(trials=2)
    arrays = truth(scene, trials, predict_receiving)
    np.savez(tmp_path / "text2hoi.npz", **{k: v for k, v in arrays.items() if "target" not in k})
    line = [
        "sweep",
        "--method",
        "fc",
        "--trials",
        "2",
        "--sim",
        "none",
        "--predicted-hands",
        str(tmp_path / "text2hoi.npz"),
    ]
    assert main([*line, "--out", str(tmp_path / "run")]) == 0
    assert "FC-Handover (hand: text2hoi, target hand: oracle + noise)" in capsys.readouterr().out.replace("\n", " ")
    run = load_run(tmp_path / "run")
    assert run.methods == ("FC-Handover (hand: text2hoi, target hand: oracle + noise)",)
    assert len(run.header["predictors"]["predicted_hands"]["sha256"]) == 64
    assert main([*line, "--trials", "3", "--out", str(tmp_path / "more")]) == 2
    assert "2 planned trials are missing: 4, 5" in capsys.readouterr().err
    assert main(["sweep", "--method", "random", "--predicted-hands", "x.npz"]) == 2
    assert "is seen by --method fc" in capsys.readouterr().err
    both = ["--predictor", "net.pt", "--predicted-contacts", "x.npz"]
    assert main(["sweep", "--method", "contact", *both]) == 2
    assert "both say the contacts" in capsys.readouterr().err


def broken(scene, trials, form="mano", **change):
    arrays = truth(scene, trials, predict_receiving, form)
    return {k: v for k, v in (arrays | change).items() if v is not None}


def test_files_that_are_no_predictions_are_refused_in_one_line(scene, asked, tmp_path):
    ids, n = asked.trial_id.numpy(), 2 * COUNT
    skin = truth(scene, asked, predict_receiving, "skin")["receiving_vertices"]
    nan = np.full((n, 48), np.nan, np.float32)
    cases = {
        "receiving hands: pose holds a number that is not finite in row 0": (
            "hands",
            broken(scene, asked, receiving_pose=nan),
        ),
        "turns joint 0 by 60.62 rad": ("hands", broken(scene, asked, receiving_pose=np.full((n, 48), 35.0))),
        "give either T_obj_hand": ("hands", broken(scene, asked, receiving_joints=skin)),
        "need MANO's 16 or OpenPose's 21": ("hands", broken(scene, asked, "skin", receiving_joints=skin[:, :17])),
        "lengths are in metres": ("hands", broken(scene, asked, "skin", receiving_vertices=1000 * skin)),
        "give that hand with --hand-model": ("hands", broken(scene, asked, "skin", receiving_vertices=skin[:, :778])),
        "another frame?": ("hands", broken(scene, asked, "skin", receiving_vertices=skin + 3)),
        "has label without usage": ("parts", {"trial_id": ids, "label": np.zeros((n, 2048), int)}),
        "role goes from 3 to 3": ("parts", {"trial_id": ids, "role": np.full((n, 2048), 3)}),
        "no row for object bowl": (
            "parts",
            {"object": np.array(["game_controller"]), "role": np.zeros((1, 2048), int)},
        ),
        "need 0 to 1 (a sigmoid?)": ("contacts", {"trial_id": ids, "probability": np.full((n, 2048), 1.5)}),
        "rows go by one of": ("contacts", {"probability": np.zeros((n, 2048))}),
        "source is not a name": (
            "contacts",
            {"trial_id": ids, "probability": np.zeros((n, 2048)), "source": np.array("a\nb")},
        ),
    }
    for words, (kind, arrays) in cases.items():
        np.savez(tmp_path / "x.npz", **arrays)
        with pytest.raises(FileError) as error:
            read_observations(scene.objects, scene.hands.model, **{kind: str(tmp_path / "x.npz")})
        assert words in str(error.value) and "\n" not in str(error.value), words
    (tmp_path / "x.pkl").write_bytes(b"\x80\x04.")
    with pytest.raises(FileError, match=r"an \.npz file"):
        read_observations(scene.objects, scene.hands.model, hands=str(tmp_path / "x.pkl"))
