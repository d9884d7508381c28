import json
import subprocess
import sys
import warnings

import gymnasium as gym
import pytest

import flowpolicy_envs
from flowpolicy_envs.registration import SQUARE_IDS, TUNNEL_IDS

EXPECTED = {
    # id: path, coupled dims, reach / width, dense, goal, penalty
    "TunnelCircle-v0": ("circle", 2, 4, 1.0, 0.1, 0.0),
    "TunnelCircleNarrow-v0": ("circle", 2, 5, 1.0, 1.0, 0.0),
    "TunnelCircle-v1": ("circle", 2, 4, 0.25, 0.1, 0.0),
    "TunnelCircleNarrow-v1": ("circle", 2, 5, 0.25, 1.0, 0.0),
    "TunnelHorizontal-v0": ("line", 1, 8, 0.0, 1.0, 0.1),
    "TunnelDiagonal-v0": ("line", 2, 8, 0.0, 1.0, 0.1),
    "TunnelSpline-v0": ("spline", 2, 4, 1.0, 1.0, 0.0),
}


EXPECTED_SQUARES = {
    # id: task, force limit, seconds of warm-up, steps
    "Square-v0": ("Hold", 6.0, 2.0, 40),
    "SquareHold-v0": ("Hold", 6.0, 2.0, 40),
    "SquareMove-v0": ("Move", 1.95, 4.0, 80),
    "SquareMoveX-v0": ("MoveX", 1.95, 4.0, 80),
    "SquareFindGoal-v0": ("FindGoal", 1.95, 4.0, 80),
    "SquareHold-v1": ("Hold", 3.0, 2.0, 40),
    "SquareMove-v1": ("Move", 1.95, 4.0, 80),
    "SquareMoveX-v1": ("MoveX", 1.95, 4.0, 80),
    "SquareFindGoal-v1": ("FindGoal", 1.95, 4.0, 80),
}


def test_every_id_is_listed():
    assert set(TUNNEL_IDS) == {*EXPECTED, "Tunnel-v0"}
    assert set(SQUARE_IDS) == set(EXPECTED_SQUARES)


@pytest.mark.parametrize("env_id", EXPECTED_SQUARES)
def test_square_ids_have_the_documented_rules(env_id):
    env = gym.make(env_id)
    config = env.unwrapped.config
    assert env.observation_space.shape == (42,)
    assert env.spec is not None
    rules = (type(config.task).__name__, config.max_force, config.warm_up)
    assert (*rules, env.spec.max_episode_steps) == EXPECTED_SQUARES[env_id]


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
    for name in flowpolicy_envs.__all__:
        assert getattr(flowpolicy_envs, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'Tunnel'"):
        flowpolicy_envs.Tunnel  # noqa: B018


@pytest.mark.parametrize("env_id", ["TunnelDiagonal-v0", "SquareHold-v0"])
def test_importing_is_light_and_making_an_environment_needs_no_torch(env_id):
    program = (
        "import sys, json, flowpolicy_envs, gymnasium as gym\n"
        "heavy = lambda: [m for m in ('torch', 'stable_baselines3', 'sb3_flowpolicy', 'numba',"
        " 'pygame') if m in sys.modules]\n"
        "first = heavy()\n"
        f"env = gym.make('{env_id}')\n"
        "env.reset()\n"
        "env.step(env.action_space.sample())\n"
        "print(json.dumps([first, heavy()]))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert json.loads(run.stdout) == [[], ["numba"]]
