"""What the repair of a mesh does to it and to grasps: `python bench/repair.py [DIR] [--json OUT] [--grasps 4000]`.

Objects that OUT holds already are not measured again.

Meshes: every mesh of DIR, four closed ones made here (mug, wrench, knife, clamp) with two slivers glued on, and wrench and knife
without the faces that look down. The made ones are compared with the uncut mesh, the others with their own given faces.
Measured, with nothing kept on disk: CPU seconds of the repair; the volume before and after where there is one; the distance
from that surface within which 99 % of the new surface lies, also without the parts that replace cut faces; the thinnest wall
(the first percentile of the depths behind 2,000 points); how much of space is inside one of the two alone, by winding numbers in
float64 (`tests/support/mesh_twins.py`); and of so many grasps how many pass Stability on one surface alone.

An older commit, measured in the same way: `git worktree add OLD a5bff95 && PYTHONPATH=OLD python bench/repair.py --grasps 0`.
"""

import importlib
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from _report import arguments, made_by

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb")
POINTS = 1500
NEAR_M = 1e-4
"""Grasps with a margin nearer to 0 than this on either surface are within what the evaluator calls borderline."""


def made() -> dict[str, Any]:
    """Closed meshes of four things, in metres."""
    import manifold3d
    import numpy as np
    import trimesh

    solid, flat = manifold3d.Manifold, manifold3d.CrossSection

    def block(size: tuple[float, float, float], at: tuple[float, float, float]) -> Any:
        return solid.cube(size, True).translate(at)

    outline = [(0, -0.045), (0.04, -0.045), (0.04, 0.045), (0.037, 0.045), (0.037, -0.042), (0, -0.042)]
    ring = solid.revolve(flat([[(0.02, -0.005), (0.028, -0.005), (0.028, 0.005), (0.02, 0.005)]]), 48)
    handle = ring.rotate((90, 0, 0)).translate((0.05, 0, 0)) - solid.cylinder(0.2, 0.0385, 0.0385, 64, True)
    jaw = solid.cylinder(0.01, 0.022, 0.022, 48, True).translate((0.09, 0, 0))
    blade = solid.extrude(flat([[(0.0, -0.014), (0.14, -0.01), (0.16, 0.012), (0.0, 0.014)]]), 0.0018)
    things = {
        "mug": solid.revolve(flat([outline]), 64) + handle,
        "wrench": block((0.17, 0.02, 0.008), (0, 0, 0)) + jaw - block((0.04, 0.016, 0.02), (0.105, 0, 0)),
        "knife": blade.translate((0.04, 0, -0.0009)) + block((0.11, 0.022, 0.016), (-0.01, 0, 0)),
        "clamp": block((0.02, 0.016, 0.11), (0, 0, 0))
        + block((0.07, 0.016, 0.014), (0.035, 0, 0.048))
        + block((0.05, 0.016, 0.014), (0.025, 0, -0.048))
        + solid.cylinder(0.05, 0.005, 0.005, 32, True).translate((0.06, 0, 0.02)),
    }
    out = {}
    for name, thing in things.items():
        mesh = thing.to_mesh()
        vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
        out[name] = trimesh.Trimesh(vertices, np.asarray(mesh.tri_verts, np.int64), process=True).subdivide_to_size(
            0.008
        )
    return out


def spoiled(mesh: Any) -> Any:
    """The mesh with two slivers of two faces each, on edges that four faces then share."""
    import numpy as np
    import trimesh

    n = len(mesh.vertices)
    (a, b), (c, d) = mesh.edges[len(mesh.edges) // 5], mesh.edges[4 * len(mesh.edges) // 5]
    points = mesh.vertices[[a, c]] + [[0, 0, 4e-4], [3e-4, 0, 0]]
    faces = [[a, b, n], [b, a, n], [c, d, n + 1], [d, c, n + 1]]
    return trimesh.Trimesh(np.vstack([mesh.vertices, points]), np.vstack([mesh.faces, faces]), process=False)


def without_underside(mesh: Any) -> Any:
    """The mesh without the faces that look down, as a scanner from above leaves it."""
    import trimesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] > -0.9], process=False)


def share_within(mesh: Any, other: Any, given: Any = None, share: float = 0.99) -> float:
    """The distance (m) from `other` within which this share of the surface of `mesh` lies, by 5,000 samples.

    Only samples whose nearest point of `other` lies on `given` count, where that is a part of it.
    """
    import igl
    import numpy as np
    import trimesh

    def nearest(points: Any, to: Any) -> tuple[Any, Any]:
        squared, _, near = igl.point_mesh_squared_distance(points, np.array(to.vertices), np.array(to.faces, np.int64))
        return squared**0.5, near

    distance, near = nearest(np.asarray(trimesh.sample.sample_surface(mesh, 5000, seed=7)[0]), other)
    if given is not None:
        distance = distance[nearest(near, given)[0] < 1e-6]
    return float(np.quantile(distance, share))


def thinnest_wall(mesh: Any, most: float = 5e-3) -> float:
    """The first percentile of depths (m) of the inside behind 2,000 points of a closed surface, in steps of 0.02 mm."""
    import igl
    import numpy as np
    import trimesh

    points, face = trimesh.sample.sample_surface(mesh, 2000, seed=7)
    tree = igl.FastWindingNumberBVH()
    tree.init(np.array(mesh.vertices), np.array(mesh.faces, np.int64), 1)
    depth, left = np.full(len(points), most), np.arange(len(points))
    for step in np.arange(1e-5, most, 2e-5):
        inside = (
            tree.winding_number(np.ascontiguousarray(points[left] - step * mesh.face_normals[face[left]]), 2.0) > 0.5
        )
        depth[left[~inside]] = step
        left = left[inside]
        if not len(left):
            break
    return float(np.quantile(depth, 0.01))


def repair_of() -> Any:
    """`closed_mesh` of this version, or of those up to a5bff95; its kernels are compiled."""
    import numpy as np
    import trimesh

    try:
        name = "r2h_batch.bodies.mesh_import.closed"
        closed_mesh = importlib.import_module(name).closed_mesh
    except ImportError:
        closed_mesh = importlib.import_module("r2h_batch.bodies.object_mesh").closed_mesh
    box = trimesh.creation.box((0.05, 0.06, 0.1))
    box.update_faces(np.arange(len(box.faces)) > 0)
    closed_mesh(box, "opened", 1.0)
    return closed_mesh


def grasps(mesh: Any, count: int) -> Any:
    """(count, 4, 4) poses whose pads face a point of the surface, half of them square with it; the others up to 25 degrees
    off."""
    import numpy as np
    import torch
    import trimesh
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(13)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=13)
    y = mesh.face_normals[face] + np.where(np.arange(count) % 2, 0.45, 0.0)[:, None] * rng.uniform(-1, 1, (count, 3))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(y, rng.normal(size=(count, 3)))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    T[:, :3, 3] = points - y * rng.uniform(0, 0.04, (count, 1)) - z * rng.uniform(-0.012, 0.015, (count, 1))
    assert np.allclose(Rotation.from_matrix(T[:, :3, :3]).as_matrix(), T[:, :3, :3], atol=1e-9)
    return torch.tensor(T, dtype=torch.float32)


def stable(mesh: Any, T_obj_ee: Any) -> Any:
    """(count,) margins of Stability on a surface as it is."""
    from types import SimpleNamespace

    import numpy as np
    import torch

    from r2h_batch.bodies.robot import load_robot
    from r2h_batch.judge.grasp import close_gripper
    from r2h_batch.scene.grasp_tables import grasp_tables

    faces = np.asarray(mesh.faces, np.int32)
    model = SimpleNamespace(
        vertices=np.asarray(mesh.vertices, np.float32), faces=faces, receiver_face=np.zeros(len(faces), bool)
    )
    tables = grasp_tables([model], load_robot())  # type: ignore[list-item]
    return close_gripper(tables, T_obj_ee, torch.zeros(len(T_obj_ee), dtype=torch.int32)).margin_m.numpy()


def measure(closed_mesh: Any, name: str, source: Any, count: int, clean: Any = None) -> dict[str, Any]:
    """The figures of one mesh: against `clean`, or against its own faces as they are given."""
    import numpy as np
    from mesh_twins import winding_number

    start = time.process_time()
    closed = closed_mesh(source, name, 1.0)
    seconds = time.process_time() - start
    mesh, repair, other = closed.mesh, closed.repair, closed.given if clean is None else clean
    given = repair.volume_given_m3 if clean is None else float(clean.volume)
    low, high = np.minimum(mesh.bounds[0], other.bounds[0]), np.maximum(mesh.bounds[1], other.bounds[1])
    points = np.random.default_rng(5).uniform(low, high, (POINTS, 3))
    inside, before = (winding_number(m, points) > 0.5 for m in (mesh, other))
    row = {
        "object": name,
        "faces": len(closed.given.faces),
        "steps": list(repair.steps),
        "cpu_s": round(seconds, 2),
        "volume_given_cm3": None if given is None else round(1e6 * given, 3),
        "volume_cm3": round(1e6 * repair.volume_m3, 3),
        "volume_change": None if given is None else round(repair.volume_m3 / given - 1, 6),
        "within_99_mm": round(1e3 * share_within(mesh, other), 4),
        "within_99_kept_mm": round(1e3 * share_within(mesh, other, closed.given), 4),
        "thinnest_wall_mm": round(1e3 * thinnest_wall(mesh), 2),
        "differs_inside": round(float((inside != before).sum() / max(int(inside.sum()), 1)), 5),
        "points_inside": int(inside.sum()),
        "moved_mm": round(1e3 * repair.moved_m, 4),
    }
    if not count:
        return row
    T = grasps(mesh, count)
    one, two = stable(mesh, T), stable(other, T)
    flips = (one >= 0) != (two >= 0)
    clear = flips & (np.abs(one) > NEAR_M) & (np.abs(two) > NEAR_M)
    return row | {
        "grasps": count,
        "stable": int((one >= 0).sum()),
        "flips": int(flips.sum()),
        "flips_clear": int(clear.sum()),
        "margin_differs_mm": round(1e3 * float(np.quantile(np.abs(one - two), 0.99)), 4),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures as Markdown."""
    head = ["object", "how it was made solid", "CPU", "volume", "99 % within (without patches)", "thinnest wall"]
    lines = [
        "| " + " | ".join([*head, "inside of one alone", "surface moved", "grasps that flip"]) + " |",
        "|---" * 9 + "|",
    ]
    for r in rows:
        change = "open as given" if r["volume_change"] is None else f"{100 * r['volume_change']:+.2f} %"
        cells = [r["object"], "; ".join(r["steps"]) or "closed as given", f"{r['cpu_s']:.2f} s"]
        cells += [
            f"{r['volume_cm3']} cm3, {change}",
            f"{r['within_99_mm']:.3f} mm ({r['within_99_kept_mm']:.3f} mm)",
            f"{r['thinnest_wall_mm']:.2f} mm",
        ]
        cells += [f"{100 * r['differs_inside']:.2f} %", f"{r['moved_mm']:.3f} mm"]
        cells.append(f"{r['flips']} of {r['grasps']} ({r['stable']} hold)" if "flips" in r else "-")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measures and prints."""
    parser = arguments(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--grasps", type=int, default=4000)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    out: Path | None = given.json
    stored: dict[str, Any] = json.loads(out.read_text()) if out is not None and out.exists() else made_by()
    rows: list[dict[str, Any]] = stored.get("objects", [])
    things = made()
    todo: list[tuple[str, Any, Any]] = [(name, spoiled(mesh), mesh) for name, mesh in things.items()]
    todo += [(f"open {name}", without_underside(things[name]), things[name]) for name in ("wrench", "knife")]
    if given.folder is not None:
        todo += [(p.stem, p, None) for p in sorted(given.folder.iterdir()) if p.suffix.lower() in SUFFIXES]
    closed_mesh = repair_of()
    for name, source, clean in todo:
        if name in {row["object"] for row in rows}:
            continue
        rows.append(measure(closed_mesh, name, source, given.grasps, clean))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        if out is not None:
            out.write_text(json.dumps({**stored, "objects": rows}, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
