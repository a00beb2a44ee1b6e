"""Files of other people: what is opened, how much of it is read, and what of it reaches a terminal."""

import errno
import os
import socket
import tempfile

import pytest
from rounds import each

from r2h_batch.__main__ import main
from r2h_batch.base.errors import FileError, MachineError
from r2h_batch.base.io.read import open_file, path_within, read_file
from r2h_batch.base.io.write import check_output_file, check_output_folder


def special_files(folder):
    """(name, path) of what looks like a file and is none."""
    os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to("pipe")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(folder / "socket"))
    names = ("pipe", "link", "zero", "folder", "socket")
    return [(n, str(folder / n)) for n in names] + [("device", "/dev/zero"), ("terminal", "/dev/tty")]


def test_only_regular_files_are_opened_and_no_pipe_is_waited_for(tmp_path):
    for name, path in each(special_files(tmp_path)):
        with pytest.raises(FileError) as refused:
            open_file(path, 1 << 20)
        message = str(refused.value)
        assert message.startswith(f"{path}: not a regular file but a") and "\n" not in message, name


def test_a_size_above_the_limit_is_refused_before_reading(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(FileError, match=f"{1 << 40} bytes; at most 100 are allowed"):
        read_file(tmp_path / "sparse", 100)
    (tmp_path / "just").write_bytes(bytes(100))
    assert read_file(tmp_path / "just", 100) == bytes(100)


@pytest.mark.parametrize(
    "name", ["../x", "a/../../x", "/etc/passwd", "C:\\x", "..\\x", "http://x/y", "", "a\0b", "out"]
)
def test_names_in_files_stay_in_their_folder(tmp_path, name):
    (tmp_path / "out").symlink_to("/etc/passwd")
    with pytest.raises(FileError, match="outside the folder"):
        path_within(tmp_path, name)
    assert path_within(tmp_path, "sub/x.bin") == tmp_path.resolve() / "sub" / "x.bin"


def test_every_command_that_takes_a_file_refuses_a_pipe_at_once(tmp_path, monkeypatch, capsys):
    """A blocking open would hang for ever."""
    monkeypatch.chdir(tmp_path)
    for name in ("pipe.npz", "pipe.yaml", "pipe.csv"):
        os.mkfifo(name)
    for line in (
        "sweep --benchmark r2h-v1 --predictions pipe.npz --trials 1 --out run",
        "sweep --config pipe.yaml",
        "study ratings pipe.csv",
        "ls benchmark pipe.yaml",
    ):
        assert main(line.split()) == 2, line
        out, error = capsys.readouterr()
        assert out == "" and error.count("\n") == 1 and "not a regular file" in error, error


def test_a_folder_that_takes_no_file_is_told_before_the_work(monkeypatch, tmp_path):
    """Above it the nearest folder that exists is asked; a folder that takes files keeps none."""

    def full(**_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for check in (check_output_file, check_output_folder):
        check(tmp_path / "new" / "page.html")
        with monkeypatch.context() as patch:
            patch.setattr(tempfile, "TemporaryFile", full)
            with pytest.raises(
                MachineError, match=rf"no file can be written in {tmp_path} \(No space left on device\)"
            ):
                check(tmp_path / "new" / "page.html")
    assert not list(tmp_path.iterdir())
