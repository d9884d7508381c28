"""Many Tunnels stepped in one call."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.env import Batch
from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.rendering import Renderer
from flowpolicy_envs.vector import BatchVectorEnv


class TunnelVectorEnv(BatchVectorEnv):
    """N Tunnels of the same shape; see :class:`~flowpolicy_envs.vector.BatchVectorEnv`.

    Example:
        >>> import gymnasium as gym
        >>> import flowpolicy_envs
        >>> envs = gym.make_vec(
        ...     "TunnelDiagonal-v0", num_envs=3, vectorization_mode="vector_entry_point"
        ... )
        >>> observations, infos = envs.reset(seed=1)
        >>> actions = np.array([[1, 1], [1, -1], [-0.5, -0.5]], np.float32)
        >>> observations, rewards, terminations, truncations, infos = envs.step(actions)
        >>> rewards.tolist(), terminations.tolist()
        ([0.0, -0.1, 0.0], [False, True, False])
    """

    def _build(self, num_envs: int, render_size: int, **arguments: Any) -> tuple[Batch, Renderer]:
        config = TunnelConfig(**arguments)
        self._batch = TunnelBatch(config, num_envs)
        return self._batch, Renderer(config, render_size)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Positions of the agents, (N, D)."""
        return self._batch.positions.copy()

    def _scene(self, i: int) -> tuple[Any, ...]:
        return (self._batch.positions[i][None],)  # without a trail, which is not recorded here
