"""Convex pieces of objects, by our planes and by CoACD: `python bench/pieces.py [DIR] [--only NAME ...] [--json OUT]`.

The objects: an instance of each of the 16 families, the five of `bench/meshes.py`, and every mesh of DIR, repaired.

Measured of each: CPU seconds (all threads); pieces; how far the surface lies outside all of them (corners and 20,000 samples)
and how far they stick out of it (4,000 samples of each), mm; their union's volume too much and too little, as shares of the
solid's (manifold3d); whether another run with one thread gives the same bits (of what takes no more than `ASKED_S`).

All ways on 40 objects take some twenty minutes of CPU; no JSON of it is kept, and no page cites it. What was found stands at
`convex_pieces`.
"""

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import coacd
import numpy as np
import trimesh
from _report import Report, markdown_table
from manifold3d import Manifold, Mesh64
from meshes import SUFFIXES, drawn
from run import Bench
from threadpoolctl import threadpool_limits

from r2h_batch.scene.families.draw import draw_instance
from r2h_batch.scene.mesh_import.closed import closed_mesh
from r2h_batch.scene.mesh_import.manifold import simplified_to
from r2h_batch.scene.mesh_import.pieces import MAX_PIECES, Hull, convex_hull, convex_pieces
from r2h_batch.scene.objects import OBJECT_NAMES
from r2h_batch.scene.solid import Surface

MEASURES = (
    "bench/pieces.py",
    "r2h_batch/scene/mesh_import/cut.py",
    "r2h_batch/scene/mesh_import/pieces.py",
)
SEED = 77
"""The families' seed."""
ASKED_S, ASKED_MM = 6.0, 0.1
"""CPU seconds that an object may take; how far its surface may lie outside of its pieces."""
BOX = trimesh.creation.box((0.05, 0.06, 0.1))
FEW: dict[str, Any] = {"mcts_nodes": 8, "mcts_iterations": 20, "mcts_max_depth": 2}
COACD: dict[str, dict[str, Any]] = {
    "default": {},
    "few": {"detail_m": 5e-5, **FEW},
    "coarse": {"detail_m": 5e-5, "threshold": 0.1, "resolution": 500, **FEW},
    "metric": {"detail_m": 5e-5, "threshold": 0.003, "real_metric": True, **FEW},
}
"""CoACD's options; `detail_m`: on a surface with that much less detail."""


def by_coacd(solid: trimesh.Trimesh, detail_m: float | None = None, **options: Any) -> list[Hull]:
    """Convex pieces as CoACD gives them: fixed seed, the surface as it is, all corners of each hull."""
    given = solid if detail_m is None else simplified_to(solid, detail_m)
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(given.vertices, given.faces),
        **{"max_convex_hull": MAX_PIECES, "preprocess_mode": "off", "seed": 0, **options},
    )
    solids = [np.asarray(corners) for corners, _ in found if len(corners) > 3 and volume_of(corners) > 0]
    return [convex_hull(corners) for corners in solids]


def volume_of(corners: Any) -> float:
    return float(Manifold.hull_points(np.asarray(corners, np.float64)).volume())


WAYS: dict[str, Callable[[trimesh.Trimesh], list[Hull]]] = {
    "planes": lambda solid: convex_pieces(solid, "object"),
    **{f"coacd_{name}": partial(by_coacd, **options) for name, options in COACD.items()},
}


def things(folder: Path | None) -> dict[str, trimesh.Trimesh]:
    """Closed surfaces, rounded as a built object's are."""
    found = {f"family_{name}": draw_instance(name, SEED, 0).mesh for name in OBJECT_NAMES} | drawn()
    for path in sorted(folder.iterdir()) if folder is not None else ():
        if path.suffix.lower() in SUFFIXES:
            found[path.stem] = closed_mesh(path, path.stem, 1.0).mesh
    return {
        name: trimesh.Trimesh(mesh.vertices.astype(np.float32).astype(np.float64), mesh.faces, process=False)
        for name, mesh in found.items()
    }


def manifold(vertices: Any, faces: Any) -> Manifold:
    arrays = np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C")
    return Manifold(Mesh64(*arrays))


def measured(solid: trimesh.Trimesh, pieces: list[Hull]) -> dict[str, Any]:
    """Figures of the pieces of a solid."""
    points = np.concatenate([solid.vertices, trimesh.sample.sample_surface(solid, 20_000, seed=1)[0]])
    outside, union, skin = np.full(len(points), np.inf), Manifold(), []
    for vertices, faces in pieces:
        piece = trimesh.Trimesh(vertices.astype(np.float64), faces, process=False)
        height = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        depth = np.full(len(points), -np.inf)
        for n, h in zip(piece.face_normals, height, strict=True):
            depth = np.maximum(depth, points @ n - h)
        outside = np.minimum(outside, depth)
        union += manifold(vertices, faces)
        skin.append(trimesh.sample.sample_surface(piece, 4_000, seed=2)[0])
    whole = manifold(solid.vertices, solid.faces)
    return {
        "pieces": len(pieces),
        "outside_mm": round(1e3 * float(outside.max()), 4),
        "sticks_out_mm": round(1e3 * float(Surface(solid).signed(np.concatenate(skin))[0].max()), 3),
        "too_much": round((union - whole).volume() / whole.volume(), 4),
        "too_little": round((whole - union).volume() / whole.volume(), 5),
    }


def compared(name: str, solid: trimesh.Trimesh, ways: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Figures of these ways for one object."""
    found: dict[str, dict[str, Any]] = {}
    for way in ways:
        begin = time.process_time()
        pieces = WAYS[way](solid)
        spent = round(time.process_time() - begin, 2)
        found[way] = {"cpu_s": spent, **measured(solid, pieces)}
        if spent <= ASKED_S:
            with threadpool_limits(1):
                found[way]["same_bits"] = bits(WAYS[way](solid)) == bits(pieces)
        print(name, len(solid.faces), way, json.dumps(found[way]), file=sys.stderr, flush=True)
    return found


def bits(pieces: list[Hull]) -> bytes:
    return b"".join(array.tobytes() for piece in pieces for array in piece)


def summary(rows: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """A line for each way, over all objects."""
    lines: list[list[object]] = []
    for way in next(iter(rows.values())):
        found = [row[way] for row in rows.values()]
        kept = sum(r["cpu_s"] <= ASKED_S and r["outside_mm"] <= ASKED_MM for r in found)
        less = sum(r[way]["too_much"] < r["planes"]["too_much"] for r in rows.values() if "planes" in r)
        shown = [[r[key] for r in found] for key in ("cpu_s", "pieces", "outside_mm", "sticks_out_mm", "too_much")]
        of_each = [f"{np.median(values):.3g} ({max(values):.3g})" for values in shown]
        lines.append([way, f"{kept} of {len(found)}", *of_each, less])
    within = f"within {ASKED_S:g} s and {ASKED_MM} mm"
    head = ["way", within, "CPU s", "pieces", "outside, mm", "sticks out, mm", "too much", "less of it"]
    return (
        f"{markdown_table(head, lines)}\n\nMedian (most). Less of it: objects with less volume too much than by planes."
    )


def run(asked: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    warnings.simplefilter("ignore")
    for way in asked.ways:  # imports, kernels
        measured(BOX, WAYS[way](BOX))
    solids = things(asked.folder)
    if unknown := [name for name in asked.only or () if name not in solids]:
        sys.exit(f"--only {' '.join(unknown)}: there are {', '.join(solids)}")
    rows = {name: compared(name, solids[name], asked.ways) for name in asked.only or solids}
    for name, found in rows.items():
        for way, row in found.items():
            for key, value in row.items():
                report.add(f"pieces.{name}.{way}.{key}", value)
    print(summary(rows))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "folder": {"type": Path, "nargs": "?"},
        "--only": {"nargs": "+", "metavar": "NAME", "help": "these objects"},
        "--ways": {"nargs": "+", "choices": WAYS, "default": list(WAYS), "help": "these ways (default: all)"},
    },
    peer="CoACD",
)

if __name__ == "__main__":
    BENCH.main()
