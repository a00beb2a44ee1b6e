"""MuJoCo only steps in a simulation: it reads no clock, unless the user has set one."""

import mujoco

from r2h_batch.judge.motion.simulation import clock_unread, warnings_unwritten

PENDULUM = "<mujoco><worldbody><body><joint axis='0 1 0'/><geom size='.1' pos='1 0 0'/></body></worldbody></mujoco>"
STEP = mujoco.mjtTimer.mjTIMER_STEP


def stepped() -> mujoco.MjData:
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 50)
    return data


def test_the_clock_is_read_again_after_the_last_simulation_and_states_do_not_depend_on_it():
    before = stepped()
    with clock_unread():
        with clock_unread():
            pass
        inside = stepped()
    after = stepped()
    assert inside.timer[STEP].duration == 0.0 and inside.timer[STEP].number == 50
    assert before.timer[STEP].duration > 0.0 and after.timer[STEP].duration > 0.0
    assert inside.qpos[0] == before.qpos[0] != 0.0 and inside.qvel[0] == before.qvel[0]


def test_a_clock_and_a_handler_of_the_user_stay_in_charge():
    read: list[int] = []
    said: list[str] = []

    def clock() -> float:
        read.append(1)
        return float(len(read))

    mujoco.set_mjcb_time(clock)
    mujoco.set_mju_user_warning(said.append)
    try:
        with warnings_unwritten(), clock_unread():
            assert stepped().timer[STEP].duration >= 50.0
            assert mujoco.get_mju_user_warning() == said.append
        assert mujoco.get_mjcb_time() is clock and mujoco.get_mju_user_warning() == said.append
    finally:
        mujoco.set_mjcb_time(None)
        mujoco.set_mju_user_warning(None)
