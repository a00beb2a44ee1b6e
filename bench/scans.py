"""Methods on meshes of yours, beside Table I: docs/results/questions.md.

`python bench/scans.py FOLDER --about bench/SET.toml` sweeps the meshes of a folder on r2h-v2 and on fewer trials of r2h-v3
(motion as planned), keeps the rows in bench/options/SET and SET-v3 and the figures in bench/results/SET.json. It fetches nothing.
NAME.yaml beside NAME.obj says what a mesh does not (docs/your_data.md); where there is none, the file of --about says a mesh's
region, and whose it is. Meshes without a region are of S0. Then `python bench/figures.py --write` writes the page.
"""

import argparse
import json
import os
import shutil
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, Report, markdown_table
from _rows import kept_rows, rates_of
from networks import region_areas
from run import Bench

from r2h_batch.methods.predictors import Contacts
from r2h_batch.trials.edit import MESHES

SETS = ("scanned", "scans")
"""The sets of the page, in its order: bench/SET.toml."""
MEASURES = (
    *("bench/scans.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/trials",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)
UNSEEN = "contact,contacts=other-categories"
WORDS = {
    "random": "random",
    "oracle": "oracle",
    "fc": "FC",
    "handover-va": "VA",
    "contact": "Contact",
    UNSEEN: "Contact that never saw the category",
    "intent": "Intent",
}
"""Word of the sweep -> name on the page."""
AREAS: dict[str, Contacts] = {"contact": "left-out", UNSEEN: "other-categories"}
COPIED = Path("runs/scans-objects")
"""The meshes of the sweep, relative to the checkout: no row says where on a machine a folder lies."""
FLAGS = ("--execute.sim", "none", "--no-poses")
TRIALS = 180
TRIALS_V3 = 60


def copied(folder: Path, about: Mapping[str, Any]) -> Path:
    """Copies the meshes of a folder and what is said of them into `COPIED`; that place.

    Args:
        folder: of meshes, and of NAME.yaml beside some.
        about: name of a mesh -> its `region` and `category`.

    Raises:
        SystemExit: no mesh is there, or `about` names another one.
    """
    meshes = sorted(p for p in folder.glob("*") if p.suffix.lower() in MESHES)
    if not meshes:
        raise SystemExit(f"{folder}: no mesh is there; give a folder with files of {', '.join(MESHES)}")
    if other := {k for k, v in about.items() if isinstance(v, dict)} - {p.stem for p in meshes}:
        raise SystemExit(f"--about names {min(other)}, and {folder} has no such mesh; delete its section")
    shutil.rmtree(COPIED, ignore_errors=True)
    COPIED.mkdir(parents=True)
    for file in (p for p in folder.glob("*") if p.is_file()):
        shutil.copy(file, COPIED)
    for mesh in meshes:
        own, said = COPIED / f"{mesh.stem}.yaml", about.get(mesh.stem, {})
        lines = [f'split: S1\nreceiver: "{said["region"]}"'] if "region" in said else []
        lines += [f"category: {said['category']}"] if "category" in said else []
        if lines and not own.exists():
            own.write_text("\n".join(lines) + "\n")
    return COPIED


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """Sweeps the meshes, keeps the rows, and counts."""
    from r2h_batch.runs.store import load_run

    if options.about is None or options.about.stem not in SETS:
        raise SystemExit(f"give --about bench/SET.toml, SET one of {', '.join(SETS)}")
    options.json = options.json or stored(options.about.stem)
    folder = options.folder.resolve()
    about = tomllib.loads(options.about.read_text("utf-8"))
    os.chdir(ROOT)
    place, words = copied(folder, about), options.methods
    name, more = options.about.stem, (*FLAGS, "--objects", place)
    rows = kept_rows(name, words, "--benchmark", "r2h-v2", "--trials", options.trials, *more)
    rows_v3 = kept_rows(f"{name}-v3", words, "--benchmark", "r2h-v3", "--trials", options.trials_v3, *more)
    objects = [
        {"name": o["name"], "split": o["split"], "digest": o["digest"]}
        | {k: v for k, v in about.get(o["name"], {}).items() if k in ("region", "category", "creator", "licence")}
        for o in load_run(rows, verify=False).header["objects"]
    ]
    areas = {}
    if any(o["split"] == "S1" for o in objects):
        areas = {w: region_areas(contacts, str(place)) for w, contacts in AREAS.items() if w in words}
    return {
        "trials": options.trials,
        "trials_v3": options.trials_v3,
        "origin": {k: about[k] for k in ("title", "source", "made") if k in about},
        "objects": objects,
        "rates": counted(rows, words),
        "rates_v3": counted(rows_v3, words),
        "areas": areas,
    }


def counted(rows: Path, words: Sequence[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Word of the sweep -> split -> rates of its line of the table, with their intervals, without times."""
    return {
        word: {
            split: {k: v for k, v in row.items() if k == "n" or k.startswith(("sr", "f_"))}
            for split, row in own.items()
        }
        for word, own in rates_of(rows, words).items()
    }


def own(rates: Mapping[str, Any] | None) -> str:
    """SR with both intervals, of the folder's meshes."""
    if rates is None:
        return "-"
    if rates["sr_new_categories_low"] is None:  # one thing says nothing of others
        return f"{rates['sr']:.1f}"
    ends = [f"{rates[f'{k}_low']:.1f}-{rates[f'{k}_high']:.1f}" for k in ("sr_new_categories", "sr_few")]
    return f"{rates['sr']:.1f} ({'; '.join(ends)})"


def table_one() -> dict[str, dict[str, str]]:
    """Word of the sweep -> split -> SR with the interval for all categories, as Table I and baselines.md have it."""
    import families

    data = json.loads(families.STORED.read_text())
    known = {name: word for word, name in WORDS.items()}
    found: dict[str, dict[str, str]] = {}
    for row in (r for r in data["table"]["rows"] if families.short(r["method"]) in known):
        cell = f"{row['sr']:.1f} ({families.ends_of(row, 'sr_new_categories')})"
        found.setdefault(known[families.short(row["method"])], {})[row["split"]] = cell
    values = json.loads((ROOT / "bench" / "results" / "networks.json").read_text())["values"]
    for split in ("S0", "S1"):
        row = {k: values[f"networks.other_categories.{split.lower()}.{k}"] for k in ("sr", *ENDS)}
        found.setdefault(UNSEEN, {})[split] = f"{row['sr']:.1f} ({row[ENDS[0]]:.1f}-{row[ENDS[1]]:.1f})"
    return found


ENDS = ("sr_new_categories_low", "sr_new_categories_high")


def by_rank(rates: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """SR in S0 / S1 of the methods of Table I, from the best mean to the worst."""
    places = sorted((w for w in rates if w != UNSEEN), key=lambda word: -rates[word]["Avg"]["sr"])
    return ", ".join(f"{WORDS[w]} {rates[w]['S0']['sr']:.0f} / {rates[w]['S1']['sr']:.0f}" for w in places)


def shown(_: Mapping[str, Any]) -> dict[str, Any]:
    """Tables and words of the page: SET.KEY of what was measured on each set."""
    sets = {name: json.loads(stored(name).read_text()) for name in SETS}
    return {f"{name}.{key}": value for name, data in sets.items() for key, value in tables(data).items()}


def tables(data: Mapping[str, Any]) -> dict[str, Any]:
    """What the page shows of a set."""
    known, areas = table_one(), data["areas"]
    lines = [
        [
            WORDS[word],
            *(cell for split in ("S0", "S1") for cell in (known[word][split], own(rates.get(split)))),
            f"{np.mean([*areas[word].values()]):.2f}" if word in areas else "",
        ]
        for word, rates in data["rates"].items()
    ]
    return {
        "number": len(data["objects"]),
        "commit": data["commit"],
        "trials": data["trials"],
        "trials_v3": data["trials_v3"],
        "table": markdown_table(
            ["", "S0, Table I", "S0, own meshes", "S1, Table I", "S1, own meshes", "region AUC"], lines
        ),
        "rank_v3": by_rank(data["rates_v3"]),
    }


def stored(name: str) -> Path:
    """The JSON of a set."""
    return ROOT / "bench" / "results" / f"{name}.json"


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "folder": {"type": Path, "help": "of meshes"},
        "--about": {"type": Path, "help": "bench/SET.toml: whose the meshes are, and their regions"},
        "--trials": {"default": TRIALS, "help": "of each split of r2h-v2"},
        "--trials-v3": {"default": TRIALS_V3, "help": "of each split of r2h-v3"},
        "--methods": {"default": [*WORDS], "choices": WORDS},
    },
    peer="Table I, the same people and the same configuration",
)

if __name__ == "__main__":
    BENCH.main()
