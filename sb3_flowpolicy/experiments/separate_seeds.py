"""Seeds one after another, for agents that cannot be trained in lockstep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.seeds.setup import make_env


class SeparateSeeds:
    """Agents with what experiments use of :class:`~sb3_flowpolicy.SeedBatch`, several times slower.

    The global random numbers are seeded anew for each agent and call of :meth:`learn`, so that it
    does not matter who was trained in between, or whether the run was interrupted.

    Args:
        policy: As of :class:`~sb3_flowpolicy.SACFlow`.
        env: Id of the environment.
        seeds: One agent for each.
        info_keywords: As of ``SeedBatch``.
        **settings: Further arguments of the agents.

    Example:
        >>> import flowpolicy_envs
        >>> settings = dict(learning_starts=20, use_sde=True, compile=False)
        >>> batch = SeparateSeeds("GaussPolicy", "TunnelDiagonal-v0", [1, 2], **settings)
        >>> batch.learn(25)
        >>> [model.num_timesteps for model in batch.models]
        [25, 25]
    """

    def __init__(
        self,
        policy: str,
        env: str,
        seeds: Iterable[int],
        info_keywords: Sequence[str] = (),
        **settings: Any,
    ) -> None:
        self.seeds = list(seeds)
        self.models = [
            SACFlow(policy, _monitored(env, info_keywords), seed=seed, **settings)
            for seed in self.seeds
        ]

    def learn(
        self,
        total_timesteps: int,
        reset_num_timesteps: bool = True,
        log_interval: int | None = None,
    ) -> None:
        """Train all agents for as many steps each."""
        for seed, model in zip(self.seeds, self.models, strict=True):
            set_random_seed(_derived(seed, model.num_timesteps))
            model.learn(
                total_timesteps,
                # Nobody reads the logs.
                log_interval=log_interval or 10**9,
                reset_num_timesteps=reset_num_timesteps,
            )

    def save(self, folder: Path) -> None:
        """Save the agents with their replay buffers; running episodes end."""
        for seed, model in zip(self.seeds, self.models, strict=True):
            model.save(folder / f"seed_{seed}")
            model.save_replay_buffer(folder / f"seed_{seed}.buffer")
            _begin_episodes(model, seed)

    @classmethod
    def load(
        cls, folder: Path, env: str, seeds: Iterable[int], info_keywords: Sequence[str] = ()
    ) -> SeparateSeeds:
        """Load what :meth:`save` wrote; training goes on as if it had not been interrupted."""
        batch = cls.__new__(cls)
        batch.seeds, batch.models = list(seeds), []
        for seed in batch.seeds:
            path, monitored = folder / f"seed_{seed}", _monitored(env, info_keywords)
            model = SACFlow.load(path, monitored, device="cpu", force_reset=False)
            model.load_replay_buffer(folder / f"seed_{seed}.buffer", truncate_last_traj=False)
            _begin_episodes(model, seed)
            batch.models.append(model)
        return batch


def _monitored(env: str, info_keywords: Sequence[str]) -> Monitor:
    return Monitor(make_env(env), info_keywords=tuple(info_keywords))


def _begin_episodes(model: SACFlow, seed: int) -> None:
    assert model.env is not None
    derived = _derived(seed, model.num_timesteps)
    model.action_space.seed(derived)
    model.env.seed(derived)
    model._last_obs = None  # learn() resets


def _derived(*numbers: int) -> int:
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
