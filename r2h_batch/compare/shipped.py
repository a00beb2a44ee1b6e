"""The stored rows of all built-in methods, which ship with the package: `compare runs/mine
baselines` needs no rerun.

`make baselines` scores them again: 500 trials of each split, as simulated (with poses) and as
planned.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["BASELINES", "FOLDERS", "baselines_for"]

BASELINES = "baselines"
"""The word that stands for them on a command line."""

_HERE = Path(__file__).parent
FOLDERS = (_HERE / "baselines", _HERE / "baselines_as_planned")
"""Run folders: moved by MuJoCo C, and with `--sim none`."""


def baselines_for(header: Mapping[str, Any] | None = None) -> Path:
    """The shipped run that was moved by the same engine as the run of a run.json; as simulated
    unless given."""
    execute = (header or {}).get("configuration", {}).get("execute") or {}
    return FOLDERS[execute.get("sim") == "none"]
