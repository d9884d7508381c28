"""Environment steps per second of ``learn()``: acting, stepping, storing and updating."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3 import SAC

import flowpolicy_envs
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Work
from sb3_flowpolicy.benchmarks.zoo_blocks import stock_block, zoo_block
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "TunnelDiagonal-v0"
N_SEEDS = 10
# Steps per call of learn(), per seed: so many that setting up a call does not count.
CHUNK = 500
QUICK_START, QUICK_CHUNK = 50, 10


def contests(quick: bool = False) -> list[Contest]:
    """Learning on the sparse Tunnel; ``quick`` neither compiles nor stacks."""
    flowpolicy_envs.register_envs()
    entrants = [Entrant("SB3 SAC", lambda: _steps_of(SAC, lambda: stock_block(ENV_ID), quick))]
    for algorithm in ("sac_gauss", "sac_flow"):

        def block(algorithm: str = algorithm) -> dict[str, Any]:
            return zoo_block(algorithm, ENV_ID) | {"compile": not quick}

        def one(block: Callable[[], dict[str, Any]] = block) -> Work:
            return _steps_of(SACFlow, block, quick)

        def batch(block: Callable[[], dict[str, Any]] = block) -> Work:
            return _steps_of(_seed_batch, block, quick, N_SEEDS)

        entrants.append(Entrant(algorithm + (", not compiled" if quick else ""), one))
        if not quick:
            entrants.append(Entrant(f"SeedBatch of {N_SEEDS} {algorithm}", batch))
    return [Contest(f"learn() on {ENV_ID}", "steps", entrants)]


def _seed_batch(**kwargs: Any) -> Any:
    return SeedBatch(seeds=range(N_SEEDS), algorithm=SACFlow, **kwargs)


def _steps_of(
    algorithm: Callable[..., Any],
    block: Callable[[], dict[str, Any]],
    quick: bool,
    n_seeds: int = 1,
) -> Work:
    """Return chunks of learning that count steps, after random steps and compilation."""
    kwargs = block()
    if quick:
        kwargs |= {key: QUICK_START for key in ("learning_starts", "random_steps") if key in kwargs}
    model = algorithm(env=ENV_ID, **kwargs)
    chunk = QUICK_CHUNK if quick else CHUNK
    warm_up = max(kwargs["learning_starts"], kwargs.get("random_steps", 0)) + chunk
    model.learn(warm_up)

    def work() -> float:
        model.learn(chunk, reset_num_timesteps=False)
        return chunk * n_seeds

    return work
