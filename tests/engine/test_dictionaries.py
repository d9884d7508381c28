"""Dictionary observations on the engine, with HER as with SB3's dictionary buffer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.engine import Engine
from sb3_flowpolicy.engine.observations import Observations
from tests.engine.test_equality import (
    OURS,
    assert_same,
    seed_everything,
    stock_loop,
)
from tests.reach import make_reach

FAST: dict[str, Any] = {"learning_starts": 200, "buffer_size": 300, "seed": 0, "device": "cpu"}


class DoubleExtractor(CombinedExtractor):
    """SB3 casts observations to float32; here they stay in float64."""

    def forward(self, obs: dict[str, th.Tensor]) -> th.Tensor:
        return super().forward(obs).double()


def filled(algorithm: Any, policy: str, env: Any, dtype: th.dtype, **settings: Any) -> Any:
    """A model that has taken 200 random steps and is about to learn."""
    kwargs: dict[str, Any] = {"net_arch": [16]}
    if dtype == th.float64:
        kwargs["features_extractor_class"] = DoubleExtractor
    model = algorithm(policy, env, policy_kwargs=kwargs, **FAST, **settings).learn(200)
    model.policy.to(dtype)
    if model.log_ent_coef is not None:
        model.log_ent_coef.data = model.log_ent_coef.data.to(dtype)
    return model


def check_equal(
    stock_algorithm: Any,
    policy: str,
    dtype: th.dtype,
    compile: bool,
    buffer: Any,
    make_env: Callable[[], Any] = make_reach,
) -> None:
    ours_class, name = OURS[stock_algorithm], f"MultiInput{policy}"
    settings = {"dtype": dtype, "replay_buffer_class": buffer}
    stock = filled(stock_algorithm, ours_class.policy_aliases[name], make_env(), **settings)
    ours = filled(ours_class, name, make_env(), compile=compile, **settings)
    ours.policy.load_state_dict(stock.policy.state_dict())
    for model in (stock, ours):
        seed_everything()
        stock_loop(model)
    assert ours._runtime._engine is not None
    assert ours._runtime._engine.compiler.enabled == compile
    assert_same(ours, stock, dtype)


@pytest.mark.parametrize(
    ("stock_algorithm", "policy", "dtype", "compile", "buffer"),
    [
        (SAC, "FlowPolicy", th.float32, False, HerReplayBuffer),
        (SAC, "LowRankPolicy", th.float64, False, DictReplayBuffer),
        (TQC, "GaussPolicy", th.float64, False, HerReplayBuffer),
        (SAC, "LowRankPolicy", th.float32, True, HerReplayBuffer),
    ],
)
def test_updates_equal_sb3s(
    stock_algorithm: Any, policy: str, dtype: th.dtype, compile: bool, buffer: Any
) -> None:
    check_equal(stock_algorithm, policy, dtype, compile, buffer)


def test_updates_with_normalized_observations_equal_sb3s() -> None:
    def make_env() -> VecNormalize:
        return VecNormalize(DummyVecEnv([make_reach]))

    check_equal(SAC, "GaussPolicy", th.float32, False, HerReplayBuffer, make_env)


class Compare(BaseCallback):
    """Compares the model with its policy, which acts eagerly."""

    compared = 0

    def _on_step(self) -> bool:
        if self.num_timesteps > 30:
            obs = {name: value[:1] for name, value in self.model._last_obs.items()}
            got, _ = self.model.predict(obs, deterministic=True)
            expected, _ = self.model.policy.predict(obs, deterministic=True)
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5)
            self.compared += 1
        return True


def test_a_compiled_policy_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    acted = []
    act = Engine.act

    def count(self: Engine, obs: th.Tensor, noise: th.Tensor | None = None) -> th.Tensor:
        acted.append(tuple(obs.shape))
        return act(self, obs, noise)

    monkeypatch.setattr(Engine, "act", count)
    monkeypatch.setattr(th, "compile", lambda function, **_: function)
    settings = {**FAST, "learning_starts": 30, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    model = SACFlow("MultiInputFlowPolicy", make_reach(), compile=True, **settings)
    callback = Compare()
    model.learn(40, callback)
    assert callback.compared == 10
    assert acted == [(1, 1, 6)] * (10 + 10)  # acting and comparing


def test_packing_is_undone() -> None:
    space = gym.spaces.Dict(
        image=gym.spaces.Box(-1, 1, (2, 3), np.float64), flags=gym.spaces.MultiBinary(2)
    )
    observations = Observations(space)
    samples = [space.sample() for _ in range(4)]
    batch = {name: np.stack([one[name] for one in samples]) for name in space}
    rows = observations.pack(batch)
    assert rows.shape == (4, 8)
    assert rows.dtype == th.float32
    for name, value in observations.unpack(rows).items():
        np.testing.assert_array_equal(value, batch[name].astype(np.float32))


def test_discrete_entries_are_left_to_sb3() -> None:
    kwargs = {"net_arch": [8]}
    model = SACFlow("MultiInputFlowPolicy", make_reach(), device="cpu", policy_kwargs=kwargs)
    assert Engine.why_unsupported(model) is None
    space = gym.spaces.Dict(level=gym.spaces.Discrete(3), position=gym.spaces.Box(0, 1, (2,)))
    model.observation_space = space
    assert Engine.why_unsupported(model) == f"observation space {space}"
