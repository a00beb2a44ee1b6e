"""FC-Handover (Meng et al. 2022): the grasp opposite to the predicted receiving hand, nothing else;
docs/baselines.md.

Grasp: of the candidates whose gripper is clear of the hand on the object, the one whose approach
axis is most opposed to the direction from that hand's wrist to its middle finger tip. Pose: the
gripper opposed to the target hand's direction, the object's centre 15 cm above its palm (the paper
names neither the point nor its distance: `at`, `height_m`).
"""

from jaxtyping import Float, Float32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.methods.batches import answers, part_of
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.from_table import chosen_candidate
from r2h_batch.methods.gate import Gate, first_fit
from r2h_batch.methods.placing import (
    HEIGHT_M,
    Anchor,
    allowed_else_usable,
    approach_frames,
    candidates_clear_of,
    home_x,
    placed_above_palm,
    roll_angles,
    rolled,
    unit,
)
from r2h_batch.methods.predictors import (
    Observations,
    PredictorNoise,
    predict_receiving,
    predict_target,
)
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "FC-Handover", "oracle hand"

ROLLS = 8
"""Turns about the approach axis that are tried: the paper fixes none (baselines.md)."""

CLEARANCE_M = 0.0
"""Distance that gripper and hand must keep: the paper drops candidates "that collide" and asks for
no clearance."""


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    rolls: int = ROLLS,
    clearance_m: float = CLEARANCE_M,
    gate: Gate = "hand",
    height_m: float = HEIGHT_M,
    at: Anchor = "object",
) -> Predictions:
    """One grasp and handover pose a trial.

    Args:
        trials: N trials.
        scene: objects, hands and robot: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: errors of what the method sees; None: `PredictorNoise()`.
        seen: answers of your own networks, in place of the stand-ins.
        T_world_obj: (N, 4, 4) where the objects rest when a trial begins on the table, m; the method then takes the best grasp
            that the arm can pick there. None: a trial begins with the object in the gripper.
        rolls: turns about the approach axis that are tried.
        clearance_m: what gripper and receiving hand must keep.
        gate: what a roll must pass (`gate.Gate`).
        height_m: how far what `at` names stands above the palm.
        at: what stands above the palm.

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.
    """
    table = candidate_table(scene)

    def choose(part: Trials, rows_of: slice) -> tuple[Tensor, Tensor]:
        taking = predict_receiving(part, scene, seed=seed, noise=noise, seen=seen)
        target = predict_target(part, scene, seed=seed, noise=noise, seen=seen)
        rows, exists = table.rows(part.object_index)
        score = opposition(table.T_obj_ee[rows][..., :3, 2], taking.wrist_to_middle)
        clear = candidates_clear_of(scene, table, part.object_index, taking.vertices, clearance_m)
        T_obj_ee, opening = chosen_candidate(
            scene,
            part,
            part_of(T_world_obj, rows_of),
            allowed_else_usable(clear, exists),
            score,
        )
        frames = approach_frames(-target.wrist_to_middle, home_x(scene))
        R = rolled(frames, roll_angles(rolls))
        T_world_ee = placed_above_palm(scene, R, T_obj_ee, part.object_index, target, height_m, at)
        return T_obj_ee, first_fit(
            scene, T_world_ee, opening, target.vertices, clearance_m, gate=gate
        )

    return answers(trials, scene, "fc", choose)


def opposition(z: Float[Tensor, "b k 3"], direction: Float[Tensor, "b 3"]) -> Float[Tensor, "b k"]:
    """cos(v_g, v_h): -1 where approach axis z and the hand's direction are opposed."""
    return se3.dot(unit(z.double()), unit(direction.double())[:, None])
