import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from flowpolicy_envs import TunnelEnv
from flowpolicy_envs.registration import TUNNEL_IDS

VIEW = 1.04


def count(frame: np.ndarray, color: str) -> int:
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    masks = {
        "red": (red > 150) & (green < 130) & (blue < 130),
        "green": (green > red + 40) & (green > blue + 40),
        "blue": (blue > red + 60) & (blue > green + 30),
        "black": frame.max(axis=2) < 30,
        "white": frame.min(axis=2) > 250,
    }
    return int(masks[color].sum())


def pixel(frame: np.ndarray, x: float, y: float) -> np.ndarray:
    size = len(frame)
    return frame[int((VIEW - y) / (2 * VIEW) * size), int((VIEW + x) / (2 * VIEW) * size)]


@pytest.mark.parametrize("env_id", TUNNEL_IDS)
def test_frames_show_walls_goal_agent_and_samples(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    plain = env.render()
    assert plain.shape == (600, 600, 3)
    assert plain.dtype == np.uint8
    assert count(plain, "white") > 0.8 * 600 * 600
    for color in ("red", "green", "black"):
        assert count(plain, color) > 30, color
    assert count(plain, "blue") == 0
    env.unwrapped.set_action_samples(np.random.default_rng(0).uniform(-1, 1, (50, 2)))
    assert count(env.render(), "blue") > 300
    env.unwrapped.set_action_samples(None)
    assert np.array_equal(env.render(), plain)


def test_agent_trail_goal_and_samples_are_where_they_should_be():
    env = TunnelEnv(width=0.1, reach=0.3, render_mode="rgb_array")
    env.reset()
    env.step([1.0, 1.0])
    env.set_action_samples([[1.0, -1.0]])
    frame = env.render()
    assert frame is not None
    assert pixel(frame, 0.3, 0.3).max() < 30
    assert len(set(pixel(frame, 0.0, 0.0))) == 1  # gray: a past position
    assert pixel(frame, 0.0, 0.0).max() < 200
    goal, sample = pixel(frame, 0.95, 0.95).astype(int), pixel(frame, 0.6, 0.0).astype(int)
    assert goal[1] > goal[0] + 40
    assert sample[2] > sample[0] + 60
    assert pixel(frame, -0.5, 0.5).min() > 250


def test_reset_clears_samples_and_trail():
    env = TunnelEnv(width=0.5, render_mode="rgb_array")
    env.reset()
    fresh = env.render()
    env.step([1.0, 0.5])
    env.set_action_samples([[1.0, 0.0], [0.0, 1.0]])
    env.reset()
    assert np.array_equal(env.render(), fresh)


@pytest.mark.parametrize(
    ("arguments", "walls"),
    [
        ({"total_dims": 1, "coupled_dims": 1}, False),
        ({"total_dims": 2, "coupled_dims": 1, "free_dims": 1}, False),
        ({"total_dims": 3, "coupled_dims": 1, "free_dims": 1}, True),
        ({"total_dims": 5, "coupled_dims": 3, "free_dims": 2}, True),
        ({"goal_position": 1.0}, True),
        ({"path": "spline", "waypoints": [(-0.5, 0), (0.5, 0), (-0.4, 0)]}, True),
    ],
)
def test_unusual_worlds_are_drawn(arguments, walls):
    env = TunnelEnv(render_mode="rgb_array", **arguments)
    env.reset()
    frame = env.render()
    assert frame is not None
    assert (count(frame, "red") > 0) == walls
    assert (count(frame, "green") > 0) == (arguments.get("goal_position") is None)


def test_rendering_needs_no_display():
    program = (
        "import gymnasium as gym, flowpolicy_envs\n"
        "env = gym.make('TunnelCircle-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "env.render()\n"
        "import pygame\n"
        "print(pygame.display.get_init())"
    )
    variables = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "SDL_VIDEODRIVER")}
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True, env=variables, text=True
    )
    assert run.stdout.splitlines()[-1] == "False"


def test_human_mode_opens_and_closes_a_window():
    import pygame

    env = TunnelEnv(render_mode="human", render_size=64)
    env.reset()
    env.step([1.0, 1.0])
    assert env.render() is None
    assert pygame.display.get_surface().get_size() == (64, 64)
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_render_without_a_mode_warns():
    with pytest.warns(UserWarning, match="render"):
        assert TunnelEnv().render() is None


@pytest.mark.parametrize("samples", [np.zeros(2), np.zeros((4, 3)), np.zeros((1, 1, 2))])
def test_samples_of_a_wrong_shape(samples):
    with pytest.raises(ValueError, match=r"samples must have shape \(N, 2\), got"):
        TunnelEnv().set_action_samples(samples)
