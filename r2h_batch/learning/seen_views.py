"""Shards of views (`r2h-batch observe export --believed`) as items to learn from: no judge and no scene is asked again."""

import hashlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.io.read import printable
from r2h_batch.learning.views import FORMAT
from r2h_batch.methods.ranker.search import NEEDS
from r2h_batch.verdicts import CRITERIA

TENSORS = (*NEEDS, "pick", "T_obj_ee", "T_world_ee", "success", "labels")


class Views:
    """The shards of a folder, in the order of their numbers.

    Attributes:
        files: the shards.
        identity: what they were made with, and a digest of all of them.
        names: the instances in them.
        benchmark: its name.
    """

    def __init__(self, folder: Path) -> None:
        """Reads what the shards say of themselves.

        Args:
            folder: of `observe export`.

        Raises:
            UsageError: h5py is missing.
            FileError: no shard, one of another format, of other criteria or without pairs of believed objects.
        """
        if find_spec("h5py") is None:
            raise UsageError(
                "shards of views are HDF5, which h5py reads: pip install 'r2h_batch[import]'"
            )
        self.files = sorted(folder.glob("shard-*.h5"))
        if not self.files:
            raise FileError(
                f"{folder}: holds no shard-NNNNNN.h5; write some with r2h-batch observe export --believed 64"
            )
        digest, names, told = hashlib.sha256(), set[str](), dict[str, str]()
        for path in self.files:
            digest.update(path.read_bytes())
            about, objects = _about(path)
            names |= objects
            told = told or about
            if about != told:
                raise FileError(
                    f"{path}: is of another benchmark or other cameras than {self.files[0].name}"
                )
        self.names, self.benchmark = sorted(names), told["benchmark"]
        self.identity: dict[str, Any] = {
            "benchmark": told["benchmark_digest"], "sees": told["sees"], "views": digest.hexdigest(),
        }  # fmt: skip

    def item(self, index: int) -> dict[str, Tensor]:
        """The pairs of a shard, as `learning.pairs.Pairs` describes an item.

        Args:
            index: 0, 1, 2, ...
        """
        import h5py

        with h5py.File(self.files[index]) as file:
            return {name: torch.from_numpy(file[f"believed/{name}"][()]) for name in TENSORS}


def _about(path: Path) -> tuple[dict[str, str], set[str]]:
    """The making of a shard, and its objects' names."""
    import h5py

    try:
        with h5py.File(path) as file:
            if file.attrs.get("format") != FORMAT:
                raise FileError(
                    f"{path}: is not of format {FORMAT}; write it with r2h-batch observe export"
                )
            if list(file.attrs["criteria"]) != list(CRITERIA):
                raise FileError(
                    f"{path}: has other criteria than {', '.join(CRITERIA)}; write it again"
                )
            missing = [name for name in TENSORS if f"believed/{name}" not in file]
            if missing:
                raise FileError(
                    f"{path}: has no believed/{missing[0]}; write shards with r2h-batch observe export --believed 64"
                )
            objects = {name.decode() for name in file["truth/object"][()]}
            return {
                k: str(file.attrs[k]) for k in ("benchmark", "benchmark_digest", "sees")
            }, objects
    except (OSError, KeyError) as error:
        raise FileError(f"{path}: not a readable shard ({printable(error)})") from error
