"""Which environment ids there are, and what distinguishes them."""

from typing import Any

from gymnasium.envs.registration import register, registry

_LINE_REACH = 0.14
"""Seven steps of 0.14 reach 0.9 from the origin (0.98), six do not (0.84)."""

_CURVED_REACH = 0.21
"""On the default circle this makes six steps the fewest that reach the goal; see TunnelEnv."""

_SPARSE: dict[str, Any] = {
    "path": "line",
    "reach": _LINE_REACH,
    "width": _LINE_REACH / 8,
    "dense_reward": 0.0,
    "goal_reward": 1.0,
    "leave_penalty": 0.1,
}

_DENSE: dict[str, Any] = {
    "reach": _CURVED_REACH,
    "width": _CURVED_REACH / 4,
    "dense_reward": 1.0,
    "goal_reward": 0.1,
    "leave_penalty": 0.0,
}

_CIRCLE = {**_DENSE, "path": "circle"}

TUNNEL_IDS: dict[str, dict[str, Any]] = {
    "Tunnel-v0": {},
    "TunnelCircle-v0": _CIRCLE,
    "TunnelCircleNarrow-v0": {**_CIRCLE, "width": _CURVED_REACH / 5, "goal_reward": 1.0},
    "TunnelHorizontal-v0": {**_SPARSE, "total_dims": 2, "coupled_dims": 1},
    "TunnelDiagonal-v0": {**_SPARSE, "total_dims": 2, "coupled_dims": 2},
    "TunnelSpline-v0": {**_DENSE, "path": "spline", "goal_reward": 1.0},
}
"""Each Tunnel id and the constructor arguments in which it differs from `Tunnel-v0`."""

_MAX_EPISODE_STEPS = {"TunnelSpline-v0": 60}
"""The spline is three times as long as the circle's way, so 40 steps would leave little slack."""

_MOVE: dict[str, Any] = {"max_force": 1.95, "warm_up": 4.0}
"""Four fingers at 1.95 N press with 7.8 N, three with 5.85 N; the weight of 3 N demands 6 N."""

SQUARE_IDS: dict[str, dict[str, Any]] = {
    "Square-v0": {},
    "SquareHold-v0": {"task": "hold"},
    "SquareMove-v0": {**_MOVE, "task": "move"},
    "SquareMoveX-v0": {**_MOVE, "task": "move_x"},
    "SquareFindGoal-v0": {**_MOVE, "task": "find_goal"},
}
"""Each Square id and the constructor arguments in which it differs from `Square-v0`."""

_SQUARE_STEPS = {"Square-v0": 40, "SquareHold-v0": 40}


def register_envs() -> None:
    """Register every environment of this package with gymnasium.

    Ids that are registered already are left alone, so calling this again (gymnasium does when it
    loads plugins) neither warns nor undoes a user's own registration.

    Example:
        >>> import gymnasium as gym
        >>> register_envs()
        >>> gym.spec("TunnelHorizontal-v0").max_episode_steps
        40
    """
    for env_id, kwargs in TUNNEL_IDS.items():
        _register("tunnel", "Tunnel", env_id, _MAX_EPISODE_STEPS.get(env_id, 40), kwargs)
    for env_id, kwargs in SQUARE_IDS.items():
        _register("square", "Square", env_id, _SQUARE_STEPS.get(env_id, 80), kwargs)


def _register(
    package: str, name: str, env_id: str, max_episode_steps: int, kwargs: dict[str, Any]
) -> None:
    if env_id not in registry:
        register(
            id=env_id,
            entry_point=f"flowpolicy_envs.{package}.env:{name}Env",
            vector_entry_point=f"flowpolicy_envs.{package}.vector:{name}VectorEnv",
            max_episode_steps=max_episode_steps,
            kwargs=kwargs,
        )
