"""A stored trial in the world that its arm was planned in, where that world has no way: the stored margin is about it."""

from dataclasses import replace

from r2h_batch.evaluate import Evaluator
from r2h_batch.observe.believed_world import ROOM_M, believed_world
from r2h_batch.observe.known import known_moments
from r2h_batch.types import Predictions, Trials
from r2h_batch.view.legs import with_legs
from r2h_batch.view.postures import postures_at
from r2h_batch.view.stored_trial import StoredTrial

MOVED = ("ok", "motion_in_collision", "not_settled")
"""Reasons of Plan of an arm that moved: the true world says what came of it."""
NOTE = f"drawn as planning believed it from the images, which keeps {1e3 * ROOM_M:.0f} mm from the person"


def as_believed(
    stored: StoredTrial, evaluator: Evaluator, trial: Trials, answer: Predictions
) -> StoredTrial | None:
    """The trial as planning believed it; None: the arm moved, planning knew the truth, or nothing was seen.

    Args:
        stored: one trial of a benchmark that asks for Pick.
        evaluator: judges the answer.
        trial: the trial.
        answer: its prediction.
    """
    picked = bool(stored.row["passed_pick"])
    if evaluator.plans_in is None or (picked and stored.row["plan_reason"] in MOVED):
        return None
    if not picked:
        made = evaluator.picks(answer.T_obj_ee, answer.T_world_ee, trial)
        if int(made.length[0]):  # picked in the belief
            return None
    scene = evaluator.scene
    world = believed_world(scene, trial, evaluator.plans_in)
    if world is None:
        return None
    T_world_grasp = known_moments(scene).of(trial).double() @ answer.T_obj_ee.double()
    judge = evaluator.in_scene(world.scene)
    known_moments(world.scene).tell(world.trials, world.T_world_obj.float())
    own = replace(answer, T_obj_ee=world.grasps(T_world_grasp))
    receiver = world.trials.receiver
    grasp = own.T_obj_ee[0].double().cpu().numpy()
    believed = replace(
        stored,
        T_obj_ee=grasp,
        T_obj_ee_attached=grasp,
        T_world_hand=world.trials.T_world_hand[0].double().cpu().numpy(),
        object_model=world.scene.objects[int(world.trials.object_index[0])],
        receiver=None if receiver is None else receiver[0].double().cpu().numpy(),
        asked=None if stored.asked is None else postures_at(judge, world.trials, own),
        note=NOTE,
        believed=True,
        room_m=ROOM_M,
    )
    return with_legs(believed, judge, world.trials, own)
