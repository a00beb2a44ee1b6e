"""The run that is looked at."""

import pytest

from r2h_batch.sweep import command as sweep


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """Five trials of each split by a method that succeeds and one that mostly fails, poses alone stored. Not changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert (
        sweep.main(
            [
                "--benchmark",
                "r2h-v1",
                "--method",
                "oracle",
                "random",
                "--trials",
                "5",
                "--execute.sim",
                "none",
                "--out",
                str(folder),
            ]
        )
        == 0
    )
    return folder
