"""Episodes that begin at the table: the scripted pick, contacts against MuJoCo C, the ends by the draft's criteria, any batch."""

from dataclasses import replace
from functools import cache

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from rounds import each
from table_twin import TableTwin

from r2h_batch import load_benchmark
from r2h_batch.closed_loop import Picks, TableHandoverEnv, play
from r2h_batch.closed_loop import from_table as tables
from r2h_batch.closed_loop.arm import ee_and_jacobian
from r2h_batch.closed_loop.env import End, HandoverEnv, LoopConfig, SingleHandoverEnv
from r2h_batch.closed_loop.episodes import Loop, env_class
from r2h_batch.closed_loop.from_table import Phase
from r2h_batch.closed_loop.moving import ReceiverMotion
from r2h_batch.closed_loop.policies import POLICIES, kind_of_action
from r2h_batch.closed_loop.registered import ID, register
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp_physics import CLOSING_M_S
from r2h_batch.methods import fc
from r2h_batch.observe import moments
from r2h_batch.verdicts import Outcome

KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))
EXACT = LoopConfig(noise=0, dropout=0, horizon_s=30)
CLOSE, LEAVE = -1.0, 0.0


@cache
def draft():
    return load_benchmark("r2h-v3-draft")


@cache
def evaluator():
    return Evaluator(draft(), KINEMATIC)


@cache
def certified(n=4):
    """Answers that solve the draft's first trials."""
    trials = draft().trials(n)
    known = draft().certificates(trials.trial_id.numpy())
    T = [torch.from_numpy(np.array(x)) for x in (known.T_obj_ee, known.T_world_ee)]
    return evaluator().score(*T, trials)


def made(scores, motion="still", name="planned", **more):
    how = {"action": kind_of_action(POLICIES[name]), "output": "torch", "config": EXACT} | more
    return TableHandoverEnv(scores, motion, **how)


def ended(env, policy="planned"):
    play(env, POLICIES[policy])
    return env._info(None)


@pytest.mark.check
def test_the_scripted_pick_beside_a_still_hand_ends_as_the_draft_judges_the_plan():
    """Answers that fail different criteria: what is played has the outcome that `score` gave it."""
    trials = draft().trials(20)
    answers = fc.predict(trials, evaluator().scene, T_world_obj=moments(evaluator().scene, trials))
    every = evaluator().score(answers.T_obj_ee, answers.T_world_ee, trials)
    two = [torch.nonzero(every.outcome == i).flatten()[:1] for i in every.outcome.unique()]
    poor = every[torch.cat(two)]
    env = made(poor)
    info = ended(env)
    kept = poor.outcome != int(Outcome.PLAN)  # without a path the policy stands
    asked = np.array([Outcome(int(x)).name.lower() for x in poor.outcome])
    differs = [(i, a, b) for i, (a, b) in enumerate(zip(asked, info["outcome"], strict=True)) if kept[i] and a != b]
    assert not differs
    assert {"success", "affordance", "received"} <= set(asked)
    lifted = poor.passed[:, poor.criteria.index("pick")] & kept
    assert (info["pick_reason"][lifted.numpy()] == "ok").all()
    # the gripper has closed as Stability closes it, where it was asked to
    assert torch.equal(env._opening[lifted], poor.opening_m[lifted]) or (
        (env._opening - poor.opening_m)[lifted].abs().max() < 1e-5
    )
    off = (env._T_obj_ee_made - poor.inputs.T_obj_ee)[lifted].abs().max()
    assert off < 1e-5


def test_all_certified_trials_are_handed_over_from_the_table():
    env = made(certified())
    info = ended(env)
    assert info["success"].all() and (info["outcome"] == "success").all()
    time_s = env.episodes().time_s
    assert float(time_s.min()) > 10 and float(time_s.max()) < 30


def at_grasp(env):
    """Plays until every row's arm stands at the grasp with an open gripper."""
    seen, picks = env.begin(), Picks(env, POLICIES["planned"](env))
    while bool((picks.leg < 2).any()):
        action = picks(seen)
        action[:, -1] = LEAVE
        seen, *_ = env.advance(action)
    return seen


def still(env, gripper):
    q = env.q if env.action == "posture" else torch.zeros_like(env.q)
    return torch.cat([q, torch.full_like(q[:, :1], gripper)], 1)


def closed_at_grasp():
    env = made(certified(2))
    at_grasp(env)
    env.advance(still(env, CLOSE))
    while bool((env.phase < int(Phase.LIFTS)).any()):
        env.advance(still(env, LEAVE))
    return env


def test_what_is_met_on_the_way_is_met_in_mujoco_c_and_nothing_else():
    """Steps about the ways of picking, each judged in every phase, against dense samples of other code."""
    env = closed_at_grasp()
    picks = Picks(env, POLICIES["planned"](env))
    rng, counts, gap = np.random.default_rng(4), {}, env._opening.clone()
    for phase in each((Phase.RESTS, Phase.LIFTS, Phase.CARRIES)):
        way = picks.way_in.path if phase == Phase.RESTS else picks.way_up.path
        env.phase[:] = int(phase)
        env._opening[:] = env.scene.robot.open_gap_m if phase == Phase.RESTS else gap
        twins = [TableTwin(env, row, env._attached[row], float(gap[row])) for row in range(4)]
        for _ in range(6):
            # the later on a way in, the nearer; the earlier on a way up, the nearer
            at = torch.from_numpy(rng.integers(0, way.shape[1], 4))
            size = 10 ** rng.uniform(-4, -1, (4, 1))
            q0 = way[torch.arange(4), at] + torch.from_numpy(rng.normal(size=(4, 6)) * size).float()
            q1 = q0 + torch.from_numpy(rng.normal(size=(4, 6)) * 0.02).float()
            free = env._meets_nothing(env._every, torch.stack([q0, q1], 1))
            for row in range(4):
                room = twins[row].room_m(q0[row].double().numpy(), q1[row].double().numpy(), phase)
                wrong = room < -2e-4 if free[row] else room > 5e-4
                assert not wrong, (phase, row, bool(free[row]), room)
                counts[phase, bool(free[row])] = counts.get((phase, bool(free[row])), 0) + 1
    assert all(counts.get((phase, free), 0) >= 2 for phase, free in counts), counts
    assert len(counts) == 6


def test_closing_takes_its_time_holds_what_stability_says_and_happens_once():
    env = made(certified(2))
    at_grasp(env)
    assert (env.phase == int(Phase.RESTS)).all()
    before = env.T_world_obj.clone()
    seen, *_ = env.advance(still(env, CLOSE))
    assert (env.phase == int(Phase.CLOSES)).all() and torch.equal(seen["gripper"], env._opening)
    gaps = [env._opening.clone()]
    while bool((env.phase == int(Phase.CLOSES)).any()):
        env.advance(still(env, LEAVE))  # once is enough
        gaps.append(env._opening.clone())
    steps = torch.stack(gaps).diff(dim=0)
    assert (steps <= 0).all() and (steps >= -CLOSING_M_S * env.step_s - 1e-7).all()
    asked = (env.scene.robot.open_gap_m - certified(2).opening_m) / CLOSING_M_S / env.step_s
    assert len(steps) == int(torch.ceil(asked - 1e-4).max())
    shift = (env.T_world_obj - before)[:, :3, 3].square().sum(1).sqrt()
    assert torch.allclose(shift, certified(2).grasp_shift_m.abs(), atol=2e-5)
    shut = env._opening.clone()
    env.advance(still(env, 1.0))
    assert torch.equal(env._opening, shut) and (env.phase == int(Phase.LIFTS)).all()


def test_a_gripper_that_closes_on_nothing_drops_and_one_that_moves_closes_when_it_stands():
    env = made(certified(2))
    env.begin()
    env.advance(still(env, CLOSE))
    info = env._info(None)
    assert (info["end"] == "drop").all() and (info["outcome"] == "stability").all()
    env = made(certified(2), name="replan", config=LoopConfig(rate_hz=50))
    env.begin()
    fast = torch.zeros(4, 7)
    fast[:, 0] = 0.5
    for _ in range(20):
        env.advance(fast)
    env.advance(torch.where(torch.arange(7) == 6, CLOSE, fast))
    assert (env.ends == int(End.RUNNING)).all() and (env.qd[:, 0] > 0).all()
    for _ in range(20):
        env.advance(fast)  # from now on the arm brakes
    assert (env.qd == 0).all() and (env.ends == int(End.DROP)).all()


def test_a_held_object_may_not_be_pressed_into_the_table():
    env = made(certified(2), name="replan", action="twist")
    other = made(certified(2))
    at_grasp(other)
    # the arm that stands at the grasp, with another kind of action
    env.begin()
    env.q, env.T_world_ee = other.q.clone(), other.T_world_ee.clone()
    down = torch.zeros(4, 7)
    down[:, 6] = CLOSE
    while bool((env.phase < int(Phase.LIFTS)).any()):
        env.advance(down)
    down[:, 2], down[0, 2] = -0.02, 0.05
    for _ in range(40):
        env.advance(down)
    info = env._info(None)
    assert env.phase[0] == int(Phase.CARRIES) and info["pick_reason"][0] == "ok"
    assert (info["end"][1:] == "collision").all() and (info["outcome"][1:] == "pick").all()
    assert (info["pick_reason"][1:] == "lift_collides").all()


def test_the_giving_is_asked_for_as_far_as_the_benchmark_asks(monkeypatch):
    whole = certified(2)
    inputs = whole.inputs
    asked = []
    real = tables.given

    def given(scores):
        found = real(scores)
        asked.append(tuple(found.criteria[5:]))
        passed = found.passed.clone()
        passed[0, found.criteria.index("received")] = False
        return replace(found, passed=passed)

    monkeypatch.setattr(tables, "given", given)
    for until, ends in each(
        {
            "present": ["success"] * 4,
            "received": ["received", "success", "success", "success"],
        }.items()
    ):
        asked.clear()
        ends_there = draft().until(until)
        scores = Evaluator(ends_there, KINEMATIC).score(inputs.T_obj_ee, inputs.T_world_ee, ends_there.trials(2))
        env = made(scores)
        monkeypatch.setattr(env, "_given_to", together(env, env._given_to))
        info = ended(env)
        assert info["outcome"].tolist() == ends, until
        assert bool(asked) == (until != "present")


def together(env, ask):
    """Asks for all rows at once, when the last one is held out."""
    waiting = set()

    def held(rows):
        waiting.update(rows.tolist())
        running = torch.nonzero(env.ends == int(End.RUNNING)).flatten()
        return ask(running) if waiting >= set(running.tolist()) else rows[:0]

    return held


def test_the_object_alone_may_go_as_deep_as_the_pads_give():
    """Straight down at the grasp, where the gripper itself stays clear of the table."""
    env, free = closed_at_grasp(), {}
    _, jacobian = ee_and_jacobian(env.scene.robot, env.q)
    for down_m in each((0.0003, 0.003)):
        twist = torch.zeros(4, 6, dtype=torch.float64)
        twist[:, 2] = -down_m
        turn = torch.linalg.lstsq(jacobian, twist[:, :, None]).solution[:, :, 0]
        way = torch.stack([env.q, (env.q + turn).float()], 1)
        alone = replace(env._bare(env._every), world=env._robot_alone.world)
        free[down_m] = (env._clear(alone, way), env._meets_nothing(env._every, way))
    clear, passes = free[0.003]
    assert clear.any() and not passes.any()
    clear, passes = free[0.0003]
    assert clear.any() and torch.equal(clear, passes)


@pytest.mark.parametrize("name", ["servo", "replan"])
def test_rows_do_not_depend_on_their_batch(name):
    rows = torch.tensor([5, 0])
    config = LoopConfig(horizon_s=15)
    (a, b) = (made(part, "moves", name, config=config) for part in (certified(), certified()[rows]))
    for env in (a, b):
        play(env, POLICIES[name])
    n = min(a.k, b.k) + 1
    for x, y in zip(a.trace(), b.trace(), strict=True):
        assert torch.equal(x[rows][:, :n], y[:, :n])
    assert torch.equal(a.ends[rows], b.ends) and torch.equal(a.phase[rows], b.phase)
    assert torch.equal(a._attached[rows], b._attached) and torch.equal(a._least[rows], b._least)
    assert (b.phase == int(Phase.CARRIES)).any()


def test_rows_begin_anew_while_others_hold_their_object():
    """More handovers than rows: the one that goes on keeps its object, the new one lies on the table."""
    env = made(certified(), num_envs=2, autoreset=True)
    seen = at_grasp(env)
    q = env.q.clone()
    env.advance(torch.cat([q, torch.tensor([[CLOSE], [LEAVE]])], 1))
    for _ in range(30):
        seen, *_ = env.advance(torch.cat([q, torch.zeros(2, 1)], 1))
    assert env.phase.tolist() == [int(Phase.LIFTS), int(Phase.RESTS)]
    held, opening = env._attached[0].clone(), env._opening[0].clone()
    env._finish(torch.tensor([1]), End.TIMEOUT, tables.Why.LATE)
    seen, *_ = env.advance(torch.cat([q, torch.zeros(2, 1)], 1))
    assert env._row.tolist() == [0, 2] and env.phase.tolist() == [int(Phase.LIFTS), int(Phase.RESTS)]
    assert torch.equal(env._attached[0], held) and torch.equal(env._opening[0], opening)
    assert float(env._opening[1]) == pytest.approx(env.scene.robot.open_gap_m)
    alone = made(certified()[2:3])
    fresh = alone.begin()
    for name in ("T_world_obj", "T_obj_ee", "gripper", "phase", "q"):
        assert torch.equal(seen[name][1], fresh[name][0]), name


def test_each_row_plays_with_its_own_seed():
    env = TableHandoverEnv(certified(2), "moves", config=LoopConfig(horizon_s=2))

    def seen(seed):
        first, _ = env.reset(seed=seed)
        later, *_ = env.step(np.zeros((4, 7), np.float32))
        return np.concatenate([x["T_world_hand"].reshape(4, -1) for x in (first, later)], 1)

    one, other, mixed = seen(3), seen(9), seen([3, 9, 3, 9])
    assert (mixed[::2] == one[::2]).all() and (mixed[1::2] == other[1::2]).all() and (one != other).any(1).all()


def test_the_distance_of_closing_fingers_holds_against_dense_samples():
    """A hand beside the pads: between the ends of a step the fingers come nearer than at both."""
    env = made(certified(2))
    env.begin()
    b, device = 4, env.q.device
    rows = torch.arange(b, device=device)
    T = env.T_world_ee.clone()
    looked = 0
    for ahead in (0.02, 0.05, 0.09, 0.12):
        hand = T.clone()
        hand[:, :3, 3] += ahead * T[:, :3, 2]
        distance = env._distance
        wide = torch.full((b,), env.scene.robot.open_gap_m)
        tight = torch.tensor([0.0, 0.02, 0.04, 0.06])
        way = Fixed(hand)
        now = torch.zeros(b, dtype=torch.float64)
        before = distance.at(rows, env.q, hand.float(), wide)
        passed = distance.over_step(rows, (env.q, env.q), way, (now, now + 0.05), before, (wide, tight))
        dense = torch.stack(
            [distance.at(rows, env.q, hand.float(), wide + s * (tight - wide)) for s in np.linspace(0, 1, 60)]
        )
        assert (passed.least_m <= dense.amin(0) + 1e-6).all()
        assert (passed.touch >= (dense.amin(0) <= 0)).all()
        sure = ~passed.touch
        assert (dense.amin(0)[sure] > 0).all()
        looked += int(sure.sum())
        far = distance.fingers_travel(wide, tight)
        assert (far >= (dense.diff(dim=0).abs().sum(0)) - 1e-5).all()
    assert looked >= 4


class Fixed:
    """Hands that stand."""

    def __init__(self, T):
        self.T = T

    @property
    def way(self):
        return self

    def __getitem__(self, rows):
        return Fixed(self.T[rows])

    def pose(self, time_s):
        return self.T

    def travel(self, first_s, last_s):
        return torch.zeros_like(first_s)


def test_what_does_not_fit_is_refused_and_other_benchmarks_begin_in_the_gripper():
    one = certified(1)
    with pytest.raises(ValueError, match='needs action velocity, twist or posture, not "pose"'):
        TableHandoverEnv(one, action="pose")
    with pytest.raises(ValueError, match=r"actions are \(2, 6\); they must be a tensor \(2, 7\)"):
        env = TableHandoverEnv(one)
        env.reset()
        env.step(np.zeros((2, 6), np.float32))
    plain = Evaluator(load_benchmark("r2h-v2"), KINEMATIC)
    trials = plain.benchmark.trials(1)
    eye = torch.eye(4).repeat(2, 1, 1)
    scores = plain.score(eye, eye, trials)
    with pytest.raises(ValueError, match="r2h-v2 does not ask for Pick, and its objects rest nowhere"):
        TableHandoverEnv(scores)
    assert env_class(scores) is HandoverEnv and env_class(one) is TableHandoverEnv
    moving = ReceiverMotion.parse("moves")
    assert Loop(moving, "servo", LoopConfig(), True).on(draft()).config.horizon_s == 30
    assert Loop(moving, "servo", LoopConfig(), True).on(plain.benchmark).config.horizon_s == 15
    assert Loop(moving, "servo", LoopConfig(horizon_s=9), False).on(draft()).config.horizon_s == 9


def test_gymnasiums_checker_passes():
    register()
    how = {"benchmark": "r2h-v3-draft", "method": "fc", "trials": 1}
    env = gymnasium.make(ID, config=LoopConfig(horizon_s=1), **how)
    check_env(env.unwrapped, skip_render_check=True)
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="vector_entry_point", **how)
    seen, info = envs.reset(seed=[1, 2])
    assert envs.observation_space.contains(seen) and info["outcome"].tolist() == ["", ""]
    assert envs.single_action_space.shape == (7,) and envs.config.horizon_s == 30
    single = SingleHandoverEnv(TableHandoverEnv(certified(1)[:1]))
    single.reset(seed=0)
    *_, info = single.step(np.zeros(7, np.float32))
    assert info["pick_reason"] == "not_evaluated"
