"""PPOFlow: SB3's PPO with our policies by name."""

from __future__ import annotations

from typing import Any, ClassVar

from stable_baselines3 import PPO
from stable_baselines3.common.policies import BasePolicy

from sb3_flowpolicy.policies import on_policy as policies


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
        ValueError: If coloured noise is asked for: PPO's ratios take actions to be independent.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017).

    Example:
        >>> model = PPOFlow("FlowPolicy", "Pendulum-v1", n_steps=64, seed=0).learn(64)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.FlowActorCriticPolicy,
        "CnnPolicy": policies.CnnFlowActorCriticPolicy,
        "MultiInputPolicy": policies.MultiInputFlowActorCriticPolicy,
        "FlowPolicy": policies.FlowActorCriticPolicy,
        "CnnFlowPolicy": policies.CnnFlowActorCriticPolicy,
        "MultiInputFlowPolicy": policies.MultiInputFlowActorCriticPolicy,
        "LowRankPolicy": policies.LowRankActorCriticPolicy,
        "CnnLowRankPolicy": policies.CnnLowRankActorCriticPolicy,
        "MultiInputLowRankPolicy": policies.MultiInputLowRankActorCriticPolicy,
    }

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        colored = {name: value for name, value in kwargs.items() if name.startswith("action_noise")}
        if colored:
            raise ValueError(
                "action_noise_color and action_noise_correlation_time must be left to off-policy "
                f"algorithms: PPO takes successive actions to be independent, got {colored}"
            )
        super().__init__(*args, **kwargs)
