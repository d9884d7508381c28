"""Environment steps per second of ``learn()``: acting, stepping, storing and updating."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

import flowpolicy_envs
from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "TunnelDiagonal-v0"
N_SEEDS = 10
# Steps per call of learn() and seed, enough to make the overhead of a call negligible.
CHUNK = 500
QUICK_START, QUICK_CHUNK = 50, 10
# rl_zoo3's settings for Pendulum-v1, with shorter rollouts and without gSDE.
PPO_ENV_ID, N_ENVS, N_STEPS = "Pendulum-v1", 4, 256
PPO_SETTINGS = {"batch_size": 64, "n_epochs": 10, "gamma": 0.9, "learning_rate": 1e-3}


def zoo_block(algorithm: str, env_id: str) -> dict[str, Any]:
    """Return the arguments of SACFlow from the shipped hyperparameter file of an algorithm.

    Example:
        >>> zoo_block("sac_gauss", "TunnelDiagonal-v0")["policy_kwargs"]["net_arch"]
        [16, 16]
    """
    block = load_hyperparameters(algorithm, env_id)
    del block["n_timesteps"]
    return block


def stock_block(env_id: str) -> dict[str, Any]:
    """Return the same settings as arguments of SB3's SAC with its Gaussian policy."""
    block = zoo_block("sac_gauss", env_id) | {"policy": "MlpPolicy"}
    for name in ("random_steps", "critic_loss_coef"):
        block.pop(name, None)
    return block


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return learning with SAC and PPO; ``quick`` neither compiles nor stacks seeds."""
    flowpolicy_envs.register_envs()
    candidates = [Candidate("SB3 SAC", lambda: _steps(SAC, stock_block(ENV_ID), quick))]
    for algorithm in ("sac_gauss", "sac_flow"):
        block = zoo_block(algorithm, ENV_ID) | {"compile": not quick}
        name = algorithm + (", not compiled" if quick else "")
        candidates.append(Candidate(name, partial(_steps, SACFlow, block, quick)))
        if not quick:
            stacked = partial(
                _steps, partial(SeedBatch, seeds=range(N_SEEDS)), block, n_seeds=N_SEEDS
            )
            candidates.append(Candidate(f"SeedBatch of {N_SEEDS} {algorithm}", stacked))
    return [
        Benchmark(f"learn() on {ENV_ID}", "steps", candidates),
        Benchmark(f"learn() of PPO on {PPO_ENV_ID}", "steps", _ppo_candidates(quick)),
    ]


def _ppo_candidates(quick: bool) -> list[Candidate]:
    stock = Candidate("SB3 PPO", partial(_ppo_steps, PPO, "MlpPolicy", quick))
    compiled = partial(PPOFlow, compile=not quick)
    policies = ("GaussPolicy", "LowRankPolicy", "FlowPolicy")
    ours = [Candidate(f"PPOFlow {p}", partial(_ppo_steps, compiled, p, quick)) for p in policies]
    return [stock, *ours]


def _ppo_steps(algorithm: Callable[..., Any], policy: str, quick: bool) -> Work:
    """Collect a rollout and learn from it per piece of work."""
    n_steps = QUICK_CHUNK if quick else N_STEPS
    env = make_vec_env(PPO_ENV_ID, N_ENVS)
    model = algorithm(policy, env, n_steps=n_steps, **PPO_SETTINGS).learn(1)

    def work() -> float:
        model.learn(1, reset_num_timesteps=False)
        return n_steps * N_ENVS

    return work


def _steps(
    algorithm: Callable[..., Any], block: dict[str, Any], quick: bool = False, n_seeds: int = 1
) -> Work:
    """Learn in chunks after random steps and compilation, and count the steps of all seeds."""
    kwargs = dict(block)
    if quick:
        kwargs |= {key: QUICK_START for key in ("learning_starts", "random_steps") if key in kwargs}
    model = algorithm(env=ENV_ID, **kwargs)
    chunk = QUICK_CHUNK if quick else CHUNK
    model.learn(max(kwargs["learning_starts"], kwargs.get("random_steps", 0)) + chunk)

    def work() -> float:
        model.learn(chunk, reset_num_timesteps=False)
        return chunk * n_seeds

    return work
