"""PPOFlow: SB3's PPO with our policies by name."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy

from sb3_flowpolicy.common.validation import (
    Check,
    by_name,
    check_policy,
    check_settings,
    flag,
    integer,
    number,
    optional,
    or_infinity,
    or_schedule,
)
from sb3_flowpolicy.guard.finite import NonFiniteError, all_finite
from sb3_flowpolicy.policies import on_policy

_SETTINGS: dict[str, Check] = {
    "n_steps": integer(1),
    "batch_size": integer(1),
    "n_epochs": integer(1),
    "gamma": number(0, 1),
    "gae_lambda": number(0, 1),
    "clip_range": or_schedule(number(0, above=True)),
    "clip_range_vf": optional(or_schedule(number(0, above=True))),
    "normalize_advantage": flag,
    "ent_coef": number(0),
    "vf_coef": number(0),
    "max_grad_norm": or_infinity(number(0, above=True)),
    "target_kl": optional(number(0, above=True)),
    "stats_window_size": integer(1),
    "seed": optional(integer(0, 2**32 - 1)),
}


class PPOFlow(PPO):
    """Proximal Policy Optimization with action distributions that correlate and bend.

    SB3's :class:`~stable_baselines3.PPO` with additional policy aliases.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, ``"GaussPolicy"``, their
            ``Cnn...`` and ``MultiInput...`` forms, or a policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *args: Further arguments of PPO, in its order.
        **kwargs: Keyword arguments of PPO. There is no colored noise: PPO's ratios assume that
            successive actions are independent.

    Raises:
        ValueError: If an argument is out of range.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017).

    Example:
        >>> model = PPOFlow("FlowPolicy", "Pendulum-v1", n_steps=64, seed=0).learn(64)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = on_policy.ALIASES

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        given = by_name(PPO, args, kwargs)
        check_settings(given, _SETTINGS)
        check_policy(given.get("policy"), ActorCriticPolicy, self.policy_aliases)
        super().__init__(*args, **kwargs)

    def train(self) -> None:
        """Do PPO's updates.

        Raises:
            NonFiniteError: If a reward or a value of the rollout is not finite; nothing is learned
                from that rollout.
        """
        for name in ("rewards", "values"):
            found = getattr(self.rollout_buffer, name)
            if not all_finite(found):
                value = float(found[~np.isfinite(found)][0])
                raise NonFiniteError(
                    f"{name} must be finite, got {value} in the rollout that ends at step "
                    f"{self.num_timesteps}; nothing was learned from it",
                    name,
                    value,
                    self.num_timesteps,
                )
        super().train()
