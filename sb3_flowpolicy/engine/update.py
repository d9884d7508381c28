"""One update of an actor and critics, written once: eager, compiled, for one seed or S of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch as th
from torch import nn

from sb3_flowpolicy.engine.adam import AdamSettings, adam_step
from sb3_flowpolicy.engine.networks import StackedNetworks


class Moments(NamedTuple):
    """State of one Adam: first and second moments (S, P) and step counts, see ``FlatAdam``."""

    mean: th.Tensor
    square: th.Tensor
    step: th.Tensor

    def of(self, seeds: slice) -> Moments:
        """Return some seeds' part, as views."""
        return Moments(*(tensor[seeds] for tensor in self))


class TrainState(NamedTuple):
    """Everything an update changes; all of it is written in place."""

    actor: th.Tensor
    critic: th.Tensor
    target: th.Tensor
    ent_coef: th.Tensor  # (S, 1): its logarithm if it is learned
    actor_moments: Moments
    critic_moments: Moments
    ent_coef_moments: Moments | None  # None: the entropy coefficient is fixed

    def of(self, seeds: slice) -> TrainState:
        """Return some seeds' part, as views."""
        return TrainState(
            self.actor[seeds],
            self.critic[seeds],
            self.target[seeds],
            self.ent_coef[seeds],
            self.actor_moments.of(seeds),
            self.critic_moments.of(seeds),
            None if self.ent_coef_moments is None else self.ent_coef_moments.of(seeds),
        )


class Batch(NamedTuple):
    """One minibatch per seed, and the noise to sample actions with."""

    obs: th.Tensor  # (S, B, ...)
    actions: th.Tensor  # (S, B, D)
    next_obs: th.Tensor  # (S, B, ...)
    dones: th.Tensor  # (S, B)
    rewards: th.Tensor  # (S, B)
    discounts: th.Tensor  # (S, B)
    noise: th.Tensor  # (2, S, B, M): for the current and for the next observations

    def of(self, seeds: slice) -> Batch:
        """Return some seeds' part, as views."""
        return Batch._make([*(column[seeds] for column in self[:-1]), self.noise[:, seeds]])

    def columns(self, seed: int) -> dict[str, np.ndarray]:
        """Return one seed's observations, actions, rewards and next observations, (B, ...)."""
        names = {"observations": "obs", "next_observations": "next_obs"}
        return {
            column: getattr(self, names.get(column, column))[seed].detach().cpu().numpy()
            for column in ("observations", "actions", "rewards", "next_observations")
        }


LOSSES = ("ent_coef", "ent_coef_loss", "critic_loss", "actor_loss")
"""What SB3 logs of an update: the rows of the tensor (4, S) that an update returns."""


class Objective(Protocol):
    """What an algorithm makes of the critics' outputs, (S, C, B, Q): Q numbers per row and critic.

    Objectives are compared by value, as their constants are compiled into the update.
    """

    @property
    def name(self) -> str:
        """The algorithm's name, for messages."""

    @property
    def critic_type(self) -> type[nn.Module]:
        """The critics that it understands."""

    def next_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return what target critics say about the next observations, (S, B, T)."""

    def critic_loss(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Return the loss (S,) of critics whose outputs are compared with targets (S, B, T)."""

    def actor_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the values (S, B) that the actor maximizes."""


@dataclass(frozen=True)
class UpdateSettings:
    """Constants of an update: they are compiled into it."""

    objective: Objective
    tau: float
    target_entropy: float
    actor_adam: AdamSettings
    critic_adam: AdamSettings
    ent_coef_adam: AdamSettings | None  # None: the entropy coefficient is fixed


# (state, batch, learning rates, whether to move the target networks) -> losses, (4, S)
Update = Callable[[TrainState, Batch, th.Tensor, bool], th.Tensor]


def make_update(networks: StackedNetworks, settings: UpdateSettings) -> Update:
    r"""Return the function that performs one update of all seeds, in place.

    It is the ``train`` of SB3's SAC and sb3-contrib's TQC, in their order: entropy coefficient,
    critics, actor, target networks. The objective says what V', L_Q and V are.

    .. math::
        y &= r + \gamma (1 - d) (V'(Q^{target}(s', a')) - \alpha \log \pi(a' | s')) \\
        L_Q &= L_Q(Q(s, a), y) \\
        L_\pi &= \mathrm{mean} (\alpha \log \pi(\tilde a | s) - V(Q(s, \tilde a)))

    Args:
        networks: The networks of S seeds.
        settings: Constants of the update.

    Returns:
        Function of (state, batch, learning rates of actor, critics and entropy coefficient,
        whether to move the target networks), which returns the losses (4, S), see ``LOSSES``.

    References:
        Soft Actor-Critic Algorithms and Applications (Haarnoja et al., 2018); thesis Algorithm 2.
    """
    objective = settings.objective

    def update(
        state: TrainState, batch: Batch, learning_rates: th.Tensor, move_target: bool
    ) -> th.Tensor:
        actor = state.actor.detach().requires_grad_()
        actions_pi, log_prob = networks.sample(actor, batch.obs, batch.noise[0])

        # As in SB3, this update uses the coefficient before its own step.
        if settings.ent_coef_adam is None:
            ent_coef = state.ent_coef
            ent_coef_loss = th.zeros_like(ent_coef)
        else:
            ent_coef = state.ent_coef.exp()
            # The gradient of -log(alpha) * mean(log pi + target) is that mean itself, negated.
            surplus = (log_prob.detach() + settings.target_entropy).mean(-1, keepdim=True)
            ent_coef_loss = -(state.ent_coef * surplus)
            assert state.ent_coef_moments is not None
            moments = state.ent_coef_moments
            stepped = adam_step(
                state.ent_coef, -surplus, *moments, learning_rates[2], settings.ent_coef_adam
            )
            for old, new in zip((state.ent_coef, *moments), stepped, strict=True):
                old.copy_(new)

        with th.no_grad():
            next_actions, next_log_prob = networks.sample(
                state.actor, batch.next_obs, batch.noise[1]
            )
            outputs = networks.q_values(state.target, batch.next_obs, next_actions)
            entropy = ent_coef * next_log_prob
            next_values = objective.next_values(outputs) - entropy.unsqueeze(-1)
            discounts = (1 - batch.dones) * batch.discounts
            targets = batch.rewards.unsqueeze(-1) + discounts.unsqueeze(-1) * next_values

        critic = state.critic.detach().requires_grad_()
        outputs = networks.q_values(critic, batch.obs, batch.actions)
        critic_loss = objective.critic_loss(outputs, targets)
        # Seeds do not share parameters: the gradient of the sum is each seed's own.
        (gradient,) = th.autograd.grad(critic_loss.sum(), critic)
        new_critic, *critic_moments = adam_step(
            state.critic, gradient, *state.critic_moments, learning_rates[1], settings.critic_adam
        )

        outputs = networks.q_values(new_critic, batch.obs, actions_pi)
        actor_loss = (ent_coef * log_prob - objective.actor_values(outputs)).mean(-1)
        (gradient,) = th.autograd.grad(actor_loss.sum(), actor)
        new_actor, *actor_moments = adam_step(
            state.actor, gradient, *state.actor_moments, learning_rates[0], settings.actor_adam
        )

        if move_target:
            state.target.lerp_(new_critic, settings.tau)
        state.critic.copy_(new_critic)
        state.actor.copy_(new_actor)
        for olds, news in (
            (state.critic_moments, critic_moments),
            (state.actor_moments, actor_moments),
        ):
            for old, new in zip(olds, news, strict=True):
                old.copy_(new)
        losses = ent_coef.squeeze(-1), ent_coef_loss.squeeze(-1), critic_loss, actor_loss
        return th.stack([loss.detach() for loss in losses])

    return update
