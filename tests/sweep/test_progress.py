"""Progress goes to stderr: plain lines without a terminal, a bar on one."""

from r2h_batch.sweep.engine import progress


def test_without_a_terminal_a_line_comes_when_it_is_due_and_one_at_the_end(capsys):
    with progress("oracle", 40, plain_every_s=0.0) as advance:
        advance(10)
        advance(30)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("oracle: 10/40 trials, ") and lines[0].endswith("s left")
    assert lines[1].startswith("oracle: 40/40 trials, ") and lines[1].endswith(" 0 s left")
    assert lines[2].startswith("oracle: 40 trials in ") and len(lines) == 3
