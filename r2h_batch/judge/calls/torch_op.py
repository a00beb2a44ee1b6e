"""Scoring as one opaque operator for torch.compile: r2h_batch::score, with shapes but no work for
tracing."""

from dataclasses import fields
from functools import partial
from itertools import count
from typing import Any, Protocol
from weakref import WeakValueDictionary

import torch
from torch import Tensor

from r2h_batch.judge.calls.gradients import by_differences
from r2h_batch.judge.inputs import Stages
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.types import GivenScores, PickedScores, Scores, Trials
from r2h_batch.verdicts import MAY_ASK, criteria_of


class Scorer(Protocol):
    """Interface that the operator calls: the `Evaluator`, as far as this module knows it."""

    scene: Any

    def score(
        self, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, *, stages: Stages
    ) -> Scores:
        """Verdicts of B handovers."""


_numbers = count()
_scorers: "WeakValueDictionary[int, Scorer]" = WeakValueDictionary()
"""An operator's arguments are tensors and numbers: this is how it finds its evaluator again."""
MOST_JOINTS = 16
KINDS = tuple(
    GivenScores if "received" in asks else PickedScores if "pick" in asks else Scores
    for asks in MAY_ASK
)
"""What `Evaluator.score` returns where a benchmark asks for each of `MAY_ASK`."""

PATH_WIDTH = {"pose": 0, "all": WAYPOINTS}
"""Width of `Scores.path`."""
WIDTH, JOINTS, COLUMNS = -1, -2, -3
"""Codes in `_SHAPES` for the path's width, the robot's number of joints and the benchmark's of criteria."""

_KEPT_OUTSIDE = ("trial_id", "motion", "motion_len", "failed_state")
RETURNED = tuple(
    tuple(f.name for f in fields(kind) if f.name not in _KEPT_OUTSIDE) for kind in KINDS
)
"""Outputs of the operator, in order, for each of `KINDS`; it may not return an input, so trial ids are put back outside.
It keeps no motion."""

_SHAPES: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
    "outcome": (torch.int8, ()),
    "success": (torch.bool, ()),
    "passed": (torch.bool, (COLUMNS,)),
    "evaluated": (torch.bool, (COLUMNS,)),
    "margin": (torch.float32, (COLUMNS,)),
    "margin_kind": (torch.int8, (COLUMNS,)),
    "borderline": (torch.bool, ()),
    "presented_by": (torch.int8, ()),
    "plan_reason": (torch.int8, ()),
    "plan_pair": (torch.int8, ()),
    "witness_part": (torch.int32, (2,)),
    "witness_point": (torch.float32, (3,)),
    "q_goal": (torch.float32, (JOINTS,)),
    "path": (torch.float32, (WIDTH, JOINTS)),
    "path_time_s": (torch.float32, (WIDTH,)),
    "path_len": (torch.int32, ()),
    "pick": (torch.int32, (3,)),
    "receives": (torch.int32, (3,)),
}
"""Per row; what is not listed is one float."""


def register(scorer: Scorer) -> int:
    """The number under which the operator finds this scorer for as long as it lives; tracing, which
    may not look it up, reads from it the robot's joints and which criteria the benchmark asks for."""
    number = next(_numbers) * len(KINDS) + MAY_ASK.index(scorer.scene.benchmark.asks)
    number = number * MOST_JOINTS + len(scorer.scene.robot.joints)
    _scorers[number] = scorer
    return number


def _asks(evaluator: int) -> int:
    """Place in `MAY_ASK` of what its benchmark asks for."""
    return evaluator // MOST_JOINTS % len(KINDS)


@torch.library.custom_op("r2h_batch::score", mutates_args=())
def score_op(
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    trial_id: Tensor,
    object_index: Tensor,
    hand_index: Tensor,
    T_world_hand: Tensor,
    receiver: Tensor | None,
    evaluator: int,
    stages: str,
) -> list[Tensor]:
    """The tensors of `Evaluator.score` in the order of `RETURNED`."""
    if evaluator not in _scorers:
        raise RuntimeError(
            "the evaluator of this compiled function is gone: keep a reference to it"
        )
    trials = Trials(trial_id, object_index, hand_index, T_world_hand, receiver)
    scores = _scorers[evaluator].score(T_obj_ee, T_world_ee, trials, stages=stages)  # type: ignore[arg-type]
    return [getattr(scores, name).clone() for name in RETURNED[_asks(evaluator)]]


@score_op.register_fake
def _(T_obj_ee: Tensor, *others: Any) -> list[Tensor]:
    out, (evaluator, stages) = [], others[-2:]
    sizes = {WIDTH: PATH_WIDTH[stages], JOINTS: evaluator % MOST_JOINTS}
    sizes[COLUMNS] = len(criteria_of(MAY_ASK[_asks(evaluator)]))
    for name in RETURNED[_asks(evaluator)]:
        dtype, shape = _SHAPES.get(name, (torch.float32, ()))
        row = [sizes.get(n, n) for n in shape]
        out.append(T_obj_ee.new_empty((T_obj_ee.shape[0], *row), dtype=dtype))
    return out


@torch.library.custom_op("r2h_batch::score_backward", mutates_args=())
def score_backward_op(
    T_obj_ee: Tensor,
    T_world_ee: Tensor,
    trial_id: Tensor,
    object_index: Tensor,
    hand_index: Tensor,
    T_world_hand: Tensor,
    receiver: Tensor | None,
    margin_gradient: Tensor,
    evaluator: int,
) -> list[Tensor]:
    """Gradient of the margins with respect to the two poses, by differences."""
    trials = Trials(trial_id, object_index, hand_index, T_world_hand, receiver)
    judge = partial(_scorers[evaluator].score, stages="pose")
    evaluated = judge(T_obj_ee, T_world_ee, trials).evaluated
    wanted = torch.where(evaluated, margin_gradient, 0.0)
    g, h = by_differences(judge, (T_obj_ee, T_world_ee), trials, wanted)
    assert g is not None and h is not None  # both were asked for
    return [g, h]


@score_backward_op.register_fake
def _(T_obj_ee: Tensor, T_world_ee: Tensor, *others: Any) -> list[Tensor]:
    return [T_obj_ee.new_empty(T_obj_ee.shape), T_world_ee.new_empty(T_world_ee.shape)]


def _remember(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    *tensors, ctx.evaluator, ctx.stages = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, gradients: list[Tensor | None]) -> tuple[Tensor | None, ...]:
    gradient = gradients[RETURNED[_asks(ctx.evaluator)].index("margin")]
    if gradient is None or ctx.stages != "pose":
        return (None,) * 9
    g, h = score_backward_op(*ctx.saved_tensors, gradient.contiguous(), ctx.evaluator)
    return g, h, *(None,) * 7


torch.library.register_autograd("r2h_batch::score", _backward, setup_context=_remember)


def call(
    evaluator: int, T_obj_ee: Tensor, T_world_ee: Tensor, trials: Trials, stages: str
) -> Scores:
    """`Evaluator.score` of checked rows through the operator: what torch.compile sees."""
    rows = (
        trials.trial_id, trials.object_index, trials.hand_index, trials.T_world_hand, trials.receiver
    )  # fmt: skip
    names = RETURNED[_asks(evaluator)]
    values = dict(zip(names, score_op(T_obj_ee, T_world_ee, *rows, evaluator, stages), strict=True))
    motion = T_obj_ee.new_empty((len(T_obj_ee), 0, values["q_goal"].shape[1]))
    motion_len = torch.zeros_like(values["path_len"])
    state = motion[:, :, 0].double()
    return KINDS[_asks(evaluator)](
        trial_id=trials.trial_id, **values, motion=motion, motion_len=motion_len, failed_state=state
    )
