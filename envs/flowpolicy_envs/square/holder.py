"""A scripted controller that never drops the square."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.square.config import DIRECTIONS
from flowpolicy_envs.square.kernels import ACTIONS


class Holder:
    """Presses all four fingers inwards by the same amount, regardless of the observation.

    Maps an observation, or a batch of them, to an action: a controller for
    `sb3_flowpolicy.algorithms.demonstrations.record_demonstrations`.

    Args:
        push: Distance of the targets inwards, as a share of the reach, in [0, 1].
        noise: Standard deviation of normal noise on each component of the action. Without noise,
            demonstrations say little about the effect of other actions.
        seed: Seed of the noise.

    Raises:
        ValueError: If an argument is outside of its range.

    Example:
        >>> Holder(push=0.5)(np.zeros(42)).tolist()
        [-0.5, -0.0, -0.0, -0.5, 0.5, -0.0, -0.0, 0.5]
    """

    def __init__(self, push: float = 0.65, noise: float = 0.0, seed: int | None = None) -> None:
        if not 0.0 <= push <= 1.0:
            raise ValueError(f"push must be in [0, 1], got {push}")
        if not 0.0 <= noise < np.inf:
            raise ValueError(f"noise must be finite and at least 0, got {noise}")
        self.push, self.noise = push, noise
        self._inwards = -push * DIRECTIONS.ravel()
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Return the action (8,), or (N, 8) for observations (N, O)."""
        shape = (*np.shape(observation)[:-1], ACTIONS)
        actions = np.broadcast_to(self._inwards, shape)
        if self.noise > 0.0:
            actions = actions + self.noise * self._rng.standard_normal(shape)
        return np.clip(actions, -1.0, 1.0).astype(np.float32)
