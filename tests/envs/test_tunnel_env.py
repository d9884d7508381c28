import math

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowpolicy_envs import TunnelEnv
from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig


@pytest.mark.parametrize(
    ("env_id", "action"),
    [("TunnelHorizontal-v0", (1.0, 0.0)), ("TunnelDiagonal-v0", (1.0, 1.0))],
)
def test_seven_precise_steps_solve_the_lines_and_six_do_not(env_id, action):
    env = gym.make(env_id)
    env.reset(seed=0)
    outcomes = [env.step(np.array(action, np.float32)) for _ in range(7)]
    assert [terminated for _, _, terminated, _, _ in outcomes] == [False] * 6 + [True]
    assert [reward for _, reward, *_ in outcomes] == [0.0] * 6 + [1.0]
    assert [info["is_success"] for *_, info in outcomes] == [False] * 6 + [True]


def annulus(config: TunnelConfig, n_radii: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a little more than the shorter way, and their angles in degrees."""
    half = config.width / 2
    radii = np.linspace(config.radius - half, config.radius + half, n_radii)
    degrees = np.arange(-135.0, 10.0, spacing)
    rays = np.stack([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))], axis=-1)
    points = (radii[:, None, None] * rays).reshape(-1, 2)
    return points, np.tile(degrees, n_radii)


def search(points: np.ndarray, goal: np.ndarray, reach: float) -> list[int]:
    """Return the indices of a shortest sequence of points from (0.7, 0) into `goal`."""
    parent = np.full(len(points), -1)
    start = int(np.abs(points - [0.7, 0.0]).max(axis=1).argmin())
    parent[start] = start
    frontier = [start]
    while frontier:
        found: list[int] = []
        for k in frontier:
            near = np.flatnonzero((np.abs(points - points[k]).max(axis=1) <= reach) & (parent < 0))
            parent[near] = k
            found += near.tolist()
        arrived = [k for k in found if goal[k]]
        if arrived:
            way = arrived[:1]
            while way[-1] != start:
                way.append(int(parent[way[-1]]))
            return way[-2::-1]
        frontier = found
    raise AssertionError("there is no way")


@pytest.mark.parametrize("env_id", ["TunnelCircle-v0", "TunnelCircleNarrow-v0"])
def test_circle_takes_six_steps_at_least(env_id):
    env = gym.make(env_id)
    config = env.unwrapped.config

    # Rounding the positions of any agent to the grid gives a path with a reach that is longer by
    # two rounding errors. If such a path needs six steps, so does the agent.
    points, degrees = annulus(config, n_radii=9, spacing=0.25)
    rounding = math.hypot(config.width / 16, np.deg2rad(0.125) * (0.7 + config.width / 2))
    blurred = search(points, degrees <= -111 + 0.125, config.reach + 2 * rounding)
    assert len(blurred) == 6

    points, degrees = annulus(config, n_radii=9, spacing=0.5)
    shrink = 1e-6  # keeps rounding from pushing the agent through the wall
    centered = points * (1 + shrink * np.sign(0.7 - np.hypot(*points.T)))[:, None]
    way = search(centered, degrees <= -111.5, config.reach)
    assert len(way) == 6
    env.reset(seed=0)
    for k in way:
        action = (centered[k] - env.unwrapped.position) / config.reach
        _, _, terminated, _, info = env.step(action)
        assert terminated == (k == way[-1])
    assert info["is_success"]


def test_only_coordinated_steps_survive_on_the_diagonal():
    """Independent uniform actions survive if |a_0 - a_1| <= w / r / sqrt 2 = d: 1 - (1 - d/2)²."""
    count = 40_000
    rng = np.random.default_rng(0)
    survival = {}
    for name in ("independent", "equal"):
        batch = TunnelBatch(TunnelConfig(width=0.14 / 8, reach=0.14), count)
        actions = rng.uniform(-1, 1, (count, 2))
        batch.step(actions if name == "independent" else actions[:, :1].repeat(2, axis=1))
        survival[name] = 1.0 - batch.terminated.mean()
    d = math.sqrt(2) * 0.5 / 8
    assert survival["equal"] == 1.0
    assert survival["independent"] == pytest.approx(1 - (1 - d / 2) ** 2, abs=0.005)


@pytest.mark.parametrize("coupled", [1, 2, 3])
def test_free_dimensions_do_not_count_and_constrained_ones_do(coupled):
    arguments = {"total_dims": coupled + 2, "coupled_dims": coupled, "width": 0.02}
    free_step, constrained_step = np.zeros(coupled + 2), np.zeros(coupled + 2)
    free_step[-1] = 1.0
    constrained_step[-2] = 0.1  # times reach 0.14 is more than half the width
    env = TunnelEnv(free_dims=1, **arguments)
    assert not env.step(free_step)[2]
    assert env.step(constrained_step)[2]
    assert TunnelEnv(free_dims=0, **arguments).step(free_step)[2]


def test_only_the_reached_position_is_checked():
    corner = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.3)]
    env = TunnelEnv("spline", waypoints=corner, width=0.05, reach=0.2)
    env.step([1.0, 0.0])
    _, _, terminated, _, _ = env.step([0.5, 0.5])  # cuts the corner: (0.25, 0.05) is outside
    assert not terminated


def test_goal_ends_the_spline():
    env = TunnelEnv("spline", waypoints=[(-0.5, 0.5), (0.5, 0.5)], reach=0.5, dense_reward=1.0)
    outcomes = [env.step([1.0, 0.0]) for _ in range(2)]
    assert [o[1] for o in outcomes] == pytest.approx([0.5, 0.45 + 1.0])
    assert [o[4]["is_success"] for o in outcomes] == [False, True]


def test_rewards_combine():
    rules = {"dense_reward": 2.0, "goal_reward": 5.0, "leave_penalty": 3.0, "width": 0.1}
    env = TunnelEnv("line", coupled_dims=1, reach=0.5, **rules)
    assert env.step([1.0, 0.0])[1] == pytest.approx(1.0)
    assert env.step([-0.5, 0.0])[1] == pytest.approx(-0.5)
    assert env.step([1.0, 0.0])[1] == pytest.approx(1.0)
    assert env.step([1.0, 0.0])[1] == pytest.approx(2.0 * 0.15 + 5.0)
    env.reset()
    observation, reward, terminated, _, info = env.step([1.0, 1.0])
    assert (reward, terminated, info) == (-3.0, True, {"is_success": False})
    assert observation.tolist() == [0.5, 0.5]


def test_dense_rewards_add_up_to_the_length_along_the_circle():
    env = gym.make("TunnelCircle-v0").unwrapped
    path = env.config.geometry
    total, arc = 0.0, 0.0
    for _ in range(12):
        arc -= 0.15
        _, reward, terminated, _, info = env.step((path.point(arc) - env.position) / 0.21)
        total += reward
        if terminated:
            break
    assert info["is_success"]
    assert total == pytest.approx(111 / 360 * 2 * math.pi * 0.7 + 0.1)


def test_circle_observes_radius_and_norm():
    env = TunnelEnv("circle", radius=0.6, width=0.5)
    observation, _ = env.reset()
    assert observation == pytest.approx([0.6, 0.0, 0.6, 0.6])
    observation = env.step([-1.0, 1.0])[0]
    assert observation == pytest.approx([0.46, 0.14, 0.6, math.hypot(0.46, 0.14)])


def test_world_ends_at_one():
    env = TunnelEnv(width=2.0, reach=2.0, goal_position=1.0)
    assert env.step([-1.0, 0.0])[0].tolist() == [-1.0, 0.0]


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 64), st.floats(0.01, 2.0), st.floats(0.01, 2.0), st.integers(0, 99))
def test_observations_stay_in_the_space_in_any_dimension(dims, width, reach, seed):
    env = TunnelEnv(total_dims=dims, coupled_dims=dims, width=width, reach=reach)
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    assert observation.shape == (dims,)
    for _ in range(5):
        assert env.observation_space.contains(observation)
        observation, *_ = env.step(env.action_space.sample())


@pytest.mark.parametrize("action", [(5.0, -7.0), (np.inf, -np.inf)])
def test_actions_are_clipped(action):
    clipped, beyond = TunnelEnv(width=2.0), TunnelEnv(width=2.0)
    assert np.array_equal(clipped.step([1.0, -1.0])[0], beyond.step(action)[0])


@pytest.mark.parametrize("dims", [{"coupled_dims": 1}, {"coupled_dims": 2}])
def test_the_far_end_of_the_tunnel_is_open(dims):
    """Stepping out of the world leaves the tunnel, so there is no safe corner."""
    env = TunnelEnv(**dims)
    back = -np.eye(2)[0] if dims["coupled_dims"] == 1 else -np.ones(2)
    for _ in range(7):
        _, reward, terminated, _, _ = env.step(back)
        assert (reward, terminated) == (0.0, False)
    observation, reward, terminated, _, info = env.step(back)
    assert (reward, terminated, info["is_success"]) == (-0.1, True, False)
    assert env.observation_space.contains(observation)


def test_free_dimensions_end_in_walls():
    env = TunnelEnv(total_dims=3, coupled_dims=1, free_dims=1, reach=1.5)
    observation, _, terminated, _, _ = env.step([0.0, 0.0, -1.0])
    assert not terminated
    assert observation.tolist() == [0.0, 0.0, -1.0]


def test_the_goal_may_be_passed_beyond_the_world():
    env = TunnelEnv(reach=0.8)
    env.step([1.0, 1.0])
    observation, reward, terminated, _, info = env.step([1.0, 1.0])
    assert (reward, terminated, info["is_success"]) == (1.0, True, True)
    assert observation.tolist() == [1.0, 1.0]


def test_bad_actions_are_rejected_and_change_nothing():
    env = TunnelEnv()
    env.step([0.5, 0.5])
    with pytest.raises(ValueError, match=r"action must have shape \(2,\), got shape \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"action must have shape \(2,\), got shape \(\)"):
        env.step(0.1)
    with pytest.raises(ValueError, match=r"actions must not contain NaN, got \[ ?0\. +nan\]"):
        env.step(np.array([0.0, np.nan]))
    assert env.position.tolist() == [0.07, 0.07]


@pytest.mark.parametrize("path", ["line", "circle", "spline"])
def test_start_noise_runs_along_the_path(path):
    env = TunnelEnv(path, start_noise=0.3, reach=0.001)
    geometry = env.config.geometry
    start = geometry.point(0.0)
    starts = []
    for seed in range(200):
        env.reset(seed=seed)
        starts.append(env.position)
        assert not env.step([0.0, 0.0])[2]
    offsets = [geometry.locate(p)[0] for p in starts]
    assert max(offsets) < 1e-12
    distances = np.linalg.norm(np.array(starts) - start, axis=1)
    assert 0.28 < distances.max() <= 0.3
    low, high = np.array(starts).min(axis=0), np.array(starts).max(axis=0)
    widest = (high - low).max()
    # On the line the noise spreads over both coordinates; the spline has no points before its
    # start.
    expected = {"line": 0.6 / math.sqrt(2), "circle": 2 * 0.7 * math.sin(0.3 / 0.7), "spline": 0.3}
    assert 0.93 * expected[path] < widest <= expected[path] + 1e-12


def test_observations_and_infos_are_not_overwritten():
    env = TunnelEnv(width=2.0)
    first, first_info = env.reset()
    second, _, _, _, second_info = env.step([1.0, 1.0])
    env.step([1.0, 1.0])
    assert first.tolist() == [0.0, 0.0]
    assert second == pytest.approx([0.14, 0.14])
    assert first_info is not second_info
