"""A batch of seeds on disk: saved between runs, and checkpointed within one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from gymnasium.vector import VectorEnv

from sb3_flowpolicy.algorithms.exploration import ColoredExploration
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.checkpoint.segments import Ring
from sb3_flowpolicy.checkpoint.session import RunCheckpoints, load_agent, open_checkpoint
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.engine import EngineRuntime
from sb3_flowpolicy.guard.training_guard import TrainingGuard
from sb3_flowpolicy.seeds.checkpoint import read_batch, write_batch
from sb3_flowpolicy.seeds.episodes import SeedEpisodes
from sb3_flowpolicy.seeds.setup import EnvFactory, make_env
from sb3_flowpolicy.seeds.storage import SeedNoise, SeedStorage

SelfBatch = TypeVar("SelfBatch", bound="BatchOnDisk")


class BatchOnDisk:
    """What :class:`SeedBatch` knows of files."""

    seeds: list[int]
    _models: list[SACFlow]
    _storage: SeedStorage
    _noise: dict[str, SeedNoise]
    _episodes: SeedEpisodes
    _venv: VectorEnv
    _obs: np.ndarray | None
    _losses: list[list[float]] | None
    _guard: TrainingGuard
    _exploration: ColoredExploration
    _checkpoints: RunCheckpoints
    _runtime: EngineRuntime

    @abstractmethod
    def _adopt(
        self,
        models: list[SACFlow],
        seeds: list[int],
        env: str | EnvFactory,
        monitor_dir: str | Path | None,
        info_keywords: Sequence[str],
    ) -> None:
        """Begin with agents that exist."""

    def save(self, folder: str | Path) -> None:
        """Save all agents, their replay buffers and their random numbers.

        The running episodes are not saved: a loaded batch begins new ones.

        Args:
            folder: Where to; one ``seed_<seed>.zip`` and ``.buffer.pkl`` per agent, which can also
                be loaded on their own, and ``batch.pt``.
        """
        noise = {name: one.state() for name, one in self._noise.items()}
        write_batch(folder, self.seeds, self._models, noise)
        self._obs = None

    @classmethod
    def load(
        cls: type[SelfBatch],
        folder: str | Path,
        env: str | EnvFactory,
        algorithm: type[SACFlow] = SACFlow,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
    ) -> SelfBatch:
        """Load what :meth:`save` wrote; ``learn(..., reset_num_timesteps=False)`` goes on.

        Args:
            folder: Folder of a saved batch.
            env: As at construction.
            algorithm: Class of the agents.
            monitor_dir: As at construction.
            info_keywords: As at construction.

        Returns:
            The batch.

        Raises:
            ValueError: If the folder holds no complete batch.
        """
        seeds, models, noise = read_batch(folder, env, algorithm)
        batch = cls.__new__(cls)
        batch._adopt(models, seeds, env, monitor_dir, info_keywords)
        for name, state in noise.items():
            batch._noise[name].set_state(state)
        return batch

    @classmethod
    def resume(
        cls: type[SelfBatch],
        path: str | Path,
        env: str | EnvFactory,
        algorithm: type[SACFlow] = SACFlow,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
    ) -> SelfBatch:
        """Take a batch up where its newest undamaged checkpoint stands, as SACFlow's ``resume``.

        Args:
            path: Folder of checkpoints that :meth:`learn` wrote.
            env: As at construction.
            algorithm: As at construction.
            monitor_dir: As at construction.
            info_keywords: As at construction.

        Returns:
            The batch; :meth:`learn`, called as before, goes on to the same end.

        Raises:
            ValueError: If the folder holds no undamaged checkpoint of a batch, or the environment
                does not fit.
        """
        store, checkpoint = open_checkpoint(path, cls.__name__)
        models = [
            load_agent(algorithm, checkpoint, name, algorithm._wrap_env(make_env(env)), "cpu")
            for name in checkpoint.manifest["agents"]
        ]
        batch = cls.__new__(cls)
        seeds = [int(name.removeprefix("seed_")) for name in checkpoint.manifest["agents"]]
        batch._adopt(models, seeds, env, monitor_dir, info_keywords)
        batch._checkpoints.load(store, checkpoint)
        batch._storage.publish()
        return batch

    def _describe_run(self) -> Run:
        """Describe what a checkpoint of this batch consists of."""
        names = [f"seed_{seed}" for seed in self.seeds]
        agents = dict(zip(names, self._models, strict=True))
        own = {name: model.env for name, model in agents.items()}
        return Run(
            kind=type(self).__name__,
            agents=agents,
            environments={"batch": self._venv, **own},
            ring=self._ring,
            extra=self._extra_state,
            set_extra=self._set_extra_state,
        )

    def _ring(self) -> tuple[SeedStorage, Ring]:
        storage = self._storage
        return storage, Ring(storage.rows.columns, storage.pos, storage.full)

    def _extra_state(self) -> dict[str, Any]:
        self._guard.look()  # no checkpoint is spoiled
        return {
            "noise": {name: one.state() for name, one in self._noise.items()},
            "episodes": self._episodes.state(),
            "obs": self._obs,
            "losses": self._losses,
            "exploration": self._exploration.state(),
            "engine": self._runtime.state(),
        }

    def _set_extra_state(self, state: dict[str, Any]) -> None:
        for name, one in self._noise.items():
            one.set_state(state["noise"][name])
        self._losses = state["losses"]
        self._exploration.load_state(state["exploration"])
        self._runtime.load_state(state["engine"])
        self._episodes.set_state(state["episodes"])
        if self._resumes_episodes():
            self._obs = state["obs"]
        else:
            self._episodes.restart()

    def _resumes_episodes(self) -> bool:
        """Whether the next step belongs to episodes that a resumed batch was in."""
        return self._checkpoints.resuming and "batch" not in self._checkpoints.opaque
