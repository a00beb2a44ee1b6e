"""Another arm goes through the whole evaluator, and no stage falls back to the UR5e."""

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.judge import ik_jacobian
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.ik_any import APART_RAD
from r2h_batch.methods.oracle import predict
from r2h_batch.runs.store import load_run
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import Robot, ee_pose
from r2h_batch.scene.robot_file import ROBOTS, load_robot, read_robot, write_robot
from r2h_batch.types import PlanReason

KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))
UR3E = load_robot("ur3e_2f85")


def test_the_closed_form_reaches_every_posture_of_another_ur() -> None:
    q = np.random.default_rng(3).uniform(UR3E.lower / 2, UR3E.upper / 2, (2000, 6))
    target = torch.from_numpy(ee_pose(UR3E, q).astype(np.float32))
    found = solve_ik(target, robot=UR3E)
    assert found.reachable.all()
    rows, slots = found.valid.nonzero(as_tuple=True)
    again = ee_pose(UR3E, found.q[rows, slots].double().numpy())
    assert np.abs(again - target[rows].double().numpy()).max() < 2e-6


def test_a_redundant_arm_gets_eight_postures_a_target_for_few_steps() -> None:
    """Postures along the self-motion of those that seeds lead to: solved from seeds alone, eight take 295 steps."""
    panda = load_robot("panda_hand")
    q = np.random.default_rng(5).uniform(panda.lower, panda.upper, (800, 7))
    target = torch.from_numpy(ee_pose(panda, q).astype(np.float32))
    found = solve_ik(target, robot=panda)
    assert int((~found.reachable).sum()) <= 1 and found.valid.sum(1).double().mean() > 7.7
    assert found.steps[:, 0].double().mean() < 100.0 and found.unproven.all()
    rows, slots = found.valid.nonzero(as_tuple=True)
    postures = found.q[rows, slots].double().numpy()
    T = ee_pose(panda, postures)
    assert np.abs(T[:, :3, 3] - target[rows, :3, 3].double().numpy()).max() < 1e-5
    assert ((panda.lower <= postures) & (postures <= panda.upper)).all()
    apart = (found.q[:, :, None] - found.q[:, None]).abs().amax(3)[:, *np.triu_indices(8, 1)]
    assert float(apart[apart.isfinite()].min()) > 0.24
    from_home = torch.where(found.valid, (found.q - torch.tensor(panda.home_q)).norm(dim=2), torch.inf).min(1).values
    by_chance = np.linalg.norm(q - panda.home_q, axis=1)
    assert float(from_home[found.reachable].mean()) < 0.8 * by_chance.mean()


@pytest.mark.parametrize(
    "robot", [pytest.param(UR3E, marks=pytest.mark.check), load_robot("panda_hand")], ids=lambda r: r.name
)
def test_the_oracle_succeeds_on_another_arm_and_its_paths_are_that_arms(robot):
    benchmark = load_benchmark("r2h-v1").on(robot)
    evaluator = Evaluator(benchmark, KINEMATIC)
    trials = benchmark.trials(2)
    answer = predict(trials, evaluator.scene, seed=0, evaluator=evaluator)
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
    assert scores.success.all()
    start, goal = scores.path[:, 0], scores.path[torch.arange(len(trials)), scores.path_len.long() - 1]
    assert torch.equal(start, torch.tensor([robot.home_q]).expand_as(start))
    assert np.abs(ee_pose(robot, goal.double().numpy())[:, :3, 3] - answer.T_world_ee[:, :3, 3].numpy()).max() < 1e-5
    ur5e = Evaluator(load_benchmark("r2h-v1"), KINEMATIC)
    usual = ur5e.score(answer.T_obj_ee, answer.T_world_ee, trials.named(ur5e.scene.objects))
    assert not torch.equal(usual.path[:, 0], start)
    compiled = torch.compile(evaluator.score, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(answer.T_obj_ee, answer.T_world_ee, trials).path, scores.path)


@pytest.mark.parametrize("robot", [UR3E, load_robot("panda_hand")], ids=lambda r: r.name)
def test_each_joint_of_a_given_motion_has_its_own_limit_of_speed(robot: Robot) -> None:
    evaluator, n = Evaluator(load_benchmark("r2h-v1").on(robot), KINEMATIC), len(robot.joints)
    trials = load_benchmark("r2h-v1").on(robot).trials(n)[:n]
    grasp = torch.eye(4).repeat(n, 1, 1)
    q = torch.tensor(robot.home_q).repeat(n, 2, 1)
    q[:, 1] += 0.05 * torch.eye(n)
    least_s = 0.05 / torch.tensor(robot.max_velocity.tolist())[:, None] * torch.tensor([0.0, 1.0])
    for share, fast in ((1.01, False), (0.99, True)):
        reason = evaluator.score_motion(grasp, q, share * least_s, trials).plan_reason
        assert ((reason == int(PlanReason.BEYOND_SPEED_LIMITS)) == fast).all()
    with pytest.raises(ValueError, match=rf"must be \({n}, W, {n}\)"):
        evaluator.score_motion(grasp, q[..., 1:], least_s, trials)


def test_objects_that_are_too_heavy_for_an_arm_are_named_and_a_payload_is_no_other_robot(tmp_path: Path) -> None:
    """Data sheets' payloads, less the mass of the gripper."""
    arms = [load_robot(name) for name in ROBOTS]
    np.testing.assert_allclose([arm.carries_kg for arm in arms], [3.95, 1.95, 11.45, 2.24])
    objects = [replace(o, mass=kg) for o, kg in zip(load_objects()[:2], (2.0, 2.3), strict=True)]
    with pytest.warns(UserWarning, match=r"1 of 2 objects are heavier than the 2.24 kg that panda_hand carries"):
        Evaluator(load_benchmark("r2h-v1").on(arms[3]).with_objects(objects), KINEMATIC)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Evaluator(load_benchmark("r2h-v1").with_objects(objects), KINEMATIC)
    write_robot(tmp_path, replace(arms[3], payload_kg=None))
    again = read_robot(tmp_path)
    assert again == arms[3] and again.carries_kg == np.inf


def test_persons_stand_for_the_robot_or_as_for_the_ur5e() -> None:
    usual = load_benchmark("r2h-v1").trials(4)
    same = load_benchmark("r2h-v1").on(UR3E, "as-for-ur5e").trials(4)
    own = load_benchmark("r2h-v1").on(UR3E).trials(4)
    assert torch.equal(usual.T_world_hand, same.T_world_hand)
    assert own.T_world_hand[:, 0, 3].mean() < 0.8 * usual.T_world_hand[:, 0, 3].mean()
    digests = {
        b.digest
        for b in (
            load_benchmark("r2h-v1"),
            load_benchmark("r2h-v1").on(UR3E),
            load_benchmark("r2h-v1").on(UR3E, "as-for-ur5e"),
        )
    }
    named_alike = replace(UR3E, name=load_robot().name)
    digests |= {replace(load_benchmark("r2h-v1"), robot=named_alike).digest}
    assert len(digests) == 4


def test_a_run_of_a_built_in_robot_is_opened_without_saying_which(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(tmp_path / "run")
    line = [
        "sweep",
        "--robot",
        "ur3e_2f85",
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "--trials",
        "2",
        "--execute.sim",
        "none",
        "--out",
        run,
    ]
    assert main(line) == 0
    assert "--robot ur3e_2f85" in load_run(run).header["benchmark"]["flags"]
    capsys.readouterr()
    assert main(["results", "reevaluate", run]) == 0
    said = capsys.readouterr().out
    assert "random: 4 of 4 rows judged again" in said and "none differs, 4 are equal bit for bit" in said
    assert main(["results", "reevaluate", run, "--robot", "ur5e_2f85"]) == 2
    assert "results reevaluate --robot: r2h_batch 0.3 had it" in capsys.readouterr().err


def test_pytorch_kinematics_finds_the_pandas_postures_by_itself(monkeypatch):
    monkeypatch.setattr(ik_jacobian, "ROWS", 24)  # what is short is filled up, to 512
    robot = load_robot("panda_hand")
    q = np.random.default_rng(5).uniform(robot.lower, robot.upper, (24, 7))
    T = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    T[-1, :3, 3] += 5.0
    found, kernel = ik_jacobian.solve_ik(T, robot=robot), solve_ik(T, robot=robot)
    assert torch.equal(found.reachable, kernel.reachable) and int(found.reachable.sum()) == 23
    assert torch.equal(found.unreachable_proven, kernel.unreachable_proven) and bool(found.unreachable_proven[-1])
    assert float(found.valid[:-1].sum(1).double().mean()) > 4
    for i in range(23):
        own = found.q[i][found.valid[i]].double().numpy()
        assert np.abs(ee_pose(robot, own) - T[i].numpy()).max() < 2e-5
        assert (own >= robot.lower).all() and (own <= robot.upper).all()
        apart = np.abs(own[:, None] - own[None]).max(2) + np.eye(len(own))
        assert apart.min() >= APART_RAD
    some = ik_jacobian.solve_ik(T[3:5], robot=robot)
    assert torch.equal(some.q.nan_to_num(), found.q[3:5].nan_to_num())


def test_pytorch_kinematics_finds_the_branches_of_a_ur_that_was_imported(monkeypatch):
    monkeypatch.setattr(ik_jacobian, "ROWS", 4)
    robot = load_robot("ur10e_2f85")
    q = np.random.default_rng(5).uniform(-3, 3, (6, 6))
    T = torch.from_numpy(ee_pose(robot, q).astype(np.float32))
    found, exact = ik_jacobian.solve_ik(T, robot=robot), solve_ik(T, robot=robot)
    assert torch.equal(found.valid, exact.valid) and bool(found.reachable.all())
    assert float((found.q - exact.q)[found.valid].abs().max()) < 1e-4


@pytest.mark.check
def test_pages_print_how_far_the_default_robots_mesh_protrudes() -> None:
    root = Path(__file__).resolve().parents[1]
    report = json.loads((root / "assets" / "robot" / "report.json").read_text())["links"]
    beyond = {name: row["worst_protrusion_mm"] for name, row in report.items()}
    arm = max(v for name, v in beyond.items() if name in load_robot().links)
    gripper = max(v for name, v in beyond.items() if name not in load_robot().links)
    choices, robots = ((root / "docs" / f"{name}.md").read_text() for name in ("choices", "robots"))
    assert f"at most {arm:.2f} mm on the arm and {gripper:.2f} mm on the gripper" in choices
    assert f"2.95 mm | {arm:.2f} mm |" in robots and f"protrudes by at most {gripper:.2f} mm" in robots
