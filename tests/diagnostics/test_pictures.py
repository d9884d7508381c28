"""Success rates and pictures of policies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.diagnostics import (
    correlation_figure,
    evaluate_success,
    rollout_figure,
    samples_figure,
)

pytest.importorskip("matplotlib")


class Constant:
    """A stand-in for a model: always the same action."""

    def __init__(self, *action: float) -> None:
        self.action = np.array(action, dtype=np.float32)

    def predict(self, obs: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return np.repeat(self.action[None], len(obs), axis=0), None


@pytest.fixture
def env() -> VecEnv:
    return make_vec_env(
        "TunnelDiagonal-v0", n_envs=1, env_kwargs={"render_mode": "rgb_array", "render_size": 64}
    )


def test_success_is_counted(env: VecEnv) -> None:
    success, mean_return = evaluate_success(Constant(1.0, 1.0), env, 5)  # type: ignore[arg-type]
    assert (success, mean_return) == (1.0, 1.0)
    success, mean_return = evaluate_success(Constant(1.0, -1.0), env, 5)  # type: ignore[arg-type]
    assert success == 0.0
    assert mean_return == pytest.approx(-0.1)


def test_success_must_be_reported() -> None:
    with pytest.raises(KeyError, match="is_success"):
        evaluate_success(Constant(0.0), make_vec_env("Pendulum-v1"), 1)  # type: ignore[arg-type]


def test_rollout_is_drawn_with_samples(env: VecEnv) -> None:
    model = SACFlow("FlowPolicy", env, seed=0)
    model.predict = Constant(1.0, 1.0).predict  # type: ignore[method-assign]
    figure = rollout_figure(model, env, n_panels=3, n_samples=20)
    assert [axes.get_title() for axes in figure.axes] == ["step 0", "step 3", "step 6"]
    frames = [axes.images[0].get_array() for axes in figure.axes]
    assert not np.array_equal(frames[0], frames[1])


def test_rollout_needs_one_environment_that_draws() -> None:
    model: Any = Constant(1.0, 1.0)
    with pytest.raises(ValueError, match="too many values to unpack"):
        rollout_figure(model, make_vec_env("TunnelDiagonal-v0", n_envs=2))
    with pytest.raises(AttributeError, match="set_action_samples"):
        rollout_figure(model, make_vec_env("Pendulum-v1"))


def test_figures_show_what_they_are_given() -> None:
    correlation = np.array([[1.0, -0.7], [-0.7, 1.0]])
    axes = correlation_figure(correlation).axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), np.abs(correlation))
    assert [text.get_text() for text in axes.texts] == ["1.00", "0.70", "0.70", "1.00"]
    samples = np.random.default_rng(0).uniform(-1, 1, (3, 10, 2))
    figure = samples_figure(samples)
    assert len(figure.axes) == 3
    np.testing.assert_allclose(figure.axes[1].collections[0].get_offsets(), samples[1])


def test_samples_must_be_two_dimensional() -> None:
    with pytest.raises(ValueError, match="too many values to unpack"):
        samples_figure(np.zeros((3, 10, 3)))
