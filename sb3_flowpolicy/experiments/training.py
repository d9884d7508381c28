"""Doing one work item: train its seeds, measure them, and survive interruptions."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th
from filelock import FileLock, Timeout

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.common.files import read_json, write_json
from sb3_flowpolicy.common.machine import machine
from sb3_flowpolicy.engine.runtime import UPDATES_WORTH_COMPILING
from sb3_flowpolicy.experiments.measures import (
    MEASURES,
    TRAINING_INFOS,
    DeterministicEpisodes,
    entropy_profile,
    policy_entropy,
    policy_picture,
)
from sb3_flowpolicy.experiments.separate_seeds import SeparateSeeds
from sb3_flowpolicy.experiments.store import ItemFiles, Row
from sb3_flowpolicy.experiments.work import WorkItem, environment
from sb3_flowpolicy.seeds.batch import SeedBatch

Report = Callable[[str, int], None]
"""Called with an item's key and the steps that each of its seeds has done."""

# SB3 keeps the last 100 episodes; we want all since the last measurement.
_ALL_EPISODES = 10**7
# An interrupted run's processes end within moments of each other.
_LOCK_SECONDS = 20
_STATE_FIELDS = {
    **{"step": int, "sessions": int, "commits": list, "files": {"table": int, "details": int}},
    **{"seconds": (int, float), "cpu_seconds": (int, float)},
}


def run_item(item: WorkItem, folder: Path, report: Report) -> None:
    """Train an item to its end, from its last checkpoint if there is one.

    A batch that is saved begins new episodes, whether or not it is loaded afterwards. So the
    results are the same whether the run was interrupted or not.

    Args:
        item: The item.
        folder: Folder of its files.
        report: Told about progress.

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
    def __init__(self, item: WorkItem, files: ItemFiles, report: Report) -> None:
        self.item, self.files, self.report = item, files, report
        self.env = environment(item)
        self.started = time.perf_counter()
        self.cpu_started = time.process_time()
        self.seconds_before, self.cpu_before, self.sessions = 0.0, 0.0, 1
        # Now, not at the end: by then the files on disk may be of another commit.
        self.machine = machine()
        self.commits = [self.machine["commit"]]
        self.done_steps = 0
        self.batch = self._resume() or self._begin()
        self.tests = DeterministicEpisodes(self.env, len(item.seeds), item.test_episodes)

    def run(self) -> None:
        item = self.item
        self.report(item.key, self.done_steps)
        while self.done_steps < item.steps:
            steps = min(item.eval_every, item.steps - self.done_steps)
            before = self.done_steps
            first = before == 0
            self.batch.learn(steps, reset_num_timesteps=first, log_interval=None)
            self.done_steps = self.batch.models[0].num_timesteps
            self.files.append_rows(self._measure())
            for at in item.pictures_at:
                if before < at <= self.done_steps:
                    self._record("picture", policy_picture, self.batch.seeds[:1])
            crossed = self.done_steps // item.checkpoint_every > before // item.checkpoint_every
            if crossed and self.done_steps < item.steps:
                self._save()
            self.report(item.key, self.done_steps)
        if "profile" in item.measures:
            self._record("profile", entropy_profile, self.batch.seeds)
        self.tests.close()
        self.files.finish(self._facts())

    def _begin(self) -> SeedBatch | SeparateSeeds:
        """Start over: what an interrupted run wrote before its first checkpoint goes."""
        self.files.cut_to({"table": 0, "details": 0})
        settings = {"device": "cpu", **self.item.hyperparameters}
        settings.setdefault("compile", self.item.updates >= UPDATES_WORTH_COMPILING)
        if self._one_by_one:
            kind: type[SeedBatch | SeparateSeeds] = SeparateSeeds
            settings["compile"] = False
        else:
            kind = SeedBatch
        return kind(
            settings.pop("policy"),
            self.env,
            self.item.seeds,
            info_keywords=self._infos(),
            stats_window_size=_ALL_EPISODES,
            **settings,
        )

    @property
    def _one_by_one(self) -> bool:
        """Whether this is gSDE, whose noise is in SB3's actor and not in a density."""
        return bool(self.item.hyperparameters.get("use_sde"))

    def _infos(self) -> list[str]:
        return [name for name in TRAINING_INFOS if name in self.item.measures]

    def _resume(self) -> SeedBatch | SeparateSeeds | None:
        # Half-written checkpoints have another name, so the last of these is complete.
        found = sorted(self.files.checkpoints.glob("step_*"))
        if not found:
            return None
        if not (found[-1] / "state.json").is_file():
            raise ValueError(f"{found[-1]} must hold state.json: {self._advice}")
        try:
            state = read_json(found[-1] / "state.json", _STATE_FIELDS)
        except ValueError as error:
            raise ValueError(f"{error}: {self._advice}") from error
        self.files.cut_to(state["files"])
        self.done_steps = state["step"]
        self.seconds_before, self.cpu_before = state["seconds"], state["cpu_seconds"]
        self.sessions = state["sessions"] + 1
        self.commits = [*state["commits"], *self.commits]
        try:
            return self._load(found[-1])
        except MemoryError:
            raise
        except Exception as error:  # whatever torch, pickle and zip say about half a file
            raise ValueError(
                f"{found[-1]} must hold a whole checkpoint, got {type(error).__name__} ({error}): "
                f"{self._advice}"
            ) from error

    @property
    def _advice(self) -> str:
        return f"delete {self.files.checkpoints} and {self.files.table} to repeat this item"

    def _load(self, checkpoint: Path) -> SeedBatch | SeparateSeeds:
        if self._one_by_one:
            return SeparateSeeds.load(checkpoint, self.env, self.item.seeds, self._infos())
        return SeedBatch.load(checkpoint, self.env, info_keywords=self._infos())

    def _save(self) -> None:
        folder = self.files.checkpoints
        partial = folder / "partial"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        self.batch.save(partial)
        state = {
            "step": self.done_steps,
            "files": self.files.fingerprint(),
            "seconds": self._seconds(),
            "cpu_seconds": self._cpu_seconds(),
            "sessions": self.sessions,
            "commits": self.commits,
        }
        write_json(partial / "state.json", state)
        older = list(folder.glob("step_*"))
        partial.rename(folder / f"step_{self.done_steps:012d}")
        for one in older:
            shutil.rmtree(one)

    def _measure(self) -> list[Row]:
        models = self.batch.models
        rows: list[Row] = []
        tested = self.tests.run(models, self.item.seeds)
        for seed, model, (test_return, test_success) in zip(
            self.item.seeds, models, tested, strict=True
        ):
            episodes, success = model.ep_info_buffer, model.ep_success_buffer
            assert episodes is not None
            assert success is not None
            row: Row = {
                "seed": seed,
                "step": model.num_timesteps,
                "episodes": len(episodes),
                "train_return": _mean([episode["r"] for episode in episodes]),
                "train_success": _mean(list(success)),
                "test_return": test_return,
                "test_success": test_success,
                "entropy": policy_entropy(model, seed),
                "ent_coef": _ent_coef(model),
            }
            for name in self._infos():
                row[name] = _mean([episode[name] for episode in episodes])
            for name, measure in MEASURES.items():
                if name in self.item.measures:
                    row[name] = measure(model, seed)
            episodes.clear()
            success.clear()
            rows.append(row)
        return rows

    def _record(self, kind: str, measure: Callable, seeds: list[int]) -> None:
        for seed, model in zip(seeds, self.batch.models, strict=False):
            content = measure(model, self.env, seed)
            if content is not None:
                head = {"kind": kind, "seed": seed, "step": self.done_steps}
                self.files.append_detail({**head, **content})

    def _seconds(self) -> float:
        return self.seconds_before + time.perf_counter() - self.started

    def _cpu_seconds(self) -> float:
        """What it would take on a core of its own: others may be using this one, too."""
        return self.cpu_before + time.process_time() - self.cpu_started

    def _facts(self) -> dict:
        seconds = self._seconds()
        return {
            "steps": self.done_steps,
            "seeds": list(self.item.seeds),
            "seconds": round(seconds, 1),
            "cpu_seconds": round(self._cpu_seconds(), 1),
            "steps_per_second": round(self.done_steps * len(self.item.seeds) / seconds, 1),
            "sessions": self.sessions,
            "commits": list(dict.fromkeys(self.commits)),
            **self.files.fingerprint(),
            "machine": self.machine,
        }


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _ent_coef(model: SACFlow) -> float:
    if model.ent_coef_optimizer is None:
        return model.ent_coef_tensor.item()
    assert model.log_ent_coef is not None
    return model.log_ent_coef.detach().exp().item()
