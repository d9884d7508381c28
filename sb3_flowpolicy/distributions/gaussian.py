"""Diagonal normal distribution, as in stock SAC."""

from __future__ import annotations

from typing import ClassVar

import torch as th
from torch import nn

from sb3_flowpolicy.distributions.base import (
    STANDARD_NORMAL_ENTROPY,
    ActionDistribution,
    score_standard_normal,
    standard_normal_log_prob,
)

# SB3's bounds, so that a stock SAC actor and ours are the same function.
LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0


class LogStdHead(nn.Linear):
    """Linear layer for the log standard deviation, clamped as SB3's SAC does."""

    def forward(self, context: th.Tensor) -> th.Tensor:
        """Return the log standard deviation, shape (..., D)."""
        return super().forward(context).clamp(LOG_STD_MIN, LOG_STD_MAX)


class DiagGaussian(ActionDistribution):
    r"""Normal distribution with diagonal covariance.

    .. math:: u = \mu(h) + \sigma(h) \odot \epsilon, \qquad \epsilon \sim \mathcal N(0, I_D)

    The heads have the names and the bounds of SB3's SAC actor, so that its checkpoints fit.

    References:
        Soft Actor-Critic Algorithms and Applications (Haarnoja et al., 2018); thesis eq. 2.12.

    Example:
        >>> density = DiagGaussian(action_dim=2, context_dim=3)
        >>> u, log_prob = density.rsample_and_log_prob(th.zeros(5, 3), th.randn(5, 2))
        >>> u.shape, log_prob.shape
        (torch.Size([5, 2]), torch.Size([5]))
    """

    log_std_head: ClassVar[type[nn.Module]] = LogStdHead

    def __init__(self, action_dim: int, context_dim: int) -> None:
        super().__init__(action_dim, context_dim)
        self.mu: nn.Module = nn.Linear(context_dim, action_dim)
        self.log_std: nn.Module = self.log_std_head(context_dim, action_dim)

    def loc_and_log_std(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the mean and the log standard deviation, both of shape (..., D)."""
        return self.mu(context), self.log_std(context)

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        loc, log_std = self.loc_and_log_std(context)
        sample = loc + log_std.exp() * noise
        return sample, standard_normal_log_prob(noise) - log_std.sum(-1)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        loc, log_std = self.loc_and_log_std(context)
        return score_standard_normal((value - loc) * (-log_std).exp()) - log_std.sum(-1)

    def _mode(self, context: th.Tensor) -> th.Tensor:
        return self.mu(context)

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        return self.log_std(context).sum(-1) + self.action_dim * STANDARD_NORMAL_ENTROPY
