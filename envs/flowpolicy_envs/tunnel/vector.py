"""Many Tunnels stepped in one call."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.tunnel.batch import TunnelBatch
from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.rendering import RENDER_FPS, Renderer, check_render_mode

BoolArray = NDArray[np.bool_]
StepResult = tuple[NDArray[np.float32], NDArray[np.float64], BoolArray, BoolArray, dict[str, Any]]


class TunnelVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], np.ndarray]):
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
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs must be an integer of at least 1, got {num_envs!r}")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be None or >= 1, got {max_episode_steps}")
        check_render_mode(render_mode, ("rgb_array",))
        self.config = TunnelConfig(**tunnel)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.config.observation_space
        self.single_action_space = self.config.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._batch = TunnelBatch(self.config, num_envs)
        self._limit = np.iinfo(np.int64).max if max_episode_steps is None else max_episode_steps
        self._steps = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._arcs = np.zeros(num_envs)
        self._seeds: list[int | None] = [None] * num_envs
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._renderer = Renderer(self.config, render_size)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Where the agents are, (N, D)."""
        return self._batch.positions.copy()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The agents' random generators."""
        return tuple(self._generator(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seeds of the agents' random generators."""
        self.np_random  # noqa: B018 (makes those that do not exist yet)
        return tuple(self._seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: One seed per agent, or an integer s for s, s + 1, ..., or None to go on with
                the generators as they are.
            options: `{"reset_mask": mask}` restricts the reset to the agents in the boolean
                `mask` (N,), as "Disabled" needs it.

        Raises:
            ValueError: If the number of seeds or the mask does not fit the number of agents.
        """
        seeds = self._checked_seeds(seed)
        chosen = self._checked_mask((options or {}).get("reset_mask"))
        for i in np.flatnonzero(chosen).tolist():
            if seeds[i] is not None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
        self._restart(chosen)
        infos = {"is_success": np.zeros(self.num_envs, np.bool_), "_is_success": chosen.copy()}
        return self._batch.observations.copy(), infos

    def step(self, actions: ArrayLike) -> StepResult:
        """Move every agent by its action, and reset as `autoreset_mode` says.

        Args:
            actions: Steps as a share of the reach, (N, D); clipped to [-1, 1].

        Returns:
            Observations (N, O), rewards (N,), terminations (N,), truncations (N,) and infos.

        Raises:
            ValueError: If `actions` has another shape or an action contains NaN.
            ResetNeeded: If an episode has ended and `autoreset_mode` is "Disabled".
        """
        batch, mode = self._batch, self.autoreset_mode
        ended = self._ended
        anyone_ended = bool(ended.any())
        if anyone_ended and mode is AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"autoreset_mode is Disabled, so agents {np.flatnonzero(ended).tolist()} must be "
                f"reset before the next step"
            )
        batch.step(actions, ~ended if anyone_ended else None)
        self._steps += 1
        if anyone_ended:
            self._restart(ended)
        rewards, terminated = batch.rewards.copy(), batch.terminated.copy()
        truncated = self._steps >= self._limit
        np.logical_or(terminated, truncated, out=self._ended)
        success = batch.success.copy()
        infos: dict[str, Any] = {}
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._final_infos(self._ended, success)
            success &= ~self._ended
            self._restart(self._ended)
        infos["is_success"] = success
        infos["_is_success"] = batch.everyone.copy()
        return batch.observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a frame (render_size, render_size, 3) per agent, without trails."""
        if self.render_mode is None:
            return None
        return tuple(self._renderer.frame(position[None]) for position in self._batch.positions)

    def _restart(self, chosen: BoolArray) -> None:
        """Put the `chosen` agents at the start of a new episode."""
        if self.config.start_noise > 0.0:
            for i in np.flatnonzero(chosen).tolist():
                self._arcs[i] = self.config.draw_start(self._generator(i))
        self._batch.reset(chosen, self._arcs)
        self._steps[chosen] = 0
        self._ended[chosen] = False

    def _final_infos(self, ended: BoolArray, success: BoolArray) -> dict[str, Any]:
        """Describe how episodes ended, the way `SyncVectorEnv` does."""
        final_obs = np.full(self.num_envs, None, dtype=object)
        observations = self._batch.observations.copy()
        for i in np.flatnonzero(ended).tolist():
            final_obs[i] = observations[i]
        return {
            "final_obs": final_obs,
            "_final_obs": ended.copy(),
            "final_info": {"is_success": success & ended, "_is_success": ended.copy()},
            "_final_info": ended.copy(),
        }

    def _generator(self, i: int) -> np.random.Generator:
        generator = self._generators[i]
        if generator is None:
            generator, self._seeds[i] = seeding.np_random()
            self._generators[i] = generator
        return generator

    def _checked_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must have one entry per agent, {self.num_envs}, got {seed}")
        return list(seed)

    def _checked_mask(self, mask: Any) -> BoolArray:
        if mask is None:
            return self._batch.everyone
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be boolean of shape ({self.num_envs},) with at "
                f"least one True, got {mask}"
            )
        return mask
