"""The same methods on the built-in robots, and their inverse kinematics: docs/results/robots.md.

`python bench/robots.py --out FOLDER` sweeps all methods on r2h-v1 with each robot, motion as planned, persons placed for the
robot (the same FOLDER goes on). IK: postures drawn uniformly within the joint ranges, so every target can be reached; process
time of one thread; pytorch-kinematics' PseudoInverseIK, by restarts, on the first of them. `--render` writes the page again
from the JSON.
"""

import argparse
import json
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_kinematics
import torch
from _report import ROOT, made_by
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.robot import Robot, ee_pose, load_robot
from r2h_batch.judge.ik import solve_ik
from r2h_batch.launch.threads import on_threads

ROBOTS = ("ur5e_2f85", "ur3e_2f85", "panda_hand")
METHODS = ("fc", "handover-va", "contact", "intent", "random", "oracle")
PAGE = ROOT / "docs" / "results" / "robots.md"
STORED = ROOT / "bench" / "results" / "robots.json"
RESTARTS = 20

HEAD = """# The same methods on three robots

{trials} trials of each split of r2h-v1 on every built-in robot, motion as planned, persons placed for the robot
([robots](../robots.md#persons-and-table)). `python bench/robots.py` (bench/results/robots.json) measured it on commit {commit}.
Your robot: `r2h-batch sweep --robot DIR --method fc handover-va contact intent oracle`.

## Success rates

Percent of all trials, mean of the splits; brackets: 95 %, Wilson.

{rates}

Order of the four methods by SR:

{orders}

The grasp candidates are the 2F-85's on every robot. The Panda's hand has a shorter stroke, {stroke:.0f} mm, and fails Stability
where they are wider.

## First failures

Percent of all trials, mean of the splits.

{failures}

## Inverse kinematics

{targets:,} postures drawn uniformly within the joint ranges; microseconds of one core for a target, with all branches or eight
postures. Missed: targets without any posture. pytorch-kinematics: one posture within 1 mm and 0.01 rad, {restarts} restarts,
{some:,} targets.

{ik}
"""


def chain_of(robot: Robot) -> Any:
    """pytorch-kinematics' chain of a robot, base to ee, from its joint frames."""

    def joint(k: int, kind: str, T: np.ndarray) -> str:
        turn, place = Rotation.from_matrix(T[:3, :3]).as_euler("xyz"), T[:3, 3]
        rpy, xyz = (" ".join(map(repr, x.tolist())) for x in (turn, place))
        return (
            f'<link name="l{k + 1}"/><joint name="j{k}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin rpy="{rpy}" xyz="{xyz}"/><axis xyz="0 0 1"/><limit lower="-7" upper="7" effort="1" velocity="1"/></joint>'
        )

    n = len(robot.joints)
    joints = [joint(k, "revolute", robot.T_parent_joint[k]) for k in range(n)]
    joints.append(joint(n, "fixed", robot.T_wrist3_flange @ robot.T_flange_ee))
    text = f'<robot name="{robot.name}"><link name="l0"/>{"".join(joints)}</robot>'
    return pytorch_kinematics.build_serial_chain_from_urdf(text, f"l{n + 1}", "l0")


def inverse_kinematics(robot: Robot, count: int, some: int) -> dict[str, float]:
    """Times, misses and errors on targets that the robot can reach."""
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (count, len(robot.joints)))
    targets = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    with on_threads(1):
        solve_ik(targets[:256], robot=robot)
        start = time.process_time()
        found = solve_ik(targets, robot=robot)
        seconds = time.process_time() - start
    chain = chain_of(robot)
    few = targets[:some].contiguous()
    ours = chain.forward_kinematics(torch.from_numpy(q[:some]).float()).get_matrix()
    assert float((ours - few).abs().max()) < 1e-4, f"{robot.name}: the reference chain is another arm"
    torch.manual_seed(0)  # its seeds come from the global generator
    limits = torch.from_numpy(np.stack([robot.lower, robot.upper], 1)).float()
    solver = pytorch_kinematics.PseudoInverseIK(
        chain, max_iterations=30, num_retries=RESTARTS, joint_limits=limits, regularlization=1e-6,
        early_stopping_any_converged=True, early_stopping_no_improvement="all",
    )  # fmt: skip
    start = time.process_time()
    reference = solver.solve(pytorch_kinematics.Transform3d(matrix=few)).converged_any
    reference_s = time.process_time() - start
    return {
        "us": 1e6 * seconds / count,
        "missed": int((~found.reachable).sum()),
        "postures": float(found.valid.sum(1).double().mean()),
        "position_error_um": 1e6 * float(found.position_error_m[found.valid].max()),
        "reference_us": 1e6 * reference_s / some,
        "reference_missed": int((~reference).sum()),
        "missed_of_these": int((~found.reachable[:some]).sum()),
    }


def table(robot: str, trials: int, folder: Path) -> dict[str, dict[str, Any]]:
    """Method -> the record of its mean row."""
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.command import run
    from r2h_batch.sweep.options import parse

    words = ["--robot", robot, "--method", *METHODS, "--trials", str(trials), "--sim", "none", "--quiet"]
    with redirect_stdout(StringIO()):
        if code := run(parse([*words, "--out", str(folder)])):
            raise SystemExit(code)
    rows = table_of(load_run(folder)).rows
    return {row.method.partition(" (")[0]: record(row) for row in rows if row.split == "Avg"}


def measure(out: Path, trials: int, targets: int, some: int) -> dict[str, Any]:
    """All robots."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    for name in ROBOTS:
        robot = load_robot(name)
        found[name] = {
            "stroke_mm": 1e3 * robot.open_gap_m,
            "ik": inverse_kinematics(robot, targets, some),
            "table": table(name, trials, out / name),
        }
        print(name, json.dumps(found[name]["ik"]), flush=True)
    return {"trials": trials, "targets": targets, "some": some, "robots": found, **made_by()}


def markdown(data: dict[str, Any]) -> str:
    """The page."""
    from r2h_batch.report.text import aligned

    robots = data["robots"]
    methods = list(next(iter(robots.values()))["table"])

    def rate(row: dict[str, Any]) -> str:
        return f"{row['sr']:.1f} [{row['sr_low']:.0f}, {row['sr_high']:.0f}]"

    rates = [[m, *(rate(r["table"][m]) for r in robots.values())] for m in methods]
    kinds = ("f_stab", "f_plan", "f_reach", "f_afford", "f_safe")
    failures = [[m, name, *(f"{r['table'][m][k]:.1f}" for k in kinds)] for m in methods for name, r in robots.items()]
    ik = [
        [
            name,
            f"{r['ik']['us']:.1f}",
            str(r["ik"]["missed"]),
            f"{r['ik']['postures']:.1f}",
            f"{r['ik']['position_error_um']:.1f}",
            f"{r['ik']['reference_us']:.0f}",
            str(r["ik"]["reference_missed"]),
        ]
        for name, r in robots.items()
    ]
    head = ["Robot", "us", "missed", "postures", "largest error, um", "pytorch-kinematics, us", "its misses"]
    return HEAD.format(
        trials=data["trials"],
        commit=str(data["commit"])[:12],
        rates=aligned(["Method", *robots], rates, 1),
        orders="\n".join(f"- {name}: {_order(r['table'], methods)}" for name, r in robots.items()),
        stroke=robots["panda_hand"]["stroke_mm"],
        failures=aligned(["Method", "Robot", *kinds], failures, 2),
        targets=data["targets"],
        some=data["some"],
        restarts=RESTARTS,
        ik=aligned(head, ik, 1),
    )


def _order(rows: dict[str, Any], methods: Sequence[str]) -> str:
    own = [m for m in methods if m not in ("random", "oracle")]
    return ", ".join(sorted(own, key=lambda m: -rows[m]["sr"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "robots")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--targets", type=int, default=100_000)
    parser.add_argument("--reference-targets", type=int, default=500)
    parser.add_argument("--render", action="store_true")
    options = parser.parse_args()
    if not options.render:
        data = measure(options.out, options.trials, options.targets, options.reference_targets)
        STORED.write_text(json.dumps(data, indent=1) + "\n")
    PAGE.write_text(markdown(json.loads(STORED.read_text())))


if __name__ == "__main__":
    main()
