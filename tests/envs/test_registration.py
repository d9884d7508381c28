import json
import subprocess
import sys
import warnings

import gymnasium as gym
import pytest

import flowpolicy_envs
from flowpolicy_envs.registration import TUNNEL_IDS

EXPECTED = {
    # id: path, coupled dims, reach / width, dense, goal, penalty
    "TunnelCircle-v0": ("circle", 2, 4, 1.0, 0.1, 0.0),
    "TunnelCircleNarrow-v0": ("circle", 2, 5, 1.0, 1.0, 0.0),
    "TunnelHorizontal-v0": ("line", 1, 8, 0.0, 1.0, 0.1),
    "TunnelDiagonal-v0": ("line", 2, 8, 0.0, 1.0, 0.1),
    "TunnelSpline-v0": ("spline", 2, 4, 1.0, 1.0, 0.0),
}


def test_every_id_is_listed():
    assert set(TUNNEL_IDS) == {*EXPECTED, "Tunnel-v0"}


@pytest.mark.parametrize("env_id", EXPECTED)
def test_ids_have_the_documented_rules(env_id):
    config = gym.make(env_id).unwrapped.config
    rules = (
        config.path,
        config.coupled_dims,
        pytest.approx(config.reach / config.width),
        config.dense_reward,
        config.goal_reward,
        config.leave_penalty,
    )
    assert rules == EXPECTED[env_id]


@pytest.mark.parametrize("env_id", TUNNEL_IDS)
def test_time_limit(env_id):
    env = gym.make(env_id)
    env.reset(seed=0)
    limit = 60 if env_id == "TunnelSpline-v0" else 40
    for step in range(limit):
        _, _, terminated, truncated, info = env.step([0.0, 0.0])
        assert not terminated
        assert truncated == (step == limit - 1)
        assert info["is_success"] is False


def test_arguments_can_be_overridden():
    env = gym.make("TunnelDiagonal-v0", width=0.5, max_episode_steps=7)
    assert env.unwrapped.config.width == 0.5
    assert env.spec is not None
    assert env.spec.max_episode_steps == 7


def test_registering_again_is_silent_and_keeps_the_registration():
    before = gym.spec("TunnelDiagonal-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flowpolicy_envs.register_envs()
    assert gym.spec("TunnelDiagonal-v0") is before


def test_public_names_resolve():
    assert flowpolicy_envs.TunnelEnv.__name__ == "TunnelEnv"
    assert flowpolicy_envs.TunnelVectorEnv.__name__ == "TunnelVectorEnv"
    with pytest.raises(AttributeError, match="has no attribute 'Tunnel'"):
        flowpolicy_envs.Tunnel  # noqa: B018


def test_importing_is_light_and_making_an_environment_needs_no_torch():
    program = (
        "import sys, json, flowpolicy_envs, gymnasium as gym\n"
        "heavy = lambda: [m for m in ('torch', 'stable_baselines3', 'sb3_flowpolicy', 'numba',"
        " 'pygame') if m in sys.modules]\n"
        "first = heavy()\n"
        "env = gym.make('TunnelDiagonal-v0')\n"
        "env.reset()\n"
        "env.step(env.action_space.sample())\n"
        "print(json.dumps([first, heavy()]))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert json.loads(run.stdout) == [[], ["numba"]]
