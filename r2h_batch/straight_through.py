"""A number from one place with the gradient from another."""

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["with_gradient"]


class _WithGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, value: Tensor, change: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: object, *gradient: Tensor) -> tuple[None, Tensor]:
        return None, gradient[0]


def with_gradient(value: Float[Tensor, "*b"], change: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """`value`, bit for bit, with the gradient of `change`."""
    out: Tensor = _WithGradient.apply(value, change)
    return out
