"""Many Tunnels stepped in one call."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.rendering import Renderer
from flowpolicy_envs.vector import BatchVectorEnv, check_num_envs


class TunnelVectorEnv(BatchVectorEnv):
    """N Tunnels of the same shape, each with its own random generator.

    Agent i behaves exactly like a `TunnelEnv` that is reset with agent i's seed, and the whole
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
        **tunnel: The arguments of `TunnelEnv`.

    Raises:
        ValueError: If an argument is outside of its range; the message names it.

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

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = 40,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_size: int = 600,
        **tunnel: Any,
    ) -> None:
        self.config = TunnelConfig(**tunnel)
        self._batch = TunnelBatch(self.config, check_num_envs(num_envs))
        self._arcs = np.zeros(num_envs)
        self._renderer = Renderer(self.config, render_size)
        super().__init__(
            self._batch,
            self.config.observation_space,
            self.config.action_space,
            num_envs=num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
        )

    @property
    def positions(self) -> NDArray[np.float64]:
        """Where the agents are, (N, D)."""
        return self._batch.positions.copy()

    def _begin(self, chosen: NDArray[np.bool_]) -> None:
        if self.config.start_noise > 0.0:
            for i in np.flatnonzero(chosen).tolist():
                self._arcs[i] = self.config.draw_start(self._generator(i))
        self._batch.reset(chosen, self._arcs)

    def _advance(self, actions: ArrayLike, active: NDArray[np.bool_] | None) -> None:
        self._batch.step(actions, active)

    def _frame(self, i: int) -> NDArray[np.uint8]:
        # Without a trail: that would have to be kept for every agent.
        return self._renderer.frame(self._batch.positions[i][None])
