"""Progress goes to stderr: plain lines without a terminal, a bar on one."""

import os
import pty
import sys
import time

from r2h_batch.sweep.engine import progress


def test_without_a_terminal_a_line_comes_when_it_is_due_and_one_at_the_end(capsys):
    with progress("oracle", 40, plain_every_s=0.0) as advance:
        advance(10)
        advance(30)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("oracle: 10/40 trials, ") and lines[0].endswith("s left")
    assert lines[1].startswith("oracle: 40/40 trials, ") and lines[1].endswith(" 0 s left")
    assert lines[2].startswith("oracle: 40 trials in ") and len(lines) == 3


def test_on_a_terminal_there_is_a_bar_on_stderr_only(monkeypatch, capsys):
    own, terminal = pty.openpty()
    with os.fdopen(terminal, "w") as stderr, monkeypatch.context() as patch:
        patch.setenv("TERM", "xterm")
        patch.setattr(sys, "stderr", stderr)
        with progress("oracle", 4) as advance:
            for _ in range(4):
                time.sleep(0.15)
                advance(1)
        stderr.flush()
        received = b""
        while b"trials in" not in received:
            received += os.read(own, 65536)
    os.close(own)
    assert b"\x1b[" in received and b"4/4" in received
    assert capsys.readouterr().out == ""
