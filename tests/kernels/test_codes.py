"""Numbers that have to stand twice, in kernels and on the host, are the same (the host imports the others)."""

from enum import IntEnum

import pytest

from r2h_batch.kernels.geometry import shape
from r2h_batch.kernels.plan import codes
from r2h_batch.kernels.robot import gripper
from r2h_batch.scene import bounds
from r2h_batch.scene.robot import MOTIONS
from r2h_batch.types import CollidingPair, PlanReason


def with_prefix(prefix: str) -> dict[str, int]:
    return {k.removeprefix(prefix): v for k, v in vars(codes).items() if k.startswith(prefix)}


@pytest.mark.parametrize(("prefix", "enum", "at_least"), [("REASON_", PlanReason, 5), ("PAIR_", CollidingPair, 4)])
def test_kernels_write_the_codes_of_the_enums(prefix: str, enum: type[IntEnum], at_least: int) -> None:
    found = with_prefix(prefix)
    found.pop("OF_OBJECT", None)
    assert len(found) >= at_least
    assert found == {name: int(enum[name]) for name in found}


def test_pairs_of_the_object_follow_those_of_the_robot() -> None:
    of_object = {p.name for p in CollidingPair if p > CollidingPair.SELF}
    assert of_object == {"OBJECT_HAND", "OBJECT_TABLE", "OBJECT_ROBOT"}
    for met, pair in (("HAND", "OBJECT_HAND"), ("TABLE", "OBJECT_TABLE"), ("SELF", "OBJECT_ROBOT")):
        assert CollidingPair[met] + codes.PAIR_OF_OBJECT == CollidingPair[pair]


def test_parts_of_a_gripper_move_by_the_same_numbers() -> None:
    names = [motion.upper() for motion in MOTIONS[: gripper.TABLE]]
    assert [getattr(gripper, name) for name in names] == list(range(gripper.TABLE))
    assert MOTIONS[gripper.TABLE :] == tuple(f"table_{k}" for k in range(len(MOTIONS) - gripper.TABLE))


def test_hulls_are_sorted_into_as_many_cells_and_cut_into_as_large_blocks_as_are_read() -> None:
    assert bounds.CELLS_PER_EDGE == shape.CELLS_PER_EDGE
    assert bounds.BLOCK_POINTS == shape.BLOCK_POINTS
