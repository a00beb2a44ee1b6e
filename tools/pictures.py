"""Pictures of docs/looking.md: python tools/pictures.py (needs chromium; a minute). Looks at a small run as a reader would.

Writes docs/pictures/view_*.png: pages that `r2h-batch view --html` writes, as headless Chromium shows them.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "pictures"
SIZE = (1280, 720)
FLAGS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def command(*arguments: str) -> None:
    """One of the project's commands, in its own process."""
    subprocess.run([sys.executable, "-m", "r2h_batch", *arguments], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)


def shoot(browser: str, page: Path, png: Path, seconds: float) -> None:
    """What a browser without a network shows of the page after so many seconds of its own time."""
    line = [browser, *FLAGS, f"--window-size={SIZE[0]},{SIZE[1]}", f"--virtual-time-budget={int(1000 * seconds)}"]
    line += [f"--screenshot={png}", "--host-resolver-rules=MAP * ~NOTFOUND", page.as_uri()]
    subprocess.run(line, check=True, capture_output=True, timeout=300)


def main() -> None:
    """All of them."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("pictures: install chromium (Debian: apt-get install chromium)")
    import imageio.v3 as imageio

    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command("sweep", "--method", "random", "oracle", "--trials", "10", "--out", str(run))
        for name, methods, trial, seconds in (
            ("view_failed_plan", ("random",), "16", 6.0),
            ("view_success", ("oracle",), "3", 9.0),
            ("view_two", ("random", "oracle"), "16", 9.0),
        ):
            page, png = Path(folder) / f"{name}.html", Path(folder) / f"{name}.png"
            command("view", str(run), "--method", *methods, "--trial", trial, "--html", str(page))
            shoot(browser, page, png, seconds)
            picture = imageio.imread(png)[..., :3]
            imageio.imwrite(OUT / f"{name}.png", picture, optimize=True)
            print(OUT / f"{name}.png", f"{page.stat().st_size / 1e6:.1f} MB page")


if __name__ == "__main__":
    main()
