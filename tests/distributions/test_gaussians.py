"""The three normal distributions against torch's, and near the limits of float32."""

from __future__ import annotations

import math

import pytest
import torch as th
from torch.distributions import LowRankMultivariateNormal, MultivariateNormal, Normal

from sb3_flowpolicy.distributions import (
    DiagGaussian,
    FullCovarianceGaussian,
    LowRankGaussian,
    make_distribution,
)
from sb3_flowpolicy.distributions.full_covariance import OFF_DIAGONAL_BOUND
from sb3_flowpolicy.distributions.gaussian import LOG_STD_MIN
from sb3_flowpolicy.distributions.low_rank import COV_FACTOR_BOUND
from tests.distributions.conftest import CONTEXT_DIM, DIMS, build


def test_diagonal_equals_torch(context: th.Tensor) -> None:
    density = build("gaussian", 3)
    assert isinstance(density, DiagGaussian)
    loc, log_std = density.loc_and_log_std(context)
    u = th.randn(10, 3, dtype=th.float64)
    expected = Normal(loc, log_std.exp()).log_prob(u).sum(-1)
    th.testing.assert_close(density.log_prob(context, u), expected)


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("rank", [1, 2, 3])
def test_low_rank_equals_torch(dim: int, rank: int) -> None:
    if rank > dim:
        pytest.skip("the rank is at most the dimension")
    th.manual_seed(0)
    density = make_distribution("low_rank", dim, CONTEXT_DIM, rank=rank).double()
    assert isinstance(density, LowRankGaussian)
    context = th.randn(20, CONTEXT_DIM, dtype=th.float64) * 3
    loc, log_std, columns = density.covariance_factors(context)
    peer = LowRankMultivariateNormal(loc, th.stack(columns, -1), (2 * log_std).exp())
    u, log_prob = density.rsample_and_log_prob(
        context, th.randn(20, density.noise_dim, dtype=th.float64)
    )
    th.testing.assert_close(log_prob, peer.log_prob(u), rtol=1e-8, atol=1e-6)
    elsewhere = th.randn(20, dim, dtype=th.float64)
    th.testing.assert_close(
        density.log_prob(context, elsewhere), peer.log_prob(elsewhere), rtol=1e-8, atol=1e-6
    )


def test_low_rank_samples_have_the_covariance(context: th.Tensor) -> None:
    density = build("low_rank", 3)
    assert isinstance(density, LowRankGaussian)
    _, log_std, columns = density.covariance_factors(context)
    factor = th.stack(columns, -1)
    covariance = factor @ factor.T + th.diag((2 * log_std).exp())
    noise = th.randn(200_000, density.noise_dim, dtype=th.float64)
    u, _ = density.rsample_and_log_prob(context, noise)
    th.testing.assert_close(th.cov(u.T), covariance, rtol=0.05, atol=0.02)


@pytest.mark.parametrize("dim", [2, 8, 17])
@pytest.mark.parametrize("parallel", [True, False])
def test_low_rank_survives_both_bounds_at_once(dim: int, parallel: bool) -> None:
    """The smallest sigma and the largest V, with parallel columns."""
    density = LowRankGaussian(dim, CONTEXT_DIM)
    with th.no_grad():
        for parameter in density.parameters():
            parameter.zero_()
        density.log_std.bias.fill_(10 * LOG_STD_MIN)
        signs = th.ones(2, dim)
        if not parallel:
            signs[1, ::2] = -1
        density.cov_factor.bias.copy_(1e6 * signs.flatten())
    context = th.zeros(64, CONTEXT_DIM)
    noise = th.randn(64, density.noise_dim, requires_grad=True)
    u, log_prob = density.rsample_and_log_prob(context, noise)
    (u.sum() + log_prob.sum()).backward()
    assert u.isfinite().all()
    assert log_prob.isfinite().all()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in density.parameters())
    assert u.abs().max() <= 2 * COV_FACTOR_BOUND * noise.abs().max()
    assert density.log_prob(context, u.detach()).isfinite().all()


def test_low_rank_defaults_to_rank_two_and_fits_one_dimension() -> None:
    assert LowRankGaussian(8, 3).rank == 2
    assert LowRankGaussian(1, 3).rank == 1


def test_low_rank_refuses_a_rank_above_the_dimension() -> None:
    with pytest.raises(ValueError, match="rank must be an integer from 1 to 2, got 3"):
        LowRankGaussian(2, 3, rank=3)
    with pytest.raises(ValueError, match="rank must be an integer from 1 to 2, got 0"):
        LowRankGaussian(2, 3, rank=0)


@pytest.mark.parametrize("dim", DIMS)
def test_full_covariance_equals_torch(dim: int, context: th.Tensor) -> None:
    density = build("full_covariance", dim)
    assert isinstance(density, FullCovarianceGaussian)
    loc, lower, log_diag = density.factors(context)
    log_std = density.loc_and_log_std(context)[1]
    scale_tril = lower * log_diag.exp().unsqueeze(-1)
    peer = MultivariateNormal(loc, scale_tril=scale_tril)
    u = th.randn(10, dim, dtype=th.float64)
    th.testing.assert_close(density.log_prob(context, u), peer.log_prob(u), rtol=1e-8, atol=1e-6)
    # log_std is the marginal standard deviation, as in DiagGaussian.
    th.testing.assert_close(peer.covariance_matrix.diagonal().sqrt(), log_std.exp())


def test_full_covariance_survives_scales_that_differ_by_nine_orders() -> None:
    density = FullCovarianceGaussian(4, CONTEXT_DIM)
    with th.no_grad():
        for parameter in density.parameters():
            parameter.zero_()
        density.log_std.bias.copy_(th.tensor([2.0, LOG_STD_MIN, 2.0, LOG_STD_MIN]))
        assert density.off_diagonal is not None
        density.off_diagonal.bias.fill_(1e6)
    context = th.zeros(64, CONTEXT_DIM)
    noise = th.randn(64, 4)
    u, log_prob = density.rsample_and_log_prob(context, noise)
    log_prob.sum().backward()
    assert u.isfinite().all()
    expected = Normal(0.0, 1.0).log_prob(noise).sum(-1)
    log_det = 2 * (2.0 + LOG_STD_MIN) - sum(
        0.5 * math.log1p(row * OFF_DIAGONAL_BOUND**2) for row in range(4)
    )
    th.testing.assert_close(log_prob, expected - log_det, rtol=1e-4, atol=1e-3)
    assert all(p.grad is None or p.grad.isfinite().all() for p in density.parameters())
