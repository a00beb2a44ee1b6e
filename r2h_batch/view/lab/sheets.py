"""Sheets of paper in true size: where the hand is, and how the object sits between the pads."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.write import atomic_path
from r2h_batch.report.figures import needs_matplotlib, style
from r2h_batch.scene.hand import load_hand_set, palm_frame
from r2h_batch.scene.robot import gripper_primitives_at
from r2h_batch.view.stored_trial import StoredTrial

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

PAPER_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "A1": (594.0, 841.0)}
MARGIN_MM, WORDS_MM = 12.0, 46.0
"""Left free at the edges by most printers; height for the words at the bottom."""
MM_PER_INCH = 25.4
GRID_M = 0.05
"""The cross stands at whole steps of this in the base's frame, so that a tape measure finds it."""
RULER_M = 0.1


class Drawn(NamedTuple):
    """The drawing of one sheet, in metres.

    Attributes:
        shapes: (points (N, 2), faces (F, 3), colour) each; a shape is the shadow of a mesh.
        words: lines below the drawing.
        across, up: names of the axes.
    """

    shapes: tuple[tuple[Array, NDArray[np.int64], str], ...]
    words: tuple[str, ...]
    across: str
    up: str
    cross: tuple[float, float] | None = None
    ball: tuple[float, float, float] | None = None
    arrow: tuple[tuple[float, float], tuple[float, float]] | None = None
    pads: tuple[tuple[float, float], tuple[float, float]] | None = None
    """middle and half sides of a pad's face"""


def hand_sheet(stored: StoredTrial) -> Drawn:
    """The hand from above in the world's frame, with a cross at round coordinates, and its heights above the table."""
    hands, k = stored.hand_set or load_hand_set(), stored.row["hand_index"]
    R, p = stored.T_world_hand[:3, :3], stored.T_world_hand[:3, 3]
    rows = torch.tensor([k], dtype=torch.int64, device="cpu")
    skin = hands.geometry.vertices[rows][0].double().numpy() @ R.T + p
    own = palm_frame(hands.geometry.joints[rows], hands.side[rows])
    palm, normal = (x[0].double().numpy() for x in own)
    palm, normal = R @ palm + p, R @ normal
    limits = stored.header["configuration"]["thresholds"]
    ball = palm + limits["reach_offset_m"] * normal
    place = stored.workplace
    table = place.table_center[2] + place.table_half[2]
    cross = (np.round(skin[:, :2].mean(0) / GRID_M) * GRID_M).tolist()
    tilt = np.degrees(np.arcsin(np.clip(normal[2], -1, 1)))
    words = (
        f"Cross: {1000 * cross[0]:.0f} mm along x and {1000 * cross[1]:.0f} mm along y of base_link (ROS 2);"
        f" {-1000 * cross[0]:.0f} and {-1000 * cross[1]:.0f} mm on a UR's pendant.",
        f"Above the table: lowest point {_mm(skin[:, 2].min() - table)}, middle of the palm {_mm(palm[2] - table)},"
        f" highest {_mm(skin[:, 2].max() - table)}; ball's centre {_mm(ball[2] - table)}.",
        f"Palm ({'left' if stored.row['side'] == 'left' else 'right'} hand) looks along the arrow,"
        f" {abs(tilt):.0f} degrees {'up' if tilt > 0 else 'down'}. Dashed: the ball that the object must touch (Reach).",
    )
    faces = np.asarray(hands.model.faces_by_side[int(hands.side[k])], np.int64)
    return Drawn(
        ((skin[:, :2], faces, "#d8a27a"),),
        words,
        "x of base_link",
        "y",
        (cross[0], cross[1]),
        (float(ball[0]), float(ball[1]), float(limits["reach_radius_m"])),
        ((float(palm[0]), float(palm[1])), (float(normal[0]), float(normal[1]))),
    )


def grasp_sheet(stored: StoredTrial) -> Drawn:
    """The object between the pads as somebody sees it who looks along the closing axis, and the pads on it."""
    model, T = stored.object_model, np.linalg.inv(stored.T_obj_ee_attached)
    points, com = (x @ T[:3, :3].T + T[:3, 3] for x in (model.vertices, model.com))
    robot, gap_m = stored.robot, stored.row["opening_m"]
    at = robot.gripper_part.index("pad")
    half, middle = robot.gripper.size[at], gripper_primitives_at(robot, gap_m)[at][:3, 3]
    words = (
        f"{model.name}, {1000 * model.mass:.0f} g. The fingers come from below on this sheet; the rectangle is their pads.",
        f"Gap of the pads when they hold: {1000 * gap_m:.1f} mm; open before: {1000 * robot.open_gap_m:.1f} mm.",
        f"TCP: the cross. Centre of mass: {1000 * com[0]:+.0f} mm along x, {1000 * com[2]:+.0f} mm along z from it.",
    )
    shadow = np.asarray(model.faces, np.int64)
    return Drawn(
        ((points[:, [0, 2]], shadow, "#9fb8c8"),),
        words,
        "x of the gripper",
        "z, away from the flange",
        (0.0, 0.0),
        pads=((float(middle[0]), float(middle[2])), (float(half[0]), float(half[2]))),
    )


def object_sheet(leg: StoredTrial) -> Drawn:
    """The object from above as it rests on the table in the world's frame, with a cross at round coordinates.

    Args:
        leg: of a trial that begins on the table, the one to the grasp.
    """
    assert leg.resting is not None
    R, p = leg.resting[:3, :3], leg.resting[:3, 3]
    points = leg.object_model.vertices @ R.T + p
    place = leg.workplace
    table = place.table_center[2] + place.table_half[2]
    cross = (np.round(points[:, :2].mean(0) / GRID_M) * GRID_M).tolist()
    words = (
        f"Cross: {1000 * cross[0]:.0f} mm along x and {1000 * cross[1]:.0f} mm along y of base_link (ROS 2);"
        f" {-1000 * cross[0]:.0f} and {-1000 * cross[1]:.0f} mm on a UR's pendant.",
        f"{leg.object_model.name} rests on its outline; its highest point is {_mm(points[:, 2].max() - table)} above the table.",
    )
    faces = np.asarray(leg.object_model.faces, np.int64)
    shadow = ((points[:, :2], faces, "#9fb8c8"),)
    return Drawn(shadow, words, "x of base_link", "y", (cross[0], cross[1]))


def _mm(metres: float) -> str:
    return f"{1000 * metres:.0f} mm"


def write_sheet(drawn: Drawn, title: str, path: Path) -> str:
    """Write the sheet as a PDF of the smallest paper that holds it in true size.

    Returns:
        The paper's name.

    Raises:
        UsageError: no paper is large enough, or matplotlib is missing.
    """
    try:
        needs_matplotlib()
    except ValueError as error:
        raise UsageError(str(error)) from None
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    every = [points for points, _, _ in drawn.shapes]
    if drawn.ball is not None:  # its rim may lie beyond the paper
        every.append(np.array([drawn.ball[:2]]))
    if drawn.pads is not None:
        middle, half = map(np.array, drawn.pads)
        every.append(np.array([middle - half, middle + half]))
    corners = np.concatenate(every)
    low, high = corners.min(0), corners.max(0)
    paper, (width, height) = _paper(1000 * (high - low), title)
    room = np.array([width - 2 * MARGIN_MM, height - 2 * MARGIN_MM - WORDS_MM])
    with style(page=False):
        figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
        axes = figure.add_axes(
            (MARGIN_MM / width, (MARGIN_MM + WORDS_MM) / height, room[0] / width, room[1] / height)
        )
        middle, half = (low + high) / 2, room / 2000
        axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
        axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(drawn.across)
        axes.set_ylabel(drawn.up)
        for points, faces, color in drawn.shapes:
            axes.add_collection(
                PolyCollection(
                    list(points[faces]), facecolors=color, edgecolors=color, linewidths=0.2
                )
            )
        _marks(axes, drawn)
        lines = [
            title,
            *drawn.words,
            "Print at 100 %, not fitted to the page. The ruler is 100 mm long.",
        ]
        for k, line in enumerate(lines):
            y = (MARGIN_MM + WORDS_MM - 12 - 6 * k) / height
            figure.text(
                MARGIN_MM / width,
                y,
                line,
                size=10 if k == 0 else 7.5,
                weight="bold" if k == 0 else "normal",
            )
        corner = middle - half + 0.006
        axes.plot(
            [corner[0], corner[0] + RULER_M],
            [corner[1]] * 2,
            color="black",
            lw=1.5,
            solid_capstyle="butt",
        )
        for k in range(11):
            x = corner[0] + RULER_M * k / 10
            axes.plot(
                [x, x], [corner[1], corner[1] + (0.004 if k % 5 else 0.007)], color="black", lw=0.6
            )
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="pdf", metadata={"CreationDate": None})
    return paper


def _paper(size_mm: Array, title: str) -> tuple[str, tuple[float, float]]:
    for name, (short, long) in PAPER_MM.items():
        for width, height in ((short, long), (long, short)):
            if (
                size_mm[0] <= width - 2 * MARGIN_MM
                and size_mm[1] <= height - 2 * MARGIN_MM - WORDS_MM
            ):
                return name, (width, height)
    sides = " x ".join(f"{x:.0f}" for x in size_mm)
    raise UsageError(
        f"{title}: {sides} mm fit on no paper up to {list(PAPER_MM)[-1]}; leave the trial out"
    )


def _marks(axes: "Axes", drawn: Drawn) -> None:
    from matplotlib.patches import Circle, Rectangle

    if drawn.pads is not None:
        (x, y), (across, up) = drawn.pads
        corner = (x - across, y - up)
        pad = Rectangle(corner, 2 * across, 2 * up, fill=False, ec="#d55e00", lw=1.5)
        axes.add_patch(pad)
    if drawn.ball is not None:
        *c, r = drawn.ball
        axes.add_patch(Circle((c[0], c[1]), r, fill=False, ec="#009e73", ls="--", lw=1.0))
    if drawn.arrow is not None:
        start, along = drawn.arrow
        end = (start[0] + 0.08 * along[0], start[1] + 0.08 * along[1])
        axes.annotate(
            "", end, start, arrowprops={"arrowstyle": "->", "color": "#009e73", "lw": 1.5}
        )
    if drawn.cross is not None:
        x, y = drawn.cross
        axes.plot([x - 0.02, x + 0.02], [y, y], color="black", lw=0.8)
        axes.plot([x, x], [y - 0.02, y + 0.02], color="black", lw=0.8)
