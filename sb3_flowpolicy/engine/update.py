"""One update of an actor and critics, written once: eager, compiled, for one seed or S of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from torch import nn
from torch.utils._pytree import tree_map_only

from sb3_flowpolicy.engine.adam import AdamSettings, Moments, adam_step
from sb3_flowpolicy.engine.networks import StackedNetworks


class TrainState(NamedTuple):
    """Everything an update changes; all of it is written in place."""

    actor: th.Tensor
    critic: th.Tensor
    others: tuple[th.Tensor, ...]  # the target networks; for CrossQ running statistics
    ent_coef: th.Tensor  # (S, 1): its logarithm if it is learned
    actor_moments: Moments
    critic_moments: Moments
    ent_coef_moments: Moments | None  # None: the entropy coefficient is fixed

    def of(self, seeds: slice) -> TrainState:
        """Return some seeds' part, as views."""
        return tree_map_only(th.Tensor, lambda tensor: tensor[seeds], self)


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
        columns = {
            "observations": self.obs,
            "actions": self.actions,
            "rewards": self.rewards,
            "next_observations": self.next_obs,
        }
        return {name: column[seed].cpu().numpy() for name, column in columns.items()}


LOSSES = ("ent_coef", "ent_coef_loss", "critic_loss", "actor_loss")
"""What SB3 logs of an update: the rows of the tensor (4, S) that an update returns."""


@dataclass(frozen=True)
class UpdateSettings:
    """Constants of an update: they are compiled into it."""

    objective: Objective
    layer_constants: tuple[object, ...]
    autocast: bool
    tau: float
    target_entropy: float
    actor_adam: AdamSettings
    critic_adam: AdamSettings
    ent_coef_adam: AdamSettings | None  # None: the entropy coefficient is fixed


# (state, batch, learning rates of actor, critics and entropy coefficient, flag of
# Objective.is_due) -> losses, (4, S)
Update = Callable[[TrainState, Batch, th.Tensor, bool], th.Tensor]


def entropy_coefficient(state: TrainState, settings: UpdateSettings) -> th.Tensor:
    """Return the entropy coefficient, (S, 1)."""
    return state.ent_coef if settings.ent_coef_adam is None else state.ent_coef.exp()


def step_entropy_coefficient(
    state: TrainState, log_prob: th.Tensor, learning_rate: th.Tensor, settings: UpdateSettings
) -> th.Tensor:
    """Update the entropy coefficient in place, if it is learned, and return its loss, (S, 1)."""
    moments = state.ent_coef_moments
    if settings.ent_coef_adam is None or moments is None:
        return th.zeros_like(state.ent_coef)
    # The gradient of -log(alpha) * mean(log pi + target) is that mean itself, negated.
    missing = (log_prob.detach() + settings.target_entropy).mean(-1, keepdim=True)
    loss = -(state.ent_coef * missing)
    step(state.ent_coef, -missing, moments, learning_rate, settings.ent_coef_adam)
    return loss


def bellman_targets(batch: Batch, next_values: th.Tensor, penalty: th.Tensor) -> th.Tensor:
    """Return r + gamma (1 - d) (V' - penalty), (S, B, T), for V' (S, B, T) and penalties (S, B)."""
    discounts = (1 - batch.dones) * batch.discounts
    next_values = next_values - penalty.unsqueeze(-1)
    return batch.rewards.unsqueeze(-1) + discounts.unsqueeze(-1) * next_values


def step(
    parameters: th.Tensor,
    gradient: th.Tensor,
    moments: Moments,
    learning_rate: th.Tensor,
    settings: AdamSettings,
) -> None:
    """Take a step of Adam in place."""
    stepped = adam_step(parameters, gradient, moments, learning_rate, settings)
    for old, new in zip((parameters, *moments), stepped, strict=True):
        old.copy_(new)


def gradient_of(loss: th.Tensor, leaf: th.Tensor) -> th.Tensor:
    """Differentiate losses (S,). As seeds share no parameters, that of the sum is each one's."""
    return th.autograd.grad(loss.sum(), leaf)[0]


def stack_losses(*losses: th.Tensor) -> th.Tensor:
    """Return the losses (S,) or (S, 1), in the order of ``LOSSES``, as (4, S)."""
    return th.stack([loss.detach().flatten() for loss in losses])


class Objective(ABC):
    """How an algorithm uses the critics' outputs, (S, C, B, Q): Q numbers per row and critic.

    Objectives are compared by value, as their constants are compiled into the update.
    """

    name: ClassVar[str]
    """The algorithm's name, for messages."""
    critic_type: ClassVar[type[nn.Module]]
    """Class of the critics."""
    gsde_actor_type: ClassVar[type[nn.Module] | None] = None
    """Class of the stock actors with gSDE (``use_sde=True``), None if they are not supported."""
    layer_types: ClassVar[tuple[type[nn.Module], ...]] = (nn.Linear,)
    """Types of the critics' layers that have parameters."""
    networks_type: ClassVar[type[StackedNetworks]] = StackedNetworks
    """Class of the functions that evaluate actor and critics."""

    @abstractmethod
    def next_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the target critics' values of the next observations, (S, B, T)."""

    @abstractmethod
    def critic_loss(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Return the loss (S,) of critics whose outputs are compared with targets (S, B, T)."""

    @abstractmethod
    def actor_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the values (S, B) that the actor maximizes."""

    def why_unsupported(self, policy: Any) -> str | None:
        """Return which part of a policy the algorithm, unlike others, does not support, or None."""
        return None

    def layer_constants(self, policy: Any) -> tuple[object, ...]:
        """Return constants of a policy's layers, which are compiled into the update, too."""
        return ()

    def is_due(self, model: Any, index: int, start: int) -> bool:
        """Return the flag of an update, here: whether to move the target networks.

        ``start`` updates of the same call of ``train()`` came before the present ones, and
        ``index`` of these come before this one.
        """
        return (start + index) % model.target_update_interval == 0

    def mean_losses(
        self, history: Sequence[th.Tensor], n_due: int
    ) -> tuple[th.Tensor, tuple[str, ...]]:
        """Return means (4, S) of the losses of several updates, and the names of those to log."""
        return history[0] if len(history) == 1 else th.stack(list(history)).mean(0), LOSSES

    def make_update(self, networks: Any, settings: UpdateSettings) -> Update:
        r"""Return the function that performs one update of all seeds, in place.

        It is the ``train`` of SB3's SAC and sb3-contrib's TQC, in their order: entropy coefficient,
        critics, actor, target networks. The objective defines V', L_Q and V.

        .. math::
            y &= r + \gamma (1 - d) (V'(Q^{target}(s', a')) - \alpha \log \pi(a' | s')) \\
            L_Q &= L_Q(Q(s, a), y) \\
            L_\pi &= \mathrm{mean} (\alpha \log \pi(\tilde a | s) - V(Q(s, \tilde a)))

        References:
            Thesis Algorithm 2.
        """

        def update(
            state: TrainState, batch: Batch, learning_rates: th.Tensor, move_target: bool
        ) -> th.Tensor:
            (target,) = state.others
            actor = state.actor.detach().requires_grad_()
            actions_pi, log_prob = networks.sample(actor, batch.obs, batch.noise[0])

            # As in SB3, this update uses the coefficient before its own step.
            ent_coef = entropy_coefficient(state, settings)
            ent_coef_loss = step_entropy_coefficient(state, log_prob, learning_rates[2], settings)

            with th.no_grad():
                next_actions, next_log_prob = networks.sample(
                    state.actor, batch.next_obs, batch.noise[1]
                )
                outputs = networks.q_values(target, batch.next_obs, next_actions)
                targets = bellman_targets(
                    batch, self.next_values(outputs), ent_coef * next_log_prob
                )

            critic = state.critic.detach().requires_grad_()
            outputs = networks.q_values(critic, batch.obs, batch.actions)
            critic_loss = self.critic_loss(outputs, targets)
            gradient, moments = gradient_of(critic_loss, critic), state.critic_moments
            step(state.critic, gradient, moments, learning_rates[1], settings.critic_adam)

            outputs = networks.q_values(state.critic, batch.obs, actions_pi)
            actor_loss = (ent_coef * log_prob - self.actor_values(outputs)).mean(-1)
            gradient, moments = gradient_of(actor_loss, actor), state.actor_moments
            step(state.actor, gradient, moments, learning_rates[0], settings.actor_adam)

            if move_target:
                target.lerp_(state.critic, settings.tau)
            return stack_losses(ent_coef, ent_coef_loss, critic_loss, actor_loss)

        return update
