"""One trial as one page: viser's client, the recorded motion and the margins in a single file that
needs no server."""

import socket
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.command_line import UsageError
from r2h_batch.export.drawing import Stage
from r2h_batch.export.stored import StoredTrial
from r2h_batch.io.write import write_text
from r2h_batch.view.draw import Drawn, look_at, prepare
from r2h_batch.view.words import as_html, title

FRAMES_PER_S = 12.0
"""Of the recorded motion; the player goes through them in real time."""
REST_S = 1.5
"""How long the last posture is held before the motion starts again."""


APART_M = 1.6
"""Between two trials that are seen side by side, along y."""


def write_page(stored: StoredTrial | Sequence[StoredTrial], file: str | Path) -> Path:
    """Writes a trial, or two side by side, as a page (about 2 MB) and returns its path; OSError
    where that is not possible."""
    path = Path(file)
    html = page_of([Stage(s) for s in ([stored] if isinstance(stored, StoredTrial) else stored)])
    write_text(path, html)
    return path


def page_of(stages: Sequence[Stage]) -> str:
    """The page as text."""
    with hidden_server() as server:
        prepare(server)
        look_at(server, stages[0], aside=APART_M * (len(stages) - 1))
        drawn = [
            Drawn(server.scene, s, f"/trial_{k}", (0.0, APART_M * k, 0.0))
            for k, s in enumerate(stages)
        ]
        recording = server.get_scene_serializer()
        motions = [(d, *d.stage.motion()) for d in drawn if d.stage.stored.moves]
        if motions:
            end = max(float(times[-1]) for _, times, _ in motions)
            at = np.linspace(0.0, end, max(2, round(end * FRAMES_PER_S)))
            for k, t in enumerate(at):
                for d, times, q in motions:
                    d.pose(q[np.abs(times - t).argmin()])
                recording.insert_sleep(float(at[k + 1] - t) if k + 1 < len(at) else REST_S)
        html: str = recording.as_html()
    return _with_panel(html, stages)


def _with_panel(html: str, stages: Sequence[Stage]) -> str:
    """viser's page with the margins beside the scene, and a title."""
    panel = files("r2h_batch.view").joinpath("panel.html").read_text(encoding="utf-8")
    panel = panel.replace("{{panel}}", "<hr>".join(map(as_html, stages)))
    end = html.rindex("</body>")
    html = html[:end] + panel + html[end:]
    start, stop = html.find("<title>"), html.find("</title>")
    return html if start < 0 else f"{html[: start + 7]}{escape(title(stages[0]))}{html[stop:]}"


@contextmanager
def hidden_server() -> Iterator[Any]:
    """A viser server that nobody is told of: on this machine alone, on a free port."""
    server = new_server(0)
    try:
        yield server
    finally:
        stop_server(server)


def new_server(port: int) -> Any:
    """A viser server on 127.0.0.1; port 0: any free one. Raises `UsageError` with one line where
    the extra is missing."""
    try:
        import viser
    except ImportError:
        raise UsageError("looking at trials needs viser: pip install 'r2h_batch[view]'") from None
    with _no_banner():
        return viser.ViserServer(host="127.0.0.1", port=port or _free_port(), verbose=False)


def stop_server(server: Any) -> None:
    """Ends a server without a word on stdout, which is for answers."""
    with _no_banner():
        server.stop()


@contextmanager
def _no_banner() -> Iterator[None]:
    """viser greets through rich, which in a notebook writes past sys.stdout: its console is told to
    be quiet."""
    import rich

    console = rich.get_console()
    kept, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = kept


def _free_port() -> int:
    with closing(socket.socket()) as asked:
        asked.bind(("127.0.0.1", 0))
        return int(asked.getsockname()[1])
