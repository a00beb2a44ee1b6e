"""The list of rows, or commands that make them, behind each published figure: bench/SOURCES.md.

Pages, commits and seconds are looked up; only where rows are, and what a command is
called where `make bench` does not say it, stands here.
"""

from pathlib import Path
from typing import Any

from _report import ROOT, markdown_table

HERE = "bench/SOURCES.md"
ROWS = {
    "closed_loop": "`won` of the JSON: each trial",
    "gates": "`bench/options/gates`",
    "networks": "`bench/options/networks`",
    "robots": "`bench/options/robots`",
    "robustness": "`bench/options/robustness`",
    "scanned": "`bench/options/scanned*`",
    "scans": "`bench/options/scans*`",
    "r2h_v3": "`r2h_batch/report/compare/rows/r2h-v3-*`",
}
"""JSON -> where its rows are; the others are made by the command alone."""
COMMANDS = {
    "closed_loop_growth": "bench/closed_loop.py --growth 2000",
    "families": "bench/families.py --rows FOLDER",
    "long": "bench/soak.py",
    "r2h_v3": "bench/r2h_v3.py --trials 500 --seen-trials 500 --checked 30 --rows",
    "scanned": "bench/scans.py FOLDER --about bench/scanned.toml",
    "scans": "bench/scans.py FOLDER --about bench/scans.toml",
    "release": "bench/release.py --release CHECKOUT",
    "vendors": "bench/vendors.py --files FOLDER",
}
"""JSON -> its command, if it is not bench/NAME.py."""


def folders(published: Any) -> list[list[object]]:
    """A line for each stored table: name, folder of its rows, rows, commit."""
    from r2h_batch.runs.store import load_run

    lines: list[list[object]] = []
    for p in published:
        run = load_run(ROOT / p.rows, verify=False)
        n = sum(len(run.trials(m, ["trial_id"])) for m in run.methods)
        flags = " ".join(p.flags)
        lines.append([p.name, f"`{p.rows.as_posix()}`", f"`{flags}`", f"{n:,}", run.header["git_commit"][:12]])
    return lines


def links(name: str, pages: list[Path]) -> str:
    """A bench's pages, as links from the list of sources."""
    return ", ".join(f"[{page.stem}](../{page.relative_to(ROOT).as_posix()})" for page in pages)


def shown(_: object) -> dict[str, str]:
    """Both tables of the page."""
    import figures
    from tables import PUBLISHED

    measured = figures.stored()
    texts = {p: p.read_text("utf-8") for p in figures.pages() if p != ROOT / HERE and p.is_relative_to(ROOT / "docs")}
    of_bench: dict[str, list[Path]] = {name: [] for name in measured}
    for path, text in texts.items():
        for name in figures.cited(text, measured):
            of_bench.setdefault(name, []).append(path)
    benches = []
    for name, own in sorted(of_bench.items()):
        command = f"`{COMMANDS.get(name, f'bench/{name}.py')}`"
        commit = measured[name].data["commit"][:12]
        benches.append([name, links(name, own), command, ROWS.get(name, ""), commit])
    return {
        "tables": markdown_table(["table", "rows", "flags", "number", "commit"], folders(PUBLISHED), left=True),
        "benches": markdown_table(["JSON", "pages", "command", "rows", "commit"], benches, left=True),
    }
