"""Tests of every registered environment of the package."""

import copy
import hashlib
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from flowpolicy_envs.registration import SQUARE_IDS, TUNNEL_IDS

IDS = [*TUNNEL_IDS, *SQUARE_IDS]
STILL = {"finger_noise": 0.0, "start_x": 0.0, "start_y": 0.0, "start_angle": 0.0}
NOISY = {"observation_noise": 0.01}
# Arguments that make episodes differ, and that make them equal.
RANDOM = {**{i: {"start_noise": 0.1} for i in TUNNEL_IDS}, **dict.fromkeys(SQUARE_IDS, NOISY)}
FIXED = {**{i: {} for i in TUNNEL_IDS}, **dict.fromkeys(SQUARE_IDS, STILL)}


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasiums_checker_passes(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*is out of date")  # ids of an earlier version
        check_env(gym.make(env_id).unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines3s_checker_passes(env_id):
    from stable_baselines3.common import env_checker

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*is out of date")  # ids of an earlier version
        env_checker.check_env(gym.make(env_id, render_mode="rgb_array"))


def rollout(env: gym.Env, steps: int, rng: np.random.Generator) -> list[tuple]:
    outcomes = []
    for _ in range(steps):
        # Short steps, so that episodes are more than one step long.
        observation, *outcome = env.step(rng.uniform(-0.3, 0.3, env.action_space.shape))
        outcomes.append((observation.tobytes(), *outcome))
        if outcome[1] or outcome[2]:
            outcomes.append((env.reset()[0].tobytes(),))
    return outcomes


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("env_id", IDS)
def test_copies_continue_equally_and_independently(env_id, clone):
    env = gym.make(env_id, **RANDOM[env_id], render_mode="rgb_array", render_size=32)
    env.reset(seed=3)
    rollout(env, 10, np.random.default_rng(0))
    env.render()
    twin = clone(env)
    expected = rollout(env, 50, np.random.default_rng(1))
    assert rollout(twin, 50, np.random.default_rng(1)) == expected
    assert np.array_equal(twin.render(), env.render())


def fingerprint(env_id: str) -> str:
    env = gym.make(env_id, **RANDOM[env_id])
    observation, _ = env.reset(seed=7)
    outcomes = rollout(env, 200, np.random.default_rng(7))
    return hashlib.sha256(repr((observation.tobytes(), outcomes)).encode()).hexdigest()


def test_another_process_sees_the_same_numbers():
    program = (
        "import runpy, sys, flowpolicy_envs\n"
        "tests = runpy.run_path(sys.argv[1])\n"
        "print(*[tests['fingerprint'](i) for i in sys.argv[2:]])"
    )
    command = [sys.executable, "-c", program, __file__, *IDS]
    run = subprocess.run(command, capture_output=True, check=True, text=True)
    assert run.stdout.split() == [fingerprint(env_id) for env_id in IDS]
    # Tunnel-v0 is the diagonal and Square-v0 the holding task by default. All others differ.
    assert len(set(run.stdout.split())) == len(IDS) - 2


@pytest.mark.parametrize("env_id", IDS)
def test_seeds_matter_only_with_a_random_start(env_id):
    for arguments, n_starts in ((FIXED[env_id], 1), (RANDOM[env_id], 5)):
        env = gym.make(env_id, **arguments)
        starts = {env.reset(seed=seed)[0].tobytes() for seed in range(5)}
        assert len(starts) == n_starts
