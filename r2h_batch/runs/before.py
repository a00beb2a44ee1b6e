"""Folders, columns and criteria of r2h_batch 0.3 that this version does not read, told in one line."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable
from r2h_batch.runs.columns import UNREAD
from r2h_batch.verdicts import NO_LONGER

FOLDERS = ("held", "picked", "transfer", "viewed")
"""Files beside the shards, which commands of 0.3 made."""
_told: set[tuple[Path, str]] = set()


def tell_unread(folder: Path, header: Mapping[str, Any]) -> None:
    """Says once what nobody reads of a run.

    Args:
        folder: the run folder.
        header: run.json.
    """
    if words := unread(folder, header):
        _tell(folder, f"not read: {words}")


def tell_moved(folder: str) -> None:
    """Says once that rows judged again may differ in Received.

    Args:
        folder: the run folder.
    """
    _tell(
        Path(folder),
        "its Received took the object where a simulated closing had put it; judged again, it is taken where the gripper holds"
        " it by geometry",
    )


def _tell(folder: Path, words: str) -> None:
    if (key := (folder.absolute(), words)) not in _told:
        _told.add(key)
        LOG.info(f"{printable(folder)}: of r2h_batch 0.3; {words}")


def unread(folder: Path, header: Mapping[str, Any]) -> str:
    """The folders and columns of a run that nobody reads, in words; empty where all is read.

    Args:
        folder: the run folder.
        header: run.json.
    """
    found = []
    for name in (n for n in NO_LONGER if n in header.get("asks", ())):
        columns = ", ".join(c for more in UNREAD.values() for c in more)
        found.append(f"{columns}. Rows that failed there keep the outcome {name}")
    found = [f"{f}/" for f in FOLDERS if (folder / f).is_dir()] + found
    return ", ".join(found)
