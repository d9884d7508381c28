"""The state of N Tunnels, with reset and step."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.env import Generators
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.kernels import reset_batch, step_batch


class TunnelBatch:
    """N agents in tunnels of the same shape.

    The single and the vectorized environment use this class, the single one with N = 1, so they
    agree bit for bit. The arrays below are allocated once and overwritten by each call: copy what
    you keep.

    Args:
        config: The tunnel.
        count: Number of agents N, at least 1.

    Attributes:
        positions: Where the agents are, (N, D).
        observations: What the agents see, (N, O).
        rewards: Reward of the latest step, (N,).
        terminated: Whether the latest step ended the episode, (N,).
        success: Whether it did so by reaching the goal, (N,).

    Example:
        >>> batch = TunnelBatch(TunnelConfig(), count=2)
        >>> batch.reset(batch.everyone, np.random.default_rng)
        >>> batch.step([[1.0, 1.0], [1.0, -1.0]])
        >>> batch.terminated.tolist()
        [False, True]
    """

    def __init__(self, config: TunnelConfig, count: int) -> None:
        geometry = config.geometry
        self.config = config
        self.everyone = np.ones(count, dtype=np.bool_)
        self.positions = np.zeros((count, geometry.dims))
        self.observations = np.zeros((count, *config.observation_space.shape), np.float32)
        self.rewards = np.zeros(count)
        self.terminated = np.zeros(count, dtype=np.bool_)
        self.success = np.zeros(count, dtype=np.bool_)
        self._arcs = np.zeros(count)
        self._remaining = np.zeros(count)
        self._actions = np.zeros((count, geometry.dims))
        self._path = (geometry.kind, geometry.numbers, geometry.table)
        # Built once: building this tuple takes as long as a step.
        self._rules = (
            *self._path,
            config.width / 2.0,
            float(config.reach),
            float(config.dense_reward),
            float(config.goal_reward),
            float(config.leave_penalty),
            self._actions,
        )
        self._state = (
            self.positions,
            self._remaining,
            self.observations,
            self.rewards,
            self.terminated,
            self.success,
        )
        self._place(self.everyone)

    def reset(self, chosen: NDArray[np.bool_], generators: Generators) -> None:
        """Put agents at the start.

        Args:
            chosen: Which agents, boolean of shape (N,).
            generators: Function from the index of an agent to its random generator.
        """
        if self.config.start_noise > 0.0:
            for n in np.flatnonzero(chosen).tolist():
                self._arcs[n] = self.config.draw_start(generators(n))
        self._place(chosen)

    def _place(self, chosen: NDArray[np.bool_]) -> None:
        state = (self.positions, self._remaining, self.observations)
        reset_batch(*self._path, self._arcs, chosen, *state)
        self.success[chosen] = False

    def step(
        self,
        actions: ArrayLike,
        active: NDArray[np.bool_] | None = None,
        generators: Generators | None = None,
    ) -> None:
        """Move agents and overwrite the arrays with the outcome.

        Args:
            actions: Steps as a share of the reach, (N, D); clipped to [-1, 1].
            active: Which agents move, boolean of shape (N,); all by default.
            generators: Not used, as steps are deterministic.

        Raises:
            ValueError: If `actions` has another shape or an active agent's action contains NaN.
        """
        given = np.asarray(actions)
        if given.shape != self._actions.shape:
            raise ValueError(
                f"actions must have shape {self._actions.shape}, got shape {given.shape}"
            )
        self._actions[...] = given
        moving = self.everyone if active is None else active
        culprit = step_batch(*self._rules, moving, *self._state)
        if culprit >= 0:
            raise ValueError(f"actions must not contain NaN, got {given[culprit]} at {culprit}")

    def info(self, n: int) -> dict[str, Any]:
        """Return the `info` of agent n."""
        return {"is_success": self.success.item(n)}

    def infos(self) -> dict[str, NDArray]:
        """Return new arrays (N,) with the `info` of all agents."""
        return {"is_success": self.success.copy()}
