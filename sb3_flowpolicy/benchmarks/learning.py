"""Environment steps per second of ``learn()``: acting, stepping, storing and updating."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv

import flowpolicy_envs
from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "TunnelDiagonal-v0"
N_SEEDS = 10
POLICIES = ("GaussPolicy", "LowRankPolicy", "FlowPolicy")
# Steps per call of learn() and seed, enough to make the overhead of a call negligible.
CHUNK = 500
QUICK_START, QUICK_CHUNK = 50, 10
# SB3 draws gSDE's noise once per rollout: with train_freq=1 it would be white.
GSDE = {"use_sde": True, "train_freq": 8, "gradient_steps": 8}
# Sizes as in rl_zoo3's settings, with SB3's tanh layers; rollouts on Pendulum-v1 are shorter.
PPO_SETTINGS: dict[str, dict[str, Any]] = {
    "Pendulum-v1": {"n_envs": 4, "n_steps": 256, "batch_size": 64, "n_epochs": 10},
    "HalfCheetahBulletEnv-v0": {
        "n_envs": 1,
        "n_steps": 512,
        "batch_size": 128,
        "n_epochs": 20,
        "policy_kwargs": {"net_arch": [256, 256], "ortho_init": False, "log_std_init": -2},
    },
}


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
    ppo = partial(PPOFlow, compile=not quick)
    return [
        _on_tunnel(f"learn() on {ENV_ID}", ("sac_gauss", "sac_flow"), {}, quick),
        _on_tunnel("the same with gSDE", ("sac_gauss",), GSDE, quick),
        *(
            Benchmark(
                f"learn() of PPO on {env_id}",
                "steps",
                [
                    Candidate("SB3 PPO", partial(_ppo, PPO, "MlpPolicy", env_id, quick)),
                    *(
                        Candidate(f"PPOFlow {name}", partial(_ppo, ppo, name, env_id, quick))
                        for name in POLICIES
                    ),
                ],
            )
            for env_id in PPO_SETTINGS
        ),
    ]


def _on_tunnel(
    title: str, algorithms: Sequence[str], changes: dict[str, Any], quick: bool
) -> Benchmark:
    candidates = [Candidate("SB3 SAC", partial(_sac, SAC, stock_block(ENV_ID) | changes, quick))]
    for algorithm in algorithms:
        block = zoo_block(algorithm, ENV_ID) | {"compile": not quick, **changes}
        name = algorithm + (", not compiled" if quick else "")
        candidates.append(Candidate(name, partial(_sac, SACFlow, block, quick)))
        if not quick:
            stacked = partial(SeedBatch, seeds=range(N_SEEDS))
            prepare = partial(_sac, stacked, block, n_seeds=N_SEEDS)
            candidates.append(Candidate(f"SeedBatch of {N_SEEDS} {algorithm}", prepare))
    return Benchmark(title, "steps", candidates)


def with_hindsight(quick: bool = False) -> list[Benchmark]:
    """Return learning with hindsight experience replay; ``quick`` does not compile."""
    start, chunk = (QUICK_START, QUICK_CHUNK) if quick else (1000, CHUNK)

    def prepare(algorithm: Callable[..., Any], policy: str) -> Work:
        model = algorithm(
            policy,
            BitFlippingEnv(n_bits=8, continuous=True),
            batch_size=256,
            learning_starts=start,
            replay_buffer_class=HerReplayBuffer,
            policy_kwargs={"net_arch": [64, 64]},
        )
        return _learning(model, start + chunk, chunk, chunk)

    ours = partial(SACFlow, compile=not quick)
    candidates = [
        Candidate("SB3 SAC", partial(prepare, SAC, "MultiInputPolicy")),
        *(Candidate(f"SACFlow {p}", partial(prepare, ours, f"MultiInput{p}")) for p in POLICIES),
    ]
    return [Benchmark("learn() with HER, nets 64-64", "steps", candidates)]


def _learning(model: Any, warm_up: int, chunk: int, amount: int) -> Work:
    """Learn in chunks after a warm-up: random steps and compilation."""
    model.learn(warm_up)

    def work() -> float:
        model.learn(chunk, reset_num_timesteps=False)
        return amount

    return work


def _sac(
    algorithm: Callable[..., Any], block: dict[str, Any], quick: bool = False, n_seeds: int = 1
) -> Work:
    starts = {name for name in ("learning_starts", "random_steps") if name in block}
    kwargs = block | (dict.fromkeys(starts, QUICK_START) if quick else {})
    chunk = QUICK_CHUNK if quick else CHUNK
    warm_up = max(kwargs[name] for name in starts) + chunk
    return _learning(algorithm(env=ENV_ID, **kwargs), warm_up, chunk, chunk * n_seeds)


def _ppo(algorithm: Callable[..., Any], policy: str, env_id: str, quick: bool) -> Work:
    """Collect a rollout and learn from it per piece of work."""
    if env_id.endswith("BulletEnv-v0"):
        import_module("pybullet_envs_gymnasium")
    settings = dict(PPO_SETTINGS[env_id])
    n_envs = settings.pop("n_envs")
    if quick:
        settings |= {"n_steps": QUICK_CHUNK, "n_epochs": 1}
    model = algorithm(policy, make_vec_env(env_id, n_envs), **settings)
    return _learning(model, 1, 1, model.n_steps * n_envs)
