"""The vectorized environments equal gymnasium's own vectorization."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from flowpolicy_envs.registration import SQUARE_IDS, TUNNEL_IDS

COUNT, STEPS = 5, 120
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]
# With these, episodes end in all possible ways: the Tunnel's by leaving, goal and time limit, the
# Square's by dropping and time limit (fingers break too rarely).
TUNNEL = {"start_noise": 0.4, "width": 0.2, "max_episode_steps": 7, "dense_reward": 1.0}
SQUARE = {
    "weight": [1.0, 3.0],
    "warm_up": 0.6,
    "max_episode_steps": 5,
    "observation_noise": {"position": 0.01, "angle": 0.1},
}
ARGUMENTS = {**dict.fromkeys(TUNNEL_IDS, TUNNEL), **dict.fromkeys(SQUARE_IDS, SQUARE)}


def make_pair(env_id: str, mode: AutoresetMode, **kwargs: Any) -> tuple[VectorEnv, VectorEnv]:
    ours = gym.make_vec(
        env_id,
        num_envs=COUNT,
        vectorization_mode="vector_entry_point",
        autoreset_mode=mode,
        **kwargs,
    )
    theirs = gym.make_vec(
        env_id,
        num_envs=COUNT,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        **kwargs,
    )
    return ours, theirs


def assert_same(ours: Any, theirs: Any) -> None:
    """Check that values, types and keys are equal, bit for bit."""
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for key in ours:
            assert_same(ours[key], theirs[key])
    elif isinstance(ours, np.ndarray):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
        if ours.dtype == object:
            for a, b in zip(ours, theirs, strict=True):
                assert_same(a, b)
        else:
            assert ours.tobytes() == theirs.tobytes()
    else:
        assert ours == theirs


@pytest.fixture
def gymnasiums_own_time_limit(monkeypatch):
    """Undo rl_zoo3's patch of gymnasium's time limit, for when another test imported rl_zoo3."""
    classes = gym.wrappers.TimeLimit.__mro__
    own = next(c for c in classes if c.__module__.startswith("gymnasium."))
    monkeypatch.setattr(gym.wrappers, "TimeLimit", own)


@pytest.mark.usefixtures("gymnasiums_own_time_limit")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("env_id", ARGUMENTS)
def test_equals_gymnasiums_vectorization_bit_for_bit(env_id, mode):
    ours, theirs = make_pair(env_id, mode, **ARGUMENTS[env_id])
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    for a, b in zip(ours.reset(seed=11), theirs.reset(seed=11), strict=True):
        assert_same(a, b)
    ours.action_space.seed(3)
    ends = np.zeros(2, int)
    for _ in range(STEPS):
        actions = ours.action_space.sample()
        results = ours.step(actions), theirs.step(actions)
        for a, b in zip(*results, strict=True):
            assert_same(a, b)
        ends += results[0][2].sum(), results[0][3].sum()
    assert ends.min() > 0


def test_disabled_mode_leaves_resets_to_the_caller():
    ours, theirs = make_pair("TunnelDiagonal-v0", AutoresetMode.DISABLED, start_noise=0.1)
    ours.reset(seed=0), theirs.reset(seed=0)
    actions = np.zeros((COUNT, 2), np.float32)
    actions[1] = (1.0, -1.0)
    for envs in (ours, theirs):
        assert envs.step(actions)[2].tolist() == [False, True, False, False, False]
    with pytest.raises(gym.error.ResetNeeded, match=r"agents \[1\] must be reset"):
        ours.step(actions)
    mask = np.arange(COUNT) == 1
    results = [envs.reset(options={"reset_mask": mask.copy()}) for envs in (ours, theirs)]
    for a, b in zip(*results, strict=True):
        assert_same(a, b)
    ours.step(actions)
