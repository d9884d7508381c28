"""PPOFlow: SB3's PPO with our policies by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy

from sb3_flowpolicy.common.settings import (
    PPO_SETTINGS,
    assertions_as_value_errors,
    by_name,
    check_policy,
    check_settings,
)
from sb3_flowpolicy.guard.finite import NonFiniteError, all_finite
from sb3_flowpolicy.policies import on_policy

_COLORED = ("action_noise_color", "action_noise_correlation_time")


class PPOFlow(PPO):
    """Proximal Policy Optimization with action distributions that correlate and bend.

    SB3's :class:`~stable_baselines3.PPO` itself, which knows more policies by name.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, their ``Cnn...`` and
            ``MultiInput...`` forms, or a policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *args: Further arguments of PPO, in its order.
        **kwargs: Keyword arguments of PPO.

    Raises:
        ValueError: If an argument is out of range, or coloured noise is asked for: PPO's ratios
            take actions to be independent.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017).

    Example:
        >>> model = PPOFlow("FlowPolicy", "Pendulum-v1", n_steps=64, seed=0).learn(64)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = on_policy.ALIASES

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        given = by_name(PPO, args, kwargs)
        _refuse_colored_noise(given)
        check_settings(given, PPO_SETTINGS)
        check_policy(given.get("policy"), ActorCriticPolicy, self.policy_aliases)
        with assertions_as_value_errors():
            super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        _refuse_colored_noise(vars(self))  # what load() was given
        super()._setup_model()

    def train(self) -> None:
        """Do PPO's updates.

        Raises:
            NonFiniteError: If a reward, or a value, of the rollout is not finite; nothing is
                learned from it.
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


def _refuse_colored_noise(settings: Mapping[str, Any]) -> None:
    colored = {name: settings[name] for name in _COLORED if name in settings}
    if colored:
        raise ValueError(
            "action_noise_color and action_noise_correlation_time must be left to off-policy "
            f"algorithms: PPO takes successive actions to be independent, got {colored}"
        )
