"""What is said to somebody whose file is not what a command takes: what was given, what is allowed, what to do."""

import json
import re

import numpy as np
import pytest

from r2h_batch.__main__ import main
from r2h_batch.bodies.hand_file import read_hand_set
from r2h_batch.config import EvalConfig, Workplace
from r2h_batch.io.read import FileError
from r2h_batch.trials.protocol import make_trials

POSE = [np.eye(4).tolist()]
ONE = {"trial_id": [0], "T_obj_ee": POSE, "T_world_ee": POSE}

BENCHMARK, PREDICTIONS = "benchmark check b.yaml", "sweep --trials 1 --out run --predictions p"
SAID = {
    "no pickle": (b"hello world", "import hand --out h.npz --mano-right hand.pkl", r"no pickle \(it begins with b'hello w"),
    "empty YAML": (b"", BENCHMARK, "must hold fields, one `name: value` a line; it is empty"),
    "a config for a benchmark": (b"trials: 500", BENCHMARK, "trials is 500; it must be text: trials of your own"),
    "centimetres": (b"thresholds: {reach_radius_m: 8}", BENCHMARK, "reach_radius_m is 8; it must be 0.001 to 2 metres"),
    "two numbers": (b"table: {half: [1, 2]}", BENCHMARK, "table.half is .*; it must have 3 entries or more, it has 2"),
    "JSON in UTF-16": (b"\xff\xfe{\0}\0", f"{PREDICTIONS}.json", "is in UTF-16; save it in UTF-8"),
    "a long number": (b'{"trial_id": [%s]}' % (b"9" * 5000), f"{PREDICTIONS}.json", "no readable JSON .number out of range"),
    "one id": (json.dumps(ONE).encode(), f"{PREDICTIONS}.json", "1 trial id is planned but missing: 1;"),
}  # fmt: skip


@pytest.mark.parametrize("case", SAID)
def test_a_file_that_is_something_else_is_told_what_it_is_and_what_is_allowed(case, tmp_path, monkeypatch, capsys):
    data, line, words = SAID[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / line.split()[-1]).write_bytes(data)
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert re.search(words, error) and error.count("\n") == 1, error
    assert "NoneType" not in error and "input should" not in error and "int_max_str" not in error


def hands(**changes):
    return {
        "pose": np.zeros((3, 48)), "shape": np.zeros((3, 10)), "side": np.array([0, 0, 1]), "posture": np.array(list("abc")),
        **changes,
    }  # fmt: skip


def turned(row, joint, radians):
    pose = np.zeros((3, 48))
    pose[row, 3 * joint] = radians
    return pose


HANDS = {
    "degrees": (
        hands(pose=turned(1, 5, 45.0)),
        "pose of hand 1 turns joint 5 by 45 rad; .* If these are degrees, multiply",
    ),
    "another shape": (hands(pose=np.zeros((3, 45))), r"pose is \(3, 45\) float64; need H x 48 floats"),
}


@pytest.mark.parametrize("case", HANDS)
def test_a_hand_set_in_degrees_or_of_another_type_is_refused_by_what_is_wrong(case, tmp_path):
    arrays, words = HANDS[case]
    np.savez(tmp_path / "h.npz", **arrays)
    with pytest.raises(FileError, match=f"h.npz: {words}"):
        read_hand_set(tmp_path / "h.npz")
    np.savez(tmp_path / "h.npz", **hands(pose=turned(1, 5, 6.28)))  # odd, and still a turn
    assert read_hand_set(tmp_path / "h.npz")["pose"][1, 15] == 6.28


@pytest.mark.parametrize("protocol", ["r2h-v0", "r2h-v1"])
def test_a_table_that_leaves_no_place_for_a_hand_is_told_in_seconds(protocol):
    everywhere = EvalConfig(workplace=Workplace(table_center=(0.6, 0.0, 0.3), table_half=(5.0, 5.0, 5.0)))
    with pytest.raises(
        ValueError, match=r"no place for a hand where r2h-v\d draws them: .*Table \(center \(0.6, 0.0, 0.3\)"
    ):
        make_trials(("S0",), 40, config=everywhere, protocol=protocol)
