"""A shard in HDF5: what depth cameras see of some trials, beside whatever arrays are to be learned with it."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base.package import VERSION
from r2h_batch.observe.seen import LABELS, Images, Observation
from r2h_batch.verdicts import CRITERIA

FORMAT = "r2h-observe-1"
DEPTH_STEP_M = 0.0001
"""Stored depths are multiples of it: that of cell-v1's sensor."""
CLOUD = 2048


def seen_arrays(seen: Observation) -> Iterator[tuple[str, NDArray[Any]]]:
    """The datasets of what was seen of N trials, by path.

    Args:
        seen: of N trials.
    """
    for name, images in (("object", seen.object), ("hand", seen.hand)):
        yield from _images(name, images)
    yield "T_world_camera", seen.T_world_camera.numpy()
    for name, value in vars(seen.receiver).items():
        yield f"receiver/{name}", value.numpy()
    points, mask = seen.cloud(CLOUD)
    yield "cloud/points", points.numpy()
    yield "cloud/mask", mask.numpy()
    if seen.region is not None:
        yield "object/region", seen.region.numpy()
        yield "cloud/region", seen.cloud_region(CLOUD).numpy()


def _images(name: str, images: Images) -> Iterator[tuple[str, NDArray[Any]]]:
    steps = torch.round(images.depth_m.double() / DEPTH_STEP_M)
    yield f"{name}/depth", steps.numpy().astype(np.uint16)
    yield f"{name}/label", images.label.numpy()
    yield f"{name}/K", images.K.numpy()


def write_shard(
    path: Path, arrays: Iterable[tuple[str, NDArray[Any]]], made_with: Mapping[str, str]
) -> None:
    """Write a shard.

    Args:
        path: of the file.
        arrays: datasets of N rows, by path.
        made_with: attributes that say where it is from.
    """
    import h5py

    with h5py.File(path, "w") as file:
        file.attrs.update(
            format=FORMAT, version=VERSION, depth_step_m=DEPTH_STEP_M, labels=list(LABELS), criteria=list(CRITERIA),
            **made_with,
        )  # fmt: skip
        for name, array in arrays:
            packed: dict[str, Any] = {}
            if array.nbytes > 4096 * len(array):  # images and clouds: a trial is a chunk
                packed = {"chunks": (1, *array.shape[1:]), "compression": "gzip", "shuffle": True}
            file.create_dataset(name, data=array, track_times=False, **packed)
