"""The rows of all built-in methods that ship with the package: `make baselines`, after anything that moves a verdict.

500 trials of each split, as simulated by MuJoCo C (with the poses, so that anybody can judge them again) and as planned.
Six minutes on two cores. tests/statistics/test_baselines.py holds them to the present code.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from r2h_batch.compare.command import FOLDERS
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.options import METHODS

KEPT = ("run.json", "methods", "manifest", "trials", "poses")


def score(folder: Path, trials: int, more: list[str]) -> None:
    """One sweep, and of its folder what is read again."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / folder.name
        if code := sweep(["--method", *METHODS, "--trials", str(trials), "--out", str(out), *more]):
            sys.exit(code)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for name in KEPT:
            if (out / name).exists():
                shutil.move(out / name, folder / name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=500, help="of each split")
    given = parser.parse_args()
    simulated, planned = FOLDERS
    score(simulated, given.trials, ["--sim", "mujoco"])
    score(planned, given.trials, ["--sim", "none", "--no-poses"])


if __name__ == "__main__":
    main()
