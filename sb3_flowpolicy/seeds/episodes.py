"""Episode statistics as in SB3's Monitor and logger, for S environments stepped at once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.checkpoint.logs import read_texts, write_texts
from sb3_flowpolicy.common.vec_env import info_of


class SeedEpisodes:
    """Sums up S running episodes, and records finished ones in models and monitor files.

    Args:
        models: One model per environment.
        seeds: Their seeds, for file names.
        monitor_dir: Folder for ``seed_<seed>.monitor.csv``; None writes none.
        info_keywords: Further numbers to record, from the info of an episode's last step.
    """

    def __init__(
        self,
        models: Sequence[OffPolicyAlgorithm],
        seeds: Sequence[int],
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
    ) -> None:
        self.models = models
        self.info_keywords = tuple(info_keywords)
        self.returns = np.zeros(len(models))
        self.lengths = np.zeros(len(models), dtype=int)
        self.start = time.time()
        self.writers: list[ResultsWriter] = []
        if monitor_dir is not None:
            header: dict[str, float | str] = {"t_start": self.start}
            self.writers = [
                ResultsWriter(str(Path(monitor_dir, f"seed_{seed}")), header, self.info_keywords)
                for seed in seeds
            ]

    def step(self, rewards: np.ndarray, dones: np.ndarray, infos: dict[str, Any]) -> list[int]:
        """Account for one step of all environments.

        Args:
            rewards: Rewards, (S,).
            dones: Which episodes ended, (S,).
            infos: Infos of a vectorized environment that resets in the same step.

        Returns:
            The models whose episodes ended.
        """
        self.returns += rewards
        self.lengths += 1
        ended = np.flatnonzero(dones).tolist()
        for seed in ended:
            model, info = self.models[seed], info_of(infos.get("final_info", {}), seed)
            episode = {
                "r": round(float(self.returns[seed]), 6),
                "l": int(self.lengths[seed]),
                "t": round(time.time() - self.start, 6),
                **{name: info[name] for name in self.info_keywords},
            }
            model._update_info_buffer([{**info, "episode": episode}], dones[[seed]])
            if self.writers:
                self.writers[seed].write_row(episode)
            model._episode_num += 1
        self.returns[ended] = 0
        self.lengths[ended] = 0
        return ended

    def restart(self) -> None:
        """Forget the running episodes: their environments were reset."""
        self.returns[:] = 0
        self.lengths[:] = 0

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue the running episodes."""
        return {
            "returns": self.returns,
            "lengths": self.lengths,
            "start": self.start,
            "texts": read_texts(self._files()),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state` returned."""
        self.returns, self.lengths = state["returns"], state["lengths"]
        self.start = state["start"]
        write_texts(self._files(), state["texts"])

    def _files(self) -> dict[str, IO[str]]:
        return {str(index): writer.file_handler for index, writer in enumerate(self.writers)}
