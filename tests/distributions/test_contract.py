"""The contract of every registered density, including those of third parties."""

from __future__ import annotations

import copy

import pytest
import torch as th
from torch.func import functional_call, stack_module_state, vmap

from sb3_flowpolicy.distributions import ActionDistribution, TanhSquashed, registered_distributions
from sb3_flowpolicy.distributions.gaussian import DiagGaussian
from tests.distributions.conftest import CONTEXT_DIM, build


def draw(density: ActionDistribution, *shape: int, seed: int = 2) -> th.Tensor:
    generator = th.Generator().manual_seed(seed)
    return th.randn(*shape, density.noise_dim, dtype=th.float64, generator=generator)


def log_density_by_jacobian(
    density: ActionDistribution, context: th.Tensor, noise: th.Tensor
) -> th.Tensor:
    """Change of variables; a Gaussian with M > D is an affine map of its noise."""

    def sample(noise: th.Tensor) -> th.Tensor:
        return density.rsample_and_log_prob(context, noise)[0]

    jacobian = th.autograd.functional.jacobian(sample, noise)
    if density.noise_dim == density.action_dim:
        base = th.distributions.Normal(th.zeros_like(noise), 1.0).log_prob(noise).sum()
        return base - th.linalg.slogdet(jacobian).logabsdet
    covariance = jacobian @ jacobian.T
    normal = th.distributions.MultivariateNormal(sample(th.zeros_like(noise)), covariance)
    return normal.log_prob(sample(noise))


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("name", registered_distributions())
@pytest.mark.parametrize("squashed", [False, True])
def test_density_integrates_to_one(name: str, dim: int, squashed: bool, context: th.Tensor) -> None:
    density = build(name, dim)
    axis = th.linspace(-14, 14, 2801 if dim == 1 else 561, dtype=th.float64)
    points = th.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    if squashed:
        # The substitution a = tanh(v) makes the grid dense in the corners of the box.
        inside = points.abs().max(-1).values < 9
        points = points[inside]
        log_volume = 2 * points.cosh().log().sum(-1)
        log_prob = TanhSquashed(density).log_prob(context, points.tanh()) - log_volume
    else:
        log_prob = density.log_prob(context, points)
    cell = (axis[1] - axis[0]) ** dim
    assert (log_prob.exp().sum() * cell).item() == pytest.approx(1, abs=1e-3)


def test_log_prob_is_the_change_of_variables(
    density: ActionDistribution, context: th.Tensor
) -> None:
    if density.noise_dim > density.action_dim and not isinstance(density, DiagGaussian):
        pytest.skip("not a change of variables; that the density integrates to 1 is tested above")
    for noise in draw(density, 5):
        _, log_prob = density.rsample_and_log_prob(context, noise)
        expected = log_density_by_jacobian(density, context, noise)
        assert log_prob.item() == pytest.approx(expected.item(), abs=1e-6)


def test_squashed_log_prob_is_the_change_of_variables(
    density: ActionDistribution, context: th.Tensor
) -> None:
    squashed = TanhSquashed(density)
    for noise in draw(density, 5):
        u, base_log_prob = density.rsample_and_log_prob(context, noise)
        action, log_prob = squashed.rsample_and_log_prob(context, noise)
        jacobian = th.autograd.functional.jacobian(th.tanh, u).diagonal()
        # Beyond |u| = 8 the reference, 1 - tanh(u)^2, loses its digits.
        log_jacobian = th.where(u.abs() < 8, jacobian.log(), -2 * u.cosh().log())
        expected = base_log_prob - log_jacobian.sum()
        assert th.equal(action, u.tanh())
        assert log_prob.item() == pytest.approx(expected.item(), abs=1e-6)


def test_mode_is_the_image_of_zero_noise(density: ActionDistribution, context: th.Tensor) -> None:
    zero = th.zeros(density.noise_dim, dtype=th.float64)
    th.testing.assert_close(density.mode(context), density.rsample_and_log_prob(context, zero)[0])
    squashed = TanhSquashed(density)
    th.testing.assert_close(squashed.mode(context), density.mode(context).tanh())


def test_noise_broadcasts_against_context(density: ActionDistribution) -> None:
    context = th.randn(4, CONTEXT_DIM, dtype=th.float64, generator=th.Generator().manual_seed(4))
    noise = draw(density, 6, 4)
    u, log_prob = density.rsample_and_log_prob(context, noise)
    assert u.shape == (6, 4, density.action_dim)
    assert log_prob.shape == (6, 4)
    one_u, one_log_prob = density.rsample_and_log_prob(context[2], noise[5, 2])
    th.testing.assert_close(u[5, 2], one_u)
    th.testing.assert_close(log_prob[5, 2], one_log_prob)
    th.testing.assert_close(density.log_prob(context, u), log_prob, rtol=1e-8, atol=1e-6)
    # One noise, many contexts.
    wide_u, wide_log_prob = density.rsample_and_log_prob(context, noise[0, 0])
    assert wide_u.shape == (4, density.action_dim)
    assert wide_log_prob.shape == (4,)


def test_gradients_reach_every_parameter(density: ActionDistribution) -> None:
    context = th.randn(32, CONTEXT_DIM, dtype=th.float64, generator=th.Generator().manual_seed(5))
    u, log_prob = density.rsample_and_log_prob(context, draw(density, 32))
    (u.square().sum() + log_prob.sum()).backward()
    for name, parameter in density.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_float32_agrees_with_float64(density: ActionDistribution) -> None:
    generator = th.Generator().manual_seed(6)
    context = (th.rand(256, CONTEXT_DIM, dtype=th.float64, generator=generator) * 2 - 1) * 10
    noise = draw(density, 256)
    squashed = TanhSquashed(density)
    action, log_prob = squashed.rsample_and_log_prob(context, noise)
    single = copy.deepcopy(squashed).float()
    action32, log_prob32 = single.rsample_and_log_prob(context.float(), noise.float())
    th.testing.assert_close(action32.double(), action, rtol=1e-4, atol=1e-4)
    th.testing.assert_close(log_prob32.double(), log_prob, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("scale", [1e2, 1e4])
def test_saturated_actions_stay_finite(density: ActionDistribution, scale: float) -> None:
    squashed = TanhSquashed(density).float()
    generator = th.Generator().manual_seed(7)
    context = (th.randn(64, CONTEXT_DIM, generator=generator) * scale).requires_grad_()
    action, log_prob = squashed.rsample_and_log_prob(context, draw(density, 64).float())
    assert action.isfinite().all()
    assert log_prob.isfinite().all()
    corners = th.randint(0, 2, action.shape, generator=generator) * 2.0 - 1.0
    corner_log_prob = squashed.log_prob(th.zeros(64, CONTEXT_DIM), corners)
    assert corner_log_prob.isfinite().all()
    (action.sum() + log_prob.mean() + corner_log_prob.mean()).backward()
    assert context.grad is not None
    assert context.grad.isfinite().all()
    for name, parameter in squashed.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("scale", [1e3, 1e8])
def test_scores_of_unlikely_actions_stay_finite(density: ActionDistribution, scale: float) -> None:
    squashed = TanhSquashed(density).float()
    generator = th.Generator().manual_seed(7)
    context = (th.randn(64, CONTEXT_DIM, generator=generator) * scale).requires_grad_()
    corners = th.randint(0, 2, (64, density.action_dim), generator=generator) * 2.0 - 1.0
    log_prob = squashed.log_prob(context, corners)
    assert log_prob.isfinite().all()
    log_prob.mean().backward()
    assert context.grad is not None
    assert context.grad.isfinite().all()


def test_same_numbers_stacked_over_seeds(density: ActionDistribution) -> None:
    """Parameters, context and noise may have a leading axis, as SeedBatch requires."""
    name = next(n for n, c in registered_distributions().items() if c is type(density))
    members = [density, build(name, density.action_dim)]
    with th.no_grad():
        for parameter in members[1].parameters():
            parameter.mul_(0.5)
    parameters, buffers = stack_module_state(members)
    context = th.randn(2, 9, CONTEXT_DIM, dtype=th.float64)
    noise = draw(density, 2, 9)

    class Sampler(th.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.density = members[0]

        def forward(self, context: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
            return self.density.rsample_and_log_prob(context, noise)

    def call(
        parameters: dict, buffers: dict, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        state = {f"density.{key}": value for key, value in {**parameters, **buffers}.items()}
        return functional_call(Sampler(), state, (context, noise))

    stacked = vmap(call)(parameters, buffers, context, noise)
    for i, member in enumerate(members):
        single = member.rsample_and_log_prob(context[i], noise[i])
        th.testing.assert_close(stacked[0][i], single[0])
        th.testing.assert_close(stacked[1][i], single[1])


def test_state_dict_carries_the_density(density: ActionDistribution, context: th.Tensor) -> None:
    name = next(n for n, c in registered_distributions().items() if c is type(density))
    other = build(name, density.action_dim)
    with th.no_grad():
        for parameter in other.parameters():
            parameter.zero_()
    noise = draw(density, 3)
    before = other.rsample_and_log_prob(context, noise)
    other.load_state_dict(density.state_dict())
    after = other.rsample_and_log_prob(context, noise)
    expected = density.rsample_and_log_prob(context, noise)
    assert not th.equal(before[0], expected[0])
    assert th.equal(after[0], expected[0])
    assert th.equal(after[1], expected[1])


def test_wrong_shapes_are_named(density: ActionDistribution) -> None:
    context = th.zeros(2, CONTEXT_DIM, dtype=th.float64)
    with pytest.raises(ValueError, match=r"context must have shape \(\.\.\., 5\), got \(2, 4\)"):
        density.rsample_and_log_prob(context[:, :4], draw(density, 2))
    with pytest.raises(ValueError, match=r"noise must have shape"):
        density.rsample_and_log_prob(context, th.zeros(2, density.noise_dim + 1))
    with pytest.raises(ValueError, match=r"value must have shape"):
        density.log_prob(context, th.zeros(2, density.action_dim + 1))


@pytest.mark.parametrize("name", registered_distributions())
def test_dimensions_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match="action_dim must be an integer of at least 1, got 0"):
        registered_distributions()[name](0, 3)
    with pytest.raises(ValueError, match="context_dim must be an integer of at least 1, got -1"):
        registered_distributions()[name](2, -1)
