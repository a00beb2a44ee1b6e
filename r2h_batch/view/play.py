"""Plays this trial with nothing but mujoco and numpy: python play.py [--executed] [--servos] [--check]

--executed  the motion that the simulator made of the plan, where there is one
--servos    simulate: the arm's servos follow the planned motion
--check     no window: play it through and print where the gripper ends
"""

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np

HERE = Path(__file__).resolve().parent


def motion(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) in s and postures (N, joints) in rad."""
    table = np.loadtxt(HERE / name, delimiter=",", skiprows=1, ndmin=2)
    return table[:, 0], table[:, 1:]


def at(t: float, times: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The posture at time t."""
    return np.array([np.interp(t, times, q[:, k]) for k in range(q.shape[1])])


def step(model: mujoco.MjModel, data: mujoco.MjData, q: np.ndarray, servos: bool) -> None:
    """One step of the simulator towards q, or the posture itself."""
    if servos:
        data.ctrl[:] = q
        mujoco.mj_step(model, data)
    else:
        data.qpos[:] = q
        data.time += model.opt.timestep
        mujoco.mj_forward(model, data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for flag in ("--executed", "--servos", "--check"):
        parser.add_argument(flag, action="store_true")
    options = parser.parse_args()
    model = mujoco.MjModel.from_xml_path(str(HERE / "scene.xml"))
    data = mujoco.MjData(model)
    times, q = motion("executed.csv" if options.executed else "trajectory.csv")
    if options.servos:
        model.opt.disableactuator = 0
    mujoco.mj_resetDataKeyframe(model, data, 0)
    if len(q) == 1:
        print("no motion was found for this trial: the key `target` holds the posture that was asked for")
        mujoco.mj_resetDataKeyframe(model, data, model.key("target").id)
    if options.check:
        while len(q) > 1 and data.time < times[-1] + 0.5 * options.servos:
            step(model, data, at(data.time + model.opt.timestep, times, q), options.servos)
        mujoco.mj_forward(model, data)
        off = float(np.linalg.norm(data.site("ee").xpos - data.site("target").xpos))
        print(f"{data.time:.2f} s, gripper {1e3 * off:.2f} mm from its target, {data.ncon} contacts")
        return
    from mujoco import viewer

    with viewer.launch_passive(model, data) as window:
        while window.is_running():
            start = time.time()
            if len(q) > 1:
                step(model, data, at(data.time + model.opt.timestep, times, q), options.servos)
                if data.time > times[-1] + 1.0:
                    mujoco.mj_resetDataKeyframe(model, data, 0)
            window.sync()
            time.sleep(max(0.0, model.opt.timestep - (time.time() - start)))


if __name__ == "__main__":
    main()
