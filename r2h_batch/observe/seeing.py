"""Look at trials: the moment, the windows, the images."""

from typing import Literal

import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from torch import Tensor

from r2h_batch.base.errors import UsageError
from r2h_batch.base.validate import check_arguments, instance_of, integer, number, one_of, optional
from r2h_batch.config import OBJECT_ERRORS, ObjectErrors
from r2h_batch.observe.estimates import (
    believed_objects,
    believed_receiver,
    image_keys,
    told_region,
)
from r2h_batch.observe.moment import moments
from r2h_batch.observe.rays import FAR_M, bodies_of
from r2h_batch.observe.rig import Rig
from r2h_batch.observe.seen import LABELS, Images, Observation
from r2h_batch.observe.sensor import MASKS, MOST_NOISE, Errors, Masks
from r2h_batch.observe.windows import (
    NEAREST_M,
    intrinsics,
    middles,
    projected,
    window_corners,
)
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

Level = Literal["none", "lab", "field", "rgb"]
"""A key of `OBJECT_ERRORS`."""
Region = Literal["hidden", "told"]
"""Whether it is told which seen points belong to the part that the receiver wants (S1)."""
CAMERA_CLEAR_M = 0.10
"""A camera that is nearer to a body is refused [choice]: stereo of 50 mm sees nothing there."""
WHOLE_STRIDE = 8
"""Pixels between the rays of a whole image."""


@check_arguments(
    scene=instance_of(Scene),
    trials=instance_of(Trials),
    rig=instance_of(Rig, "load_rig(NAME or FILE)"),
    seed=integer(),
    noise=number(0, MOST_NOISE),
    labels=one_of(*MASKS),
    model=optional(one_of(*OBJECT_ERRORS)),
    region=one_of("hidden", "told"),
)
def observe(
    scene: Scene,
    trials: Trials,
    rig: Rig,
    *,
    seed: int = 0,
    noise: float = 1.0,
    labels: Masks = "exact",
    model: Level | None = None,
    region: Region = "hidden",
) -> Observation:
    """Look at trials with the cameras of a rig, at the moment.

    A trial's bits do not depend on the other trials of the call.

    Args:
        scene: what is seen.
        trials: N trials of its objects and hands.
        rig: C cameras, and their sensor.
        seed: of the moments and of the errors.
        noise: factor on the sensor's errors, 0 (exact) to 5.
        labels: exact, or masks of object and hand that are eroded, grown or at times missed.
        model: None: objects are not known; else the level of the error (`OBJECT_ERRORS`, times `noise`) with which the
            objects' poses are.
        region: told: the observation has the receiver's region, as a part labeller sees it (`Observation.region`).

    Raises:
        UserError: an object finds no place (`moments`).
        UsageError: a camera stands in a body, or an object is in no camera's image.
    """
    T_world_obj = moments(scene, trials, seed=seed)
    return look(
        scene, trials, rig, T_world_obj, seed=seed, noise=noise, labels=labels, model=model, region=region
    )  # fmt: skip


def look(
    scene: Scene,
    trials: Trials,
    rig: Rig,
    T_world_obj: Float32[Tensor, "n 4 4"],
    *,
    seed: int = 0,
    noise: float = 1.0,
    labels: Masks = "exact",
    model: Level | None = None,
    region: Region = "hidden",
) -> Observation:
    """As `observe`, at moments of the caller's.

    Args:
        scene: what is seen.
        trials: N trials of its objects and hands.
        rig: C cameras, and their sensor.
        T_world_obj: (N, 4, 4) float32, where the objects lie, m.
        seed: of the errors.
        noise: factor on the sensor's errors, 0 (exact) to 5.
        labels: as in `observe`.
        model: as in `observe`.
        region: as in `observe`.

    Raises:
        UsageError: a camera stands in a body, or an object is in no camera's image.
    """
    _check_cameras(scene, trials, rig, T_world_obj)
    about = middles(scene, trials, T_world_obj)
    _check_in_view(scene, trials, rig, about)
    palm = scene.palm(trials.hand_index, trials.T_world_hand)[0].double()
    errors = Errors(rig, noise=noise, labels=labels, seed=seed, device=scene.device)
    known = None
    if model is not None:
        shift, turn = OBJECT_ERRORS[model]
        sizes = ObjectErrors(noise * shift, noise * turn, seed=seed)
        known = believed_objects(scene, trials, T_world_obj, sizes)
    own = _window(scene, trials, errors, T_world_obj, about, rig.object_px)
    hand = _window(scene, trials, errors, T_world_obj, palm, rig.hand_px)
    told = None
    if region == "told":
        told = told_region(
            scene, trials, own, rig.T_world_camera, T_world_obj, seed=seed, noise=noise
        )
    return Observation(
        own,
        hand,
        errors.believed(trials.trial_id),
        believed_receiver(scene, trials, seed=seed, noise=noise),
        image_keys(own, hand),
        known,
        told,
    )


def whole_images(
    scene: Scene, trials: Trials, rig: Rig, T_world_obj: Float32[Tensor, "n 4 4"]
) -> tuple[Float32[Tensor, "n c h w"], UInt8[Tensor, "n c h w"]]:
    """Exact depth (m) and labels of the cameras' whole sensors, a ray for every eighth pixel each way.

    Args:
        scene: what is seen.
        trials: N trials of its objects and hands.
        rig: C cameras.
        T_world_obj: (N, 4, 4) float32, where the objects lie, m.
    """
    corner = torch.zeros(
        (len(trials), len(rig.cameras), 2), dtype=torch.int32, device=T_world_obj.device
    )
    depth, label, _ = bodies_of(scene).cast(
        trials, T_world_obj, rig.T_world_camera.to(T_world_obj.device), corner, focal_px=rig.focal_px,
        sensor_px=rig.sensor_px, columns=rig.width // WHOLE_STRIDE, rows=rig.height // WHOLE_STRIDE, stride=WHOLE_STRIDE,
    )  # fmt: skip
    return depth, label


def _window(
    scene: Scene, trials: Trials, errors: Errors, T_world_obj: Tensor, about: Float64[Tensor, "n 3"], side: int
) -> Images:  # fmt: skip
    rig = errors.rig
    corner = window_corners(rig, about, side)
    cameras = rig.T_world_camera.to(T_world_obj.device)
    depth, label, facing = bodies_of(scene).cast(
        trials, T_world_obj, cameras, corner, focal_px=rig.focal_px,
        sensor_px=rig.sensor_px, columns=side, rows=side,
    )  # fmt: skip
    depth = errors.measured(trials.trial_id, corner, depth, facing)
    return Images(depth, errors.masked(trials.trial_id, label), intrinsics(rig, corner))


def _check_cameras(scene: Scene, trials: Trials, rig: Rig, T_world_obj: Tensor) -> None:
    """Refuses a camera that stands in a body, or nearly."""
    if not len(trials):
        return
    centers = rig.T_world_camera[None, :, :3, 3].expand(len(trials), -1, -1).to(T_world_obj.device)
    near = bodies_of(scene).near(
        trials, T_world_obj, centers, within_m=CAMERA_CLEAR_M, resting=False
    )
    if bool((near > 0).any()):
        row, camera = (near > 0).nonzero()[0].tolist()
        what = LABELS[int(near[row, camera])].replace("_", " ")
        raise UsageError(
            f"rig {rig.name}: camera {rig.cameras[camera].name!r} is within {CAMERA_CLEAR_M:g} m of the {what} in trial"
            f" {int(trials.trial_id[row])}; move it away"
        )


def _check_in_view(scene: Scene, trials: Trials, rig: Rig, about: Float64[Tensor, "n 3"]) -> None:
    """Refuses rigs of which no camera has an object's middle in its image, and near enough."""
    at, z = projected(rig, about)
    sensor = torch.tensor(rig.sensor_px, dtype=torch.float64, device=at.device)
    inside = ((at >= 0) & (at < sensor)).all(2) & (z > NEAREST_M)
    seen = inside & (z < FAR_M)
    if not bool(seen.any(1).all()):
        row = int((~seen.any(1)).nonzero()[0])
        name = scene.objects[int(trials.object_index[row])].name
        why = _why_unseen(inside[row], z[row])
        raise UsageError(
            f"rig {rig.name}: object {name} of trial {int(trials.trial_id[row])} {why}"
        )


def _why_unseen(inside: Bool[Tensor, " c"], z: Float64[Tensor, " c"]) -> str:
    """What is wrong with a place that no camera sees: which of them have it in their image, and its depth in each, m."""
    if not bool(inside.any()):
        return "is in no camera's image; turn a camera towards the table"
    away = float(z[inside].min())
    return f"is {away:.1f} m from the nearest camera that looks at it; they see {FAR_M:g} m"
