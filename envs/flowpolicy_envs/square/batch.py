"""The state of N Squares, with reset and step."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.env import Generators
from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.tasks import as_task

METRICS = ("held_fraction", "x_std", "x_max", "distance_std", "distance_max")
END_REASONS = np.array(["timeout", "dropped", "broken"], dtype=object)


class RollOut(NamedTuple):
    """T steps of N worlds, arrays of shape (T, N).

    Attributes:
        taken: Whether the world was still running.
        failed: Whether this step ended the episode.
        rewards: Zero after the end.
        log_slopes: Sum over the components of log(1 - a^2): what tanh adds to the entropy.
    """

    taken: NDArray[np.bool_]
    failed: NDArray[np.bool_]
    rewards: NDArray[np.float64]
    log_slopes: NDArray[np.float64]


class SquareBatch:
    """N worlds with the same rules, each with its own constants and poses.

    The single and the vectorized environment use this class, the single one with N = 1, so they
    agree bit for bit. The arrays below are allocated once and overwritten by each call: copy what
    you keep.

    Args:
        config: The rules.
        count: Number of worlds N, at least 1.

    Attributes:
        observations: What the agents see, (N, O).
        rewards: Reward of the latest step, (N,).
        terminated: Whether the latest step ended the episode, (N,).
        bodies: Position, angle and velocities x, y, theta, vx, vy, omega of the squares, (N, 6).
        fingers: Positions of the fingers, (N, 4, 2).
        targets: Targets of the fingers' controllers, (N, 4, 2).
        presses: Mean normal force of each finger during the latest step, in newtons, (N, 4).
        held: Whether these forces hold the square, (N,).
        success: Whether the goal has been reached or, without a goal, the square is held after
            the warm-up, (N,).
        metrics: The columns named in `METRICS`, (N, 5).

    Example:
        >>> batch = SquareBatch(SquareConfig(), count=2)
        >>> batch.reset(batch.everyone, lambda n: np.random.default_rng(n))
        >>> inwards = [-0.6, 0, 0, -0.6, 0.6, 0, 0, 0.6]
        >>> for _ in range(4):
        ...     batch.step([inwards, np.zeros(8)])
        >>> batch.held.tolist()
        [True, False]
    """

    def __init__(self, config: SquareConfig, count: int) -> None:
        self.config = config
        self.everyone = np.ones(count, dtype=np.bool_)
        self.bodies = np.zeros((count, 6))
        self.fingers = np.zeros((count, kernels.FINGERS, 2))
        self.targets = np.zeros((count, kernels.FINGERS, 2))
        self.presses = np.zeros((count, kernels.FINGERS))
        self.held = np.zeros(count, dtype=np.bool_)
        self.observations = np.zeros((count, *config.observation_space.shape), np.float32)
        self.rewards = np.zeros(count)
        self.terminated = np.zeros(count, dtype=np.bool_)
        self.constants = np.ones((count, kernels.N_CONSTANTS))
        self.starts = np.zeros((count, kernels.FINGERS, 2))
        self.goals = np.zeros((count, 2))
        self.actions = np.zeros((count, kernels.ACTIONS))
        self.tallies = np.zeros((count, kernels.N_TALLIES))
        self.metrics = np.zeros((count, kernels.N_METRICS))
        self.found = np.zeros(count, dtype=np.bool_)
        self.success = np.zeros(count, dtype=np.bool_)
        self.ends = np.zeros(count, dtype=np.int64)
        self._uniform = np.zeros((count, kernels.N_SETUP))
        self._setup_ends = config.setup_ends
        self._noise = np.zeros((count, config.frame_width))
        self._requests = np.zeros((count, kernels.ACTIONS))
        # Built once: building these tuples takes as long as a step.
        self._seen = (
            config.picked,
            self._noise,
            np.zeros(kernels.N_FEATURES),
            self.constants,
            self.starts,
            self.bodies,
            self.fingers,
            self.targets,
            self.actions,
            self.presses,
            self.tallies,
            self.metrics,
            self.held,
            self.found,
            self.success,
            self.ends,
            self.observations,
        )
        self._rules = (
            float(config.dt),
            int(config.substeps),
            int(config.slew_substeps),
            bool(config.friction_cone),
            float(config.warm_steps),
            as_task(config.task).terms(),
            self.goals,
            np.zeros((2, kernels.FINGERS, 2)),
            np.zeros(kernels.SCRATCH),
            np.zeros((kernels.FINGERS, 4)),
            self.rewards,
            self.terminated,
        )
        self.is_noisy = bool(config.noise.any())

    def reset(self, chosen: NDArray[np.bool_], generators: Generators) -> None:
        """Start new episodes.

        Args:
            chosen: In which worlds, boolean of shape (N,).
            generators: Function from the index of a world to its random generator.
        """
        for n in np.flatnonzero(chosen).tolist():
            generators(n).random(out=self._uniform[n])
        self._draw_noise(chosen, generators)
        kernels.reset_batch(chosen, self._uniform, *self._setup_ends, self.goals, *self._seen)

    def step(
        self,
        actions: ArrayLike,
        active: NDArray[np.bool_] | None = None,
        generators: Generators | None = None,
    ) -> None:
        """Request targets, simulate, and overwrite the arrays with the outcome.

        Args:
            actions: Targets as a share of the reach, (N, 8); clipped to [-1, 1].
            active: Which worlds move, boolean of shape (N,); all by default.
            generators: As for `reset`; needed for noisy observations.

        Raises:
            ValueError: If `actions` has another shape or an active world's action contains NaN.
        """
        given = np.asarray(actions)
        if given.shape != self._requests.shape:
            raise ValueError(
                f"actions must have shape {self._requests.shape}, got shape {given.shape}"
            )
        self._requests[...] = given
        moving = self.everyone if active is None else active
        if self.is_noisy and generators is not None:
            self._draw_noise(moving, generators)
        culprit = kernels.step_batch(self._requests, moving, *self._rules, *self._seen)
        if culprit >= 0:
            raise ValueError(f"actions must not contain NaN, got {given[culprit]} at {culprit}")

    def roll_out(self, means: ArrayLike, noise: NDArray[np.float64]) -> RollOut:
        """Run all worlds to their end under a squashed normal policy, compiled as a whole.

        The actions are tanh(`means` + `noise`). Observations get no noise.

        Args:
            means: (8,).
            noise: (T, N, 8) for T steps.

        Returns:
            What happened. The metrics of the batch describe the episodes.
        """
        shape = noise.shape[:2]
        flags = np.zeros((2, *shape), np.bool_)
        numbers = np.zeros((2, *shape))
        mean = np.asarray(means, np.float64)
        ends = (self.rewards, self.terminated)
        rest = (*self._rules, *self._seen)
        kernels.roll_out(mean, noise, self.everyone.copy(), *flags, *numbers, *ends, rest)
        return RollOut(*flags, *numbers)

    def info(self, n: int) -> dict[str, Any]:
        """Return the `info` of world n, see `SquareEnv`."""
        return {
            "is_success": self.success.item(n),
            "held": self.held.item(n),
            **dict(zip(METRICS, self.metrics[n].tolist(), strict=True)),
            "end_reason": END_REASONS[self.ends.item(n)],
        }

    def infos(self) -> dict[str, NDArray]:
        """Return new arrays (N,) with the `info` of all worlds."""
        columns = dict(zip(METRICS, self.metrics.T.copy(), strict=True))
        return {
            "is_success": self.success.copy(),
            "held": self.held.copy(),
            **columns,
            "end_reason": END_REASONS[self.ends],
        }

    def _draw_noise(self, chosen: NDArray[np.bool_], generators: Generators) -> None:
        if self.is_noisy:
            scale = self.config.noise
            for n in np.flatnonzero(chosen).tolist():
                self._noise[n] = scale * generators(n).standard_normal(len(scale))
