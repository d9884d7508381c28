"""Lattice against torch's normal distribution, its definition, and at its bounds."""

from __future__ import annotations

import copy

import pytest
import torch as th
from torch.distributions import MultivariateNormal, Normal

from sb3_flowpolicy.distributions import Lattice
from sb3_flowpolicy.distributions.lattice import LOG_STD_MAX, LOG_STD_MIN, SoftLogStdHead
from tests.distributions.conftest import CONTEXT_DIM, DIMS, build


def stds(density: Lattice, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Standard deviations of the noise of features and of actions."""
    latent = density.latent_log_std(context).exp()
    return density.alpha * latent, density.loc_and_log_std(context)[1].exp()


def lattice(dim: int, alpha: float = 1.0) -> Lattice:
    density = build("lattice", dim)
    assert isinstance(density, Lattice)
    density.alpha = alpha
    return density


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_equals_torch(dim: int, alpha: float) -> None:
    density = lattice(dim, alpha)
    context = th.randn(20, CONTEXT_DIM, dtype=th.float64)
    latent, own = stds(density, context)
    weight = density.mu.weight
    covariance = (weight * latent.square().unsqueeze(-2)) @ weight.T + th.diag_embed(own.square())
    peer = MultivariateNormal(density.mu(context), covariance)
    u, log_prob = density.rsample_and_log_prob(context, th.randn(20, dim, dtype=th.float64))
    th.testing.assert_close(log_prob, peer.log_prob(u), rtol=1e-8, atol=1e-6)
    elsewhere = th.randn(20, dim, dtype=th.float64)
    th.testing.assert_close(
        density.log_prob(context, elsewhere), peer.log_prob(elsewhere), rtol=1e-8, atol=1e-6
    )


def test_samples_are_spread_like_noise_in_features_and_actions(context: th.Tensor) -> None:
    density = lattice(3, alpha=0.7)
    latent, own = stds(density, context)
    draw = th.Generator().manual_seed(0)
    features, actions, noise = (
        th.randn(200_000, n, dtype=th.float64, generator=draw) for n in (CONTEXT_DIM, 3, 3)
    )
    defined = density.mu(context + latent * features) + own * actions
    u, _ = density.rsample_and_log_prob(context, noise)
    th.testing.assert_close(u.mean(0), defined.mean(0), rtol=0.05, atol=0.02)
    th.testing.assert_close(th.cov(u.T), th.cov(defined.T), rtol=0.05, atol=0.02)


def test_alpha_zero_is_a_diagonal_normal(context: th.Tensor) -> None:
    density = lattice(3, alpha=0.0)
    u = th.randn(10, 3, dtype=th.float64)
    expected = Normal(density.mu(context), stds(density, context)[1]).log_prob(u).sum(-1)
    th.testing.assert_close(density.log_prob(context, u), expected)


def test_exploration_shapes_the_layer_that_computes_the_mean() -> None:
    density = lattice(3)
    context = th.randn(8, CONTEXT_DIM, dtype=th.float64)
    log_std = density.loc_and_log_std(context)[1]
    density.scale_tril(context, log_std).diagonal(dim1=-2, dim2=-1).log().sum().backward()
    assert density.mu.weight.grad is not None
    assert density.mu.weight.grad.abs().max() > 1e-3


@pytest.mark.parametrize("dim", [2, 8, 17])
@pytest.mark.parametrize("size", [1.0, 10.0, 1e6])
def test_survives_parallel_rows_and_no_noise_of_the_actions_own(dim: int, size: float) -> None:
    """A covariance of rank one up to the smallest possible standard deviations."""
    density = Lattice(dim, CONTEXT_DIM)
    with th.no_grad():
        for parameter in density.parameters():
            parameter.zero_()
        density.mu.weight.fill_(size)
        density.log_std.bias.fill_(-1e6)
        density.latent_log_std.bias.fill_(1e6)
    context, noise = th.zeros(64, CONTEXT_DIM), th.randn(64, dim)
    u, log_prob = density.rsample_and_log_prob(context, noise)
    (u.sum() + log_prob.sum()).backward()
    assert u.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in density.parameters())
    assert density.log_prob(context, u.detach()).isfinite().all()
    # det(a^2 1 1^T + s^2 I) = s^2D (1 + D a^2 / s^2), up to the rounding of float64.
    factor = CONTEXT_DIM * size**2 * th.tensor(2 * LOG_STD_MAX, dtype=th.float64).exp()
    ratio = factor * th.tensor(-2 * LOG_STD_MIN, dtype=th.float64).exp()
    half_log_det = dim * LOG_STD_MIN + 0.5 * th.log1p(dim * ratio)
    expected = Normal(0.0, 1.0).log_prob(noise).sum(-1) - half_log_det
    assert log_prob.isfinite().all()
    if size <= 10:
        th.testing.assert_close(log_prob.double(), expected.double(), rtol=1e-4, atol=1e-2)


def test_float32_agrees_with_float64_on_large_covariances() -> None:
    density = lattice(8)
    with th.no_grad():
        density.mu.weight.mul_(30)
        density.log_std.bias.sub_(8)
    single = copy.deepcopy(density).float()
    context, noise = th.randn(256, CONTEXT_DIM), th.randn(256, 8)
    _, expected = density.rsample_and_log_prob(context.double(), noise.double())
    _, got = single.rsample_and_log_prob(context, noise)
    th.testing.assert_close(got.double(), expected, rtol=1e-4, atol=1e-4)


def test_bounds_are_soft() -> None:
    value = th.tensor([-1e3, 0.0, 1e3], requires_grad=True)
    head = SoftLogStdHead(1, 1)
    with th.no_grad():
        head.weight.fill_(1.0)
        head.bias.zero_()
    bounded = head(value.unsqueeze(-1)).squeeze(-1)
    bounded.sum().backward()
    assert LOG_STD_MIN < bounded[0] < LOG_STD_MIN + 0.2
    assert LOG_STD_MAX - 0.01 < bounded[2] < LOG_STD_MAX
    assert value.grad is not None
    assert (value.grad > 0).all()
    assert value.grad[1] == 1


@pytest.mark.parametrize("alpha", [-0.1, float("nan"), float("inf"), "1", True, None])
def test_bad_alpha(alpha: object) -> None:
    with pytest.raises(ValueError, match=r"alpha must be (a number|finite|at least 0), got"):
        Lattice(2, 3, alpha=alpha)  # type: ignore[arg-type]
