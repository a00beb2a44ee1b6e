"""Progress goes to stderr: plain lines without a terminal, a bar on one."""

import os
import pty
import subprocess
import sys

from r2h_batch.sweep.engine import progress

CODE = """
import time
from r2h_batch.sweep.engine import progress
with progress("oracle", 4) as advance:
    for _ in range(4):
        time.sleep(0.15)
        advance(1)
print("table")
"""


def test_without_a_terminal_a_line_comes_when_it_is_due_and_one_at_the_end(capsys):
    with progress("oracle", 40, plain_every_s=0.0) as advance:
        advance(10)
        advance(30)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("oracle: 10/40 trials, ") and lines[0].endswith("s left")
    assert lines[1].startswith("oracle: 40/40 trials, ") and lines[1].endswith(" 0 s left")
    assert lines[2].startswith("oracle: 40 trials in ") and len(lines) == 3


def _on_a_terminal(term: str) -> tuple[bytes, bytes]:
    """stdout and what a terminal on stderr received."""
    own, terminal = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        stdout=subprocess.PIPE,
        stderr=terminal,
        env={**os.environ, "TERM": term},
        check=True,
    )
    os.close(terminal)
    received = b""
    while True:
        try:
            part = os.read(own, 65536)
        except OSError:
            break
        if not part:
            break
        received += part
    os.close(own)
    return done.stdout, received


def test_on_a_terminal_there_is_a_bar_on_stderr_only():
    out, received = _on_a_terminal("xterm")
    assert out == b"table\n"
    assert b"\x1b[" in received and b"4/4" in received and b"oracle: 4 trials in" in received
