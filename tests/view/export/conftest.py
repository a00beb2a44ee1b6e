"""The run that exports are made of."""

import pytest

from r2h_batch.sweep import command as sweep


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Two trials of each split with paths, by a method that succeeds and one that mostly fails. It is not changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    arguments = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "oracle",
        "random",
        "--trials",
        "2",
        "--save-paths",
        "--out",
        str(folder),
    ]
    assert sweep.main(arguments) == 0
    return folder
