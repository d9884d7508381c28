"""The actor: samples, log-densities, entropy, correlation, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_flowpolicy import FlowPolicy, GaussPolicy, LowRankPolicy
from sb3_flowpolicy.distributions import DiagGaussian, registered_distributions, registry
from sb3_flowpolicy.policies import DistributionPolicy, FlowActor

OBS = spaces.Box(-1, 1, (3,))
ACTION = spaces.Box(-2, 2, (2,))


def make(policy_class: type[DistributionPolicy], **kwargs: object) -> FlowActor:
    th.manual_seed(0)
    policy = policy_class(OBS, ACTION, lambda _: 1e-3, net_arch=[16], **kwargs)  # type: ignore[arg-type]
    assert isinstance(policy.actor, FlowActor)
    return policy.actor


@pytest.fixture(params=list(registered_distributions()))
def actor(request: pytest.FixtureRequest) -> FlowActor:
    actor = make(FlowPolicy, distribution=request.param)
    with th.no_grad():
        for parameter in actor.density.parameters():
            parameter.copy_(th.randn_like(parameter) * 0.15)
    return actor


def test_noise_decides_the_action(actor: FlowActor) -> None:
    obs = th.randn(5, 3)
    noise = actor.density.draw_noise(actor.context(obs))
    action, log_prob = actor.action_log_prob(obs, noise)
    assert th.equal(actor(obs, noise=noise), action)
    assert action.shape == (5, 2)
    assert log_prob.shape == (5,)
    assert action.abs().max() <= 1
    th.testing.assert_close(actor.log_prob(obs, action), log_prob, rtol=1e-3, atol=1e-3)


def test_edge_of_the_box_has_finite_density(actor: FlowActor) -> None:
    obs = th.randn(4, 3)
    corners = th.tensor([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, 0.0]])
    log_prob = actor.log_prob(obs, corners)
    log_prob.sum().backward()
    assert log_prob.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in actor.parameters())


# The grid contains the tails of these densities.
@pytest.mark.parametrize(
    "actor",
    ["gaussian", "low_rank", "full_covariance", "lattice", "realnvp", "spline"],
    indirect=True,
)
def test_entropy_is_minus_the_mean_log_prob_on_a_grid(actor: FlowActor) -> None:
    obs = th.randn(1, 3)
    axis = th.linspace(-6, 6, 801)
    points = th.cartesian_prod(axis, axis)
    log_prob = actor.log_prob(obs.expand(len(points), 3), points.tanh())
    log_volume = -2 * points.cosh().log().sum(-1)
    mass = (log_prob + log_volume).exp() * (axis[1] - axis[0]) ** 2
    expected = -(mass * log_prob).sum() / mass.sum()
    estimate = actor.entropy(obs, n_samples=20_000)
    assert estimate.shape == (1,)
    assert estimate.item() == pytest.approx(expected.item(), abs=0.05)


def test_entropy_never_exceeds_that_of_the_uniform_distribution(actor: FlowActor) -> None:
    assert (actor.entropy(th.randn(8, 3), 4000) <= 2 * math.log(2) + 0.05).all()


def test_diagonal_policy_has_no_correlation() -> None:
    correlation = make(GaussPolicy).action_correlation(th.randn(4, 3), n_samples=20_000)
    assert correlation.shape == (4, 2, 2)
    assert correlation[:, 0, 1].abs().max() < 0.03


def test_strong_correlation_is_found() -> None:
    actor = make(LowRankPolicy, distribution_kwargs={"rank": 1})
    density = actor.density.base
    with th.no_grad():
        for parameter in density.parameters():
            parameter.zero_()
        density.log_std.bias.fill_(-3.0)
        density.cov_factor.bias.copy_(th.tensor([0.3, -0.3]))
    correlation = actor.action_correlation(th.randn(4, 3))
    assert (correlation[:, 0, 1] < -0.95).all()
    th.testing.assert_close(correlation, correlation.mT)
    assert th.equal(correlation.diagonal(dim1=-2, dim2=-1), th.ones(4, 2))


def test_correlation_of_a_constant_action_is_no_nan() -> None:
    actor = make(GaussPolicy)
    with th.no_grad():
        for parameter in actor.density.parameters():
            parameter.zero_()
        actor.density.base.mu.bias.fill_(50.0)
    correlation = actor.action_correlation(th.randn(2, 3))
    assert th.equal(correlation, th.eye(2).expand(2, 2, 2))


def test_sb3_distribution_interface(actor: FlowActor) -> None:
    obs = th.randn(6, 3)
    context = actor.context(obs)
    dist = actor.action_dist
    assert dist.proba_distribution_net() is actor.density
    assert th.equal(dist.actions_from_params(context, deterministic=True), actor(obs, True))
    th.manual_seed(3)
    action, log_prob = dist.log_prob_from_params(context)
    th.manual_seed(3)
    assert th.equal(dist.proba_distribution(context).sample(), action)
    th.testing.assert_close(dist.log_prob(action), log_prob, rtol=1e-3, atol=1e-3)
    entropy = th.stack([dist.entropy() for _ in range(300)])
    standard_error = entropy.std(0) / 300**0.5
    assert ((entropy.mean(0) - actor.entropy(obs, 20_000)).abs() < 5 * standard_error + 1e-2).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"distribution": "nvp"}, "distribution must be one of"),
        (
            {"distribution_kwargs": {2: "layers"}},
            "distribution_kwargs must be None or a dict with strings",
        ),
        (
            {"distribution_kwargs": "layers=4"},
            "distribution_kwargs must be None or a dict .* got 'layers=4'",
        ),
        ({"distribution": ["realnvp"]}, "distribution must be one of"),
        ({"use_sde": True}, "use_sde must be False unless distribution is 'gaussian'"),
    ],
)
def test_bad_arguments(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlowPolicy(OBS, ACTION, lambda _: 1e-3, **kwargs)


def test_unknown_arguments_are_refused_by_python() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'layers'"):
        FlowPolicy(OBS, ACTION, lambda _: 1e-3, layers=2)
    with pytest.raises(TypeError, match="unexpected keyword argument 'layer'"):
        FlowPolicy(OBS, ACTION, lambda _: 1e-3, distribution_kwargs={"layer": 2})


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(-np.inf, np.inf, (2,))])
def test_bad_action_spaces(space: spaces.Space) -> None:
    with pytest.raises(
        ValueError, match="action_space must be a Box with finite bounds, low < high, got"
    ):
        FlowPolicy(OBS, space, lambda _: 1e-3)  # type: ignore[arg-type]


def test_actions_to_score_must_fit() -> None:
    actor = make(FlowPolicy)
    with pytest.raises(ValueError, match=r"value must have shape \(\.\.\., 2\), got \(3, 4\)"):
        actor.log_prob(th.zeros(3, 3), th.zeros(6, 1, 2))
    with pytest.raises(ValueError, match=r"action must be scaled to \[-1, 1\], got.*1.9"):
        actor.log_prob(th.zeros(1, 3), th.tensor([[0.0, 1.9]]))
    scored = actor.log_prob(th.zeros(1, 3), np.array([[0.5, 1.0]]))  # type: ignore[arg-type]
    assert scored.isfinite().all()
    with pytest.raises(ValueError, match="n_samples must be an integer of at least 1, got 0"):
        actor.entropy(th.zeros(1, 3), 0)


def test_a_density_must_not_hide_the_actor(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clash(DiagGaussian):
        def __init__(self, action_dim: int, context_dim: int) -> None:
            super().__init__(action_dim, context_dim)
            self.latent_pi = th.nn.Linear(1, 1)

    monkeypatch.setattr(registry, "_REGISTRY", {"clash": Clash})
    with pytest.raises(ValueError, match=r"must not name a submodule.*got \['latent_pi'\]"):
        make(FlowPolicy, distribution="clash")
