"""All published figures of the built-in methods, from one clean commit: `make tables`.

    python bench/tables.py             # sweeps, then every page and picture
    python bench/tables.py --render    # the tables and pages again from the stored rows
    python bench/tables.py --pictures  # the pictures again from the stored rows, after a change of drawing

The sweeps stand in runs/tables-COMMIT, and the same command goes on with them. Only when all are done do files change:

    r2h_batch/report/compare/rows/*, bench/rows/*    the rows of each table, with poses
    docs/results/table1*.{csv,json}               the tables, with intervals, counts, versions and digests
    docs/results/sensitivity.json                 what each choice is worth (default benchmark)
    docs/*.png, docs/pictures/*.png               pictures of runs
    docs/results/made_from.json                   commit, golden's digest, digests of the pictures
    README.md, docs/results/*.md                  the figures and tables of all pages (bench/figures.py)

tests/test_figures.py and tests/test_published.py hold all of this to the present code.
"""

import argparse
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import families
import figures
import pictures
import sensitivity
from _report import ROOT, swept
from _rows import keep

RESULTS = Path("docs/results")
METHODS = ("fc", "handover-va", "contact", "intent", "random", "oracle")
LEARNED = ("learned",)
"""It was trained for the default benchmark, and came later: its rows stand in folders of their own."""


@dataclass(frozen=True)
class Published:
    """A table, or rows alone (without a title): the flags of its sweep and the folder of its rows."""

    name: str
    title: str
    flags: tuple[str, ...]
    rows: Path
    methods: tuple[str, ...] = METHODS

    def line(self, trials: int) -> list[str]:
        """The sweep's arguments without --out."""
        return ["--method", *self.methods, "--trials", str(trials), *self.flags]


_SHIPPED, _LATER = Path("r2h_batch/report/compare/rows"), Path("r2h_batch/report/compare/later")
_OTHERS, _PAPER = Path("bench/rows"), ("--preset", "paper")
_V0, _V1 = ("--benchmark", "r2h-v0", "--execute.sim", "mujoco"), ("--benchmark", "r2h-v1", "--execute.sim", "mujoco")
_RELEASE = ("--preset", "release")
PUBLISHED = (
    Published("table1-v1", "Table I of r2h-v1", _V1, _OTHERS / "v1"),
    Published(
        "table1-v1-paper-preset",
        "Table I of r2h-v1, planned as the paper does",
        (*_V1, *_PAPER),
        _OTHERS / "v1-paper-preset",
    ),
    Published(
        "table1-v1-release-preset",
        "Table I of r2h-v1, with the definitions of the authors' release",
        ("--benchmark", "r2h-v1", *_RELEASE),
        _OTHERS / "v1-release-preset",
    ),
    Published(
        "table1-release",
        "Table I of r2h-release, with the definitions of the authors' release",
        ("--benchmark", "r2h-release", *_RELEASE),
        _OTHERS / "release-release-preset",
    ),
    Published("table1-v0", "Table I of r2h-v0", _V0, _OTHERS / "v0"),
    Published(
        "v1-as-planned", "", ("--benchmark", "r2h-v1", "--execute.sim", "none", "--no-poses"), _OTHERS / "v1-as-planned"
    ),
    Published("r2h-v2", "", ("--benchmark", "r2h-v2", "--execute.sim", "mujoco"), _SHIPPED / "r2h-v2"),
    Published(
        "r2h-v2-as-planned",
        "",
        ("--benchmark", "r2h-v2", "--execute.sim", "none", "--no-poses"),
        _SHIPPED / "r2h-v2-as-planned",
    ),
    Published("r2h-v2-learned", "", ("--benchmark", "r2h-v2", "--execute.sim", "mujoco"), _LATER / "r2h-v2", LEARNED),
    Published(
        "r2h-v2-as-planned-learned",
        "",
        ("--benchmark", "r2h-v2", "--execute.sim", "none", "--no-poses"),
        _LATER / "r2h-v2-as-planned",
        LEARNED,
    ),
)
"""Rows of r2h-v3 are those of bench/r2h_v3.py --rows."""
TABLES = tuple(p for p in PUBLISHED if p.title)


def git(*words: str) -> str:
    """Output of git in this checkout."""
    return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True).stdout.strip()


def clean_commit() -> str:
    """The commit of a clean checkout; ends the program otherwise."""
    if changed := git("status", "--porcelain").splitlines():
        sys.exit(f"tables: {len(changed)} files differ from the commit ({changed[0].strip()}, ...); commit them first")
    return git("rev-parse", "HEAD")


OF_TABLES = ("none.", "mujoco.", "mjwarp.", "pose", "r2h-v1.", "release.")
"""Golden's cases of the benchmarks whose tables this program makes; that of r2h-v2 comes from bench/families.py."""


def golden_digest() -> str:
    """sha256 of the outcomes of golden's cases, row by row: verdicts are unchanged while it is. Last bits of joint angles, which
    golden's own digests have, move no figure; tests/test_published.py judges rows again, with their margins."""
    golden = json.loads((ROOT / "tests" / "golden.json").read_text())["cases"]
    cases = {name: case["outcomes"] for name, case in golden.items() if name.startswith(OF_TABLES)}
    return hashlib.sha256(json.dumps(cases, sort_keys=True).encode()).hexdigest()


def pairs_of(run) -> list[dict[str, object]]:
    """The paired test of the methods on all trials of each split and of both: who is apart from whom."""
    from r2h_batch.report.statistics.paired import compare, pair_up

    return [
        {
            **{"group": c.group, "a": p.a, "b": p.b, "difference": p.difference},
            **{"p_holm": p.p_holm, "p_new_holm": p.p_new_holm, "verdict": p.verdict},
        }
        for c in compare(pair_up([run]), draws=1)
        for p in c.pairs
    ]


def unsolved(run) -> dict[str, list[int]]:
    """Ids of the trials that the oracle does not solve, and of those that no method solves."""
    solved: dict[int, set[str]] = {}
    for method in run.methods:
        rows = run.trials(method)
        for trial, outcome in zip(rows["trial_id"].to_pylist(), rows["outcome"].to_pylist()):
            solved.setdefault(trial, set()).update({method} if outcome == "success" else ())
    oracle = [t for t, who in sorted(solved.items()) if "oracle" not in who]
    return {"oracle_unsolved": oracle, "solved_by_nobody": [t for t, who in sorted(solved.items()) if not who]}


def bench_json(name: str) -> Any:
    """The JSON of a bench."""
    return json.loads((ROOT / "bench" / "results" / f"{name}.json").read_text())


def table_1() -> dict[str, Any]:
    """README's Table I: rates and pairs of the shipped rows, turn tests of the benches."""
    from r2h_batch.report.compare.stored import load_rows

    (shipped,) = (p.rows for p in PUBLISHED if p.name == "r2h-v2-as-planned")
    run = load_rows(ROOT / shipped)
    table = families.table_of_run(run)
    bounds = [r for r in table["rows"] if r["method"] in families.BOUNDS]
    table["rows"] = [r for r in table["rows"] if r not in bounds] + bounds
    turned = bench_json("families")["turned"]["r2h-v2"]
    return {
        "table": table,
        "compared": families.compared(run, (*families.METHODS, *LEARNED)),
        "turned": {"r2h-v2": turned},
        "unseen": unseen_row(),
    }


def unseen_row() -> list[str]:
    """Cells of Table I for Contact-Handover on categories that its predictor never saw (bench/networks.py)."""
    found = bench_json("networks")["values"]

    def cell(split: str) -> str:
        sr, low, high = (found[f"networks.other_categories.{split}.{k}"] for k in ("sr", *CATEGORIES))
        return f"{sr:.1f} ({low:.1f}-{high:.1f})"

    return [cell("s0"), cell("s1"), found["networks.other_categories.beside"]]


CATEGORIES = ("sr_new_categories_low", "sr_new_categories_high")
"""Ends of the interval for the mean of all categories."""


def shown(_: object) -> dict[str, object]:
    """What README and the page of Table I show."""
    own = table_1()
    return {"one": families.table_one(own), "n": own["table"]["rows"][0]["n"]}


def table_files(published: Published, rows: Path) -> dict[str, str]:
    """Name -> text of the table's .csv and .json, from stored rows alone."""
    from r2h_batch.report.table import render, table_of
    from r2h_batch.runs.store import load_run

    run = load_run(rows)
    table = table_of(run)
    header, split = run.header, next(iter(run.header["trials"].values()))
    command = shlex.join(["r2h-batch", "sweep", *published.line(split), "--out", f"runs/{published.name}"])
    origin = {"command": command, "commit": header["git_commit"], "digests": header["digests"]}
    origin |= {"methods": {m: run.digest(m) for m in run.methods}, "predictors": header["predictors"]}
    origin |= {"versions": header["versions"], "device": header["device"]["name"], "rows": published.rows.as_posix()}
    data = json.loads(render(table, "json")) | {"provenance": origin, "pairs": pairs_of(run)} | unsolved(run)
    return {
        f"{published.name}.csv": render(table, "csv"),
        f"{published.name}.json": json.dumps(data, indent=1) + "\n",
    }


def render_all() -> dict[Path, str]:
    """The tables' files (path from the checkout's root), from the stored rows."""
    return {RESULTS / name: text for p in TABLES for name, text in table_files(p, ROOT / p.rows).items()}


def install(place: Path, commit: str) -> None:
    """The rows from the sweeps' folders, then all that is made of them."""
    for p in PUBLISHED:
        keep(place / p.name, ROOT / p.rows)
    shutil.copy(place / "sensitivity.json", ROOT / RESULTS)
    write(render_all())
    draw({"commit": commit, "golden": golden_digest()})


def draw(made: dict[str, object]) -> None:
    """Every picture from the stored rows; their digests go into made_from.json."""
    rows = {p.name: p.rows for p in PUBLISHED}
    drawn = pictures.draw(rows["r2h-v2"], rows["table1-release"], Path("docs"))
    made = made | {"pictures": drawn}
    (ROOT / RESULTS / "made_from.json").write_text(json.dumps(made, indent=1) + "\n")


def write(files: dict[Path, str]) -> None:
    """Writes the tables' files, and then the pages."""
    for path, text in files.items():
        (ROOT / path).write_text(text)
        print(path)
    figures.write()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--render", action="store_true", help="the tables and pages again from the stored rows")
    parser.add_argument("--pictures", action="store_true", help="the pictures again from the stored rows")
    parser.add_argument("--trials", type=int, default=500, help="of each split and table")
    given = parser.parse_args()
    os.chdir(ROOT)
    if given.render:
        write(render_all())
        return
    if given.pictures:
        draw(json.loads((ROOT / RESULTS / "made_from.json").read_text()))
        return
    from r2h_batch.runs.store import load_run

    pictures.browser()  # ends the program before the sweeps if there is none
    begin, commit = time.perf_counter(), clean_commit()
    place = Path("runs") / f"tables-{commit[:12]}-{given.trials}"
    runs = [swept(place / p.name, *p.line(given.trials)) for p in PUBLISHED]
    measured = sensitivity.measure(place / "sensitivity", sensitivity.TRIALS)
    (place / "sensitivity.json").write_text(json.dumps(measured, indent=1) + "\n")
    if clean_commit() != commit or {load_run(run).header["git_commit"] for run in runs} != {commit}:
        sys.exit("tables: files changed while the sweeps ran; run the command again")
    install(place, commit)
    print(f"{time.perf_counter() - begin:.0f} s; look at the difference, and commit")


if __name__ == "__main__":
    main()
