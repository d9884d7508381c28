"""SAC: the smaller of two values, and their squared errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_flowpolicy.engine.update import Objective

# SB3 halves the squared error, spinningup (and the thesis) does not.
SB3_CRITIC_LOSS_COEF = 0.5


@dataclass(frozen=True)
class SACObjective(Objective):
    r"""The :class:`~sb3_flowpolicy.engine.update.Objective` of SAC: one value per critic.

    .. math::
        V' = V = \min_c Q_c, \qquad L_Q = k \sum_c \mathrm{mean} (Q_c - y)^2

    Args:
        critic_loss_coef: Factor k of the critics' summed mean squared error.

    References:
        Soft Actor-Critic Algorithms and Applications (Haarnoja et al., 2018).
    """

    critic_loss_coef: float = SB3_CRITIC_LOSS_COEF
    name: ClassVar[str] = "SAC"
    critic_type: ClassVar[type[nn.Module]] = ContinuousCritic
    gsde_actor_type: ClassVar[type[nn.Module] | None] = Actor

    def next_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the smallest value of the target critics, (S, B, 1)."""
        return outputs.amin(1)

    def critic_loss(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Return the critics' summed mean squared error times its factor, (S,)."""
        errors = outputs - targets.unsqueeze(1)
        return self.critic_loss_coef * errors.square().mean((-2, -1)).sum(1)

    def actor_values(self, outputs: th.Tensor) -> th.Tensor:
        """Return the smallest value, (S, B)."""
        return outputs.amin(1).squeeze(-1)
