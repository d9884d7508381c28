"""A policy class for sb3-contrib's recurrent PPO."""

from __future__ import annotations

from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from sb3_flowpolicy.policies.on_policy import FlowActorCriticPolicy


class FlowLstmPolicy(FlowActorCriticPolicy, RecurrentActorCriticPolicy):
    """:class:`FlowActorCriticPolicy` with the memory of ``RecurrentActorCriticPolicy``.

    Example:
        >>> from sb3_contrib import RecurrentPPO
        >>> kwargs = dict(lstm_hidden_size=16)
        >>> model = RecurrentPPO(FlowLstmPolicy, "Pendulum-v1", n_steps=64, policy_kwargs=kwargs)
        >>> _ = model.learn(64)
    """
