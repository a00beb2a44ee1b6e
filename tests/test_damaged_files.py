"""Whatever happened to a file, a command reads it or refuses it in one line with exit code 2, within limits, and loses nothing.

A table: kinds of files (tests/support/kinds_of_files.py) by kinds of damage (tests/support/damage.py). `make test` draws some of
each, and places to cut and bits to flip; `make test-all` takes all.
"""

import hashlib
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import NamedTuple

import pytest
from damage import ANY, Damage, Kind, rewritten
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from kinds_of_files import kinds
from rounds import each

from r2h_batch.base.command_line import exit_code_of

KINDS = kinds()
MOST_SECONDS, MOST_MIB = 60.0, 1024
WORKS = ("reading: working for", " s)")


class Ended(NamedTuple):
    """The end of a reading process: exit code (below 0: a signal), what it said, memory beyond what its parent has."""

    code: int
    said: str
    mib: int


def read(kind: Kind, path: Path) -> Ended:
    """Reads a file as a command does, in a process of its own: it may hang, crash, or fill the memory."""
    with tempfile.TemporaryFile("w+b") as said:
        before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
        if not (child := os.fork()):
            code = 99
            try:
                os.setsid()
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                os.dup2(said.fileno(), 2)
                sys.stderr = os.fdopen(2, "w", errors="replace")
                code = exit_code_of("reading", lambda: found if isinstance(found := kind.read(path), int) else 0)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(code)
        end = time.monotonic() + MOST_SECONDS
        while not (done := os.wait4(child, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.killpg(child, signal.SIGKILL)
                end = float("inf")
            time.sleep(0.005)
        said.seek(0)
        words = said.read().decode(errors="replace")
    return Ended(os.waitstatus_to_exitcode(done[1]), words, (done[2].ru_maxrss >> 10) - (before >> 20))


def held(folder: Path) -> list[tuple[int, str]]:
    """Sizes and digests of the regular files in a folder, whatever they are called."""
    files = [p for p in folder.rglob("*") if p.is_file() and not p.is_symlink()]
    large = 1 << 30
    return sorted(
        (p.stat().st_size, "" if p.stat().st_size > large else hashlib.sha256(p.read_bytes()).hexdigest())
        for p in files
    )


def what_is_wrong(kind: Kind, damage: Damage) -> str:
    """What must not happen and does when a damaged file is read; "" if nothing."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / f"file{kind.ending}"
        kind.make(path)
        try:
            damage(path)
        except (ValueError, KeyError, OSError, UnicodeError):  # the damage does not fit this file
            return ""
        before = held(Path(place))
        ended = read(kind, path)
        lines = [x for x in ended.said.strip().splitlines() if not x.endswith(" s")]  # but for how long it works
        said = f"exit code {ended.code}, said {ended.said[-400:]!r}"
        if ended.code not in (0, 2) or "Traceback" in ended.said:
            return f"neither read nor refused: {said}"
        if ended.code == 2 and len(lines) != 1:
            return f"not refused in one line: {said}"
        if any(c in ended.said for c in "\x1b\x07\x00"):
            return f"control characters: {said}"
        if ended.mib > MOST_MIB:
            return f"{ended.mib} MiB"
        return "" if held(Path(place)) == before else f"files of the user have changed: {said}"


@pytest.mark.parametrize("name", KINDS)
def test_a_sound_file_is_read(name: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    kind.make(path := tmp_path / f"file{kind.ending}")
    ended = read(kind, path)
    assert ended.code == 0, ended.said


def cut(where: float) -> Damage:
    """The beginning of the file alone."""
    return rewritten(lambda data: data[: int(where * len(data))])


def flipped(places: list[float]) -> Damage:
    """A bit is another one at each of these places."""

    def change(data: bytes) -> bytes:
        found = bytearray(data)
        for place in places:
            bit = int(place * 8 * len(data))
            found[bit // 8] ^= 1 << bit % 8
        return bytes(found)

    return rewritten(change)


def inserted(where: float, what: bytes) -> Damage:
    """Bytes more in the middle of a file."""
    return rewritten(lambda data: data[: int(where * len(data))] + what + data[int(where * len(data)) :])


SHARE = st.floats(0, 1, exclude_max=True)
BYTES = st.one_of(
    st.builds(cut, SHARE),
    st.builds(flipped, st.lists(SHARE, min_size=1, max_size=8)),
    st.builds(inserted, SHARE, st.binary(min_size=1, max_size=40)),
)


@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_file_is_read_or_refused_in_one_line_and_nothing_is_lost(name: str) -> None:
    kind = KINDS[name]
    named = {**ANY, **kind.own}

    @settings(max_examples=6, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(st.one_of(BYTES, st.sampled_from(sorted(named)).map(named.__getitem__)))
    def tried(damage: Damage) -> None:
        assert (wrong := what_is_wrong(kind, damage)) == "", wrong

    tried()


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_each_named_damage_is_read_or_refused_in_one_line_and_nothing_is_lost(name: str) -> None:
    kind = KINDS[name]
    found = {what: what_is_wrong(kind, damage) for what, damage in each({**ANY, **kind.own}.items(), 9)}
    assert {what: wrong for what, wrong in found.items() if wrong} == {}
