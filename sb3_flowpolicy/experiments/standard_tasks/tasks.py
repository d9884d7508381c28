"""The tasks, and the policies that are compared on them."""

from __future__ import annotations

from typing import Any, NamedTuple

from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_flowpolicy.algorithms.crossq_flow import CrossQFlow
from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.algorithms.tqc_flow import TQCFlow


class Candidate(NamedTuple):
    """A class with a policy, and the arguments of the policy that set it apart."""

    algorithm: Any
    policy: str
    policy_kwargs: dict[str, Any]


class Task(NamedTuple):
    """An environment, and per algorithm the number of steps and the settings of all candidates.

    Two settings are not arguments of the algorithm: ``n_envs`` and ``normalize``, for rl_zoo3's
    ``VecNormalize``.
    """

    env_id: str
    steps: dict[str, int]
    settings: dict[str, dict[str, Any]]
    env_kwargs: dict[str, Any]


def _candidates(stock: Any, ours: Any, **more: Candidate) -> dict[str, Candidate]:
    policies = {"gauss": "GaussPolicy", "lowrank": "LowRankPolicy", "flow": "FlowPolicy"}
    return {
        "stock": Candidate(stock, "MlpPolicy", {}),
        **{name: Candidate(ours, policy, {}) for name, policy in policies.items()},
        **more,
    }


CANDIDATES: dict[str, dict[str, Candidate]] = {
    "sac": _candidates(
        SAC, SACFlow, spline=Candidate(SACFlow, "FlowPolicy", {"distribution": "spline"})
    ),
    "tqc": _candidates(TQC, TQCFlow),
    "crossq": _candidates(CrossQ, CrossQFlow),
    "ppo": _candidates(
        PPO,
        PPOFlow,
        full=Candidate(PPOFlow, "GaussPolicy", {"distribution": "full_covariance"}),
    ),
}
"""Algorithm -> name -> candidate; "stock" is the algorithm with its own policy."""

# rl_zoo3 2.9.2's settings for PyBullet's tasks, without gSDE, which is not a density: without
# use_sde, sde_sample_freq, use_expln, and the log_std_init that goes with it. A test compares them.
_PPO = {
    "normalize": True,
    "n_envs": 16,
    "n_steps": 512,
    "batch_size": 128,
    "n_epochs": 20,
    "gamma": 0.99,
    "gae_lambda": 0.9,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "learning_rate": 3e-5,
    "clip_range": 0.4,
    "policy_kwargs": {
        "ortho_init": False,
        "activation_fn": nn.ReLU,
        "net_arch": {"pi": [256, 256], "vf": [256, 256]},
    },
}
_PPO_LINEAR = {**_PPO, "clip_range": LinearSchedule(0.4, 0.0, 1.0)}
_CROSSQ = {
    "learning_rate": 7.3e-4,
    "buffer_size": 300_000,
    "batch_size": 256,
    "ent_coef": "auto",
    "gamma": 0.98,
    "train_freq": 8,
    "gradient_steps": 8,
    "learning_starts": 10_000,
}
_SAC = {**_CROSSQ, "tau": 0.02, "policy_kwargs": {"net_arch": [400, 300]}}
_LINEAR = {"learning_rate": LinearSchedule(7.3e-4, 0.0, 1.0)}
_STEPS = {"sac": 300_000, "tqc": 100_000, "crossq": 100_000, "ppo": 500_000}
_HOPPER = {
    "sac": {**_SAC, **_LINEAR},
    "tqc": {**_SAC, **_LINEAR, "top_quantiles_to_drop_per_net": 5},
    "crossq": {**_CROSSQ, **_LINEAR},
    "ppo": _PPO_LINEAR,
}
_WALKER = {**_HOPPER, "tqc": {**_SAC, **_LINEAR}}
_CHEETAH = {"sac": _SAC, "tqc": _SAC, "crossq": _CROSSQ, "ppo": _PPO}

TASKS: dict[str, Task] = {
    "half-cheetah": Task("HalfCheetahBulletEnv-v0", _STEPS, _CHEETAH, {}),
    "hopper": Task("HopperBulletEnv-v0", _STEPS, _HOPPER, {}),
    "walker": Task("Walker2DBulletEnv-v0", _STEPS, _WALKER, {}),
    # Our own settings with small networks, for a quick look.
    "half-cheetah-quick": Task(
        "HalfCheetahBulletEnv-v0",
        {"ppo": 150_000},
        {
            "ppo": {
                "normalize": True,
                "n_envs": 8,
                "n_steps": 512,
                "batch_size": 128,
                "gae_lambda": 0.9,
                "policy_kwargs": {"net_arch": [64, 64]},
            }
        },
        {},
    ),
    # Only coordinated actions are safe here.
    "tunnel-2": Task(
        "TunnelDiagonal-v0",
        {"ppo": 120_000},
        {
            "ppo": {
                "n_envs": 8,
                "n_steps": 64,
                "batch_size": 128,
                "n_epochs": 10,
                "gamma": 0.8,
                "gae_lambda": 0.9,
                "learning_rate": 1e-3,
                "ent_coef": 0.01,
                "policy_kwargs": {"net_arch": [32, 32]},
            },
        },
        {"total_dims": 2, "coupled_dims": 2},
    ),
}
"""Name -> task."""
