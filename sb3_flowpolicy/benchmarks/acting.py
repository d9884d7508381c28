"""Calls of ``predict`` per second: how fast a finished or evaluated agent acts."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from stable_baselines3 import PPO, SAC

from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import POLICIES
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.policies.traced import CALLS_WORTH_TRACING

OBS_DIM, ACTION_DIM = 42, 8


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return SAC and PPO, sampling and deterministic, for one observation and for many."""
    agents: dict[str, dict[str, tuple[Any, str, dict[str, Any]]]] = {
        "SAC": {"SB3 SAC": (SAC, "MlpPolicy", {})}
        | {f"SACFlow {policy}": (SACFlow, policy, {}) for policy in POLICIES}
        | {
            f"SACFlow FlowPolicy, {mode}": (SACFlow, "FlowPolicy", {"deterministic_mode": mode})
            for mode in MODES[1:]
        },
        "PPO": {"SB3 PPO": (PPO, "MlpPolicy", {})}
        | {f"PPOFlow {policy}": (PPOFlow, policy, {}) for policy in POLICIES},
    }
    return [
        Benchmark(
            f"{'deterministic' if deterministic else 'sampled'} actions of {name}, {size} at once",
            "calls",
            [
                Candidate(label, partial(_acting, *agent, deterministic, size, quick))
                for label, agent in candidates.items()
                if deterministic or not agent[2]
            ],
        )
        for name, candidates in agents.items()
        for deterministic in (False, True)
        for size in (1, 100)
    ]


def _acting(
    algorithm: Any,
    policy: str,
    policy_kwargs: dict[str, Any],
    deterministic: bool,
    size: int,
    quick: bool,
) -> Work:
    kwargs = {"buffer_size": 1} if issubclass(algorithm, SAC) else {}
    model = algorithm(
        policy,
        Unmoved(OBS_DIM, ACTION_DIM),
        policy_kwargs={"net_arch": [256, 256], **policy_kwargs},
        device="cpu",
        **kwargs,
    )
    obs = np.random.default_rng(0).uniform(-1, 1, (size, OBS_DIM)).astype(np.float32)

    def act() -> float:
        model.predict(obs if size > 1 else obs[0], deterministic=deterministic)
        return 1.0

    for _ in range(0 if quick else CALLS_WORTH_TRACING + 2):  # then graphs are recorded
        act()
    return act
