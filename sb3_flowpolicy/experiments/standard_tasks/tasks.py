"""The tasks, and the policies that are compared on them."""

from __future__ import annotations

from importlib import resources
from typing import Any, NamedTuple

import yaml
from rl_zoo3.exp_manager import ExperimentManager
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC
from torch import nn  # noqa: F401, rl_zoo3's files name it

from sb3_flowpolicy.algorithms.crossq_flow import CrossQFlow
from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.algorithms.tqc_flow import TQCFlow


class Candidate(NamedTuple):
    """A class with a policy, and the arguments of the policy that set it apart."""

    algorithm: Any
    policy: str
    policy_kwargs: dict[str, Any]


_UNUSED = {
    *("policy", "n_timesteps"),
    *("use_sde", "sde_sample_freq", "use_expln", "log_std_init"),  # gSDE
}


class Task(NamedTuple):
    """An environment, the number of steps per algorithm, and the settings of all candidates.

    Two settings are not arguments of the algorithm: ``n_envs`` and ``normalize``, for rl_zoo3's
    ``VecNormalize``.
    """

    env_id: str
    steps: dict[str, int]
    env_kwargs: dict[str, Any] | None = None
    own_settings: dict[str, dict[str, Any]] | None = None

    def settings(self, algorithm: str) -> dict[str, Any]:
        """Return the task's own settings, or those that rl_zoo3 publishes, without gSDE.

        gSDE is not a density; ``log_std_init`` goes with it, as gSDE multiplies the features with
        noise of that size. Noise of that size itself is too small: PPO with ``log_std_init=-2``
        stayed at -1100 on HalfCheetah for 150,000 steps, where it reached some 500 without.
        """
        if self.own_settings is not None:
            return dict(self.own_settings[algorithm])
        files = resources.files("rl_zoo3") / "hyperparams"
        published = yaml.safe_load((files / f"{algorithm}.yml").read_text())[self.env_id]
        policy_kwargs = eval(published.pop("policy_kwargs", "{}"))
        settings, policy_kwargs = (
            {name: value for name, value in given.items() if name not in _UNUSED}
            for given in (published, policy_kwargs)
        )
        return ExperimentManager._preprocess_schedules(settings) | {"policy_kwargs": policy_kwargs}


def _candidates(stock: Any, ours: Any, **more: Candidate) -> dict[str, Candidate]:
    policies = {"gauss": "GaussPolicy", "lowrank": "LowRankPolicy", "flow": "FlowPolicy"}
    return {
        "stock": Candidate(stock, "MlpPolicy", {}),
        **{name: Candidate(ours, policy, {}) for name, policy in policies.items()},
        **more,
    }


_SQUASHED = {"squash_output": True, "state_dependent_std": True}

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
        lowrank_squashed=Candidate(PPOFlow, "LowRankPolicy", _SQUASHED),
        flow_squashed=Candidate(PPOFlow, "FlowPolicy", _SQUASHED),
    ),
}
"""Algorithm -> name -> candidate; "stock" is the algorithm with its own policy. "squashed" policies
bound actions by tanh, and their standard deviation depends on the observation."""

_STEPS = {"sac": 300_000, "tqc": 100_000, "crossq": 100_000, "ppo": 500_000}

TASKS: dict[str, Task] = {
    "half-cheetah": Task("HalfCheetahBulletEnv-v0", _STEPS),
    "hopper": Task("HopperBulletEnv-v0", _STEPS),
    "walker": Task("Walker2DBulletEnv-v0", _STEPS),
    # Only coordinated actions are safe here. Without normalized advantages, the entropy coefficient
    # weighs entropy against reward, as in SAC. Steps of the weights are small, because the mean
    # must not reach the edge of the action box, where clipping hides its gradient, before noise has
    # found the goal. Chosen on seeds 100 to 109.
    "tunnel-2": Task(
        "TunnelDiagonal-v0",
        {"ppo": 150_000},
        {"total_dims": 2, "coupled_dims": 2},
        {
            "ppo": {
                "n_envs": 8,
                "n_steps": 256,
                "batch_size": 512,
                "n_epochs": 10,
                "gamma": 0.8,
                "gae_lambda": 0.9,
                "learning_rate": 3e-4,
                "normalize_advantage": False,
                "ent_coef": 0.003,
                "policy_kwargs": {"net_arch": [32, 32], "log_std_init": -1.0},
            },
        },
    ),
}
"""Name -> task."""
