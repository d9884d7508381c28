"""The arguments of a Tunnel."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from flowpolicy_envs.checks import check_not_negative, is_number, is_whole
from flowpolicy_envs.tunnel.kernels import CIRCLE
from flowpolicy_envs.tunnel.paths import (
    DEFAULT_WAYPOINTS,
    Path,
    circle_path,
    line_path,
    spline_path,
)

PATHS = ("line", "circle", "spline")


@dataclass(frozen=True, eq=False)
class TunnelConfig:
    """Geometry and rewards of a Tunnel. `TunnelEnv` documents the arguments.

    Attributes:
        geometry: The path that the arguments describe.

    Raises:
        ValueError: If an argument is outside of its range; the message names it.

    Example:
        >>> TunnelConfig(path="circle", radius=0.5, width=0.1).geometry.ends[1] / (2 * math.pi)
        0.5
        >>> TunnelConfig(width=0.0)
        Traceback (most recent call last):
        ...
        ValueError: width must be in (0, 2], got 0.0
    """

    path: str = "line"
    total_dims: int = 2
    coupled_dims: int = 2
    free_dims: int = 0
    goal_position: float = 0.9
    radius: float = 0.7
    waypoints: Sequence[Sequence[float]] | None = None
    width: float = 0.0175
    reach: float = 0.14
    start_noise: float = 0.0
    dense_reward: float = 0.0
    goal_reward: float = 1.0
    leave_penalty: float = 0.1
    geometry: Path = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the arguments and build the path."""
        if not isinstance(self.path, str) or self.path not in PATHS:
            raise ValueError(f"path must be one of {PATHS}, got {self.path!r}")
        _check_range("width", self.width, 0.0, 2.0)
        _check_range("reach", self.reach, 0.0, 2.0)
        _check_range("goal_position", self.goal_position, 0.0, 1.0)
        _check_range("radius", self.radius, 0.0, 1.0)
        _check_dims(self)
        for name in ("dense_reward", "leave_penalty", "start_noise"):
            check_not_negative(name, getattr(self, name))
        if not is_number(self.goal_reward) or not math.isfinite(self.goal_reward):
            raise ValueError(f"goal_reward must be finite, got {self.goal_reward!r}")
        # The dataclass is frozen, and this attribute follows from the others.
        object.__setattr__(self, "geometry", self._build_path())
        to_goal = self.geometry.locate(self.geometry.point(0.0))[1]
        if self.start_noise >= to_goal:
            raise ValueError(
                "start_noise must be less than the path's length to the goal region, "
                f"{to_goal:.4g}, got {self.start_noise}"
            )

    def _build_path(self) -> Path:
        if self.path == "line":
            return line_path(self.total_dims, self.coupled_dims, self.free_dims, self.goal_position)
        if self.path == "circle":
            return circle_path(self.radius)
        waypoints = DEFAULT_WAYPOINTS if self.waypoints is None else self.waypoints
        return spline_path(_checked_waypoints(waypoints))

    @property
    def observation_space(self) -> spaces.Box:
        """Box of the position (D,), on a circle followed by the radius and the norm."""
        high = np.ones(self.total_dims, np.float32)
        low = -high
        if self.geometry.kind == CIRCLE:
            # The corner of the world has norm sqrt(2), which float32 rounds up, not down.
            high = np.append(high, np.array([1.0, math.sqrt(2.0)], np.float32))
            low = np.append(low, np.zeros(2, np.float32))
        return spaces.Box(low, high, dtype=np.float32)

    @property
    def action_space(self) -> spaces.Box:
        """Box [-1, 1]^D."""
        return spaces.Box(-1.0, 1.0, (self.total_dims,), np.float32)

    def draw_start(self, rng: np.random.Generator) -> float:
        """Return the arc at which an episode starts."""
        low = max(-self.start_noise, self.geometry.first_arc)
        return float(rng.uniform(low, self.start_noise))


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not is_number(value) or not low < value <= high:
        raise ValueError(f"{name} must be in ({low:g}, {high:g}], got {value!r}")


def _check_dims(config: TunnelConfig) -> None:
    """Raise ValueError unless the three dimension counts fit the path and each other."""
    total, coupled, free = config.total_dims, config.coupled_dims, config.free_dims
    for name, count, least in (
        ("total_dims", total, 1),
        ("coupled_dims", coupled, 1),
        ("free_dims", free, 0),
    ):
        if not is_whole(count) or count < least:
            raise ValueError(f"{name} must be an integer of at least {least}, got {count!r}")
    if config.path != "line" and (total, coupled, free) != (2, 2, 0):
        raise ValueError(
            f"total_dims, coupled_dims and free_dims must be 2, 2 and 0 for path={config.path!r}, "
            f"got {total}, {coupled} and {free}"
        )
    if coupled > total:
        raise ValueError(f"coupled_dims must be at most total_dims={total}, got {coupled}")
    if coupled + free > total:
        raise ValueError(
            f"free_dims must be at most total_dims - coupled_dims = {total - coupled}, got {free}"
        )


def _checked_waypoints(waypoints: Any) -> np.ndarray:
    """Return `waypoints` as an array (K, 2), or raise ValueError."""
    try:
        points = np.asarray(waypoints, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"waypoints must be numbers of shape (K, 2) with K >= 2, got {waypoints!r}"
        ) from None
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise ValueError(f"waypoints must have shape (K, 2) with K >= 2, got {points.shape}")
    if not (np.abs(points) <= 1.0).all():
        raise ValueError(f"waypoints must lie in the world [-1, 1], got {points.tolist()}")
    if (points[1:] == points[:-1]).all(axis=1).any():
        raise ValueError(f"waypoints must not repeat their predecessor, got {points.tolist()}")
    return points
