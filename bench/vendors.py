"""Robots as their vendors and simulators ship them, imported unedited: docs/robots.md.

`python bench/vendors.py --files FOLDER --json bench/results/vendors.json` runs `r2h-batch import robot` on each file of ROBOTS
below FOLDER, and sweeps the oracle on each robot that it writes. FOLDER holds, unpacked:

| folder | is |
|---|---|
| robosuite | the wheel of robosuite |
| example-robot-data | the wheel of example-robot-data |
| mink | the repository kevinzakka/mink |
| menagerie | the repository google-deepmind/mujoco_menagerie |
| franka_description, xarm_description | the ROS packages, with the named xacro file expanded into their folder |

None of it is part of this project. A robot whose file is not there is left out, and the count of files says so. `--only NAME
...` tries these alone.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

from _report import ROOT, Report
from _rows import oracle_percent
from run import Bench

MEASURES = (
    "bench/vendors.py",
    "r2h_batch/commands/import_files.py",
    *(f"r2h_batch/data/robot{part}.py" for part in ("", "_chain", "_links", "_model", "_pads", "_pairs", "_shapes")),
)
SUITE = "robosuite/robosuite/models/assets/robots"
DATA = "example-robot-data/cmeel.prefix/share/example-robot-data/robots"


class Sold(NamedTuple):
    """A file of a vendor and the flags that import it."""

    arm: str
    gripper: str
    origin: str
    path: str
    flags: str


ROBOTS = {
    "gen3_2f85": Sold(
        "Kinova Gen3", "its Robotiq 2F-85, `<connect>`", "mink", "mink/examples/stanford_tidybot/tidybot.xml",
        "--base gen3/base_link --flange base --fingers left_pad,right_pad",
    ),
    "gen3": Sold("Kinova Gen3", "", "robosuite", f"{SUITE}/kinova3/robot.xml", "--base base --flange right_hand"),
    "iiwa14": Sold(
        "iiwa14", "", "mink, Menagerie", "mink/examples/kuka_iiwa_14/iiwa14.xml", "--base base --flange attachment_site"
    ),
    "iiwa": Sold("iiwa", "", "robosuite", f"{SUITE}/iiwa/robot.xml", "--base base --flange right_hand"),
    "xarm7_jaws": Sold(
        "xArm7", "its xArm gripper, `<connect>`", "mink, Menagerie", "mink/examples/ufactory_xarm7/xarm7.xml",
        "--base link_base --flange xarm_gripper_base_link --fingers left_finger,right_finger",
    ),
    "xarm7": Sold("xArm7", "", "robosuite", f"{SUITE}/xarm7/robot.xml", "--base base --flange right_hand"),
    "xarm7_urdf": Sold(
        "xArm7", "", "example-robot-data", f"{DATA}/xarm_description/urdf/xarm7.urdf", "--base link_base --flange link_eef"
    ),
    "lite6": Sold("Lite6", "", "xarm_ros2", "xarm_description/lite6.urdf", "--base link_base --flange link_eef"),
    "vx300s": Sold(
        "ViperX 300s", "its own fingers", "mink (ALOHA)", "mink/examples/aloha/aloha.xml",
        "--base left/base_link --flange left/gripper_link --offset=0,0,0,0,1.5708,0"
        " --fingers left/left_finger_link,left/right_finger_link",
    ),
    "z1": Sold(
        "Z1", "", "example-robot-data", f"{DATA}/z1_description/urdf/z1.urdf",
        "--base link00 --flange link06 --offset=0.051,0,0,0,1.5708,0 --home=0,1.8,-2.16,1.5,0,0",
    ),
    "sawyer": Sold("Sawyer", "", "robosuite", f"{SUITE}/sawyer/robot.xml", "--base base --flange right_hand"),
    "fr3": Sold("FR3", "", "franka_description", "franka_description/fr3.urdf", "--base fr3_link0 --flange fr3_link8"),
    "panda_jaws": Sold(
        "Panda", "its hand, pads from meshes", "Menagerie", "menagerie/franka_emika_panda/panda.xml",
        "--base link0 --flange hand --fingers left_finger,right_finger",
    ),
    "panda": Sold("Panda", "", "robosuite", f"{SUITE}/panda/robot.xml", "--base base --flange right_hand"),
    "ur5": Sold("UR5", "", "example-robot-data", f"{DATA}/ur_description/urdf/ur5_robot.urdf", "--base base_link --flange tool0"),
}  # fmt: skip


def imported(sold: Sold, files: Path, folder: Path) -> tuple[int, str]:
    """Exit code and the last line of the command."""
    path = files / sold.path
    flag = "--mjcf" if path.suffix == ".xml" else "--urdf"
    line = [
        sys.executable,
        "-m",
        "r2h_batch",
        "import",
        "robot",
        flag,
        str(path),
        *sold.flags.split(),
        "--out",
        str(folder),
    ]
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=ROOT)
    said = (done.stdout + done.stderr).strip().splitlines()
    return done.returncode, said[-1] if said else ""


def tried(name: str, sold: Sold, files: Path, out: Path, trials: int) -> dict[str, Any]:
    """One file: success of the oracle, or the refusal."""
    code, said = imported(sold, files, out / name)
    if code:
        return {"refused": said.replace(str(files), "FOLDER")}
    return {"oracle_percent": oracle_percent(out / f"{name}_run", out / name, trials)}


def run(options: argparse.Namespace, result: Report) -> None:
    """Tries every file and writes the figures."""
    os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "osmesa")  # of the commands: they draw home.png
    here = {n: ROBOTS[n] for n in options.only if (options.files / ROBOTS[n].path).is_file()}
    found: dict[str, dict[str, Any]] = {}
    options.out.mkdir(parents=True, exist_ok=True)
    for name, sold in here.items():
        kept = options.out / f"{name}.json"
        if not kept.exists():
            kept.write_text(json.dumps(tried(name, sold, options.files, options.out, options.trials)))
        found[name] = json.loads(kept.read_text())
        for key, value in found[name].items():
            result.add(f"vendors.{name}.{key}", value)
    through = [n for n in found if "refused" not in found[n]]
    result.add("vendors.files", len(found))
    result.add("vendors.through", len(through))
    result.add("vendors.arms", len({ROBOTS[n].arm for n in through}))
    result.add("vendors.trials", options.trials)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--files": {"type": Path, "required": True, "help": "folder of the vendors' files, unpacked"},
        "--only": {"nargs": "+", "default": [*ROBOTS], "choices": [*ROBOTS], "help": "names of ROBOTS"},
        "--trials": {"default": 20, "help": "of each split, for the oracle"},
        "--out": {"type": Path, "required": True, "help": "robots and figures; what is there is not tried again"},
    },
)

if __name__ == "__main__":
    BENCH.main()
