"""CrossQ: no target networks, but one batch of current and next observations for the critics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq.policies import CrossQCritic
from torch import nn

from sb3_flowpolicy.engine.renorm import RenormNetworks
from sb3_flowpolicy.engine.sac import SACObjective
from sb3_flowpolicy.engine.update import (
    LOSSES,
    Batch,
    TrainState,
    Update,
    UpdateSettings,
    bellman_targets,
    entropy_coefficient,
    gradient_of,
    stack_losses,
    step,
    step_entropy_coefficient,
)
from sb3_flowpolicy.policies.crossq import CrossQFlowActor


@dataclass(frozen=True)
class CrossQObjective(SACObjective):
    """The objective of CrossQ: SAC's, with an update of its own.

    Args:
        policy_delay: Number of updates of the critics for one of the actor.

    References:
        CrossQ: Batch Normalization in Deep Reinforcement Learning (Bhatt et al., 2024).
    """

    policy_delay: int = 3
    name: ClassVar[str] = "CrossQ"
    critic_type: ClassVar[type[nn.Module]] = CrossQCritic
    gsde_actor_type: ClassVar[type[nn.Module] | None] = None
    layer_types: ClassVar[tuple[type[nn.Module], ...]] = (nn.Linear, BatchRenorm1d)
    networks_type: ClassVar[type[RenormNetworks]] = RenormNetworks

    def why_unsupported(self, policy: Any) -> str | None:
        """Return what about a policy is not supported: actors of other kinds."""
        if type(policy.actor) is not CrossQFlowActor:
            return f"actor of type {type(policy.actor).__name__}"
        networks = (policy.actor.latent_pi, policy.critic.q_networks[0])
        if not all(any(isinstance(one, BatchRenorm1d) for one in net) for net in networks):
            return "CrossQ without batch renormalization"
        if len({_constants(network) for network in policy.critic.q_networks}) > 1:
            return "critics that differ in their batch renormalization"
        return None

    def layer_constants(self, policy: Any) -> tuple[object, ...]:
        """Return the constants of the batch renormalization."""
        return tuple(map(_constants, (policy.actor.latent_pi, *policy.critic.q_networks)))

    def is_due(self, model: Any, index: int, start: int) -> bool:
        """Whether it is the actor's turn in this update."""
        return (model._n_updates + index + 1) % self.policy_delay == 0

    def mean_losses(
        self, history: Sequence[th.Tensor], n_due: int
    ) -> tuple[th.Tensor, tuple[str, ...]]:
        """Average the actor's losses over its own updates; without any, there are none."""
        mean = th.stack(list(history)).mean(0)
        of_actor = [LOSSES.index("ent_coef_loss"), LOSSES.index("actor_loss")]
        mean[of_actor] *= len(history) / max(1, n_due)
        return mean, LOSSES if n_due else ("ent_coef", "critic_loss")

    def make_update(self, networks: Any, settings: UpdateSettings) -> Update:
        """Return sb3-contrib's ``CrossQ.train``, in its order: critics, entropy coefficient, actor.

        The flag of an update decides whether the last two are updated.
        """

        def update(
            state: TrainState, batch: Batch, learning_rates: th.Tensor, moves_actor: bool
        ) -> th.Tensor:
            ent_coef = entropy_coefficient(state, settings)
            with th.no_grad():
                next_actions, next_log_prob, _ = networks.sample_with(
                    state.actor, state.others, batch.next_obs, batch.noise[1], training=False
                )
            critic = state.critic.detach().requires_grad_()
            outputs, statistics = networks.q_values_with(
                critic,
                state.others,
                th.cat([batch.obs, batch.next_obs], dim=1),
                th.cat([batch.actions, next_actions], dim=1),
                training=True,
            )
            current, following = outputs.chunk(2, dim=2)
            targets = bellman_targets(
                batch, self.next_values(following.detach()), ent_coef * next_log_prob
            )
            critic_loss = self.critic_loss(current, targets)
            gradient, moments = gradient_of(critic_loss, critic), state.critic_moments
            step(state.critic, gradient, moments, learning_rates[1], settings.critic_adam)
            networks.write_statistics(state.others, statistics, of_critics=True)

            ent_coef_loss, actor_loss = th.zeros_like(ent_coef), th.zeros_like(critic_loss)
            if moves_actor:
                actor = state.actor.detach().requires_grad_()
                actions_pi, log_prob, statistics = networks.sample_with(
                    actor, state.others, batch.obs, batch.noise[0], training=True
                )
                ent_coef_loss = step_entropy_coefficient(
                    state, log_prob, learning_rates[2], settings
                )
                outputs, _ = networks.q_values_with(
                    state.critic, state.others, batch.obs, actions_pi, training=False
                )
                actor_loss = (ent_coef * log_prob - self.actor_values(outputs)).mean(-1)
                gradient, moments = gradient_of(actor_loss, actor), state.actor_moments
                step(state.actor, gradient, moments, learning_rates[0], settings.actor_adam)
                networks.write_statistics(state.others, statistics, of_critics=False)
            return stack_losses(ent_coef, ent_coef_loss, critic_loss, actor_loss)

        return update


def _constants(network: nn.Module) -> tuple[tuple[float, ...], ...]:
    return tuple(
        (layer.eps, layer.momentum, layer.rmax, layer.dmax, layer.warmup_steps)
        for layer in network.children()
        if isinstance(layer, BatchRenorm1d)
    )
