"""Can the receivers take what methods hand over: docs/results/questions.md, docs/results/reception.png.

`python bench/reception.py` asks it of the shipped baselines of the default benchmark and of `oracle,for=reception`, and draws one
trial with all hands that were tried.
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from _report import ROOT, Report, lines_of, markdown_table
from _rows import rate_over_categories
from run import Bench
from scipy.spatial.transform import Rotation, Slerp

PICTURE = ROOT / "docs" / "results" / "reception.png"
MEASURES = (
    "bench/reception.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/trials/holding",
    "r2h_batch/sweep/results/reception.py",
)
BOUND = "oracle,for=reception"
SHOWN_OF = 4
TAKEN, BLOCKED, BEYOND = (0.25, 0.65, 0.3, 1), (0.8, 0.25, 0.2, 0.5), (0.95, 0.8, 0.2, 0.35)
SKIN, OBJECT = (0.87, 0.66, 0.54, 1), (0.13, 0.35, 0.72, 1)


def judged(run: Any, trials: int) -> tuple[Any, dict[str, Any]]:
    """The judge of the baselines, and the table of each method; of the first `trials` of each split."""
    from r2h_batch.sweep.results import reception as stored
    from r2h_batch.sweep.results.judge import Judge

    judge, ids = Judge(run), np.arange(2 * trials)
    tables = tables_of(run, judge, trials)
    bound = answered(judge, ids)
    scores = bound[3]
    tables[BOUND] = stored.rows_of(ids, scores, dict(zip(ids.tolist(), scores.success.tolist(), strict=True)))
    return bound, tables


def tables_of(run: Any, judge: Any, trials: int) -> dict[str, Any]:
    """The table of each method's rows, of the first `trials` of each split."""
    from r2h_batch.sweep.results import questions
    from r2h_batch.sweep.results import reception as stored

    tables = {}
    for name in run.methods:
        (whole,) = questions.parts(run, name)  # 1,000 rows
        own, scores = questions.judged(judge, whole)
        first = np.flatnonzero(own < 2 * trials)
        tables[name] = stored.rows_of(own[first], scores[torch.from_numpy(first)], whole.success)
        print(name, tables[name]["received"].to_numpy().mean(), flush=True)
    return tables


def rates(tables: dict[str, Any], asked: Any, objects: Any) -> dict[str, list[str]]:
    """Method -> percent of all trials received, and received with success, with intervals over categories."""
    trials = {"split": asked.splits, "category": [objects[i].category for i in asked.object_index.tolist()]}
    found = {}
    for name, table in tables.items():
        rows = {row["trial_id"]: row for row in table.select(["trial_id", "received", "success"]).to_pylist()}
        mine = [rows.get(i) for i in asked.trial_id.tolist()]  # a trial without a pose has no row
        received = [bool(row and row["received"]) for row in mine]
        both = [bool(row and row["received"] and row["success"]) for row in mine]
        found[name] = [rate_over_categories("".join("01"[x] for x in own), trials) for own in (received, both)]
    return found


def answered(judge: Any, ids: Any) -> tuple[Any, Any, Any, Any]:
    """The judge, and trials with the bound's answers and their scores."""
    from r2h_batch.methods import oracle

    asked, evaluator = judge.trials(ids), judge.evaluator.kinematic
    answer = oracle.predict(asked, evaluator.scene, evaluator=evaluator, for_="reception")
    return judge, asked, answer, evaluator.score(answer.T_obj_ee, answer.T_world_ee, asked)


def draw(judge: Any, asked: Any, answer: Any, scores: Any) -> str:
    """Writes the picture of the first trial that is received upright with a turn of the hand; gives its caption."""
    from r2h_batch.judge import reception as steps
    from r2h_batch.view.drawing import Drawing, view_of
    from r2h_batch.view.pictures import save_picture
    from r2h_batch.view.stored import judged_again

    found = steps.reception(scores)
    lean = found.angles_deg[:, steps.ANGLES.index("lean")]
    fits = found.received & (lean == 0) & (found.turn_deg > 45) & (found.count[:, -1] > 6)
    i = int(torch.nonzero(fits)[0, 0])
    stored = judged_again(judge.evaluator.kinematic, asked[i : i + 1], answer[i : i + 1], BOUND)
    batch = steps._batch_of(scores[i : i + 1])
    arms = steps._arms(batch, steps.LEANS_DEG)
    passes = torch.zeros((*arms["effort"].shape, len(steps.STEPS)), dtype=torch.bool)
    passes[..., 0], passes[..., 5] = arms["effort"] >= 0, True
    way, _ = steps._come(batch, arms, passes)
    steps._beside_robot(batch, arms, passes)
    steps._let_go(batch, arms, passes)
    taken = passes.all(2)[0]

    def skin(k: int) -> np.ndarray:
        """Skin of grasp k, world."""
        pair = batch.pairs(torch.tensor([0]), torch.tensor([k]), arms)
        turned = steps._about_axis(batch.grasps, pair["object"].long(), pair["turn"])[0].double()
        T = (pair["T_world_obj"][0].double() @ turned).numpy()
        own = batch.grasps.held_out.grasps[int(batch.first[0]) + k : int(batch.first[0]) + k + 1]
        return own.vertices[0].double().numpy() @ T[:3, :3].T + T[:3, 3]

    groups = {
        "taken": (taken, TAKEN),
        "blocked": (~taken & passes[0, :, 0], BLOCKED),
        "beyond the arm": (~passes[0, :, 0], BEYOND),
    }
    size, drawing = (440, 400), Drawing(stored)
    view = view_of([drawing], size[0] / size[1], close=True)
    view = replace(view, distance_m=2.2 * view.distance_m)
    some = [(skin(k), color) for mask, color in groups.values() for k in torch.nonzero(mask)[:, 0].tolist()[::SHOWN_OF]]
    images = [frame(stored, some, stored.receiver, size, view)]
    row = int(batch.grasps.first_of(asked.object_index[i])) + int(found.grasp[i])
    k, receiver = row - int(batch.first[0]), np.array(stored.receiver)
    table, hand = batch.grasps, skin(k)
    pair = batch.pairs(torch.tensor([0]), torch.tensor([k]), arms)
    wrist = batch.wrists(pair)[0].double().numpy()
    R = (
        found.T_world_hand[i, :3, :3].double().numpy()
        @ batch.grasps.held_out.grasps.T_obj_hand[row, :3, :3].double().numpy().T
    )
    n, a = (R @ table.owners[j][row].double().numpy() for j in (2, 1))
    u = (n, a, (n + a) / np.linalg.norm(n + a))[int(way[0, k])]
    R_grasp, R_waits = found.T_world_hand[i, :3, :3].double().numpy(), stored.T_world_hand[:3, :3].astype(float)
    turn = Slerp([0, 1], Rotation.from_matrix([R_waits, R_grasp]))
    for t in (0.0, 1.0, 2.0):
        before = wrist - 0.1 * u
        at = receiver[2, :3] + t * (before - receiver[2, :3]) if t < 1 else before + (t - 1) * (wrist - before)
        moved = (hand - wrist) @ (turn(min(t, 1.0)).as_matrix() @ R_grasp.T).T + at
        posed = receiver.copy()
        posed[1, :3] += 0.5 * t * (found.elbow[i].double().numpy() - receiver[1, :3])
        posed[2, :3] = at
        images.append(frame(stored, [(moved, SKIN)], posed, size, view))
    images.append(frame(stored, [(moved, SKIN)], posed, size, view, released=True))
    save_picture(PICTURE, np.concatenate(images, axis=1))
    counts = ", ".join(f"{int(mask.sum())} {name}" for name, (mask, _) in groups.items())
    return (
        f"Trial {int(asked.trial_id[i])} ({stored.object_model.name}). Left: one in {SHOWN_OF} of the {int(found.known[i])} hands"
        f" that were tried ({counts}; green, red, yellow). Then the easiest hand: waiting, 10 cm before the grasp, at the grasp,"
        f" and after the release. It turns by {float(found.turn_deg[i]):.0f} degrees."
    )


def frame(
    stored: Any, hands: list[tuple[np.ndarray, Any]], receiver: Any, size: tuple[int, int], view: Any, *,
    released: bool = False,
) -> np.ndarray:  # fmt: skip
    """A picture of the trial at its goal, with these hands (skins in the world, colours) in place of the waiting one;
    `released`: the object stays, the gripper is open and 10 cm back along its axis."""
    import mujoco

    from r2h_batch.judge.ik import solve_ik
    from r2h_batch.scene.offscreen import renderer
    from r2h_batch.view.mjcf import spec_of

    q, robot = stored.target_q, stored.robot
    row = {**stored.row, "opening_m": robot.open_gap_m} if released else stored.row
    spec = spec_of(replace(stored, receiver=receiver, row=row))
    for geom in spec.geoms:
        if geom.name.startswith(("hand/", "object/") if released else "hand/"):
            geom.rgba[3] = 0.0
    if released:
        back = np.eye(4)
        back[2, 3] = -0.1
        target = torch.tensor(stored.T_world_ee @ back, dtype=torch.float32)[None]
        ik = solve_ik(target, robot=robot, home=tuple(np.asarray(q, float)))
        branches = ik.q[0][ik.valid[0]].double().numpy()
        q = branches[np.abs(branches - q).max(1).argmin()]
        T = stored.T_world_ee @ np.linalg.inv(stored.T_obj_ee_attached)
        left = stored.object_model.mesh.copy().apply_transform(T)
        mesh = spec.add_mesh(name="left", uservert=left.vertices.ravel(), userface=left.faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        how = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name, "rgba": OBJECT}
        spec.worldbody.add_geom(contype=0, conaffinity=0, **how)
    faces = stored.hand_set.model.faces_by_side[int(stored.hand_set.side[stored.row["hand_index"]])].numpy()
    for k, (skin, color) in enumerate(hands):
        mesh = spec.add_mesh(name=f"taking{k}", uservert=skin.ravel(), userface=faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        how = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name, "rgba": color}
        spec.worldbody.add_geom(contype=0, conaffinity=0, **how)
    model = spec.compile()
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    data, camera, option = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvOption()
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    option.sitegroup[:], option.geomgroup[:] = 0, [1, 1, 1, 0, 0, 0]
    camera.lookat[:], camera.distance = view.look_at, view.distance_m
    camera.azimuth, camera.elevation = view.azimuth_deg, view.elevation_deg
    with renderer(model, *size) as drawer:
        drawer.update_scene(data, camera, option)
        return np.array(drawer.render())


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    steps = lines_of(data["tables"], "Received, by step")
    for row in steps:
        row[0] = row[0].replace("oracle,fo..ption", BOUND)
    percent = {name.partition(" (")[0]: own for name, own in data["rates"].items()}
    steps = [steps[0], *([*row[:-2], *percent.get(row[0], row[-2:])] for row in steps[2:])]
    return {
        "steps": markdown_table(steps[0], steps[1:]),
    }


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """All figures of the page, and its picture."""
    from r2h_batch import load_benchmark
    from r2h_batch.report import load_baselines
    from r2h_batch.sweep.results.reception import render

    benchmark = load_benchmark()
    bound, tables = judged(load_baselines(benchmark), options.trials)
    return {
        "trials": options.trials,
        "benchmark": benchmark.name,
        "rates": rates(tables, bound[1], benchmark.objects),
        "tables": render(tables),
        "caption": draw(*bound),
    }


BENCH = Bench(__doc__, measure, MEASURES, {"--trials": {"default": 100, "help": "of each split"}}, stored="reception")

if __name__ == "__main__":
    BENCH.main()
