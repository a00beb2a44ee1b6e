"""What the repair of a mesh does to it and to grasps: `python bench/repair.py DIR [--json OUT] [--grasps 4000]`.

Objects that OUT holds already are not measured again.

Every mesh of DIR, and four closed ones made here (mug, wrench, knife, clamp) to which two slivers are glued.
Measured, with nothing kept on disk: the volume before and after where the given surface has one (bodies that overlap count twice
there); how much of space is inside one of the two and not in the other, as a share of the repaired volume, by winding numbers
of both surfaces in float64 at random points (`tests/support/mesh_twins.py`, which shares no code with the repair; an open
surface has fractions, of which more than a half counts as inside); how far the surface moved; and of 4,000 grasps how many
pass Stability on the repaired surface and not on the one that it is compared with, or the other way: the given faces as they
are, or, of the four that are made, those without what was glued to them.
"""

import json
import sys
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

    from r2h_batch.judge.grasp import close_gripper
    from r2h_batch.scene.grasp_tables import grasp_tables

    faces = np.asarray(mesh.faces, np.int32)
    model = SimpleNamespace(
        vertices=np.asarray(mesh.vertices, np.float32), faces=faces, receiver_face=np.zeros(len(faces), bool)
    )
    tables = grasp_tables([model])  # type: ignore[list-item]
    return close_gripper(tables, T_obj_ee, torch.zeros(len(T_obj_ee), dtype=torch.int32)).margin_m.numpy()


def measure(name: str, source: Any, count: int, clean: Any = None) -> dict[str, Any]:
    """The figures of one mesh: against `clean`, or against its own faces as they are given."""
    import numpy as np
    from mesh_twins import winding_number

    from r2h_batch.bodies.mesh_import.closed import closed_mesh

    closed = closed_mesh(source, name, 1.0)
    mesh, repair, other = closed.mesh, closed.repair, closed.given if clean is None else clean
    given = repair.volume_given_m3 if clean is None else float(clean.volume)
    low, high = np.minimum(mesh.bounds[0], other.bounds[0]), np.maximum(mesh.bounds[1], other.bounds[1])
    points = np.random.default_rng(5).uniform(low, high, (POINTS, 3))
    inside, before = (winding_number(m, points) > 0.5 for m in (mesh, other))
    T = grasps(mesh, count)
    one, two = stable(mesh, T), stable(other, T)
    flips = (one >= 0) != (two >= 0)
    clear = flips & (np.abs(one) > NEAR_M) & (np.abs(two) > NEAR_M)
    return {
        "object": name,
        "faces": len(closed.given.faces),
        "steps": list(repair.steps),
        "volume_given_cm3": None if given is None else round(1e6 * given, 3),
        "volume_cm3": round(1e6 * repair.volume_m3, 3),
        "volume_change": None if given is None else round(repair.volume_m3 / given - 1, 6),
        "differs_inside": round(float((inside != before).sum() / max(int(inside.sum()), 1)), 5),
        "points_inside": int(inside.sum()),
        "moved_mm": round(1e3 * repair.moved_m, 4),
        "grasps": count,
        "stable": int((one >= 0).sum()),
        "flips": int(flips.sum()),
        "flips_clear": int(clear.sum()),
        "margin_differs_mm": round(1e3 * float(np.quantile(np.abs(one - two), 0.99)), 4),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures as Markdown."""
    lines = [
        "| object | repaired | volume | inside of one alone | surface moved | grasps that flip |",
        "|---" * 6 + "|",
    ]
    for r in rows:
        change = "open as given" if r["volume_change"] is None else f"{100 * r['volume_change']:+.2f} %"
        cells = [r["object"], "; ".join(r["steps"]) or "no", change, f"{100 * r['differs_inside']:.2f} %"]
        cells += [f"{r['moved_mm']:.3f} mm", f"{r['flips']} of {r['grasps']} ({r['stable']} hold)"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measures and prints."""
    parser = arguments(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--grasps", type=int, default=4000)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    out: Path | None = given.json
    stored: dict[str, Any] = json.loads(out.read_text()) if out is not None and out.exists() else made_by()
    rows: list[dict[str, Any]] = stored.get("objects", [])
    todo: list[tuple[str, Any, Any]] = [(name, spoiled(mesh), mesh) for name, mesh in made().items()]
    todo += [(p.stem, p, None) for p in sorted(given.folder.iterdir()) if p.suffix.lower() in SUFFIXES]
    for name, source, clean in todo:
        if name in {row["object"] for row in rows}:
            continue
        rows.append(measure(name, source, given.grasps, clean))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        if out is not None:
            out.write_text(json.dumps({**stored, "objects": rows}, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
