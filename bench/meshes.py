"""Somebody's meshes through import, grasps and every method: `python bench/meshes.py [DIR] [--json OUT]`.

Drawn here, so that anybody can measure them again: a mug, a wrench, a knife and a clamp with two slivers glued on, a bottle
as it is (mug and bottle of some 20,000 faces), and wrench and knife without the faces that look down. Then every mesh of DIR.

Measured, with nothing kept on disk and kernels compiled: CPU seconds (all threads) of the import, of the convex
decomposition, of grasp candidates and of receiving grasps; how many of `--trials` trials (S0, built-in hands, motion as
planned) each method solves; against the drawn mesh as it was, or a file's own faces: the volume, the distance within which 99
% of the surface lies (also without what replaces missing faces), how much of space is inside one of the two alone (float64),
and how many of `--grasps` grasps pass Stability on one of the two alone; the thinnest wall (the first percentile of the
depths behind 2,000 points).
"""

import argparse
import json
import os
import sys
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import igl
import manifold3d
import numpy as np
import torch
import trimesh
from _report import Report, markdown_table
from _twins import winding_number
from numpy.typing import NDArray
from run import Bench

os.environ["R2H_BATCH_CACHE"] = "off"

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.judge.grasp import close_gripper
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.mesh_import.pieces import convex_pieces
from r2h_batch.scene.objects import ObjectMeshError, build_object
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.sweep.jobs import Setting, make_jobs
from r2h_batch.sweep.request import Sweep
from r2h_batch.trials.holding.receiving import load_receiving

MEASURES = (
    "bench/meshes.py",
    "r2h_batch/scene/mesh_import",
    "r2h_batch/scene/objects.py",
    "r2h_batch/methods",
    "r2h_batch/trials/holding",
)
METHODS = ("oracle", "random", "fc", "handover-va", "contact", "intent")
SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb")


def drawn() -> dict[str, trimesh.Trimesh]:
    """Closed meshes of five things, in metres."""
    solid, flat = manifold3d.Manifold, manifold3d.CrossSection

    def block(size: tuple[float, float, float], at: tuple[float, float, float]) -> Any:
        return solid.cube(size, True).translate(at)

    cup = [(0, -0.045), (0.04, -0.045), (0.04, 0.045), (0.037, 0.045), (0.037, -0.042), (0, -0.042)]
    outer = [(0, 0), (0.03, 0), (0.0325, 0.004), (0.0325, 0.13), (0.028, 0.15), (0.014, 0.175), (0.0135, 0.22)]
    inner = [(0.0115, 0.22), (0.012, 0.175), (0.026, 0.15), (0.0305, 0.13), (0.0305, 0.006), (0, 0.002)]
    ring = solid.revolve(flat([[(0.02, -0.005), (0.028, -0.005), (0.028, 0.005), (0.02, 0.005)]]), 48)
    handle = ring.rotate((90, 0, 0)).translate((0.05, 0, 0)) - solid.cylinder(0.2, 0.0385, 0.0385, 64, True)
    jaw = solid.cylinder(0.01, 0.022, 0.022, 48, True).translate((0.09, 0, 0))
    blade = solid.extrude(flat([[(0.0, -0.014), (0.14, -0.01), (0.16, 0.012), (0.0, 0.014)]]), 0.0018)
    things = {
        "mug": (solid.revolve(flat([cup]), 64) + handle, 0.01),
        "bottle": (solid.revolve(flat([[*outer, *inner]]), 40), 0.0125),
        "wrench": (block((0.17, 0.02, 0.008), (0, 0, 0)) + jaw - block((0.04, 0.016, 0.02), (0.105, 0, 0)), 0.008),
        "knife": (blade.translate((0.04, 0, -0.0009)) + block((0.11, 0.022, 0.016), (-0.01, 0, 0)), 0.008),
        "clamp": (
            block((0.02, 0.016, 0.11), (0, 0, 0))
            + block((0.07, 0.016, 0.014), (0.035, 0, 0.048))
            + block((0.05, 0.016, 0.014), (0.025, 0, -0.048))
            + solid.cylinder(0.05, 0.005, 0.005, 32, True).translate((0.06, 0, 0.02)),
            0.008,
        ),
    }
    out: dict[str, Any] = {}
    for name, (thing, longest_m) in things.items():
        mesh = thing.to_mesh()
        vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
        made = trimesh.Trimesh(vertices, np.asarray(mesh.tri_verts, np.int64), process=True)
        out[f"drawn_{name}"] = made.subdivide_to_size(longest_m)
    return out


def spoiled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with two slivers of two faces each, on edges that four faces then share."""
    n = len(mesh.vertices)
    (a, b), (c, d) = mesh.edges[len(mesh.edges) // 5], mesh.edges[4 * len(mesh.edges) // 5]
    points = mesh.vertices[[a, c]] + [[0, 0, 4e-4], [3e-4, 0, 0]]
    faces = [[a, b, n], [b, a, n], [c, d, n + 1], [d, c, n + 1]]
    return trimesh.Trimesh(np.vstack([mesh.vertices, points]), np.vstack([mesh.faces, faces]), process=False)


def without_underside(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without the faces that look down, as a scanner from above leaves it."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] > -0.9], process=False)


def share_within(mesh: trimesh.Trimesh, other: trimesh.Trimesh, given: trimesh.Trimesh) -> tuple[float, float]:
    """The distance (m) from `other` within which 99 % of 5,000 samples of `mesh` lie: of all samples, and of those
    whose nearest point of `other` lies on `given`."""

    def nearest(points: Any, to: Any) -> tuple[Any, Any]:
        squared, _, near = igl.point_mesh_squared_distance(points, np.array(to.vertices), np.array(to.faces, np.int64))
        return squared**0.5, near

    distance, near = nearest(np.asarray(trimesh.sample.sample_surface(mesh, 5000, seed=7)[0]), other)
    kept = distance[nearest(near, given)[0] < 1e-6]
    return float(np.quantile(distance, 0.99)), float(np.quantile(kept, 0.99))


def thinnest_wall(mesh: trimesh.Trimesh, most: float = 5e-3) -> float:
    """The first percentile of depths (m) of the inside behind 2,000 points of a closed surface, in steps of 0.02 mm."""
    points, face = trimesh.sample.sample_surface(mesh, 2000, seed=7)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.array(mesh.vertices), np.array(mesh.faces, np.int64), 1)
    depth, left = np.full(len(points), most), np.arange(len(points))
    for step in np.arange(1e-5, most, 2e-5):
        behind = np.ascontiguousarray(points[left] - step * mesh.face_normals[face[left]])
        inside = tree.winding_number(behind, 2.0) > 0.5
        depth[left[~inside]] = step
        left = left[inside]
        if not len(left):
            break
    return float(np.quantile(depth, 0.01))


def random_grasps(mesh: trimesh.Trimesh, count: int) -> torch.Tensor:
    """(count, 4, 4) poses whose pads face a point of the surface, half of them square with it, half up to 25 degrees off."""
    rng = np.random.default_rng(13)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=13)
    y = mesh.face_normals[face] + np.where(np.arange(count) % 2, 0.45, 0.0)[:, None] * rng.uniform(-1, 1, (count, 3))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(y, rng.normal(size=(count, 3)))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    T[:, :3, 3] = points - y * rng.uniform(0, 0.04, (count, 1)) - z * rng.uniform(-0.012, 0.015, (count, 1))
    return torch.tensor(T, dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class BareSurface:
    """Fields of an object that Stability reads."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    receiver_face: NDArray[np.bool_]
    receiver_boxes: None = None


def stable(mesh: trimesh.Trimesh, T_obj_ee: torch.Tensor) -> NDArray[np.bool_]:
    """(count,) whether grasps pass Stability on a surface as it is."""
    faces = np.asarray(mesh.faces, np.int32)
    region = np.zeros(len(faces), bool)
    model = BareSurface(np.asarray(mesh.vertices, np.float32), faces, region)
    tables = grasp_tables([model], load_robot())  # type: ignore[list-item]
    return close_gripper(tables, T_obj_ee, torch.zeros(len(T_obj_ee), dtype=torch.int32)).margin_m.numpy() >= 0


def changed(
    model: Any, other: trimesh.Trimesh, given: trimesh.Trimesh, volume: float | None, count: int
) -> dict[str, Any]:
    """Change of a surface by the import: against `other`, whose volume is `volume`; None: it is open."""
    mesh, rng = model.mesh, np.random.default_rng(5)
    low, high = np.minimum(mesh.bounds[0], other.bounds[0]), np.maximum(mesh.bounds[1], other.bounds[1])
    points = rng.uniform(low, high, (1500, 3))
    inside, before = (np.array([winding_number(x, m.triangles) > 0.5 for x in points]) for m in (mesh, other))
    everywhere, kept = share_within(mesh, other, given)
    T = random_grasps(mesh, count)
    one, two = stable(mesh, T), stable(other, T)
    return {
        "steps": list(model.repair.steps) if model.repair else [],
        "moved_mm": round(1e3 * model.repair.moved_m, 3) if model.repair else 0.0,
        "volume_cm3": round(1e6 * float(mesh.volume), 3),
        "volume_change": None if not volume else round(float(mesh.volume / volume - 1), 6),
        "within_99_mm": round(1e3 * everywhere, 4),
        "within_99_kept_mm": round(1e3 * kept, 4),
        "thinnest_wall_mm": round(1e3 * thinnest_wall(mesh), 2),
        "differs_inside": round(float((inside != before).sum() / max(int(inside.sum()), 1)), 5),
        "grasps_tried": count,
        "stable": int(one.sum()),
        "flips": int((one != two).sum()),
    }


def measure(
    name: str, source: Path | trimesh.Trimesh, clean: trimesh.Trimesh | None, n: int, count: int
) -> dict[str, Any]:
    """The figures of one mesh; `clean`: as it was drawn."""
    spent, before = {}, time.process_time()

    def took(step: str) -> None:
        nonlocal before
        now = time.process_time()
        spent[f"{step}_cpu_s"], before = round(now - before, 2), now

    try:
        model = build_object(source, name, pieces=False)
    except ObjectMeshError as error:
        return {"object": name, "refused": str(error)}
    took("build")
    convex_pieces(model.mesh, model.name)
    took("pieces")
    grasps = len(candidates_of((model,))[0])
    took("grasps")
    receiving = len(load_receiving((model,)))
    took("receiving")
    row: dict[str, Any] = {"object": name, "faces": len(model.faces), "grasps": grasps, "receiving": receiving, **spent}
    row["all_cpu_s"] = round(sum(spent.values()), 2)
    given = source if isinstance(source, trimesh.Trimesh) else load_mesh_file(source, name)
    volume = clean.volume if clean is not None else model.repair.volume_given_m3 if model.repair else model.mesh.volume
    row |= changed(model, given if clean is None else clean, given, volume, count)
    evaluator, trials = (
        Evaluator(load_benchmark("r2h-v1").with_objects([model])),
        load_benchmark("r2h-v1").with_objects([model]).trials(n, splits=["S0"]),
    )
    setting = Setting(evaluator, {}, lambda first, last: trials.trial_id[first:last], lambda ids: trials)
    for method in METHODS if grasps else ():
        (job,) = make_jobs(replace(setting, sweep=Sweep(method=(method,))), [])
        answer = job.predict(trials, None)
        row[method] = int(evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials).success.sum())
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Change of each mesh by the import, as Markdown."""
    keys = ("faces", "build_cpu_s", "all_cpu_s", "volume_change", "within_99_mm", "flips", "oracle")
    return markdown_table(["object", *keys], [[r["object"], *(r.get(k, "-") for k in keys)] for r in rows])


def figures(report: Report, rows: list[dict[str, Any]]) -> None:
    """Counts over all meshes, and the figures of each."""
    taken = [r for r in rows if "refused" not in r]
    report.add("meshes.meshes", len(rows))
    report.add("meshes.refused", len(rows) - len(taken))
    report.add("meshes.kept_within_1_um", sum(r["within_99_mm"] <= 1e-3 for r in taken))
    report.add("meshes.imported_within_5_cpu_s", sum(r["build_cpu_s"] <= 5 for r in taken))
    report.add("meshes.longest_import_cpu_s", max(r["build_cpu_s"] for r in taken))
    for row in rows:
        for key, value in row.items():
            if key != "object" and value is not None:
                report.add(f"meshes.{row['object']}.{key}", ", ".join(value) if isinstance(value, list) else value)


def run(asked: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    warnings.simplefilter("ignore")
    things = drawn()
    todo: list[tuple[str, Any, Any]] = [(n, m if n == "drawn_bottle" else spoiled(m), m) for n, m in things.items()]
    todo += [(f"open_{n}", without_underside(things[f"drawn_{n}"]), things[f"drawn_{n}"]) for n in ("wrench", "knife")]
    if asked.folder is not None:
        todo += [(p.stem, p, None) for p in sorted(asked.folder.iterdir()) if p.suffix.lower() in SUFFIXES]
    opened = trimesh.creation.box((0.05, 0.06, 0.1))
    opened.update_faces(np.arange(len(opened.faces)) > 0)
    for box in (trimesh.creation.box((0.05, 0.06, 0.1)), opened):
        measure("box", box, None, 1, 8)  # compiles or loads every kernel
    rows = []
    for name, source, clean in todo:
        rows.append(measure(name, source, clean, asked.trials, asked.grasps))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    figures(report, rows)
    print(table(rows))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "folder": {"type": Path, "nargs": "?"},
        "--trials": {"default": 20},
        "--grasps": {"default": 4000},
    },
    peer="the meshes before they were spoiled",
)

if __name__ == "__main__":
    BENCH.main()
