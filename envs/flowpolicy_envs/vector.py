"""What the vectorized environments have in common: seeds, time limits, resets and infos."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from flowpolicy_envs.canvas import Canvas, check_render_mode
from flowpolicy_envs.checks import is_whole
from flowpolicy_envs.env import Batch, BoolArray

StepResult = tuple[NDArray[np.float32], NDArray[np.float64], BoolArray, BoolArray, dict[str, Any]]


class BatchVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], np.ndarray]):
    """N agents of the same kind, each with its own random generator.

    Agent i behaves like a single environment that is reset with agent i's seed, and the whole like
    gymnasium's `SyncVectorEnv` over N of them, `infos` included, only faster.

    Args:
        num_envs: Number of agents N, at least 1.
        max_episode_steps: Steps after which an episode is truncated, at least 1, or None for
            no limit. `gymnasium.make_vec` takes it from the registration.
        autoreset_mode: What follows the end of an episode. With "NextStep" the next call of `step`
            ignores the action and resets. With "SameStep" the agent is reset at once, and
            `infos["final_obs"]` and `infos["final_info"]` describe the end of the episode. With
            "Disabled" the caller has to reset.
        render_mode: None or "rgb_array".
        render_size: Edge of each agent's frame in pixels, at least 16.
        **arguments: The arguments of the single environment.

    Raises:
        ValueError: If an argument is outside of its range; the message names it.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = 40,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_size: int = 600,
        **arguments: Any,
    ) -> None:
        if not is_whole(num_envs) or num_envs < 1:
            raise ValueError(f"num_envs must be an integer of at least 1, got {num_envs!r}")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be None or >= 1, got {max_episode_steps}")
        check_render_mode(render_mode, ("rgb_array",))
        self._agents, self._renderer = self._build(num_envs, render_size, **arguments)
        self.config = self._agents.config
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": self._renderer.fps,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.config.observation_space
        self.single_action_space = self.config.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = np.iinfo(np.int64).max if max_episode_steps is None else max_episode_steps
        self._steps = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._seeds: list[int | None] = [None] * num_envs
        self._generators: list[np.random.Generator | None] = [None] * num_envs

    @abstractmethod
    def _build(self, num_envs: int, render_size: int, **arguments: Any) -> tuple[Batch, Canvas]:
        """Build state and renderer of `num_envs` agents."""

    @abstractmethod
    def _scene(self, i: int) -> tuple[Any, ...]:
        """Return the arguments of the renderer for agent i."""

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The agents' random generators."""
        return tuple(self._generator(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seeds of the agents' random generators."""
        self.np_random  # noqa: B018 (creates the missing ones)
        return tuple(self._seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: One seed per agent, or an integer s for s, s + 1, ..., or None to keep the
                generators.
            options: `{"reset_mask": mask}` resets only the agents in the boolean `mask` (N,), for
                the mode "Disabled".

        Raises:
            ValueError: If there are not N seeds or the mask has another shape.
        """
        seeds = self._checked_seeds(seed)
        chosen = self._checked_mask((options or {}).get("reset_mask"))
        for i in np.flatnonzero(chosen).tolist():
            if seeds[i] is not None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
        self._restart(chosen)
        return self._agents.observations.copy(), _masked(self._agents.infos(), chosen)

    def step(self, actions: ArrayLike) -> StepResult:
        """Step every agent with its action, and reset according to `autoreset_mode`.

        Args:
            actions: Actions (N, D); clipped to [-1, 1].

        Returns:
            Observations (N, O), rewards (N,), terminations (N,), truncations (N,) and infos.

        Raises:
            ValueError: If `actions` has another shape or an action contains NaN.
            ResetNeeded: If an episode has ended and `autoreset_mode` is "Disabled".
        """
        agents, mode = self._agents, self.autoreset_mode
        ended = self._ended
        some_ended = bool(ended.any())
        if some_ended and mode is AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"autoreset_mode is Disabled, so agents {np.flatnonzero(ended).tolist()} must be "
                "reset before the next step"
            )
        agents.step(actions, ~ended if some_ended else None, self._generator)
        self._steps += 1
        if some_ended:
            self._restart(ended)
        rewards, terminated = agents.rewards.copy(), agents.terminated.copy()
        truncated = self._steps >= self._limit
        np.logical_or(terminated, truncated, out=self._ended)
        final = {}
        if mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = self._final_infos(self._ended)
            self._restart(self._ended)
        infos = {**final, **_masked(agents.infos(), agents.everyone)}
        return agents.observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a frame (render_size, render_size, 3) per agent."""
        if self.render_mode is None:
            return None
        return tuple(self._renderer.frame(*self._scene(i)) for i in range(self.num_envs))

    def _restart(self, chosen: BoolArray) -> None:
        self._agents.reset(chosen, self._generator)
        self._steps[chosen] = 0
        self._ended[chosen] = False

    def _final_infos(self, ended: BoolArray) -> dict[str, Any]:
        """Describe how episodes ended, in the format of `SyncVectorEnv`."""
        final_obs = np.full(self.num_envs, None, dtype=object)
        observations = self._agents.observations.copy()
        for i in np.flatnonzero(ended).tolist():
            final_obs[i] = observations[i]
        return {
            "final_obs": final_obs,
            "_final_obs": ended.copy(),
            "final_info": _masked(self._agents.infos(), ended),
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
            return self._agents.everyone
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be boolean of shape ({self.num_envs},) with at "
                f"least one True, got {mask}"
            )
        return mask


def _masked(infos: dict[str, NDArray[Any]], mask: BoolArray) -> dict[str, Any]:
    """Add `mask` as `_name` to each array `name`, and clear the entries outside the mask."""
    masked: dict[str, Any] = {}
    blank = None if mask.all() else ~mask
    for name, values in infos.items():
        if blank is not None:
            values[blank] = None if values.dtype == np.object_ else 0
        masked[name], masked[f"_{name}"] = values, mask.copy()
    return masked
