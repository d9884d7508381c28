"""GaussPolicy is stock SAC: same start, same update, exchangeable checkpoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.logger import configure

from sb3_flowpolicy import GaussPolicy, SACFlow

SETTINGS = {"buffer_size": 500, "seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [32, 32]}}


def with_data(model: SAC, n_updates: int) -> SAC:
    """Fill the buffer with the same transitions, seed, and train."""
    rng = np.random.default_rng(0)
    assert model.replay_buffer is not None
    model.replay_buffer.reset()
    for _ in range(300):
        obs, next_obs = rng.normal(size=(2, 1, 3)).astype(np.float32)
        action, reward = rng.uniform(-1, 1, (1, 1)), rng.normal(size=1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.array([False]), [{}])
    model.set_logger(configure(None, []))
    th.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002 (SB3's buffers draw from the global state)
    model.train(n_updates, batch_size=64)
    return model


def exact_jacobian(model: SAC) -> None:
    """Stock SAC adds 1e-6 inside the log of the tanh Jacobian; ours is exact."""
    assert isinstance(model.actor.action_dist, SquashedDiagGaussianDistribution)
    model.actor.action_dist.epsilon = 0.0


def test_same_initial_weights() -> None:
    stock = SAC("MlpPolicy", "Pendulum-v1", **SETTINGS)
    ours = SAC(GaussPolicy, "Pendulum-v1", **SETTINGS)
    expected, got = stock.policy.state_dict(), ours.policy.state_dict()
    assert got.keys() == expected.keys()
    for key, value in expected.items():
        assert th.equal(got[key], value), key


@pytest.mark.parametrize("ent_coef", ["auto", 0.1])
@pytest.mark.parametrize("weight_decay", [0.0, 2.5e-4])
def test_same_first_update(ent_coef: str | float, weight_decay: float) -> None:
    policy_kwargs = {"net_arch": [32, 32], "optimizer_kwargs": {"weight_decay": weight_decay}}
    settings = {**SETTINGS, "policy_kwargs": policy_kwargs, "ent_coef": ent_coef}
    stock = SAC("MlpPolicy", "Pendulum-v1", **settings)
    ours = SAC(GaussPolicy, "Pendulum-v1", **settings)
    before = {key: value.clone() for key, value in stock.policy.state_dict().items()}
    exact_jacobian(stock)
    with_data(stock, 1)
    with_data(ours, 1)
    for key, value in stock.policy.state_dict().items():
        got = ours.policy.state_dict()[key]
        th.testing.assert_close(got, value, rtol=1e-5, atol=1e-6, msg=key)
    after = ours.policy.state_dict()
    assert all(not th.equal(after[key], value) for key, value in before.items())
    for key in ("train/actor_loss", "train/critic_loss", "train/ent_coef"):
        expected = stock.logger.name_to_value[key]
        assert ours.logger.name_to_value[key] == pytest.approx(expected, rel=1e-5), key


def test_stock_epsilon_changes_an_update_by_less_than_its_own_size() -> None:
    """Unmodified stock SAC, with its epsilon, has the same losses up to 1e-4."""
    stock = with_data(SAC("MlpPolicy", "Pendulum-v1", **SETTINGS), 1)
    ours = with_data(SAC(GaussPolicy, "Pendulum-v1", **SETTINGS), 1)
    for key in ("train/actor_loss", "train/critic_loss"):
        expected = stock.logger.name_to_value[key]
        assert ours.logger.name_to_value[key] == pytest.approx(expected, rel=1e-4), key


@pytest.mark.parametrize("direction", ["stock to ours", "ours to stock"])
def test_checkpoints_are_exchanged(tmp_path: Path, direction: str) -> None:
    stock = SAC("MlpPolicy", "Pendulum-v1", **SETTINGS)
    ours = SACFlow("GaussPolicy", "Pendulum-v1", **{**SETTINGS, "seed": 1})
    source, target = (stock, ours) if direction == "stock to ours" else (ours, stock)
    with_data(source, 2)
    source.save(tmp_path / "model")
    target.set_parameters(str(tmp_path / "model.zip"))
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.testing.assert_array_equal(
        target.predict(obs, deterministic=True)[0], source.predict(obs, deterministic=True)[0]
    )
    # The optimizer state was exchanged, too, so the next update is the same. Adam turns the
    # rounding of a gradient near zero into a fraction of a step (3e-4); without its state the steps
    # would differ completely.
    exact_jacobian(stock)
    with_data(source, 1)
    with_data(target, 1)
    for key, value in source.policy.state_dict().items():
        got = target.policy.state_dict()[key]
        th.testing.assert_close(got, value, rtol=1e-5, atol=3e-5, msg=key)


def test_gsde_is_left_to_sb3() -> None:
    model = SAC(GaussPolicy, "Pendulum-v1", use_sde=True, learning_starts=5, seed=0).learn(20)
    assert model.actor.get_std().isfinite().all()
