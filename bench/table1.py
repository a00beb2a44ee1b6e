"""Table I of all methods and both bounds: docs/results/table1*.{md,csv,json}.

Of r2h-v0 and r2h-v1 (-v1), in the default preset and with what the paper's planning and methods know (-paper-preset).
`make tables` runs this, bench/sensitivity.py and bench/findings.py.

    python bench/table1.py                     # 500 trials a split, about twenty minutes on two cores
    python bench/table1.py --trials 100 --out /tmp/table1

Run folders (--runs) are gone on with where they stopped. Each file says command, digests and versions; the Markdown also
which of the paper's findings appear here.
"""

import argparse
import contextlib
import io
import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from _report import ROOT, hardware

METHODS = ("fc", "handover-va", "contact", "intent", "random", "oracle")
OWN = {"FC": "FC-Handover", "VA": "Handover-VA", "Contact": "Contact-Handover", "Intent": "Intent-Handover"}

FINGERS = {
    "r2h-v0": "The protocol leaves a hand's roll free: fingers that point away from the robot ask FC- and Intent-Handover, which"
    " oppose the gripper to them, for poses that no arm on this side takes.",
    "r2h-v1": "The hand follows from a reaching arm (docs/receivers.md): few fingers point away from the robot.",
}
Cells = Callable[[str, str, str], float]


def findings() -> list[tuple[str, str, str, str, int]]:
    """(what the paper says, split, column, who leads, sign): sign 1, the leader has the highest value; -1, the lowest."""
    return [
        ("Intent-Handover has the lowest F_afford in S1", "S1", "f_afford", "Intent", -1),
        ("FC-Handover has the highest F_afford in S1", "S1", "f_afford", "FC", 1),
        ("Handover-VA has the highest F_plan", "Avg", "f_plan", "VA", 1),
        ("Handover-VA has the highest F_safe", "Avg", "f_safe", "VA", 1),
        ("Contact-Handover has the best SR in S0", "S0", "sr", "Contact", 1),
        ("Intent-Handover has the best SR in S1", "S1", "sr", "Intent", 1),
        ("FC-Handover has the lowest F_reach", "Avg", "f_reach", "FC", -1),
        ("Contact-Handover has the lowest F_safe", "Avg", "f_safe", "Contact", -1),
        ("Handover-VA has the lowest F_stab", "Avg", "f_stab", "VA", -1),
        ("Handover-VA has the shortest planning", "Avg", "t_plan_s", "VA", -1),
        ("Handover-VA's own time is the shortest", "Avg", "t_method_s", "VA", -1),
    ]


def finding_lines(cell: Cells) -> list[str]:
    """A Markdown table: finding, the four methods' values, whether it appears."""
    lines = ["| the paper says | column | FC | VA | Contact | Intent | here |", "|---|---|--:|--:|--:|--:|---|"]
    for text, split, column, leader, sign in findings():
        values = {name: cell(split, title, column) for name, title in OWN.items()}
        best = max(sign * v for v in values.values())
        tied = sum(sign * v == best for v in values.values()) > 1
        word = "no" if sign * values[leader] < best else "tied" if tied else "yes"
        shown = " | ".join(f"{v:.2g}" if column.startswith("t_") else f"{v:.1f}" for v in values.values())
        lines.append(f"| {text} | {split} {column} | {shown} | {word} |")
    drops = {name: cell("S0", title, "sr") - cell("S1", title, "sr") for name, title in OWN.items()}
    shown = " | ".join(f"{v:.1f}" for v in drops.values())
    word = "yes" if drops["VA"] == max(drops.values()) else "no"
    lines.append(f"| Handover-VA drops most from S0 to S1 | SR S0 - S1 | {shown} | {word} |")
    return lines


def finger_lines(run) -> list[str]:
    """F_plan by where the receiver's fingers point (in the horizontal plane's sense: towards the robot or away)."""
    import numpy as np
    import torch

    from r2h_batch.scene.scene import Scene
    from r2h_batch.trials.protocol import trials_with_ids

    scene, tip = Scene(), 1
    ids = np.array(run.trials(run.methods[0])["trial_id"])
    trials = trials_with_ids(torch.from_numpy(ids.copy()), protocol=run.header["protocol"])
    hand = trials.hand_index.long()
    pointing = scene.hands.vertices[hand, int(scene.hands.model.tip_vertices[tip])] - scene.hands.joints[hand, 0]
    fingers = torch.einsum("nij,nj->ni", trials.T_world_hand[:, :3, :3], pointing).double().numpy()
    center = scene.palm(trials.hand_index, trials.T_world_hand)[2].double().numpy() * [1.0, 1.0, 0.0]
    cos = -(fingers * center).sum(1) / np.linalg.norm(fingers, axis=1) / np.linalg.norm(center, axis=1)
    angle = np.degrees(np.arccos(np.clip(cos, -1, 1)))
    edges = [(0, 60), (60, 90), (90, 120), (120, 181)]
    inside = [(angle >= a) & (angle < b) for a, b in edges]
    heads = [f"{a}-{min(b, 180)} deg (n = {int(m.sum())})" for (a, b), m in zip(edges, inside)]
    lines = ["| F_plan in % | " + " | ".join(heads) + " |", "|---|" + "--:|" * len(edges)]
    for method in run.methods:
        rows = run.trials(method)
        failed = np.array(rows["outcome"].to_pylist()) == "plan"
        failed = failed[np.argsort(np.array(rows["trial_id"]))][np.argsort(np.argsort(ids))]
        lines.append(
            f"| {method} | " + " | ".join(f"{100 * failed[m].mean():.1f}" if m.any() else "-" for m in inside) + " |"
        )
    return lines


def pairs_of(run) -> list[dict[str, object]]:
    """The paired test of the four methods on all trials of each split and of both: who is apart from whom."""
    from r2h_batch.statistics.common import common_trials
    from r2h_batch.statistics.paired import Paired, compare, pair_up

    paired: Paired = pair_up([run], common_trials([run]))
    return [
        {"group": c.group, "a": p.a, "b": p.b, "difference": p.difference, "p_holm": p.p_holm, "verdict": p.verdict}
        for c in compare(paired)
        for p in c.pairs
    ]


def unsolved(run) -> dict[str, list[int]]:
    """Ids of the trials that the oracle does not solve, and of those that no method solves."""
    solved: dict[int, set[str]] = {}
    for method in run.methods:
        rows = run.trials(method)
        for trial, outcome in zip(rows["trial_id"].to_pylist(), rows["outcome"].to_pylist()):
            solved.setdefault(trial, set())
            if outcome == "success":
                solved[trial].add(method)
    oracle = [t for t, who in sorted(solved.items()) if "oracle" in run.methods and "oracle" not in who]
    return {"oracle_unsolved": oracle, "solved_by_nobody": [t for t, who in sorted(solved.items()) if not who]}


def sweep(folder: Path, trials: int, noise: float, more: list[str]) -> list[str]:
    """Runs (or goes on with) one sweep; its command."""
    from r2h_batch.sweep import command as command

    line = [
        "--method",
        *METHODS,
        "--trials",
        str(trials),
        "--predictor-noise",
        f"{noise:g}",
        "--out",
        str(folder),
        *more,
    ]
    with contextlib.redirect_stdout(io.StringIO()):
        code = command.main(line)
    if code:
        sys.exit(code)
    return ["python", "-m", "r2h_batch.sweep", *line]


def write(folder: Path, out: Path, name: str, title: str, line: list[str]) -> None:
    """The table of a run folder as .md, .csv and .json."""
    from r2h_batch.report.table import object_lines, render, table_of
    from r2h_batch.runs.store import load_run

    run = load_run(folder)
    table = table_of(run)
    origin = {
        "command": shlex.join(line),
        "commit": run.header["git_commit"],
        "digests": run.header["digests"],
        "methods": {m: run.digest(m) for m in run.methods},
        "predictors": run.header["predictors"],
        "versions": run.header["versions"],
        "hardware": hardware(),
    }
    rows = {(r["split"], r["method"].partition(" (")[0]): r for r in json.loads(render(table, "json"))["rows"]}

    def cell(split: str, method: str, column: str) -> float:
        return float(rows[split, method][column] or 0.0)

    parts = [
        f"# {title}",
        f"`{origin['command']}`",
        f"Commit {origin['commit']}; code {run.header['digests']['code'][:16]}; versions: "
        + ", ".join(f"{k} {v}" for k, v in run.header["versions"].items()),
        render(table, "md").rstrip(),
        "## The paper's findings",
        "Point estimates of the four methods; whether two of them differ by more than chance says the intervals above.",
        "\n".join(finding_lines(cell)),
        "## Plan failures by where the receiver's fingers point",
        "Angle between the true hand's direction (wrist to middle tip) and the horizontal direction to the robot. "
        + FINGERS[run.header["protocol"]],
        "\n".join(finger_lines(run)),
        "## By object",
        object_lines(run).rstrip(),
    ]
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text("\n\n".join(parts) + "\n")
    (out / f"{name}.csv").write_text(render(table, "csv"))
    data = json.loads(render(table, "json")) | {"provenance": origin, "pairs": pairs_of(run)} | unsolved(run)
    (out / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n")
    print(out / f"{name}.md")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=500, help="of each split")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs", help="where the run folders are")
    parser.add_argument("--only", nargs="*", default=(), help="names of tables; all unless given")
    given, more = parser.parse_known_args()
    for name, title, noise, preset, protocol in (
        ("table1", "Table I of r2h-v0", 1.0, "default", "r2h-v0"),
        ("table1-paper-preset", "Table I of r2h-v0, planned as the paper does", 1.0, "paper", "r2h-v0"),
        ("table1-v1", "Table I of r2h-v1", 1.0, "default", "r2h-v1"),
        ("table1-v1-paper-preset", "Table I of r2h-v1, planned as the paper does", 1.0, "paper", "r2h-v1"),
    ):
        if given.only and name not in given.only:
            continue
        folder = given.runs / f"{name}-{given.trials}"
        line = sweep(folder, given.trials, noise, ["--preset", preset, "--protocol", protocol, *more])
        write(folder, given.out, name, title, line)


if __name__ == "__main__":
    main()
