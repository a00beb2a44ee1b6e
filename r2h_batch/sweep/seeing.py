"""Methods that see: a chunk of trials is looked at, the method is asked apart, its grasps come into the objects' frames."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.errors import AnswerError
from r2h_batch.observe.apart import Apart
from r2h_batch.observe.seen import LABELS, Observation
from r2h_batch.observe.sees import Sees
from r2h_batch.types import Predictions, Trials
from r2h_batch.verdicts import CRITERIA

if TYPE_CHECKING:
    from r2h_batch.evaluate import Evaluator

AT_ONCE = 64
"""Trials that are looked at and sent at once: 34 MB of images of two posts."""
CLOUD = 2048
SEEN_M = 0.008
"""A point of the object's surface counts as seen with a point of the cloud this near [choice]."""
SURFACE_POINTS = 512
KEPT_TRIALS = 256
"""Trials whose images stay for the next method of a sweep: 0.53 MB each of two posts. The first ones stay: each method goes
through all trials in the same order, so that the last ones never would."""
LIFT_M = 0.005
"""How far the object is lifted where its pick is looked at [choice]: at rest it touches the table."""


class Asked(Protocol):
    """Answers observations."""

    def ask(self, seen: Observation) -> tuple[Tensor, Tensor, Tensor]:
        """T_world_grasp, T_world_ee (N, 4, 4) float64, m, and seconds (N,) float32, on the CPU.

        Args:
            seen: of N trials.
        """


@dataclass(frozen=True)
class Look:
    """Images of some trials, and where their objects lie in truth.

    Attributes:
        seen: of N trials.
        T_world_obj: where their objects lie in truth, m.
        columns: of `SEES`, those that no method decides.
    """

    seen: Observation
    T_world_obj: Float32[Tensor, "n 4 4"]
    columns: dict[str, Tensor]


class Looks:
    """Images of the trials of a sweep, made once for all of its methods.

    Args:
        sees: what is shown.
        evaluator: of the trials.
        kept: trials whose images stay; 0: each method looks anew.
    """

    def __init__(self, sees: Sees, evaluator: "Evaluator", kept: int = 0) -> None:
        self.sees, self.evaluator = sees, evaluator
        self._free = kept
        self._kept: dict[bytes, Look] = {}

    def of(self, trials: Trials) -> Look:
        """The images of N trials; `t_sees_s` is that of the first look.

        Args:
            trials: N trials of the evaluator's benchmark: an id names one.
        """
        key = trials.trial_id.cpu().numpy().tobytes()
        if key in self._kept:
            return self._kept[key]
        found = self._look(trials)
        if len(trials) <= self._free:
            self._kept[key] = found
            self._free -= len(trials)
        return found

    def _look(self, trials: Trials) -> Look:
        start = time.perf_counter()
        seen, T_world_obj = self.sees.look(self.evaluator.scene, trials)
        t_sees, home = (time.perf_counter() - start) / len(trials), T_world_obj.device
        pixels = (seen.object.label == LABELS.index("object")) & (seen.object.depth_m > 0)
        columns = {
            "t_sees_s": torch.full((len(trials),), t_sees, dtype=torch.float32, device=home),
            "seen_px": pixels.sum((1, 2, 3)).int(),
            "seen_share": seen_share(self.evaluator, trials, seen, T_world_obj),
        }
        return Look(seen, T_world_obj, columns)


class SeeingMethod:
    """A method that answers what it sees, as a job of a sweep.

    Args:
        name: in tables and messages.
        asked: answers observations.
        looks: what it is shown.
    """

    def __init__(self, name: str, asked: Asked, looks: Looks) -> None:
        self.name, self.looks = name, looks
        self._asked = asked
        self._looked: dict[str, Tensor] = {}

    @classmethod
    def apart(
        cls,
        name: str,
        method: str,
        options: Mapping[str, Any],
        looks: Looks,
    ) -> Self:
        """A user's `predict(seen)`, in a process of its own.

        Args:
            name: in tables and messages.
            method: as `--method` names it, without name and options.
            options: keyword arguments of the function.
            looks: what it is shown.
        """
        return cls(name, Apart(method, options, looks.evaluator.threads), looks)

    @classmethod
    def built_in(
        cls,
        name: str,
        function: Callable[..., Predictions],
        shown: Sequence[str],
        options: Mapping[str, Any],
        looks: Looks,
    ) -> Self:
        """A built-in method, in the world that it believes (`methods.believed`).

        Args:
            name: in tables and messages.
            function: its `predict`.
            shown: fields of `Observations` that it is shown.
            options: keyword arguments of the function.
            looks: what it is shown.
        """
        from r2h_batch.methods.believed import AskedHere

        evaluator, sees = looks.evaluator, looks.sees
        asked = AskedHere(
            function, shown, options, evaluator.scene.benchmark, evaluator.config,
            noise=sees.noise, model=sees.model, threads=evaluator.threads,
        )  # fmt: skip
        return cls(name, asked, looks)

    def predict(self, trials: Trials) -> Predictions:
        """The answers of N trials; what was seen of them waits for `looked`.

        Args:
            trials: N trials.

        Raises:
            AnswerError: one line about the method's answer.
        """
        parts = [self._part(trials[i : i + AT_ONCE]) for i in range(0, len(trials), AT_ONCE)]
        answers = [answer for answer, _ in parts]
        self._looked = {k: torch.cat([seen[k] for _, seen in parts]) for k in parts[0][1]}
        return Predictions(
            trials.trial_id,
            torch.cat([a.T_obj_ee for a in answers]),
            torch.cat([a.T_world_ee for a in answers]),
            torch.cat([_seconds(a) for a in answers]),
            self.name,
        )

    def looked(self, trial_id: Int64[Tensor, " n"]) -> dict[str, Tensor]:
        """The columns `SEES` of the trials of the last call.

        Args:
            trial_id: their ids.
        """
        if not torch.equal(self._looked["trial_id"], trial_id.cpu()):
            raise RuntimeError("what was seen is of other trials than the answers")
        return self._looked

    def _part(self, trials: Trials) -> tuple[Predictions, dict[str, Tensor]]:
        look = self.looks.of(trials)
        try:
            grasp, handover, seconds = self._asked.ask(look.seen)
        except AnswerError as error:
            raise AnswerError(f"method {self.name}: {error}") from None
        home = look.T_world_obj.device
        T_obj_ee = se3.matmul(se3.inverse(look.T_world_obj.double()), grasp.to(home)).float()
        answers = Predictions(
            trials.trial_id, T_obj_ee, handover.float().to(home), seconds.to(home), self.name
        )
        picked = picks(self.looks.evaluator, trials, T_obj_ee, grasp)
        columns = {"trial_id": trials.trial_id, **look.columns, **picked}
        return answers, {k: x.cpu() for k, x in columns.items()}


def _seconds(answers: Predictions) -> Tensor:
    assert answers.t_method_s is not None
    return answers.t_method_s


def seen_share(
    evaluator: "Evaluator",
    trials: Trials,
    seen: Observation,
    T_world_obj: Float32[Tensor, "n 4 4"],
) -> Float32[Tensor, " n"]:
    """Share of each object's surface that has a point of the seen cloud within `SEEN_M`.

    Args:
        evaluator: of the trials.
        trials: N trials.
        seen: what was seen of them.
        T_world_obj: (N, 4, 4) float32, where the objects lie, m.
    """
    cloud, mask = seen.cloud(CLOUD)
    objects, found = evaluator.scene.objects, []
    for i, k in enumerate(trials.object_index.tolist()):
        points = objects[k].points
        few = points[:: max(1, len(points) // SURFACE_POINTS)][:SURFACE_POINTS]
        some = torch.from_numpy(few.astype(np.float32)).to(T_world_obj.device)
        own, mine = se3.apply(T_world_obj[i], some), cloud[i][mask[i]]
        near = torch.zeros(len(own), dtype=torch.bool, device=own.device)
        if len(mine):
            mode = "donot_use_mm_for_euclid_dist"  # the other way depends on the batch
            near = torch.cdist(own, mine, compute_mode=mode).amin(1) < SEEN_M
        found.append(near.sum().float() / len(own))
    return torch.stack(found)


def picks(
    evaluator: "Evaluator",
    trials: Trials,
    T_obj_ee: Float32[Tensor, "n 4 4"],
    T_world_grasp: Float64[Tensor, "n 4 4"],
) -> dict[str, Bool[Tensor, " n"]]:
    """`pick`: whether some posture takes the object up where it lies, and `pick_judged`: whether that was looked at.

    The judge looks at the grasp with the object lifted by `LIFT_M` as at a handover pose: the arm reaches it, and robot and
    object touch neither the table nor the person. The way there is not looked at, nor whether the grasp is stable.

    Args:
        evaluator: of the trials.
        trials: N trials.
        T_obj_ee: (N, 4, 4) float32 grasps, m.
        T_world_grasp: (N, 4, 4) float64, where they are at the moment, m.
    """
    lifted = T_world_grasp.float().to(T_obj_ee.device)
    lifted[:, 2, 3] += LIFT_M
    # the first call of an evaluator tells of odd poses: these are not the method's
    called, evaluator.called = evaluator.called, True
    try:
        scores = evaluator.score(T_obj_ee, lifted, trials, stages="pose")
    finally:
        evaluator.called = called
    plan = CRITERIA.index("plan")
    return {"pick": scores.passed[:, plan], "pick_judged": scores.evaluated[:, plan]}
