"""Grasps of one object: proposed at antipodal points of its surface, tried on the gripper, scored,
chosen; a user's own, seated.

Score in [0, 1] = 0.4 alignment + 0.35 contact + 0.25 balance:
  alignment  mean cosine between closing axis and touched surface, 0 at the friction cone's edge, 1
  when square
  contact    share of the pad with surface within 1.5 mm, of the lesser pad; half a pad or more
  counts 1
  balance    1 at the centre of mass, 0 at the object's farthest point from it
"""

import hashlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float64
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from r2h_batch.base.errors import UserError
from r2h_batch.base.launch import init_warp, launch_trials
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.config import Thresholds
from r2h_batch.data.grasp_files import TURNED
from r2h_batch.judge.grasp import (
    attach,
    close_pads,
    closed_clearance,
    open_is_clear,
    region_distance,
)
from r2h_batch.kernels.methods import antipodal
from r2h_batch.methods.box_grasps import three_boxes
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.grasp_tables import GraspTables, grasp_tables
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, drive_from_gap, pad_center_z
from r2h_batch.scene.robot_file import load_robot

OWN_GRIPPER, OWN_ROBOT = "2f-85", "ur5e_2f85"
"""The gripper that stored candidates are for, and a robot that carries it."""


def carrier(robot: Robot | None) -> Robot:
    """The robot whose gripper candidates are for: all with the 2F-85 (None) are as good as one."""
    return load_robot(OWN_ROBOT) if robot is None or robot.linkage.table is None else robot


def widest_m(robot: Robot) -> float:
    """Largest width of a candidate: it leaves the open pads 1.5 mm on each side."""
    return round(robot.open_gap_m - 0.003, 9)


F32 = NDArray[np.float32]


class NoGraspError(UserError):
    """An object that the gripper cannot hold anywhere, as far as was found."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """K grasps, best score first: T_obj_ee (K, 4, 4), width (K,) m, score (K,), part (K,) index
    into `part_names`.

    `region_m`: distance of the closed fingers to the receiver's region, NaN without one.
    """

    T_obj_ee: F32
    width: F32
    score: F32
    part: NDArray[np.uint8]
    region_m: F32

    def rows(self, rows: Any) -> "Candidates":
        """The selected grasps."""
        return Candidates(**{k: v[rows] for k, v in vars(self).items()})

    def __len__(self) -> int:
        return len(self.width)


def joined(parts: Sequence[Candidates]) -> Candidates:
    """All grasps of several sets, in their order."""
    columns = zip(*(vars(c).values() for c in parts), strict=True)
    return Candidates(*map(np.concatenate, columns))


FRICTION = 0.5
SEEDS, APPROACHES = 3000, 6
DEPTH_M = 0.012  # how far the contact may lie from the pads' centre along the approach


def proposals(
    model: ObjectModel, mesh: wp.Mesh, rng: np.random.Generator, robot: Robot
) -> tuple[F32, F32]:
    """(M, 4, 4) T_obj_ee, pads on opposite surface points, several approaches about each closing
    axis; (M,) how far these points are from each other."""
    corner = model.vertices[model.faces].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    share = np.cumsum(double_area) / double_area.sum()
    face = np.searchsorted(share, (np.arange(SEEDS) + rng.random(SEEDS)) / SEEDS)
    face = np.minimum(face, len(share) - 1)
    a, b = rng.random((2, SEEDS, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    point = (
        corner[face, 0]
        + a * (corner[face, 1] - corner[face, 0])
        + b * (corner[face, 2] - corner[face, 0])
    )
    tilt = rng.random((SEEDS, 3))
    center, axis = np.zeros((2, SEEDS, 3), np.float32)
    thickness = np.zeros(SEEDS, np.float32)
    launch_trials(
        antipodal.opposite_points,
        SEEDS,
        inputs={
            "mesh": mesh.id,
            "friction_cosine": 1 / np.hypot(1, FRICTION),
            "widest": widest_m(robot),
            "point": point.astype(np.float32),
            "normal": (normal[face] / np.maximum(double_area[face, None], 1e-30)).astype(
                np.float32
            ),
            "random": tilt.astype(np.float32),
        },
        outputs={"center": center, "axis": axis, "thickness": thickness},
        device="cpu",
    )
    angle = 2 * np.pi * (np.arange(APPROACHES) + rng.random((SEEDS, 1))) / APPROACHES
    sign = np.where(rng.random((SEEDS, APPROACHES)) < 0.5, -1.0, 1.0)
    depth = DEPTH_M * (2 * rng.random((SEEDS, APPROACHES)) - 1)
    keep = thickness > 0
    center64, axis64 = center[keep].astype(np.float64), axis[keep].astype(np.float64)
    aside = np.where(np.abs(axis64[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    e = np.cross(axis64, aside)
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    f = np.cross(axis64, e)
    z = np.cos(angle[keep])[..., None] * e[:, None] + np.sin(angle[keep])[..., None] * f[:, None]
    y = sign[keep][..., None] * axis64[:, None]
    T = np.zeros((*z.shape[:2], 4, 4))
    T[..., :3, 0], T[..., :3, 1], T[..., :3, 2], T[..., 3, 3] = np.cross(y, z), y, z, 1
    height = pad_height(robot, thickness[keep].astype(np.float64))[:, None] + depth[keep]
    T[..., :3, 3] = center64[:, None] - height[..., None] * z
    return T.reshape(-1, 4, 4).astype(np.float32), np.repeat(thickness[keep], APPROACHES)


def pad_height(robot: Robot, gap: NDArray[Any]) -> NDArray[np.float64]:
    """Height of the pads' centres in the ee frame at a gap."""
    z, middle = (pad_center_z(robot, drive_from_gap(robot, g)) for g in (gap, robot.open_gap_m / 2))
    return z - middle


CLEARANCE_M = 0.001
CENTERED_M = 0.0005
CUTOFF_M = 0.0015
LEAST_CONTACT = 0.05
HOPELESS = 0.15
"""Below the friction cone's edge (cosine) after the first closing: the others move the pads along
the closing axis only."""
BEHIND_PADS_M = -0.001  # the closed gripper's shapes overshoot the real one by about this much


def graded(
    model: ObjectModel, tables: GraspTables, mesh: wp.Mesh, proposals: F32, robot: Robot
) -> tuple[Candidates, NDArray[np.int64]]:
    """The proposals that keep every promise of `sample_grasps`, with their scores, and which of the
    proposals they are."""
    T = torch.from_numpy(proposals)
    row = torch.nonzero(_clear(tables, T))[:, 0]
    T = T[row].contiguous()
    edge, widest = 1 / np.hypot(1, FRICTION), widest_m(robot)
    pads = _Pads(tables, len(proposals))
    for turn in range(3):  # the pads centre the object; what then lies between them may differ
        width, opening, shift, empty = pads.close(T, row)
        held = ~empty & (width <= widest)
        T, row = attach(T[held], shift[held]).contiguous(), row[held]
        if turn == 0:  # for most there is no hope: they hold by an edge, or at a slant
            share, cosine, _ = pad_contact(
                model, mesh, T.numpy(), width[held].numpy(), opening[held].numpy(), robot
            )
            hopeful = torch.from_numpy((share > 0) & (cosine >= edge - HOPELESS))
            T, row = T[hopeful].contiguous(), row[hopeful]
    clear = _clear(tables, T)
    T, row = T[clear].contiguous(), row[clear]
    width, opening, shift, empty = pads.close(T, row)
    held = ~empty & (width <= widest) & (shift.abs() <= CENTERED_M)
    behind, _ = closed_clearance(tables, T, zeros(T), opening, cap_m=CLEARANCE_M)
    held &= behind >= BEHIND_PADS_M
    T, width, opening, shift, row = (x[held].contiguous() for x in (T, width, opening, shift, row))
    squeezed = (width - Thresholds().pad_squeeze_m).clamp(min=0)
    region = region_distance(tables, attach(T, shift), zeros(T), squeezed)[0].numpy()
    stands = T.numpy(), width.numpy(), opening.numpy()
    contact, alignment, part = pad_contact(model, mesh, *stands, robot)
    score, square = scored(model, T.numpy(), opening.numpy(), contact, alignment, robot)
    every = Candidates(T.numpy(), width.numpy(), score, part.astype(np.uint8), region)
    good = square & (contact >= LEAST_CONTACT)
    return every.rows(good), row.numpy()[good]


class _Pads:
    """`close_pads` of proposals by their number: those that stand as they did when it was asked
    before are not asked again."""

    def __init__(self, tables: GraspTables, count: int) -> None:
        self.tables = tables
        self.T = torch.full((count, 4, 4), torch.nan, dtype=torch.float32, device="cpu")
        self.found = [torch.empty(count, dtype=torch.float32, device="cpu") for _ in range(3)]
        self.empty = torch.empty(count, dtype=torch.bool, device="cpu")

    def close(self, T: torch.Tensor, row: torch.Tensor) -> list[torch.Tensor]:
        """Width, opening, shift, emptiness of proposals `row`, which stand at `T` now."""
        moved = (self.T[row] != T).flatten(1).any(1)
        poses, number = T[moved].contiguous(), row[moved]
        every = [*self.found, self.empty]
        for known, new in zip(every, close_pads(self.tables, poses, zeros(poses)), strict=True):
            known[number] = new
        self.T[number] = poses
        return [known[row] for known in every]


def scored(
    model: ObjectModel,
    T: F32,
    opening: F32,
    contact: NDArray[np.float64],
    alignment: NDArray[np.float64],
    robot: Robot,
) -> tuple[F32, NDArray[np.bool_]]:
    """Scores (as the head of this file says), and whether the touched surface is within the friction
    cone."""
    edge = 1 / np.hypot(1, FRICTION)
    pads = T[:, :3, 3] + pad_height(robot, opening)[:, None] * T[:, :3, 2]
    farthest = np.linalg.norm(model.vertices - model.com, axis=1).max()
    balance = 1 - np.clip(np.linalg.norm(pads - model.com, axis=1) / farthest, 0, 1)
    score = 0.4 * (alignment - edge) / (1 - edge) + 0.35 * np.minimum(contact / 0.5, 1)
    score = score + 0.25 * balance
    return score.astype(np.float32), alignment >= edge


def pad_contact(
    model: ObjectModel, mesh: wp.Mesh, T: F32, width: F32, opening: F32, robot: Robot
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Result of `antipodal.pad_contact`: share of the lesser pad, mean cosine, part."""
    link = robot.linkage
    share, cosine = np.zeros((2, len(T)), np.float32)
    part = np.zeros(len(T), np.int32)
    pad_z = pad_height(robot, opening).astype(np.float32)
    launch_trials(
        antipodal.pad_contact,
        len(T),
        inputs={
            "mesh": mesh.id,
            "face_part": wp.array(model.face_part, dtype=wp.uint8, device="cpu"),
            "half_x": link.pad_half_size[0],
            "half_z": link.pad_half_size[2],
            "cutoff": CUTOFF_M,
            "T_obj_ee": T,
            "pad_z": pad_z,
            "width": width,
        },
        outputs={"contact": share, "alignment": cosine, "part": part},
        device="cpu",
    )
    return share.astype(np.float64), cosine.astype(np.float64), part


def _clear(tables: GraspTables, T: torch.Tensor) -> torch.Tensor:
    """Whether the open gripper keeps its clearance to the object."""
    return open_is_clear(tables, T, zeros(T), clearance_m=CLEARANCE_M)


def device_mesh(model: ObjectModel) -> wp.Mesh:
    return wp.Mesh(
        wp.array(model.vertices, dtype=wp.vec3, device="cpu"),
        wp.array(model.faces.reshape(-1), dtype=wp.int32, device="cpu"),
    )


def zeros(T: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(T), dtype=torch.int32, device="cpu")


REGION_SHARE = 0.4
"""Share of an S1 object's candidates that keep the fingers off the receiver's region, where so many
exist."""
REGION_CLEARANCE_M = 0.001
POOREST = 0.1  # share of the pool that is left out where it is large enough
TURN_RAD = 0.9


def diverse(model: ObjectModel, every: Candidates, count: int, robot: Robot) -> Candidates:
    """Greedy by score without the pool's poorest, none too like one already taken; that bar falls
    until `count` are found."""
    order = np.argsort(-every.score, kind="stable")
    every = every.rows(order)
    y, z = every.T_obj_ee[:, :3, 1].astype(np.float64), every.T_obj_ee[:, :3, 2].astype(np.float64)
    place = every.T_obj_ee[:, :3, 3] + pad_height(robot, every.width)[:, None] * z
    taken: list[int] = []
    off_region = every.region_m > REGION_CLEARANCE_M
    stages = [(np.ones(len(every), bool), min(count, len(every)))]
    if model.split != "S0":
        stages.insert(0, (off_region, min(int(REGION_SHARE * count), int(off_region.sum()))))
    for allowed, wanted in stages:
        poorest = np.quantile(every.score[allowed], POOREST) if allowed.any() else 0.0
        better = allowed & (every.score >= poorest)
        if better.sum() > 2 * wanted:
            allowed = better
        radius = float(np.linalg.norm(np.ptp(model.vertices, axis=0))) / 4
        while len(taken) < wanted:
            free = allowed.copy()
            free[taken] = False
            for i in taken:
                free &= _likeness(place, y, z, i, radius) >= 1
            for i in range(len(every)):
                if len(taken) < wanted and free[i]:
                    taken.append(i)
                    free &= _likeness(place, y, z, i, radius) >= 1
            radius *= 0.75
    return every.rows(np.sort(taken))


def _likeness(
    place: NDArray[Any], y: NDArray[Any], z: NDArray[Any], i: int, radius: float
) -> NDArray[Any]:
    """Distance of all candidates to candidate i: below 1 they are too like. Both turn by 180
    degrees about z alike."""
    turn_z = np.arccos(np.clip(z @ z[i], -1, 1))
    turn_y = np.arccos(np.clip(np.abs(y @ y[i]), 0, 1))
    turn = np.maximum(turn_y, turn_z)
    scale = TURN_RAD * min(1.0, radius / 0.02)
    out = np.linalg.norm(place - place[i], axis=1) / radius + turn / scale
    out[i] = 0
    return np.asarray(out)


COUNT = 100
ROUNDS = 8
ENOUGH = 1200
GENERATED_CONTACT = 0.1
ALONG = 0.5
"""Cosine of 60 degrees."""


def sample_grasps(
    model: ObjectModel,
    robot: Robot | None = None,
    *,
    count: int = COUNT,
    enough: int = ENOUGH,
    along: Float64[np.ndarray, "3"] | None = None,
) -> Candidates:
    """Up to `count` grasps of an object: the same object and name, the same grasps. Raises if it
    has none.

    They are for the robot's gripper, None: for the 2F-85.

    They are chosen of the first `enough` that are found (a round more or less), or of what 8 rounds
    find.

    Each closes on 3 mm less than the open gap within the friction cone, is centred between the pads to 0.5 mm,
    keeps the open gripper 1 mm off the object, and closed touches it with the pads (1 mm for the
    shapes' overshoot). At least 40 % of an S1 object's keep 1 mm from the receiver's region, if
    that many were found.

    `along` (frame obj): only grasps that approach within 60 degrees of this direction, a unit vector.
    """
    robot = carrier(robot)
    tables = grasp_tables([model], robot)
    mesh = device_mesh(model)

    def found_of(rng: np.random.Generator) -> Candidates:
        proposed = proposals(model, mesh, rng, robot)[0]
        if along is not None:
            proposed = proposed[(proposed[:, :3, 2] * along).sum(1) >= ALONG]
        return graded(model, tables, mesh, proposed, robot)[0]

    def suffices(pool: Candidates) -> bool:
        off_region = int((pool.region_m > REGION_CLEARANCE_M).sum())
        some = model.split == "S0" or off_region >= enough // 4
        return len(pool) >= enough and (some or len(pool) >= 3 * enough)

    # proposals of their own: the object's candidates may be known already
    stream = model.name if along is None else f"{model.name} along"
    every = _pool(stream, found_of, suffices)
    if len(every) == 0:
        stroke = f"{1e3 * robot.open_gap_m:.0f} mm"
        raise NoGraspError(
            f"{model.name}: no grasp found; the gripper needs a part narrower than {stroke} that it can reach"
        )
    chosen = diverse(model, every, count, robot)
    free = int((chosen.region_m > REGION_CLEARANCE_M).sum())
    if model.split != "S0" and free < 0.25 * len(chosen):
        warnings.warn(
            f"{model.name}: {free} of {len(chosen)} grasps keep {1e3 * REGION_CLEARANCE_M:.0f} mm from the receiver's region; "
            "is the region too large, or the rest of the object too wide for the gripper?",
            stacklevel=2,
        )
    return chosen


def generate_grasps(model: ObjectModel, robot: Robot | None = None) -> Candidates:
    """Up to `COUNT` grasps as a generator proposes them, not tried on this evaluator's gripper;
    reproducible. Raises if none.

    Antipodal pairs within the friction cone and 3 mm less than the open gap apart, with a tenth of each pad on the
    surface there; the open gripper, as three boxes, holds no point of the object's cloud outside
    the gap (as ten Pas et al. 2017 ask of a hand). `width` is the pair's distance: what else lies
    between the pads, whether they close on it centred, and what the true gripper cuts into is not
    asked. `region_m`: 1 where no cloud point of the receiver's region is touched by the pads, else
    -1.
    """
    init_warp()
    robot = carrier(robot)
    mesh = device_mesh(model)

    def found_of(rng: np.random.Generator) -> Candidates:
        T, width = proposals(model, mesh, rng, robot)
        contact, alignment, part = pad_contact(model, mesh, T, width, width, robot)
        score, square = scored(model, T, width, contact, alignment, robot)
        rows = np.flatnonzero(square & (contact >= GENERATED_CONTACT))
        rows = rows[_boxes_clear(model, T[rows], robot)]
        region = np.where(_on_region(model, T[rows], width[rows], robot), -1.0, 1.0)
        columns = T[rows], width[rows], score[rows], part[rows].astype(np.uint8)
        return Candidates(*columns, region.astype(np.float32))

    every = _pool(model.name, found_of, lambda pool: len(pool) >= ENOUGH)
    if len(every) == 0:
        raise NoGraspError(
            f"{model.name}: the gripper of {robot.name} fits about no antipodal pair"
        )
    return diverse(model, every, COUNT, robot)


def _pool(
    stream: str,
    found_of: Callable[[np.random.Generator], Candidates],
    suffices: Callable[[Candidates], bool],
) -> Candidates:
    """Grasps from rounds of proposals until they suffice; `stream` (the object's name) and the round's
    number seed each round."""
    key = int.from_bytes(hashlib.sha256(stream.encode()).digest()[:8], "little")
    rounds: list[Candidates] = []
    with threadpool_limits(1, user_api="blas"), one_torch_thread("cpu"):
        for turn in range(ROUNDS):
            rng = np.random.Generator(np.random.Philox(key=np.array([key, turn], np.uint64)))
            rounds.append(found_of(rng))
            if suffices(joined(rounds)):
                break
    return joined(rounds)


def _boxes_clear(model: ObjectModel, T: F32, robot: Robot) -> NDArray[np.bool_]:
    """Whether no point of the object's cloud lies in the open gripper as three boxes: two fingers,
    and the rest."""
    corners = (x.astype(np.float32) for x in three_boxes(robot))
    finger_low, finger_high, rest_low, rest_high = corners
    clear = np.ones(len(T), bool)
    for first in range(0, len(T), 256):
        x, y, z = _in_gripper(model, T[first : first + 256])
        on_finger, in_rest = np.ones((2, *x.shape), bool)
        for axis, (mirrored, value) in enumerate(((x, x), (np.abs(y), y), (z, z))):
            on_finger &= (mirrored > finger_low[axis]) & (mirrored < finger_high[axis])
            in_rest &= (value > rest_low[axis]) & (value < rest_high[axis])
        clear[first : first + 256] = ~(on_finger | in_rest).any(1)
    return clear


def _on_region(model: ObjectModel, T: F32, width: F32, robot: Robot) -> NDArray[np.bool_]:
    """Whether pads `width` apart touch a cloud point of the receiver's region."""
    link = robot.linkage
    pad_z = pad_height(robot, width).astype(np.float32)
    region = model.receiver_face[model.point_face]
    touches = np.zeros(len(T), bool)
    for first in range(0, len(T), 256):
        rows = slice(first, first + 256)
        x, y, z = _in_gripper(model, T[rows])
        near = np.abs(x) <= link.pad_half_size[0]
        near &= np.abs(z - pad_z[rows, None]) <= link.pad_half_size[2]
        near &= np.abs(np.abs(y) - 0.5 * width[rows, None]) <= CUTOFF_M
        touches[rows] = (near & region).any(1)
    return touches


def _in_gripper(model: ObjectModel, T: F32) -> tuple[F32, F32, F32]:
    """Coordinates (n, P) of the object's cloud in the ee frames of n grasps."""
    p = model.points[None].astype(np.float32) - T[:, None, :3, 3]
    axes = [
        p[..., 0] * T[:, 0, k, None] + p[..., 1] * T[:, 1, k, None] + p[..., 2] * T[:, 2, k, None]
        for k in range(3)
    ]
    return axes[0], axes[1], axes[2]


SEATS_M = (0.0, 0.004, -0.004, 0.008, -0.008, 0.012, -0.012, 0.016, -0.016, 0.02, -0.02)


def own_grasps(model: ObjectModel, grasps: GraspSet, robot: Robot) -> Candidates:
    """The user's grasps as they are, best score first, without any check. `width`: of what
    lies between the pads."""
    init_warp()
    order = np.argsort(-grasps.score, kind="stable")
    T = np.ascontiguousarray(grasps.T_obj_ee[order])
    poses = torch.from_numpy(T)
    width = close_pads(grasp_tables([model], robot), poses, zeros(poses))[0].numpy()
    part = np.maximum(grasps.part[order], 0).astype(np.uint8)
    return Candidates(T, width, grasps.score[order], part, np.full(len(T), np.nan, np.float32))


FEW, TRIED = 0.5, 256
"""Share of seated grasps below which `TRIED` of them are tried with their closing axis turned."""


def _named_wrongly(
    model: ObjectModel,
    tables: GraspTables,
    mesh: wp.Mesh,
    grasps: GraspSet,
    seated: list[int],
    robot: Robot,
) -> str:
    """A question, if far more grasps hold with the fingers turned by 90 degrees about the approach; else ""."""
    rows = np.linspace(0, len(grasps) - 1, min(len(grasps), TRIED)).astype(np.int64)
    T = grasps.T_obj_ee[rows].copy()
    T[:, :3, :2] = np.stack([T[:, :3, 1], -T[:, :3, 0]], 2)
    _, held = graded(model, tables, mesh, T, robot)
    before = int(np.isin(rows, seated).sum())
    if len(held) < max(2 * before, 0.1 * len(rows)):
        return ""
    name = TURNED.get(grasps.gripper)
    other = f"is GRIPPER {name}?" if name else "is their GRIPPER right?"
    return f"; turned by 90 degrees {len(held)} of {len(rows)} hold, as they are {before}: {other}"


def seat_grasps(model: ObjectModel, grasps: GraspSet, robot: Robot | None = None) -> Candidates:
    """The user's grasps that keep every promise of `sample_grasps`, best score of the user's first.

    Pads centre the object as in `sample_grasps`. Those of another gripper may be pushed up to 20 mm
    further or less far along the approach, the nearest place first: its fingers have another
    length. `score` is the user's, `part` what the pads touch. How many were seated elsewhere and
    how many dropped is one warning; none left raises.
    """
    init_warp()
    robot = carrier(robot)
    tables, mesh = grasp_tables([model], robot), device_mesh(model)
    own = OWN_GRIPPER if robot == carrier(None) else robot.name.replace("_", "-")
    depths = (0.0,) if grasps.gripper == own else SEATS_M
    seated: dict[int, tuple[Candidates, float]] = {}
    for depth in depths:
        left = np.array([i for i in range(len(grasps)) if i not in seated], np.int64)
        if not len(left):
            break
        T = grasps.T_obj_ee[left].copy()
        T[:, :3, 3] += np.float32(depth) * T[:, :3, 2]
        found, rows = graded(model, tables, mesh, T, robot)
        seated |= {int(left[r]): (found.rows([k]), depth) for k, r in enumerate(rows)}
    asked = ""
    if len(seated) < FEW * len(grasps):
        asked = _named_wrongly(model, tables, mesh, grasps, sorted(seated), robot)
    if not seated:
        raise NoGraspError(
            f"{model.name}: none of {len(grasps)} grasps can be held by the {own}; are they in the object's frame, in"
            f" metres, and named for the right gripper?{asked}"
        )
    moved = sum(depth != 0 for _, depth in seated.values())
    if moved or len(seated) < len(grasps):
        dropped = len(grasps) - len(seated)
        warnings.warn(
            f"{model.name}: of {len(grasps)} grasps of the {grasps.gripper}, {moved} seated elsewhere, {dropped} dropped{asked}",
            stacklevel=2,
        )
    order = sorted(seated, key=lambda i: (-float(grasps.score[i]), i))
    return replace(joined([seated[i][0] for i in order]), score=grasps.score[order])
