"""Hand sets from GRAB, ARCTIC, H2O, DexYCB and OakInk: small folders in their formats, read back as what they mean."""

import numpy as np
import pytest
import torch
from hand_data import (
    FRAMES,
    LIFTED,
    WIDEST,
    body_truth,
    truth,
    write_arctic,
    write_dexycb,
    write_grab,
    write_h2o,
    write_oakink,
)
from hand_errors import CASES, largest_errors, moving_camera
from mano_files import mano_dictionary, write_mano
from scipy.spatial.transform import Rotation
from smplx_files import SIDES, smplx_twin, write_smplx

from r2h_batch.__main__ import main
from r2h_batch.bodies.hand import load_hand_set
from r2h_batch.importers.hand_sets import motion_file
from r2h_batch.importers.mano import load_mano
from r2h_batch.trials.protocol import make_trials


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    return [write_mano(folder / f"MANO_{n}.pkl", mano_dictionary(s)) for s, n in enumerate(("RIGHT", "LEFT"))]


@pytest.fixture(scope="module")
def means(mano):
    hand = load_mano(*mano).model
    return hand.pose_mean.double().numpy(), hand.pose_components.double().numpy()


def imported(capsys, folder, source, out, *more):
    code = main(["import", "hands", str(folder), "--from", source, "--out", str(out), *map(str, more)])
    text = capsys.readouterr()
    return code, text.out, text.err


def loaded(path):
    with np.load(path, allow_pickle=False) as hands, np.load(motion_file(path), allow_pickle=False) as motions:
        return dict(hands), dict(motions)


def check(hands, motions, row, side, frame, first, wrist_offset=None, pose_tolerance=1e-5):
    """Row `row` is the known motion's hand of this side at `frame`; its stored motion starts at frame `first` of it."""
    h = truth(side)
    assert hands["side"][row] == side and hands["frame"][row] == frame - first
    assert not hands["pose"][row, :3].any(), "trials turn the whole hand"
    assert np.abs(hands["pose"][row, 3:] - h["fingers"][frame]).max() < pose_tolerance
    R = Rotation.from_rotvec(h["turn"][frame]).as_matrix()
    offset = np.zeros(3) if wrist_offset is None else wrist_offset
    assert np.abs(hands["T_world_hand"][row, :3, :3] - R).max() < 1e-5
    assert np.abs(hands["T_world_hand"][row, :3, 3] - h["place"][frame] - offset).max() < 1e-5
    assert np.abs(hands["T_world_object"][row] - h["object"][frame]).max() < 1e-5
    mine = slice(motions["first"][row], motions["first"][row + 1])
    assert mine.stop - mine.start == hands["frames"][row] == FRAMES - first
    assert np.abs(motions["fingers"][mine] - h["fingers"][first:]).max() < 2e-3
    assert np.abs(motions["hand"][mine, 3:] - h["place"][first:] - offset).max() < 1e-5
    assert np.abs(motions["object"][mine, 3:] - h["object"][first:, :3, 3]).max() < 1e-5


@pytest.mark.parametrize("case", CASES)
def test_vertices_and_arms_are_those_of_an_own_forward_pass_over_the_released_numbers(tmp_path, mano, case):
    """Every layout as its owners release it; the pass is the data set's own recipe in float64."""
    skin, arm = largest_errors(tmp_path, case, mano)
    assert skin < 1e-7 and arm < 1e-6, f"{1e3 * skin} mm, arms {1e3 * arm} mm"


def test_grab(tmp_path, capsys):
    write_grab(tmp_path)
    code, out, err = imported(capsys, tmp_path, "grab", tmp_path / "hands.npz")
    assert (
        code == 0
        and "2 hands of grab (1 right, 1 left)" in out
        and out.endswith(" left out, 0 files skipped\n")
        and err
        == "grab: meshes of subjects: need MANO's files, --mano-right and --mano-left; their hands get the shape 0\n"
    )
    hands, motions = loaded(tmp_path / "hands.npz")
    for side in (0, 1):
        check(hands, motions, side, side, WIDEST, 0)
    assert hands["source"].tolist() == ["grab:s1/mug_pass_1"] * 2 and hands["object"][0] == "mug"
    assert hands["instruction"][0] == "pass the mug" and hands["rate_hz"][0] == 120
    assert np.allclose(hands["up"], [0, 0, 1]) and not hands["shape"].any()
    facing = Rotation.from_euler("xz", [np.pi / 2, 0.4]).as_matrix()[:, 2]
    assert np.abs(hands["facing"] - facing).max() < 1e-5 and abs(facing[2]) < 1e-9, "level, as the body stands"
    posed = load_hand_set(tmp_path / "hands.npz")
    assert (
        len(posed) == 2
        and posed.posture == ("grab", "grab")
        and torch.equal(posed.side, torch.tensor([0, 1]).to(torch.int8))
    )


def test_arctic_is_about_the_mean_hand_and_in_millimetres(tmp_path, capsys, mano, means):
    write_arctic(tmp_path, means[0])
    code, _, err = imported(capsys, tmp_path, "arctic", tmp_path / "no.npz")
    assert code == 2 and "give MANO's file with --mano-right" in err and not (tmp_path / "no.npz").exists()
    options = ("--mano-right", mano[0], "--mano-left", mano[1])
    code, _, _ = imported(capsys, tmp_path, "arctic", tmp_path / "hands.npz", *options)
    hands, motions = loaded(tmp_path / "hands.npz")
    assert code == 0
    hand = load_mano(*mano)
    for side in (0, 1):
        shape = truth(side)["shape"][None]
        offset = hand.wrist(np.zeros((1, 3)), shape, np.array([side]))[0]
        check(hands, motions, side, side, WIDEST, 0, offset)
        assert np.abs(hands["shape"][side] - shape).max() < 1e-6
    assert hands["source"][0] == "arctic:s01/box_use_01" and hands["instruction"][0] == "use the box"
    assert np.allclose(hands["up"], [0, 0, 1]) and np.isfinite(hands["facing"]).all()


def test_h2o_is_taken_out_of_the_cameras_frame(tmp_path, capsys):
    write_h2o(tmp_path, moving_camera(), right_from=5)
    code, _, _ = imported(capsys, tmp_path, "h2o", tmp_path / "hands.npz")
    hands, motions = loaded(tmp_path / "hands.npz")
    assert (
        code == 0
        and np.isnan(hands["facing"]).all()
        and hands["object"][0] == "lotion"
        and hands["instruction"][0] == "take out the chips"
    )
    check(hands, motions, 0, 0, WIDEST, 5)
    check(hands, motions, 1, 1, WIDEST, 0)
    assert hands["source"][0] == "h2o:subject1/h1/0/cam4"


def test_dexycb_is_in_components_about_the_mean_hand(tmp_path, capsys, mano, means):
    mean, components = means
    write_dexycb(tmp_path, components[0], mean[0])
    write_dexycb(tmp_path, components[1], mean[1], side=1, name="20200820-subject-03/20200820_135508")
    options = ("--mano-right", mano[0], "--mano-left", mano[1])
    code, _, _ = imported(capsys, tmp_path, "dexycb", tmp_path / "hands.npz", *options)
    hands, motions = loaded(tmp_path / "hands.npz")
    hand = load_mano(*mano)
    assert code == 0 and hands["object"].tolist() == ["006_mustard_bottle"] * 2
    assert hands["instruction"][0] == "pick up the mustard bottle"
    for side in (0, 1):  # both subjects share the calibration that was written last
        offset = hand.wrist(np.zeros((1, 3)), truth(1)["shape"][None], np.array([side]))[0]
        check(hands, motions, side, side, WIDEST, 3, offset, 1e-4)


def test_oakink_takes_the_receivers_of_handovers(tmp_path, capsys):
    time = "2021-09-26-19-59-58"
    write_oakink(tmp_path, "0123456789", f"pass1/A01001_0004_0001_0002/{time}", seed=1)
    write_oakink(tmp_path, "abcdef0123", f"pass1/A01001_0004_0001_0002/{time}_alt", seed=0)
    write_oakink(tmp_path, "fedcba9876", f"pass1/A01001_0001_0003/{time}", seed=2)
    write_oakink(tmp_path, "abcdef0123", f"pass1/A01001_0004_0001_0002/{time}_alt", seed=0, virtual="B00001")
    code, out, _ = imported(capsys, tmp_path, "oakink", tmp_path / "hands.npz")
    hands, _ = loaded(tmp_path / "hands.npz")
    assert code == 0 and "2 hands of oakink (2 right, 0 left)" in out
    h = truth(0, 0)
    assert np.abs(hands["pose"][:, 3:] - h["fingers"][WIDEST]).max() < 1e-5
    assert np.abs(hands["T_world_hand"][0, :3, 3] - h["place"][WIDEST]).max() < 1e-6, "tsl is the wrist joint"
    assert hands["instruction"][0] == "receive the mug" and hands["source"][0].endswith("_alt")
    trials = make_trials(trials=6, hand_set=load_hand_set(tmp_path / "hands.npz"))
    assert sorted(set(trials.hand_index.tolist())) == [0, 1], "right hands only: they stand for every trial"
    code, out, _ = imported(capsys, tmp_path, "oakink", tmp_path / "all.npz", "--frame", "first")
    assert code == 0 and "4 hands" in out
    assert "use the mug" in loaded(tmp_path / "all.npz")[0]["instruction"].tolist()


def test_hands_that_never_carry_the_object_are_left_out_and_counted(tmp_path, capsys):
    write_grab(tmp_path, idle=(1,))
    write_grab(tmp_path, "s1/cup_lift_1")
    code, out, _ = imported(capsys, tmp_path, "grab", tmp_path / "hands.npz")
    hands, _ = loaded(tmp_path / "hands.npz")
    assert code == 0 and "3 hands of grab (2 right, 1 left)" in out and "; 1 idle hand left out" in out
    assert hands["source"].tolist() == ["grab:s1/cup_lift_1", "grab:s1/mug_pass_1", "grab:s1/cup_lift_1"]
    seconds = (FRAMES - LIFTED) / 120
    assert np.abs(hands["held_s"] - seconds).max() < 0.12 and hands["mover"].tolist() == [True, True, False]
    code, out, _ = imported(capsys, tmp_path, "grab", tmp_path / "all.npz", "--idle")
    hands, _ = loaded(tmp_path / "all.npz")
    assert code == 0 and "4 hands" in out and (hands["held_s"] == 0).tolist() == [False, False, False, True]


class Runs:
    def __reduce__(self):
        return eval, ("__import__('pathlib').Path('/tmp/r2h_batch_hands_ran').touch()",)


def test_a_bad_file_is_named_and_skipped_or_refused(tmp_path, capsys):
    good = write_grab(tmp_path)
    (good.parent / "cup_pass_1.npz").write_bytes(b"PK\x03\x04 not really")
    np.savez(
        good.parent / "pot_pass_1.npz", **{k: np.array(Runs(), object) for k in ("rhand", "lhand", "object", "body")}
    )
    with np.load(good, allow_pickle=True) as data:
        short = {k: data[k] for k in data.files}
    short["object"].item()["params"]["transl"] = np.zeros((3, 3))
    np.savez(good.parent / "jar_pass_1.npz", **short)
    code, out, err = imported(capsys, tmp_path, "grab", tmp_path / "hands.npz")
    lines = [line for line in err.splitlines() if "meshes of subjects" not in line]
    assert (
        code == 0
        and out.endswith("; 0 idle hands left out, 3 files skipped\n")
        and len(loaded(tmp_path / "hands.npz")[0]["side"]) == 2
    )
    assert [next(w for w in ("cup", "jar", "pot") if w in line) for line in lines] == ["cup", "jar", "pot"]
    assert all(line.startswith("skipped: ") for line in lines) and "asks for builtins.eval" in lines[2]
    from pathlib import Path

    assert not Path("/tmp/r2h_batch_hands_ran").exists()
    code, _, err = imported(capsys, tmp_path, "grab", tmp_path / "strict.npz", "--strict")
    assert code == 2 and err.startswith("import: ") and "cup_pass_1.npz" in err and len(err.splitlines()) == 1
    assert not (tmp_path / "strict.npz").exists()


def test_a_sequence_of_zeros_is_refused_where_it_is_read_and_not_where_the_hands_are_used(tmp_path, capsys):
    good = write_grab(tmp_path)
    with np.load(good, allow_pickle=True) as data:
        arrays = {k: data[k] for k in data.files}
    for name in ("rhand", "lhand", "object", "body"):
        params = arrays[name].item()["params"]
        params.update({k: np.zeros_like(v) for k, v in params.items()})
    np.savez(good, **arrays)
    code, _, err = imported(capsys, tmp_path, "grab", tmp_path / "hands.npz")
    assert (
        code == 2 and "must be a rotation and two different directions" in err and not (tmp_path / "hands.npz").exists()
    )


def test_nothing_outside_the_folder_is_read(tmp_path, capsys, means, mano):
    outside = write_grab(tmp_path / "elsewhere")
    inside = tmp_path / "data" / "grab" / "s1"
    inside.mkdir(parents=True)
    (inside / "mug_pass_1.npz").symlink_to(outside)
    code, _, err = imported(capsys, tmp_path / "data", "grab", tmp_path / "hands.npz")
    assert code == 2 and "1 **/*_*.npz is a link that leads out of the folder (not followed)" in err
    write_grab(tmp_path / "data", "s1/cup_pass_1")
    code, _, err = imported(capsys, tmp_path / "data", "grab", tmp_path / "linked.npz")
    assert code == 0 and "is a link that leads out of the folder, left out" in err
    mean, components = means
    pose = write_dexycb(tmp_path / "ycb", components[0], mean[0])
    meta = pose.with_name("meta.yml")
    meta.write_text(meta.read_text().replace("20200709-subject-01_right", "../../../secret"))
    code, _, err = imported(capsys, tmp_path / "ycb", "dexycb", tmp_path / "hands.npz", "--mano-right", mano[0])
    assert code == 2 and "points outside" in err
    meta.write_text("a: &x [1, 2]\nb: *x\n")
    code, _, err = imported(capsys, tmp_path / "ycb", "dexycb", tmp_path / "hands.npz", "--mano-right", mano[0])
    assert code == 2 and "anchors and aliases are not allowed" in err


def test_a_body_without_its_mesh_has_the_models_arms(tmp_path, capsys):
    write_grab(tmp_path)
    model, body = write_smplx(tmp_path / "smplx"), body_truth()
    code, _, err = imported(capsys, tmp_path, "grab", tmp_path / "hands.npz", "--smplx", tmp_path / "smplx")
    assert code == 0 and "s1.ply: not in " in err and "its arms get the model's own lengths" in err
    turns = np.concatenate([body["global_orient"][WIDEST], body["body_pose"][WIDEST]]).reshape(22, 3)
    joints = smplx_twin(model, model["v_template"], turns, body["transl"][WIDEST])[list(SIDES["right"])]
    assert np.abs(loaded(tmp_path / "hands.npz")[0]["arm"][0] - joints).max() < 1e-6
    ways = load_hand_set(tmp_path / "hands.npz").in_body[0, :, 3:].T.numpy()
    lengths = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    assert np.abs([np.linalg.norm(ways[0]), np.linalg.norm(ways[1] - ways[0])] - lengths).max() < 1e-6
