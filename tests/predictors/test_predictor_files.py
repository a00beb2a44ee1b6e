"""Files that are given as contact predictors: opened with limits, refused in one line."""

import os
import zipfile

import pytest
import torch

from r2h_batch.predictors.files import load_predictor
from r2h_batch.predictors.grid import PredictorError


def refused(path, *parts):
    with pytest.raises(PredictorError) as error:
        load_predictor(str(path))
    message = str(error.value)
    assert "\n" not in message and all(part in message for part in parts), message


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_special_and_endless_files_are_refused_unread(tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    with (tmp_path / f"huge{suffix}").open("wb") as file:
        file.truncate(1 << 40)
    refused(tmp_path / f"pipe{suffix}", "not a regular file but a pipe")
    refused(tmp_path / f"zero{suffix}", "not a regular file but a device")
    refused(tmp_path / f"huge{suffix}", f"{1 << 40} bytes; at most")


def test_an_archive_with_members_that_unpack_to_far_more_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("m/constants.pkl", b"")
        archive.writestr("m/code/__torch__.py", bytes(50_000_000))
    refused(tmp_path / "bomb.pt", "at most 200 times")


def test_a_real_torchscript_module_passes_the_checks(tmp_path):
    torch.jit.save(torch.jit.script(torch.nn.Linear(5, 1)), tmp_path / "net.pt")
    assert load_predictor(str(tmp_path / "net.pt"))(torch.zeros(2, 5)).shape == (2, 1)
