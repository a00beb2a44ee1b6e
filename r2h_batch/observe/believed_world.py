"""The world that arms are planned in where a run's methods see: what the cameras showed, in place of the truth.

The object is the solid that the images show (`solid`), or the known mesh where it is believed to lie. The hand stands where its
estimator sees it, arm, torso and head are shifted as the middle of the palm is. All of the person is grown by `ROOM_M`
(`Scene.hand_room_m`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.observe.believed_object import believed_object
from r2h_batch.observe.sees import Sees
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.noise import PredictorNoise, estimated_hand
from r2h_batch.types import Trials

ROOM_M = 0.01
"""How far plans grow the person that they believe in [choice]: an estimator is off by 12 mm along each axis."""


@dataclass(frozen=True)
class BelievedWorld:
    """M of N trials: those in which something is seen that could be an object.

    Attributes:
        row: which of the N.
        scene: the believed objects, the benchmark's hands, the robot.
        trials: in that scene, with the true trials' ids.
        T_world_obj: where the believed objects lie, m.
    """

    row: Int64[Tensor, " m"]
    scene: Scene
    trials: Trials
    T_world_obj: Float64[Tensor, "m 4 4"]

    def grasps(self, T_world_grasp: Float64[Tensor, "m 4 4"]) -> Float32[Tensor, "m 4 4"]:
        """The same grasps in the believed objects' frames, T_obj_ee (m).

        Args:
            T_world_grasp: the ee where the objects lie, m.
        """
        return se3.matmul(se3.inverse(self.T_world_obj), T_world_grasp).float()


def believed_world(scene: Scene, trials: Trials, sees: Sees) -> BelievedWorld | None:
    """The world that planning believes N trials to be; None: nothing is seen in any of them.

    A trial's part of it depends on that trial alone.

    Args:
        scene: the true one.
        trials: N trials.
        sees: the cameras and their errors.
    """
    seen, _ = sees.look(scene, trials)
    found = [believed_object(seen, i) for i in range(len(seen))]
    rows = [i for i, x in enumerate(found) if x is not None]
    if not rows:
        return None
    objects = {x[0].name: x[0] for x in found if x is not None}
    index = [list(objects).index(x[0].name) for x in found if x is not None]
    row = torch.tensor(rows, dtype=torch.int64, device="cpu")
    own = replace(
        scene.benchmark, name="believed", objects=tuple(objects.values()), listed=None, labels=None, certified=None,
        asks=("pick",),
    )  # fmt: skip
    believed = Scene(own, scene.device, config=scene.config, hand_room_m=ROOM_M)
    T_world_hand, receiver = _person(scene, trials[row], sees)
    moved = replace(
        trials[row],
        object_index=torch.tensor(index, dtype=torch.int32, device=scene.device),
        T_world_hand=T_world_hand,
        receiver=receiver,
    ).named(believed.objects)
    T_world_obj = np.stack([x[1] for x in found if x is not None])
    return BelievedWorld(row, believed, moved, torch.from_numpy(T_world_obj).to(scene.device))


def _person(
    scene: Scene, trials: Trials, sees: Sees
) -> tuple[Float32[Tensor, "m 4 4"], Float32[Tensor, "m 5 4"] | None]:
    """Where hands are believed to stand, and the persons with them."""
    hands = trials.hand_index
    noise = PredictorNoise().scaled(sees.noise)
    T = estimated_hand(
        scene, trials.trial_id, hands, trials.T_world_hand, seed=sees.seed, noise=noise
    )
    T = se3.orthonormalise(T).contiguous()
    if trials.receiver is None:
        return T, None
    true, seen = (scene.palm(hands, x)[0] for x in (trials.T_world_hand, T))
    receiver = trials.receiver.clone()
    receiver[:, :4, :3] += (seen - true)[:, None]
    return T, receiver
