"""Many Squares stepped in one call."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.rendering import RENDER_FPS, Renderer
from flowpolicy_envs.vector import BatchVectorEnv, check_num_envs


class SquareVectorEnv(BatchVectorEnv):
    """N Squares with the same rules, each with its own random generator.

    Agent i behaves exactly like a `SquareEnv` that is reset with agent i's seed, and the whole
    exactly like gymnasium's `SyncVectorEnv` over N of them, `infos` included; it is only faster.

    Args:
        num_envs: Number of agents N, at least 1.
        max_episode_steps: Steps after which an episode is truncated, at least 1, or None for
            never. `gymnasium.make_vec` fills it in from the registration.
        autoreset_mode: What follows an episode's end: with "NextStep" the next call of `step`
            ignores the action and resets, with "SameStep" the agent is reset at once and
            `infos["final_obs"]` and `infos["final_info"]` tell how the episode ended, with
            "Disabled" the caller has to reset.
        render_mode: None or "rgb_array".
        render_size: Edge of each agent's frame in pixels.
        **square: The arguments of `SquareEnv`.

    Raises:
        ValueError: If an argument is outside of its range; the message names it.

    Example:
        >>> import gymnasium as gym
        >>> import flowpolicy_envs
        >>> envs = gym.make_vec(
        ...     "SquareHold-v0", num_envs=3, vectorization_mode="vector_entry_point"
        ... )
        >>> observations, infos = envs.reset(seed=1)
        >>> observations, rewards, terminations, truncations, infos = envs.step(np.zeros((3, 8)))
        >>> observations.shape, infos["end_reason"].tolist()
        ((3, 42), ['timeout', 'timeout', 'timeout'])
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = 40,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_size: int = 600,
        **square: Any,
    ) -> None:
        self.config = SquareConfig(**square)
        self._batch = SquareBatch(self.config, check_num_envs(num_envs))
        self._renderer = Renderer(self.config, render_size)
        super().__init__(
            self._batch,
            self.config.observation_space,
            self.config.action_space,
            num_envs=num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
            render_fps=RENDER_FPS,
        )

    @property
    def bodies(self) -> NDArray[np.float64]:
        """Position, angle and velocities x, y, theta, vx, vy, omega of the squares, (N, 6)."""
        return self._batch.bodies.copy()

    def _begin(self, chosen: NDArray[np.bool_]) -> None:
        self._batch.reset(chosen, self._generator)

    def _advance(self, actions: ArrayLike, active: NDArray[np.bool_] | None) -> None:
        self._batch.step(actions, active, self._generator)

    def _frame(self, i: int) -> NDArray[np.uint8]:
        return self._renderer.frame(self._batch, i)
