"""methods/METHOD.json: the methods of a run folder, and the shards that each has."""

import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import READS
from r2h_batch.runs.files import RunError, is_held
from r2h_batch.runs.header import Method, checked, read_json, shard_at, shard_count
from r2h_batch.runs.shard import StoredShard, number_of, shard_files, stored_files

_BEFORE = {
    **dict.fromkeys(("fc", "handover-va", "contact", "intent", "learned"), "estimates"),
    **dict.fromkeys(("oracle", "robust"), "judge"),
}
"""What built-in methods of runs read that do not say it."""
_SLUG = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,79}")


@dataclass(frozen=True)
class Entry:
    """A method of a run folder.

    Attributes:
        folder: the run folder.
        header: its run.json.
        slug: the method's part of file names.
        name: the method's name. In a joined run its robot or run may stand in front.
        source: where its answers come from.
        command: the command line that added it.
        order: its place among the methods.
        shards: number of a stored shard -> the shard, in order; `load_run` lists them.
    """

    folder: Path
    header: dict[str, Any]
    slug: str
    name: str
    source: dict[str, str]
    command: list[str]
    order: int
    shards: dict[int, StoredShard] = field(default_factory=dict)

    def claim_path(self, number: int) -> Path:
        """The file that a process locks while it works on a shard."""
        return self.folder / ".claims" / f"{self.slug}-{number:06d}"

    def claims(self) -> dict[int, Path]:
        """The number of every shard with such a file, and the file."""
        named = re.compile(rf"{re.escape(self.slug)}-(\d{{6,}})")
        place = self.folder / ".claims"
        names = sorted(os.listdir(place)) if place.is_dir() else []
        return {int(found[1]): place / found[0] for n in names if (found := named.fullmatch(n))}

    @property
    def data_files(self) -> str:
        """The pattern of the files that hold the rows, in the run folder."""
        return f"shards/{self.slug}/*.parquet"

    @property
    def complete(self) -> bool:
        """Whether every shard is stored; run.json may claim a million, so none is listed."""
        return len(self.shards) == shard_count(self.header)

    @property
    def hindrance(self) -> str:
        """What keeps shards out that sweeping again is no answer to, and what to do; empty where there is nothing."""
        for path in shard_files(self.folder, self.slug):
            if path.suffix == ".parquet" and number_of(path) is None:
                words = "no shard has such a name, so it was passed over; give it its own name back"
                return f"{printable(path)}: {words}"
        if any(is_held(path) for path in self.claims().values()):
            done = sum(s.shard.last - s.shard.first for s in self.shards.values())
            planned = sum(self.header["trials"].values())
            return f"a sweep is at work, {done} of {planned} trials of {self.name} are scored; wait for it"
        return ""

    @property
    def reads(self) -> str:
        """What the method may read, a word of `READS`; empty where nobody says it. Runs of 0.3 go by the method."""
        if (word := self.source.get("reads", "")) in READS:
            return word
        if self.source.get("kind") != "method":
            return ""
        if self.header.get("sees") is not None:
            return "cameras"
        module = self.source.get("function", "").partition(":")[0]
        known = {
            f"r2h_batch.methods.{name.replace('-', '_')}": own for name, own in _BEFORE.items()
        }
        return known.get(module, "scene")

    def listed(self) -> "Entry":
        """The method with the shards that its folder holds now."""
        shards: dict[int, StoredShard] = {}
        for number, path in stored_files(self.header, self.folder, self.slug).items():
            if shard := shard_at(self.header, number):
                shards[number] = StoredShard(path, self.header, self.name, shard)
        return replace(self, shards=shards)


def read_methods(folder: Path, header: dict[str, Any]) -> list[Entry]:
    """The methods in the order in which they were added, without receipts."""
    entries = []
    for path in sorted((folder / "methods").glob("[!.]*.json")):
        if not _SLUG.fullmatch(path.stem):
            words = "foreign, no method's file has such a name; take it away"
            raise RunError(f"{printable(path)}: {words}")
        entries.append(Entry(folder, header, path.stem, **checked(Method, read_json(path), path)))
    names = [e.name for e in entries]
    if len(set(names)) != len(names):
        twice = max(names, key=names.count)
        words = f"two files name the method {twice!r}; take one away"
        raise RunError(f"{folder / 'methods'}: {words}")
    return sorted(entries, key=lambda e: (e.order, e.name))
