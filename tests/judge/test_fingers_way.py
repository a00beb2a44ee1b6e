"""Closing fingers: how far they come, how low they are, what they meet; and the least clearance of a way."""

from collections import Counter
from functools import cache

import numpy as np
import pytest
import torch
from problems import kinematic_evaluator
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.judge.fingers_way import PARTS, fingers_way, gripper_radii, heights
from r2h_batch.judge.grasp import gripper_poses, open_clearance, way_in_clearance
from r2h_batch.judge.least import SHARE, TOLERANCE_M, least_along
from r2h_batch.judge.straight_way import WAY_M, gripper_lever_m
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.runs.store import load_run
from r2h_batch.scene.robot import ShapeKind, ee_pose, gripper_primitives_at


@cache
def scene():
    return kinematic_evaluator("r2h-v2").scene


@pytest.mark.check
def test_the_least_of_a_way_is_found_to_the_tolerance_with_few_questions():
    """|s - c| + floor: as steep as a way of 1 m allows. And a constant one, which is asked no finer than a tenth of it."""
    c, floor = torch.tensor([0.3217, 0.9999, 0.0, 0.5]), torch.tensor([0.004, -0.02, 0.001, 1.0])
    asked_for = Counter()

    def measure(row, s):
        asked_for.update(row.tolist())
        return (s - c[row]).abs() + floor[row]

    def travel(row, low, middle, high):
        return torch.maximum(middle - low, high - middle)

    rows = torch.tensor([0, 1, 3])
    best, where = least_along(measure, travel, rows, 4, parts=8, cap_m=0.01)
    assert float(best[2]) == pytest.approx(0.01) and 2 not in asked_for and float(best[3]) == pytest.approx(0.01)
    for i, allowed in each(((0, 4e-4), (1, 2e-3))):
        assert floor[i] - 1e-7 <= best[i] <= floor[i] + allowed + 1e-7
        assert abs(where[i] - c[i]) <= allowed + 1e-6
    assert max(asked_for.values()) < 60


@pytest.mark.check
def test_an_interval_whose_floor_is_high_enough_is_not_asked_again():
    """The same least value as without floors, by fewer questions; a floor that says nothing changes none."""
    c, lift = torch.tensor([0.3217, 0.71]), torch.tensor([0.004, 0.002])
    asked_for = Counter()

    def measure(row, s):
        asked_for.update(row.tolist())
        return (s - c[row]).abs() + lift[row]

    def travel(row, low, middle, high):
        return 3 * torch.maximum(middle - low, high - middle)  # as if it could

    def true(row, low, high):
        return torch.maximum(torch.maximum(low - c[row], c[row] - high), torch.zeros_like(low)) + lift[row]

    def least(floor):
        asked_for.clear()
        found = least_along(measure, travel, torch.tensor([0, 1]), 2, parts=1, cap_m=1.0, floor=floor)
        return *found, asked_for.total()

    plain, nothing, helped = least(None), least(lambda row, low, high: torch.full_like(low, -9.0)), least(true)
    assert all(torch.equal(x, y) for x, y in zip(plain[:2], nothing[:2], strict=True)) and plain[2] == nothing[2]
    assert helped[2] < 0.7 * plain[2]
    assert (lift - 1e-7 <= helped[0]).all() and (helped[0] <= lift / (1 - SHARE) + 1e-6).all()


def lowest(robot, T_world_ee, gap_m):
    """World z of the lowest point of the gripper, in float64, from the host's own description of it."""
    low, shapes = np.inf, robot.gripper
    for kind, size, T in zip(shapes.kind, shapes.size, gripper_primitives_at(robot, gap_m), strict=True):
        T = T_world_ee @ T
        down = -T[2, :3]  # the world's -z in the primitive's frame
        if kind == ShapeKind.BOX:
            corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * size
            far = (corners @ down).max()
        else:
            far = size[0] * (1.0 if kind != ShapeKind.CYLINDER else np.hypot(down[0], down[1]))
            far += 0.0 if kind == ShapeKind.SPHERE else size[1] * abs(down[2])
        low = min(low, T[2, 3] - far)
    return low


def test_no_closing_finger_is_lower_on_a_part_of_its_way_than_is_said_nor_much_higher():
    s, rng, n = scene(), np.random.default_rng(5), 24
    robot, place = s.robot, s.config.workplace
    q = torch.from_numpy(rng.uniform(-2, 2, (n, len(robot.joints))).astype(np.float32))
    start = torch.from_numpy(rng.uniform(0.03, robot.open_gap_m, n).astype(np.float32))
    end = torch.from_numpy(rng.uniform(robot.closed_gap_m, 0.03, n).astype(np.float32))
    said = heights(s, q, start, end)
    top = place.table_center[2] + place.table_half[2]
    slack = []
    for i in each(range(n)):
        T = ee_pose(robot, q[i].double().numpy())
        for part in range(0, PARTS, 5):
            share = (part + np.linspace(0, 1, 9)) / PARTS
            gaps = float(start[i]) + share * (float(end[i]) - float(start[i]))
            true = min(lowest(robot, T, g) for g in gaps) - top
            slack.append(true - float(said.least_m[i, part]))
    assert min(slack) >= 0 and max(slack) < 2e-4, (min(slack), max(slack))
    # of an interval: the least of the parts that it meets
    row = torch.arange(n)
    for low, high, parts in each(((0.0, 1.0, slice(0, 16)), (0.26, 0.31, slice(4, 5)), (0.5, 0.5625, slice(8, 9)))):
        got = said.within(row, torch.full((n,), low), torch.full((n,), high))
        assert torch.equal(got, said.least_m[:, parts].amin(1))


@cache
def stored_grasps():
    """Some stored grasps of r2h-v2 of each method, and their objects."""
    run = load_run(next(f for f in stored_rows() if f.name == "r2h-v2"))
    rows = [r for e in run.entries for r in run.poses(e.name).slice(0, 12).to_pylist()]
    trials = load_benchmark("r2h-v2").trials_with_ids(torch.tensor([r["trial_id"] for r in rows]))
    return torch.tensor([r["T_obj_ee"] for r in rows]).reshape(-1, 4, 4), trials.object_index


def test_the_clearance_on_the_way_in_is_the_least_of_four_hundred_places_on_it():
    s, (grasp, objects) = scene(), stored_grasps()
    # whose palm or fingers enter the object, and that pass it sideways
    for along, across in ((0.03, 0.01), (0.07, 0.075)):
        moved = grasp[:36].clone()
        moved[:, :3, 3] += along * moved[:, :3, 2] + across * moved[:, :3, 1]
        grasp, objects = torch.cat([grasp, moved]), torch.cat([objects, objects[:36]])
    n, tables = len(grasp), s.grasp_tables
    options = {"way_m": WAY_M, "tolerance_m": TOLERANCE_M, "share": SHARE}
    cap = torch.full((n,), 0.01)
    found, witness = way_in_clearance(tables, grasp, objects, cap, **options)
    share = torch.linspace(0, 1, 401)
    T = grasp[:, None].repeat(1, len(share), 1, 1)
    T[:, :, :3, 3] -= WAY_M * (1 - share)[None, :, None] * grasp[:, None, :3, 2]
    every, by = open_clearance(tables, T.flatten(0, 1).contiguous(), objects.repeat_interleave(len(share)), cap_m=0.01)
    true, at = every.view(n, -1).min(1)
    between = (at > 20) & (at < 380) & (true < torch.minimum(every.view(n, -1)[:, 0], every.view(n, -1)[:, -1]) - 1e-3)
    assert between.sum() > 5
    allowed = (SHARE * true.abs()).clamp(min=TOLERANCE_M)
    step = 0.5 * WAY_M / 400  # samples see no more
    assert (found <= true + allowed + 1e-6).all() and (found >= true - step - 1e-6).all()
    assert (true < 0).sum() > 3 and ((true > 0) & (true < 0.01)).sum() > 20 and (found == 0.01).sum() > 3
    assert ((witness < 0) == (found == 0.01)).all()
    # many are as near in the middle of their way as at its end: the places differ, and so may the bodies
    own = by.view(n, -1).gather(1, at[:, None])[:, 0]
    assert (own == witness)[true < 0.009].double().mean() > 0.8
    # a cap of each row's own: below it nothing changes by more than the tolerance, beyond it nobody is named
    cap = torch.from_numpy(np.random.default_rng(1).uniform(0, 0.01, n).astype(np.float32))
    capped, who = way_in_clearance(tables, grasp, objects, cap, **options)
    below = true < cap - allowed - step
    assert below.sum() > 10 and ((capped - found).abs() <= 2 * allowed + step)[below].all()
    assert ((capped == cap) == (who < 0)).all() and (capped == cap)[true > cap].all() and (true > cap).sum() > 10
    # a row does not depend on the others
    order = torch.from_numpy(np.random.default_rng(0).permutation(n))
    again, _ = way_in_clearance(tables, grasp[order], objects[order], cap[order], **options)
    assert torch.equal(again, capped[order])


def test_no_point_of_the_gripper_is_farther_than_its_lever_and_radii():
    s, g = scene(), scene().robot.gripper
    lever, radii = gripper_lever_m(s), gripper_radii(s).numpy()
    for gap in each((s.robot.open_gap_m, 0.03, s.robot.closed_gap_m)):
        for i, T in each(enumerate(gripper_primitives_at(s.robot, gap))):
            corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
            size = g.size[i]
            half = {0: [size[0]] * 3, 1: [size[0], size[0], size[0] + size[1]], 2: [size[0], size[0], size[1]]}.get(
                int(g.kind[i]), size
            )
            # corners of a box overstate round bodies by at most the square root of two across
            points = (
                corners * np.array(half)
                if int(g.kind[i]) == 3
                else np.diag(half).repeat(2, 0) * np.tile([[1], [-1]], (3, 1))
            )
            assert np.linalg.norm(points, axis=1).max() <= radii[i] + 1e-6
            assert np.linalg.norm(points @ T[:3, :3].T + T[:3, 3], axis=1).max() <= lever + 1e-6


def test_no_point_of_the_gripper_goes_farther_between_two_openings_than_the_fingers_way():
    s, rng = scene(), np.random.default_rng(3)
    gap, radii = s.robot.open_gap_m, gripper_radii(s).numpy()
    first = rng.uniform(0, gap, 400)
    last = np.clip(first + rng.choice([-1, 1], 400) * gap * 10 ** rng.uniform(-3.5, 0, 400), 0, gap)
    first, last = (torch.from_numpy(x.astype(np.float32)) for x in (first, last))
    (R0, p0), (R1, p1) = (tuple(x.double().numpy() for x in gripper_poses(s.robot, x)) for x in (first, last))
    directions = np.array(np.meshgrid(*[(-1, 0, 1)] * 3)).reshape(3, -1).T
    directions = directions[np.abs(directions).sum(1) > 0]
    ends = directions / np.linalg.norm(directions, axis=1)[:, None]
    moved = np.zeros(400)
    for i in each(range(len(radii))):  # points as far from the middle as any of the primitive
        go = (R1[:, i] - R0[:, i]) @ (radii[i] * ends.T) + (p1 - p0)[:, i, :, None]
        moved = np.maximum(moved, np.linalg.norm(go, axis=1).max(1))
    way = (fingers_way(s).at(last) - fingers_way(s).at(first)).abs().numpy()
    assert (moved <= 1.001 * way + 2e-7).all()
    far = way > 1e-3
    assert far.sum() > 100 and np.median(way[far] / moved[far]) < 1.2  # not far beyond what they go
