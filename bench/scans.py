"""Methods on meshes of yours, beside Table I: docs/results/scans.md.

`python bench/scans.py FOLDER --about bench/SET.toml` sweeps the meshes of a folder (r2h-v2's people, motion as planned), keeps
the rows in bench/options/SET, the figures in bench/results/SET.json, and writes the page of all sets. It fetches nothing.
NAME.yaml beside NAME.obj says what a mesh does not (docs/your_data.md); where there is none, the file of --about says a mesh's
region, and whose it is. Meshes without a region are of S0. `--render` writes the page again from the JSON.
"""

import argparse
import json
import os
import shutil
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table
from _rows import kept_rows, rates_of
from networks import region_areas

from r2h_batch.methods.predictors import Contacts
from r2h_batch.protocols.edit import MESHES

SETS = ("scanned", "scans")
"""The sets of the page, in its order: bench/SET.toml."""
MEASURES = (
    *("bench/scans.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/trials",
        "r2h_batch/protocols",
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
FLAGS = ("--benchmark", "r2h-v2", "--execute.sim", "none", "--no-poses")
TRIALS = 180


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


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Sweeps the meshes, keeps the rows, and counts."""
    from r2h_batch.runs.store import load_run

    if options.folder is None:
        raise SystemExit("give a folder of meshes, or --render")
    if options.about is None or options.about.stem not in SETS:
        raise SystemExit(f"give --about bench/SET.toml, SET one of {', '.join(SETS)}")
    folder = options.folder.resolve()
    about = tomllib.loads(options.about.read_text("utf-8"))
    os.chdir(ROOT)
    place, words = copied(folder, about), options.methods
    rows = kept_rows(options.about.stem, words, "--trials", options.trials, *FLAGS, "--objects", place)
    run = load_run(rows)
    found = rates_of(rows, words)
    names = {e.name: word for e, word in zip(run.entries, words, strict=True)}
    objects = [
        {"name": o["name"], "split": o["split"], "digest": o["digest"]}
        | {k: v for k, v in about.get(o["name"], {}).items() if k in ("region", "category", "creator", "licence")}
        for o in run.header["objects"]
    ]
    areas = {}
    if any(o["split"] == "S1" for o in objects):
        areas = {w: region_areas(contacts, str(place)) for w, contacts in AREAS.items() if w in words}
    return {
        "trials": options.trials,
        "origin": {k: about[k] for k in ("title", "source", "made") if k in about},
        "objects": objects,
        "rates": {word: {split: counted(row) for split, row in own.items()} for word, own in found.items()},
        "by_object": {names[m]: by_object(run.trials(m, ["object", "outcome"]).to_pylist()) for m in run.methods},
        "areas": areas,
        **made_by(MEASURES),
    }


def counted(row: Mapping[str, Any]) -> dict[str, Any]:
    """Rates of a line of the table, with their intervals, without times."""
    return {k: v for k, v in row.items() if k == "n" or k.startswith(("sr", "f_"))}


def by_object(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Object -> success of its trials, percent."""
    won: dict[str, list[bool]] = {}
    for row in rows:
        won.setdefault(row["object"], []).append(row["outcome"] == "success")
    return {name: 100 * float(np.mean(own)) for name, own in sorted(won.items())}


HEAD = """\
# Your own meshes beside Table I

See how the methods do on things of yours, and how far Table I tells it. In one column stand r2h-v2's objects, in the next the
meshes of a folder: the same people, the same configuration.

    r2h-batch sweep --method random oracle fc handover-va contact {unseen} intent \\
        --objects FOLDER --execute.sim none --trials {trials} --out runs/mine
    r2h-batch report RUN --scans runs/mine    # RUN: the same methods on r2h-v2

The second command adds the column to Table I, with its interval. Say a mesh's region in a file beside it
([your data](../your_data.md#objects)): without one it is of S0, where nothing is reserved for the receiver. Nothing is
downloaded, and `report` names a folder by its last name alone.

The tables have the mean of all categories in Table I, with its 95 % interval. Beside it stands the same of the meshes, with the
95 % interval for the mean of all categories of such things. Then comes where the mean of 6 new ones lies ([statistical
terms](../statistics.md)). Region AUC: how well the contact map finds the part that the receiver wants,
mean over the things of S1 (0.5 is chance).

Network and trees learned from generated things alone. `contact` knows the sixteen categories of r2h-v2. The next row
(`{unseen}`) has never seen the category that a thing names: `category: hammer` in a file beside the mesh. A
thing that is like none of the sixteen names none, and the mean of the four predictors answers.
"""

SECTION = """
## {title}: {number} things

{what}

`python bench/scans.py FOLDER --about bench/{name}.toml` measured this (commit {commit}; {n} trials a split, motion as planned;
rows in `bench/options/{name}`, figures in `bench/results/{name}.json`).

{table}

{order}

### {title}: thing by thing

SR in percent, about {s0} trials each in S0 and {s1} in S1. In brackets the contact maps' region AUC.

{things}

### {title}: names, sources, licences

{names}
"""


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


def from_best(sr: Mapping[str, float]) -> str:
    """Names of the methods but the bounds, from the best one to the worst."""
    places = sorted((w for w in sr if w not in ("random", "oracle", UNSEEN)), key=lambda w: (-sr[w], w))
    return ", ".join(WORDS[w] for w in places)


def order(data: Mapping[str, Any]) -> str:
    """A sentence for each split: the order of the four methods here and in Table I."""
    import families

    rows = json.loads(families.STORED.read_text())["table"]["rows"]
    known = {name: word for word, name in WORDS.items()}
    lines = []
    for split in ("S0", "S1"):
        here = {w: r[split]["sr"] for w, r in data["rates"].items() if split in r}
        there = {known[m]: r["sr"] for r in rows if r["split"] == split and (m := families.short(r["method"])) in known}
        lines.append(f"- {split}, from the best: {from_best(here)} (Table I: {from_best(there)}).")
    return "\n".join(lines)


def markdown(sets: Mapping[str, Mapping[str, Any]]) -> str:
    """docs/results/scans.md, of what was measured on each set."""
    trials = next(iter(sets.values()))["trials"]
    return HEAD.format(unseen=UNSEEN, trials=trials) + "".join(section(name, data) for name, data in sets.items())


def section(name: str, data: Mapping[str, Any]) -> str:
    """The page's part about a set."""
    known, areas = table_one(), data["areas"]
    lines = [
        [
            WORDS[word],
            *(cell for split in ("S0", "S1") for cell in (known[word][split], own(rates.get(split)))),
            f"{np.mean([*areas[word].values()]):.2f}" if word in areas else "",
        ]
        for word, rates in data["rates"].items()
    ]
    words: Sequence[str] = [w for w in data["rates"] if w != "random"]

    def thing(word: str, name: str) -> str:
        area = areas.get(word, {}).get(name)
        return f"{data['by_object'][word][name]:.0f}" + (f" ({area:.2f})" if area is not None else "")

    things = [[o["name"].replace("_", " "), o["split"], *(thing(w, o["name"]) for w in words)] for o in data["objects"]]
    names = [
        [o["name"], *(o.get(key, "").replace("_", " ") for key in ("category", "region", "creator", "licence"))]
        for o in data["objects"]
    ]
    many = {split: sum(o["split"] == split for o in data["objects"]) for split in ("S0", "S1")}
    origin = {k: v for k, v in data["origin"].items() if k != "title"}
    return SECTION.format(
        name=name, title=data["origin"].get("title", name), n=data["trials"], commit=str(data["commit"])[:12],
        what=" ".join(f"{text[0].upper()}{text[1:]}." for text in origin.values()), number=len(data["objects"]),
        s0=round(data["trials"] / max(1, many["S0"])), s1=round(data["trials"] / max(1, many["S1"])),
        table=markdown_table(
            ["", "S0, Table I", "S0, own meshes", "S1, Table I", "S1, own meshes", "region AUC"], lines
        ),
        order=order(data),
        things=markdown_table(["", "split", *(WORDS[w] for w in words)], things),
        names=markdown_table(["mesh", "like", "region", "made by", "licence"], names, left=True),
    )  # fmt: skip


def stored(name: str) -> Path:
    """The JSON of a set."""
    return ROOT / "bench" / "results" / f"{name}.json"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="of meshes")
    parser.add_argument("--about", type=Path, help="bench/SET.toml: whose the meshes are, and their regions")
    parser.add_argument("--trials", type=int, default=TRIALS, help="of each split")
    parser.add_argument("--methods", nargs="+", choices=WORDS, default=[*WORDS])
    parser.add_argument("--render", action="store_true", help="the page again from the JSON")
    chosen = parser.parse_args()
    if not chosen.render:
        found = measure(chosen)
        stored(chosen.about.stem).write_text(json.dumps(found, indent=1) + "\n")
    sets = {name: json.loads(stored(name).read_text()) for name in SETS if stored(name).exists()}
    (ROOT / "docs" / "results" / "scans.md").write_text(markdown(sets))
