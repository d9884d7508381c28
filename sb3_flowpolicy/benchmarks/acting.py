"""How fast a finished agent acts, and how fast an agent is evaluated while it learns."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import POLICIES
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.policies.traced import CALLS_WORTH_TRACING

OBS_DIM, ACTION_DIM = 42, 8
EPISODE_STEPS = 1000


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
    acting = [
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
    evaluating = [
        Candidate(label, partial(_evaluating, *agents["SAC"][label][:2], quick))
        for label in ("SB3 SAC", *(f"SACFlow {policy}" for policy in POLICIES))
    ]
    return [*acting, Benchmark("EvalCallback while SAC learns", "steps", evaluating)]


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


class Idle(Unmoved):
    """Returns the same random observation at every step, so that only acting takes time."""

    def __init__(self) -> None:
        super().__init__(OBS_DIM, ACTION_DIM)
        self.obs = np.random.default_rng(0).uniform(-1, 1, OBS_DIM).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        """Begin an episode."""
        return self.obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Do nothing."""
        return self.obs, 0.0, False, False, {}


def _evaluating(algorithm: Any, policy: str, quick: bool) -> Work:
    """Evaluate one episode per piece of work, from a call of ``learn`` that does nothing else."""
    kwargs = {} if algorithm is SAC else {"compile": not quick}
    model = algorithm(policy, Idle(), learning_starts=2, buffer_size=100, device="cpu", **kwargs)
    model.learn(8)  # compiles
    model.learning_starts = 10**9
    env = Monitor(gym.wrappers.TimeLimit(Idle(), EPISODE_STEPS))
    test = EvalCallback(env, n_eval_episodes=1, eval_freq=1, verbose=0)

    def evaluate() -> float:
        model.learn(1, callback=test)
        return EPISODE_STEPS

    return evaluate
