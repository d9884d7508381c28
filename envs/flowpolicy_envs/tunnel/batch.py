"""The state of N Tunnels, and the two things that happen to it: resets and steps."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.kernels import reset_batch, step_batch


class TunnelBatch:
    """N agents in tunnels of the same shape.

    Both environments are thin layers over this class, the single one with N = 1, which is why
    they agree to the last bit. The arrays below are allocated once and overwritten by each call:
    whoever hands them on has to copy them.

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
        >>> batch.reset(np.ones(2, dtype=bool), np.zeros(2))
        >>> batch.step([[1.0, 1.0], [1.0, -1.0]])
        >>> batch.terminated.tolist()
        [False, True]
    """

    def __init__(self, config: TunnelConfig, count: int) -> None:
        geometry = config.geometry
        self.everyone = np.ones(count, dtype=np.bool_)
        self.positions = np.zeros((count, geometry.dims))
        self.observations = np.zeros((count, *config.observation_space.shape), np.float32)
        self.rewards = np.zeros(count)
        self.terminated = np.zeros(count, dtype=np.bool_)
        self.success = np.zeros(count, dtype=np.bool_)
        self._remaining = np.zeros(count)
        self._actions = np.zeros((count, geometry.dims))
        self._path = (geometry.kind, geometry.numbers, geometry.table)
        # Collected once: building this tuple anew would cost as much as the step itself.
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
        self.reset(self.everyone, np.zeros(count))

    def reset(self, chosen: np.ndarray, arcs: np.ndarray) -> None:
        """Put agents on the centre line.

        Args:
            chosen: Which agents, boolean of shape (N,).
            arcs: Where along the path, (N,); ignored for agents that are not chosen.
        """
        reset_batch(*self._path, arcs, chosen, self.positions, self._remaining, self.observations)
        self.success[chosen] = False

    def step(self, actions: ArrayLike, active: np.ndarray | None = None) -> None:
        """Move agents and overwrite the arrays with the outcome.

        Args:
            actions: Steps as a share of the reach, (N, D); clipped to [-1, 1].
            active: Which agents move, boolean of shape (N,); all by default.

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

    def infos(self) -> dict[str, NDArray]:
        """Return what is known about the episodes: arrays (N,)."""
        return {"is_success": self.success.copy()}
