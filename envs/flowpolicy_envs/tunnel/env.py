"""The Tunnel as a gymnasium environment."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.canvas import RENDER_FPS, RENDER_MODES, check_render_mode
from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.rendering import Renderer


class TunnelEnv(gym.Env[np.ndarray, np.ndarray]):
    r"""Follow a path that is several times narrower than a step is long.

    ## Description

    An agent lives in the world $[-1, 1]^D$ and has to reach a goal region without leaving a
    tunnel of width $w$. There is no inertia: from position $p$, the action $a$ leads to

    $$p' = p + r\,a$$

    where $r$ is the reach. Only $p'$ has to lie in the tunnel; what lies between does not count.
    The tunnel ends where the world does: stepping out of the world is leaving the tunnel, unless
    it is through the goal region. Free dimensions end in walls.
    As $r$ is larger than $w$, long steps stay inside only if their coordinates fit each other.
    How many do is set by the path:

    - `path="line"`: The first $C$ dimensions are *coupled*. On them, the centre line runs along
      $(1, \dots, 1)$ through the origin to both ends of the world, and the distance from it must
      not exceed $w/2$. The last $F$ dimensions are *free* and do not count. Each one in between
      must stay within $w/2$ of 0. With $C = 1$ the constraints can be met one dimension at a
      time; from $C = 2$ on they cannot. The goal region is the part of the tunnel whose
      projection on the line is at or beyond the point with `goal_position` on each coupled axis.
    - `path="circle"` ($D = 2$): The tunnel is the ring $\big|\|p\| - R\big| \le w/2$. The start is
      at angle 0; the goal region is a twentieth of the ring, centred at two thirds of a turn
      counter-clockwise. The ring is open both ways, and distances are counted along the shorter
      one.
    - `path="spline"` ($D = 2$): The tunnel is what lies within $w/2$ of a polyline through the
      way points. The start is the first of them, the goal region the last twentieth of its length.

    ## Action Space

    A `Box(-1, 1, (D,), float32)`. Actions outside of it are clipped.

    | Num | Action | Min | Max | Effect |
    |-----|--------|-----|-----|--------|
    | 0 … D-1 | step along axis i, as a share of the reach | -1 | 1 | $p_i$ changes by $r a_i$ |

    ## Observation Space

    A `Box` of float32 with shape `(D,)`, and `(4,)` for the circle.

    | Num | Observation | Min | Max | Paths |
    |-----|-------------|-----|-----|-------|
    | 0 … D-1 | position $p_i$ | -1 | 1 | all |
    | 2 | radius $R$ | 0 | 1 | circle |
    | 3 | norm $\lVert p \rVert$ | 0 | $\sqrt 2$ | circle |

    ## Rewards

    The sum of

    - `dense_reward` times the length of path by which the step came closer to the goal region
      (negative for a step back), paid for steps that end in the tunnel;
    - `goal_reward` for reaching the goal region;
    - `-leave_penalty` for leaving the tunnel.

    ## Starting State

    On the centre line: at the origin of the line, at angle 0 of the circle, at the first way point
    of the spline. With `start_noise` $n > 0$ the start is drawn uniformly from the part of the
    path within $n$ of that point, measured along the path.

    ## Episode End

    The episode terminates when the agent leaves the tunnel or reaches the goal region. All ids
    truncate it after 40 steps, `TunnelSpline-v0` after 60. `info["is_success"]` is true at the
    step that reaches the goal and false otherwise.

    The fewest steps to the goal: on the two lines each coordinate has to cover 0.9 at 0.14 a step,
    which takes 7 steps ($6 \cdot 0.14 = 0.84$). On the two circles, $R = 0.7$ and $r = 0.21$: the
    shorter way to the goal region spans $120° - 9° = 111°$. A step is $r$ long along an axis and
    $\sqrt 2\,r$ along a diagonal, on average over directions $1.12\,r$; as chords of this circle
    that is 17.3°, 24.5° and 19.4°. Five steps would have to cover 22.2° each, more than the
    directions allow on average, and six 18.5° each: it takes 6.

    ## Arguments

    | Argument | Default | Range | Meaning |
    |----------|---------|-------|---------|
    | `path` | `"line"` | `"line"`, `"circle"`, `"spline"` | shape of the centre line |
    | `total_dims` | 2 | at least 1; 2 unless a line | dimension $D$ of the world |
    | `coupled_dims` | 2 | 1 to D | $C$; line only |
    | `free_dims` | 0 | 0 to D - C | $F$; line only |
    | `goal_position` | 0.9 | (0, 1] | where the goal region begins; line only |
    | `radius` | 0.7 | (0, 1] | $R$; circle only |
    | `waypoints` | an S | (K, 2) in [-1, 1], K at least 2 | spline only |
    | `width` | 0.0175 | (0, 2] | $w$, world units |
    | `reach` | 0.14 | (0, 2] | $r$, world units |
    | `start_noise` | 0 | 0 to less than the way to the goal | $n$, world units |
    | `dense_reward` | 0 | at least 0 | reward per unit of path |
    | `goal_reward` | 1 | finite | reward for reaching the goal region |
    | `leave_penalty` | 0.1 | at least 0 | subtracted for leaving the tunnel |
    | `render_mode` | `None` | `None`, `"rgb_array"`, `"human"` | what `render()` does |
    | `render_size` | 600 | at least 16 | edge of a frame, pixels |

    Raises:
        ValueError: If an argument is outside of its range; the message names it.

    Example:
        >>> import gymnasium as gym
        >>> import flowpolicy_envs
        >>> env = gym.make("Tunnel-v0", total_dims=3, coupled_dims=2, width=0.1)
        >>> _ = env.reset(seed=0)
        >>> for _ in range(7):
        ...     observation, reward, terminated, truncated, info = env.step(
        ...         np.array([1.0, 0.8, 0.0], np.float32)
        ...     )
        ...     if terminated:
        ...         break
        >>> reward, info  # (0.42, 0.336, 0) is 0.059 away from the diagonal
        (-0.1, {'is_success': False})

    ## Version History

    * v0: Initial version
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        path: str = "line",
        *,
        total_dims: int = 2,
        coupled_dims: int = 2,
        free_dims: int = 0,
        goal_position: float = 0.9,
        radius: float = 0.7,
        waypoints: Sequence[Sequence[float]] | None = None,
        width: float = 0.0175,
        reach: float = 0.14,
        start_noise: float = 0.0,
        dense_reward: float = 0.0,
        goal_reward: float = 1.0,
        leave_penalty: float = 0.1,
        render_mode: str | None = None,
        render_size: int = 600,
    ) -> None:
        check_render_mode(render_mode, RENDER_MODES)
        self.config = TunnelConfig(
            path=path,
            total_dims=total_dims,
            coupled_dims=coupled_dims,
            free_dims=free_dims,
            goal_position=goal_position,
            radius=radius,
            waypoints=waypoints,
            width=width,
            reach=reach,
            start_noise=start_noise,
            dense_reward=dense_reward,
            goal_reward=goal_reward,
            leave_penalty=leave_penalty,
        )
        self.render_mode = render_mode
        self.observation_space = self.config.observation_space
        self.action_space = self.config.action_space
        self._batch = TunnelBatch(self.config, count=1)
        self._action_shape = (total_dims,)
        self._arcs = np.zeros(1)
        self._renderer = Renderer(self.config, render_size)
        self._trail: list[NDArray[np.float64]] = []
        self._action_samples: NDArray[np.float64] | None = None

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the agent is, (D,)."""
        return self._batch.positions[0].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put the agent at the start; see "Starting State". `options` has no effect."""
        super().reset(seed=seed)
        if self.config.start_noise > 0.0:
            self._arcs[0] = self.config.draw_start(self.np_random)
        self._batch.reset(self._batch.everyone, self._arcs)
        self._action_samples = None
        if self.render_mode is not None:
            self._trail = [self.position]
            if self.render_mode == "human":
                self.render()
        return self._batch.observations[0].copy(), {"is_success": False}

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move by `action` (D,), clipped to [-1, 1], times the reach.

        Raises:
            ValueError: If `action` has another shape or contains NaN.
        """
        given = np.asarray(action)
        if given.shape != self._action_shape:
            raise ValueError(
                f"action must have shape {self._action_shape}, got shape {given.shape}"
            )
        batch = self._batch
        batch.step(given[None])
        if self.render_mode is not None:
            self._trail.append(self.position)
            if self.render_mode == "human":
                self.render()
        return (
            # A copy, because the batch overwrites its own and replay buffers keep ours.
            batch.observations[0].copy(),
            batch.rewards.item(),
            batch.terminated.item(),
            False,
            {"is_success": batch.success.item()},
        )

    def set_action_samples(self, samples: ArrayLike | None) -> None:
        """Draw actions, typically a policy's, as blue dots where they would lead.

        Args:
            samples: Actions (N, D) to be drawn around the agent until the next reset, or None to
                remove them.

        Raises:
            ValueError: If `samples` has another shape.
        """
        points = None if samples is None else np.asarray(samples, np.float64)
        if points is not None and (points.ndim != 2 or points.shape[1:] != self._action_shape):
            raise ValueError(
                f"samples must have shape (N, {self._action_shape[0]}), got {points.shape}"
            )
        self._action_samples = points

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame (render_size, render_size, 3), or show it if the mode is "human"."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a mode: gym.make(..., render_mode="rgb_array")')
            return None
        trail = np.array(self._trail or [self.position])
        if self.render_mode == "human":
            self._renderer.show(trail, self._action_samples)
            return None
        return self._renderer.frame(trail, self._action_samples)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()
