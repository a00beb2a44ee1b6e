"""Witnesses of the gripper's kernels against float64 twins: nearest and deepest points, and what closing pads stand on."""

import numpy as np
import pytest
import torch
from convex_twin import bodies, convex_distance, primitive_distance
from problems import default_evaluator
from scipy.optimize import linprog
from slopes import candidates

from r2h_batch import se3, twist
from r2h_batch.bodies.robot import Kind, gripper_primitives_at, load_robot
from r2h_batch.judge.grasp import attach, close_gripper, region_distance, squeezed
from r2h_batch.training import first_order, witnesses

Array = np.ndarray


@pytest.fixture(scope="module")
def held():
    """Grasps of S1 objects: attachment, object, the fingers' opening and their distance to the region."""
    evaluator = default_evaluator()
    batch = candidates(evaluator, 300, seed=17)
    rows = torch.nonzero(evaluator.scene.grasp_tables.has_region[batch.trials.object_index.long()]).flatten()
    T_obj_ee, objects = batch.T_obj_ee[rows].contiguous(), batch.trials.object_index[rows].contiguous()
    grasp = close_gripper(evaluator.scene.grasp_tables, T_obj_ee, objects)
    attached, opening = attach(T_obj_ee, grasp.shift_m), squeezed(grasp, evaluator.config.thresholds)
    distance, _ = region_distance(evaluator.scene.grasp_tables, attached, objects, opening)
    return attached, objects, opening, distance


def deepest(size: Array, triangle: Array) -> float:
    """Largest depth of a triangle's points in a box: a linear program (negative: the triangle is outside)."""
    sides = np.concatenate([triangle.T, -triangle.T])  # +-x = triangle^T lambda
    rows = np.concatenate([sides, np.ones((6, 1))], 1)
    found = linprog(
        [0, 0, 0, -1],
        rows,
        np.tile(size, 2),
        [[1, 1, 1, 0]],
        [1],
        bounds=[(0, None)] * 3 + [(None, None)],
        method="highs",
    )
    return -float(found.fun)


def signed(size: Array, triangle: Array) -> float:
    """Least signed distance of a triangle's points to a box at the origin."""
    depth = deepest(size, triangle)
    if depth > 0:
        return -depth
    a, b = bodies([Kind.BOX], [size], np.eye(4)[None]), bodies([Kind.HULL], None, np.eye(4)[None], triangle[None])
    return float(convex_distance(a, b, gap=1e-12)[1][0])


def contenders(triangles: Array, opening: float) -> list[tuple[Array, Array, Array]]:
    """Boxes (T_ee_box, size) of the fingers and triangles (ee frame) that may decide the clearance."""
    robot, pairs = load_robot(), []
    for i, T in enumerate(gripper_primitives_at(robot, opening)):
        if robot.gripper_motion[i] != "fixed":
            assert robot.gripper.kind[i] == Kind.BOX
            inverse = np.linalg.inv(T)
            local = triangles @ inverse[:3, :3].T + inverse[:3, 3]
            center = local.mean(1)
            radius = np.linalg.norm(local - center[:, None], axis=2).max(1)
            lower = primitive_distance(Kind.BOX, robot.gripper.size[i], center) - radius
            upper = primitive_distance(Kind.BOX, robot.gripper.size[i], local).min(1)
            pairs += [
                (lower[k], upper[k], inverse, robot.gripper.size[i], triangles[k], local[k]) for k in range(len(local))
            ]
    best = min(upper for _, upper, *_ in pairs)
    values = []
    for lower, _, inverse, size, triangle, local in sorted(pairs, key=lambda pair: pair[0]):
        if lower > best + 2e-5:
            break
        value = signed(size, local)
        best = min(best, value)
        values.append((value, (inverse, size, triangle)))
    return [pair for value, pair in values if value < best + 2e-5]


def clearance(pairs: list[tuple[Array, Array, Array]], shift: Array) -> float:
    """Least signed distance of the pairs when the triangles are moved by `shift` (ee frame)."""
    return min(signed(size, (triangle + shift) @ T[:3, :3].T + T[:3, 3]) for T, size, triangle in pairs)


@pytest.mark.parametrize("overlapping", [False, True])
def test_the_regions_witness_has_the_slope_of_the_exact_distance(held, overlapping):
    attached, objects, opening, distance = held
    wanted = (distance < -1e-4) if overlapping else (distance > 1e-4) & (distance < 0.02)
    contact = witnesses.fingers(default_evaluator().scene, attached, objects, opening, distance, wanted, region=True)
    assert torch.equal(contact.found, wanted)
    kinks, rows = 0, torch.nonzero(wanted).flatten()[:6].tolist()
    assert len(rows) == 6
    for i in rows:
        model = default_evaluator().scene.objects[int(objects[i])]
        T = np.linalg.inv(attached[i].double().numpy())
        triangles = model.vertices[model.faces[model.receiver_face]].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        pairs, step = contenders(triangles, float(opening[i])), 2e-6
        here = clearance(pairs, np.zeros(3))
        assert abs(here - float(distance[i])) < 8e-6
        sides = np.array([[clearance(pairs, s * step * np.eye(3)[k]) for s in (1, -1)] for k in range(3)])
        if np.abs(sides.sum(1) - 2 * here).max() > 0.02 * step:
            kinks += 1
        else:
            np.testing.assert_allclose(
                contact.normal_ee[i].numpy(), (sides[:, 0] - sides[:, 1]) / (2 * step), atol=0.01
            )
    assert kinks <= 3


def test_pads_stand_on_points_of_the_surface_whose_distance_is_the_width(held):
    _, objects, _, _ = held
    evaluator = default_evaluator()
    batch = candidates(evaluator, 200, seed=19)
    objects = batch.trials.object_index
    grasp = close_gripper(evaluator.scene.grasp_tables, batch.T_obj_ee, objects)
    found = witnesses.closing(evaluator.scene, batch.T_obj_ee, objects, grasp.width_m, grasp.opening_m)
    x = se3.apply(se3.inverse(batch.T_obj_ee)[:, None], found.point_obj)
    held_rows = ~grasp.empty
    between = x[:, 3, 1] - x[:, 2, 1]
    assert (between - grasp.width_m)[held_rows].abs().max() < 1e-4
    assert (between - grasp.width_m)[held_rows].abs().median() < 1e-6
    for i in torch.nonzero(held_rows).flatten()[:10].tolist():
        mesh = evaluator.scene.objects[int(objects[i])].mesh
        assert np.abs(mesh.nearest.on_surface(found.point_obj[i].double().numpy())[1]).max() < 1e-6


def test_the_arms_inverse_jacobian_moves_the_ee_as_asked():
    scene = default_evaluator().scene
    g = torch.Generator().manual_seed(0)
    q = (torch.rand((40, 6), generator=g) * 2 - 1) * torch.tensor([3.0, 1.5, 2.5, 3.0, 3.0, 3.0])
    arm = witnesses.arm_at(scene, q)
    from r2h_batch.bodies.robot import ee_pose

    q0 = q.double().numpy()
    T = ee_pose(scene.robot, q0)
    regular = 0
    for k in range(6):
        asked = np.eye(6)[k]
        rate = arm.inverse[:, :, k].double().numpy()
        moved = (ee_pose(scene.robot, q0 + 1e-5 * rate) - ee_pose(scene.robot, q0 - 1e-5 * rate)) / 2e-5
        turn = moved[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
        got = np.concatenate([moved[:, :3, 3], np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], 1)], 1)
        error = np.abs(got - asked).max(1)
        regular += int((error < 2e-3).sum())
        assert np.isfinite(rate).all()
    assert regular > 0.9 * 240


def test_a_contact_moves_with_the_fingers_as_the_linkage_does():
    robot, scene = load_robot(), default_evaluator().scene
    parts = torch.arange(len(robot.gripper.names), dtype=torch.int32)
    opening = torch.full((len(parts),), 0.04)
    T = gripper_primitives_at(robot, 0.04)
    point = T[:, :3, 3] + T[:, :3, 0] * 0.003
    velocity = witnesses.finger_motion(scene, parts, opening, torch.from_numpy(point).float())
    ahead, behind = gripper_primitives_at(robot, 0.04 + 1e-6), gripper_primitives_at(robot, 0.04 - 1e-6)
    local = np.einsum("nji,nj->ni", T[:, :3, :3], point - T[:, :3, 3])
    moved = (ahead - behind) / 2e-6
    expected = np.einsum("nij,nj->ni", moved[:, :3, :3], local) + moved[:, :3, 3]
    np.testing.assert_allclose(velocity.numpy(), expected, atol=1e-4)
    assert twist.exp(torch.zeros(1, 6)).isfinite().all() and first_order.FIXED == -1
