"""Rigs: depth cameras that stand in the cell, their windows and the errors of their sensor, in a TOML file or by name."""

import hashlib
import json
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic
import torch
from jaxtyping import Float32
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from r2h_batch.base.errors import FileError, UsageError, nearest
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.base.validate import describe_value, rule_of

_Coordinate = Annotated[float, Field(ge=-5, le=5, allow_inf_nan=False)]
_Point = Annotated[tuple[_Coordinate, ...], Field(min_length=3, max_length=3)]
_Pixels = Annotated[int, Field(ge=16, le=4096)]
_Window = Annotated[int, Field(ge=16, le=1024)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Camera(_Part):
    """One camera on a post.

    Attributes:
        name: of its random numbers and of messages.
        position: of its centre in the world, m.
        target: what it looks at, m; its rows are level.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    position: _Point
    target: _Point


_Length = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Sensor(_Part):
    """Errors of a stereo depth camera and of its calibration (docs/observe.md has their sources).

    Attributes:
        baseline_m: between its two eyes, m.
        disparity_px: deviation of a measured disparity; the depth z has the deviation z^2 disparity_px / (focal_px baseline_m).
        disparity_side_px: side of the squares of pixels that share such an error.
        lateral_px: deviation each way of where a pixel looks, pixels.
        edge_m: a step of depth of this among a pixel and its eight neighbours is an edge, m.
        edge_lost: share of the pixels at edges that measure nothing.
        edge_flying: share of them that measure a depth between the nearer and the farther side.
        steepest_deg: a surface whose normal is turned further from the ray is not measured, degrees.
        lost: share of all pixels that measure nothing.
        step_m: depths are multiples of it, m.
        calibration_m: deviation each way of where a camera is believed to stand, m.
        calibration_deg: of how it is believed to be turned, about each of its axes, degrees.
        mask_px: how far masks grow or shrink where labels are asked to, pixels.
        mask_missed: share of masks that are not there where labels are asked to miss some.
    """

    baseline_m: Annotated[float, Field(ge=0.001, le=1, allow_inf_nan=False)] = 0.050
    disparity_px: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.08
    disparity_side_px: Annotated[int, Field(ge=1, le=64)] = 2
    lateral_px: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.5
    edge_m: _Length = 0.02
    edge_lost: _Share = 0.3
    edge_flying: _Share = 0.3
    steepest_deg: Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)] = 80.0
    lost: _Share = 0.005
    step_m: Annotated[float, Field(ge=1e-5, le=0.1, allow_inf_nan=False)] = 0.0001
    calibration_m: _Length = 0.002
    calibration_deg: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.2
    mask_px: Annotated[int, Field(ge=0, le=16)] = 2
    mask_missed: _Share = 0.05


class Rig(_Part):
    """Cameras of one kind. Pixels are square, there is no distortion, the principal point is the sensor's middle.

    Attributes:
        name: of messages and run folders.
        width: columns of the sensor.
        height: its rows.
        focal_px: focal length, pixels.
        object_px: side of the window about the object, pixels.
        hand_px: side of the window about the hand, pixels.
        cameras: one to eight.
        sensor: their errors.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,40}$")]
    width: _Pixels = 1280
    height: _Pixels = 720
    focal_px: Annotated[float, Field(ge=16, le=1e5, allow_inf_nan=False)] = 650.0
    object_px: _Window = 192
    hand_px: _Window = 128
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1, max_length=8)]
    sensor: Sensor = Sensor()

    @property
    def sensor_px(self) -> tuple[int, int]:
        """Columns and rows of the sensor."""
        return self.width, self.height

    @property
    def T_world_camera(self) -> Float32[Tensor, "c 4 4"]:
        """Where the cameras stand (m): x along rows, y along columns, z forward."""
        return torch.from_numpy(
            np.stack([look_at(c.position, c.target) for c in self.cameras])
        ).float()

    @property
    def digest(self) -> str:
        """sha256 (hex) of all numbers."""
        data = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(data.encode()).hexdigest()

    def only(self, *names: str) -> "Rig":
        """The rig with some of its cameras.

        Args:
            names: of the cameras.

        Raises:
            UsageError: it has no camera of this name.
        """
        known = {c.name: c for c in self.cameras}
        for name in names:
            if name not in known:
                raise UsageError(
                    f"camera {name!r} is not in rig {self.name}{nearest(name, list(known))}; it has {', '.join(known)}"
                )
        chosen = tuple(known[n] for n in names)
        return self.model_copy(update={"cameras": chosen})


def look_at(position: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    """(4, 4) float64 pose in the world of a camera with level rows: x right, y down, z towards the target, m."""
    eye = np.array(position, np.float64)
    z = np.array(target, np.float64) - eye
    z /= math.sqrt(float((z * z).sum()))
    x = np.array([z[1], -z[0], 0.0])
    x /= math.sqrt(float((x * x).sum()))
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    T[:3, 3] = eye
    return T


MAX_BYTES = 1 << 16
"""A rig has at most eight cameras."""

POSTS = (
    Camera(name="left", position=(-0.10, 0.75, 0.80), target=(0.42, -0.02, 0.15)),
    Camera(name="right", position=(-0.10, -0.75, 0.80), target=(0.42, 0.02, 0.15)),
)
"""Two posts behind the robot [choice]: 0.95 m from the object, 0.95 to 1.2 m from the hand."""

CELL_V1 = Rig(name="cell-v1", cameras=POSTS)
"""Frozen: rows of what was seen with it name its digest. 1280 x 720 pixels and 650 px give 58 degrees of height, as a D435's
depth image has (from memory)."""

RIGS = {rig.name: rig for rig in (CELL_V1,)}


def load_rig(name: str | Path) -> Rig:
    """The rig of a name (`cell-v1`) or of a TOML file with the fields of `Rig`.

    Args:
        name: name or file.

    Raises:
        UsageError: there is neither a rig nor a file of this name.
        FileError: one line about the first field that cannot be.
    """
    if str(name) in RIGS:
        return RIGS[str(name)]
    path = Path(name)
    if path.suffix != ".toml":
        allowed = f"allowed are {', '.join(RIGS)} or a file that ends with .toml"
        raise UsageError(f"rig {printable(name)!r}{nearest(str(name), list(RIGS))}; {allowed}")
    try:
        data: dict[str, Any] = tomllib.loads(read_file(path, MAX_BYTES).decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise FileError(f"{printable(path)}: no TOML file ({printable(error)[:120]})") from None
    try:
        rig = Rig.model_validate(data)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        found = (
            ""
            if first["type"] == "missing"
            else f" is {printable(describe_value(first['input']))[:60]}"
        )
        rule = "it is needed" if first["type"] == "missing" else rule_of(first)
        if first["type"] == "extra_forbidden":
            parts: dict[str, type[_Part]] = {"sensor": Sensor, "cameras": Camera}
            has = [*(Rig if len(first["loc"]) == 1 else parts[str(first["loc"][0])]).model_fields]
            rule = f"there is no such field{nearest(str(first['loc'][-1]), has)}; it has {', '.join(has)}"
        raise FileError(f"{printable(path)}: {where}{found}; {rule}") from None
    names = [c.name for c in rig.cameras]
    if twice := [n for n in names if names.count(n) > 1]:
        raise FileError(
            f"{printable(path)}: two cameras are called {twice[0]!r}; give each its own name"
        )
    for side, pixels in (("object_px", rig.object_px), ("hand_px", rig.hand_px)):
        if pixels > min(rig.width, rig.height):
            allowed = f"a window is no larger than the sensor, {rig.width} x {rig.height}"
            raise FileError(f"{printable(path)}: {side} is {pixels}; {allowed}")
    for camera in rig.cameras:
        across = np.hypot(*(np.array(camera.target) - camera.position)[:2])
        if across < 0.01:
            words = "its target must be 1 cm or more beside the vertical through its position"
            raise FileError(f"{printable(path)}: camera {camera.name!r} looks up or down; {words}")
    return rig
