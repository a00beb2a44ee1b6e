"""The kernels of the stages, compiled before a first call: all that are missing at once, on all
cores."""

from functools import cache
from typing import Any

from r2h_batch.base.launch import load
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.kernels.grasp.region import primitives_clearance
from r2h_batch.kernels.grasp.width import close_gripper
from r2h_batch.kernels.ik.nearest import nearest_posture
from r2h_batch.kernels.ik.step import solve_ik_kernel
from r2h_batch.kernels.judge.goal import goal_clearance
from r2h_batch.kernels.judge.goal_distance import goal_safe_distance
from r2h_batch.kernels.judge.presented import present
from r2h_batch.kernels.judge.reach import point_to_object
from r2h_batch.kernels.judge.rows import usable_rows
from r2h_batch.kernels.judge.verdict import judge_criterion
from r2h_batch.kernels.robot.place import place_bodies
from r2h_batch.scene.scene import Scene

SIZED = (goal_clearance, place_bodies)
"""A kernel of each file that every call needs and that depends on the number of joints,"""

POSED = (goal_safe_distance,)
"""of each such file that calls without paths need beside them,"""

SHARED = (
    primitives_clearance,
    close_gripper,
    point_to_object,
    usable_rows,
    present,
    judge_criterion,
)
"""and of each that every call needs and that does not depend on it. The kernels of paths and of
arms without a closed form are imported where they are needed: Warp parses every file of kernels
that is imported."""


def planned() -> tuple[Any, ...]:
    """A kernel of each file that depends on the number of joints and that calls with paths need
    beside them."""
    from r2h_batch.kernels.judge.safe import safe_distance
    from r2h_batch.kernels.plan.lines import straight_lines

    return straight_lines, safe_distance


def compile_stages(scene: Scene, *, paths: bool) -> None:
    """Compiles, or loads, what the first call needs. What a stage needs only for some trials or
    options is compiled when it is launched.

    Args:
        scene: whose device and robot.
        paths: also what calls with paths need.
    """
    if scene.device == "cpu":  # on CUDA kernels of one file are compiled for different blocks
        _compile(len(scene.robot.joints), scene.robot.family == "ur", paths)


@cache
def _compile(joints: int, closed_form: bool, paths: bool) -> None:
    arm: tuple[Any, ...] = (solve_ik_kernel, nearest_posture)
    if not closed_form:
        from r2h_batch.kernels.ik.any_arm import solve_any

        arm = (of_joints(solve_any, joints),)
    # what takes longest is compiled first
    sized = (*(planned() if paths else POSED), *SIZED)
    load((*(of_joints(kernel, joints) for kernel in sized), *SHARED, *arm), "cpu")
