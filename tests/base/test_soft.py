"""Soft success: in (0, 1), above 0.5 exactly where the verdict is success, with gradients that are those of the formula."""

import pytest
import torch

from r2h_batch.base.soft import soft_success

TOUCHING = torch.tensor([True, False, True, False, False])  # Stability and Reach pass when touching


def made(n: int = 20_000, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Margins of all sizes down to 1e-12 and exact zeros, masks, verdicts."""
    g = torch.Generator().manual_seed(seed)
    margin = torch.randn((n, 5), generator=g) * 10 ** (-12 * torch.rand((n, 1), generator=g))
    margin[torch.rand((n, 5), generator=g) < 0.05] = 0.0
    margin[torch.rand((n, 5), generator=g) < 0.02] = -torch.inf
    margin[: n // 2] = margin[: n // 2].abs()
    evaluated = torch.rand((n, 5), generator=g) < 0.8
    evaluated[::97] = False
    margin[~evaluated] = torch.nan
    passed = torch.where(TOUCHING, margin >= 0, margin > 0)
    return margin, evaluated, (passed | ~evaluated).all(1) & evaluated.any(1)


@pytest.mark.parametrize("temperature_m", [1e-4, 5e-3, 1.0])
def test_it_is_above_one_half_exactly_where_everything_passes(temperature_m):
    margin, evaluated, success = made()
    assert 0.1 < success.float().mean() < 0.9
    soft = soft_success(margin, evaluated, success, temperature_m=temperature_m)
    assert ((soft > 0) & (soft < 1)).all() and torch.equal(soft > 0.5, success)
    log = soft_success(margin, evaluated, success, temperature_m=temperature_m, log=True)
    assert torch.isfinite(log).all() and (log < 0).all()
    seen = soft > 1e-30
    torch.testing.assert_close(log[seen].exp(), soft[seen], rtol=1e-4, atol=0)


def test_every_failing_criterion_pulls_and_what_was_not_evaluated_does_not():
    margin, evaluated, success = made()
    margin.requires_grad_()
    (slope,) = torch.autograd.grad(soft_success(margin, evaluated, success, temperature_m=5e-3, log=True).sum(), margin)
    assert torch.isfinite(slope).all() and (slope >= 0).all() and not slope[~evaluated].any()
    fails = evaluated & (margin < 0) & torch.isfinite(margin)
    assert (slope[fails & ~success[:, None]] > 0).all()
    assert not slope[margin == -torch.inf].any()


def test_gradients_are_those_of_finite_differences_in_float64():
    g = torch.Generator().manual_seed(1)
    margin = (0.01 * torch.randn((8, 5), generator=g)).double()
    margin[:4] = margin[:4].abs()
    evaluated = torch.ones(8, 5, dtype=torch.bool)
    success = (margin > 0).all(1)
    margin.requires_grad_()
    for log in (False, True):
        f = lambda m, log=log: soft_success(m, evaluated, success, temperature_m=5e-3, log=log)  # noqa: E731
        assert torch.autograd.gradcheck(f, margin, eps=1e-8)


def test_it_is_continuous_where_the_verdict_changes():
    margin = torch.full((2, 5), 0.02)
    margin[:, 1] = torch.tensor([1e-7, -1e-7])
    soft = soft_success(margin, torch.ones(2, 5, dtype=torch.bool), torch.tensor([True, False]), temperature_m=5e-3)
    assert soft[0] > 0.5 >= soft[1] and soft[0] - soft[1] < 1e-4


def test_rows_do_not_depend_on_the_batch_and_a_wrong_temperature_is_refused():
    rows = made(33)
    whole = soft_success(*rows, temperature_m=1e-3)
    assert torch.equal(whole[5:6], soft_success(*(x[5:6] for x in rows), temperature_m=1e-3))
    assert soft_success(*(x[:0] for x in rows), temperature_m=1e-3).shape == (0,)
    with pytest.raises(ValueError, match="temperature_m"):
        soft_success(*rows, temperature_m=0.0)
