"""Messages about files that a command cannot take: what was given, what is allowed, what to do."""

from dataclasses import replace

import numpy as np
import pytest

from r2h_batch import load_benchmark
from r2h_batch.base.errors import FileError, nearest
from r2h_batch.config import EvalConfig, Workplace
from r2h_batch.scene.hand_file import read_hand_set


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
        replace(load_benchmark(protocol), workplace=everywhere.workplace, thresholds=everywhere.thresholds).trials(
            40, splits=("S0",)
        )


def test_the_only_word_that_begins_as_the_given_one_is_the_nearest():
    names = ["r2h-v1", "r2h-v2", "r2h-v3-draft"]
    assert nearest("r2h-v3", names) == ", did you mean r2h-v3-draft?"
    assert nearest("r2h-v", names) == ", did you mean r2h-v2?"  # several begin so: the nearest letters
    assert nearest("zzzz", names) == ""
