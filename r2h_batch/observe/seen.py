"""Images and clouds of cameras: all that a method that sees is given. Imports nothing of the scene."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.base.validate import check_arguments, integer, one_of

LABELS = ("nothing", "table", "robot", "object", "hand", "forearm", "upper_arm", "torso", "head")
"""Things that a pixel can show, by its label."""
T = TypeVar("T")


@dataclass(frozen=True)
class Images:
    """Windows of N trials and C cameras, rows before columns.

    Attributes:
        depth_m: along the camera's z axis, m; 0 where nothing was measured.
        label: what each pixel shows, a number of `LABELS`.
        K: intrinsics of each window, pixels; the middle of the first pixel is at (0.5, 0.5).
    """

    depth_m: Float32[Tensor, "n c h w"]
    label: UInt8[Tensor, "n c h w"]
    K: Float32[Tensor, "n c 3 3"]


@dataclass(frozen=True)
class Receiver:
    """The receiving hands of N trials as they are believed to be, world.

    Attributes:
        palm: middle of the palm, m. Reach asks for the object within 10 cm of the point 12 cm in front of it.
        normal: out of the palm, a unit vector.
        along: from the wrist to the middle finger, a unit vector across `normal`.
        left: whether it is a left hand.
    """

    palm: Float32[Tensor, "n 3"]
    normal: Float32[Tensor, "n 3"]
    along: Float32[Tensor, "n 3"]
    left: Bool[Tensor, " n"]


@dataclass(frozen=True)
class KnownObjects:
    """The objects of N trials, for methods that know their models.

    Attributes:
        T_world_obj: where the objects are believed to lie, m.
        mesh: which of `vertices` and `faces` each trial's object is.
        vertices: of each mesh (V, 3), object's frame, m.
        faces: of each mesh (F, 3), rows of its vertices.
    """

    T_world_obj: Float32[Tensor, "n 4 4"]
    mesh: Int64[Tensor, " n"]
    vertices: tuple[Float32[Tensor, "v 3"], ...]
    faces: tuple[Int32[Tensor, "f 3"], ...]


@dataclass(frozen=True)
class Observation:
    """The view of C cameras on N trials at the moment (`moments`).

    Attributes:
        object: windows about the object.
        hand: windows about the receiver's hand.
        T_world_camera: where the cameras are believed to stand (x along rows, y along columns, z forward), m.
        receiver: where the receiving hand is believed to be.
        key: a number of each trial's images: for random draws that are the same in any batch.
        known: the objects' models and poses; None where no model is known.
        region: of each pixel of `object`, whether a part labeller puts what was measured there into the receiver's region; False
            where no object was measured, and in trials without a region. None where no region is told.
    """

    object: Images
    hand: Images
    T_world_camera: Float32[Tensor, "n c 4 4"]
    receiver: Receiver
    key: Int64[Tensor, " n"]
    known: KnownObjects | None = None
    region: Bool[Tensor, "n c h w"] | None = None

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def __getitem__(self, rows: slice | Tensor) -> "Observation":
        """The selected trials."""

        def of(part: T) -> T:
            return replace(
                part, **{k: x[rows] for k, x in vars(part).items() if isinstance(x, Tensor)}
            )  # type: ignore[type-var]

        known = None if self.known is None else of(self.known)
        return replace(
            of(self),
            object=of(self.object),
            hand=of(self.hand),
            receiver=of(self.receiver),
            known=known,
        )

    @check_arguments(points=integer(0), label=one_of(*LABELS), seed=integer())
    def cloud(
        self, points: int = 2048, *, label: str = "object", seed: int = 0
    ) -> tuple[Float32[Tensor, "n p 3"], Bool[Tensor, "n p"]]:
        """Clouds of a fixed size, drawn from the pixels that show a thing and have a depth, each at most once.

        A pixel's turn follows from (seed, label, `key`, pixel) by Philox counters: the same bits in any batch. A smaller cloud
        is the beginning of a larger one. Fewer pixels than points: each comes once and the rest is masked.

        Args:
            points: of each trial.
            label: of `LABELS`; `hand` is taken from the windows about the hand, all else from those about the object.
            seed: of the draw.

        Returns:
            (N, P, 3) float32 in the world, m, 0 where masked; (N, P) whether there is a point.

        Raises:
            TypeError: an argument of another type.
            ValueError: a number of points below 0, or no such label.
        """
        images = self.hand if label == "hand" else self.object
        mask, camera, v, u = self._drawn(images, points, label, seed)
        of = torch.arange(len(self), dtype=torch.int64, device=mask.device)[:, None]
        K, T = images.K[of, camera], self.T_world_camera[of, camera]
        z = images.depth_m[of, camera, v, u]
        x = (u + 0.5 - K[..., 0, 2]) / K[..., 0, 0] * z
        y = (v + 0.5 - K[..., 1, 2]) / K[..., 1, 1] * z
        found = torch.stack(
            [
                x * T[..., k, 0] + y * T[..., k, 1] + z * T[..., k, 2] + T[..., k, 3]
                for k in range(3)
            ],
            -1,
        )
        return torch.where(mask[..., None], found, torch.zeros_like(found)), mask

    @check_arguments(points=integer(0), seed=integer())
    def cloud_region(self, points: int = 2048, *, seed: int = 0) -> Bool[Tensor, "n p"]:
        """Whether each point of `cloud(points, seed=seed)` is in the receiver's region; False where masked.

        Args:
            points: of each trial.
            seed: of the cloud's draw.

        Raises:
            ValueError: no region is told.
        """
        if self.region is None:
            raise ValueError("the receiver's region is not told; look with region=told")
        mask, camera, v, u = self._drawn(self.object, points, "object", seed)
        of = torch.arange(len(self), dtype=torch.int64, device=mask.device)[:, None]
        return self.region[of, camera, v, u] & mask

    def _drawn(
        self, images: Images, points: int, label: str, seed: int
    ) -> tuple[
        Bool[Tensor, "n p"], Int64[Tensor, "n p"], Int64[Tensor, "n p"], Int64[Tensor, "n p"]
    ]:
        """The pixels of a cloud: whether there is one, camera, row and column."""
        shown = (images.label == LABELS.index(label)) & (images.depth_m > 0)
        row, pixel = (x.cpu().numpy() for x in shown.flatten(1).nonzero(as_tuple=True))
        key, ids = rng.key_of(f"cloud {label} {seed}"), self.key.cpu().numpy()
        (turn,) = rng.uniforms(key, ids[row], 1, purpose=0, attempt=pixel)
        # of equal turns the first pixel: numbers to sort, which takes a tenth of sorting by two columns
        order = (turn * 2.0**32).astype(np.uint64) << np.uint64(32) | pixel.astype(np.uint64)
        ends = np.searchsorted(row, np.arange(len(self) + 1))
        # masked places read any pixel
        taken = np.zeros((len(self), points), np.int64)
        there = np.arange(points) < np.diff(ends)[:, None]
        for i, (begin, end) in enumerate(itertools.pairwise(ends.tolist())):
            own = np.sort(order[begin:end])[:points]
            taken[i, : len(own)] = own & np.uint64(0xFFFFFFFF)
        mask, at = (torch.from_numpy(x).to(shown.device) for x in (there, taken))
        h, w = shown.shape[-2:]
        return mask, at // (h * w), at % (h * w) // w, at % w


def packed(seen: Observation) -> dict[str, NDArray[np.generic]]:
    """All arrays of an observation by name, on the CPU, for another process.

    Args:
        seen: of N trials.
    """
    arrays = {
        f"{name} {k}": value
        for name in ("object", "hand", "receiver")
        for k, value in vars(getattr(seen, name)).items()
    }
    arrays |= {"T_world_camera": seen.T_world_camera, "key": seen.key}
    if seen.region is not None:
        arrays["region"] = seen.region
    if (known := seen.known) is not None:
        arrays |= {"known T_world_obj": known.T_world_obj, "known mesh": known.mesh}
        for name in ("vertices", "faces"):
            arrays |= {f"{name} {i}": x for i, x in enumerate(getattr(known, name))}
    return {name: value.detach().cpu().numpy() for name, value in arrays.items()}


def unpacked(arrays: Mapping[str, NDArray[np.generic]]) -> Observation:
    """The observation that `packed` took apart, in memory of its own.

    Args:
        arrays: by name.
    """
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}

    def of(part: str) -> dict[str, Tensor]:
        return {
            k.removeprefix(f"{part} "): x for k, x in tensors.items() if k.startswith(f"{part} ")
        }

    known = None
    if "known mesh" in tensors:
        vertices, faces = of("vertices"), of("faces")
        known = KnownObjects(
            tensors["known T_world_obj"],
            tensors["known mesh"],
            tuple(vertices[str(i)] for i in range(len(vertices))),
            tuple(faces[str(i)] for i in range(len(faces))),
        )
    return Observation(
        Images(**of("object")), Images(**of("hand")), tensors["T_world_camera"],
        Receiver(**of("receiver")), tensors["key"], known, tensors.get("region"),
    )  # fmt: skip
