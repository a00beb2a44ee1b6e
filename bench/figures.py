"""Figures of the pages: written from the benches' JSON, and checked against the present code.

    python bench/figures.py            # lists each JSON: who cites it, when it was measured, what has changed since
    python bench/figures.py --write    # writes the figures of all pages again (after `make bench`)

A page holds a template in a comment, and below it the text that is made of it:

    <!-- figures
    The planner needs {plan.us_per_problem_core:~2} us.
    -->

    The planner needs 240 us.

    <!-- end -->

A name in braces is a figure of any JSON in bench/results, NAME.made.commit (cpu, cores, load, date, seconds) of NAME.json, or
what `shown` of bench/NAME.py gives of its JSON: tables and words. NAME.a.b is `data["a"]["b"]`. `*1000` after the name
multiplies. `:~2` rounds to two significant digits; any other format is Python's.
"""

import argparse
import importlib
import json
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from _report import FIGURES_SINCE, markdown_table
from _source import ROOT, digests

STORED = ROOT / "bench" / "results"
BLOCK = re.compile(r"(<!-- figures\n(?P<template>.*?)\n-->\n\n)(?P<text>.*?)(\n\n<!-- end -->)", re.DOTALL)
FIELD = re.compile(r"\{(?P<name>[\w.]+)(\*(?P<factor>[\d.e+-]+))?(:(?P<spec>[^}]+))?\}")
CITED = re.compile(r"bench/results/(\w+)\.json")
CHANGED_SHARE = 0.25
"""A page may not show figures after so large a part of the measured files has changed: measure again."""


ORIGIN = ("hardware", "measures", "source", "versions")
"""Parts of a JSON that hold no figures."""


def paths(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Path and value of all numbers and words below a value."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from paths(".".join((name, re.sub(r"\W", "_", str(key)))), inner)
    elif not isinstance(value, list):
        yield name, value


@dataclass(frozen=True)
class Measured:
    """A bench's JSON."""

    name: str
    data: Mapping[str, Any]

    @property
    def values(self) -> dict[str, Any]:
        """Figures, numbers and words of the JSON by their path (`_` for what is not a word), and NAME.made.*: where they come
        from."""
        hardware = self.data.get("hardware", {})
        made = {k: hardware.get(k) for k in ("cpu", "cores")} | {"load": hardware.get("load_at_start")}
        made |= {k: self.data.get(k) for k in ("commit", "date", "seconds")}
        inner = {k: v for k, v in self.data.items() if k not in ("values", *ORIGIN)}
        return dict(self.data.get("values", {})) | dict(paths(self.name, inner | {"made": made}))

    def lacks(self) -> list[str]:
        """Names of what says where the figures come from and is missing."""
        made, hardware = ("commit", "source", "figures_since", "seconds"), ("cpu", "load_at_start")
        return [k for k in made if not self.data.get(k)] + [
            k for k in hardware if k not in self.data.get("hardware", {})
        ]

    def changed(self, root: Path = ROOT) -> list[str]:
        """Files among the measured ones whose code is another one now, are new or are gone."""
        before = self.data["source"]
        now = digests((p for p in self.data["measures"] if (root / p).exists()), root)
        return sorted(p for p in {*before, *now} if before.get(p) != now.get(p))

    def outdated(self, root: Path = ROOT) -> str:
        """Why a page may not show these figures any more; "" if it may."""
        for version, benches, reason in FIGURES_SINCE:
            if version > self.data["figures_since"] and {"*", self.name} & {*benches}:
                return f"figures are valid since version {version}: {reason}"
        changed, all_files = self.changed(root), len(self.data["source"])
        if len(changed) > CHANGED_SHARE * all_files:
            return f"{len(changed)} of {all_files} measured files have changed"
        return ""


def stored(folder: Path = STORED) -> dict[str, Measured]:
    """All JSON files of the benches by name."""
    return {p.stem: Measured(p.stem, json.loads(p.read_text())) for p in sorted(folder.glob("*.json"))}


def pages(root: Path = ROOT) -> list[Path]:
    """Pages that may show figures."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md")), root / "bench" / "SOURCES.md"]


def written(value: Any, factor: str | None, spec: str | None) -> str:
    """A figure as text."""
    if factor:
        value = value * float(factor)
    if spec and spec.startswith("~"):
        digits = int(spec[1:]) - 1 - (math.floor(math.log10(abs(value))) if value else 0)
        return f"{round(value, digits):,.{max(digits, 0)}f}"
    return format(value, spec or "")


def filled(template: str, values: Mapping[str, Any]) -> str:
    """The text of a template.

    Raises:
        KeyError: a figure that no JSON has.
    """

    def one(field: re.Match[str]) -> str:
        if field["name"] not in values:
            raise KeyError(f"no JSON in bench/results has the figure {field['name']}; `make bench` measures them")
        return written(values[field["name"]], field["factor"], field["spec"])

    return FIELD.sub(one, template)


def rendered(text: str, values: Mapping[str, Any]) -> str:
    """A page with all of its figures written again."""
    return BLOCK.sub(lambda block: block[1] + filled(block["template"], values) + block[4], text)


def of_assets() -> dict[str, Any]:
    """Figures of reports in assets/, of training and of measured hands: voxnet.*, hand_errors.*, people_report.*."""
    left_out = json.loads((ROOT / "assets/receiving/voxnet.json").read_text())
    found = {
        f"voxnet.{part}.{k}": left_out[f"{key}_mean"][k]
        for part, key in (("left_out", "left_out"), ("all", "stored_weights"))
        for k in ("auc", "iou", "touched_share")
    }
    areas = [own["auc"] for own in left_out["left_out_figures"].values()]
    found |= {"voxnet.left_out.least_auc": min(areas), "voxnet.left_out.most_auc": max(areas)}
    kept = json.loads((ROOT / "assets/receiving/hand_errors_report.json").read_text())["kept"]
    found |= {
        f"hand_errors.{name}.{p}": v for name in ("turn_deg", "shift_mm") for p, v in zip((50, 90, 99, 999), kept[name])
    }
    found["hand_errors.beyond_90_deg_percent"] = kept["beyond_90_deg_percent"]
    shapes = json.loads((ROOT / "assets/people/report.json").read_text())["shapes"]
    held = [part["skin_held_share"] for own in shapes.values() for part in own.values()]
    return found | {"people_report.held_least": min(held), "people_report.held_most": max(held)}


def used(text: str) -> set[str]:
    """Names of the figures in the templates of a page."""
    return {field["name"] for block in BLOCK.finditer(text) for field in FIELD.finditer(block["template"])}


def all_values(measured: Mapping[str, Measured], texts: Iterable[str]) -> dict[str, Any]:
    """Figures of all JSON files and of assets, and what benches show of theirs, as far as these pages ask for it."""
    found = of_assets()
    for one in measured.values():
        found |= one.values
    for name in sorted({asked.partition(".")[0] for text in texts for asked in used(text) - found.keys()}):
        if (ROOT / "bench" / f"{name}.py").exists():
            data = measured[name].data if name in measured else {}
            found |= {f"{name}.{key}": value for key, value in importlib.import_module(name).shown(data).items()}
    return found


def cited(text: str, measured: Mapping[str, Measured]) -> set[str]:
    """Names of the JSON files that a page takes figures from, or names."""
    return {*CITED.findall(text)} | (measured.keys() & {name.partition(".")[0] for name in used(text)})


def listing(measured: Mapping[str, Measured]) -> str:
    """A Markdown table: where each JSON comes from, and what has changed since."""
    by: dict[str, list[str]] = {name: [] for name in measured}
    for page in pages():
        for name in cited(page.read_text("utf-8"), measured):
            by.setdefault(name, []).append(page.relative_to(ROOT).as_posix())
    rows = []
    for name, one in measured.items():
        if missing := one.lacks():
            state = f"without {', '.join(missing)}: measure again"
        elif why := one.outdated():
            state = f"out of date: {why}"
        elif files := one.changed():
            state = f"stale: {len(files)} of {len(one.data['source'])} files changed ({', '.join(files[:2])})"
        else:
            state = "as measured"
        made = one.values
        rows.append(
            [name, made[f"{name}.made.seconds"], str(made[f"{name}.made.commit"])[:8], made[f"{name}.made.load"]]
        )
        rows[-1] += [", ".join(by[name]) or "no page", state]
    return markdown_table(["bench/results", "s", "commit", "load", "cited by", "figures"], rows, left=True)


def changed() -> dict[Path, str]:
    """Pages whose figures are other ones, as they have to be."""
    texts = {page: page.read_text("utf-8") for page in pages()}
    values = all_values(stored(), texts.values())
    return {page: after for page, text in texts.items() if (after := rendered(text, values)) != text}


def write() -> None:
    """Writes the figures of all pages again."""
    for page, text in changed().items():
        page.write_text(text, "utf-8")
        print(page.relative_to(ROOT))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the figures of all pages again")
    if parser.parse_args().write:
        write()
        return
    print(listing(stored()))
    if other := changed():
        sys.exit(
            f"other figures than in the JSON: {', '.join(p.relative_to(ROOT).as_posix() for p in other)}; give --write"
        )


if __name__ == "__main__":
    main()
