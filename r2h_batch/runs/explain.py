"""Why a trial passed or failed, in words: from its stored row, without judging it again."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from r2h_batch.config import PRESENTED_M
from r2h_batch.verdicts import ELSEWHERE, EVERY, NO_LONGER, UNITS, Unit

REASONS = {
    "start_in_collision": "the arm collides where its path begins",
    "ik_unreachable": "the arm cannot reach the target",
    "ik_in_collision": "every posture at the target collides",
    "no_path_in_budget": "no path was found in time",
    "not_settled": "the arm did not come to rest",
    "motion_in_collision": "the motion collides",
    "beyond_joint_limits": "a joint goes beyond its limit",
    "beyond_speed_limits": "a joint turns faster than it can",
    "ik_not_found": "no posture was found at the target",
    "no_free_posture_found": "every posture found at the target collides",
}
"""Plan's reasons in words."""
RECEIVES = {
    "arm": "no grasp is within the person's joints",
    "free": "the hand would meet the closed gripper",
    "way": "the hand's last 10 cm are blocked",
    "clear": "the arm, the torso or the head would meet the robot, or the head the object",
    "release": "the fingers could not open, or not back off",
    "hold": "the hand could not carry it",
    "whole_way": "the hand's way from where it waits is blocked",
    "no_grasp": "no grasp of this hand is known",
}
"""Why nobody can take the object, in words: what the last of the receiving grasps fails."""
LEFT_OUT = ("way", "release", "whole_way")
"""Of these the margin is the part of a way that is left."""
ROOMS = {
    "hand": "between hand and gripper",
    "body": "between the person's body and the robot, or the head and the object",
    "reach": "of the arm's reach",
    "joints": "of the joints' ranges",
}
"""What Received's margin is of (`Room`), in words."""
PICKS = {
    "out_of_reach": "the arm cannot reach the grasp where the object rests",
    "grasp_collides": "the open gripper meets something at the grasp",
    "no_straight_way": "no posture follows the straight ways in and up",
    "approach_collides": "something is in the way to the grasp",
    "nothing_between_pads": "nothing lies between the pads",
    "not_held": "the gripper does not hold it",
    "closing_collides": "the closing fingers meet something",
    "lift_collides": "something is in the way up",
    "start_in_collision": "the arm collides at home",
    "before_collides": "every posture before the grasp meets the object",
    "no_path_in_budget": "no path to the object was found in time",
    "path_collides": "the path to the object, planned in what was seen, meets something",
}
"""Pick's reasons in words."""
PAIRS = {
    "hand": "robot and hand", "table": "robot and table", "self": "robot and robot",
    "object_hand": "object and hand", "object_table": "object and table", "object_robot": "object and robot",
}  # fmt: skip
"""Pairs of bodies (`CollidingPair`) in words."""
PERSON = "the person"
MET = {
    "hand": PERSON, "table": "the table", "self": "the robot itself", "object_hand": PERSON,
    "object_table": "the table", "object_robot": "the robot",
}  # fmt: skip
"""The second body of a pair: what Pick's reasons call something."""
SHORT = ("ik_unreachable", "ik_not_found")
"""Reasons of Plan whose margin is how far the gripper stays from its target."""
CALIBRATION_M = 0.002
"""By so much a camera of cell-v1 stands elsewhere than is believed, each way (`observe.rig`). A pick with less room may touch."""
LEAST = 0.05
"""Smaller margins are not printed as a number (mm, deg)."""
REASON_COLUMNS = ("outcome", "plan_reason", "pick_reason", "received_reason", "width_m")
"""Columns that say why a row failed."""
ENTRIES = {entry.name: entry for entry in EVERY}
"""Name of a criterion -> what the registry says of it."""


def body_name(part: str) -> str:
    """A part of the robot in words, without the number of its collision body: wrist_3_0: wrist 3."""
    return re.sub(r"_\d+$", "", part).replace("_", " ")


def meets_person(head_m: float) -> str:
    """What a part of the robot does where the person's hand is not meant, with `--receiver body`; `head_m`: what it has to keep
    from the head, m."""
    if not head_m:
        return "meets the receiver's arm, torso or head"
    return f"meets the receiver's arm or torso, or is within {100 * head_m:g} cm of the head"


def short_by(row: Mapping[str, Any], criterion: str) -> tuple[float | None, Unit]:
    """By how much a criterion fails, above 0, as people read it (mm, deg), and the unit; None where no number says it."""
    entry = ENTRIES[criterion]
    size, unit = row.get(entry.margin_column), UNITS[entry.unit]
    known = size is not None and math.isfinite(size)
    return (-unit.scale * float(size) if known else None), unit  # type: ignore[arg-type]


def headline(row: Mapping[str, Any], pair: str | None = None, head_m: float = 0.0) -> str:
    """The verdict in one line: success, or the criterion that fails first, why, and by how much.

    Args:
        row: of trials, with or without its details.
        pair: the pair of bodies that Plan's margin is about, of `PAIRS` or in words, where that was computed; a row alone does
            not say it.
        head_m: what robot and object have to keep from the head, m.
    """
    outcome, said = str(row["outcome"]), reason_of(row)
    if outcome == "success":
        return said if row.get("t_exec_s") is None else f"{said}, {row['t_exec_s']:.1f} s"
    if outcome not in ENTRIES:
        return said
    size, unit = short_by(row, outcome)
    least = "at least " if row.get(f"margin_kind_{outcome}") == "bound" else ""
    by = "" if size is None or size < LEAST else f"{least}{size:.1f} {unit.shown}"
    words = f"{outcome} fails: "
    if outcome == "plan":
        met = f" ({PAIRS.get(pair, pair)})" if pair and row.get("plan_pair") else ""
        short = f": {by} short" if by and str(row["plan_reason"]) in SHORT else ""
        return f"{said}{met}{short}"
    if outcome == "pick":
        return f"{words}{_pick_why(row, head_m)}{f', by {by}' if by else ''}".rstrip(" :,")
    if outcome == "received":
        left = str(row.get("received_reason")) in LEFT_OUT
        return said + ((f": {by} are left" if left else f", by {by}") if by else "")
    if outcome == "presented" and (nearer := presented_words(row)):
        return f"{words}{nearer}"
    if outcome == "safe" and row.get("witness_safe_part") and row.get("witness_time_s") is not None:
        part = body_name(str(row["witness_safe_part"]))
        if not row.get("witness_point_m"):  # a point is known of the hand alone
            return f"{words}{part} {meets_person(head_m)}"
        return f"{words}{part} meets the hand at {row['witness_time_s']:.1f} s"
    if outcome == "stability" and row.get("width_m") is not None:
        fails = ENTRIES[outcome].fails
        said = f"{words}{1e3 * row['width_m']:.1f} mm of material between the pads, {fails}"
        return f"{said}, by {by}" if by else said
    return f"{said}, by {by}" if by and ENTRIES[outcome].fails else said


def reason_of(row: Mapping[str, Any]) -> str:
    """The verdict in words that all rows of one reason share: without numbers and without the bodies of a row.

    Args:
        row: of trials; `REASON_COLUMNS` are read.
    """
    outcome = str(row["outcome"])
    if outcome in NO_LONGER:
        return f"{outcome} fails: r2h_batch 0.3 judged by it, this version does not"
    if outcome == ELSEWHERE:
        return "fails a criterion whose package is not installed here"
    if outcome not in ENTRIES:
        return outcome.replace("_", " ")
    if outcome == "plan":
        reason = str(row["plan_reason"])
        words = REASONS.get(reason, reason.replace("_", " "))
    elif outcome == "pick":
        words = PICKS.get(str(row.get("pick_reason")), "")
    elif outcome == "received":
        words = RECEIVES.get(str(row.get("received_reason")), "")
    elif outcome == "stability" and row.get("width_m") is None:
        words = "nothing lies between the pads"
    else:
        words = ENTRIES[outcome].fails
    return f"{outcome} fails: {words}".rstrip(" :")


NEARER = {"gripper": "the gripper", "sharp": "a sharp part"}
"""What comes to the palm beside the wanted part (`Nearer`), in words."""


def wanted_words(row: Mapping[str, Any]) -> str:
    """What the receiver wants, in words."""
    return "the receiver's part" if row.get("split") == "S1" else "the object"


def presented_words(row: Mapping[str, Any]) -> str:
    """What Presented's margin is about, in words, whether or not the benchmark asks for it; empty where the row does not say
    it."""
    margin, by, wanted = row.get("presented_margin_m"), row.get("presented_by"), wanted_words(row)
    if margin is None or by is None:
        return ""
    if by not in NEARER:
        return f"{wanted} is {100 * abs(margin):.1f} cm {'inside' if margin >= 0 else 'outside'} the ball in front of the palm"
    ahead = 100 * (PRESENTED_M[str(row["split"])] - margin)
    if ahead <= 0:
        return f"{wanted} is {-ahead:.1f} cm nearer to the palm than {NEARER[by]}"
    return f"{NEARER[by]} is {ahead:.1f} cm nearer to the palm than {wanted}"


def _pick_why(row: Mapping[str, Any], head_m: float) -> str:
    """Pick's reason in words, with the two bodies that its margin is about, each named once. What is kept from the head counts
    as the person, and no row says which it was."""
    why, pair = PICKS.get(str(row.get("pick_reason")), ""), str(row.get("pick_pair"))
    if "something" in why and pair in MET:
        of_object, part = pair.startswith("object_"), row.get("pick_part")
        own = "the object" if of_object else body_name(str(part)) if part else ""
        around = (
            f" or the {100 * head_m:g} cm around the head" if head_m and MET[pair] == PERSON else ""
        )
        return why.replace("something", MET[pair] + around) + (f" ({own})" if own else "")
    return f"{why} ({found})" if (found := _pick_pair(row)) else why


def _pick_pair(row: Mapping[str, Any]) -> str:
    """The two bodies that Pick's margin is about, in words; empty where there are none."""
    pair, part = row.get("pick_pair"), row.get("pick_part")
    if pair is None:
        return ""
    words = PAIRS.get(str(pair), str(pair).replace("_", " and "))
    return f"{words}, {body_name(str(part))}" if part else words


def _close_pick(row: Mapping[str, Any]) -> str:
    """Words for a pick that passes with less room than a camera's calibration errs by; empty of others."""
    room = row.get("margin_pick_m")
    if not row.get("passed_pick") or room is None or room >= CALIBRATION_M:
        return ""
    by = f" ({found})" if (found := _pick_pair(row)) else ""
    return f"the pick has {1e3 * room:.1f} mm of room{by}, less than the {1e3 * CALIBRATION_M:g} mm that a calibration may err by"


def _least_room(row: Mapping[str, Any]) -> str:
    """Words for what Received's margin is of; empty where nobody was asked to take the object."""
    if (by := row.get("received_by")) not in ROOMS:
        return ""
    return f"{1e3 * row['margin_received_m']:.1f} mm {ROOMS[str(by)]} is the least room where the person takes it"


@dataclass(frozen=True)
class Explanation:
    """Why one trial of one method passed or failed.

    Attributes:
        trial: the trial's number.
        method: the method's name.
        criterion: the one that failed first; empty where none did.
        margin: its margin, in `unit`, negative where it failed; None where no number says it.
        unit: of the margin: m or deg.
        bound: whether the margin is a bound: it fails by at least as much.
        why: the verdict in one line.
        witness: what decides it, in words; empty where the row does not say it.
        passes: what would have passed; empty of a success.
        picture: the command that shows it.
    """

    trial: int
    method: str
    criterion: str
    margin: float | None
    unit: str
    bound: bool
    why: str
    witness: str
    passes: str
    picture: str

    def __str__(self) -> str:
        margin = ""
        if self.margin is not None:
            unit = UNITS[self.unit]
            margin = (
                f"{unit.scale * self.margin:+.1f} {unit.shown}{' or less' if self.bound else ''}"
            )
        lines = {
            "why": self.why, "criterion": self.criterion, "margin": margin, "witness": self.witness,
            "would pass": self.passes, "picture": self.picture,
        }  # fmt: skip
        told = [f"  {name + ':':<12}{words}" for name, words in lines.items() if words]
        return "\n".join([f"trial {self.trial}, {self.method}", *told])


def explained(
    row: Mapping[str, Any], method: str, limits: Mapping[str, float], picture: str, *,
    pair: str | None = None, witness: str = "", head_m: float = 0.0,
) -> Explanation:  # fmt: skip
    """The explanation of a row.

    Args:
        row: of trials, with its details where they are stored.
        method: its name.
        limits: `thresholds` of the run's configuration, m; empty where a foreign run has none.
        picture: the command that shows the trial.
        pair: as of `headline`.
        witness: what decides it, where that was computed; else what the row says.
        head_m: as of `headline`.
    """
    outcome = str(row["outcome"])
    criterion = outcome if outcome in ENTRIES else ""
    size, unit = short_by(row, criterion) if criterion else (None, UNITS["m"])
    return Explanation(
        int(row["trial_id"]), method, criterion, None if size is None else -size / unit.scale,
        next(name for name, one in UNITS.items() if one is unit),
        row.get(f"margin_kind_{criterion}") == "bound", headline(row, pair, head_m),
        witness or _witness(row, criterion),
        _passes(row, criterion, limits) if criterion else "", picture,
    )  # fmt: skip


def _witness(row: Mapping[str, Any], criterion: str) -> str:
    """Words for the place where the criterion is decided, as far as the row knows it; of a success what is nearly none."""
    if not criterion:
        return "; ".join(words for words in (_close_pick(row), _least_room(row)) if words)
    if criterion == "stability" and row.get("width_m") is not None:
        return f"the material between the pads, {1e3 * row['width_m']:.1f} mm along the closing direction"
    if criterion == "safe" and row.get("witness_safe_part"):
        part, point = body_name(str(row["witness_safe_part"])), row.get("witness_point_m")
        if not point:
            return f"{part} and the receiver's arm, torso or head"
        at = f" at ({', '.join(f'{x:.3f}' for x in point)}) m in the world"
        return f"{part}, {row['witness_time_s']:.2f} s after the start{at}"
    if criterion == "plan" and (row.get("nearest_pair") or row.get("plan_pair")):
        near = row.get("nearest_pair")
        name = str(near or row["plan_pair"])
        link = row.get("witness_plan_part")
        words = PAIRS.get(name, name.replace("_", " and "))
        which = "" if near else ", of the first posture that was looked at"
        return f"{words}{f' ({body_name(str(link))})' if link else ''}{which}"
    if criterion == "pick":
        return _pick_pair(row)
    if criterion == "received":
        return "the receiving grasps of this object and hand"
    if criterion == "presented" and row.get("presented_by") in NEARER:
        allowed = 100 * PRESENTED_M[str(row["split"])]
        return f"{presented_words(row)}; up to {allowed:g} cm is allowed"
    if criterion == "presented":
        return presented_words(row)
    if criterion == "reach":
        return "the object's nearest point to the ball in front of the palm"
    return "the fingers and the receiver's part" if criterion == "affordance" else ""


def _passes(row: Mapping[str, Any], criterion: str, limits: Mapping[str, float]) -> str:
    """Words for the nearest thing that passes."""
    size, unit = short_by(row, criterion)
    least = "at least " if row.get(f"margin_kind_{criterion}") == "bound" else ""
    by = None if size is None else f"{least}{max(size, 0.1):.1f} {unit.shown}"
    if criterion == "stability":
        low, high = (limits.get(k) for k in ("w_min_m", "w_max_m"))
        room = "" if low is None or high is None else f"{1e3 * low:.1f} to {1e3 * high:.1f} mm of "
        return f"{room}material between the pads"
    if criterion == "plan":
        return _plan_passes(row, by)
    if criterion == "pick":
        return "a grasp that the table, the person and the arm leave room for"
    if criterion == "received":
        return "a handover pose that leaves the hand a grasp and a way to it"
    if by is None:
        return ""
    if criterion == "reach":
        radius = limits.get("reach_radius_m")
        ball = "" if radius is None else f" (radius {1e3 * radius:.0f} mm)"
        return f"the object {by} nearer to the ball's middle{ball}"
    if criterion == "presented":
        first = NEARER.get(str(row.get("presented_by")))
        if first is None:  # what is beside the palm is too near for the ball
            return f"{wanted_words(row)} {by} nearer to the ball's middle"
        return f"{wanted_words(row)} {by} nearer to the hand, or {first} farther away"
    if criterion == "affordance":
        return f"the fingers {by} farther from the receiver's part"
    if criterion == "safe":
        who = "the hand then" if row.get("witness_point_m") else "the receiver's arm, torso or head"
        return f"the robot {by} farther from {who}"
    return f"a margin larger by {by}"


def _plan_passes(row: Mapping[str, Any], by: str | None) -> str:
    """The same for each reason of Plan."""
    reason = str(row["plan_reason"])
    if reason in SHORT:
        return "a target that the arm reaches" + (f", {by} from this one" if by else "")
    if reason in ("ik_in_collision", "no_free_posture_found"):
        return "a target at which one posture overlaps nothing" + (
            f": the best one overlaps by {by}" if by else ""
        )
    if reason == "start_in_collision":
        return "a grasp with which robot and object are free where the path begins"
    if reason == "no_path_in_budget":
        return "a path to the target, which is free itself: another target, or a longer search (--plan.rounds)"
    return {
        "not_settled": "a motion that comes to rest at its goal",
        "motion_in_collision": "a motion that meets nothing" + (f": it is {by} in" if by else ""),
        "beyond_joint_limits": "joint angles within the limits",
        "beyond_speed_limits": "a slower motion",
    }.get(reason, "")
