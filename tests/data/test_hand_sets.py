"""Hand sets from GRAB, ARCTIC, H2O, DexYCB and OakInk: small folders in their formats, read back as what they mean."""

from dataclasses import replace
from pathlib import Path

import hand_data
import numpy as np
import pytest
import torch
import trimesh
from hand_data import FRAMES, LIFTED, WIDEST, body_truth, truth, write_grab
from mano_files import mano_dictionary, mano_twin, write_mano
from scipy.spatial.transform import Rotation
from smplx_files import SIDES, smplx_twin, write_smplx

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.data.hand_sets import motion_file
from r2h_batch.data.mano import load_mano
from r2h_batch.scene.hand import load_hand_set

RECEIVER = "pass1/A01001_0004_0001_0002/2021-09-26-19-59-58"


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    return [write_mano(folder / f"MANO_{n}.pkl", mano_dictionary(s)) for s, n in enumerate(("RIGHT", "LEFT"))]


@pytest.fixture(scope="module")
def model(mano):
    return load_mano(*mano).model


def imported(capsys, folder, source, *more, out="hands.npz"):
    """Exit code, stdout, stderr; the hands and their motions, None where there are none."""
    path = folder / out
    code = main(["import", "hands", str(folder), "--from", source, "--out", str(path), *map(str, more)])
    text, found = capsys.readouterr(), [None, None]
    if path.exists():
        with np.load(path, allow_pickle=False) as hands, np.load(motion_file(path), allow_pickle=False) as motions:
            found = [dict(hands), dict(motions)]
    return code, text.out, text.err, *found


def moving_camera():
    rng = np.random.default_rng(3)
    camera = np.tile(np.eye(4), (FRAMES, 1, 1))
    camera[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (FRAMES, 3))).as_matrix()
    camera[:, :3, 3] = rng.normal(0, 1, (FRAMES, 3))
    return camera


CASES = {  # object and instruction of each; the layouts as their owners release them
    "grab": ("mug", "pass the mug"),
    "arctic": ("box", "use the box"),
    "h2o": ("lotion", "take out the chips"),
    "h2o as its page has it, without MANO": ("lotion", "take out the chips"),
    "dexycb": ("006_mustard_bottle", "pick up the mustard bottle"),
    "oakink": ("A01001", "receive the mug"),
    "oakink in axis-angle": ("A01001", "receive the mug"),
}


def camera_of(case):
    """Camera to world, of H2O alone. The made place is that of MANO's origin: with it only a camera that stands has a hand
    that stands too."""
    return (
        moving_camera()
        if "without" in case
        else np.tile(moving_camera()[0] if case == "h2o" else np.eye(4), (FRAMES, 1, 1))
    )


def write_case(folder, case, model):
    means, components = model.pose_mean.double().numpy(), model.pose_components.double().numpy()
    if case == "grab":
        write_grab(folder, subjects=True)
    elif case == "arctic":
        hand_data.write_arctic(folder, means)
    elif case == "h2o":
        hand_data.write_h2o(folder, camera_of(case), right_from=5)
    elif case == "dexycb":
        hand_data.write_dexycb(folder, components[0], means[0])
        hand_data.write_dexycb(folder, components[1], means[1], side=1, name="20200820-subject-03/20200820_135508")
    elif "h2o" in case:
        hand_data.write_h2o(folder, camera_of(case), right_from=5, kinds=("hand_pose_MANO", "obj_pose_RT"))
    else:
        hand_data.write_oakink(folder, "abcdef0123", f"{RECEIVER}_alt", quaternions="axis" not in case)


@pytest.mark.parametrize("case", CASES)
def test_hands_arms_and_motions_are_those_of_an_own_forward_pass_over_the_released_numbers(
    tmp_path, capsys, mano, model, case
):
    """The pass is the data set's own recipe, in float64."""
    write_case(tmp_path, case, model)
    name, body_model, without = case.split()[0], write_smplx(tmp_path / "smplx"), "without" in case
    options = () if without else ("--mano-right", mano[0], "--mano-left", mano[1], "--smplx", tmp_path / "smplx")
    code, _, err, hands, motions = imported(capsys, tmp_path, name, "--strict", *options)
    assert code == 0, err
    assert hands["side"].tolist() == ([0] if name == "oakink" else [0, 1])
    assert (hands["object"][0], hands["instruction"][0]) == CASES[case]
    posed = model.pose(*(torch.from_numpy(hands[k]) for k in ("pose", "shape", "side"))).vertices.double().numpy()
    camera = camera_of(case)
    for row, side in enumerate(hands["side"]):
        h, arrays = truth(side), mano_dictionary(side)
        fingers, beta = h["fingers"][WIDEST], truth(1)["shape"] if name == "dexycb" else h["shape"]
        if name == "grab":  # its recipe puts the subject's mesh for v_template
            mesh = tmp_path / f"tools/subject_meshes/male/s1_{('rhand', 'lhand')[side]}.ply"
            arrays, beta = {**arrays, "v_template": trimesh.load(mesh, process=False).vertices}, np.zeros(10)
        R, turn = camera[WIDEST, :3, :3], Rotation.from_rotvec(h["turn"])
        seen = (Rotation.from_matrix(R).inv() * turn[WIDEST]).as_rotvec()
        vertices, joints = mano_twin(arrays, np.concatenate([seen, fingers]), beta)
        origin = joints[0] * (
            name == "oakink" or without
        )  # OakInk's place is the wrist's; without MANO all are taken so
        T = hands["T_world_hand"][row].astype(np.float64)
        assert np.abs(posed[row] @ T[:3, :3].T + T[:3, 3] - (vertices - origin) @ R.T - h["place"][WIDEST]).max() < 1e-7
        # what a trial turns and carries, and the motion that leads there
        assert not hands["pose"][row, :3].any() and np.abs(T[:3, :3] - turn[WIDEST].as_matrix()).max() < 1e-5
        assert np.abs(hands["pose"][row, 3:] - fingers).max() < (1e-4 if name == "dexycb" else 1e-5)
        if name == "oakink":
            assert hands["source"][0].endswith("_alt") and hands["frames"][0] == 1
            continue
        first = {"dexycb": 3, "h2o": 0 if side else 5}.get(name, 0)
        mine = slice(motions["first"][row], motions["first"][row + 1])
        assert (
            hands["frame"][row] == WIDEST - first and mine.stop - mine.start == hands["frames"][row] == FRAMES - first
        )
        assert np.abs(hands["T_world_object"][row] - h["object"][WIDEST]).max() < 1e-5
        assert np.abs(motions["fingers"][mine] - h["fingers"][first:]).max() < 2e-3
        places = h["place"] + camera[:, :3, :3] @ (joints[0] - origin)
        assert np.abs(motions["hand"][mine, 3:] - places[first:]).max() < 1e-5
        assert np.abs(motions["object"][mine, 3:] - h["object"][first:, :3, 3]).max() < 1e-5
        if name not in ("grab", "arctic"):
            assert np.isnan(hands["facing"][row]).all()
            continue
        body = body_truth()
        turns = np.concatenate([body["global_orient"][WIDEST], body["body_pose"][WIDEST]]).reshape(22, 3)
        joints = smplx_twin(body_model, 1.04 * body_model["v_template"], turns, body["transl"][WIDEST])
        assert np.abs(hands["arm"][row] - joints[list(SIDES[("right", "left")[side]])]).max() < 1e-6
        facing = Rotation.from_euler("xz", [np.pi / 2, 0.4]).as_matrix()[:, 2]
        assert np.abs(hands["facing"][row] - facing).max() < 1e-5, "level, as the body stands"
        assert np.allclose(hands["up"][row], [0, 0, 1])


def test_without_models_grabs_hands_get_no_shape_and_arctic_asks_for_mano(tmp_path, capsys):
    write_grab(tmp_path)
    hand_data.write_arctic(tmp_path, np.zeros((2, 45)))
    code, out, err, hands, _ = imported(capsys, tmp_path, "grab")
    assert code == 0 and "2 hands of grab (1 right, 1 left)" in out and out.endswith(" left out, 0 files skipped\n")
    needs = "need MANO's files, --mano-right and --mano-left; their hands get the shape 0"
    assert err == f"grab: meshes of subjects: {needs}\n" and not hands["shape"].any()
    assert hands["source"].tolist() == ["grab:s1/mug_pass_1"] * 2 and hands["rate_hz"][0] == 120
    assert load_hand_set(tmp_path / "hands.npz").side.tolist() == [0, 1]
    code, _, err, hands, _ = imported(capsys, tmp_path, "arctic", out="no.npz")
    assert code == 2 and "give MANO's file with --mano-right" in err and hands is None


def test_oakink_takes_the_receivers_of_handovers(tmp_path, capsys):
    hand_data.write_oakink(tmp_path, "0123456789", RECEIVER, seed=1)
    for virtual in (None, "B00001"):
        hand_data.write_oakink(tmp_path, "abcdef0123", f"{RECEIVER}_alt", seed=0, virtual=virtual)
    hand_data.write_oakink(tmp_path, "fedcba9876", RECEIVER.replace("4_0001_0002", "1_0003"), seed=2)
    code, out, _, hands, _ = imported(capsys, tmp_path, "oakink")
    assert code == 0 and "2 hands of oakink (2 right, 0 left)" in out
    h = truth(0, 0)
    assert np.abs(hands["pose"][:, 3:] - h["fingers"][WIDEST]).max() < 1e-5
    assert np.abs(hands["T_world_hand"][0, :3, 3] - h["place"][WIDEST]).max() < 1e-6, "tsl is the wrist joint"
    trials = replace(load_benchmark("r2h-v1"), hand_set=load_hand_set(tmp_path / "hands.npz")).trials(6)
    assert sorted(set(trials.hand_index.tolist())) == [0, 1], "right hands only: they stand for every trial"
    code, out, _, hands, _ = imported(capsys, tmp_path, "oakink", "--frame", "first", out="all.npz")
    assert code == 0 and "4 hands" in out and "use the mug" in hands["instruction"].tolist()


def test_hands_that_never_carry_the_object_are_left_out_and_counted(tmp_path, capsys):
    write_grab(tmp_path, idle=(1,))
    write_grab(tmp_path, "s1/cup_lift_1")
    code, out, _, hands, _ = imported(capsys, tmp_path, "grab")
    assert code == 0 and "3 hands of grab (2 right, 1 left)" in out and "; 1 idle hand left out" in out
    assert hands["source"].tolist() == ["grab:s1/cup_lift_1", "grab:s1/mug_pass_1", "grab:s1/cup_lift_1"]
    seconds = (FRAMES - LIFTED) / 120
    assert np.abs(hands["held_s"] - seconds).max() < 0.12 and hands["mover"].tolist() == [True, True, False]
    code, out, _, hands, _ = imported(capsys, tmp_path, "grab", "--idle", out="all.npz")
    assert code == 0 and "4 hands" in out and (hands["held_s"] == 0).tolist() == [False, False, False, True]


def test_a_data_set_of_idle_hands_alone_says_so(tmp_path, capsys):
    write_grab(tmp_path, idle=(0, 1))
    code, _, err, *_ = imported(capsys, tmp_path, "grab")
    assert (
        code != 0
        and "of 1 files all 2 hands are idle, none carries the object for 0.25 s: take them with --idle" in err
    )


class Runs:
    def __reduce__(self):
        return eval, ("__import__('pathlib').Path('/tmp/r2h_batch_hands_ran').touch()",)


def arrays_of(path):
    with np.load(path, allow_pickle=True) as data:
        return {k: data[k] for k in data.files}


def test_a_bad_file_is_named_and_skipped_or_refused(tmp_path, capsys):
    good = write_grab(tmp_path)
    (good.parent / "cup_pass_1.npz").write_bytes(b"PK\x03\x04 not really")
    evil = {k: np.array(Runs(), object) for k in ("rhand", "lhand", "object", "body")}
    np.savez(good.parent / "pot_pass_1.npz", **evil)
    short, zeros = arrays_of(good), arrays_of(good)
    short["object"].item()["params"]["transl"] = np.zeros((3, 3))
    np.savez(good.parent / "jar_pass_1.npz", **short)
    for name in ("rhand", "lhand", "object", "body"):
        params = zeros[name].item()["params"]
        params.update({k: np.zeros_like(v) for k, v in params.items()})
    np.savez(good.parent / "toy_pass_1.npz", **zeros)
    code, out, err, hands, _ = imported(capsys, tmp_path, "grab")
    lines = [line for line in err.splitlines() if "meshes of subjects" not in line]
    assert code == 0 and out.endswith("; 0 idle hands left out, 4 files skipped\n") and len(hands["side"]) == 2
    for line, name in zip(lines, ("cup", "jar", "pot", "toy"), strict=True):
        assert line.startswith("skipped: ") and name in line
    assert "asks for builtins.eval" in lines[2] and "must be a rotation and two different directions" in lines[3]
    assert not Path("/tmp/r2h_batch_hands_ran").exists()
    code, _, err, hands, _ = imported(capsys, tmp_path, "grab", "--strict", out="strict.npz")
    assert code == 2 and err.startswith("import: ") and "cup_pass_1.npz" in err and len(err.splitlines()) == 1
    assert hands is None


def test_nothing_outside_the_folder_is_read(tmp_path, capsys, model, mano):
    outside = write_grab(tmp_path / "elsewhere")
    inside = tmp_path / "data" / "grab" / "s1"
    inside.mkdir(parents=True)
    (inside / "mug_pass_1.npz").symlink_to(outside)
    code, _, err, _, _ = imported(capsys, tmp_path / "data", "grab")
    assert code == 2 and "1 **/*_*.npz is a link that leads out of the folder (not followed)" in err
    mean, components = model.pose_mean.double().numpy(), model.pose_components.double().numpy()
    meta = hand_data.write_dexycb(tmp_path / "ycb", components[0], mean[0]).with_name("meta.yml")
    for text, words in (
        (meta.read_text().replace("20200709-subject-01_right", "../../../secret"), "points outside"),
        ("a: &x [1, 2]\nb: *x\n", "anchors and aliases are not allowed"),
    ):
        meta.write_text(text)
        code, _, err, _, _ = imported(capsys, tmp_path / "ycb", "dexycb", "--mano-right", mano[0])
        assert code == 2 and words in err


def test_a_body_without_its_mesh_has_the_models_arms(tmp_path, capsys):
    write_grab(tmp_path)
    body_model, body = write_smplx(tmp_path / "smplx"), body_truth()
    code, _, err, hands, _ = imported(capsys, tmp_path, "grab", "--smplx", tmp_path / "smplx")
    assert code == 0 and "s1.ply: not in " in err and "its arms get the model's own lengths" in err
    turns = np.concatenate([body["global_orient"][WIDEST], body["body_pose"][WIDEST]]).reshape(22, 3)
    joints = smplx_twin(body_model, body_model["v_template"], turns, body["transl"][WIDEST])[list(SIDES["right"])]
    assert np.abs(hands["arm"][0] - joints).max() < 1e-6
    ways = load_hand_set(tmp_path / "hands.npz").in_body[0, :, 3:].T.numpy()
    lengths = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    assert np.abs([np.linalg.norm(ways[0]), np.linalg.norm(ways[1] - ways[0])] - lengths).max() < 1e-6
