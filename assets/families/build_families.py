"""Builds the shipped instances of all families, or the training instances (needs the ``build`` extra):
``python -m r2h_batch.assets.families.build_families [--training build/families]``.

Shipped: ``NAME.npz`` (an `ObjectModel`), ``grasps.npz`` and ``grasps_as_generated.npz`` with the arrays of assets/objects,
``receiving.npz``, ``held_out.npz`` and ``capacity.npz`` with those of assets/receiving, and
``report.json``: parameters, size, mass, way of resting and digest of each. Hands are those of the built-in people (after
build_people). Training instances have keys of their own, stay out of the wheel, and are objects alone.
``--only receiving`` makes that file anew, of the stored objects; ``--only held_out`` makes held_out.npz and capacity.npz.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.assets.hand.build_hand import write_npz
from r2h_batch.assets.people.build_held_out import made
from r2h_batch.data.people import people_hand
from r2h_batch.methods.grasps import generate_grasps, sample_grasps
from r2h_batch.scene.arrays import read_arrays
from r2h_batch.scene.families.draw import SHIPPED, TRAINING, Instance, draw_instance, model_of
from r2h_batch.scene.families.family import FAMILIES
from r2h_batch.scene.objects import OBJECT_NAMES, SAID, ObjectModel, load_objects, object_digest
from r2h_batch.scene.objects import SHIPPED_INSTANCES as TESTS
from r2h_batch.trials.holding.sampler import sample_receiving

HERE = Path(__file__).resolve().parent
LEARNED = 12
"""Training instances of a category."""
GRASPS = ("T_obj_ee", "width", "score", "part")

HOLDS = {"receiving": ("receiving",), "held_out": ("held_out", "capacity")}
"""Files of hands that hold an instance, by what makes them."""
FILES = ("grasps", "grasps_as_generated", *HOLDS["receiving"], *HOLDS["held_out"])

Arrays = dict[str, NDArray[Any]]


def built(series: int, held_out: bool, job: tuple[str, int]) -> tuple[ObjectModel, dict[str, Arrays], dict[str, Any]]:
    """One instance: its model, its arrays by file, and what the report says."""
    category, index = job
    begin = time.process_time()
    instance = draw_instance(category, series, index)
    model = model_of(instance)
    name = instance.name
    found: dict[str, Arrays] = {}
    if series == SHIPPED:
        filtered, proposed = sample_grasps(model), generate_grasps(model)
        found["receiving"] = sample_receiving(model, hand=people_hand())
        found["grasps"] = {k: getattr(filtered, k) for k in GRASPS}
        found["grasps_as_generated"] = {k: getattr(proposed, k) for k in GRASPS}
    if held_out and series == SHIPPED:
        found |= hands_of(model, "held_out")
    named = {file: {f"{name}/{k}": v for k, v in arrays.items()} for file, arrays in found.items()}
    return model, named, described(instance, model) | {"cpu_s": round(time.process_time() - begin, 1)}


def hands_of(model: ObjectModel, what: str) -> dict[str, Arrays]:
    """Arrays of an object by file: each of the files `HOLDS[what]`."""
    if what == "receiving":
        return {what: sample_receiving(model, hand=people_hand())}
    return dict(zip(HOLDS[what], made(model), strict=True))


def held(what: str, job: tuple[str, int]) -> tuple[str, dict[str, Arrays], float]:
    """A stored instance's name, its arrays of each of the files `HOLDS[what]`, and the CPU seconds they took."""
    begin, name = time.process_time(), f"{job[0]}_{job[1]:02d}"
    (model,) = load_objects([name])
    named = {file: {f"{name}/{k}": v for k, v in arrays.items()} for file, arrays in hands_of(model, what).items()}
    return name, named, time.process_time() - begin


def make_only(what: str, jobs: list[tuple[str, int]], out: Path, pool: ProcessPoolExecutor) -> None:
    """Writes `HOLDS[what]` after each instance, so that what is made survives an interrupted run."""
    files = HOLDS[what]
    known = {f: read_arrays(p) if (p := out / f"{f}.npz").exists() else {} for f in files}
    there = [{key.partition("/")[0] for key in known[f]} for f in files]
    todo = [(c, i) for c, i in jobs if not all(f"{c}_{i:02d}" in names for names in there)]
    order = [f"{c}_{i:02d}" for c in OBJECT_NAMES for i in range(TESTS)]
    for name, found, seconds in pool.map(partial(held, what), todo):
        left = int(found[files[0]][f"{name}/side"].sum())
        right = len(found[files[0]][f"{name}/side"]) - left
        print(f"{name:20s} {right} right, {left} left, {seconds:5.1f} CPU-s", flush=True)
        for f in files:
            known[f] |= found[f]
            write_npz(out / f"{f}.npz", {k: known[f][k] for n in order for k in known[f] if k.startswith(f"{n}/")})


def described(instance: Instance, model: ObjectModel) -> dict[str, Any]:
    """The report's line of an instance; lengths in millimetres."""
    mesh = instance.mesh
    return {
        "category": instance.family.category,
        "split": model.split,
        "size_mm": (1000 * mesh.extents).round(1).tolist(),
        "mass_kg": model.mass,
        "rests": instance.rest,
        "faces": len(model.faces),
        "watertight": bool(mesh.is_watertight and mesh.is_winding_consistent),
        "bodies": int(mesh.body_count),
        "receiver_area_share": round(float(model.mesh.area_faces[model.receiver_face].sum() / model.mesh.area), 3),
        "parameters": instance.parameters,
        "digest": object_digest(model),
    }


def jobs_of(name: str, count: int) -> list[tuple[str, int]]:
    """All instances of a category, or the one of this name."""
    category, _, index = name.rpartition("_")
    return [(category, int(index))] if category in FAMILIES and index.isdigit() else [(name, i) for i in range(count)]


def main() -> None:
    """Writes all files and prints a line per instance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="categories, or instances such as cup_04; default: all categories")
    parser.add_argument("--training", type=Path, help="write the training instances into this folder instead")
    parser.add_argument("--count", type=int, help="instances of each category; default: 6 to ship, 12 to learn from")
    parser.add_argument(
        "--without-held-out", action="store_true", help="keep the stored held-out grasps and what they withstand"
    )
    parser.add_argument("--only", choices=tuple(HOLDS), help="make what these files lack, of the stored instances")
    parser.add_argument("--out", type=Path, default=HERE, help="folder to write (default: assets/families)")
    parser.add_argument("--jobs", type=int, default=1, help="instances made at a time; the result is the same")
    args = parser.parse_args()
    series, count = (TRAINING, LEARNED) if args.training else (SHIPPED, TESTS)
    count = args.count or count
    out = args.training or args.out
    out.mkdir(parents=True, exist_ok=True)
    jobs = [job for name in args.names or OBJECT_NAMES for job in jobs_of(name, count)]
    if args.only:
        with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            make_only(args.only, jobs, out, pool)
        return
    path = out / "report.json"
    report: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    stored: dict[str, Arrays] = {p.stem: dict(read_arrays(p)) for p in out.glob("*.npz") if p.stem in FILES}
    make = partial(built, series, not args.without_held_out)
    with ProcessPoolExecutor(args.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        for model, arrays, line in pool.map(make, jobs):
            values = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model) if f.name not in SAID}
            np.savez_compressed(out / f"{model.name}.npz", allow_pickle=False, **values)
            for file, found in arrays.items():
                stored.setdefault(file, {}).update(found)
            report[model.name] = line
            print(model.name, {k: v for k, v in line.items() if k not in ("parameters", "digest")}, flush=True)
    order = [f"{c}_" for c in OBJECT_NAMES]
    names = sorted(report, key=lambda n: (order.index(n.rpartition("_")[0] + "_"), n))
    for file, known in stored.items():
        write_npz(out / f"{file}.npz", {k: known[k] for n in names for k in known if k.startswith(f"{n}/")})
    path.write_text(json.dumps({n: report[n] for n in names}, indent=1) + "\n")


if __name__ == "__main__":
    main()
