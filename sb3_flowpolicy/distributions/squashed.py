"""Squash any density into the open box (-1, 1)^D."""

from __future__ import annotations

import math

import torch as th
from torch.nn.functional import softplus

from sb3_flowpolicy.distributions.base import ActionDistribution


class TanhSquashed(ActionDistribution):
    r"""Density of :math:`a = \tanh(u)` where u follows ``base``.

    .. math:: \log p(a \mid h) = \log p(u \mid h)
        - \sum_i 2 (\log 2 - u_i - \mathrm{softplus}(-2 u_i))

    This form of the log-Jacobian needs no epsilon and stays exact where rounding turns
    :math:`\log(1 - a^2)` into :math:`-\infty`.

    Args:
        base: Density of the unsquashed action u.

    References:
        Soft Actor-Critic (Haarnoja et al., 2018), appendix C.

    Example:
        >>> from sb3_flowpolicy.distributions import RealNVP
        >>> density = TanhSquashed(RealNVP(action_dim=2, context_dim=3))
        >>> density.log_prob(th.zeros(1, 3), th.ones(1, 2)).isfinite()  # at the corner of the box
        tensor([True])
    """

    def __init__(self, base: ActionDistribution) -> None:
        super().__init__(base.action_dim, base.context_dim)
        self.base = base
        self.noise_dim = base.noise_dim

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        unsquashed, log_prob = self.base.rsample_and_log_prob(context, noise)
        return th.tanh(unsquashed), log_prob - tanh_ladj(unsquashed)

    def _rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        return th.tanh(self.base.rsample(context, noise))

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        # The edge has no preimage. Score the largest number below it instead.
        edge = 1 - th.finfo(value.dtype).eps
        unsquashed = th.atanh(value.clamp(-edge, edge))
        return self.base.log_prob(context, unsquashed) - tanh_ladj(unsquashed)

    def _mode(self, context: th.Tensor) -> th.Tensor:
        return th.tanh(self.base.mode(context))


def tanh_ladj(unsquashed: th.Tensor) -> th.Tensor:
    """Log-determinant of the Jacobian of tanh, summed over the last dimension."""
    return 2 * (math.log(2) - unsquashed - softplus(-2 * unsquashed)).sum(-1)
