"""Steps per second of the environments, single and in batches."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym

import flowpolicy_envs
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work

# One id for each kind of step.
ENVIRONMENTS = ("TunnelDiagonal-v0", "TunnelCircle-v1", "TunnelSpline-v0", "SquareMoveX-v1")
# A familiar environment of similar complexity.
BASELINE = "Pendulum-v1"
BATCH = 64
# Calls of step() per piece of work, enough to make the clock's overhead negligible.
N_CALLS = 200


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return the baseline and each environment (``quick``: the first), single and batched."""
    flowpolicy_envs.register_envs()
    candidates = []
    for env_id in (BASELINE, *(ENVIRONMENTS[:1] if quick else ENVIRONMENTS)):
        candidates.append(Candidate(env_id, partial(_steps, env_id, 1)))
        candidates.append(Candidate(f"{env_id}, batch of {BATCH}", partial(_steps, env_id, BATCH)))
    return [Benchmark("random actions", "steps", candidates)]


def _steps(env_id: str, n_envs: int) -> Work:
    """Step one environment, or a batch that resets itself, and count the steps of each."""
    env: Any
    if n_envs == 1:
        env = gym.make(env_id, disable_env_checker=True)
    else:
        mode = "sync" if env_id == BASELINE else "vector_entry_point"
        env = gym.make_vec(env_id, num_envs=n_envs, vectorization_mode=mode)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(N_CALLS)]
    env.reset(seed=0)

    def work() -> float:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if n_envs == 1 and (terminated or truncated):
                env.reset()
        return N_CALLS * n_envs

    return work
