"""Deterministic actions: the base mean, or the best of a fixed set of candidates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv

from sb3_flowpolicy import FlowPolicy, SACFlow
from sb3_flowpolicy.distributions import registered_distributions
from sb3_flowpolicy.policies import deterministic
from sb3_flowpolicy.policies.actor import FlowActor

FAST: dict[str, Any] = {"buffer_size": 200, "seed": 0, "device": "cpu"}
BOX = gym.spaces.Box(-1, 1, (4,), np.float32)


class Spaces(gym.Env):
    """Four observations and three actions with different bounds; never stepped."""

    observation_space = BOX
    action_space = gym.spaces.Box(np.float32(-2), np.float32([1, 2, 3]))


def make(algorithm: type[SAC] = SACFlow, **policy_kwargs: Any) -> SAC:
    """An agent with random weights, because the base mean of an identity flow is hard to beat."""
    kwargs = {"net_arch": [16, 16], **policy_kwargs}
    model = algorithm(FlowPolicy, Spaces(), policy_kwargs=kwargs, **FAST)
    th.manual_seed(3)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.copy_(th.randn_like(parameter) * 0.25)
    return model


def observations(count: int = 40) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, 4)).astype(np.float32)


def act(model: SAC, obs: Any, mode: str) -> np.ndarray:
    model.policy.deterministic_mode = mode  # type: ignore[assignment]
    return model.predict(obs, deterministic=True)[0]


def scaled(model: SAC, obs: np.ndarray, mode: str) -> th.Tensor:
    return th.as_tensor(model.policy.scale_action(act(model, obs, mode)))


def score(model: SAC, obs: np.ndarray, actions: th.Tensor, mode: str) -> th.Tensor:
    assert isinstance(model.actor, FlowActor)
    with th.no_grad():
        if mode == "log_prob":
            return model.actor.log_prob(th.as_tensor(obs), actions)
        return th.cat(model.critic(th.as_tensor(obs), actions), dim=1).amin(1)


@pytest.mark.parametrize("distribution", registered_distributions())
@pytest.mark.parametrize("mode", ["log_prob", "q"])
def test_best_of_the_candidates_is_taken(distribution: str, mode: str) -> None:
    model, obs = make(distribution=distribution), observations()
    chosen = score(model, obs, scaled(model, obs, mode), mode)
    base = score(model, obs, scaled(model, obs, "base"), mode)
    assert (chosen >= base - 1e-3).all()
    assert (chosen > base + 1e-2).any()
    # No other candidate is better when evaluated on its own.
    noise = deterministic.candidate_noise(64, model.actor.density.noise_dim)
    with th.no_grad():
        context = model.actor.context(th.as_tensor(obs))
        for one in noise:
            own = one.expand(len(obs), -1)
            actions, log_prob = model.actor.density.rsample_and_log_prob(context, own)
            other = log_prob if mode == "log_prob" else score(model, obs, actions, mode)
            assert (chosen >= other - 1e-2 * other.abs().clamp_min(1)).all()


@pytest.mark.parametrize("distribution", registered_distributions())
def test_base_is_the_mode_and_the_first_candidate(distribution: str) -> None:
    model, obs = make(distribution=distribution), observations()
    with th.no_grad():
        mode = model.actor(th.as_tensor(obs), deterministic=True)
        zero = th.zeros(len(obs), model.actor.density.noise_dim)
        first = model.actor(th.as_tensor(obs), noise=zero)
    np.testing.assert_allclose(scaled(model, obs, "base"), mode, atol=1e-6)
    np.testing.assert_allclose(first, mode, atol=1e-6)


@pytest.mark.parametrize("algorithm", [SAC, SACFlow])
@pytest.mark.parametrize("mode", ["log_prob", "q"])
def test_deterministic_means_deterministic(algorithm: type[SAC], mode: str, tmp_path: Path) -> None:
    model, obs = make(algorithm, deterministic_mode=mode, deterministic_samples=16), observations()
    th.manual_seed(1)
    first = model.predict(obs, deterministic=True)[0]
    drawn = th.rand(3)
    th.manual_seed(1)
    assert th.equal(th.rand(3), drawn)  # predict drew no random numbers
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], first)
    one_by_one = [model.predict(row, deterministic=True)[0] for row in obs]
    np.testing.assert_allclose(one_by_one, first, atol=1e-4)
    assert not np.array_equal(model.predict(obs)[0], model.predict(obs)[0])
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], first)
    model.policy.save(str(tmp_path / "policy"))
    policy = FlowPolicy.load(str(tmp_path / "policy"), device="cpu")
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], first)


@pytest.mark.parametrize("at_first", ["base", "log_prob"])
def test_a_mode_that_is_set_later_is_saved(at_first: str, tmp_path: Path) -> None:
    model = make(deterministic_mode=at_first)
    assert isinstance(model.policy, FlowPolicy)
    for mode in ("q", "base"):
        model.policy.deterministic_mode = mode
        model.save(tmp_path / "model")
        loaded = SACFlow.load(tmp_path / "model", device="cpu")
        assert loaded.policy.deterministic_mode == mode
        assert loaded.policy.deterministic_samples == 64


def test_many_observations_are_processed_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    model, obs = make(), observations()
    whole = act(model, obs, "q")
    monkeypatch.setattr(deterministic, "_MOST_AT_ONCE", 7 * 64)
    np.testing.assert_allclose(act(model, obs, "q"), whole, atol=1e-4)


@pytest.mark.parametrize("mode", ["log_prob", "q"])
@pytest.mark.parametrize(
    ("policy", "env"),
    [
        ("CnnFlowPolicy", lambda: FakeImageEnv(40, 40, n_channels=1, discrete=False)),
        (
            "MultiInputLowRankPolicy",
            lambda: SimpleMultiObsEnv(discrete_actions=False, random_start=False),
        ),
    ],
)
def test_images_and_dictionaries(policy: str, env: Any, mode: str) -> None:
    made = env()
    model = SACFlow(policy, made, policy_kwargs={"net_arch": [8]}, **FAST)
    obs = made.observation_space.sample()
    action = act(model, obs, mode)
    assert made.action_space.contains(action)
    np.testing.assert_array_equal(act(model, obs, mode), action)


def test_candidates_lie_like_standard_normals() -> None:
    for noise_dim in (1, 3, 10):
        noise = deterministic.candidate_noise(256, noise_dim)
        assert noise.shape == (256, noise_dim)
        assert (noise[0] == 0).all()
        assert noise[1:].mean(0).abs().max() < 0.05
        assert (noise[1:].std(0) - 1).abs().max() < 0.1


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"deterministic_mode": "mean"}, r"deterministic_mode must be one of .* got 'mean'"),
        ({"deterministic_mode": None}, r"deterministic_mode must be one of .* got None"),
        (
            {"deterministic_samples": 1},
            "deterministic_samples must be an integer .* got 1",
        ),
        ({"deterministic_samples": 2.5}, "deterministic_samples must be an integer .* got 2.5"),
    ],
)
def test_bad_settings(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_gsde_has_no_candidates() -> None:
    message = r"deterministic_mode must be one of \('base',\), got 'q'"
    with pytest.raises(ValueError, match=message):
        SACFlow(
            "GaussPolicy",
            Spaces(),
            use_sde=True,
            policy_kwargs={"deterministic_mode": "q"},
            **FAST,
        )
