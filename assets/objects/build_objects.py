"""Builds the built-in objects (needs the ``build`` extra): ``python -m r2h_batch.assets.objects.build_objects [NAME ...]``.

Solids come from the shapes_*.py files in millimetres, are remeshed to even triangles, centred on their bounding
box, and written as ``<name>.npz``; ``report.json`` states what came out. Two runs give the same bytes.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import Manifold

from r2h_batch.assets.objects import shapes_s0, shapes_s1, shapes_s1_goods
from r2h_batch.scene.families.remesh import Surface, Vec, imprint, remesh
from r2h_batch.scene.families.shapes import Parts, Spec
from r2h_batch.scene.objects import (
    BUILT_IN_NAMES,
    OBJECT_NAMES,
    SAID,
    ObjectModel,
    build_object,
    object_digest,
    read_object,
)

HERE = Path(__file__).resolve().parent
SPECS = {s.name: s for s in (*shapes_s0.SPECS, *shapes_s1.SPECS, *shapes_s1_goods.SPECS)}


def build(spec: Spec) -> ObjectModel:
    """One object, from its solid to all derived data."""
    part = Parts()
    surface = _labelled_surface(spec, spec.solid(part), part)
    names = list(spec.parts)
    for source, (normal, offset), target in spec.cuts:
        unit = np.asarray(normal, float) / np.linalg.norm(normal)

        def height(p: Vec, u: np.ndarray = unit, d: float = offset) -> float:
            return p[0] * u[0] + p[1] * u[1] + p[2] * u[2] - d

        imprint(surface, height, 0.15 * spec.edge)
        old, new = names.index(source), names.index(target)
        for k, face in enumerate(surface.f):
            if face is not None and surface.label[k] == old:
                middle = np.mean([surface.v[a] for a in face], axis=0)
                if middle @ unit > offset:
                    surface.label[k] = new
    _absorb_specks(surface, spec.edge**2)
    remesh(surface, [dict(spec.fine).get(n, spec.edge) for n in names])
    vertices, faces, label = surface.arrays()
    vertices = (vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2) / 1000
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    wanted = [names.index(p) for p in spec.receiver]
    return build_object(
        mesh,
        spec.name,
        spec.split,
        receiver=np.isin(label, wanted) if spec.split == "S1" else None,
        mass=spec.mass,
        instruction=f"hand over the {spec.name.replace('_', ' ')}{' ' + spec.take if spec.take else ''} to human",
        face_part=label,
        part_names=spec.parts,
        pieces="fine",
    )


def report(model: ObjectModel, spec: Spec) -> dict[str, object]:
    """The figures of one object; lengths in millimetres."""
    mesh = model.mesh
    size = (mesh.extents * 1000).round(1)
    pieces = [trimesh.Trimesh(v.astype(float), f, process=False) for v, f in model.pieces]
    planes = [(p.face_normals, np.einsum("ij,ij->i", p.face_normals, p.triangles[:, 0])) for p in pieces]
    depth = np.min([(model.points.astype(float) @ n.T - d).max(axis=1) for n, d in planes], axis=0)
    ratio = mesh.area_faces / (mesh.edges_unique_length[mesh.faces_unique_edges].max(axis=1) ** 2 * np.sqrt(3) / 4)
    hull = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
    return {
        "size_mm": size.tolist(),
        "table_mm": list(spec.size),
        "size_error_percent": (100 * (np.sort(size) / np.sort(spec.size) - 1)).round(1).tolist(),
        "mass_kg": model.mass,
        "faces": len(model.faces),
        "hull_vertices": len(model.hull_vertices),
        "hull_overshoot_mm": round(1e3 * _overshoot(mesh, hull), 3),
        "volume_cm3": round(float(mesh.volume) * 1e6, 2),
        "hull_volume_cm3": round(float(hull.volume) * 1e6, 2),
        "watertight": bool(mesh.is_watertight and mesh.is_winding_consistent),
        "bodies": int(mesh.body_count),
        "triangle_quality_p1_median": np.quantile(ratio, [0.01, 0.5]).round(3).tolist(),
        "pieces": len(pieces),
        "pieces_volume_cm3": round(float(sum(p.volume for p in pieces)) * 1e6, 2),
        "surface_points_outside_pieces_mm": [round(float(np.quantile(depth, q)) * 1000, 3) for q in (0.5, 0.95, 1.0)],
        "parts": {n: int((model.face_part == k).sum()) for k, n in enumerate(model.part_names)},
        "receiver_parts": list(spec.receiver),
        "receiver_area_share": round(float(mesh.area_faces[model.receiver_face].sum() / mesh.area), 3),
        "frame": spec.frame,
        "digest": object_digest(model),
    }


def _absorb_specks(surface: Surface, area: float) -> None:
    """Patches of a label smaller than an area take the label that borders them most."""
    vertices, faces, label = surface.arrays()
    live = [k for k, face in enumerate(surface.f) if face is not None]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    pairs, length = (
        mesh.face_adjacency,
        np.linalg.norm(np.diff(vertices[mesh.face_adjacency_edges], axis=1)[:, 0], axis=1),
    )
    same = label[pairs[:, 0]] == label[pairs[:, 1]]
    patch = trimesh.graph.connected_component_labels(pairs[same], node_count=len(faces))
    for k in np.flatnonzero(np.bincount(patch, mesh.area_faces) < area):
        border = ~same & (patch[pairs] == k).any(axis=1)
        other = np.where(patch[pairs[border, 0]] == k, label[pairs[border, 1]], label[pairs[border, 0]])
        new = int(np.argmax(np.bincount(other, length[border])))
        for f in np.flatnonzero(patch == k):
            surface.label[live[f]] = new


def _overshoot(mesh: trimesh.Trimesh, hull: trimesh.Trimesh) -> float:
    exact = trimesh.convex.convex_hull(mesh.vertices)
    offset = np.einsum("ij,ij->i", exact.face_normals, exact.triangles[:, 0])
    return max(0.0, float((hull.vertices @ exact.face_normals.T - offset).max()))


def _labelled_surface(spec: Spec, solid: Manifold, part: Parts) -> Surface:
    mesh = solid.to_mesh64()
    label = np.zeros(len(mesh.tri_verts), np.int64)
    bounds = np.asarray(mesh.run_index) // 3
    for k, original in enumerate(mesh.run_original_id):
        label[bounds[k] : bounds[k + 1]] = spec.parts.index(part.names[int(original)])
    return Surface(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64), label)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="objects to build (default: all)")
    parser.add_argument("--out", type=Path, default=HERE)
    args = parser.parse_args()
    path = args.out / "report.json"
    figures = json.loads(path.read_text())["objects"] if path.exists() else {}
    for name in args.names or BUILT_IN_NAMES:
        model = build(SPECS[name])
        arrays = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model) if f.name not in SAID}
        np.savez_compressed(args.out / f"{name}.npz", allow_pickle=False, **arrays)
        figures[name] = report(model, SPECS[name])
        print(name, {k: v for k, v in figures[name].items() if k not in ("frame", "digest", "parts")}, flush=True)
    ordered = {n: figures[n] for n in BUILT_IN_NAMES if n in figures}
    stored = [read_object(str(args.out / f"{n}.npz")) for n in ordered if n in OBJECT_NAMES]
    total = object_digest(stored) if len(stored) == len(OBJECT_NAMES) else None  # of r2h-v0 and r2h-v1
    path.write_text(json.dumps({"digest": total, "objects": ordered}, indent=1) + "\n")


if __name__ == "__main__":
    main()
