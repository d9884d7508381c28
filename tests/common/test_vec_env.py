"""Batched environments look to SB3 like its own vectorization does."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.common.vec_env import BatchedVecEnv, make_batched_env


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("SquareHold-v0", {"warm_up": 0.5}),
        ("TunnelDiagonal-v0", {"width": 0.2, "start_noise": 0.1}),
    ],
)
def test_equals_sb3s_own_vectorization(env_id: str, kwargs: dict) -> None:
    ours = make_batched_env(env_id, 3, seed=7, **kwargs)
    theirs = make_vec_env(env_id, 3, seed=7, env_kwargs=kwargs)
    assert ours.observation_space == theirs.observation_space
    assert np.array_equal(ours.reset(), theirs.reset())
    assert ours.venv.reset_infos[0]["is_success"] is False
    rng, episodes = np.random.default_rng(0), 0
    for _ in range(60):
        actions = rng.uniform(-1, 1, (3, *ours.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        mine, reference = ours.step(actions), theirs.step(actions)
        for a, b in zip(mine[:3], reference[:3], strict=True):
            assert np.array_equal(a, b)
        for info, expected in zip(mine[3], reference[3], strict=True):
            assert info.keys() == expected.keys()
            for name, value in expected.items():
                if name == "episode":
                    assert info[name]["r"] == pytest.approx(value["r"], abs=1e-5)
                    assert info[name]["l"] == value["l"]
                elif name == "terminal_observation":
                    assert np.array_equal(info[name], value)
                else:
                    assert info[name] == value
                    assert type(info[name]) is type(value)
            episodes += "episode" in info
    assert episodes > 5


def test_agents_train_in_it() -> None:
    env = make_batched_env("SquareHold-v0", 4, seed=0)
    model = SACFlow("GaussPolicy", env, learning_starts=20, batch_size=16, seed=0, compile=False)
    model.learn(200)
    assert model.num_timesteps == 200
    assert len(model.ep_info_buffer or ()) > 0


def test_what_it_refuses() -> None:
    with pytest.raises(gym.error.Error, match="doesn't have a vector entry point"):
        make_batched_env("Acrobot-v1")
    venv = gym.make_vec("SquareHold-v0", 2, vectorization_mode="vector_entry_point")
    with pytest.raises(ValueError, match="venv must reset in the same step, got autoreset_mode"):
        BatchedVecEnv(venv)
    env = make_batched_env("SquareHold-v0", 2)
    with pytest.raises(NotImplementedError, match="cannot call reset one by one"):
        env.env_method("reset")
    with pytest.raises(NotImplementedError, match="share task: make them anew"):
        env.set_attr("task", "move")
    assert env.get_images() == [None, None]
