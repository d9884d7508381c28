"""Gradient updates per second: SACFlow against SB3's SAC, against the matrix products alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.limit import products_alone
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, UnavailableError, Work
from sb3_flowpolicy.benchmarks.zoo_blocks import stock_block, zoo_block
from sb3_flowpolicy.engine import Engine
from sb3_flowpolicy.policies import FlowPolicy

BATCH_SIZE = 256
# Per call of train(): as if an episode had just ended.
N_UPDATES = 64
N_SEEDS = 10
N_TRANSITIONS = 10_000
# Units from which on products in bfloat16 are faster.
WORTH_ROUNDING = 128
SPARSE_TUNNEL = "TunnelDiagonal-v0"


@dataclass(frozen=True)
class Shape:
    """Sizes of a problem and of the networks that solve it."""

    units: int
    obs_dim: int
    action_dim: int

    @property
    def title(self) -> str:
        """For the table."""
        return f"nets {self.units}-{self.units}, obs {self.obs_dim}, D = {self.action_dim}"

    def policy_kwargs(self, policy: str) -> dict[str, Any]:
        """Return the sizes of the networks of a policy."""
        units = [self.units, self.units]
        if policy == "FlowPolicy" and self.units == 16:
            # Thesis section 3.2.4: about as many parameters as the Gaussian's.
            small = [4, 4]
            return {
                "net_arch": {"pi": small, "qf": units},
                "distribution_kwargs": {"hidden": small},
            }
        return {"net_arch": units}


SHAPES = (Shape(16, 2, 2), Shape(128, 2, 2), Shape(256, 42, 8))
POLICIES = ("GaussPolicy", "LowRankPolicy", "FlowPolicy")


class Unmoved(gym.Env):
    """Spaces without a world behind them: updates read the replay buffer only."""

    def __init__(self, obs_dim: int, action_dim: int) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (action_dim,), np.float32)


def contests(quick: bool = False) -> list[Contest]:
    """One contest per shape, and one for ten stacked seeds; ``quick`` keeps the first, shorter."""
    if quick:
        return [_contest(SHAPES[0], ("GaussPolicy",))]
    return [*(_contest(shape, POLICIES) for shape in SHAPES), _stacked_contest()]


def _contest(shape: Shape, policies: tuple[str, ...]) -> Contest:
    def sac(algorithm: Callable[..., Any], policy: Any, sizes_of: str, **kwargs: Any) -> Any:
        sizes = shape.policy_kwargs(sizes_of)
        return prefilled(algorithm, shape, policy=policy, policy_kwargs=sizes, **kwargs)

    def stock() -> Work:
        return updates_of(sac(SAC, "MlpPolicy", "MlpPolicy"))

    def stock_with_flow() -> Work:
        return updates_of(sac(SAC, FlowPolicy, "FlowPolicy"))

    def sbx() -> Work:
        try:
            sbx_sac = import_module("sbx").SAC
        except ModuleNotFoundError as error:
            raise UnavailableError("sbx-rl is not installed") from error
        return updates_of(sac(sbx_sac, "MlpPolicy", "MlpPolicy"))

    entrants = [Entrant("SB3 SAC", stock, limit=_limit_name("GaussPolicy"))]
    for policy in policies:

        def ours(policy: str = policy) -> Work:
            return updates_of(sac(SACFlow, policy, policy, compile=True))

        def rounded(policy: str = policy) -> Work:
            return updates_of(sac(SACFlow, policy, policy, compile=True, autocast=True))

        entrants.append(Entrant(f"SACFlow {policy}", ours, limit=_limit_name(policy)))
        if shape.units >= WORTH_ROUNDING and policy != "LowRankPolicy":
            entrants.append(Entrant(f"SACFlow {policy}, bfloat16", rounded))
    if "FlowPolicy" in policies:
        limit = _limit_name("FlowPolicy")
        entrants.append(Entrant("SB3 SAC with FlowPolicy", stock_with_flow, limit=limit))
    entrants.append(Entrant("SBX SAC", sbx))
    for policy in policies:

        def limit_of(policy: str = policy) -> Work:
            model = sac(SACFlow, policy, policy)
            return products_alone([model.policy], BATCH_SIZE, N_UPDATES)

        entrants.append(Entrant(_limit_name(policy), limit_of))
    return Contest(shape.title, "updates", entrants)


def _stacked_contest() -> Contest:
    shape = SHAPES[0]

    def stock() -> Work:
        return updates_of(prefilled(SAC, shape, **stock_block(SPARSE_TUNNEL)))

    entrants = [Entrant("SB3 SAC, one seed", stock)]
    for algorithm in ("sac_gauss", "sac_flow"):

        def models(algorithm: str = algorithm) -> list[SACFlow]:
            block = zoo_block(algorithm, SPARSE_TUNNEL)
            return [prefilled(SACFlow, shape, **block, seed=seed) for seed in range(N_SEEDS)]

        def stacked(models: Callable[[], list[SACFlow]] = models) -> Work:
            seeds = models()
            engine = Engine(seeds, seeds[0].critic_loss_coef, compiled=True)

            def work() -> float:
                engine.train(engine.draw(N_UPDATES, BATCH_SIZE))
                return N_UPDATES * N_SEEDS

            return work

        def limit_of(models: Callable[[], list[SACFlow]] = models) -> Work:
            return products_alone([model.policy for model in models()], BATCH_SIZE, N_UPDATES)

        limit = _limit_name(f"{N_SEEDS} x {algorithm}")
        entrants += [
            Entrant(f"{N_SEEDS} x {algorithm}, stacked", stacked, limit),
            Entrant(limit, limit_of),
        ]
    return Contest(f"{N_SEEDS} seeds of {SPARSE_TUNNEL}'s settings", "updates", entrants)


def _limit_name(of: str) -> str:
    return f"products alone, {of}"


def prefilled(algorithm: Callable[..., Any], shape: Shape, **kwargs: Any) -> Any:
    """Return a model whose replay buffer is full of random transitions."""
    kwargs["buffer_size"] = N_TRANSITIONS
    model = algorithm(env=Unmoved(shape.obs_dim, shape.action_dim), **kwargs)
    model.set_logger(Logger(folder=None, output_formats=[]))
    rng, buffer = np.random.default_rng(0), model.replay_buffer
    for column in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
        column[:] = rng.uniform(-1, 1, column.shape)
    buffer.full = True
    return model


def updates_of(model: Any) -> Work:
    """Return calls of ``train`` that count updates."""

    def work() -> float:
        model.train(gradient_steps=N_UPDATES, batch_size=BATCH_SIZE)
        return N_UPDATES

    return work
