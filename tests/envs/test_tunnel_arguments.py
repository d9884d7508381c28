import pytest

from flowpolicy_envs import TunnelEnv, TunnelVectorEnv

NAN = float("nan")

BAD = [
    ({"path": "square"}, r"path must be one of .*'line', 'circle', 'spline'.*, got 'square'"),
    ({"width": 0.0}, r"width must be in \(0, 2\], got 0.0"),
    ({"width": -1}, r"width must be in \(0, 2\], got -1"),
    ({"width": 2.1}, r"width must be in \(0, 2\], got 2.1"),
    ({"width": NAN}, r"width must be in \(0, 2\], got nan"),
    ({"reach": 0.0}, r"reach must be in \(0, 2\], got 0.0"),
    ({"reach": 2.5}, r"reach must be in \(0, 2\], got 2.5"),
    ({"goal_position": 1.1}, r"goal_position must be in \(0, 1\], got 1.1"),
    ({"goal_position": 0.0}, r"goal_position must be in \(0, 1\], got 0.0"),
    ({"path": "circle", "radius": 1.5}, r"radius must be in \(0, 1\], got 1.5"),
    ({"total_dims": 0}, r"total_dims must be an integer of at least 1, got 0"),
    ({"total_dims": 2.0}, r"total_dims must be an integer of at least 1, got 2.0"),
    ({"coupled_dims": 0}, r"coupled_dims must be an integer of at least 1, got 0"),
    ({"free_dims": -1}, r"free_dims must be an integer of at least 0, got -1"),
    ({"coupled_dims": 3}, r"coupled_dims must be at most total_dims=2, got 3"),
    ({"total_dims": 4, "free_dims": 3}, r"free_dims must be at most .* = 2, got 3"),
    ({"path": "circle", "total_dims": 3}, r"must be 2, 2 and 0 for path='circle', got 3, 2 and 0"),
    ({"path": "spline", "total_dims": 1}, r"must be 2, 2 and 0 for path='spline', got 1, 2 and 0"),
    ({"leave_penalty": -0.1}, r"leave_penalty must be finite and at least 0, got -0.1"),
    ({"dense_reward": -1.0}, r"dense_reward must be finite and at least 0, got -1.0"),
    ({"goal_reward": float("inf")}, r"goal_reward must be finite, got inf"),
    ({"start_noise": -0.1}, r"start_noise must be finite and at least 0, got -0.1"),
    ({"start_noise": 1.3}, r"start_noise must be less than .* goal region, 1.273, got 1.3"),
    ({"path": "spline", "waypoints": [(0, 0)]}, r"waypoints must have shape \(K, 2\) .*\(1, 2\)"),
    ({"path": "spline", "waypoints": [(0, 0, 0)] * 2}, r"waypoints must have shape .*\(2, 3\)"),
    ({"path": "spline", "waypoints": [(0, 0), (1,)]}, r"waypoints must be numbers of shape"),
    ({"path": "spline", "waypoints": [(0, 0), (0, 2)]}, r"waypoints must lie in the world"),
    ({"path": "spline", "waypoints": [(0, 0), (0, NAN)]}, r"waypoints must lie in the world"),
    ({"path": "spline", "waypoints": [(0, 0), (0, 0)]}, r"waypoints must not repeat"),
    ({"render_mode": "ansi"}, r"render_mode must be None or one of .*, got 'ansi'"),
    ({"render_size": 8}, r"render_size must be an integer of at least 16, got 8"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
@pytest.mark.parametrize("make", [TunnelEnv, TunnelVectorEnv])
def test_bad_arguments(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, r"num_envs must be an integer of at least 1, got 0"),
        ({"max_episode_steps": 0}, r"max_episode_steps must be None or >= 1, got 0"),
        ({"render_mode": "human"}, r"render_mode must be None or one of \('rgb_array',\)"),
        ({"autoreset_mode": "Never"}, r"'Never' is not a valid AutoresetMode"),
    ],
)
def test_bad_vector_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        TunnelVectorEnv(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {"total_dims": 1, "coupled_dims": 1},
        {"total_dims": 64, "coupled_dims": 64},
        {"total_dims": 5, "coupled_dims": 2, "free_dims": 3},
        {"width": 2.0, "reach": 2.0, "goal_position": 1.0},
        {"start_noise": 1.27},
        {"leave_penalty": 0.0, "goal_reward": 0.0},
    ],
)
def test_extreme_arguments_are_accepted(arguments):
    env = TunnelEnv(**arguments)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
