"""Declared conventions: a file written in another frame, unit or order is read as the same answers, and a wrong word or one
that the numbers contradict is one line."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from prediction_files import refused, store
from scipy.spatial.transform import Rotation

from r2h_batch.base.declared import ALLOWED, joint_columns
from r2h_batch.base.errors import FileError
from r2h_batch.trials.predictions import Answers, check_frame, load_answers, load_predictions, write_predictions
from r2h_batch.types import Predictions, Trials

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
HOME = (-0.32, -1.75, 1.43, -1.26, -1.57, 1.25)
OF_METRE = {"m": 1, "cm": 100, "mm": 1000, "inch": 1 / 0.0254}
OF_SECOND = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}
UNITS = {name: tuple(ALLOWED[name]) for name in ("length_unit", "angle_unit", "time_unit")}


def answers(seed: int, n: int = 6) -> dict[str, np.ndarray]:
    """Poses and motions of n trials in our conventions, as float64."""
    rng = np.random.default_rng(seed)
    data = {"trial_id": rng.permutation(n)}
    for name, middle, spread in (("T_obj_ee", 0.0, 0.05), ("T_world_ee", 0.6, 0.1)):
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
        T[:, :3, 3] = [middle, 0.0, middle / 2] + spread * rng.normal(size=(n, 3))
        data[name] = T
    length = rng.integers(2, 5, n)
    first = np.repeat(np.cumsum(length) - length, length)
    data["q"] = rng.uniform(-2.8, 2.8, (length.sum(), 6))
    data["time_s"] = (np.arange(length.sum()) - first) * 1.7
    data["length"] = length
    return data


def hands(n: int, seed: int = 5) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    T[:, :3, 3] = [0.65, 0.05, 0.35]
    return torch.from_numpy(T.astype(np.float32))


def in_another(data, said, T_world_hand=None) -> dict[str, np.ndarray]:
    """The same answers as a program writes them that has these conventions: an independent way out."""
    out = {k: v.copy() for k, v in data.items()}
    if (frame := said.get("frame")) in ("base", "hand"):
        to = np.diag([-1.0, -1, 1, 1]) if frame == "base" else np.linalg.inv(T_world_hand.double().numpy())
        out["T_world_ee"] = to @ out["T_world_ee"]
    for name in ("T_obj_ee", "T_world_ee"):
        out[name][:, :3, 3] *= OF_METRE[said.get("length_unit", "m")]
        if order := said.get("quaternion_order"):
            xyzw = Rotation.from_matrix(out[name][:, :3, :3]).as_quat()
            quaternion = xyzw if order == "xyzw" else xyzw[:, [3, 0, 1, 2]]
            out[name] = np.concatenate([out[name][:, :3, 3], quaternion], 1)
    if "q" in out:
        if said.get("angle_unit") == "deg":
            out["q"] = np.rad2deg(out["q"])
        out["time_s"] *= OF_SECOND[said.get("time_unit", "s")]
        if "joint_names" in said:
            out["q"] = out["q"][:, [JOINTS.index(j) for j in said["joint_names"]]]
    return out | {k: np.array(v) for k, v in said.items()}


def as_file(path, data):
    """The arrays as a file of this ending."""
    if path.suffix == ".npz":
        np.savez(path, **data)
    elif path.suffix == ".json":
        path.write_text(json.dumps({k: v.tolist() for k, v in data.items()}))
    else:
        n, columns = len(data["trial_id"]), {}
        for name, value in data.items():
            if name in ("q", "time_s"):
                columns[name] = [x.tolist() for x in np.split(value, np.cumsum(data["length"])[:-1])]
            elif value.shape[:1] != (n,) or name == "joint_names":
                columns[name] = [value.tolist()] * n
            elif name != "length":
                columns[name] = value.reshape(n, -1).tolist() if value.ndim > 1 else value.tolist()
        if path.suffix == ".parquet":
            pq.write_table(pa.table(columns), path, write_page_checksum=True)
        else:
            flat = {}
            for name, value in columns.items():
                wide = name in ("T_obj_ee", "T_world_ee")
                flat |= (
                    {f"{name}_{k}": [row[k] for row in value] for k in range(len(value[0]))} if wide else {name: value}
                )
            lines = [",".join(flat), *(",".join(map(str, row)) for row in zip(*flat.values(), strict=True))]
            path.write_text("\n".join(lines))
    return path


def read(path, T_world_hand) -> tuple[Predictions, Answers]:
    found = load_answers(path).ordered(JOINTS, HOME, str(path))
    n = len(found.predictions)
    zeros = torch.zeros(n, dtype=torch.int32)
    trials = Trials(found.predictions.trial_id, zeros, zeros, T_world_hand)
    return found.in_world(found.predictions, trials), found


def the_same(path, other, T_world_hand, slack):
    (mine, motion), (theirs, motion_too) = read(path, T_world_hand), read(other, T_world_hand)
    assert torch.equal(mine.trial_id, theirs.trial_id)
    for name in ("T_obj_ee", "T_world_ee"):
        assert torch.allclose(getattr(mine, name), getattr(theirs, name), atol=slack, rtol=0.0), name
    if motion.motions is not None:
        assert torch.equal(motion.motions.length, motion_too.motions.length)
        for name in ("q", "time_s"):
            assert torch.allclose(
                getattr(motion.motions, name), getattr(motion_too.motions, name), atol=slack, rtol=0
            ), name


@given(
    seed=st.integers(0, 2**32 - 1),
    frame=st.sampled_from(list(ALLOWED["frame"])),
    units=st.fixed_dictionaries({k: st.sampled_from(v) for k, v in UNITS.items()}),
    order=st.sampled_from([None, *ALLOWED["quaternion_order"]]),
    joints=st.one_of(st.none(), st.permutations(JOINTS)),
    ending=st.sampled_from([".npz", ".json", ".parquet", ".csv"]),
)
@settings(max_examples=60, deadline=None)
def test_what_is_declared_is_read_as_what_is_ours(tmp_path_factory, seed, frame, units, order, joints, ending):
    folder, data = tmp_path_factory.mktemp("declared"), answers(seed)
    said = {"frame": frame, **units}
    if ending == ".csv":
        data = {k: v for k, v in data.items() if k in ("trial_id", "T_obj_ee", "T_world_ee")}
    elif joints is not None:
        said["joint_names"] = list(joints)
    if order is not None:
        said["quaternion_order"] = order
    T_world_hand = hands(6)
    ours, theirs = (
        as_file(folder / f"{k}{ending}", d) for k, d in enumerate((data, in_another(data, said, T_world_hand)))
    )
    the_same(ours, theirs, T_world_hand, 2e-6)


@pytest.mark.parametrize("ending", [".npz", ".json", ".parquet"])
@pytest.mark.parametrize("said", [
    {"frame": "base"}, {"frame": "base_link", "length_unit": "m", "angle_unit": "rad", "time_unit": "s"},
    {"joint_names": sorted(JOINTS)},
    {"frame": "base", "joint_names": [*JOINTS[3:], *JOINTS[:3]]},
], ids=str)  # fmt: skip
def test_conversions_without_rounding_give_the_same_bits(tmp_path, ending, said):
    data = answers(3)
    ours, theirs = as_file(tmp_path / f"a{ending}", data), as_file(tmp_path / f"b{ending}", in_another(data, said))
    the_same(ours, theirs, hands(6), 0.0)


def test_what_we_write_says_its_conventions_and_is_read_back_equal(tmp_path):
    data = answers(1)
    made = Predictions(
        torch.arange(6), *(torch.from_numpy(data[k].astype(np.float32)) for k in ("T_obj_ee", "T_world_ee"))
    )
    write_predictions(tmp_path / "p.npz", made)
    with np.load(tmp_path / "p.npz") as file:
        assert {k: str(file[k]) for k in ("frame", "length_unit", "time_unit")} == {
            "frame": "world", "length_unit": "m", "time_unit": "s",
        }  # fmt: skip
    assert torch.equal(load_predictions(tmp_path / "p.npz").T_world_ee, made.T_world_ee)


def poses(**said):
    data = answers(2)
    return {k: v for k, v in data.items() if k in ("trial_id", "T_obj_ee", "T_world_ee")} | {
        k: np.array(v) for k, v in said.items()
    }


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"length_unit": "millimetre"}, "length_unit is 'millimetre'; allowed are m, cm, mm, inch"),
        ({"lenght_unit": "mm"}, "unknown array 'lenght_unit', did you mean length_unit?; allowed are trial_id"),
        ({"length_unit": 1000}, "length_unit is int64 (); it must be one word: m, cm, mm, inch"),
        ({"frame": "worlds"}, "frame is 'worlds', did you mean world?; allowed are world, base_link, base, hand"),
        ({"frame": ["world", "base"]}, "frame is 'base', 'world' in different rows; a file declares one word"),
        ({"joint_names": list(JOINTS)}, "declares joint_names, and has no motions"),
        ({"quaternion_order": "wxyz"}, "is 6 x 4 x 4, no quaternions; give N x 7"),
        ({"length_unit": "mm"}, "length_unit is mm, and the median T_world_ee then lies 0.000"),
    ],
)
def test_a_wrong_word_is_one_line_that_says_what_is_allowed(tmp_path, said, words):
    refused(store(tmp_path / "p.npz", poses(**said)), words)


def test_seven_numbers_need_their_order(tmp_path):
    data = poses()
    data["T_obj_ee"] = np.zeros((6, 7))
    refused(store(tmp_path / "p.npz", data), "T_obj_ee has 7 numbers a row; declare quaternion_order: wxyz or xyzw")
    columns = {"trial_id": list(range(6)), "T_obj_ee": [[0.0] * 7] * 6, "T_world_ee": [[0.0] * 7] * 6}
    pq.write_table(pa.table(columns), tmp_path / "p.parquet", write_page_checksum=True)
    refused(tmp_path / "p.parquet", "7 numbers in row 0", "or 7 and a column quaternion_order")


def test_a_quaternion_before_the_position_is_refused(tmp_path):
    data = in_another(poses(), {"quaternion_order": "wxyz"})
    data["T_obj_ee"] = np.roll(data["T_obj_ee"], 4, 1)
    refused(
        store(tmp_path / "p.npz", data), "the first four of the 7 numbers of T_obj_ee are a quaternion", "x, y, z first"
    )


CONTRADICTED = [
    ({"angle_unit": "deg"}, {}, "angle_unit is deg, and the median motion of q has no angle beyond", "radians?"),
    ({"angle_unit": "rad"}, {"angle_unit": "deg"}, "angle_unit is rad, and the median motion of q turns by", "degrees?"),
    ({"time_unit": "s"}, {"time_unit": "ns"}, "time_unit is s, and the median motion then lasts", "with ns it lasts"),
    ({"time_unit": "ns"}, {}, "time_unit is ns, and the median motion then lasts", "with s it lasts"),
    ({"length_unit": "m"}, {"length_unit": "cm"}, "length_unit is m, and the median T_", "with cm it lies"),
    ({"joint_names": list(JOINTS[:5])}, {}, "joint_names has 5 names, and q 6 columns"),
    ({"joint_names": [*JOINTS[:5], JOINTS[0]]}, {}, "joint_names has 'shoulder_pan_joint' twice"),
]  # fmt: skip


@pytest.mark.parametrize(("said", "true", "words"), [(*c[:2], c[2:]) for c in CONTRADICTED])
def test_a_unit_that_the_motions_contradict_is_refused(tmp_path, said, true, words):
    data = in_another(answers(4), true) | {k: np.array(v) for k, v in said.items()}
    with pytest.raises(FileError) as error:
        load_answers(as_file(tmp_path / "m.npz", data))
    assert "\n" not in str(error.value) and all(w in str(error.value) for w in words), error.value


def test_times_as_whole_nanoseconds_are_read_where_they_are_declared(tmp_path):
    data = answers(4)
    whole = data | {"time_s": (data["time_s"] * 1e9).round().astype(np.int64) + 1_700_000_000_000_000_000}
    with pytest.raises(FileError, match=r"time_s .* int64"):
        load_answers(as_file(tmp_path / "a.npz", whole))
    found = load_answers(as_file(tmp_path / "b.npz", whole | {"time_unit": np.array("ns")})).motions
    assert np.allclose(found.time_s, data["time_s"], atol=1e-6)


def test_times_of_day_in_float32_are_refused_for_their_steps(tmp_path):
    coarse = answers(4) | {"time_s": (answers(4)["time_s"] + 1.7e9).astype(np.float32)}
    with pytest.raises(
        FileError, match=r"time_s is float32 and goes to 1.7e\+09 s, where its steps are 1.3e\+02 s: write float64"
    ):
        load_answers(as_file(tmp_path / "m.npz", coarse))


def test_milliseconds_in_float32_are_told_by_their_unit(tmp_path):
    data = answers(4)
    longest = 2e7 / data["time_s"].max()
    coarse = data | {"time_s": (data["time_s"] * longest).astype(np.float32)}
    with pytest.raises(
        FileError, match=r"time_s is float32 .* as us they are those of motions: a file may declare time_unit=us"
    ):
        load_answers(as_file(tmp_path / "m.npz", coarse))


def test_names_with_which_no_motion_begins_at_home_are_refused_where_all_do_without_them(tmp_path):
    data = answers(4)
    data["q"][np.cumsum(data["length"]) - data["length"]] = HOME
    data["joint_names"] = np.array(sorted(JOINTS))
    with pytest.raises(FileError, match="f: all 6 motions begin at home with the columns as they stand, and none with"):
        load_answers(as_file(tmp_path / "m.npz", data)).ordered(JOINTS, HOME, "f")
    theirs = in_another({k: v for k, v in data.items() if k != "joint_names"}, {"joint_names": sorted(JOINTS)})
    first = load_answers(as_file(tmp_path / "n.npz", theirs)).ordered(JOINTS, HOME, "f").motions.q[0]
    assert torch.allclose(first, torch.tensor(HOME), atol=1e-6)


def test_joints_are_found_by_name_with_a_prefix_and_a_gripper_beside_them():
    alphabetical = sorted(["finger_joint", *JOINTS])
    assert [alphabetical[k] for k in joint_columns(alphabetical, JOINTS, "f")] == list(JOINTS)
    left = [f"left_{j}" for j in sorted(JOINTS)]
    assert [left[k] for k in joint_columns(left, JOINTS, "f")] == [f"left_{j}" for j in JOINTS]
    with pytest.raises(FileError, match=r"f: joint_names has no shoulder_pan_joint; it has j0, j1, j2.* name these"):
        joint_columns(["j0", "j1", "j2", "j3", "j4", "j5"], JOINTS, "f")


@pytest.mark.parametrize(
    ("declared", "true"), [("base", "world"), ("world", "base"), ("world", "hand"), ("hand", "world")]
)
def test_a_frame_that_takes_the_grippers_from_the_hands_is_refused(tmp_path, declared, true):
    T_world_hand = hands(6)
    data = in_another(answers(6), {"frame": true}, T_world_hand) | {"frame": np.array(declared)}
    data = {k: v for k, v in data.items() if k not in ("q", "time_s", "length")}
    rows, zeros = torch.arange(6), torch.zeros(6, dtype=torch.int32)
    found = load_answers(as_file(tmp_path / "p.npz", data))
    trials = Trials(found.predictions.trial_id, zeros, zeros, T_world_hand)
    words = rf"p: frame is {declared}, and the median gripper .* with {true} it is 0"
    if declared == "world":  # as files mean that say nothing: they are judged
        assert re.match(words, check_frame(found, rows, trials, "p"))
    else:
        with pytest.raises(FileError, match=words):
            check_frame(found, rows, trials, "p")
    data["frame"] = np.array(true)
    assert check_frame(load_answers(as_file(tmp_path / "q.npz", data)), rows, trials, "q") is None


def test_poses_in_the_hands_frame_need_their_trials(tmp_path):
    refused(as_file(tmp_path / "p.npz", in_another(poses(), {"frame": "hand"}, hands(6))), "declares frame=hand; sweep")
