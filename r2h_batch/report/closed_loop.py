"""Handovers in closed loop as tables: how episodes ended, beside the verdict of the plan, and how they went."""

from collections.abc import Callable
from typing import Any

import numpy as np

from r2h_batch.base.table import PERCENT, RATE, Column, Table, document, notes_list, plain
from r2h_batch.report.text import hits_fields, short_names
from r2h_batch.runs.store import Run

__all__ = ["render"]

NOTES = (
    "Ends in percent of all trials; a trial without an answer counts as a failure. SR: the verdict of the plan, hand at rest"
    " (Table I); brackets: 95 %, Wilson. Contact by robot, by hand: who brought them together.",
    "Least: median of the least distance at the steps; between steps it is less by `slack` at most (mean; certified). Near"
    " speed: median of the largest speed within 25 cm, of the arm's fastest point, from above; PFL: largest share of ISO/TS"
    " 15066's transient limit for a hand (from memory). SSM: time nearer than its protective distance, while the robot"
    " moves, 25 cm at most.",
    "Idle, both move, delay (neither moves): shares of an episode, means (Hoffman 2019). Time: median handover time of"
    " successes.",
)
OWN_POLICY = (
    "The policy is the author's own code, not a built-in one. It runs in the process of the environment and may know what"
    " no observation holds; `results reevaluate` does not play it again."
)
SHOWN = ("contact", "collision", "drop", "not_received", "timeout")


def render(run: Run, *, brief: bool = False) -> str:
    """Tables of all methods of a run that holds episodes, as text that ends in a newline.

    Args:
        run: what `load_run` gives.
        brief: how episodes ended, and nothing else.
    """
    short = short_names(run.methods)
    records = []
    for name in run.methods:
        episodes = run.episodes(name)
        rows = {k: episodes[k].to_numpy(zero_copy_only=False) for k in episodes.column_names}
        verdicts = run.trials(name, ["outcome"])["outcome"].to_numpy(zero_copy_only=False)
        touched = rows["end"] == "contact"
        by_robot = touched & (rows["robot_touched"] == True)  # noqa: E712 - null where nothing touched
        won = rows["end"] == "success"
        hits = {"sr": verdicts == "success", "success": won, "by_robot": by_robot}
        hits |= {"by_hand": touched & ~by_robot} | {end: rows["end"] == end for end in SHOWN[1:]}
        record: dict[str, Any] = {"method": short[name], "n": len(verdicts)}
        for key, own in hits.items():
            record |= hits_fields(key, own)
        records.append(record | _numbers(rows, won))
    digests: Any = run.header["digests"]
    loop = str(digests.get("closed_loop", "unknown"))
    own = ":" in loop.partition("; ")[0]  # module:function, as no built-in policy is called
    played = "closed loop (own policy)" if own else "closed loop"
    method, none = Column("method", "Method", left=True), "-"
    ends = [
        *(method, Column("n"), Column("sr", "SR", RATE, none=none)),
        Column("success", played, RATE, none=none),
        Column("by_robot", "contact by robot", PERCENT, none=none),
        Column("by_hand", "by hand", PERCENT, none=none),
        *(Column(end, end.replace("_", " "), PERCENT, none=none) for end in SHOWN[1:]),
    ]
    notes = (OWN_POLICY, *NOTES) if own else NOTES
    loop = f"Closed loop: {plain(loop)}"
    if brief:
        return document([loop, Table(ends, records)])
    return document([loop, Table(ends, records), Table([method, *HOW], records), notes_list(notes)])


HOW = (
    Column("time_s", "time, s", PERCENT, none="-"),
    Column("least_m", "least, cm", PERCENT, scale=100, none="-"),
    Column("slack_m", "slack, cm", PERCENT, scale=100, none="-"),
    Column("near_speed_m_s", "near speed, cm/s", PERCENT, scale=100, none="-"),
    Column("pfl_share", "PFL", "{value:.2f}", none="-"),
    Column("ssm_s", "SSM, s", PERCENT, none="-"),
    *(
        Column(name, heading, "{value:.2f}", none="-")
        for name, heading in {
            "robot_idle": "robot idle", "human_idle": "human idle", "concurrent": "both move", "delay": "delay",
        }.items()
    ),
)  # fmt: skip
"""How episodes went."""


def _numbers(rows: dict[str, np.ndarray], won: np.ndarray) -> dict[str, float]:
    """The values of `HOW`; none without an episode that began."""
    lived = rows["time_s"] > 0
    if not lived.any():
        return {}
    over: dict[str, Callable[[np.ndarray], Any]] = {
        **{"least_m": np.median, "slack_m": np.mean, "near_speed_m_s": np.median},
        **{"pfl_share": np.max, "ssm_s": np.mean},
        **dict.fromkeys(("robot_idle", "human_idle", "concurrent", "delay"), np.mean),
    }
    found = {name: float(mean(rows[name][lived])) for name, mean in over.items()}
    return found | ({"time_s": float(np.median(rows["time_s"][won]))} if won.any() else {})
