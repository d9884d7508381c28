"""TQCFlow and CrossQFlow: policies by name, directed exploration, runs that can be resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.envs import SimpleMultiObsEnv

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import CrossQFlow, FlowActorCriticPolicy, FlowPolicy, PPOFlow, SACFlow, TQCFlow
from sb3_flowpolicy.diagnostics import PolicyDiagnosticsCallback
from tests.checkpoint.test_resume import BreakAt, BrokenError

ENV = "TunnelDiagonal-v0"
OFF_POLICY: Any = pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow])


def make(algorithm: Any, policy: str = "FlowPolicy", **kwargs: Any) -> Any:
    settings = {"learning_starts": 20, "batch_size": 16, "buffer_size": 300, "seed": 0}
    settings |= {"policy_kwargs": {"net_arch": [16, 16]}, "device": "cpu"} | kwargs
    return algorithm(policy, ENV, **settings)


@OFF_POLICY
def test_a_broken_run_goes_on_bit_for_bit(algorithm: Any, tmp_path: Path) -> None:
    """The colored noise, and CrossQ's batch renormalization, are part of what is resumed."""
    settings: Any = {"action_noise_color": 1.0, "ent_coef": "auto"}
    th.manual_seed(0)
    calm = make(algorithm, **settings).learn(90)
    th.manual_seed(0)
    broken = make(algorithm, **settings)
    with pytest.raises(BrokenError):
        broken.learn(90, BreakAt(67), checkpoint_every=20, checkpoint_path=tmp_path)
    th.manual_seed(1)
    resumed = algorithm.resume(tmp_path, ENV, device="cpu")
    assert resumed.num_timesteps == 60
    resumed.learn(90)
    expected, found = calm.policy.state_dict(), resumed.policy.state_dict()
    assert expected.keys() == found.keys()
    assert not [name for name, value in expected.items() if not th.equal(value, found[name])]
    np.testing.assert_array_equal(calm.replay_buffer.actions, resumed.replay_buffer.actions)


@OFF_POLICY
def test_color_changes_exploration_and_is_saved(algorithm: Any, tmp_path: Path) -> None:
    white, pink = (make(algorithm, action_noise_color=color).learn(60) for color in (0.0, 1.0))
    assert not np.array_equal(white.replay_buffer.actions, pink.replay_buffer.actions)
    pink.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model").action_noise_color == 1.0


@OFF_POLICY
def test_a_deterministic_mode_that_is_set_later_is_saved(algorithm: Any, tmp_path: Path) -> None:
    model = make(algorithm)
    model.policy.deterministic_mode = "q"
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model").policy.deterministic_mode == "q"


@OFF_POLICY
def test_values_in_the_diagnostics_are_the_critics(algorithm: Any) -> None:
    model = make(algorithm)
    model.learn(60, PolicyDiagnosticsCallback(log_freq=60, image_freq=0))
    logged = model.logger.name_to_value
    assert np.isfinite([logged["value/q_policy"], logged["value/q_buffer"]]).all()
    data = model.replay_buffer.sample(2000)
    model.policy.set_training_mode(False)
    with th.no_grad():
        values = model.critic(data.observations, data.actions)
    mean = values.mean() if algorithm is TQCFlow else th.cat(values).mean()
    assert logged["value/q_buffer"] == pytest.approx(mean.item(), abs=0.1)


@pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow, PPOFlow])
def test_names_of_policies(algorithm: Any) -> None:
    settings = {} if algorithm is not PPOFlow else {"n_steps": 32}
    for name, policy in algorithm.policy_aliases.items():
        if name.startswith(("Cnn", "MultiInput")):
            continue
        assert type(algorithm(name, ENV, device="cpu", **settings).policy) is policy
    with pytest.raises(ValueError, match=r"must be one of .*'LowRankPolicy'.* got 'NoPolicy'"):
        algorithm("NoPolicy", ENV)


@OFF_POLICY
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gamma": "high"}, "gamma must be a number, got 'high'"),
        ({"batch_size": 0}, "batch_size must be an integer of at least 1, got 0"),
        ({"ent_coef": "aut"}, 'ent_coef must be a number, "auto"'),
        ({"action_noise_color": 2.0}, "action_noise_color must be"),
        ({"policy": "stock", "action_noise_color": 1.0}, "one of sb3_flowpolicy's"),
        ({"ent_coef": -1.0}, "ent_coef must be at least 0, got -1.0"),
        ({"learning_rate": -1.0}, "learning_rate must be a function or at least 0, got -1.0"),
        ({"policy": FlowPolicy}, "one of .* got the class FlowPolicy of another algorithm; pass"),
        ({"policy": FlowActorCriticPolicy}, "policy must be one of .* got FlowActorCriticPolicy"),
        ({"policy_kwargs": {"n_critics": 0}}, "n_critics must be an integer of at least 1, got 0"),
    ],
)
def test_bad_arguments(algorithm: Any, arguments: dict[str, Any], message: str) -> None:
    if arguments.get("policy") == "stock":
        theirs = TQC if algorithm is TQCFlow else CrossQ
        arguments = {**arguments, "policy": theirs.policy_aliases["MlpPolicy"]}
    with pytest.raises(ValueError, match=message):
        make(algorithm, **arguments)


def test_bad_arguments_of_one_algorithm() -> None:
    for dropped in (25, 99):
        with pytest.raises(ValueError, match=f"less than n_quantiles .* got {dropped} of 25"):
            make(TQCFlow, top_quantiles_to_drop_per_net=dropped)
    with pytest.raises(ValueError, match="top_quantiles_to_drop_per_net must be an integer of at"):
        make(TQCFlow, top_quantiles_to_drop_per_net=1.5)
    with pytest.raises(ValueError, match="n_quantiles must be an integer of at least 1, got 0"):
        make(TQCFlow, policy_kwargs={"n_quantiles": 0})
    with pytest.raises(ValueError, match="policy_delay must be an integer of at least 1, got 0"):
        make(CrossQFlow, policy_delay=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_steps": 2.5}, "n_steps must be an integer of at least 1, got 2.5"),
        ({"n_epochs": 0}, "n_epochs must be an integer of at least 1, got 0"),
        ({"gamma": 2}, "gamma must be at most 1, got 2"),
        ({"clip_range": 0.0}, "clip_range must be a function or above 0, got 0.0"),
        ({"clip_range_vf": "a"}, "clip_range_vf must be None or a function or a number, got 'a'"),
        ({"target_kl": -1.0}, "target_kl must be None or above 0, got -1.0"),
        ({"ent_coef": "auto"}, "ent_coef must be a number, got 'auto'"),
        ({"learning_rate": "a"}, "learning_rate must be a function or a number, got 'a'"),
        ({"seed": "a"}, "seed must be None or an integer"),
        ({"policy_kwargs": 5}, "policy_kwargs must be None or a dict"),
        ({"policy": TQC.policy_aliases["MlpPolicy"]}, "policy must be one of .* got TQCPolicy"),
    ],
)
def test_bad_arguments_of_ppo(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PPOFlow(**{"policy": "FlowPolicy", "env": ENV, "n_steps": 32, **arguments})


def test_good_arguments_of_ppo() -> None:
    """What SB3 takes, ours takes."""
    PPOFlow("FlowPolicy", ENV, n_steps=32, clip_range=lambda left: 0.2 * left, target_kl=None)
    PPOFlow("FlowPolicy", ENV, n_steps=32, max_grad_norm=float("inf"), verbose=False)
    PPOFlow(
        "FlowPolicy",
        ENV,
        n_steps=np.int64(32),
        normalize_advantage=np.bool_(True),
        policy_kwargs={"net_arch": {"pi": [np.int64(4)], "vf": []}},
    )
    with pytest.warns(UserWarning, match="directly a dictionary"):
        PPOFlow("FlowPolicy", ENV, n_steps=32, policy_kwargs={"net_arch": [{"pi": [4], "vf": [4]}]})


@pytest.mark.parametrize("algorithm", [SACFlow, TQCFlow, CrossQFlow, PPOFlow])
def test_policies_of_other_observations(algorithm: Any) -> None:
    with pytest.raises(ValueError, match=r"observation_space must not be a Dict .* MultiInput"):
        algorithm("FlowPolicy", SimpleMultiObsEnv(discrete_actions=False))
    if algorithm is not CrossQFlow:
        with pytest.raises(ValueError, match="observation_space must be a Dict for Combined"):
            algorithm("MultiInputFlowPolicy", ENV)
