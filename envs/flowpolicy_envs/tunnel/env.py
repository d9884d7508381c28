"""The Tunnel as a gymnasium environment."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.env import BatchEnv
from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.rendering import Renderer


class TunnelEnv(BatchEnv):
    r"""Follow a path that is several times narrower than a step is long.

    ## Description

    An agent lives in the world $[-1, 1]^D$ and has to reach a goal region without leaving a
    tunnel of width $w$. There is no inertia: from position $p$, the action $a$ leads to

    $$p' = p + r\,a$$

    where $r$ is the reach. Only $p'$ has to lie in the tunnel, not the points between. The tunnel
    ends at the border of the world: an agent that steps out of the world leaves the tunnel, unless
    it does so in the goal region. Free dimensions end in walls. As $r$ is larger than $w$, a long
    step stays inside only if its coordinates match. The path determines how many of them:

    - `path="line"`: The first $C$ dimensions are *coupled*. On them, the center line runs along
      $(1, \dots, 1)$ through the origin to both ends of the world, and the distance from it must
      not exceed $w/2$. The last $F$ dimensions are *free* and unconstrained. The dimensions in
      between must stay within $w/2$ of 0. With $C = 1$ the constraints can be met one dimension at
      a time; with $C \ge 2$ they cannot. The goal region is the part of the tunnel whose projection
      on the line is at or beyond the point with `goal_position` on each coupled axis.
    - `path="circle"` ($D = 2$): The tunnel is the ring $\big|\|p\| - R\big| \le w/2$. The start is
      at angle 0; the goal region is a twentieth of the ring, centered at two thirds of a turn
      counter-clockwise. The ring is open both ways, and distances are counted along the shorter
      one.
    - `path="spline"` ($D = 2$): The tunnel is the band within $w/2$ of a polyline through the way
      points. The start is the first of them, the goal region the last twentieth of its length.

    ## Action Space

    A `Box(-1, 1, (D,), float32)`. Actions outside it are clipped.

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
      (negative for a step back), for steps that end in the tunnel;
    - `goal_reward` for reaching the goal region;
    - `-leave_penalty` for leaving the tunnel.

    ## Starting State

    On the center line: at the origin of the line, at angle 0 of the circle, at the first way point
    of the spline. With `start_noise` $n > 0$ the start is drawn uniformly from the part of the
    path within $n$ of that point, measured along the path.

    ## Episode End

    The episode terminates when the agent leaves the tunnel or reaches the goal region. All ids
    truncate it after 40 steps, `TunnelSpline-v0` after 60. `info["is_success"]` is true in the step
    that reaches the goal and false otherwise.

    The smallest number of steps to the goal: on the two lines each coordinate has to cover 0.9 at
    0.14 per step, which takes 7 steps ($6 \cdot 0.14 = 0.84$). On the two circles, $R = 0.7$ and $r
    = 0.21$: the shorter way to the goal region spans $120° - 9° = 111°$. A step is at most $r$ long
    along an axis, $\sqrt 2\,r$ along a diagonal and $1.12\,r$ on average over directions; as chords
    of this circle these are 17.3°, 24.5° and 19.4°. Five steps would have to cover 22.2° each, more
    than the average, and six 18.5° each: it takes 6.

    ## Arguments

    | Argument | Default | Range | Meaning |
    |----------|---------|-------|---------|
    | `path` | `"line"` | `"line"`, `"circle"`, `"spline"` | shape of the center line |
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
    | `render_mode` | `None` | `None`, `"rgb_array"`, `"human"` | effect of `render()` |
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

    * v1 (the two circles): `dense_reward` of 0.25 instead of 1
    * v0: Initial version
    """

    def __init__(
        self,
        path: str = "line",
        *,
        render_mode: str | None = None,
        render_size: int = 600,
        **arguments: Any,
    ) -> None:
        config = TunnelConfig(path, **arguments)
        self._batch = TunnelBatch(config, count=1)
        super().__init__(self._batch, Renderer(config, render_size), render_mode)
        self._trail: list[NDArray[np.float64]] = []

    @property
    def position(self) -> NDArray[np.float64]:
        """Position of the agent, (D,)."""
        return self._batch.positions[0].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put the agent at the start; see "Starting State". `options` has no effect."""
        self._trail = []
        return super().reset(seed=seed, options=options)

    def _show(self) -> None:
        self._trail.append(self.position)
        super()._show()

    def _scene(self) -> tuple[Any, ...]:
        return np.array(self._trail or [self.position]), self._action_samples
