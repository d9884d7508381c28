"""Many Squares stepped in one call."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.env import Batch
from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.rendering import Renderer
from flowpolicy_envs.vector import BatchVectorEnv


class SquareVectorEnv(BatchVectorEnv):
    """N Squares with the same rules; see :class:`~flowpolicy_envs.vector.BatchVectorEnv`.

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

    def _build(self, num_envs: int, render_size: int, **arguments: Any) -> tuple[Batch, Renderer]:
        config = SquareConfig(**arguments)
        self._batch = SquareBatch(config, num_envs)
        return self._batch, Renderer(config, render_size)

    @property
    def bodies(self) -> NDArray[np.float64]:
        """Position, angle and velocities x, y, theta, vx, vy, omega of the squares, (N, 6)."""
        return self._batch.bodies.copy()

    def _scene(self, i: int) -> tuple[Any, ...]:
        return self._batch, i
