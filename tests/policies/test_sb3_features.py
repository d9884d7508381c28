"""The features that SB3 documents for SAC policies, with ours."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy import SACFlow, distributions, policies
from sb3_flowpolicy.distributions import registered_distributions

MLP = ("GaussPolicy", "LowRankPolicy", "FlowPolicy")
FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 200,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
}
NET = {"net_arch": [16, 16]}


class MatrixActions(gym.Env):
    """Actions of shape (2, 3) with asymmetric bounds."""

    observation_space = spaces.Box(-1, 1, (4,), np.float32)
    action_space = spaces.Box(np.float32(0), np.arange(1, 7, dtype=np.float32).reshape(2, 3))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 4).astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple:
        obs = self.np_random.uniform(-1, 1, 4).astype(np.float32)
        return obs, float(-np.square(action).sum()), False, bool(self.np_random.random() < 0.1), {}


class NoisyExtractor(BaseFeaturesExtractor):
    """Behaves differently in training and evaluation mode."""

    def __init__(self, observation_space: spaces.Box, dropout: float = 0.5) -> None:
        super().__init__(observation_space, features_dim=8)
        self.net = th.nn.Sequential(
            th.nn.Linear(observation_space.shape[0], 8),
            th.nn.BatchNorm1d(8),
            th.nn.Dropout(dropout),
        )

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.net(obs)


def parameters_finite(model: SAC) -> bool:
    return all(p.isfinite().all() for p in model.policy.parameters())


@pytest.mark.parametrize("policy", MLP)
def test_predict_shapes_and_bounds(policy: str) -> None:
    env = MatrixActions()
    model = SACFlow(policy, env, policy_kwargs=NET, **FAST).learn(30)
    obs = np.stack([env.observation_space.sample() for _ in range(7)])
    for deterministic in (True, False):
        one, _ = model.predict(obs[0], deterministic=deterministic)
        many, _ = model.predict(obs, deterministic=deterministic)
        assert one.shape == (2, 3)
        assert many.shape == (7, 2, 3)
        assert env.action_space.contains(one)
        assert all(env.action_space.contains(action) for action in many)


@pytest.mark.parametrize("policy", MLP)
@pytest.mark.parametrize(
    "settings",
    [
        {"n_steps": 3},
        {"policy_kwargs": {**NET, "n_critics": 3}},
        {"policy_kwargs": {**NET, "share_features_extractor": True}},
        {"policy_kwargs": {"net_arch": {"pi": [4], "qf": [16, 16]}, "activation_fn": th.nn.Tanh}},
        {"policy_kwargs": {"net_arch": []}},
        {"policy_kwargs": {**NET, "optimizer_class": th.optim.AdamW}},
        {"train_freq": (1, "episode"), "gradient_steps": -1},
        {"ent_coef": "auto_0.1", "target_entropy": -0.5},
    ],
    ids=lambda settings: "-".join(str(value) for value in settings.values())[:40],
)
def test_trains_with(policy: str, settings: dict) -> None:
    env = gym.make("Pendulum-v1", max_episode_steps=20)
    model = SACFlow(policy, env, **{"policy_kwargs": NET, **FAST, **settings})
    before = th.nn.utils.parameters_to_vector(model.actor.parameters()).clone()
    model.learn(50)
    assert parameters_finite(model)
    assert not th.equal(th.nn.utils.parameters_to_vector(model.actor.parameters()), before)


@pytest.mark.parametrize("policy", ["CnnGaussPolicy", "CnnLowRankPolicy", "CnnFlowPolicy"])
@pytest.mark.parametrize("share", [False, True])
def test_images(policy: str, share: bool) -> None:
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    kwargs = {**NET, "features_extractor_kwargs": {"features_dim": 8}}
    kwargs["share_features_extractor"] = share
    model = SACFlow(policy, env, policy_kwargs=kwargs, **FAST).learn(14)
    assert parameters_finite(model)
    assert model.predict(env.observation_space.sample())[0].shape == env.action_space.shape


@pytest.mark.parametrize(
    "policy", ["MultiInputGaussPolicy", "MultiInputLowRankPolicy", "MultiInputFlowPolicy"]
)
def test_dictionaries(policy: str) -> None:
    env = SimpleMultiObsEnv(discrete_actions=False, random_start=False)
    kwargs = {**NET, "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = SACFlow(policy, env, policy_kwargs=kwargs, **FAST).learn(14)
    assert parameters_finite(model)


@pytest.mark.parametrize(
    "policy", ["MultiInputGaussPolicy", "MultiInputLowRankPolicy", "MultiInputFlowPolicy"]
)
def test_hindsight_experience_replay(policy: str) -> None:
    model = SACFlow(
        policy,
        BitFlippingEnv(n_bits=3, continuous=True),
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs=NET,
        **FAST,
    )
    assert parameters_finite(model.learn(40))


@pytest.mark.parametrize("policy", MLP)
def test_several_normalized_environments(policy: str) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=3, seed=0))
    model = SACFlow(policy, env, policy_kwargs=NET, **FAST).learn(60)
    assert parameters_finite(model)
    assert model.predict(env.reset())[0].shape == (3, 1)


@pytest.mark.parametrize("policy", MLP)
def test_seeds_reproduce(policy: str) -> None:
    def train(seed: int) -> np.ndarray:
        settings = {**FAST, "seed": seed}
        return (
            SACFlow(policy, "Pendulum-v1", policy_kwargs=NET, **settings)
            .learn(40)
            .policy.parameters_to_vector()
        )

    first = train(0)
    assert np.array_equal(first, train(0))
    assert not np.array_equal(first, train(1))


def test_training_and_evaluation_mode() -> None:
    kwargs = {**NET, "features_extractor_class": NoisyExtractor}
    model = SACFlow("FlowPolicy", "Pendulum-v1", policy_kwargs=kwargs, **FAST).learn(30)
    obs = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    first, _ = model.predict(obs, deterministic=True)
    assert np.array_equal(first, model.predict(obs, deterministic=True)[0])
    assert not model.actor.training
    model.policy.set_training_mode(True)
    with th.no_grad():
        noisy = [model.actor(th.as_tensor(obs), deterministic=True) for _ in range(2)]
    assert not th.equal(*noisy)


def test_policy_aliases_name_their_class() -> None:
    for name, policy_class in SACFlow.policy_aliases.items():
        same = {"MlpPolicy": "FlowPolicy", "CnnPolicy": "CnnFlowPolicy"}
        same["MultiInputPolicy"] = "MultiInputFlowPolicy"
        assert policy_class.__name__ == same.get(name, name)
        assert getattr(policies, policy_class.__name__) is policy_class


# Other than default arguments, for the densities that have arguments.
UNUSUAL: dict[str, dict] = {
    "realnvp": {"layers": 3, "hidden": [6, 5], "init": "default"},
    "low_rank": {"rank": 1},
    "lattice": {"alpha": 0.5},
    "spline": {"layers": 3, "hidden": [6, 5], "init": "default", "bins": 5},
}
IN_A_NEW_PROCESS = """
import sys, json, numpy as np, torch as th
from pathlib import Path
from sb3_flowpolicy import SACFlow
import sb3_flowpolicy.policies as policies
folder = Path(sys.argv[1])
for path in sorted(folder.glob("*.zip")):
    model = SACFlow.load(path, device="cpu")
    policy = getattr(policies, type(model.policy).__name__).load(path.with_suffix(".policy"))
    obs = dict(np.load(path.with_suffix(".obs.npz")))
    obs = obs["array"] if "array" in obs else obs
    out = {}
    for name, actor in {"model": model, "policy": policy}.items():
        out[name + "_mean"] = actor.predict(obs, deterministic=True)[0]
        th.manual_seed(7)
        out[name + "_sample"] = actor.predict(obs)[0]
    np.savez(path.with_suffix(".out.npz"), **out)
"""


def test_saved_models_predict_the_same_in_a_new_process(tmp_path: Path) -> None:
    """All policy classes and densities, with unusual arguments; also saved as a policy alone."""
    models: dict[str, SACFlow] = {}
    for name, distribution_class in registered_distributions().items():
        if not hasattr(distributions, distribution_class.__name__):
            continue  # registered by a test or a doctest: unknown in a new process
        policy_kwargs = {**NET, "distribution": name, "share_features_extractor": True}
        policy_kwargs["distribution_kwargs"] = UNUSUAL.get(name, {})
        model = SACFlow("FlowPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, **FAST)
        models[name] = model.learn(30)
    image = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    multi = SimpleMultiObsEnv(discrete_actions=False, random_start=False)
    for kind in ("Gauss", "LowRank", "Flow"):
        cnn = {**NET, "features_extractor_kwargs": {"features_dim": 8}}
        models[f"Cnn{kind}"] = SACFlow(f"Cnn{kind}Policy", image, policy_kwargs=cnn, **FAST)
        dic = {**NET, "features_extractor_kwargs": {"cnn_output_dim": 8}}
        models[f"Multi{kind}"] = SACFlow(
            f"MultiInput{kind}Policy", multi, policy_kwargs=dic, **FAST
        )

    expected = {}
    for name, model in models.items():
        model.observation_space.seed(0)
        obs = model.observation_space.sample()
        arrays = obs if isinstance(obs, dict) else {"array": obs}
        np.savez(tmp_path / f"{name}.obs.npz", **arrays)
        model.save(tmp_path / f"{name}.zip")
        model.policy.save(str(tmp_path / f"{name}.policy"))
        mean, _ = model.predict(obs, deterministic=True)
        th.manual_seed(7)
        expected[name] = mean, model.predict(obs)[0]

    subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS, str(tmp_path)], check=True)
    for name, (mean, sample) in expected.items():
        got = np.load(tmp_path / f"{name}.out.npz")
        for source in ("model", "policy"):
            np.testing.assert_array_equal(got[f"{source}_mean"], mean, err_msg=name)
            np.testing.assert_array_equal(got[f"{source}_sample"], sample, err_msg=name)


def test_shared_extractor_is_still_shared_after_loading(tmp_path: Path) -> None:
    kwargs = {**NET, "share_features_extractor": True}
    model = SACFlow("FlowPolicy", "Pendulum-v1", policy_kwargs=kwargs, **FAST)
    model.policy.save(str(tmp_path / "policy"))
    loaded = policies.FlowPolicy.load(str(tmp_path / "policy"))
    assert loaded.critic.features_extractor is loaded.actor.features_extractor
