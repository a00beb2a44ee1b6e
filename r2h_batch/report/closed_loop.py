"""Handovers in closed loop as tables: how episodes ended, beside the verdict of the plan, and how they went."""

from typing import Any

import numpy as np

from r2h_batch.report.text import aligned, notes_list, percent_text, plain, rate_text, short_names
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


def render(run: Run) -> str:
    """Tables of all methods of a run that holds episodes, as text that ends in a newline."""
    short = short_names(run.methods)
    ends, went = [], []
    for name in run.methods:
        episodes = run.episodes(name)
        rows = {k: episodes[k].to_numpy(zero_copy_only=False) for k in episodes.column_names}
        verdicts = run.trials(name, ["outcome"])["outcome"].to_numpy(zero_copy_only=False)
        n, label = len(verdicts), plain(short[name])
        touched = rows["end"] == "contact"
        by_robot = touched & (rows["robot_touched"] == True)  # noqa: E712 - null where nothing touched
        won = rows["end"] == "success"
        shares = [percent_text(rows["end"] == end) for end in SHOWN[1:]]
        touches = [percent_text(by_robot), percent_text(touched & ~by_robot)]
        rates = [rate_text(verdicts == "success"), rate_text(won)]
        ends.append([label, str(n), *rates, *touches, *shares])
        went.append([label, *_numbers(rows, won)])
    digests: Any = run.header["digests"]
    loop = str(digests.get("closed_loop", "unknown"))
    own = ":" in loop.partition("; ")[0]  # module:function, as no built-in policy is called
    played = "closed loop (own policy)" if own else "closed loop"
    head = ["Method", "n", "SR", played, "contact by robot", "by hand"]
    head += [end.replace("_", " ") for end in SHOWN[1:]]
    how = [
        "Method", "time, s", "least, cm", "slack, cm", "near speed, cm/s", "PFL", "SSM, s", "robot idle", "human idle",
        "both move", "delay",
    ]  # fmt: skip
    notes = (OWN_POLICY, *NOTES) if own else NOTES
    parts = [
        f"Closed loop: {plain(loop)}",
        aligned(head, ends, 1),
        aligned(how, went, 1),
        notes_list(notes),
    ]
    return "\n\n".join(parts) + "\n"


def _numbers(rows: dict[str, np.ndarray], won: np.ndarray) -> list[str]:
    lived = rows["time_s"] > 0
    if not lived.any():
        return ["-"] * 10
    time = f"{np.median(rows['time_s'][won]):.1f}" if won.any() else "-"
    cm = [
        f"{100 * f(rows[k][lived]):.1f}"
        for f, k in ((np.median, "least_m"), (np.mean, "slack_m"), (np.median, "near_speed_m_s"))
    ]
    shares = [
        f"{np.mean(rows[k][lived]):.2f}"
        for k in ("robot_idle", "human_idle", "concurrent", "delay")
    ]
    pfl, ssm = rows["pfl_share"][lived].max(), np.mean(rows["ssm_s"][lived])
    return [time, *cm, f"{pfl:.2f}", f"{ssm:.1f}", *shares]
