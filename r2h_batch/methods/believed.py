"""The world as a method that sees believes it: built-in methods answer in it, and are told nothing else.

An object is the solid that the images show (`observe.solid`), or the known mesh where it is believed to lie. It has no name, and
no parts but the receiver's region, where that is told: the faces nearest to seen points of it. Grasp candidates and the hand that
takes it are sampled on that solid. The target hand is a hand of the benchmark in a middle posture, where `Observation.receiver`
says. The person has no arm and no torso.
"""

import hashlib
import inspect
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import OBJECT_ERRORS, EvalConfig, ObjectErrors
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods.grasps import NoGraspError, sample_grasps
from r2h_batch.methods.predictors import Observations, PredictorNoise
from r2h_batch.methods.predictors.external_predictions import ExternalHands, ExternalPoints
from r2h_batch.methods.predictors.grid import contact_grids, voxel_of_points
from r2h_batch.methods.predictors.principal_axes import load_axes_network
from r2h_batch.methods.robust import Sizes
from r2h_batch.observe.believed_object import KEPT_SOLIDS, believed_object
from r2h_batch.observe.believed_world import ROOM_M
from r2h_batch.observe.seeing import Level
from r2h_batch.observe.seen import Observation, Receiver
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.hand import HandGeometry, HandModel, HandSet, palm_frame
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.holding.sampler import NoHoldError, sample_receiving
from r2h_batch.trials.noise import perturbed
from r2h_batch.types import Predictions, Trials

GRASPS_ENOUGH = 240
"""Grasps that an object's candidates are chosen from; as for a user's mesh."""
HOLDS, HOLDS_ENOUGH = 4, 32
"""Receiving hands of an object, one of which is drawn, and the number that they are chosen from [choice]."""
SOLID_M, SOLID_DEG = (0.002, 0.002), (1.0, 1.0)
"""Errors of a completed solid, per axis, without noise, and more for each time the noise [choice]: its surface is off by
2 mm with exact images, by 4 mm with errors."""
_GRASP, _RECEIVING = 0, 1  # purposes of the random counters

CONTACTS: OrderedDict[str, NDArray[np.float32]] = OrderedDict()
"""Digest of a solid's surface -> where the contact network expects people's hands on it."""

Method = Callable[..., Predictions]


@dataclass(frozen=True)
class Believed:
    """M of N seen trials: those in which there is something to take hold of.

    Attributes:
        row: which of the N.
        scene: the believed objects, two hands, the robot.
        trials: in that scene; ids are the images' keys.
        T_world_obj: where the believed objects lie, m.
        receiving: the receiver's hands on them.
    """

    row: Int64[Tensor, " m"]
    scene: Scene
    trials: Trials
    T_world_obj: Float64[Tensor, "m 4 4"]
    receiving: Observations


class AskedHere:
    """A built-in method, asked about what cameras saw in this process.

    Args:
        function: its `predict`.
        shown: fields of `Observations` that it is shown.
        options: its keyword arguments.
        benchmark: whose robot, workplace, limits and hands are known; its objects are not looked at.
        config: how one judges.
        noise: factor on errors, as of `observe`.
        model: what is known of the objects, as of `observe`.
        threads: as of `Evaluator`.
    """

    def __init__(
        self,
        function: Method,
        shown: Sequence[str],
        options: Mapping[str, Any],
        benchmark: Benchmark,
        config: EvalConfig,
        *,
        noise: float,
        model: Level | None = None,
        threads: int | None = None,
    ) -> None:
        self._function, self._options = function, dict(options)
        self._takes = inspect.signature(function).parameters
        self._holds = "receiving" in shown
        self._known, self._threads = known_before(benchmark), threads
        self._config = replace(config, receiver="hand")
        self._sizes = error_sizes(noise, model)
        self._noise = noise_left(noise)

    def ask(
        self, seen: Observation
    ) -> tuple[Float64[Tensor, "n 4 4"], Float64[Tensor, "n 4 4"], Float32[Tensor, " n"]]:
        """T_world_grasp, T_world_ee (m) and the method's seconds a trial, on the CPU.

        Where nothing is to be taken hold of, the gripper comes straight down on the middle of what was seen.

        Args:
            seen: of N trials.
        """
        start = time.perf_counter()
        grasp, handover = straight_down(seen)
        with on_threads(self._threads):
            world = believed(
                seen, *self._known, self._config, self._noise, holds=self._holds, seed=self._seed
            )
            if world is not None:
                answer = self._function(world.trials, world.scene, **self._arguments(world))
        if world is not None:
            T_world_grasp = se3.matmul(world.T_world_obj, answer.T_obj_ee.double())
            grasp[world.row], handover[world.row] = T_world_grasp, answer.T_world_ee.double()
        seconds = (time.perf_counter() - start) / max(len(seen), 1)
        return grasp, handover, torch.full((len(seen),), seconds, dtype=torch.float32, device="cpu")

    @property
    def _seed(self) -> int:
        return int(self._options.get("seed", 0))

    def _arguments(self, world: Believed) -> dict[str, Any]:
        found = dict(self._options)
        if "noise" in self._takes:
            found["noise"] = self._noise
        seen = world.receiving
        if "predictor" in self._takes:
            on = np.stack([contacts_on(model) for model in world.scene.objects])
            seen = replace(seen, contacts=ExternalPoints("seen solid", None, {"probability": on}))
        if "seen" in self._takes:
            found["seen"] = seen
        if "T_world_obj" in self._takes and "pick" in world.scene.benchmark.asks:
            found["T_world_obj"] = world.T_world_obj.float()
        if "sizes" in self._takes:
            found["sizes"] = self._sizes
        if "evaluator" in self._takes:
            judge = Evaluator(
                world.scene.benchmark, world.scene.config, device="cpu", threads=self._threads
            )
            found["evaluator"] = judge.in_scene(world.scene)
        return found


def noise_left(noise: float) -> PredictorNoise:
    """Errors of what methods see, less those of the target hand and of borders: `Observation.receiver` and `.region` have them
    already.

    Args:
        noise: factor on errors, as of `observe`.
    """
    scaled = PredictorNoise().scaled(noise)
    return replace(scaled, target_rotation_deg=0.0, target_translation_m=0.0, border_m=0.0)


def error_sizes(noise: float, model: Level | None) -> Sizes:
    """Errors that a search in a believed world reckons with: of the estimates, as large as they are; of a completed solid, as
    of an object whose pose is off by `SOLID_M` and `SOLID_DEG`.

    Args:
        noise: factor on errors, as of `observe`.
        model: what is known of the objects, as of `observe`.
    """
    if model is None:
        shift, turn = ((low + noise * more) for low, more in (SOLID_M, SOLID_DEG))
    else:
        shift, turn = (noise * x for x in OBJECT_ERRORS[model])
    return Sizes(ObjectErrors(shift, turn), PredictorNoise().scaled(noise))


def contacts_of_any(grid: Float32[Tensor, "1 5 64 64 64"]) -> Float32[Tensor, "1 64 64 64"]:
    """The built-in contact network that no frame decides, without its answers on disk: no two seen solids are equal.

    Args:
        grid: of `predictors.grid`.
    """
    found: Tensor = load_axes_network()(grid)
    return found


def contacts_on(model: ObjectModel) -> Float32[np.ndarray, " p"]:
    """Probability of each point of an object's cloud that a hand is there, as the built-in network says. A surface that
    has come before is not asked again.

    Args:
        model: a believed object.
    """
    surface = model.voxels, model.voxel_origin, np.float64(model.voxel_pitch), model.points
    digest = hashlib.sha256(
        b"".join(np.ascontiguousarray(x).tobytes() for x in surface)
    ).hexdigest()
    if digest not in CONTACTS:
        i, j, k = voxel_of_points(model).T
        with torch.no_grad():
            CONTACTS[digest] = contacts_of_any(contact_grids([model]))[0, i, j, k].numpy()
        while len(CONTACTS) > KEPT_SOLIDS:
            CONTACTS.popitem(last=False)
    return CONTACTS[digest]


def believed(
    seen: Observation,
    benchmark: Benchmark,
    hands: HandSet,
    config: EvalConfig,
    noise: PredictorNoise,
    *,
    holds: bool,
    seed: int,
) -> Believed | None:
    """The world that images show; None: nothing in any of them can be taken hold of.

    A trial's part of it depends on its own images alone.

    Args:
        seen: of N trials.
        benchmark: its robot, workplace and limits.
        hands: a right and a left hand, or one of them.
        config: how one judges.
        noise: its error of the receiver's hand on the object.
        holds: whether the receiver's hands on the objects are asked for.
        seed: of the draws.
    """
    left = seen.receiver.left.cpu().numpy()
    rows, objects, places, hands_on = [], [], [], []
    for i in range(len(seen)):
        found = _object(seen, i, benchmark.robot)
        if found is None:
            continue
        if holds:
            hold = _hold(found[0], hands.model, int(left[i]), int(seen.key[i]), noise, seed)
            if hold is None:
                continue
            hands_on.append(hold)
        rows.append(i)
        objects.append(found[0])
        places.append(found[1])
    if not rows:
        return None
    row = torch.tensor(rows, dtype=torch.int64, device="cpu")
    # two trials of one known mesh share it
    names = {o.name: o for o in objects}
    index = [list(names).index(o.name) for o in objects]
    own = replace(benchmark, objects=tuple(names.values()), hand_set=hands)
    # planning keeps this room too, where it believes what was seen
    room = ROOM_M if "pick" in benchmark.asks else 0.0
    scene = Scene(own, config=config, hand_room_m=room)
    receiver = replace(seen.receiver, **{k: x.cpu()[row] for k, x in vars(seen.receiver).items()})
    key = seen.key.cpu()[row]
    hand_index, T_world_hand = _placed(scene, receiver)
    trials = Trials(
        key, torch.tensor(index, dtype=torch.int32, device="cpu"), hand_index, T_world_hand
    ).named(scene.objects)
    given = None
    if holds:
        order = np.argsort(key.numpy(), kind="stable")
        arrays = {k: np.stack([h[k] for h in hands_on])[order] for k in hands_on[0]}
        given = ExternalHands("seen solid", key.numpy()[order], arrays)
    T_world_obj = torch.from_numpy(np.stack(places))
    return Believed(row, scene, trials, T_world_obj, Observations(receiving=given))


def straight_down(
    seen: Observation,
) -> tuple[Float64[Tensor, "n 4 4"], Float64[Tensor, "n 4 4"]]:
    """Poses of a gripper that comes down on the middle of the cloud, and that looks into the palm from 15 cm.

    Args:
        seen: of N trials.
    """
    cloud, mask = (x.cpu() for x in seen.cloud(2048))
    grasp = torch.eye(4, dtype=torch.float64, device="cpu").repeat(len(seen), 1, 1)
    grasp[:, 1, 1] = grasp[:, 2, 2] = -1.0
    count = mask.sum(1).clamp(min=1)
    handover = grasp.clone()
    grasp[:, :3, 3] = cloud.double().sum(1) / count[:, None]
    palm, normal = seen.receiver.palm.double().cpu(), seen.receiver.normal.double().cpu()
    handover[:, :3, 3] = palm + 0.15 * normal
    return grasp, handover


def known_before(benchmark: Benchmark) -> tuple[Benchmark, HandSet]:
    """A benchmark as it is known before anything is seen: without its objects, people and trials; and two of its hands.

    What people can take (Received) is not asked: hands that take an object cost half a minute of search each.
    """
    own = replace(
        benchmark, name="believed", receiver="hand", head_clearance_m=0.0, people=None, listed=None, labels=None, seed="",
        asks=tuple(name for name in benchmark.asks if name == "pick"), certified=None,
    )  # fmt: skip
    return own, _middle_hands(benchmark.hand_set)


@lru_cache(maxsize=4)
def _middle_hands(hands: HandSet) -> HandSet:
    """The hand of each side whose joints are nearest to those of the others."""
    joints = hands.geometry.joints.double().numpy()
    sides, rows = hands.side.numpy(), []
    for side in np.unique(sides):
        own = np.flatnonzero(sides == side)
        away = np.abs(joints[own] - np.median(joints[own], 0)).sum((1, 2))
        rows.append(int(own[np.argmin(away)]))
    pieces = (len(hands.hull_offsets) - 1) // len(hands)
    ids, offsets = hands.hull_vertex_ids.numpy(), hands.hull_offsets.numpy()
    of_hand = [offsets[h * pieces : (h + 1) * pieces + 1] for h in rows]
    lengths = np.concatenate([np.diff(o) for o in of_hand])
    kept = torch.tensor(rows, dtype=torch.int64, device="cpu")
    skin = hands.skin
    return replace(
        hands,
        pose=hands.pose[kept],
        shape=hands.shape[kept],
        side=hands.side[kept],
        posture=tuple(hands.posture[h] for h in rows),
        hull_vertex_ids=torch.from_numpy(np.concatenate([ids[o[0] : o[-1]] for o in of_hand])),
        hull_offsets=torch.from_numpy(np.append(0, np.cumsum(lengths)).astype(offsets.dtype)),
        digest=hashlib.sha256(f"{hands.digest} {rows}".encode()).hexdigest(),
        in_body=None,
        skin=None if skin is None else HandGeometry(skin.vertices[kept], skin.joints[kept]),
    )


def _placed(scene: Scene, receiver: Receiver) -> tuple[Tensor, Float32[Tensor, "m 4 4"]]:
    """The hand of the scene that each receiver has, and its T_world_hand: palm, normal and direction are the receiver's."""
    side = scene.hands.set.side.long()
    wanted = receiver.left.long()
    row = (side[None] == wanted[:, None]).to(torch.int8).argmax(1)
    normal, along = receiver.normal.double(), receiver.along.double()
    along = along - se3.dot(along, normal)[:, None] * normal
    along = along / se3.dot(along, along).sqrt()[:, None]
    sign = torch.where(receiver.left, -1.0, 1.0).double()
    world = torch.stack([along, normal, sign[:, None] * se3.cross(along, normal)], 2)
    own = scene.hands.directions[row]
    R = se3.matmul(world, own.mT)
    palm = scene.hands.palm_point[row].double()
    p = receiver.palm.double() - se3.rotate(R, palm)
    return row.to(torch.int32), se3.from_rotation(R, p).float()


def _object(
    seen: Observation, row: int, robot: Robot
) -> tuple[ObjectModel, Float64[np.ndarray, "4 4"]] | None:
    """The object of a trial as it is believed to be, with its candidates, and where its frame lies in the world; None: there is
    none, or the gripper cannot hold it."""
    found = believed_object(seen, row)
    if found is None:
        return None
    model = with_grasps(found[0], robot)
    return None if model is None else (model, found[1])


@lru_cache(maxsize=KEPT_SOLIDS)
def with_grasps(model: ObjectModel, robot: Robot) -> ObjectModel | None:
    """An object with candidates for the robot's gripper; None: the gripper can hold it nowhere."""
    with warnings.catch_warnings():  # a repair of what was seen is no user's business
        warnings.simplefilter("ignore")
        try:
            found = sample_grasps(model, robot, enough=GRASPS_ENOUGH)
        except NoGraspError:
            return None
    gripper = "2f-85" if robot.linkage.table is None else robot.name.replace("_", "-")
    grasps = GraspSet(
        found.T_obj_ee, found.width, found.score, found.part.astype(np.int32), gripper
    )
    return replace(model, grasps=grasps)


def _hold(
    model: ObjectModel, hand: HandModel, side: int, key: int, noise: PredictorNoise, seed: int
) -> dict[str, NDArray[np.float32]] | None:
    """The receiver's hand on an object, with the error of a network; None: no hand can hold it, as far as was found."""
    held = holds_on(model, hand, side)
    if held is None:
        return None
    ids, counters = np.array([key], np.int64), rng.key_of(f"receiving hand {seed}")
    (u,) = rng.uniforms(counters, ids, 1, purpose=_GRASP)
    k = int(rng.choice(u, np.array([len(held["side"])]))[0])
    one = {name: torch.from_numpy(held[name][k : k + 1]) for name in ("pose", "shape", "side")}
    posed = hand.pose(one["pose"], one["shape"], one["side"])
    palm, _ = palm_frame(posed.joints, one["side"])
    T = perturbed(
        torch.from_numpy(held["T_obj_hand"][k : k + 1]), palm, ids, counters, purpose=_RECEIVING,
        rotation_deg=noise.receiving_rotation_deg, translation_m=noise.receiving_translation_m,
    )  # fmt: skip
    return {"T": T[0].numpy(), "pose": held["pose"][k], "shape": held["shape"][k]}


@lru_cache(maxsize=KEPT_SOLIDS)
def holds_on(model: ObjectModel, hand: HandModel, side: int) -> dict[str, NDArray[Any]] | None:
    """Hands of one side on an object."""
    try:
        found = sample_receiving(
            model, hand=hand, per_side=HOLDS, sides=(side,), enough=HOLDS_ENOUGH
        )
    except NoHoldError:
        return None
    return found
