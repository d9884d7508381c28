"""The Square as a gymnasium environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowpolicy_envs.canvas import RENDER_MODES
from flowpolicy_envs.env import BatchEnv
from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.rendering import RENDER_FPS, Renderer
from flowpolicy_envs.square.tasks import Task

_STATE = (
    *("constants", "starts", "goals", "bodies", "fingers", "targets", "actions", "presses"),
    *("tallies", "metrics", "held", "found", "success", "ends"),
    *("observations", "rewards", "terminated"),
)


class SquareEnv(BatchEnv):
    r"""Hold a square with four fingers, and move it without letting go.

    ## Description

    A square lies in the world $[-1, 1]^2$, seen from above, with a finger at each side. Its weight
    pulls it down, out of the plane, and friction on its sides holds it as long as

    $$\mu \sum_i \bar F_{n,i} \ge W$$

    with the fingers' normal forces $\bar F_{n,i}$ averaged over a step of the agent. With
    `friction_cone`, tangential forces $F_{t,i}$ use up part of the friction: the left side becomes
    the average of $\sum_i \sqrt{(\mu F_{n,i})^2 - F_{t,i}^2}$. Four times a
    second, the agent requests a target for each finger, to which a PD controller moves the finger
    with limited force. Fingers are massless points with viscous drag; the square has mass and
    inertia. Contact is rigid, with Coulomb friction. The mechanics are simulated at 100 Hz;
    `docs/environments/square.md` has the equations.

    ## Action Space

    A `Box(-1, 1, (8,), float32)`: the targets relative to the start of each finger, as a share of
    the reach. Actions outside it are clipped.

    | Num | Action | Min | Max |
    |-----|--------|-----|-----|
    | 0, 1 | x, y of the target of the finger on the right | -1 | 1 |
    | 2, 3 | … of the finger at the top | -1 | 1 |
    | 4, 5 | … of the finger on the left | -1 | 1 |
    | 6, 7 | … of the finger at the bottom | -1 | 1 |

    ## Observation Space

    A `Box(-1, 1, (42,), float32)`: the two latest frames, the older one first. A frame holds:

    | Num | Observation | Min | Max | Name in `observe` |
    |-----|-------------|-----|-----|-------------------|
    | 0, 1 | x, y of the square, world units | -1 | 1 | `position` |
    | 2, 3 | cosine and sine of its angle | -1 | 1 | `angle` |
    | 4 … 11 | x, y of the fingers from their start, share of the reach | -1 | 1 | `fingers` |
    | 12 … 19 | last action | -1 | 1 | `action` |
    | 20 | timer: from 1 down to 0 at the end of the warm-up | 0 | 1 | `timer` |

    With noise, values are clipped to [-1, 1].

    ## Rewards

    The tasks `Hold`, `Move`, `MoveX`, `FindGoal` in `flowpolicy_envs.square.tasks` have the
    coefficients below as arguments; `"hold"`, `"move"`, `"move_x"`, and `"find_goal"` have the
    defaults, and `{"name": "move_x", "angle": 0.3}` changes some. Per step, with defaults:

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

    Each episode draws, uniformly and independently, the start of each finger within `finger_noise`
    of its place, the pose of the square, and each constant that was given as an interval.
    Everything is at rest. `FindGoal` also draws the hidden goal.

    ## Episode End

    The episode terminates when the square is not held in a step that begins after the warm-up
    (*dropped*), or when a finger is pushed out of its reach by more than 2 % (*broken*).
    `SquareHold` and `Square` truncate it after 40 steps (10 s), the others after 80 (20 s).

    ## Info

    | Key | Meaning |
    |-----|---------|
    | `is_success` | `FindGoal`: the goal has been reached. Else: held, after the warm-up |
    | `held` | the square was held in this step |
    | `held_fraction` | share of the steps of this episode in which it was held |
    | `x_std`, `x_max` | standard deviation of x and maximum of \|x\|, after the warm-up |
    | `distance_std`, `distance_max` | the same of the distance from the middle |
    | `end_reason` | `"dropped"`, `"broken"` or else `"timeout"`: reason if the episode ends now |

    ## Arguments

    For arguments with the range *interval*, a pair `[low, high]` draws a value for each episode.

    | Argument | Default | Range | Meaning |
    |----------|---------|-------|---------|
    | `task` | `"hold"` | a `Task`, a name, or a mapping, see above | the reward |
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
    | `finger_distance` | 0.4 | at least 0 | from the middle to the start of the fingers |
    | `finger_noise` | 0.02 | at least 0 | variation of the start along each axis |
    | `start_x`, `start_y` | [-0.03, 0.03] | interval | initial position of the square |
    | `start_angle` | [-0.1, 0.1] | interval | initial angle of the square, rad |
    | `warm_up` | 2 | at least 0 | s |
    | `observe` | all | names, see above | parts of the observation |
    | `observation_noise` | 0 | at least 0, or a mapping from names to that | standard deviation |
    | `stack` | 2 | at least 1 | number of frames observed |
    | `dt` | 0.01 | positive | s per substep |
    | `substeps` | 25 | at least 1 | per step of the agent |
    | `slew` | 0 | at least 0, at most a step | s in which targets move to the requested ones |
    | `friction_cone` | `False` | | friction that drags the square does not carry it, see above |
    | `render_mode` | `None` | `None`, `"rgb_array"`, `"human"` | effect of `render()` |
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

    * v1 (all ids but `Square`): `friction_cone`, `slew` of 0.25 s, stiffer fingers (`kp` 50, `kd`
      0.5) and `friction` 1.25, so that independent noise breaks the grip and joint motion does
      not; moving: `weight` 7.5, `linear_damping` 1, a penalty of the angle of 0.3 per radian;
      holding: `weight` 11.5, `max_force` 3
    * v0: Initial version
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        task: Task | str | Mapping[str, Any] = "hold",
        *,
        render_mode: str | None = None,
        render_size: int = 600,
        **arguments: Any,
    ) -> None:
        config = SquareConfig(task, **arguments)
        self._batch = SquareBatch(config, count=1)
        super().__init__(self._batch, Renderer(config, render_size), render_mode)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of everything that determines the future.

        It holds, for a single world: `bodies` (6,): x, y, theta, vx, vy, omega of the square;
        `fingers`, `targets`, `starts` (4, 2); `constants` (12,), see `square.kernels`; and
        `np_random`, the state of the random generator, among others.
        """
        state = {name: getattr(self._batch, name)[0].copy() for name in _STATE}
        return {**state, "np_random": self.np_random.bit_generator.state}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of this environment or of one with equal arguments.

        Args:
            state: What `get_state` returned, or only the entries to change. Observations change
                with the next step.

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

    def _scene(self) -> tuple[Any, ...]:
        return self._batch, 0, self._action_samples
