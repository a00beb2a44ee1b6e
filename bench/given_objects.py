"""Somebody's meshes through build, grasps and every method: `python bench/given_objects.py DIR [--json OUT]`.

`--synthetic`: a mug and a bottle of 20,000 faces (`_drawn.py`), without DIR or after it. `--trials N` of each object (20),
`--methods A,B` or none (all). Objects that OUT holds already are not measured again; `--again` forgets them. `--docs` puts the
table into docs/results/objects.md. All figures of that table, on an idle machine:
`python bench/given_objects.py DIR --synthetic --again --json bench/results/given_objects.json --docs`.

Measured: CPU seconds (all threads of the process, kernels compiled) of the build, of the convex decomposition, of the grasp
candidates and of the receiving grasps, with nothing kept on disk, and their sum, also for each face; how far points of the
surface stick out of the convex pieces and by how much these have more volume; what the repair changed; how many receiving
grasps were found; and how many of N trials (S0, the built-in hands, the motion as planned) each method solves. Compared with
nothing: the oracle is the bound.
"""

import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from _drawn import write
from _report import made_by
from repair import share_within, thinnest_wall

os.environ.setdefault("R2H_BATCH_CACHE", "off")

METHODS = ("oracle", "random", "fc", "handover-va", "contact", "intent")
SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb")
MOST_S = 5.0
"""What an object of 20,000 faces may take."""
PAGE, HEAD, SUM = Path(__file__).resolve().parents[1] / "docs/results/objects.md", "| object | faces |", "Within 5 s: "


def measure(path: Path, trials: int, methods: Sequence[str]) -> dict[str, Any]:
    """The figures of one mesh file."""
    from r2h_batch import Evaluator, make_trials
    from r2h_batch.bodies.mesh_import.pieces import convex_pieces
    from r2h_batch.bodies.objects import ObjectMeshError, build_object
    from r2h_batch.methods.candidates import candidates_of
    from r2h_batch.receiver.receiving import load_receiving
    from r2h_batch.sweep.jobs import Setting, make_jobs
    from r2h_batch.sweep.options import Options

    start = time.process_time()
    try:
        model = build_object(path, pieces=False)
    except ObjectMeshError as error:
        return {"object": path.stem, "refused": str(error)}
    built = time.process_time()
    pieces = convex_pieces(model.mesh, model.name)
    decomposed = time.process_time()
    row: dict[str, Any] = {
        "object": path.stem,
        "faces": len(model.faces),
        "build_cpu_s": round(built - start, 2),
        "pieces_cpu_s": round(decomposed - built, 2),
        **held_by(pieces, model),
        "volume_cm3": round(1e6 * float(model.mesh.volume), 2),
        "within_99_mm": round(1e3 * share_within(model.mesh, given_faces(path)), 4),
        "thinnest_wall_mm": round(1e3 * thinnest_wall(model.mesh), 2),
    }
    if model.repair:
        given = model.repair.volume_given_m3
        row |= {"steps": list(model.repair.steps), "moved_mm": round(1e3 * model.repair.moved_m, 3)}
        row["volume_change"] = None if not given else round(model.repair.volume_m3 / given - 1, 4)
    begin = time.process_time()
    row["grasps"] = len(candidates_of((model,))[0])
    row["grasps_cpu_s"] = round(time.process_time() - begin, 2)
    begin = time.process_time()
    row["receiving"] = len(load_receiving((model,)))
    row["receiving_cpu_s"] = round(time.process_time() - begin, 2)
    made = ("build_cpu_s", "pieces_cpu_s", "grasps_cpu_s", "receiving_cpu_s")
    row["all_cpu_s"] = round(sum(row[k] for k in made), 2)
    row["cpu_ms_per_face"] = round(1e3 * row["all_cpu_s"] / row["faces"], 3)
    if not methods or not row["grasps"]:
        return row
    evaluator = Evaluator(objects=[model])
    asked = make_trials(["S0"], trials, objects=[model])

    setting = Setting(evaluator, {}, lambda first, last: asked.trial_id[first:last], lambda ids: asked)
    for method in methods:
        begin = time.process_time()
        (job,) = make_jobs(Options(method=(method,)), [], setting)
        answer = job.predict(asked, None)
        scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, asked)
        row[method] = int(scores.success.sum())
        row[f"{method}_cpu_s"] = round(time.process_time() - begin, 1)
        row["cannot"] = [*row.get("cannot", []), *job.lines]
    return row


def given_faces(path: Path) -> Any:
    """The mesh of a file as it is."""
    from r2h_batch.bodies.mesh_import.file import load_mesh_file

    return load_mesh_file(path, path.stem)


def held_by(pieces: Sequence[tuple[Any, Any]], model: Any) -> dict[str, Any]:
    """How many pieces, how far the surface's 2,048 points stick out of them, and their volume as a share of the solid's."""
    import numpy as np
    import trimesh

    depth, volume = np.full(len(model.points), np.inf), 0.0
    for vertices, faces in pieces:
        piece = trimesh.Trimesh(vertices.astype(float), faces, process=False)
        offset = np.einsum("ij,ij->i", piece.face_normals, piece.triangles[:, 0])
        depth = np.minimum(depth, (model.points @ piece.face_normals.T - offset).max(axis=1))
        volume += float(piece.volume)
    out = max(0.0, float(depth.max()))
    return {
        "pieces": len(pieces),
        "pieces_out_mm": round(1e3 * out, 3),
        "pieces_volume": round(volume / model.mesh.volume, 3),
    }


def warm() -> None:
    """Compiles and loads every kernel that is measured, on a box."""
    import numpy as np
    import trimesh

    from r2h_batch.bodies.objects import build_object
    from r2h_batch.methods.grasps.sample import sample_grasps
    from r2h_batch.receiver.sampler import sample_receiving

    box = build_object(trimesh.creation.box((0.05, 0.06, 0.1)), "box")
    opened = trimesh.creation.box((0.05, 0.06, 0.1))
    opened.update_faces(np.arange(len(opened.faces)) > 0)
    build_object(opened, "opened")  # its repair asks for distances
    sample_grasps(box, count=10, enough=10)
    sample_receiving(box, per_side=2)


def table(rows: list[dict[str, Any]], trials: int) -> str:
    """The figures as Markdown."""
    head = [
        "object",
        "faces",
        "build",
        "pieces",
        "grasps",
        "receiving",
        "in all",
        "a face",
        "volume",
        "99 % within",
        "thinnest wall",
        "surface moved",
        *METHODS,
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for r in rows:
        if "refused" in r:
            lines.append(f"| {r['object']} | refused: {r['refused']} |")
            continue
        change = r.get("volume_change")
        cells = [r["object"].removeprefix("sh3d_"), r["faces"], f"{r['build_cpu_s']} s", f"{r['pieces_cpu_s']} s"]
        cells += [f"{r[k]} in {r[f'{k}_cpu_s']} s" for k in ("grasps", "receiving")]
        cells += [f"{r['all_cpu_s']} s", f"{1e3 * r['all_cpu_s'] / r['faces']:.2f} ms"]
        cells.append("" if change is None else f"{100 * change:+.2f} %")
        cells += [f"{r['within_99_mm']:.3f} mm", f"{r['thinnest_wall_mm']:.2f} mm"]
        cells += [
            f"{r['moved_mm']} mm" if "moved_mm" in r else "as given",
            *(f"{r.get(m, '-')}/{trials}" for m in METHODS),
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def summary(rows: list[dict[str, Any]]) -> str:
    """How many objects take no more than they may, and what the others take."""
    built = [r for r in rows if "all_cpu_s" in r]
    over = sorted((r for r in built if r["all_cpu_s"] > MOST_S), key=lambda r: -r["all_cpu_s"])
    others = ", ".join(f"{r['object'].removeprefix('sh3d_')} {r['all_cpu_s']} s" for r in over)
    return f"{SUM}{len(built) - len(over)} of {len(built)} objects" + (f"; {others}." if others else ".")


def write_docs(text: str, said: str) -> None:
    """Puts table and summary in the place of those that the page has."""
    lines = PAGE.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(HEAD))
    last = first + next(i for i, line in enumerate([*lines[first:], ""]) if not line.startswith("|"))
    after = lines[last:]
    if after[1:2] and after[1].startswith(SUM):
        after = after[2:]
    PAGE.write_text("\n".join([*lines[:first], text, "", said, *after]) + "\n")


def main(arguments: list[str]) -> int:
    """Exit code: 0 measured."""
    words = list(arguments)
    out = Path(words.pop(words.index("--json") + 1)) if "--json" in words else None
    trials = int(words.pop(words.index("--trials") + 1)) if "--trials" in words else 20
    chosen = words.pop(words.index("--methods") + 1) if "--methods" in words else ",".join(METHODS)
    methods = [m for m in chosen.split(",") if m != "none"]
    warnings.simplefilter("ignore")
    keep = out is not None and out.exists() and "--again" not in words
    stored: dict[str, Any] = json.loads(out.read_text()) if keep and out is not None else {**made_by()}
    rows: list[dict[str, Any]] = stored.get("objects", [])
    known = {row["object"] for row in rows}
    with tempfile.TemporaryDirectory() as drawn:
        folders = [Path(w) for w in words if not w.startswith("--")]
        paths = [p for folder in folders for p in sorted(folder.iterdir()) if p.suffix.lower() in SUFFIXES]
        paths += write(Path(drawn)) if "--synthetic" in words else []
        wanted = [p for p in paths if p.stem not in known]
        if wanted:
            warm()
        for path in wanted:
            rows.append(measure(path, trials, methods))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
            if out is not None:
                out.write_text(json.dumps({**stored, "trials": trials, "objects": rows}, indent=1) + "\n")
    print(table(rows, trials), summary(rows), sep="\n\n")
    if "--docs" in words:
        write_docs(table(rows, trials), summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
