"""Whoever rebuilds r2h-v3 finds each number of it on the pages: read here from the code."""

import re
from pathlib import Path

import pytest
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.config import PRESENTED_M
from r2h_batch.judge import reception, straight_way
from r2h_batch.judge.grasp import CUT_CAP_M
from r2h_batch.judge.least import TOLERANCE_M
from r2h_batch.kernels.judge import reception as arm
from r2h_batch.observe.rays import FAR_M
from r2h_batch.observe.rig import load_rig
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.trials.holding import capacity, held_out
from r2h_batch.verdicts import IN_ORDER, criteria_of

DOCS = Path(__file__).resolve().parents[1] / "docs"


def text_of(page: str) -> str:
    return " ".join((DOCS / page).read_text().split())


def n(x: float, scale: float = 1.0) -> str:
    """A number as pages write it: in mm, cm or degrees."""
    return f"{float(x) * scale:.6g}"


def numbers() -> dict[str, list[str]]:
    """Page -> the words that it must have, with the code's numbers in them."""
    v3, limits = load_benchmark("r2h-v3"), load_benchmark("r2h-v3").thresholds
    swivels = float(arm.SWIVEL_LOW), float(arm.SWIVEL_LOW + arm.SWIVEL_STEP * (arm.SWIVELS - 1))
    spaced = [n(straight_way.WAY_M / k, 1e3) for k in straight_way.STEPS]
    asked = {entry.name for entry in criteria_of(v3.asks)}
    order = ", ".join(entry.name.capitalize() for entry in IN_ORDER if entry.name in asked)
    leans = [n(x) for x in reception.LEANS_DEG]
    sensor = load_rig("cell-v1").sensor
    return {
        "r2h_v3.md": [
            v3.digest,
            f"**{order}**",
            f"keep {n(v3.head_clearance_m, 1e2)} cm from the head",
            f"from {n(straight_way.WAY_M, 1e2)} cm before the grasp, and lifts the object straight up by "
            f"{n(straight_way.WAY_M, 1e2)} cm",
            f"every {spaced[0]} mm along a straight way",
            f"tried with waypoints every {spaced[1]} mm, then every {spaced[2]} mm",
            f"turn by more than {n(straight_way.MOST_TURN_RAD)} rad between two waypoints",
            f"more than {n(straight_way.MOST_OFF_M, 1e3)} mm off the line. This distance is that of the TCP",
            "nearest to home (sum of the squared differences of the joints)",
            "the smallest margin of all stages, including Stability",
            f"at most {n(CUT_CAP_M, 1e2)} cm",
            "all links of the arm, from base to wrist 3",
            f"certain to {n(TOLERANCE_M, 1e3)} mm",
            f"(`pad_squeeze_m`, {n(limits.pad_squeeze_m, 1e3)} mm)",
            f"{held_out.PER_SIDE} *held-out grasps* are tried",
            f"bent by at most {n(arm.ELBOW_DEG)} degrees; forearm turned by at most {n(arm.TURN_DEG)} either way",
            f"wrist {n(arm.FLEXION_DEG)} down and {n(arm.EXTENSION_DEG)} up, {n(arm.ULNAR_DEG)} to the little finger and "
            f"{n(arm.RADIAL_DEG)} to the thumb",
            f"{int(arm.FOREARM_POINTS)} points along the forearm",
            f"{', '.join(leans[:-1])} or {leans[-1]} degrees about the middle of the box's lower face",
            f"{int(arm.SWIVELS)} steps of {int(arm.SWIVEL_STEP)} degrees, from {n(-swivels[0])} inwards of hanging to "
            f"{n(swivels[1])} outwards",
            f"shoulder flexion / {n(arm.SHOULDER_FLEXION_DEG)} (extension / {n(arm.SHOULDER_EXTENSION_DEG)}), abduction / "
            f"{n(arm.SHOULDER_ABDUCTION_DEG)} (adduction / {n(arm.SHOULDER_ADDUCTION_DEG)})",
            f"more than {n(reception.ROOM_M, 1e3)} mm from the closed gripper",
            f"straight to {n(arm.WAY_M, 1e2)} cm before the grasp",
            f"{reception.WAYS_TRIED} easiest grasps",
            f"more than {n(arm.TOUCH_M, 1e3)} mm from the robot",
            f"of the palm, {n(arm.PALM_M, 1e2)} cm from the wrist",
            f"at most {n(arm.FAR_M, 1e2)} cm: at the grasp less the required {n(arm.TOUCH_M, 1e3)} mm, on the way as it is",
            f"Along the way `hand` and `body` are certain to {n(reception.MARGIN_TOLERANCE_M, 1e3)} mm or to a tenth",
            f"pulls with {n(reception.PULL_N)} N",
            f"{n(reception.LIFT)} upwards for each unit along",
            f"at most {n(reception.GRIP_N)} N",
            f"at least {n(capacity.GRIP_BASE_N)} N plus {n(capacity.GRIP_PER_WEIGHT)} times the load's size, at most "
            f"{n(2 * reception.GRIP_N)} N for both sides",
            f"friction {n(held_out.FRICTION)}",
            f"{n(capacity.AXES_SHARE)} of these values counts",
            "every second grasp is turned about the object's axis",
        ],
        "observe.md": [
            f"nothing within {n(FAR_M)} m along the ray",
            f"a step of {n(sensor.edge_m, 1e3)} mm",
            "nothing outside the window counts",
        ],
        "choices.md": [n(1e2 * PRESENTED_M["S0"]), n(1e2 * PRESENTED_M["S1"]), unchecked()],
        "run_folder.md": ["`grasp` is its number", "`grasp_shift_m`"],
    }


def unchecked() -> str:
    """The pairs of the UR5e's links that nobody checks against each other, as the page names them."""
    robot = load_robot()
    links = [name.replace("_", " ") for name in robot.links]
    seen = {tuple(sorted(pair)) for pair in robot.self_pairs.tolist()}
    left = {(a, b) for a in range(len(links)) for b in range(a + 1, len(links))} - seen
    end = range(links.index("wrist 1"), len(links))
    by_rule = {(a, b) for a, b in left if b == a + 1} | {(a, b) for a in end for b in end if a < b}
    assert by_rule <= left
    named = ", ".join(f"{links[a]} and {links[b]}" for a, b in sorted(left - by_rule))
    return f"Of the UR5e these are {named}, each link and the next one, and all pairs of wrists and gripper"


@pytest.mark.parametrize("page", ["r2h_v3.md", "observe.md", "choices.md", "run_folder.md"])
def test_the_numbers_that_a_rebuild_needs_are_on_the_page(page):
    text = text_of(page)
    for words in each(numbers()[page]):
        assert re.search(rf"(?<![\d.]){re.escape(words)}(?![\d])", text), words
