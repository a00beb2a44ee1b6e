"""Smooth success: a number in (0, 1) that is above 0.5 exactly where all evaluated criteria pass.

With t = temperature_m and m_i the evaluated margins,

    some m_i fails   f = 1/2 prod_i 2 sigmoid(min(m_i, 0) / t)      at most 1/2, every failing
    criterion pulls
    all pass         f = 1/2 + 1/2 prod_i tanh(max(m_i, 0) / 2 t)   at least 1/2, the smallest
    margins pull most

The two meet at 1/2 where the smallest margin is 0, so f is continuous; its kinks are those of the
margins and m_i = 0.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from r2h_batch.base.validate import boolean, describe_value, number
from r2h_batch.base.validate_tensors import check_tensor, check_tensor_arguments
from r2h_batch.verdicts import REGISTRY, UNITS

_LOG_2 = 0.6931471805599453

LOWEST_M = -1e3
"""Stands for a margin of -inf (no path): its gradient is 0."""


def _floats(name: str, value: object) -> object:
    return _of(name, value, "a torch tensor (B, C) of floats", True)


def _booleans(name: str, value: object) -> object:
    return _of(name, value, "a torch tensor of booleans", False)


def _of(name: str, value: object, words: str, floats: bool) -> object:
    value = check_tensor(name, value, words)
    if value.is_floating_point() if not floats else not (value.is_floating_point() and value.ndim):
        raise TypeError(f"{name} is {describe_value(value)}; it must be {words}")
    return value


@check_tensor_arguments(
    margin=_floats,
    evaluated=_booleans,
    success=_booleans,
    temperature_m=number(0, above=True, what=" metres"),
    log=boolean,
)
def soft_success(
    margin: Float[Tensor, "*b c"],
    evaluated: Bool[Tensor, "*b c"],
    success: Bool[Tensor, "*b"],
    *,
    temperature_m: float,
    log: bool = False,
) -> Float[Tensor, "*b"]:
    """Smooth success of margins, in (0, 1).

    Args:
        margin: (..., C), m.
        evaluated: (..., C): which margins count. Rows without any get the smallest positive number;
            they and NaN margins have gradient 0.
        success: (...): the verdict, because criteria differ in whether touching passes.
        temperature_m: margins of this size, m, move it noticeably.
        log: return its logarithm, which stays linear in the margins where the number itself
            underflows.

    Raises:
        ValueError: shapes do not fit.
    """
    for name, value, shape in (
        ("evaluated", evaluated, margin.shape),
        ("success", success, margin.shape[:-1]),
    ):
        if value.shape != shape:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}; with this margin it must be {tuple(shape)}"
            )
    judged = evaluated.any(-1)
    m = (
        torch.where(evaluated, margin, torch.full_like(margin, torch.inf)).clamp(min=LOWEST_M)
        / temperature_m
    )
    failing = torch.zeros_like(m[..., 0])
    passing = torch.ones_like(failing)
    for i in range(m.shape[-1]):  # in a fixed order: the same bits at any batch size
        finite = torch.isfinite(m[..., i])
        x = torch.where(finite, m[..., i], torch.ones_like(failing))
        failing = failing + torch.where(
            finite & (x <= 0), _LOG_2 + torch.nn.functional.logsigmoid(x), 0.0
        )
        passing = passing * torch.where(finite & (x >= 0), torch.tanh(0.5 * x), 1.0)
    half = torch.full_like(failing, 0.5)
    least, above = torch.finfo(margin.dtype).tiny, torch.nextafter(half, torch.ones_like(half))
    change = torch.where(success, 0.5 + 0.5 * passing, 0.5 * torch.exp(failing))
    value = torch.where(
        success,
        torch.clamp(change, above, torch.nextafter(torch.ones_like(half), half)),
        change.clamp(least, 0.5),
    )
    value = torch.where(judged, value, torch.full_like(value, least))
    if log:
        change = torch.where(success, torch.log(change.clamp(min=0.5)), failing - _LOG_2)
        value = torch.where(judged & ~success, change, torch.log(value))
    return with_gradient(value.detach(), torch.where(judged, change, torch.zeros_like(change)))


def in_metres(margin: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
    """Margins (..., C), each in its criterion's unit, as lengths: a degree counts as `verdicts.UNITS` says.

    Args:
        margin: (..., C) each in its criterion's unit.
    """
    if all(entry.unit == "m" for entry in REGISTRY):
        return margin
    worth = [UNITS[entry.unit].worth_m for entry in REGISTRY]
    own = [margin[..., k] * w for k, w in enumerate(worth)]
    return torch.cat(
        [torch.stack(own, -1), margin[..., len(own) :]], -1
    )  # what is asked for is in m


class _WithGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, value: Tensor, change: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: object, *gradient: Tensor) -> tuple[None, Tensor]:
        return None, gradient[0]


def with_gradient(value: Float[Tensor, "*b"], change: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """`value`, bit for bit, with the gradient of `change`.

    Args:
        value: any shape.
        change: same shape; its value does not count.
    """
    out: Tensor = _WithGradient.apply(value, change)
    return out
