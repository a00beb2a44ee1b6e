"""Code of others: the lock, its licences, its advisories. `python tools/supply.py lock|licences|audit`.

`make lock` writes constraints.txt from what is installed in the test environment, `make licences` docs/licences.md from
its metadata, `make audit` asks an advisory source about the lock.
"""

import argparse
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "constraints.txt"
LICENCES = ROOT / "docs" / "licences.md"
SPDX = {
    **dict.fromkeys(("Apache 2.0", "Apache Software License"), "Apache-2.0"),
    **dict.fromkeys(("2-clause BSD", "BSD 2-Clause License"), "BSD-2-Clause"),
    "3-Clause BSD License": "BSD-3-Clause",
    "BSD License": "BSD",
    "ISC license": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}
"""One name for a licence that metadata spell in several ways."""
NOT_CHECKED = 3
"""Exit code of an audit that could not be made: no advisory source was reachable."""

HEAD = """\
# Every package that r2h_batch and its tests install, direct and transitive. Written by `make lock`; do not edit.
# With a GPU, PyTorch brings its own CUDA packages, which its exact version pins; README: how to install without them.
"""


class Missing(Exception):
    """A package that the project asks for is not installed: a lock made now would lack it."""


def roots() -> Iterator[tuple[Requirement, str]]:
    """Every requirement of the package and of its extra `test` with the extra that asks for it ("": the package).

    Extras that `test` does not name (loggers) are not installed here and not locked.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    todo = ["", "test"]
    for extra in todo:
        for line in groups[extra]:
            requirement = Requirement(line)
            if canonicalize_name(requirement.name) != "r2h-batch":
                yield requirement, extra
            else:
                todo += sorted(requirement.extras - set(todo))


def closure() -> dict[str, tuple[Distribution, str]]:
    """Canonical name -> what is installed, and who asked for it first: all that this environment's markers select."""
    found: dict[str, tuple[Distribution, str]] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    todo = [(r, f"r2h_batch[{extra}]" if extra else "r2h_batch", frozenset({""})) for r, extra in roots()]
    while todo:
        requirement, asked_by, extras = todo.pop(0)
        marker = requirement.marker
        if marker is not None and not any(marker.evaluate({"extra": e}) for e in extras):
            continue
        name, wanted = canonicalize_name(requirement.name), frozenset({"", *requirement.extras})
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        try:
            installed = distribution(name)
        except PackageNotFoundError:
            raise Missing(f"{name}, which {asked_by} asks for, is not installed: run `make test` first") from None
        found.setdefault(name, (installed, asked_by))
        todo += [(Requirement(line), name, wanted) for line in installed.requires or ()]
    return dict(sorted(found.items()))


def lock() -> str:
    """The text of constraints.txt: one exact version a line, builds (+cpu, +cu128) left to the machine."""
    pins = [f"{name}=={Version(installed.version).public}" for name, (installed, _) in closure().items()]
    return HEAD + "\n".join(pins) + "\n"


def licence(installed: Distribution) -> str:
    """A distribution's licence as its metadata says it, in one short line."""
    metadata = installed.metadata
    if expression := metadata.get("License-Expression"):
        return expression
    classes = [c.split(" :: ")[-1] for c in metadata.get_all("Classifier") or () if c.startswith("License ::")]
    words = " ".join((metadata.get("License") or "").split())
    if words and len(words) <= 60:
        return words
    named = [c for c in classes if c != "OSI Approved"]
    if named:
        return ", ".join(named)
    return words[:57] + "..." if words else _licence_file(installed)


def _licence_file(installed: Distribution) -> str:
    for file in installed.files or ():
        if re.search(r"licen[cs]e|copying", file.name, re.IGNORECASE):
            text = file.read_binary().decode("utf-8", errors="replace")
            if re.search(r"Apache License,\s+Version 2\.0", text):  # the first line is a copyright, such as anny's
                return "Apache-2.0"
            lines = text.splitlines()
            return f"{next((x.strip() for x in lines if x.strip()), '')[:57]} ({file.name})"
    return "not stated"


def licences() -> str:
    """The text of docs/licences.md: every package of the lock."""
    # licence -> names of the packages that r2h_batch needs, that one of its extras needs, and that these bring along
    kinds: dict[str, tuple[list[str], list[str], list[str]]] = {}
    for installed, asked_by in closure().values():
        kind = 0 if asked_by == "r2h_batch" else 1 if asked_by.startswith("r2h_batch[") else 2
        name = _cell(licence(installed))
        kinds.setdefault(SPDX.get(name, name), ([], [], []))[kind].append(installed.metadata["Name"])
    head = (
        "| licence | r2h_batch needs | an extra needs | these need |",
        "|---|---|---|---|",
    )
    rows = ["| " + " | ".join([name, *map(", ".join, kinds[name])]) + " |" for name in sorted(kinds, key=str.lower)]
    return "\n".join(
        (
            "# Licences of bundled data and of packages",
            "",
            "For everybody who passes r2h_batch on. It has the licence Apache-2.0. `make licences` writes this page; do not edit"
            " it.",
            "",
            "The scripts beside the bundled data made all of it, under the same licence (`assets/SOURCES.md`). The site"
            " contains iframe-worker (MIT, `docs/javascripts/iframe-worker.js`).",
            "",
            "## Packages",
            "",
            "pip installs them; none is bundled. Versions are those of `constraints.txt`, licences those of the packages'"
            " metadata.",
            "",
            *head,
            *rows,
            "",
        )
    )


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "/").split())


def audit() -> int:
    """Known advisories against the lock, by pip-audit: 0 none, 1 some, `NOT_CHECKED` where a package was not looked up.

    pip-audit itself says "none found" when no source knew any of the packages; that is no answer.
    """
    line = [
        sys.executable,
        "-m",
        "pip_audit",
        "--requirement",
        str(LOCK),
        "--no-deps",
        "--disable-pip",
        "--format=json",
    ]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    try:
        looked_up = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError, TypeError):
        why = (done.stderr.strip().splitlines() or ["no answer"])[-1]
        print(f"audit: NOT CHECKED, no advisory source answered here ({why[:200]})", file=sys.stderr)
        return NOT_CHECKED
    return verdict(looked_up)


def verdict(looked_up: list[dict[str, Any]]) -> int:
    """Prints what pip-audit's records say; its exit code."""
    bad = [(d["name"], v["id"]) for d in looked_up for v in d.get("vulns", ())]
    skipped = [d["name"] for d in looked_up if "skip_reason" in d]
    for name, advisory in bad:
        print(f"{name}: {advisory}")
    print(f"audit: {len(looked_up) - len(skipped)} packages checked, {len(bad)} advisories")
    if skipped:
        print(
            f"audit: NOT CHECKED, the source does not know {len(skipped)} of {len(looked_up)} packages", file=sys.stderr
        )
    return 1 if bad else NOT_CHECKED if skipped or not looked_up else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("lock", "licences", "audit"))
    what = parser.parse_args().what
    if what == "audit":
        return audit()
    path, make = (LOCK, lock) if what == "lock" else (LICENCES, licences)
    try:
        path.write_text(make(), encoding="utf-8")
    except Missing as error:
        print(f"{what}: {error}", file=sys.stderr)
        return 2
    print(f"{path.relative_to(ROOT)}: {len(closure())} packages")
    return 0


if __name__ == "__main__":
    sys.exit(main())
