"""On-policy policies start as stock PPO's, with every density."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

from sb3_flowpolicy.distributions import ActionDistribution, registered_distributions, registry
from sb3_flowpolicy.distributions.loc_scale import LocScale, StateIndependent, with_heads
from sb3_flowpolicy.policies.on_policy import GaussActorCriticPolicy
from tests.distributions.conftest import CONTEXT_DIM, build

EVERY_DENSITY = pytest.mark.parametrize("distribution", registered_distributions())
#: The shape of these is exactly the identity. The others start with factors of gain 0.01.
IDENTITY = {"gaussian", "realnvp", "spline"}


class Reach(gym.Env[np.ndarray, np.ndarray]):
    """Three observations, four actions."""

    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Box(-1, 1, (4,))

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), float(action.sum()), False, False, {}


def build_pair(distribution: str, algorithm: Any = PPO, **policy_kwargs: Any) -> tuple[Any, Any]:
    """Build a stock model and ours from the same seed."""
    stock = algorithm("MlpPolicy", Reach(), seed=3, policy_kwargs=policy_kwargs)
    policy_kwargs = {**policy_kwargs, "distribution": distribution}
    ours = algorithm(GaussActorCriticPolicy, Reach(), seed=3, policy_kwargs=policy_kwargs)
    return stock.policy, ours.policy


@EVERY_DENSITY
@pytest.mark.parametrize("log_std_init", [0.0, -2.0])
@pytest.mark.parametrize("ortho_init", [True, False])
def test_it_starts_as_the_stock_policy(
    distribution: str, log_std_init: float, ortho_init: bool
) -> None:
    if distribution == "lattice" and not ortho_init:
        pytest.skip("the covariance of Lattice depends on the weights of the mean")
    stock, ours = build_pair(distribution, log_std_init=log_std_init, ortho_init=ortho_init)
    obs = th.randn(64, 3)
    theirs, mine = stock.get_distribution(obs), ours.get_distribution(obs)
    th.testing.assert_close(mine.mode(), theirs.mode(), rtol=0, atol=1e-6)
    action = theirs.sample()
    values, log_prob, entropy = stock.evaluate_actions(obs, action)
    found = ours.evaluate_actions(obs, action)
    th.testing.assert_close(found[0], values)
    atol = 1e-4 if distribution in IDENTITY else 0.3
    th.testing.assert_close(found[1], log_prob, rtol=0, atol=atol)
    th.testing.assert_close(found[2], entropy, rtol=0, atol=1e-4 if atol < 0.1 else 0.05)
    with th.no_grad():
        noise = mine.density.draw_noise(mine.context, 4000)
        samples, _ = mine.density.rsample_and_log_prob(mine.context, noise)
    expected = th.full((64, 4), float(np.exp(log_std_init)))
    th.testing.assert_close(samples.std(0), expected, rtol=0.08, atol=0)


@EVERY_DENSITY
@pytest.mark.parametrize("squash_output", [True, False])
@pytest.mark.parametrize("state_dependent_std", [True, False])
def test_gradients_reach_location_scale_and_shape(
    distribution: str, squash_output: bool, state_dependent_std: bool
) -> None:
    kwargs = {"squash_output": squash_output, "state_dependent_std": state_dependent_std}
    policy = PPO(
        GaussActorCriticPolicy, Reach(), policy_kwargs={"distribution": distribution, **kwargs}
    ).policy
    obs, action = th.randn(64, 3), th.rand(64, 4) * 1.8 - 0.9
    for _ in range(2):  # at the identity, gradients reach the last layers of a flow only
        policy.optimizer.zero_grad()
        _, log_prob, entropy = policy.evaluate_actions(obs, action)
        (log_prob * th.linspace(-1, 1, 64)).sum().add(entropy.mean()).backward()
        policy.optimizer.step()
    for name, parameter in policy.action_net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("distribution", ["gaussian", "low_rank", "realnvp"])
def test_a_state_dependent_scale_starts_at_log_std_init(distribution: str) -> None:
    kwargs = {"distribution": distribution, "log_std_init": -1.5, "state_dependent_std": True}
    model = PPO(GaussActorCriticPolicy, Reach(), policy_kwargs=kwargs, seed=0)
    density = model.policy.action_net
    log_std = density.log_std(th.randn(32, density.context_dim))
    th.testing.assert_close(log_std, th.full_like(log_std, -1.5), rtol=0, atol=0.1)
    assert log_std.std(0).min() > 0


@pytest.mark.parametrize("state_dependent_std", [True, False])
def test_options_survive_saving(tmp_path: Path, state_dependent_std: bool) -> None:
    kwargs = {"distribution": "realnvp", "log_std_init": -1.5, "squash_output": True}
    kwargs |= {"state_dependent_std": state_dependent_std, "ortho_init": False}
    model = PPO(GaussActorCriticPolicy, Reach(), n_steps=32, batch_size=32, policy_kwargs=kwargs)
    model.learn(64)
    model.policy.save(tmp_path / "policy")
    loaded = GaussActorCriticPolicy.load(tmp_path / "policy")
    assert loaded.squash_output
    assert loaded.log_std_init == -1.5
    assert loaded.state_dependent_std == state_dependent_std
    obs, action = th.randn(8, 3), th.rand(8, 4)
    with th.no_grad():
        expected = model.policy.evaluate_actions(obs, action)[1]
        assert th.equal(loaded.evaluate_actions(obs, action)[1], expected)


def behind_heads(name: str, dim: int, log_std: float = -0.7) -> ActionDistribution:
    """Give random weights to a density, a mean, and a log standard deviation."""
    density = with_heads(
        build(name, dim),
        nn.Linear(CONTEXT_DIM, dim),
        StateIndependent(nn.Parameter(th.full((dim,), log_std))),
    ).double()
    generator = th.Generator().manual_seed(8)
    with th.no_grad():
        for key, parameter in density.named_parameters():
            if key != "log_std.value":
                noise = th.randn(parameter.shape, dtype=th.float64, generator=generator)
                parameter.copy_(0.3 * noise)
    return density


@EVERY_DENSITY
@pytest.mark.parametrize("dim", [1, 2])
def test_density_integrates_to_one(distribution: str, dim: int) -> None:
    density = behind_heads(distribution, dim)
    axis = th.linspace(-12, 12, 2401 if dim == 1 else 481, dtype=th.float64)
    points = th.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    context = th.randn(CONTEXT_DIM, dtype=th.float64, generator=th.Generator().manual_seed(1))
    mass = density.log_prob(context, points).exp().sum() * (axis[1] - axis[0]) ** dim
    assert mass.item() == pytest.approx(1, abs=1e-3)


@EVERY_DENSITY
@pytest.mark.parametrize("dim", [1, 3])
def test_scores_samples_modes_and_entropies_agree(distribution: str, dim: int) -> None:
    density = behind_heads(distribution, dim)
    context = th.randn(7, CONTEXT_DIM, dtype=th.float64)
    noise = th.randn(20_000, 7, density.noise_dim, dtype=th.float64)
    with th.no_grad():
        sample, log_prob = density.rsample_and_log_prob(context, noise)
        th.testing.assert_close(density.log_prob(context, sample), log_prob, rtol=1e-8, atol=1e-6)
        at_zero, _ = density.rsample_and_log_prob(context, th.zeros_like(noise[0]))
        th.testing.assert_close(density.mode(context), at_zero)
        entropy = density.entropy(context)
    assert (entropy is None) == (type(density) is LocScale)
    if entropy is not None:
        error = log_prob.std(0) / len(noise) ** 0.5
        assert ((entropy + log_prob.mean(0)).abs() < 5 * error).all()


def test_the_entropy_of_a_location_and_scale_includes_that_of_the_shape() -> None:
    shape = build("low_rank", 3)
    density = LocScale(shape).double()
    context = th.randn(7, CONTEXT_DIM, dtype=th.float64)
    expected = shape.entropy(context) + density.log_std(context).sum(-1)
    th.testing.assert_close(density.entropy(context), expected)


class Logistic(ActionDistribution):
    """A density as a third party writes it: nothing in it concerns on-policy algorithms."""

    def __init__(self, action_dim: int, context_dim: int) -> None:
        super().__init__(action_dim, context_dim)
        self.loc = nn.Linear(context_dim, action_dim)

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        uniform = th.special.ndtr(noise)
        value = self.loc(context) + uniform.logit()
        return value, self._log_prob(context, value)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        distance = value - self.loc(context)
        return (-distance - 2 * nn.functional.softplus(-distance)).sum(-1)

    def _mode(self, context: th.Tensor) -> th.Tensor:
        return self.loc(context)


def test_any_density_starts_at_the_mean_of_stock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._REGISTRY, "logistic", Logistic)
    stock, ours = build_pair("logistic")
    obs = th.randn(8, 3)
    expected = stock.get_distribution(obs).mode()
    th.testing.assert_close(ours.get_distribution(obs).mode(), expected, rtol=0, atol=0.1)
    assert ours.evaluate_actions(obs, th.zeros(8, 4))[2].isfinite().all()
