"""Trains one candidate on one task."""

from __future__ import annotations

import math
import time
import warnings
from importlib import import_module
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.experiments.standard_tasks.tasks import CANDIDATES, Task

_TESTS = 10


def train(task: Task, algorithm: str, name: str, seed: int, episodes: int) -> list[tuple[Any, ...]]:
    """Train an agent and test it ten times, deterministically.

    Args:
        task: The task.
        algorithm: Key of ``CANDIDATES``.
        name: Key of the candidate.
        seed: Seed of agent and environments; those of the tests differ.
        episodes: Number of episodes per test.

    Returns:
        Step, mean return, share of successes (NaN if the task has none), and seconds since the
        start, per test.
    """
    if "Bullet" in task.env_id:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
            import_module("pybullet_envs_gymnasium")
    candidate, settings = CANDIDATES[algorithm][name], dict(task.settings[algorithm])
    count, normalize = settings.pop("n_envs", 1), settings.pop("normalize", False)
    settings["policy_kwargs"] = {**settings.get("policy_kwargs", {}), **candidate.policy_kwargs}
    venv: VecEnv = make_vec_env(task.env_id, count, seed, env_kwargs=task.env_kwargs)
    test_venv: VecEnv = make_vec_env(task.env_id, 1, 10**6 + seed, env_kwargs=task.env_kwargs)
    if normalize:
        venv = VecNormalize(venv, gamma=settings.get("gamma", 0.99))
        test_venv = VecNormalize(test_venv, training=False, norm_reward=False)
    model = candidate.algorithm(candidate.policy, venv, seed=seed, device="cpu", **settings)
    tests = _Tests(test_venv, episodes)
    # One call, because schedules follow the progress of a call.
    steps = task.steps[algorithm]
    model.learn(steps, callback=EveryNTimesteps(max(1, steps // _TESTS), tests))
    if len(tests.rows) < _TESTS:
        tests.test(model)
    venv.close()
    test_venv.close()
    return tests.rows


class _Tests(BaseCallback):
    """Tests the model whenever it is called."""

    def __init__(self, venv: VecEnv, episodes: int) -> None:
        super().__init__()
        self.venv, self.episodes = venv, episodes
        self.rows: list[tuple[Any, ...]] = []
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        self.test(self.model)
        return True

    def test(self, model: Any) -> None:
        """Append a row."""
        if isinstance(self.venv, VecNormalize):
            sync_envs_normalization(model.get_env(), self.venv)
        successes: list[bool] = []

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"] and "is_success" in local["info"]:
                successes.append(bool(local["info"]["is_success"]))

        mean_return, _ = evaluate_policy(model, self.venv, self.episodes, callback=note)
        assert isinstance(mean_return, float)
        success = float(np.mean(successes)) if successes else math.nan
        seconds = round(time.perf_counter() - self._started)
        self.rows.append((model.num_timesteps, round(mean_return, 2), success, seconds))
