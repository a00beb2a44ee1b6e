"""Files of hand sets: what is refused."""

import numpy as np
import pytest

from r2h_batch.base.errors import FileError
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
