"""Processes that read files of strangers end with the process that started them."""

import signal
import subprocess
import sys
import tempfile
import time

import pytest
import trimesh
from alive import alive, all_end

from r2h_batch.scene.mesh_import.file import load_mesh_file

READER = """
import os, sys, time
from pathlib import Path
from r2h_batch.base.io.child import answer_parent

def read(data, options):
    Path(options["place"]).write_text(str(os.getpid()))
    while True:
        time.sleep(0.1)

if __name__ == "__main__":
    sys.exit(answer_parent(read))
"""
PARENT = """
import sys
from r2h_batch.base.io.child import read_in_child

with open(__file__, "rb") as file:
    read_in_child("endless_reader", file, {"place": sys.argv[1]}, count=1, seconds=60, doing="reading")
"""


@pytest.mark.alone
def test_a_reader_ends_with_a_parent_that_is_killed(tmp_path):
    (tmp_path / "endless_reader.py").write_text(READER)
    (tmp_path / "parent.py").write_text(PARENT)
    place = tmp_path / "pid"
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py"), str(place)])
    try:
        end = time.monotonic() + 60
        while not (place.exists() and place.read_text()):
            assert time.monotonic() < end and parent.poll() is None
            time.sleep(0.05)
        child = int(place.read_text())
        assert alive(child)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    assert all_end([child], 20)


@pytest.mark.parametrize("place", ["copied", "answered"])
def test_a_full_disk_of_temporary_files_is_told_by_their_folder(place, tmp_path, monkeypatch, own_process):
    """It was told as the run folder's."""
    whole, kept = tmp_path / "ball.stl", []
    trimesh.creation.icosphere(2, 0.05).export(whole)

    def full():
        kept.append(place)
        return open("/dev/full", "r+b", buffering=0) if len(kept) > (place == "answered") else whole_file()

    whole_file = tempfile.TemporaryFile
    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    with pytest.raises(OSError, match="No space left") as error:
        load_mesh_file(whole, "ball")
    assert "TMPDIR names another folder" in error.value.filename
