"""How far long work is: lines on stderr, what they say and when."""

import re
import threading
import time

import pytest

from r2h_batch.base.command_line import exit_code_of
from r2h_batch.base.io import progress as progress_file
from r2h_batch.base.io.log import LOG, lines_said, telling
from r2h_batch.base.io.progress import busy, progress


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


@pytest.mark.alone
def test_a_command_that_says_nothing_says_that_it_works(monkeypatch, capsys):
    monkeypatch.setattr(progress_file, "SILENT_S", 0.1)
    monkeypatch.setattr(progress_file, "SOON_S", 0.1)

    def waits(lines):
        before, end = lines_said(), time.monotonic() + 20.0
        while lines_said() < before + lines and time.monotonic() < end:
            time.sleep(0.01)
        return int(lines_said() < before + lines)

    assert exit_code_of("report", lambda: waits(2)) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2 and {*lines} == {"report: working, 0 s"}

    def speaks():
        code = waits(1)
        LOG.info("two pictures")
        time.sleep(0.3)
        return code

    assert exit_code_of("report", speaks) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "report: working, 0 s" and {*lines} == {"report: working, 0 s", "two pictures"}
    assert exit_code_of("report", lambda: 0) == 0  # short: nothing, and no thread is left
    assert capsys.readouterr().err == "" and not [t for t in threading.enumerate() if "not silent" in t.name]
    with telling(quiet=True):
        assert exit_code_of("report", lambda: time.sleep(0.3) or 0) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.alone
def test_a_command_that_lasts_says_more_rarely_that_it_works(monkeypatch, capsys):
    for name, seconds in (("SILENT_S", 0.05), ("SOON_S", 0.05), ("SOON_UNTIL_S", 0.3), ("EVERY_S", 60.0)):
        monkeypatch.setattr(progress_file, name, seconds)
    assert exit_code_of("film", lambda: time.sleep(1.5) or 0) == 0
    assert 1 <= len(capsys.readouterr().err.splitlines()) <= 7  # the first 0.3 s have six; 1.5 s would have thirty


@pytest.mark.alone
def test_a_command_says_that_it_works_again_where_it_falls_silent_and_not_beside_what_is_counted(monkeypatch, capsys):
    for name in ("SILENT_S", "SOON_S"):
        monkeypatch.setattr(progress_file, name, 0.1)

    def speaks_then_works():
        LOG.info("reading")
        end = time.monotonic() + 20.0
        while "works: working" not in capsys_text() and time.monotonic() < end:
            time.sleep(0.02)
        return 0

    heard = []

    def capsys_text():
        heard.append(capsys.readouterr().err)
        return "".join(heard)

    assert exit_code_of("works", speaks_then_works) == 0
    assert re.match(r"reading\nworks: working, 0 s\n", "".join(heard))

    def counts():
        with progress("film", 10, "pictures", first_s=30.0):
            time.sleep(0.5)
        return 0

    assert exit_code_of("counts", counts) == 0
    # what counts may have begun a moment before: the first line does not wait for it
    assert capsys.readouterr().err == "counts: working, 0 s\n"


def test_calls_of_a_script_say_that_they_work_once_all_of_them_took_long(monkeypatch):
    said = []
    monkeypatch.setattr(LOG, "info", said.append)
    monkeypatch.setattr(progress_file, "LEAST_S", 0.05)
    monkeypatch.setattr(progress_file, "FIRST_S", 0.6)
    now = time.perf_counter()
    monkeypatch.setitem(progress_file._calls, "begin", now)
    monkeypatch.setitem(progress_file._calls, "end", now)
    for name in ("loading", "drawing"):
        with busy(name):
            time.sleep(0.2)
    assert not said
    with busy("judging"):
        time.sleep(0.5)
    assert len(said) == 1 and re.fullmatch(r"judging: 1 s so far", said[0]), said
    monkeypatch.setitem(progress_file._calls, "end", time.perf_counter() - 1000.0)  # later, another piece of work
    with busy("judging"):
        time.sleep(0.2)
    assert len(said) == 1


def test_a_call_inside_of_a_command_or_of_what_is_counted_starts_no_thread(monkeypatch):
    monkeypatch.setattr(progress_file, "SILENT_S", 120.0)

    def threads():
        return [t.name for t in threading.enumerate() if t.name == "progress of judging"]

    def inside():
        with busy("judging"):
            return len(threads())

    assert exit_code_of("sweep", inside) == 0
    with progress("film", 10, "pictures"), busy("judging"):
        assert not threads()
    with busy("judging"):
        assert len(threads()) == 1
    assert not threads()
