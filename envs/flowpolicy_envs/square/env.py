"""The Square as a gymnasium environment."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.canvas import RENDER_MODES, check_render_mode
from flowpolicy_envs.square.batch import END_REASONS, METRICS, SquareBatch
from flowpolicy_envs.square.config import FEATURES, Range, SquareConfig
from flowpolicy_envs.square.kernels import ACTIONS
from flowpolicy_envs.square.rendering import RENDER_FPS, Renderer
from flowpolicy_envs.square.tasks import Task

_STATE = (
    *("constants", "starts", "goals", "bodies", "fingers", "targets", "actions", "presses"),
    *("tallies", "metrics", "held", "found", "success", "ends"),
    *("observations", "rewards", "terminated"),
)


class SquareEnv(gym.Env[np.ndarray, np.ndarray]):
    r"""Hold a square with four fingers, and move it without letting go.

    ## Description

    A square lies in the world $[-1, 1]^2$, seen from above, with a finger at each side. There is
    no gravity in the picture: what pulls the square down does so out of the plane, and it is held
    while friction on its sides carries its weight,

    $$\mu \sum_i \bar F_{n,i} \ge W$$

    with the fingers' normal forces $\bar F_{n,i}$ averaged over a step of the agent. Four times
    a second, the agent requests a target for each finger, toward which a PD controller pulls it
    with limited force. Fingers are points with a viscous drag and without mass; the square has
    mass and inertia. Contact is rigid, with Coulomb friction. The mechanics are simulated at
    100 Hz; `docs/environments/square.md` has the equations.

    ## Action Space

    A `Box(-1, 1, (8,), float32)`: the targets, as a share of the reach from where each finger
    started. Actions outside of it are clipped.

    | Num | Action | Min | Max |
    |-----|--------|-----|-----|
    | 0, 1 | x, y of the target of the finger on the right | -1 | 1 |
    | 2, 3 | … of the finger on the top | -1 | 1 |
    | 4, 5 | … of the finger on the left | -1 | 1 |
    | 6, 7 | … of the finger at the bottom | -1 | 1 |

    ## Observation Space

    A `Box(-1, 1, (42,), float32)`: the two latest frames, the older one first. In a frame:

    | Num | Observation | Min | Max | Name in `observe` |
    |-----|-------------|-----|-----|-------------------|
    | 0, 1 | x, y of the square, world units | -1 | 1 | `position` |
    | 2, 3 | cosine and sine of its angle | -1 | 1 | `angle` |
    | 4 … 11 | x, y of the fingers from their start, share of the reach | -1 | 1 | `fingers` |
    | 12 … 19 | last action | -1 | 1 | `action` |
    | 20 | timer: from 1 down to 0 at the end of the warm-up | 0 | 1 | `timer` |

    With noise, values are clipped to [-1, 1].

    ## Rewards

    The task decides: `Hold`, `Move`, `MoveX`, `FindGoal` in `flowpolicy_envs.square.tasks`, whose
    arguments are the coefficients below. Per step, with defaults:

    | Term | `Hold` | `Move` | `MoveX` | `FindGoal` |
    |------|------|------|-------|----------|
    | `held`: the square is held | +1 | +1 | +1 | +1 |
    | `failure`: it drops or a finger breaks | -10 | -10 | -10 | -10 |
    | `overreach`: mean of $\max(0, \lvert a\rvert - 0.8) / 0.2$ | -0.1 | | | |
    | `angle`: $\lvert\theta\rvert$ | -0.2 | 0 | 0 | 0 |
    | `position`: distance from the middle | -0.5 | -0.5 at first | -0.5 at first | 0 |
    | `y`: $\lvert y\rvert$ after the warm-up | | 0 | -0.5 | 0 |
    | `effort`: mean of $k_p \lVert t - p \rVert / F_{max}$ | | -0.05 | -0.05 | -0.05 |
    | `goal`: the goal is reached for the first time | | | | +10 |

    "At first" is during the warm-up.

    ## Starting State

    Each episode draws, uniformly and independently: the start of each finger within
    `finger_noise` of its place, the pose of the square, and each constant that was given as an
    interval. Everything is at rest. `FindGoal` also draws the hidden goal.

    ## Episode End

    The episode terminates when the square is not held in a step that begins after the warm-up
    (*dropped*), or when a finger is pushed out of its reach by more than 2 % (*broken*). The ids
    truncate it: `SquareHold-v0` and `Square-v0` after 40 steps, which are 10 s, the others after
    80, which are 20 s.

    ## Info

    | Key | Meaning |
    |-----|---------|
    | `is_success` | `FindGoal`: the goal has been reached. Else: held, after the warm-up |
    | `held` | the square was held in this step |
    | `held_fraction` | share of this episode's steps in which it was |
    | `x_std`, `x_max` | standard deviation of x and maximum of \|x\|, after the warm-up |
    | `distance_std`, `distance_max` | the same of the distance from the middle |
    | `end_reason` | `"dropped"`, `"broken"`, else `"timeout"`: why the episode ends, if it does |

    ## Arguments

    Where the range says *interval*, a pair `[low, high]` draws a new value for each episode.

    | Argument | Default | Range | Meaning |
    |----------|---------|-------|---------|
    | `task` | `"hold"` | a `Task`, or `"hold"`, `"move"`, `"move_x"`, `"find_goal"` | the reward |
    | `size` | 0.6 | positive, interval | edge of the square, world units |
    | `mass` | 0.2 | positive, interval | $m$, kg |
    | `inertia` | 0.012 | positive, interval | $I$, kg per unit² |
    | `linear_damping` | 2 | at least 0, interval | $d_l$, N s per unit |
    | `angular_damping` | 0.05 | at least 0, interval | $d_a$, N s unit |
    | `friction` | 0.5 | at least 0, interval | $\mu$ |
    | `weight` | 3 | at least 0, interval | $W$, N |
    | `kp` | 25 | at least 0, interval | gain of the controllers, N per unit |
    | `kd` | 0.4 | at least 0, interval | gain of the controllers, N s per unit |
    | `finger_damping` | 0.1 | positive, interval | drag of the fingers, N s per unit |
    | `max_force` | 6 | positive, interval | limit of the controllers along each axis, N |
    | `max_speed` | 1 | positive, interval | of the fingers, units per s |
    | `reach` | 0.4 | positive, interval | of the fingers along each axis, world units |
    | `finger_distance` | 0.4 | at least 0 | from the middle to where fingers start |
    | `finger_noise` | 0.02 | at least 0 | how far that varies along each axis |
    | `start_x`, `start_y` | [-0.03, 0.03] | interval | where the square starts |
    | `start_angle` | [-0.1, 0.1] | interval | how it is turned, rad |
    | `warm_up` | 2 | at least 0 | s |
    | `observe` | all | names, see above | what is observed |
    | `observation_noise` | 0 | at least 0, or a mapping from names to that | standard deviation |
    | `stack` | 2 | at least 1 | number of frames observed |
    | `dt` | 0.01 | positive | s per substep |
    | `substeps` | 25 | at least 1 | per step of the agent |
    | `render_mode` | `None` | `None`, `"rgb_array"`, `"human"` | what `render()` does |
    | `render_size` | 600 | at least 16 | edge of a frame, pixels |

    Raises:
        ValueError: If an argument is outside of its range, or the constants are too stiff for
            `dt`; the message names it.

    Example:
        >>> import gymnasium as gym
        >>> import flowpolicy_envs
        >>> env = gym.make("Square-v0", task="move", max_force=2.4, weight=[2.5, 3.0])
        >>> _ = env.reset(seed=0)
        >>> inwards = np.array([-0.6, 0, 0, -0.6, 0.6, 0, 0, 0.6], np.float32)
        >>> for _ in range(40):
        ...     observation, reward, terminated, truncated, info = env.step(inwards)
        >>> info["held"], info["end_reason"], truncated
        (True, 'timeout', True)

    ## Version History

    * v0: Initial version
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        task: Task | str = "hold",
        *,
        size: Range = 0.6,
        mass: Range = 0.2,
        inertia: Range = 0.012,
        linear_damping: Range = 2.0,
        angular_damping: Range = 0.05,
        friction: Range = 0.5,
        weight: Range = 3.0,
        kp: Range = 25.0,
        kd: Range = 0.4,
        finger_damping: Range = 0.1,
        max_force: Range = 6.0,
        max_speed: Range = 1.0,
        reach: Range = 0.4,
        finger_distance: float = 0.4,
        finger_noise: float = 0.02,
        start_x: Range = (-0.03, 0.03),
        start_y: Range = (-0.03, 0.03),
        start_angle: Range = (-0.1, 0.1),
        warm_up: float = 2.0,
        observe: Sequence[str] = tuple(FEATURES),
        observation_noise: float | Mapping[str, float] = 0.0,
        stack: int = 2,
        dt: float = 0.01,
        substeps: int = 25,
        render_mode: str | None = None,
        render_size: int = 600,
    ) -> None:
        check_render_mode(render_mode, RENDER_MODES)
        self.config = SquareConfig(
            task=task,
            size=size,
            mass=mass,
            inertia=inertia,
            linear_damping=linear_damping,
            angular_damping=angular_damping,
            friction=friction,
            weight=weight,
            kp=kp,
            kd=kd,
            finger_damping=finger_damping,
            max_force=max_force,
            max_speed=max_speed,
            reach=reach,
            finger_distance=finger_distance,
            finger_noise=finger_noise,
            start_x=start_x,
            start_y=start_y,
            start_angle=start_angle,
            warm_up=warm_up,
            observe=observe,
            observation_noise=observation_noise,
            stack=stack,
            dt=dt,
            substeps=substeps,
        )
        self.render_mode = render_mode
        self.observation_space = self.config.observation_space
        self.action_space = self.config.action_space
        self._batch = SquareBatch(self.config, count=1)
        self._renderer = Renderer(self.config, render_size)
        self._action_samples: NDArray[np.float64] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; see "Starting State". `options` has no effect."""
        super().reset(seed=seed)
        self._batch.reset(self._batch.everyone, self._generator)
        self._action_samples = None
        if self.render_mode == "human":
            self.render()
        return self._batch.observations[0].copy(), self._info()

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Request targets `action` (8,), clipped to [-1, 1], and simulate until the next request.

        Raises:
            ValueError: If `action` has another shape or contains NaN.
        """
        given = np.asarray(action)
        if given.shape != (ACTIONS,):
            raise ValueError(f"action must have shape ({ACTIONS},), got shape {given.shape}")
        batch = self._batch
        batch.step(given[None], None, self._generator)
        if self.render_mode == "human":
            self.render()
        return (
            # A copy, because the batch overwrites its own and replay buffers keep ours.
            batch.observations[0].copy(),
            batch.rewards.item(),
            batch.terminated.item(),
            False,
            self._info(),
        )

    def get_state(self) -> dict[str, Any]:
        """Return all that decides what happens from here on, as a copy.

        Among it, for a single world: `bodies` (6,): x, y, theta, vx, vy, omega of the square;
        `fingers`, `targets`, `starts` (4, 2); `constants` (12,), see `square.kernels`; and
        `np_random`, the state of the random generator.
        """
        state = {name: getattr(self._batch, name)[0].copy() for name in _STATE}
        return {**state, "np_random": self.np_random.bit_generator.state}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on from where `get_state` was called, on this or an environment with equal arguments.

        Args:
            state: All of what `get_state` returns, or only the entries that are to change.
                Observations follow at the next step.

        Raises:
            ValueError: If an entry is unknown, not finite or of another shape.
        """
        for name, value in state.items():
            if name == "np_random":
                continue
            if name not in _STATE:
                raise ValueError(f"state must have entries of {_STATE}, got {name!r}")
            shape = getattr(self._batch, name)[0].shape
            if np.shape(value) != shape or not np.isfinite(value).all():
                raise ValueError(f"state must have finite {name} of shape {shape}, got {value}")
        for name, value in state.items():
            if name == "np_random":
                self.np_random.bit_generator.state = value
            else:
                getattr(self._batch, name)[0] = value

    def set_action_samples(self, samples: ArrayLike | None) -> None:
        """Draw actions, typically a policy's, as dots in the fingers' colours at their targets.

        Args:
            samples: Actions (N, 8) to be drawn until the next reset, or None to remove them.

        Raises:
            ValueError: If `samples` has another shape.
        """
        points = None if samples is None else np.asarray(samples, np.float64)
        if points is not None and (points.ndim != 2 or points.shape[1] != ACTIONS):
            raise ValueError(f"samples must have shape (N, {ACTIONS}), got {points.shape}")
        self._action_samples = points

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame (render_size, render_size, 3), or show it if the mode is "human"."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a mode: gym.make(..., render_mode="rgb_array")')
            return None
        if self.render_mode == "human":
            self._renderer.show(self._batch, 0, self._action_samples)
            return None
        return self._renderer.frame(self._batch, 0, self._action_samples)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()

    def _generator(self, _: int) -> np.random.Generator:
        return self.np_random

    def _info(self) -> dict[str, Any]:
        batch = self._batch
        return {
            "is_success": batch.success.item(),
            "held": batch.held.item(),
            **dict(zip(METRICS, batch.metrics[0].tolist(), strict=True)),
            "end_reason": END_REASONS[batch.ends.item()],
        }
