"""Trials of the authors' release: nine of its bundled fixtures, rebuilt from their numbers, get the flags it publishes."""

import csv
import json
import random
from dataclasses import replace

import fcl
import numpy as np
import pytest
import torch
import trimesh
from grasp_cases import model_of
from odd_fields import outcome, with_odd
from scipy.optimize import least_squares
from sweep_command import in_process

from r2h_batch import EvalConfig, Evaluator
from r2h_batch.__main__ import main
from r2h_batch.data.release import read_trials
from r2h_batch.judge.grasp import region_distance
from r2h_batch.runs.store import load_run
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.objects import object_digest
from r2h_batch.scene.robot import Primitives, ShapeKind, slide_table, table_linkage
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.trials.yaml_file import read_benchmark
from r2h_batch.types import Outcome
from r2h_batch.verdicts import CRITERIA
from r2h_batch.view.export.region_boxes import region_as_boxes

# Denavit-Hartenberg parameters of the UR5e (Universal Robots); the release puts the base at z = 0.75 m
A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
HOME, GOAL = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0), (0.25, -1.10, 1.45, -1.90, -1.57, 0.25)
TOP = np.diag([1.0, -1.0, -1.0])
FROM_X = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
OBJECTS = {  # two boxes (centre, half extents), the part that people use first; tip of the grasp from above, and from +x
    "hammer": ([((0, 0, -0.07), (0.014, 0.014, 0.08)), ((0, 0, 0.035), (0.07, 0.025, 0.025))], 0.060, 0.014),
    "screwdriver": ([((0, 0, -0.075), (0.019, 0.019, 0.055)), ((0, 0, 0.04), (0.004, 0.004, 0.065))], 0.105, 0.019),
    "bottle": ([((0, 0, -0.025), (0.035, 0.035, 0.075)), ((0, 0, 0.075), (0.014, 0.014, 0.025))], 0.100, 0.035),
}
REACH_MM = {"hammer": (69.0, -70.576), "screwdriver": (74.0, -80.943), "bottle": (90.0, -51.483)}
"""Margins of the release's own evaluator at the goal, and where the arm stayed at home."""
TIPS = 0.01875
"""Our TCP stands so far behind the finger tips."""
MATCHED = 0.051953
"""`T_tcp_asset_tool` along z with which the release's tool is our gripper's finger tips."""


def shift(z):
    T = np.eye(4)
    T[2, 3] = z
    return T


def tcp(q):
    T = shift(0.75)
    for theta, a, d, alpha in zip(q, A, D, ALPHA):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return T @ shift(0.12)


def box(T, center, half):
    return {"center": (T @ [*center, 1])[:3].tolist(), "half_extents": list(half), "rotation": T[:3, :3].tolist()}


def posture_at(point, tool):
    """Joints with the tool's tip at a point, near GOAL."""
    reached = least_squares(lambda q: (tcp(q) @ shift(tool))[:3, 3] - point, GOAL, xtol=1e-12, ftol=1e-12)
    assert np.abs(reached.fun).max() < 1e-6
    return reached.x


def between(a, b, n):
    u = np.linspace(0, 1, n)[:, None]
    return np.array(a) + (3 * u**2 - 2 * u**3) * (np.array(b) - a)


def fixture(name, variant, tool=0.0, frames=30):
    boxes, top, side = OBJECTS[name]
    grasp = np.eye(4)
    if variant == "region_agnostic":
        grasp[:3, :3], grasp[:3, 3] = FROM_X, (side, 0, boxes[0][0][2])
    else:
        grasp[:3, :3], grasp[2, 3] = TOP, top
    target = tcp(GOAL) @ shift(tool)
    T_world_object = target @ np.linalg.inv(grasp)
    palm = T_world_object @ [-0.075, 0, boxes[0][0][2], 1]
    # hand: palm, four fingers, thumb
    parts = [((-0.105, 0), (0.025, 0.038, 0.012)), ((-0.085, -0.047), (0.018, 0.008, 0.01))]
    parts += [((-0.062, y), (0.018, 0.006, 0.009)) for y in (-0.027, -0.009, 0.009, 0.027)]
    hand = [box(T_world_object, (*xy, boxes[0][0][2]), half) for xy, half in parts]
    planned = executed = between(HOME, GOAL, frames)
    if variant == "missed_delivery":
        executed = np.repeat(planned[:1], frames, 0)
    if variant == "execution_deviation":
        astray = posture_at(hand[0]["center"], tool)
        executed = np.concatenate([between(HOME, astray, frames // 2), between(astray, GOAL, frames // 2)[1:]])
    named = [{"center": list(c), "half_extents": list(h), "label": "part"} for c, h in boxes]
    return {
        "schema_version": "handover.trial.v1", "units": "m", "id": f"{name}_{variant}", "object_id": name,
        "variant": variant, "split": "S0" if name == "bottle" else "S1", "T_object_gripper": grasp.tolist(),
        "target_T_world_gripper": target.tolist(),
        "object_boxes": named, "usage_boxes": named[:1], "hand_boxes_world": hand,
        "palm_position_world": palm[:3].tolist(), "palm_normal_world": T_world_object[:3, 0].tolist(),
        "reach_offset_m": 0.12, "reach_radius_m": 0.10, "max_opening_m": 0.085, "dt_s": 1 / 60,
        "planned_joints": planned.tolist(), "executed_joints": executed.tolist(), "T_tcp_asset_tool": shift(tool).tolist(),
    }  # fmt: skip


def written(folder, trials):
    folder.mkdir()
    for t in trials:
        (folder / f"{t['id']}.json").write_text(json.dumps(t))
    return folder


def imported(folder, trials):
    written(folder / "in", trials)
    assert main(["import", "trials", str(folder / "in"), "--from", "r2handoversim", "--out", str(folder / "out")]) == 0
    with (folder / "out" / "trials.csv").open() as file:
        names = {int(row["trial_id"]): row["id"] for row in csv.DictReader(file)}
    benchmark = read_benchmark(folder / "out" / "benchmark.yaml")
    evaluator = Evaluator(benchmark, EvalConfig(width="whole")).kinematic
    return names, benchmark, evaluator, np.load(folder / "out" / "predictions.npz")


def swept(source, out, *more):
    """The rows of a sweep over such files by their ids, and the run."""
    done = in_process("--trials-from", source, "--execute.sim", "none", "--width", "whole", *more, "--out", out)
    assert done.returncode == 0, done.stderr
    run = load_run(out)
    return {run.labels[r["trial_id"]][0]: r for r in run.trials("r2handoversim").to_pylist()}, run


def test_fixtures_get_the_margins_and_flags_that_the_release_publishes(tmp_path):
    variants, column = ("intent_aware", "region_agnostic", "missed_delivery"), CRITERIA.index
    names, benchmark, evaluator, poses = imported(tmp_path, [fixture(n, v) for n in OBJECTS for v in variants])
    ids, *T = (torch.from_numpy(poses[k]) for k in ("trial_id", "T_obj_ee", "T_world_ee"))
    scores = evaluator.score(*T, benchmark.trials_with_ids(ids))
    rows = {names[i]: scores[k] for k, i in enumerate(ids.tolist())}
    for name in OBJECTS:
        for variant in variants:
            row, missed = rows[f"{name}_{variant}"], variant == "missed_delivery"
            passed, margin = row.passed.flatten(), row.margin.flatten()
            assert passed[column("stability")], (name, variant)
            assert float(margin[column("reach")]) * 1e3 == pytest.approx(REACH_MM[name][missed], abs=1.5e-3)
            if name != "bottle":
                # hammer from +x: the release's box fingers stand 50 mm apart (the width of the head), ours 28 mm (the handle)
                assert bool(passed[column("affordance")]) == (variant != "region_agnostic"), (name, variant)
            if missed:
                assert row.outcome == int(Outcome.REACH)
    # no file names an obstacle, so nothing stands below what is held from above at the goal
    assert rows["screwdriver_intent_aware"].outcome == int(Outcome.SUCCESS)
    assert rows["bottle_region_agnostic"].outcome == int(Outcome.SUCCESS)
    assert rows["screwdriver_region_agnostic"].outcome == int(Outcome.AFFORDANCE)


VARIANTS = ("intent_aware", "region_agnostic", "execution_deviation", "missed_delivery")


def published(name, variant):
    """The flags and the first failure that the release publishes for a fixture; in S0 no Affordance."""
    flags = dict.fromkeys(CRITERIA, True) | {"affordance": None if name == "bottle" else True}
    failure = {"execution_deviation": "safe", "missed_delivery": "reach"}.get(variant)
    if variant == "region_agnostic" and name == "screwdriver":
        failure = "affordance"
    return (flags | {failure: False} if failure else flags), failure or "success"


def agreeing(rows):
    """How many fixtures have the published flag, criterion by criterion, and the published first failure."""
    count = dict.fromkeys((*CRITERIA, "first failure"), 0)
    for name in OBJECTS:
        for variant in VARIANTS:
            row, (flags, failure) = rows[f"{name}_{variant}"], published(name, variant)
            for c in CRITERIA:
                count[c] += flags[c] is not None and row[f"passed_{c}"] == flags[c]
            count["first failure"] += row["outcome"] == failure
    return count


def test_twelve_fixtures_as_they_are_agree_with_the_release_by_the_preset_alone(tmp_path, capsys):
    """Their tool is 52 mm shorter than ours: no given motion can be judged, each is named, and Safe sees ours.

    One more flag differs: the release spreads the hammer's fingers by the whole head (50 mm), ours touch the handle (28 mm).
    """
    trials = [fixture(name, v, frames=90) for name in OBJECTS for v in VARIANTS]
    assert all("obstacle_boxes_world" not in t and np.array_equal(t.pop("T_tcp_asset_tool"), np.eye(4)) for t in trials)
    source, out = written(tmp_path / "in", trials), tmp_path / "run"
    done = in_process("--trials-from", source, "--preset", "release", "--out", out)
    assert done.returncode == 0, done.stderr
    run = load_run(out)
    rows = {run.labels[r["trial_id"]][0]: r for r in run.trials("r2handoversim").to_pylist()}
    agreed = {"stability": 12, "plan": 12, "reach": 12, "affordance": 7, "safe": 9, "first failure": 8}
    assert agreeing(rows) == agreed
    left_out = run.header["motions_left_out"]
    assert (
        left_out.keys() == {t["id"] for t in trials}
        and "it is another tool's motion" in left_out["hammer_intent_aware"]
    )
    assert (
        "12 executed motions are left out and planned anew" in done.stdout
    )  # the short table's note, without the names
    capsys.readouterr()
    assert main(["report", str(out), "--full"]) == 0
    for text in (" ".join((out / "log.txt").read_text().split()), " ".join(capsys.readouterr().out.split())):
        assert "executed motions are left out and planned anew" in text and all(t["id"] in text for t in trials)


def test_twelve_fixtures_with_our_tool_have_the_motions_of_the_release_judged(tmp_path):
    trials = [fixture(name, v, tool=MATCHED, frames=90) for name in OBJECTS for v in VARIANTS]
    done = in_process(
        "--trials-from", written(tmp_path / "in", trials), "--preset", "release", "--out", tmp_path / "run"
    )
    assert done.returncode == 0, done.stderr
    run = load_run(tmp_path / "run")
    rows = {run.labels[r["trial_id"]][0]: r for r in run.trials("r2handoversim").to_pylist()}
    agreed = {"stability": 12, "plan": 12, "reach": 12, "affordance": 7, "safe": 12, "first failure": 11}
    assert agreeing(rows) == agreed and "motions_left_out" not in run.header


def test_objects_that_are_boxes_collide_box_by_box_with_preset_release_alone(tmp_path):
    meshed = fixture("bottle", "region_agnostic", tool=MATCHED)
    corners = trimesh.creation.box((0.07, 0.07, 0.2))
    meshed["object_mesh_object"] = {"vertices": corners.vertices.tolist(), "faces": corners.faces.tolist()}
    boxes = fixture("bottle", "region_agnostic", tool=MATCHED)
    for k, (trial, line, collision) in enumerate(
        [
            (boxes, ["--preset", "release"], "pieces"),
            (boxes, ["--execute.sim", "none"], "hull"),
            (meshed, ["--preset", "release"], "hull"),
            (boxes, ["--preset", "release", "--plan.object-collision", "hull"], "hull"),
        ]
    ):
        source = written(tmp_path / f"in{k}", [trial])
        done = in_process("--trials-from", source, *line, "--out", tmp_path / f"run{k}")
        assert done.returncode == 0, done.stderr
        assert load_run(tmp_path / f"run{k}").header["configuration"]["plan"]["object_collision"] == collision


def release_fingers():
    """Our robot with the release's fingers: two boxes on slides, whose ends are our pads' ends."""
    own, slides = load_robot(), slide_table(0.0, 0.085)
    T_gripper_ee = np.linalg.inv(own.T_flange_gripper) @ own.T_flange_ee
    at = np.tile(T_gripper_ee @ shift(TIPS - 0.022), (2, 1, 1))
    at[:, :3, 3] += np.outer([-0.006, 0.006], T_gripper_ee[:3, 1])
    boxes = Primitives(
        ("left", "right"), np.zeros(2, np.int32), np.full(2, int(ShapeKind.BOX), np.int32), at,
        np.tile((0.012, 0.006, 0.022), (2, 1)),
    )  # fmt: skip
    return replace(
        own, gripper=boxes, gripper_part=("pad", "pad"), gripper_motion=("table_0", "table_0"),
        gripper_side=np.array([-1, 1], np.int32), digest="fingers of the release",
        linkage=table_linkage(slides, 0.0, 0.085, own.linkage.pad_half_size, 0.0, 1.0, 0.1),
    )  # fmt: skip


def as_rows(boxes):
    """A trial's boxes as `ObjectModel.receiver_boxes`."""
    return np.array([[b["center"], b["half_extents"], *b["rotation"]] for b in boxes])


def region_distances(regions, T_object_gripper, opening):
    """Distance of region i to the release's fingers at grasp i, m."""
    cube = trimesh.creation.box((0.01, 0.01, 0.01))
    tables = grasp_tables([replace(model_of(cube), receiver_boxes=r) for r in regions], release_fingers())
    T = torch.tensor(np.array(T_object_gripper) @ shift(-TIPS), dtype=torch.float32)
    index = torch.arange(len(regions), dtype=torch.int32)
    return region_distance(tables, T, index, torch.tensor(opening, dtype=torch.float32))[0]


def test_with_the_releases_fingers_usage_boxes_are_volumes_as_there():
    """Its published flags of all S1 fixtures, and FCL's boxes on random grasps: in, around and inside."""
    s1 = [fixture(name, v) for name in ("hammer", "screwdriver") for v in ("intent_aware", "region_agnostic")]
    regions = [as_rows([{**b, "rotation": np.eye(3)} for b in t["usage_boxes"]]) for t in s1]
    width = [0.05, 0.05, 0.038, 0.038]  # of the whole object, as the release opens its fingers
    touch_m = 1e-6  # the screwdriver's fingers touch its handle, which fails: rounding decides nothing
    flags = region_distances(regions, [t["T_object_gripper"] for t in s1], width) > touch_m
    assert flags.tolist() == [True, True, True, False]

    rng, n = np.random.default_rng(5), 300
    regions, grasps = [], []
    for _ in range(n):
        turns = [trimesh.transformations.random_rotation_matrix(rng.random(3)) for _ in range(3)]
        many = turns[: rng.integers(1, 3)]
        regions.append(np.array([[rng.normal(0, 0.02, 3), rng.uniform(0.002, 0.06, 3), *T[:3, :3]] for T in many]))
        turns[2][:3, 3] = rng.normal(0, 0.05, 3)
        grasps.append(turns[2])
    opening = rng.uniform(0, 0.085, n)
    distance = region_distances(regions, grasps, opening).numpy()
    met, within, size = np.zeros(n, bool), 0, (0.024, 0.012, 0.044)
    for i in range(n):
        for side in (-1, 1):
            at = trimesh.transformations.translation_matrix((0, side * (opening[i] / 2 + 0.006), -0.022))
            finger = grasps[i] @ at
            corners = trimesh.transform_points(trimesh.creation.box(size).vertices, finger)
            for center, half, *R in regions[i]:
                a = fcl.CollisionObject(fcl.Box(*size), fcl.Transform(finger[:3, :3], finger[:3, 3]))
                b = fcl.CollisionObject(fcl.Box(*2 * half), fcl.Transform(np.stack(R), center))
                met[i] |= fcl.collide(a, b) > 0
                within += (np.abs((corners - center) @ np.stack(R)) < half).all()
    clear = np.abs(distance) > 1e-5
    assert clear.sum() > n - 3 and (met == (distance < 0))[clear].all()
    assert 20 < met.sum() < n - 20 and within > 5


def test_usage_boxes_come_back_as_they_came(tmp_path):
    """A box that contains no face's middle comes back too; its inside is compared."""
    turned = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3))
    trial = fixture("hammer", "intent_aware", tool=MATCHED)
    more = box(turned, (0.0, 0.01, -0.02), (0.003, 0.002, 0.001))
    trial["usage_boxes"] = [{**trial["usage_boxes"][0], "rotation": np.eye(3).tolist()}, more]
    _, benchmark, _, _ = imported(tmp_path, [trial])
    assert np.allclose(benchmark.objects[0].receiver_boxes, as_rows(trial["usage_boxes"]), atol=1e-12)
    assert np.allclose(region_as_boxes(benchmark.objects[0]), as_rows(trial["usage_boxes"]), atol=1e-12)
    plain = replace(benchmark.objects[0], receiver_boxes=None)
    assert object_digest(plain) != object_digest(benchmark.objects[0])
    assert replace(benchmark, objects=(plain,)).digest != benchmark.digest


def test_a_sweep_judges_their_files_in_one_step_and_keeps_their_ids(tmp_path):
    """The executed motion is judged for our gripper (`T_tcp_asset_tool`); for another one the pose is planned to."""
    trials = [fixture("bottle", v, tool=MATCHED) for v in ("region_agnostic", "missed_delivery")]
    trials.append(fixture("bottle", "region_agnostic") | {"id": "box_tool"})
    source = written(tmp_path / "in", [t | {"obstacle_boxes_world": []} for t in trials])
    for more, planned in (([], {"box_tool"}), (["--replan"], {t["id"] for t in trials})):
        rows, run = swept(source, tmp_path / f"run{len(more)}", *more)
        assert {k for k, r in rows.items() if r["t_plan_s"] is not None} == planned
        assert {k: r["outcome"] for k, r in rows.items()} == {
            "bottle_region_agnostic": "success", "bottle_missed_delivery": "reach", "box_tool": "success"
        }  # fmt: skip
        if not more:
            assert rows["bottle_region_agnostic"]["t_exec_s"] == pytest.approx(29 / 60)
            assert run.labels[run.trial_id("bottle_missed_delivery")] == ("bottle_missed_delivery", "missed_delivery")


def test_obstacles_beside_the_table_stand_in_the_way_of_given_and_new_motions(tmp_path):
    """A turned box at the tool of a sample in the middle of the given motion; and one that is far from all of it."""
    trial, trials = fixture("bottle", "region_agnostic", tool=MATCHED), []
    ground = {"center": [-0.35, 0, 0.2], "half_extents": [0.65, 0.55, 0.035]}
    turned = trimesh.transformations.rotation_matrix(0.4, (1, 2, 3))
    middle = tcp(np.array(trial["executed_joints"])[14]) @ shift(MATCHED)
    for name, turned[:3, 3] in (("far", [1.5, 0, 2]), ("near", middle[:3, 3])):
        obstacle = box(turned, (0, 0, 0), (0.005, 0.005, 0.005))
        trials.append(trial | {"id": name, "obstacle_boxes_world": [obstacle, ground]})
    source = written(tmp_path / "in", trials)
    for more, near in (([], "plan"), (["--replan"], "success")):
        rows, _ = swept(source, tmp_path / f"run{len(more)}", *more)
        assert {k: r["outcome"] for k, r in rows.items()} == {"far": "success", "near": near}


def test_a_receivers_palm_frame_is_where_the_hand_stands(tmp_path):
    trial = fixture("bottle", "region_agnostic")
    P = np.eye(4)
    P[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    P[:3, 3] = (-0.6, -0.3, 0.9)
    trial["receiver"] = {"side": "left", "T_world_hand": P.tolist()}
    _, benchmark, evaluator, _ = imported(tmp_path, [trial])
    trials = benchmark.trials_with_ids(torch.tensor([0]))
    point, normal, _ = evaluator.scene.palm(trials.hand_index, trials.T_world_hand)
    # our world stands 0.75 m lower and is turned by half a turn about z
    assert torch.allclose(point[0], torch.tensor([0.6, 0.3, 0.15]), atol=1e-5)
    assert torch.allclose(normal[0], torch.tensor([0.0, 0.0, 1.0]), atol=1e-5)
    assert int(evaluator.scene.hands.set.side[trials.hand_index[0]]) == 1


def scene_of(trial):
    """The trial as a scene in the object's frame and the selection of its grasp."""
    T_world_object = np.array(trial["target_T_world_gripper"]) @ np.linalg.inv(trial["T_object_gripper"])
    back = np.linalg.inv(T_world_object)
    hand = [{**b, "center": (back @ [*b["center"], 1])[:3].tolist(), "rotation": (back[:3, :3] @ b["rotation"]).tolist()}
            for b in trial["hand_boxes_world"]]  # fmt: skip
    grasp = {"id": "g", "T_object_gripper": trial["T_object_gripper"]}
    scene = {
        "schema_version": "handover.scene.v1", "units": "m", "evaluation_split": trial["split"],
        "object": {"id": trial["object_id"], "boxes": trial["object_boxes"], "usage_regions": {"handle": trial["usage_boxes"]}},
        "intent": {"human_region": "handle"}, "candidates": [grasp], "target_T_world_object": T_world_object.tolist(),
        "receiving_hand": {
            "center": (back @ [*trial["palm_position_world"], 1])[:3].tolist(), "boxes": hand,
            "palm_normal": (back[:3, :3] @ trial["palm_normal_world"]).tolist(),
        },
    }  # fmt: skip
    return scene, {"schema_version": "handover.selection.v1", "object_id": trial["object_id"]}


def test_selections_with_their_scenes_and_experiments_are_the_trials_that_they_mean(tmp_path, capsys):
    trials = [fixture("bottle", "region_agnostic"), fixture("screwdriver", "region_agnostic")]
    batches, files = [], tmp_path / "files"
    files.mkdir()
    for t in trials:
        t["planned_joints"] = t["executed_joints"] = []
        name = t["object_id"]
        t["id"], t["variant"] = f"{name}_FS", "FS"
        scene, selection = scene_of(t)
        chosen = selection | {"status": "ok", "selected": "g", "mode": "FS"}
        none = selection | {"status": "no_feasible_grasp", "mode": "A1"}
        for part, data in (("scene", scene), ("FS", chosen), ("A1", none)):
            (files / f"{name}_{part}.json").write_text(json.dumps(data))
        modes = {mode: f"{name}_{mode}.json" for mode in ("FS", "A1")}
        batches.append({"object_id": name, "scene": f"{name}_scene.json", "selections": modes})
    experiment = files / "experiment.json"

    def read(source):
        out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
        assert main(["import", "trials", str(source), "--from", "r2handoversim", "--out", str(out)]) == 0
        return {k: np.load(out / f"{k}.npz") for k in ("predictions", "trials")}

    wanted, paired = read(written(tmp_path / "plain", trials)), read(files)
    assert "2 selections without a feasible grasp left out" in capsys.readouterr().out
    experiment.write_text(json.dumps({"schema_version": "handover.experiment.v1", "objects": batches}))
    for found in (paired, read(experiment)):
        assert found["trials"]["id"].tolist() == wanted["trials"]["id"].tolist() == ["bottle_FS", "screwdriver_FS"]
        both = {"T_world_hand": "trials", "skin": "trials", "T_obj_ee": "predictions", "T_world_ee": "predictions"}
        for name, file in both.items():
            assert np.allclose(found[file][name], wanted[file][name], atol=1e-6)
    scene = json.loads((files / "bottle_scene.json").read_text())
    del scene["target_T_world_object"]
    (files / "bottle_scene.json").write_text(json.dumps(scene))
    assert main(["import", "trials", str(experiment), "--from", "r2handoversim", "--out", str(tmp_path / "no")]) == 2
    assert "bottle_scene.json: target_T_world_object is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"schema_version": "handover.trial.v2"}, "schema_version is handover.trial.v2"),
        ({"T_object_gripper": np.diag([2, 1, 1, 1]).tolist()}, "T_object_gripper is"),
        ({"palm_normal_world": [0, 0, 0]}, "palm_normal_world is zero"),
        ({"usage_boxes": [{"center": [9, 9, 9], "half_extents": [1e-3] * 3}]}, "usage_boxes hold no face of the object"),
        ({"planned_joints": [[0, 0, 0]]}, "planned_joints is [[0, 0, 0]]; rows must have 6 numbers each"),
        ({"object_mesh_object": {"vertices": [[0, 0, 0]] * 4, "faces": [[0, 1, 7]] * 4}}, "names vertex 7; there are 4"),
        ({"usage_boxes": [{"center": [0, 0, 0], "half_extents": [1, -1, 1]}]}, "half_extents: row 0 is [1, -1, 1]; 1e-09 to 10"),
        ({"object_mesh_object": {"vertices": [[0, 0, 0]] * 4, "faces": [[0, 1, 2]] * 4, "source_path": "o.obj",
                                 "source_sha256": "0" * 64}}, "source_sha256 is 000000000000...; "),
        ({"method_geometry_invalidated": True}, "method_geometry_invalidated is true"),
        ({"obstacle_boxes_world": [{"center": [0, 0, 0], "half_extents": [1, 1, 1]}] * 22}, "has 21 boxes beside the table"),
    ],
)  # fmt: skip
def test_what_is_no_trial_is_refused_in_one_line_that_names_the_field(tmp_path, capsys, fields, line):
    (tmp_path / "t.json").write_text(json.dumps(fixture("hammer", "intent_aware") | fields))
    (tmp_path / "o.obj").write_text("v 0 0 0\n")
    out = str(tmp_path / "out")
    assert main(["import", "trials", str(tmp_path / "t.json"), "--from", "r2handoversim", "--out", out]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and line in said and "t.json" in said, said


MESH = {
    "vertices": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]],
    "faces": [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
}
EYE = np.eye(4).tolist()


@pytest.mark.parametrize("seed", range(4))
def test_odd_fields_of_a_trial_of_the_release_are_one_line(tmp_path, seed):
    good = json.loads(json.dumps(fixture("hammer", "region_agnostic")))
    good["object_mesh_object"] = MESH
    good["receiver"] = {"side": "left", "T_world_hand": EYE}
    own = {"pose": [0.0] * 48, "shape": [0.0] * 10, "T_world_hand": EYE, "T_world_palm": EYE, "receiver_faces": [0, 1]}
    good["provenance"] = {"r2h_batch": own}
    path, rng, found = tmp_path / "a.json", random.Random(seed), []
    path.write_text(json.dumps(good))
    read_trials(path)
    for _ in range(40):
        path.write_text(json.dumps(with_odd(good, rng)))
        found.append(outcome(lambda: read_trials(path)))
    assert found.count(False) > 20
