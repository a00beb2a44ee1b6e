"""How far long work is: lines on stderr, what they say and when."""

import re
import threading
import time

from r2h_batch.base.io.log import LOG
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
