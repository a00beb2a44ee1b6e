"""Pictures of what a run's report looks like, for the docs: docs/report.png (Chromium) and docs/latex.png (pdflatex).

python -m bench.screens RUN [--out docs]        # a run of the six built-in methods, 500 trials of each split

Prints how large the pages are and how long Chromium takes until all scripts of a page have run, beyond an empty page.
"""

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from r2h_batch.gallery.command import figures_main, report_main
from r2h_batch.report.page import page
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.store import load_run

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = r"""\documentclass[10pt]{article}
\usepackage[paperwidth=536pt,paperheight=300pt,margin=10pt]{geometry}
\usepackage{booktabs,siunitx}\pagestyle{empty}\begin{document}\noindent
TABLE
\end{document}
"""


def browser() -> str:
    """Chromium by whatever name it has here."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    return found or sys.exit("screens: no browser; install chromium")


def loading_s(address: str) -> float:
    """Median of five starts of the browser that end when the page's document is whole."""
    line = [browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom", address]
    times = []
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(line, check=True, capture_output=True, timeout=120)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def weigh(pages: dict[str, Path]) -> None:
    """Prints size and loading time of pages."""
    empty = loading_s("about:blank")
    for name, page_file in pages.items():
        took = loading_s(page_file.as_uri()) - empty
        print(f"{name}: {page_file.stat().st_size / 1e6:.1f} MB, {max(took, 0.0):.1f} s to load")


def screenshot(html: Path, png: Path, width: int, height: int) -> None:
    """The page as headless Chromium shows it."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=4000"]
    with tempfile.TemporaryDirectory() as profile:
        line = [browser(), *flags, f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        subprocess.run([*line, f"--screenshot={png}", html.as_uri()], check=True, capture_output=True, timeout=120)


def gallery(run: Path, folder: Path, out: Path) -> None:
    """The page's gallery alone, and two of the paper's figures."""
    page_file = folder / "gallery.html"
    line = [str(run), "--method", "fc", "handover-va", "--format", "html", "--gallery", "2", "--out"]
    drawn = [str(run), "--method", "fc", "random", "handover-va", "--out", str(folder / "figures")]
    if code := report_main([*line, str(page_file)]) or figures_main(drawn):
        sys.exit(code)
    trial = min((folder / "gallery_trials").glob("*.html"))
    weigh({"report": folder / "page.html", "report with gallery": page_file, "a trial of it": trial})
    alone = "<style>body > :not(section), section:not(:has(.gallery)) { display: none !important }</style></body>"
    text = page_file.read_text(encoding="utf-8").replace("</body>", alone)
    page_file.write_text(text, encoding="utf-8")
    screenshot(page_file, (out / "gallery.png").resolve(), 1130, 640)
    for name in ("protocol", "failures"):
        shutil.copy(folder / "figures" / f"{name}.png", out / f"figure_{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    given = parser.parse_args()
    run = load_run(given.run)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "page.html").write_text(page(run), encoding="utf-8")
        screenshot(folder / "page.html", (given.out / "report.png").resolve(), 1280, 1262)
        table = render(table_of(run), "latex", intervals=False)
        (folder / "doc.tex").write_text(DOCUMENT.replace("TABLE", table), encoding="utf-8")
        line = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "doc.tex"]
        subprocess.run(line, cwd=folder, check=True, capture_output=True, timeout=120)
        gallery(given.run, folder, given.out)
        crop = ["pdftoppm", "-r", "130", "-png", "-singlefile", "doc.pdf", str((given.out / "latex").resolve())]
        subprocess.run(crop, cwd=folder, check=True, timeout=120)


if __name__ == "__main__":
    main()
