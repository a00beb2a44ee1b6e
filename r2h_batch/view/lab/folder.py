"""The folder that a laboratory takes to its robot: one folder a trial, the objects, the table to fill in."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from r2h_batch.base.declared import OURS
from r2h_batch.base.io.write import atomic_path, csv_cell, write_json, write_text
from r2h_batch.scene.robot import Robot
from r2h_batch.sweep.study.real import OUTCOME_COLUMNS
from r2h_batch.view.lab.frames import T_base_world, pendant, turn_vector
from r2h_batch.view.lab.paths import csv_of, path_of, ros2_of, urscript_of
from r2h_batch.view.lab.sheets import grasp_sheet, hand_sheet, object_sheet, write_sheet
from r2h_batch.view.mjcf import describe
from r2h_batch.view.stored_trial import StoredTrial

LEGS = ("pick", "lift")
"""Files of the legs before a motion."""
SAFETY = """\
Before anything moves
1. Do a risk assessment of your cell (ISO 10218-2, ISO/TS 15066). These files are no safety function.
2. Somebody holds the emergency stop at every run and does nothing else.
3. Run every path first without a person and without an object, at the pendant's slowest speed.
4. Compare the first posture, the TCP and the frame with the pendant (trial.json, under "lab"). A pose of the other frame
   (base, base_link) is on the other side of the robot.
5. Only then a stand in place of the hand, then the object, and a person last: informed, with consent, and with your ethics
   board's approval.
6. The way back (back.*) is not judged: the person steps away first.
The judged workplace has a table, a hand and a person. What else stands in your cell is in no check.
"""


def write_trial(
    stored: StoredTrial, folder: Path, *, step_s: float, tcp_speed: float
) -> dict[str, Any]:
    """One trial's folder: there.* and back.* (CSV, ROS 2, URScript of a UR), hand.pdf, grasp.pdf, trial.json.

    A trial that begins on the table has pick.*, lift.* and object.pdf too: with the open gripper to the grasp, up with the
    closed one, and where the object rests.

    Args:
        stored: a trial with a path.
        folder: where its folder goes.
        step_s: between two postures, s.
        tcp_speed: highest speed of the TCP, m/s.

    Returns:
        Its row of the table to fill in.

    Raises:
        UsageError: the trial has no path, or a sheet fits on no paper.
    """
    row, robot, model = stored.row, stored.robot, stored.object_model
    there = path_of(stored, step_s=step_s, tcp_speed=tcp_speed)
    title = f"trial {row['trial_id']}, {model.name}, {stored.method}"
    sheets = {"hand": hand_sheet(stored), "grasp": grasp_sheet(stored)}
    if stored.before:
        sheets["object"] = object_sheet(stored.before[0])
    papers = {
        name: write_sheet(drawn, f"{title}: {name}", folder / f"{name}.pdf")
        for name, drawn in sheets.items()
    }
    load_kg, load_m = load_of(stored)
    legs = [path_of(leg, step_s=step_s, tcp_speed=tcp_speed) for leg in stored.before]
    named = [*zip(LEGS, legs, strict=False), ("there", there), ("back", there.back)]
    for name, path in named:
        write_text(folder / f"{name}.csv", csv_of(path))
        write_json(folder / f"{name}.ros2.json", ros2_of(path))
        if robot.family == "ur":
            own = (
                (load_kg, load_m)
                if name in ("there", "lift")
                else (robot.linkage.mass_kg, gripper_com(robot))
            )
            program = urscript_of(
                path, f"r2h_{row['trial_id']}_{name}", robot, load_kg=own[0], load_m=own[1]
            )
            write_text(folder / f"{name}.script", program)
    T, first = robot.T_flange_ee, (*stored.before, stored)[0]
    about = describe(stored)
    about["conventions"] = {**OURS, "joint_names": list(robot.joints)}
    about["lab"] = {
        "frames": "world = base_link of ROS 2; a UR's pendant counts in base, turned by half a turn about z",
        "T_base_world": T_base_world.tolist(),
        "tcp_mm_rad": [
            *(1000 * T[:3, 3]).round(3).tolist(),
            *turn_vector(T[:3, :3]).round(6).tolist(),
        ],
        "pendant_mm_rad": {
            "home_tcp": pendant(_tcp_at(first, 0)),
            "handover_tcp": pendant(stored.T_world_ee),
            "hand": pendant(stored.T_world_hand),
        },
        "joints_deg": {
            "home": np.degrees(first.q[0]).round(3).tolist(),
            "handover": np.degrees(stored.q[-1]).round(3).tolist(),
        },
        "payload_kg": round(load_kg, 4),
        "payload_center_mm": (1000 * load_m).round(1).tolist(),
        "seconds": round(float(there.time_s[-1]), 3),
        "times_slower_than_the_run": round(there.slower, 3),
        "highest_tcp_speed_m_s": tcp_speed,
        "paper": papers,
    }
    write_json(folder / "trial.json", about)
    return {
        "trial_id": row["trial_id"],
        "method": stored.method,
        "object": model.name,
        "split": row["split"],
    }


def _tcp_at(stored: StoredTrial, k: int) -> Any:
    from r2h_batch.view.lab.paths import tcp_of

    return tcp_of(stored.robot, stored.q[k : k + 1])[0]


def gripper_com(robot: Robot) -> Any:
    """Centre of the gripper's mass in the flange's frame, m: halfway to the TCP [choice], as it has no published one here."""
    return robot.T_flange_ee[:3, 3] / 2


def load_of(stored: StoredTrial) -> tuple[float, Any]:
    """Mass at the flange (kg) and its centre in the flange's frame (3,) m: gripper and object as it is held."""
    robot, model = stored.robot, stored.object_model
    T_flange_obj = robot.T_flange_ee @ np.linalg.inv(stored.T_obj_ee_attached)
    com = T_flange_obj[:3, :3] @ model.com + T_flange_obj[:3, 3]
    mass = robot.linkage.mass_kg + model.mass
    return mass, (robot.linkage.mass_kg * gripper_com(robot) + model.mass * com) / mass


def write_objects(models: Sequence[Any], folder: Path) -> None:
    """NAME.stl of each object in millimetres, and objects.csv with their masses."""
    folder.mkdir(parents=True, exist_ok=True)
    for model in models:
        mesh = trimesh.Trimesh(1000 * np.asarray(model.vertices), model.faces, process=False)
        with atomic_path(folder / f"{model.name}.stl") as temporary:
            mesh.export(temporary, file_type="stl")
    rows = [
        {"object": m.name, "mass_g": round(1000 * m.mass, 1), "volume_ml": _volume_ml(m)}
        for m in models
    ]
    write_table(folder / "objects.csv", list(rows[0]), rows)


def _volume_ml(model: Any) -> float:
    mesh = trimesh.Trimesh(model.vertices, model.faces, process=False)
    return round(1e6 * abs(float(mesh.volume)), 1)


def write_outcomes(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """The table to fill in, which `study real` reads: a line for each trial and method, its result left empty."""
    columns = ["trial_id", "method", *OUTCOME_COLUMNS, "object", "split", "note"]
    write_table(path, columns, rows)


def write_table(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as CSV; what a row lacks stays empty."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([csv_cell(row.get(c, "")) for c in columns] for row in rows)
