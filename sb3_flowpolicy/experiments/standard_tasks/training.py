"""Trains one candidate on one task."""

from __future__ import annotations

import math
import tempfile
import time
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import ConvertCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.experiments.standard_tasks.tasks import CANDIDATES, Task
from sb3_flowpolicy.experiments.work import register_env

_TESTS = 10


def train(task: Task, algorithm: str, name: str, seed: int, episodes: int) -> list[tuple[Any, ...]]:
    """Train an agent, ``CANDIDATES[algorithm][name]``, and test it ten times, deterministically.

    The environments of the tests have other seeds than that of training.

    Returns:
        Step, mean return, share of successes (NaN if the task has none), and seconds since the
        start, per test.
    """
    register_env(task.env_id)
    candidate, settings = CANDIDATES[algorithm][name], task.settings(algorithm)
    count, normalize = settings.pop("n_envs", 1), settings.pop("normalize", False)
    settings["policy_kwargs"] = {**settings.get("policy_kwargs", {}), **candidate.policy_kwargs}
    venv: VecEnv = make_vec_env(task.env_id, count, seed, env_kwargs=task.env_kwargs)
    test_venv: VecEnv = make_vec_env(task.env_id, 1, 10**6 + seed, env_kwargs=task.env_kwargs)
    if normalize:
        venv = VecNormalize(venv, gamma=settings.get("gamma", 0.99))
        test_venv = VecNormalize(test_venv, training=False, norm_reward=False)
    model = candidate.algorithm(candidate.policy, venv, seed=seed, device="cpu", **settings)
    steps, started, seconds = task.steps[algorithm], time.perf_counter(), []

    def note_time(*_: Any) -> bool:
        seconds.append(round(time.perf_counter() - started))
        return True

    with tempfile.TemporaryDirectory() as folder:  # without one, EvalCallback keeps only the last
        tests = EvalCallback(
            test_venv,
            callback_after_eval=ConvertCallback(note_time),
            n_eval_episodes=episodes,
            eval_freq=max(1, steps // _TESTS // count),
            log_path=folder,
            verbose=0,
        )
        # One call, because schedules follow the progress of a call.
        model.learn(steps, callback=tests)
    venv.close()
    test_venv.close()
    returns = [round(float(np.mean(episodes)), 2) for episodes in tests.evaluations_results]
    successes = [float(np.mean(one)) for one in tests.evaluations_successes]
    successes = successes or [math.nan] * len(returns)
    return list(zip(tests.evaluations_timesteps, returns, successes, seconds, strict=True))
