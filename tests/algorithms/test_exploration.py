"""Colored noise while collecting: the same actions at a fixed state, another way to go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.envs.classic_control import PendulumEnv as Pendulum
from scipy import stats
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow, SeedBatch

FAST: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [16, 16]},
    "random_steps": 10,
    "batch_size": 16,
    "buffer_size": 2000,
    "seed": 0,
    "learning_starts": 10_000,
}
# Densities without a policy class stand under their names.
POLICIES = pytest.mark.parametrize(
    "policy", ["GaussPolicy", "LowRankPolicy", "FlowPolicy", "lattice", "spline"]
)


def fixed_state(policy: str, n_envs: int = 1, **kwargs: Any) -> SACFlow:
    """A model about to act, at one state, with weights off their initial values."""
    if not policy.endswith("Policy"):
        kwargs["policy_kwargs"] = {**FAST["policy_kwargs"], "distribution": policy}
        policy = "FlowPolicy"
    model = SACFlow(policy, make_vec_env("TunnelDiagonal-v0", n_envs), **(FAST | kwargs))
    th.manual_seed(1)
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.add_(0.2 * th.randn_like(parameter))
    model.learn(max(12, 4 * n_envs))
    model._last_obs = np.tile(np.float32([0.1, 0.2]), (n_envs, 1))
    return model


def act(model: SACFlow, steps: int) -> np.ndarray:
    """Scaled actions (steps, N, 2), without moving."""
    n_envs = model.n_envs
    return np.stack([model._sample_action(0, n_envs=n_envs)[1] for _ in range(steps)])


@POLICIES
@pytest.mark.parametrize(
    "color", [{"action_noise_color": 1.0}, {"action_noise_correlation_time": 8.0}]
)
def test_at_a_fixed_state_actions_are_distributed_as_ever(
    policy: str, color: dict[str, float]
) -> None:
    white, colored = fixed_state(policy, 500), fixed_state(policy, 500, **color)
    colored.actor.load_state_dict(white.actor.state_dict())
    assert colored._exploration.process is not None
    colored._exploration.process.restart()
    (first, *_, last), (reference,) = act(colored, 6), act(white, 1)
    along = np.array([[1, 0], [0, 1], [1, 1], [1, -1]]).T
    for actions in (first, last):
        for mine, theirs in zip((actions @ along).T, (reference @ along).T, strict=True):
            assert stats.ks_2samp(mine, theirs).pvalue > 1e-3
    # Independent from one environment to the next, but not from one step to the next.
    assert np.corrcoef(first[:, 0], last[:, 0])[0, 1] > 0.1
    assert abs(np.corrcoef(first[:-1, 0], first[1:, 0])[0, 1]) < 0.15


def test_a_new_episode_begins_without_a_past() -> None:
    model = fixed_state("GaussPolicy", 3, action_noise_correlation_time=1e6)
    before = act(model, 2)
    np.testing.assert_allclose(before[0], before[1], atol=1e-2)
    obs = model._last_obs
    assert isinstance(obs, np.ndarray)
    assert model.replay_buffer is not None
    dones = np.array([False, True, False])
    infos: list[dict[str, Any]] = [{"terminal_observation": obs[0]} for _ in dones]
    model._store_transition(model.replay_buffer, before[1], obs, np.zeros(3), dones, infos)
    after = act(model, 1)[0]
    np.testing.assert_allclose(after[[0, 2]], before[1][[0, 2]], atol=1e-2)
    assert abs(after[1] - before[1][1]).max() > 1e-2


def test_compiled_or_not_the_actions_are_the_same() -> None:
    found = []
    for compiled in (False, True):
        model = fixed_state("FlowPolicy", action_noise_color=0.5)
        with model._runtime.running():
            if compiled:  # takes the engine's path, whose function stays eager
                engine = model._runtime.engine()
                assert engine is not None
                engine.compiled = True
            th.manual_seed(5)
            found.append(act(model, 3))
    np.testing.assert_allclose(*found, rtol=1e-5, atol=1e-6)


def test_a_loaded_model_goes_on_with_the_same_process(tmp_path: Path) -> None:
    model = fixed_state("GaussPolicy", action_noise_correlation_time=1e6)
    before = act(model, 1)
    model.save(tmp_path / "model")
    loaded = SACFlow.load(tmp_path / "model", env=model.env, force_reset=False)
    assert loaded.action_noise_correlation_time == 1e6
    loaded._last_obs = model._last_obs
    np.testing.assert_allclose(act(loaded, 1), before, atol=1e-2)


def test_a_resumed_batch_is_the_undisturbed_one(tmp_path: Path) -> None:
    settings = FAST | {"learning_starts": 10, "action_noise_color": 1.0}
    del settings["seed"]

    def new() -> SeedBatch:
        return SeedBatch("FlowPolicy", "TunnelDiagonal-v0", [3, 4], **settings)

    calm, path = new().learn(80), tmp_path / "checkpoints"
    new().learn(45, checkpoint_every=15, checkpoint_path=path)
    # The last checkpoint is that of the end.
    resumed = SeedBatch.resume(path, "TunnelDiagonal-v0").learn(80)
    for mine, theirs in zip(resumed.models, calm.models, strict=True):
        assert mine.replay_buffer is not None
        assert theirs.replay_buffer is not None
        np.testing.assert_array_equal(mine.replay_buffer.actions, theirs.replay_buffer.actions)
        vectors = (model.policy.parameters_to_vector() for model in (mine, theirs))
        np.testing.assert_array_equal(*vectors)


def test_a_batch_explores_in_the_same_way() -> None:
    settings = {key: value for key, value in FAST.items() if key != "seed"}
    batch = SeedBatch(
        "GaussPolicy", "TunnelDiagonal-v0", 2, action_noise_correlation_time=1e6, **settings
    ).learn(200)
    buffer = batch.models[0].replay_buffer
    assert buffer is not None
    actions, ends = buffer.actions[10:200, 0], buffer.dones[10:200, 0].astype(bool)
    steps = np.abs(np.diff(actions, axis=0)).max(1)
    # Within an episode only the state moves the action; between two of them the noise is new.
    assert np.median(steps[ends[:-1]]) > 5 * np.median(steps[~ends[:-1]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"action_noise_color": -1}, "action_noise_color must be"),
        ({"action_noise_color": "pink"}, "action_noise_color must be"),
        (
            {"action_noise_correlation_time": 0.0},
            "action_noise_correlation_time must be None or above 0",
        ),
        (
            {"action_noise_color": 1.0, "action_noise_correlation_time": 3.0},
            "action_noise_color must be 0 where action_noise_correlation_time is given",
        ),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SACFlow("FlowPolicy", "Pendulum-v1", **arguments)


def test_gsde_has_noise_of_its_own() -> None:
    with pytest.raises(ValueError, match="action_noise_color must be 0 unless the policy is one"):
        SACFlow("GaussPolicy", "Pendulum-v1", use_sde=True, action_noise_color=1.0)


def decays(model: SACFlow) -> int:
    """Number of the process's components: it tells processes of different settings apart."""
    assert model._exploration.process is not None
    return model._exploration.process.white_shape[1]


def test_settings_that_change_change_the_process(tmp_path: Path) -> None:
    model = SACFlow("GaussPolicy", "TunnelDiagonal-v0", **FAST, action_noise_color=1.0).learn(12)
    first, pink = model._exploration.process, decays(model)
    model.learn(4, reset_num_timesteps=False)
    assert model._exploration.process is first
    model.set_env(gym.make("TunnelDiagonal-v0", max_episode_steps=4000))
    model.learn(4, reset_num_timesteps=False)
    assert decays(model) > pink
    model.action_noise_color = 0.0
    model.learn(4, reset_num_timesteps=False)
    assert model._exploration.process is None
    model.action_noise_correlation_time = 5.0
    model.learn(4, reset_num_timesteps=False)
    assert decays(model) == 1
    model.save(tmp_path / "model")
    changes = {"action_noise_correlation_time": None, "action_noise_color": 1.0}
    loaded = SACFlow.load(tmp_path / "model", env=model.get_env(), **changes)
    loaded.learn(4, reset_num_timesteps=False)
    assert decays(loaded) > pink
    with pytest.raises(ValueError, match=r"action_noise_color must be at most 1.5, got 99"):
        SACFlow.load(tmp_path / "model", action_noise_color=99.0)


def test_settings_of_a_batch_can_change() -> None:
    settings = {name: value for name, value in FAST.items() if name != "seed"}
    batch = SeedBatch("GaussPolicy", "TunnelDiagonal-v0", 2, **settings)
    batch.learn(12)
    exploration, noise = batch._experience._exploration, batch._experience._noise
    assert exploration.process is None
    updates = noise["updates"]
    for model in batch.models:
        model.action_noise_color = 1.0
    batch.learn(4, reset_num_timesteps=False)
    assert batch._experience._exploration.process is not None
    assert (
        batch._experience._noise["actions"].shape
        == batch._experience._exploration.process.white_shape[1:]
    )
    assert batch._experience._noise["updates"] is updates  # it continues with its numbers
    for model in batch.models:
        model.action_noise_color = 0.0
    batch.learn(4, reset_num_timesteps=False)
    assert exploration.process is None


def test_processes_need_not_send_their_spec() -> None:
    """A spec with a lambda in it cannot be pickled."""
    gym.register("Unsendable-v0", lambda: Pendulum(), max_episode_steps=40)
    try:
        env = make_vec_env(
            "Unsendable-v0",
            2,
            vec_env_cls=SubprocVecEnv,
            vec_env_kwargs={"start_method": "fork"},  # which knows what was registered
        )
        model = SACFlow("GaussPolicy", env, **FAST, action_noise_color=1.0).learn(12)
        env.close()
        reference = SACFlow("GaussPolicy", "TunnelDiagonal-v0", **FAST, action_noise_color=1.0)
        assert decays(model) == decays(reference.learn(12))  # also cut after 40 steps
    finally:
        del gym.registry["Unsendable-v0"]
