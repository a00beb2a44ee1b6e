"""Pictures of docs/looking.md: python tools/pictures.py [views|notebook] (needs chromium; a minute). Looks as a reader would.

Writes docs/pictures/view_*.png: pages that `r2h-batch view --html` writes, as headless Chromium shows them; and notebook.png:
the tutorial after a run from top to bottom (extra `notebook`, and nbconvert, which nothing else here needs).
"""

import base64
import json
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "pictures"
SIZE = (1280, 720)
NOTEBOOK = (900, 2560)
FLAGS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def command(*arguments: str) -> None:
    """One of the project's commands, in its own process."""
    subprocess.run([sys.executable, "-m", "r2h_batch", *arguments], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)


def shoot(browser: str, page: Path, png: Path, seconds: float, size: tuple[int, int] = SIZE) -> None:
    """What a browser without a network shows of the page after so many seconds of its own time."""
    line = [browser, *FLAGS, f"--window-size={size[0]},{size[1]}", f"--virtual-time-budget={int(1000 * seconds)}"]
    line += ["--hide-scrollbars", f"--screenshot={png}", "--host-resolver-rules=MAP * ~NOTFOUND", page.as_uri()]
    subprocess.run(line, check=True, capture_output=True, timeout=300)


def shoot_live(browser: str, address: str, png: Path, seconds: float) -> None:
    """The same of a page that talks to a server, after so many seconds of ours."""
    from websockets.sync.client import connect

    line = [browser, *FLAGS, f"--window-size={SIZE[0]},{SIZE[1]}", "--remote-debugging-port=9339"]
    with subprocess.Popen([*line, "--remote-allow-origins=*", address], stderr=subprocess.DEVNULL) as process:
        try:
            time.sleep(seconds)
            with urllib.request.urlopen("http://127.0.0.1:9339/json") as answer:
                page = next(tab for tab in json.load(answer) if tab["type"] == "page")
            with connect(page["webSocketDebuggerUrl"], max_size=None) as talk:
                talk.send(json.dumps({"id": 1, "method": "Page.captureScreenshot"}))
                told = next(m for m in map(json.loads, talk) if m.get("id") == 1)
            png.write_bytes(base64.b64decode(told["result"]["data"]))
        finally:
            process.terminate()


def keep(png: Path, about: str) -> None:
    """Packs a picture into docs/pictures."""
    import imageio.v3 as imageio

    imageio.imwrite(OUT / png.name, imageio.imread(png)[..., :3], optimize=True)
    print(OUT / png.name, about)


def notebook(browser: str, folder: Path) -> None:
    """The tutorial as it looks when all its cells have run."""
    try:
        import nbformat
        from nbclient import NotebookClient
        from nbconvert import HTMLExporter
    except ImportError as error:
        sys.exit(f"pictures: {error.name} is missing; pip install '.[notebook]' nbconvert")
    book = nbformat.read(ROOT / "examples" / "tutorial.ipynb", as_version=4)
    NotebookClient(book, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}).execute()
    page = folder / "notebook.html"
    page.write_text(HTMLExporter(template_name="lab").from_notebook_node(book)[0], encoding="utf-8")
    shoot(browser, page, folder / "notebook.png", 20.0, NOTEBOOK)
    keep(folder / "notebook.png", f"{page.stat().st_size / 1e6:.1f} MB page")


def views(browser: str, folder: Path) -> None:
    """Pages of trials, and the viewer at work."""
    run = folder / "run"
    command("sweep", "--method", "random", "oracle", "--trials", "10", "--out", str(run))
    for name, methods, trial, seconds in (
        ("view_failed_plan", ("random",), "16", 6.0),
        ("view_success", ("oracle",), "3", 9.0),
        ("view_two", ("random", "oracle"), "16", 9.0),
    ):
        page, png = folder / f"{name}.html", folder / f"{name}.png"
        command("view", str(run), "--method", *methods, "--trial", trial, "--html", str(page))
        shoot(browser, page, png, seconds)
        keep(png, f"{page.stat().st_size / 1e6:.1f} MB page")
    from r2h_batch.export.stored import Reader
    from r2h_batch.view.server import Viewer

    viewer = Viewer(Reader(run), ["random"], trial=16)
    shoot_live(browser, viewer.address, folder / "view_live.png", 25.0)
    viewer.stop()
    keep(folder / "view_live.png", "live")


def main() -> None:
    """Those that are named; all unless any is."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("pictures: install chromium (Debian: apt-get install chromium)")
    kinds = {"views": views, "notebook": notebook}
    for name in sys.argv[1:] or kinds:
        if name not in kinds:
            sys.exit(f"pictures: unknown picture {name!r}; allowed are {', '.join(kinds)}")
        OUT.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            kinds[name](browser, Path(folder))


if __name__ == "__main__":
    main()
