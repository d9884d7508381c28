"""The TensorBoard callback logs what it documents and does not change the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import VecNormalize

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.diagnostics import PolicyDiagnosticsCallback

event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

FAST: dict[str, Any] = {
    "learning_starts": 50,
    "buffer_size": 500,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16, 16]},
}
FREQUENT = {"log_freq": 50, "image_freq": 100, "n_states": 32, "n_samples": 32}


def events(folder: Path) -> Any:
    accumulator = event_accumulator.EventAccumulator(
        str(folder), size_guidance={"tensors": 0, "images": 0, "scalars": 0}
    )
    return accumulator.Reload()


def test_numbers_pictures_and_dashboard_are_logged(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", "TunnelDiagonal-v0", tensorboard_log=str(tmp_path), **FAST)
    model.learn(300, callback=PolicyDiagnosticsCallback(**FREQUENT))
    log = events(tmp_path / "SAC_1")
    scalars = log.Tags()["scalars"]
    for key in (
        "policy/entropy",
        "policy/scale_0",
        "policy/scale_1",
        "policy/mean_abs_correlation",
        "value/q_policy",
        "value/q_buffer",
        "train/ent_coef",
        "rollout/ep_rew_mean",
        "rollout/success_rate",
    ):
        assert key in scalars, key
        assert all(np.isfinite(event.value) for event in log.Scalars(key)), key
    assert {"policy/correlation", "policy/samples"} <= set(log.Tags()["images"])
    assert "custom_scalars__config__" in log.Tags()["tensors"]
    # The policy starts as tanh of a standard normal: known entropy and spread.
    first = log.Scalars("policy/entropy")[0]
    assert first.value == pytest.approx(2 * 0.64, abs=0.15)
    assert log.Scalars("policy/scale_0")[0].value == pytest.approx(0.63, abs=0.08)


def test_one_action_has_no_correlation_to_draw(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", "Pendulum-v1", tensorboard_log=str(tmp_path), **FAST)
    model.learn(420, log_interval=1, callback=PolicyDiagnosticsCallback(**FREQUENT))
    log = events(tmp_path / "SAC_1")
    assert "policy/entropy" in log.Tags()["scalars"]
    assert "policy/mean_abs_correlation" not in log.Tags()["scalars"]
    assert log.Tags()["images"] == []


@pytest.mark.parametrize("policy", ["GaussPolicy", "LowRankPolicy", "FlowPolicy"])
def test_measuring_does_not_change_the_run(policy: str) -> None:
    def train(callback: PolicyDiagnosticsCallback | None) -> th.Tensor:
        model = SACFlow(policy, "TunnelDiagonal-v0", **FAST).learn(250, callback=callback)
        return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach()

    assert th.equal(train(None), train(PolicyDiagnosticsCallback(**FREQUENT)))


def test_normalized_and_dictionary_observations() -> None:
    env = VecNormalize(make_vec_env("TunnelDiagonal-v0", n_envs=3, seed=0))
    SACFlow("FlowPolicy", env, **FAST).learn(200, callback=PolicyDiagnosticsCallback(**FREQUENT))
    multi = SimpleMultiObsEnv(discrete_actions=False, random_start=False)
    settings = {**FAST, "learning_starts": 5, "batch_size": 4}
    callback = PolicyDiagnosticsCallback(log_freq=5, n_states=4)
    model = SACFlow("MultiInputFlowPolicy", multi, **settings).learn(11, callback=callback)
    assert "policy/entropy" in model.logger.name_to_value


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"log_freq": 0}, "log_freq must be an integer of at least 1, got 0"),
        ({"image_freq": -1}, "image_freq must be an integer of at least 0, got -1"),
        ({"n_states": 0}, "n_states must be an integer of at least 1, got 0"),
        ({"n_samples": 1}, "n_samples must be an integer of at least 2, got 1"),
    ],
)
def test_bad_arguments(argument: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PolicyDiagnosticsCallback(**argument)


def test_nothing_is_recorded_with_gsde() -> None:
    """The settings of rl_zoo3 name the callback for every policy."""
    model = SACFlow("GaussPolicy", "Pendulum-v1", use_sde=True, **FAST)
    with pytest.warns(UserWarning, match="records nothing with gSDE"):
        model.learn(60, callback=PolicyDiagnosticsCallback(log_freq=10, image_freq=10))
    assert not [key for key in model.logger.name_to_value if key.startswith(("policy/", "value/"))]


def test_stock_policies_are_refused() -> None:
    model = SAC("MlpPolicy", "Pendulum-v1", **FAST)
    with pytest.raises(
        ValueError, match="needs a policy of sb3_flowpolicy, off-policy, got SACPolicy"
    ):
        model.learn(10, callback=PolicyDiagnosticsCallback())
