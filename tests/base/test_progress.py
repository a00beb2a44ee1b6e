"""How far long work is: lines on stderr, what they say and when."""

import re
import threading
import time

from r2h_batch.base.command_line import exit_code_of
from r2h_batch.base.io import progress as progress_file
from r2h_batch.base.io.log import LOG, lines_said, telling
from r2h_batch.base.io.progress import progress


def test_long_work_says_how_far_it_is_and_short_work_nothing(monkeypatch):
    said = []
    monkeypatch.setattr(LOG, "info", said.append)
    with progress("film", 10, "pictures") as told:
        for _ in range(10):
            told(1)
    assert not said
    heard = threading.Semaphore(0)
    monkeypatch.setattr(LOG, "info", lambda line: (said.append(line), heard.release()))
    with progress("film", 10, "pictures", first_s=0.01, every_s=0.01) as told:
        assert heard.acquire(timeout=20)  # though the first picture is not there yet
        told(4)
        assert any(heard.acquire(timeout=20) and "4/10" in said[-1] for _ in range(100))
        told(6)
    assert re.fullmatch(r"film: 0/10 pictures after \d+ s", said[0]), said
    assert re.fullmatch(r"film: 4/10 pictures, [\d.]+ pictures/s, \d+ s left", said[-1]), said
    number = len(said)
    time.sleep(0.05)
    assert len(said) == number, "nothing is said of what has ended"


def test_the_speed_is_that_of_what_had_to_be_done(monkeypatch):
    said, heard = [], threading.Semaphore(0)
    monkeypatch.setattr(LOG, "info", lambda line: (said.append(line), heard.release()))
    with progress("grasps", 86, "objects", first_s=1.0, every_s=0.2) as told:
        told(32)  # kept from before
        assert heard.acquire(timeout=20) and re.fullmatch(r"grasps: 32/86 objects after \d+ s", said[-1]), said
        told(2)
        assert any(heard.acquire(timeout=20) and "34/86" in said[-1] for _ in range(100))
    speed, left = map(float, re.findall(r"([\d.]+) objects/s, (\d+) s left", said[-1])[0])
    assert speed <= 2 / 0.5 and left >= 52 / 4 - 1


def test_a_command_that_says_nothing_says_that_it_works_until_it_speaks(monkeypatch, capsys):
    monkeypatch.setattr(progress_file, "SILENT_S", 0.1)
    monkeypatch.setattr(progress_file, "EVERY_S", 0.1)

    def waits(lines):
        before, end = lines_said(), time.monotonic() + 20.0
        while lines_said() < before + lines and time.monotonic() < end:
            time.sleep(0.01)
        return int(lines_said() < before + lines)

    assert exit_code_of("figures", lambda: waits(2)) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2 and {*lines} == {"figures: working, 0 s"}

    def speaks():
        code = waits(1)
        LOG.info("two pictures")
        time.sleep(0.3)
        return code

    assert exit_code_of("figures", speaks) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2 and lines[-1] == "two pictures" and {*lines[:-1]} == {"figures: working, 0 s"}
    assert exit_code_of("figures", lambda: 0) == 0  # short: nothing, and no thread is left
    assert capsys.readouterr().err == "" and not [t for t in threading.enumerate() if "not silent" in t.name]
    with telling(quiet=True):
        assert exit_code_of("figures", lambda: time.sleep(0.3) or 0) == 0
    assert capsys.readouterr().err == ""
