"""Folders, columns and criteria of r2h_batch 0.3 that this version does not read, told in one line."""

from collections.abc import Mapping, Sequence
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
    """Says once what nobody reads of a run, and whether its receivers have no head.

    Args:
        folder: the run folder.
        header: run.json.
    """
    words = unread(folder, header)
    head = [CHANGES["head"]] if _without_head(header) else []
    _tell(folder, [*([f"not read: {words}"] if words else []), *head])


CHANGES = {
    "taken": "its Received took the object where a simulated closing had put it; judged again, it is taken where the gripper"
    " holds it by geometry",
    "head": "its receivers have no head; judged again, the head counts as arm and torso do",
}
"""What may differ in rows that are judged again (`Benchmark.digests_before`), in words."""


def tell_changed(folder: Path, changed: Sequence[str]) -> None:
    """Says once in what rows judged again may differ.

    Args:
        folder: the run folder.
        changed: keys of `CHANGES`.
    """
    _tell(folder, [CHANGES[name] for name in changed])


def has_head(header: Mapping[str, Any]) -> bool:
    """Whether a run's receivers have a head, in `body_m` and where `--receiver body` counts it; those of r2h_batch 0.3 had none.

    Args:
        header: run.json.
    """
    return "head" in header.get("person", ())


def _without_head(header: Mapping[str, Any]) -> bool:
    """Whether verdicts of a run counted receivers that had no head."""
    return not has_head(header) and header["configuration"].get("receiver") == "body"


def _tell(folder: Path, facts: Sequence[str]) -> None:
    """Says in one line those of these facts that were not said yet of the folder."""
    new = [words for words in facts if (folder.absolute(), words) not in _told]
    _told.update((folder.absolute(), words) for words in new)
    if new:
        LOG.info(f"{printable(folder)}: of r2h_batch 0.3; {'. '.join(new)}")


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
