import gymnasium as gym
import numpy as np
import pytest

from flowpolicy_envs import Holder, SquareEnv
from flowpolicy_envs.registration import SQUARE_IDS
from flowpolicy_envs.square.rendering import COLORS

STILL = {"finger_noise": 0.0, "start_x": 0.0, "start_y": 0.0, "start_angle": 0.0}
VIEW = 1.04


def pixel(frame: np.ndarray, x: float, y: float) -> np.ndarray:
    size = len(frame)
    return frame[int((VIEW - y) / (2 * VIEW) * size), int((VIEW + x) / (2 * VIEW) * size)]


@pytest.mark.parametrize("env_id", SQUARE_IDS)
def test_square_fingers_lamp_and_samples_are_where_they_should_be(env_id):
    env = gym.make(env_id, **STILL, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    frame = env.render()
    assert frame.shape == (600, 600, 3)
    assert frame.dtype == np.uint8
    assert pixel(frame, 0.22, -0.22).max() < 40
    for color, place in zip(COLORS, ((0.4, 0), (0, 0.4), (-0.4, 0), (0, -0.4)), strict=True):
        assert np.abs(pixel(frame, *place).astype(int) - color).max() < 8
    assert np.ptp(pixel(frame, 0.9, 0.9).astype(int)) < 5  # a gray lamp: not held
    samples = np.zeros((1, 8))
    samples[0, :2] = -0.5, 0.5
    env.set_action_samples(samples)
    red = pixel(env.render(), 0.2, 0.2).astype(int)
    assert red[0] > red[1] + 60
    for _ in range(6):
        env.step(Holder()(np.zeros(42)))
    held = pixel(env.render(), 0.9, 0.9).astype(int)
    assert held[1] > held[0] + 60


def test_the_square_turns_and_moves_in_the_picture():
    env = SquareEnv(**STILL, render_mode="rgb_array")
    env.reset(seed=0)
    assert pixel(env.render(), 0.28, 0.28).max() < 40
    env.set_state({"bodies": [0.0, 0.0, np.pi / 4, 0.0, 0.0, 0.0]})
    assert pixel(env.render(), 0.28, 0.28).max() > 200
    env.set_state({"bodies": [0.2, 0.2, 0.0, 0.0, 0.0, 0.0]})
    assert pixel(env.render(), 0.45, 0.45).max() < 40


def test_reset_removes_samples():
    env = SquareEnv(**STILL, render_mode="rgb_array")
    env.reset(seed=0)
    fresh = env.render()
    env.set_action_samples(np.random.default_rng(0).uniform(-1, 1, (20, 8)))
    assert not np.array_equal(env.render(), fresh)
    env.reset(seed=0)
    assert np.array_equal(env.render(), fresh)
    with pytest.raises(ValueError, match=r"samples must have shape \(N, 8\), got \(3, 2\)"):
        env.set_action_samples(np.zeros((3, 2)))


def test_the_window_opens_and_closes():
    env = gym.make("SquareHold-v0", render_mode="human", render_size=64)
    env.reset(seed=0)
    env.step(np.zeros(8))
    assert env.render() is None
    env.close()
