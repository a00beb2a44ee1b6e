"""Contact-Handover (Wang et al. 2024): the grasp that leaves the predicted human contact free;
docs/baselines.md.

Grasp: DBSCAN over an object's candidates drops outliers; of the others whose gripper is clear of
the hand on the object, the one that blocks least of the contact map (probabilities of 0.4 and
more). Pose: the object's centre 15 cm above the estimated palm, in the orientation of least collision cost with the
estimated hand; whether the arm reaches it is not asked (`gate`).
"""

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, UInt8
from sklearn.cluster import DBSCAN
from torch import Tensor

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.methods import blocked as blocked_kernels
from r2h_batch.methods.batches import answers, part_of
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.from_table import chosen_candidate
from r2h_batch.methods.gate import Gate
from r2h_batch.methods.least_cost_pose import (
    DIRECTIONS,
    HAND_POINTS,
    ROLLS,
    ZONE_M,
    least_cost_pose,
)
from r2h_batch.methods.placing import (
    HEIGHT_M,
    Anchor,
    candidates_clear_of,
    check_choice,
)
from r2h_batch.methods.predictors import (
    ContactPredictor,
    Contacts,
    Observations,
    PredictorNoise,
    predict_contacts,
    predict_receiving,
    predict_target,
)
from r2h_batch.scene.grasp_tables import gripper_tables
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Contact-Handover", "VoxNet, built-in contacts"
STAND_INS = {"contacts=other-categories": "trees, built-in contacts"}
"""Option -> what stands in with it, in tables."""

THRESHOLD = 0.4
"""Contact probability from which a point counts (published)."""

BLOCKED_M = 0.02
"""A contact point this near to the gripper is blocked: a fingertip is 14-20 mm thick and cannot get
between."""

EPS_M = 0.022
"""DBSCAN: grasp points nearer than the pads' width of 22 mm are neighbours: pads there overlap, it
is one place."""

MIN_SAMPLES = 3
"""DBSCAN: a grasp with fewer neighbours (itself counted) may be an outlier: two alike can be
chance, three are a place."""

CLEARANCE_M = 0.0
"""Distance that gripper and hand must keep: the paper filters collisions and asks for no
clearance."""


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    predictor: ContactPredictor | None = None,
    threshold: float = THRESHOLD,
    height_m: float = HEIGHT_M,
    blocked_m: float = BLOCKED_M,
    eps_m: float = EPS_M,
    min_samples: int = MIN_SAMPLES,
    clearance_m: float = CLEARANCE_M,
    directions: int = DIRECTIONS,
    rolls: int = ROLLS,
    zone_m: float = ZONE_M,
    hand_points: int = HAND_POINTS,
    gate: Gate = "none",
    at: Anchor = "object",
    contacts: Contacts = "left-out",
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
        predictor: what gives the contact map (`predictors.load_predictor`); None: the built-in
            VoxNet.
        threshold: probability from which a point counts as touched.
        height_m: how far what `at` names stands above the palm.
        blocked_m: contact points nearer than this to the gripper are blocked by it.
        eps_m: DBSCAN: grasps nearer than this are neighbours.
        min_samples: DBSCAN: neighbours that a grasp needs to be no outlier, itself counted.
        clearance_m: what gripper and receiving hand must keep.
        directions: approach directions that are tried.
        rolls: turns about each direction that are tried.
        zone_m: points of the target hand nearer than this to gripper or object cost.
        hand_points: points of the hand that the cost counts.
        gate: what an orientation must pass (`gate.Gate`).
        at: what stands above the palm.
        contacts: which built-in weights answer (`predictors.Contacts`).

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.
    """
    check_choice("contacts", contacts, Contacts)
    table = candidate_table(scene)
    clustered = in_clusters(scene, eps_m, min_samples)
    near = points_near_gripper(scene, blocked_m)

    def choose(part: Trials, rows_of: slice) -> tuple[Tensor, Tensor]:
        taking = predict_receiving(part, scene, seed=seed, noise=noise, seen=seen)
        target = predict_target(part, scene, seed=seed, noise=noise, seen=seen)
        contact = predict_contacts(part, scene, predictor=predictor, seen=seen, contacts=contacts)
        rows, exists = table.rows(part.object_index)
        clear = candidates_clear_of(scene, table, part.object_index, taking.vertices, clearance_m)
        blocked = blocked_contact(
            near, contact, table.first[part.object_index.long()], table.count[part.object_index.long()], table.most,
            threshold=threshold
        )  # fmt: skip
        T_obj_ee, opening = chosen_candidate(
            scene,
            part,
            part_of(T_world_obj, rows_of),
            clustered_else_clear(clear, clustered[rows], exists),
            blocked,
            -table.score[rows],
        )
        T_world_ee = least_cost_pose(
            scene, part.object_index, T_obj_ee, opening, target, height_m,
            directions=directions, rolls=rolls, zone_m=zone_m, hand_points=hand_points, gate=gate,
            clearance_m=clearance_m, at=at
        )  # fmt: skip
        return T_obj_ee, T_world_ee

    return answers(trials, scene, "contact", choose)


def clustered_else_clear(
    clear: Bool[Tensor, "b k"], clustered: Bool[Tensor, "b k"], exists: Bool[Tensor, "b k"]
) -> Bool[Tensor, "b k"]:
    """The clear, clustered candidates of each row. Where none is both: the clear ones, where none is clear: all."""
    pool = torch.where((clear & clustered).any(1, keepdim=True), clear & clustered, clear)
    return torch.where(pool.any(1, keepdim=True), pool, exists) & exists


@KeptWith
def in_clusters(scene: Scene, eps_m: float, min_samples: int) -> Bool[Tensor, " m"]:
    """For every row of the candidate table: whether DBSCAN over its object's grasp points puts it
    in a cluster."""
    table = candidate_table(scene)
    kept = np.zeros(len(table.T_obj_ee), bool)
    points = table.T_obj_ee[:, :3, 3].cpu().numpy().astype(np.float64)
    for first, count in zip(table.first.tolist(), table.count.tolist(), strict=True):
        if not count:
            continue
        rows = slice(first, first + count)
        kept[rows] = DBSCAN(eps=eps_m, min_samples=min_samples).fit(points[rows]).labels_ >= 0
    return torch.from_numpy(kept).to(scene.device)


@KeptWith
def points_near_gripper(scene: Scene, radius_m: float) -> UInt8[Tensor, "m p"]:
    """Which points of its object's cloud each candidate's closed gripper is nearer to than
    `radius_m`."""
    table = candidate_table(scene)
    points = torch.from_numpy(np.stack([o.points for o in scene.objects])).to(scene.device)
    shape = (len(table.T_obj_ee), points.shape[1])
    near = torch.zeros(shape, dtype=torch.uint8, device=scene.device)
    launch_trials(
        blocked_kernels.points_near_gripper,
        len(near),
        inputs={
            "gripper": gripper_tables(scene.robot, scene.device),
            "radius": radius_m,
            "points": points,
            "object": table.object_index,
            "T_obj_ee": table.T_obj_ee,
            "opening": table.opening_m,
        },
        outputs={"near": near},
        device=scene.device,
        chunk=16,
        width=near.shape[1],
    )
    return near


def blocked_contact(
    near: UInt8[Tensor, "m p"],
    contact: Float32[Tensor, "b p"],
    first: Int32[Tensor, " b"],
    count: Int32[Tensor, " b"],
    width: int,
    *,
    threshold: float,
) -> Float32[Tensor, "b k"]:
    """Sum of the contact probabilities (those of `threshold` and more) that candidate k of each
    trial blocks."""
    device = str(near.device)
    out = torch.zeros((len(contact), width), dtype=torch.float32, device=near.device)
    launch_trials(
        blocked_kernels.blocked_contact,
        len(out),
        inputs={
            "threshold": threshold,
            "near": near,
            "row": first.to(torch.int32).contiguous(),
            "count": count.to(torch.int32).contiguous(),
            "contact": contact.float().contiguous(),
        },
        outputs={"blocked": out},
        device=device,
        chunk=8,
        width=width,
    )
    return out
