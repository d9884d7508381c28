"""What the single environments have in common: they are batches of one agent."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.canvas import RENDER_FPS, RENDER_MODES, Canvas, check_render_mode

BoolArray = NDArray[np.bool_]
Generators = Callable[[int], np.random.Generator]


class Batch(Protocol):
    """The state of N agents. Each call of `step` overwrites the arrays (N, ...)."""

    config: Any
    everyone: BoolArray
    observations: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminated: BoolArray

    def reset(self, chosen: BoolArray, generators: Generators) -> None:
        """Start new episodes of the `chosen` (N,) agents, with the generator of each."""

    def step(
        self, actions: ArrayLike, active: BoolArray | None = None, generators: Any = None
    ) -> None:
        """Step the `active` (N,) agents, all by default, by their actions (N, D)."""

    def info(self, n: int) -> dict[str, Any]:
        """Return the `info` of agent n."""

    def infos(self) -> dict[str, NDArray[Any]]:
        """Return new arrays (N,) with the `info` of all agents."""


class BatchEnv(gym.Env[np.ndarray, np.ndarray]):
    """A batch of one agent as a gymnasium environment.

    Args:
        batch: Its state and configuration.
        renderer: Draws it.
        render_mode: None, "rgb_array" or "human".

    Raises:
        ValueError: If `render_mode` is unknown.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(self, batch: Batch, renderer: Canvas, render_mode: str | None) -> None:
        check_render_mode(render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.config = batch.config
        self.observation_space = self.config.observation_space
        self.action_space = self.config.action_space
        self._action_shape = self.config.action_space.shape
        self._agent = batch
        self._renderer = renderer
        self._action_samples: NDArray[np.float64] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see "Starting State". `options` has no effect."""
        super().reset(seed=seed)
        self._agent.reset(self._agent.everyone, self._generator)
        self._action_samples = None
        if self.render_mode is not None:
            self._show()
        return self._agent.observations[0].copy(), self._agent.info(0)

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Do one step with `action` (D,), clipped to [-1, 1].

        Raises:
            ValueError: If `action` has another shape or contains NaN.
        """
        given = np.asarray(action)
        if given.shape != self._action_shape:
            raise ValueError(
                f"action must have shape {self._action_shape}, got shape {given.shape}"
            )
        agent = self._agent
        agent.step(given[None], None, self._generator)
        if self.render_mode is not None:
            self._show()
        return (
            # A copy, because replay buffers keep it and the batch overwrites its array.
            agent.observations[0].copy(),
            agent.rewards.item(),
            agent.terminated.item(),
            False,
            agent.info(0),
        )

    def set_action_samples(self, samples: ArrayLike | None) -> None:
        """Draw actions, typically samples of a policy, as dots where they would lead.

        Args:
            samples: Actions (N, D) to draw until the next reset, or None to remove them.

        Raises:
            ValueError: If `samples` has another shape.
        """
        points = None if samples is None else np.asarray(samples, np.float64)
        if points is not None and (points.ndim != 2 or points.shape[1:] != self._action_shape):
            raise ValueError(
                f"samples must have shape (N, {self._action_shape[0]}), got {points.shape}"
            )
        self._action_samples = points

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame (render_size, render_size, 3), or show it if the mode is "human"."""
        if self.render_mode is None:
            gym.logger.warn('render() needs a mode: gym.make(..., render_mode="rgb_array")')
            return None
        if self.render_mode == "human":
            self._renderer.show(*self._scene())
            return None
        return self._renderer.frame(*self._scene())

    def close(self) -> None:
        """Close the window, if there is one."""
        self._renderer.close()

    @abstractmethod
    def _scene(self) -> tuple[Any, ...]:
        """Return the arguments of the renderer."""

    def _show(self) -> None:
        """Update the window after a reset or a step."""
        if self.render_mode == "human":
            self.render()

    def _generator(self, _: int) -> np.random.Generator:
        return self.np_random
