"""A policy class for sb3-contrib's recurrent PPO."""

from __future__ import annotations

from typing import Any

from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from sb3_flowpolicy.policies.on_policy import FlowActorCriticPolicy


class FlowLstmPolicy(FlowActorCriticPolicy, RecurrentActorCriticPolicy):
    """:class:`FlowActorCriticPolicy` with the memory of ``RecurrentActorCriticPolicy``.

    ``squash_output`` must be False: ``RecurrentPPO`` clips the actions that it collects to the
    action space and would not rescale squashed ones.

    Example:
        >>> from sb3_contrib import RecurrentPPO
        >>> model = RecurrentPPO(FlowLstmPolicy, "Pendulum-v1", n_steps=64)
    """

    _predict = RecurrentActorCriticPolicy._predict  # type: ignore[assignment]

    def __init__(self, *args: Any, squash_output: bool = False, **kwargs: Any) -> None:
        if squash_output:
            raise ValueError(
                "squash_output must be False, because sb3-contrib's RecurrentPPO does not rescale "
                f"the actions it collects, got {squash_output!r}"
            )
        super().__init__(*args, squash_output=False, **kwargs)
