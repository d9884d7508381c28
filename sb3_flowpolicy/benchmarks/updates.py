"""Gradient updates per second, compared with SB3 and with the matrix products alone."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import ENV_ID, N_SEEDS, POLICIES, stock_block, zoo_block
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.engine import Engine, EngineRuntime
from sb3_flowpolicy.policies import FlowPolicy
from sb3_flowpolicy.seeds.setup import refuse

BATCH_SIZE = 256
# Updates per call of train(), as after an episode.
N_UPDATES = 64
N_CALLS = 4
N_TRANSITIONS = 10_000
# Products in bfloat16 are faster from this number of units on.
MIN_UNITS_BFLOAT16 = 128


class Shape(NamedTuple):
    """Sizes of a problem and of the networks that solve it."""

    units: int
    obs_dim: int
    action_dim: int

    @property
    def title(self) -> str:
        """Title of the benchmark."""
        return f"nets {self.units}-{self.units}, obs {self.obs_dim}, D = {self.action_dim}"

    def policy_kwargs(self, policy: Any) -> dict[str, Any]:
        """Return the sizes of the networks of a policy."""
        units, small = [self.units, self.units], [4, 4]
        if policy in ("FlowPolicy", FlowPolicy) and self.units == 16:
            # Thesis section 3.2.4: about as many parameters as the Gaussian's.
            sizes = {"pi": small, "qf": units}
            return {"net_arch": sizes, "distribution_kwargs": {"hidden": small}}
        return {"net_arch": units}


SHAPES = (Shape(16, 2, 2), Shape(128, 2, 2), Shape(256, 42, 8))
CONTRIB_SHAPES = (Shape(64, 17, 6), Shape(256, 42, 8))


class Unmoved(gym.Env):
    """An environment that has only spaces, because updates read only the replay buffer."""

    def __init__(self, obs_dim: int, action_dim: int) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (action_dim,), np.float32)


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return one benchmark per shape and one of ten stacked seeds; ``quick``: a small first one."""
    if quick:
        return [_single_seed(SHAPES[0], ("GaussPolicy",))]
    return [*(_single_seed(shape, POLICIES) for shape in SHAPES), _stacked_seeds()]


def contrib(quick: bool = False) -> list[Benchmark]:
    """Return TQC and CrossQ against sb3-contrib's; ``quick``: one shape, not compiled."""

    def candidate(shape: Shape, algorithm: str, policy: str, **kwargs: Any) -> Candidate:
        def prepare() -> Work:
            constructor = pkgutil.resolve_name(algorithm)  # needs the extra [contrib]
            # sb3-contrib's updates take long.
            return updates_of(_sized(constructor, shape, policy, **kwargs), n_calls=1)

        return Candidate(f"{algorithm.rpartition(':')[2]} {policy}", prepare)

    return [
        Benchmark(
            f"{name}, {shape.title}",
            "updates",
            [
                candidate(shape, f"sb3_contrib:{name}", "MlpPolicy"),
                *(
                    candidate(shape, f"sb3_flowpolicy:{name}Flow", policy, compile=not quick)
                    for policy in POLICIES
                ),
            ],
        )
        for name in ("TQC", "CrossQ")
        for shape in CONTRIB_SHAPES[: 1 if quick else None]
    ]


def _single_seed(shape: Shape, policies: Sequence[str]) -> Benchmark:
    def updates(*args: Any, **kwargs: Any) -> Callable[[], Work]:
        return lambda: updates_of(_sized(*args, **kwargs))

    def sbx() -> Work:
        return updates_of(_sized(import_module("sbx").SAC, shape, "MlpPolicy"))

    def limit(policy: str) -> Work:
        return products_alone([_sized(SACFlow, shape, policy).policy], BATCH_SIZE, N_UPDATES)

    stock = updates(SAC, shape, "MlpPolicy")
    candidates = [Candidate("SB3 SAC", stock, _limit_name("GaussPolicy"))]
    for policy in policies:
        ours = updates(SACFlow, shape, policy, compile=True)
        candidates.append(Candidate(f"SACFlow {policy}", ours, _limit_name(policy)))
        if shape.units >= MIN_UNITS_BFLOAT16 and policy != "LowRankPolicy":
            rounded = updates(SACFlow, shape, policy, compile=True, autocast=True)
            candidates.append(Candidate(f"SACFlow {policy}, bfloat16", rounded))
    if "FlowPolicy" in policies:
        ours = updates(SAC, shape, FlowPolicy)
        candidates.append(Candidate("SB3 SAC with FlowPolicy", ours, _limit_name("FlowPolicy")))
    candidates.append(Candidate("SBX SAC", sbx))
    candidates += [Candidate(_limit_name(policy), partial(limit, policy)) for policy in policies]
    return Benchmark(shape.title, "updates", candidates)


def _stacked_seeds() -> Benchmark:
    def models(algorithm: str) -> list[SACFlow]:
        block = {**zoo_block(algorithm, ENV_ID), "compile": True}
        return [prefilled(SACFlow, SHAPES[0], **block, seed=seed) for seed in range(N_SEEDS)]

    def stock() -> Work:
        return updates_of(prefilled(SAC, SHAPES[0], **stock_block(ENV_ID)))

    def stacked(algorithm: str) -> Work:
        runtime = EngineRuntime(models(algorithm), Engine, refuse)

        def work() -> float:
            with runtime.running():
                for _ in range(N_CALLS):
                    engine = runtime.engine()
                    assert engine is not None
                    engine.train(engine.draw(N_UPDATES, BATCH_SIZE))
            return N_CALLS * N_UPDATES * N_SEEDS

        return work

    def limit(algorithm: str) -> Work:
        return products_alone([model.policy for model in models(algorithm)], BATCH_SIZE, N_UPDATES)

    candidates = [Candidate("SB3 SAC, one seed", stock)]
    for algorithm in ("sac_gauss", "sac_flow"):
        name = f"{N_SEEDS} x {algorithm}"
        candidates += [
            Candidate(f"{name}, stacked", partial(stacked, algorithm), _limit_name(name)),
            Candidate(_limit_name(name), partial(limit, algorithm)),
        ]
    return Benchmark(f"{N_SEEDS} seeds of {ENV_ID}'s settings", "updates", candidates)


def _limit_name(of: str) -> str:
    return f"products alone, {of}"


def _sized(algorithm: Callable[..., Any], shape: Shape, policy: Any, **kwargs: Any) -> Any:
    """Return a prefilled model whose networks have the sizes of the shape."""
    sizes = shape.policy_kwargs(policy)
    return prefilled(algorithm, shape, policy=policy, policy_kwargs=sizes, **kwargs)


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


def updates_of(model: Any, n_calls: int = N_CALLS) -> Work:
    """Call ``train`` and count updates, with ours bound to its engine as during ``learn``."""
    learning = model._runtime.running if isinstance(model, EngineFlow) else nullcontext

    def work() -> float:
        with learning():
            for _ in range(n_calls):
                model.train(gradient_steps=N_UPDATES, batch_size=BATCH_SIZE)
        return n_calls * N_UPDATES

    return work


def products_alone(policies: Sequence[SACPolicy], batch_size: int, n_updates: int) -> Work:
    """Compute only the matrix products of updates: an upper bound on the rate of any update.

    In each update the actor runs on the present and on the next observations, and backward once.
    The critics run three times (targets, critic loss, actor loss) and backward twice: once for
    their weights and once only through to the actions.

    The policies have equal shapes and are stacked. The work counts updates, summed over them.
    """
    n_policies = len(policies)
    critics = policies[0].critic.q_networks
    # Operands and result: (copies, rows, inner) x (copies, inner, columns), or without copies.
    products: list[tuple[th.Tensor, th.Tensor, th.Tensor]] = []

    def add(left: th.Tensor, right: th.Tensor) -> None:
        products.append((left, right, th.empty(*left.shape[:-1], right.shape[-1])))

    for network, copies, forward_passes, input_gradients in (
        (policies[0].actor, n_policies, 2, 1),
        (critics[0], n_policies * len(critics), 3, 2),
    ):
        linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
        lead = () if copies == 1 else (copies,)
        for i, layer in enumerate(linear):
            inputs = th.randn(*lead, batch_size, layer.in_features)
            weight = th.randn(*lead, layer.out_features, layer.in_features)
            gradient = th.randn(*lead, batch_size, layer.out_features)
            for _ in range(forward_passes):
                add(inputs, weight.mT)
            add(gradient.mT, inputs)
            # The critic loss needs no gradient of the inputs, the actor loss that of the actions.
            for _ in range(input_gradients if i > 0 else input_gradients - 1):
                add(gradient, weight)

    @th.no_grad()
    def work() -> float:
        for _ in range(n_updates):
            for left, right, out in products:
                th.matmul(left, right, out=out)
        return n_updates * n_policies

    return work
