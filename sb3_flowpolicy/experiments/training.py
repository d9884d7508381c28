"""Do one work item: train its seeds, measure them, and survive interruptions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from filelock import FileLock, Timeout

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.common.machine import machine
from sb3_flowpolicy.engine.runtime import UPDATES_WORTH_COMPILING
from sb3_flowpolicy.experiments import measures
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import WorkItem, environment
from sb3_flowpolicy.seeds.batch import SeedBatch

Report = Callable[[str, int], None]
"""Called with an item's key and the steps that each of its seeds has done."""

# SB3 keeps the last 100 episodes; we want all since the last measurement.
_ALL_EPISODES = 10**7
_NO_LOGS = 10**9
# An interrupted run's processes end within moments of each other.
_LOCK_SECONDS = 20
_PROGRESS = "experiment_progress"
"""Attribute of the first agent, and so part of its checkpoints: what the item's files held when the
current stage began."""


def run_item(item: WorkItem, folder: Path, report: Report) -> None:
    """Train an item to its end, from its last checkpoint in the folder if there is one.

    The results are the same whether or not the run was interrupted, except for environments that
    cannot be pickled: they begin new episodes.

    Raises:
        ValueError: If another process is at work on the item, or its files are damaged.
        OSError: If a file cannot be written.
    """
    files = ItemFiles(folder, item.key)
    if files.finished:
        return
    th.set_num_threads(1)
    try:
        with FileLock(folder / f".{item.key}.lock", timeout=_LOCK_SECONDS):
            _Training(item, files, report).run()
    except Timeout as error:
        raise ValueError(
            f"{folder} must be used by one run at a time, but another is at work on {item.key}"
        ) from error


class _Training:
    """Trains all seeds in lockstep.

    Training is a sequence of stages, each followed by a measurement. The first agent carries what
    the item's files held when the stage began. A resumed run cuts the files to that, finishes the
    stage and measures again: files and checkpoint agree, whenever the run was killed.
    """

    def __init__(self, item: WorkItem, files: ItemFiles, report: Report) -> None:
        self.item, self.files, self.report = item, files, report
        self.env = environment(item)
        self.infos = [name for name in measures.TRAINING_INFOS if name in item.measures]
        self.started, self.cpu_started = time.perf_counter(), time.process_time()
        # Totals of earlier sessions.
        self.before: dict[str, Any] = {"seconds": 0, "cpu_seconds": 0, "sessions": 0, "commits": []}
        # Read now, because the source files may change during the run.
        self.machine = machine()

    def run(self) -> None:
        resumed = any(self.files.checkpoints.glob("*-step-*"))
        if not resumed:
            self.files.cut_to({"table": 0, "details": 0})
        steps = self._train(resumed)
        totals, seeds = self._totals(), self.item.seeds
        facts = {
            "steps": steps,
            "seeds": list(seeds),
            "seconds": round(totals["seconds"], 1),
            "cpu_seconds": round(totals["cpu_seconds"], 1),
            "steps_per_second": round(self.item.steps * len(seeds) / totals["seconds"], 1),
            "sessions": totals["sessions"],
            "commits": list(dict.fromkeys(totals["commits"])),
        }
        self.files.finish({**facts, **self.files.fingerprint(), "machine": self.machine})

    def _train(self, resumed: bool) -> int:
        """Train the seeds to their end, and return the steps that each has done."""
        item = self.item
        batch = self._resume() if resumed else self._begin()
        models = batch.models
        stage = vars(models[0]).get(_PROGRESS, {"start": 0})["start"]
        self.report(item.key, stage)
        tests = measures.DeterministicEpisodes(self.env, item.seeds, item.test_episodes)
        first = True
        while stage < item.steps:
            end = min(stage + item.eval_every, item.steps)
            crossed = end // item.checkpoint_every > stage // item.checkpoint_every
            # The first call of a resumed run has to take over its folder of checkpoints.
            due = end < item.steps and (crossed or first)
            if models[0].num_timesteps < end:
                progress = {"start": stage, "files": self.files.fingerprint(), **self._totals()}
                vars(models[0])[_PROGRESS] = progress
                # More steps than the run has: the only checkpoint is that at the end of the call.
                every = 2 * item.steps if due else None
                batch.learn(
                    # The first call counts from zero, that of a resumed run included.
                    end if first else end - stage,
                    log_interval=_NO_LOGS,
                    reset_num_timesteps=first,
                    checkpoint_every=every,
                    checkpoint_path=self.files.checkpoints if due else None,
                )
                first = False
            done = models[0].num_timesteps
            tested = zip(models, tests.run(models), tests.run(models, "log_prob"), strict=True)
            self.files.append_rows([self._row(*one) for one in tested])
            if any(stage < at <= done for at in item.pictures_at):
                self._record("picture", measures.policy_picture, models[:1])
            stage = done
            self.report(item.key, stage)
        if "profile" in item.measures:
            self._record("profile", measures.entropy_profile, models)
        tests.venv.close()
        # Kept to draw pictures of it; saved before the item is declared complete.
        self.files.agent.parent.mkdir(exist_ok=True)
        models[0].save(self.files.agent)
        return stage

    def _begin(self) -> SeedBatch:
        settings = {"device": "cpu", **self.item.hyperparameters}
        settings |= {"stats_window_size": _ALL_EPISODES}
        settings.setdefault("compile", self.item.updates >= UPDATES_WORTH_COMPILING)
        return SeedBatch(env=self.env, seeds=self.item.seeds, info_keywords=self.infos, **settings)

    def _resume(self) -> SeedBatch:
        try:
            batch = SeedBatch.resume(self.files.checkpoints, self.env, info_keywords=self.infos)
        except ValueError as error:
            raise ValueError(f"{error}: {self.files.advice}") from error
        self.before = vars(batch.models[0])[_PROGRESS]
        self.files.cut_to(self.before["files"])
        return batch

    def _totals(self) -> dict[str, Any]:
        """Return time, number and commits of all sessions so far."""
        return {
            "seconds": self.before["seconds"] + time.perf_counter() - self.started,
            # Unlike the time above, this leaves out other processes on the same core.
            "cpu_seconds": self.before["cpu_seconds"] + time.process_time() - self.cpu_started,
            "sessions": self.before["sessions"] + 1,
            "commits": [*self.before["commits"], self.machine["commit"]],
        }

    def _row(
        self,
        model: Any,
        tested: tuple[float | None, float | None],
        most_likely: tuple[float | None, float | None],
    ) -> dict[str, float | None]:
        """Measure one agent, and forget the episodes that the row accounts for."""
        episodes, success, seed = model.ep_info_buffer, model.ep_success_buffer, model.seed
        row = {
            "seed": seed,
            "step": model.num_timesteps,
            "episodes": len(episodes),
            "train_return": _mean([episode["r"] for episode in episodes]),
            "train_success": _mean(list(success)),
            "test_return": tested[0],
            "test_success": tested[1],
            "log_prob_return": most_likely[0],
            "log_prob_success": most_likely[1],
            "entropy": measures.policy_entropy(model, seed),
            "ent_coef": _ent_coef(model),
        }
        row |= {name: _mean([episode[name] for episode in episodes]) for name in self.infos}
        if "same_axis_correlation" in self.item.measures:
            row["same_axis_correlation"] = measures.same_axis_correlation(model, seed)
        episodes.clear()
        success.clear()
        return row

    def _record(self, kind: str, measure: Callable, models: Sequence[EngineFlow]) -> None:
        for model in models:
            content = measure(model, self.env, model.seed)
            if content is not None:
                head = {"kind": kind, "seed": model.seed, "step": model.num_timesteps}
                self.files.append_detail({**head, **content})


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _ent_coef(model: SACFlow) -> float:
    log = model.log_ent_coef
    return (model.ent_coef_tensor if log is None else log.detach().exp()).item()
