"""A trial as depth cameras see it before the robot moves: whole images, windows and the cloud in one picture."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.io.write import atomic_path
from r2h_batch.observe.moment import moments
from r2h_batch.observe.rig import Rig
from r2h_batch.observe.seeing import look, whole_images
from r2h_batch.observe.seen import LABELS, Images, Observation
from r2h_batch.observe.sees import Sees
from r2h_batch.observe.sensor import Masks
from r2h_batch.report.figures import style
from r2h_batch.scene.offscreen import RenderError
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials
from r2h_batch.view.stored import Reader

COLORS = (
    "#e9edf1",
    "#cdc6b8",
    "#747a82",
    "#2a70b2",
    "#dead8e",
    "#8fbf8f",
    "#5e9e6e",
    "#3f7d55",
    "#c98f8f",
)
"""One for each of `LABELS`."""
BEYOND_M = 0.06
"""Depth that a window shows behind what it is about."""


def write_sees(
    reader: Reader,
    trial_id: int,
    rig: Rig,
    out: Path,
    *,
    seed: int = 0,
    noise: float = 1.0,
    labels: Masks = "exact",
) -> None:
    """A picture of what cameras see of a trial (`figure_of`), with the moment of `seed`.

    Args:
        reader: of a run folder; its benchmark has the trial.
        trial_id: which.
        rig: the cameras.
        out: file, with the format in its name.
        seed: of the moment and of the errors.
        noise: factor on the sensor's errors in windows and cloud, 0 (exact) to 5; the whole image has none.
        labels: errors of the windows' masks, as `observe` takes them.

    Raises:
        RenderError: matplotlib is missing.
        UserError: the rig cannot see the trial (`observe.observe`).
    """
    scene, trial = reader.evaluator.scene, _trial(reader, trial_id)
    T = moments(scene, trial, seed=seed)
    seen = look(scene, trial, rig, T, seed=seed, noise=noise, labels=labels)
    figure = figure_of(scene, trial, seen, T, rig, noise=noise, labels=labels)
    with atomic_path(out) as temporary:
        figure.savefig(temporary, metadata={"Software": None} if out.suffix == ".png" else None)


def shown_to(reader: Reader, sees: Sees, trial_id: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The picture of what the methods of a run saw of a trial, (height, width, 3).

    Args:
        reader: of a run folder.
        sees: the sight of its methods.
        trial_id: which.
        size: width and height, pixels.
    """
    from PIL import Image, ImageOps

    scene, trial = reader.evaluator.scene, _trial(reader, trial_id)
    seen, T = sees.look(scene, trial)
    figure = figure_of(scene, trial, seen, T, sees.rig, noise=sees.noise, labels=sees.labels)
    file = BytesIO()
    figure.savefig(file, format="png")
    picture = Image.open(file).convert("RGB")
    return np.asarray(ImageOps.pad(picture, size, color="white"))


def _trial(reader: Reader, trial_id: int) -> Trials:
    return reader.benchmark.trials_with_ids(
        torch.tensor([trial_id], dtype=torch.int64, device="cpu")
    )


def figure_of(
    scene: Scene, trial: Trials, seen: Observation, T_world_obj: Tensor, rig: Rig, *, noise: float, labels: Masks
) -> Any:  # fmt: skip
    """A figure with a row for each camera (the whole image's labels, the windows about object and hand) and the object's cloud.

    Args:
        scene: what is seen.
        trial: one trial.
        seen: what is seen of it.
        T_world_obj: (1, 4, 4) where its object lies, m.
        rig: the cameras.
        noise: factor on the errors of `seen`, for the title.
        labels: errors of its masks, for the title.

    Raises:
        RenderError: matplotlib is missing.
    """
    try:
        from matplotlib.colors import ListedColormap
        from matplotlib.figure import Figure
        from matplotlib.patches import Patch
    except ImportError:
        raise RenderError("pictures need matplotlib: pip install 'r2h_batch[view]'") from None
    _, label = whole_images(scene, trial, rig, T_world_obj)
    model = scene.objects[int(trial.object_index[0])]
    kinds: dict[str, Any] = {
        "cmap": ListedColormap(COLORS),
        "vmin": -0.5,
        "vmax": len(LABELS) - 0.5,
    }
    n = len(rig.cameras)
    with style(page=False):
        figure = Figure(figsize=(12.5, 1.75 * n + 0.9), dpi=110)
        grid = figure.add_gridspec(
            n, 6, width_ratios=[1.7, 1, 1, 1, 1, 1.3], left=0.03, right=0.985, top=1 - 0.55 / (1.75 * n + 0.9),
            bottom=0.4 / (1.75 * n + 0.9), wspace=0.06, hspace=0.08,
        )  # fmt: skip
        for c, camera in enumerate(rig.cameras):
            shown = [
                (label[0, c].numpy(), kinds, "whole image"),
                (seen.object.label[0, c].numpy(), kinds, "about the object"),
                (*_depth(seen.object, c, "object"), "its depth"),
                (seen.hand.label[0, c].numpy(), kinds, "about the hand"),
                (*_depth(seen.hand, c, "hand"), "its depth"),
            ]
            for k, (image, how, words) in enumerate(shown):
                axis = figure.add_subplot(grid[c, k])
                axis.imshow(image, interpolation="nearest", **how)
                axis.set_xticks([])
                axis.set_yticks([])
                if c == 0:
                    axis.set_title(words, fontsize=9)
                if k == 0:
                    axis.set_ylabel(camera.name, fontsize=9)
        axis = figure.add_subplot(grid[:, 5], projection="3d")
        points, mask = seen.cloud(2048)
        own = points[0][mask[0]].double().numpy()
        pose = T_world_obj[0].double().numpy()
        true = model.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        axis.scatter(*true.T, s=1.2, c="0.72", linewidths=0)
        axis.scatter(*own.T, s=1.6, c=COLORS[LABELS.index("object")], linewidths=0)
        middle, half = 0.5 * (true.min(0) + true.max(0)), 0.5 * np.ptp(true, 0).max()
        axis.set_xlim(middle[0] - half, middle[0] + half)
        axis.set_ylim(middle[1] - half, middle[1] + half)
        axis.set_zlim(middle[2] - half, middle[2] + half)
        axis.view_init(30, 180)
        axis.set_axis_off()
        axis.set_title(f"{int(mask[0].sum())} points; grey: all of the object", fontsize=9)
        errors = "exactly" if noise == 0 else f"with {noise:g} times its errors"
        masks = "" if labels == "exact" else f", masks {labels}"
        title = (
            f"trial {int(trial.trial_id[0])}: {model.name}, as {rig.name} sees it {errors}{masks}"
        )
        figure.suptitle(title.replace("with 1 times its", "with its"), fontsize=10)
        patches = [
            Patch(color=color, label=name.replace("_", " "))
            for name, color in zip(LABELS, COLORS, strict=True)
        ]
        figure.legend(
            handles=patches, loc="lower center", ncols=len(LABELS), frameon=False, fontsize=8
        )
        return figure


def _depth(images: Images, camera: int, label: str) -> tuple[np.ndarray, dict[str, Any]]:
    """Depth of a window, NaN where there is none, and the colours' range about what the window is about."""
    depth = images.depth_m[0, camera].numpy()
    own = depth[(images.label[0, camera].numpy() == LABELS.index(label)) & (depth > 0)]
    # a few flying pixels do not decide the colours
    low, high = np.quantile(own, (0.02, 0.98)) if len(own) else (0.5, 1.5)
    return np.where(depth > 0, depth, np.nan), {
        "cmap": "viridis",
        "vmin": low - BEYOND_M / 2,
        "vmax": high + BEYOND_M,
    }
