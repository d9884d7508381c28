"""Normal distribution whose covariance is a low-rank matrix plus a diagonal."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.distributions.base import (
    FARTHEST,
    LOG_SQRT_2PI,
    STANDARD_NORMAL_ENTROPY,
    soft_bound,
)
from sb3_flowpolicy.distributions.gaussian import DiagGaussian

# tanh(3) = 0.995: with this bound a single column of V spans the whole action box.
COV_FACTOR_BOUND = 3.0


class LowRankGaussian(DiagGaussian):
    r"""Normal distribution with covariance :math:`\Sigma = V V^\top + \mathrm{diag}(\sigma^2)`.

    A sample takes M = D + K normals, :math:`u = \mu + V \epsilon_K + \sigma \odot \epsilon_D`.
    The entries of the K x K capacitance matrix grow as :math:`1 / \sigma^2`. Instead of inverting
    it, the density uses the QR decomposition Q R = [V / sigma; I]:

    .. math::
        \log\det\Sigma = 2 \sum_i \log\sigma_i + 2 \sum_k \log R_{kk}, \qquad
        (u - \mu)^\top \Sigma^{-1} (u - \mu) = \| n - Q Q^\top n \|^2

    with :math:`n = [\epsilon_D; -\epsilon_K]` for a sample and :math:`n = [(u - \mu) / \sigma; 0]`
    for a given point. As every :math:`R_{kk} \ge 1`, nothing overflows or becomes negative, for any
    K and down to :math:`\sigma = e^{-20}`.

    Args:
        rank: Rank K of the factor V, between 1 and D. Default: 2, or 1 where D = 1.

    References:
        Thesis eq. 2.13, which clips V; here V is softly bounded.

    Example:
        >>> LowRankGaussian(action_dim=8, context_dim=3, rank=2).noise_dim
        10
    """

    def __init__(self, action_dim: int, context_dim: int, rank: int | None = None) -> None:
        super().__init__(action_dim, context_dim)
        rank = min(2, action_dim) if rank is None else rank
        self.rank = integer(1, action_dim)("rank", rank)
        self.noise_dim = action_dim + self.rank
        self.cov_factor = nn.Linear(context_dim, action_dim * self.rank)

    def covariance_factors(
        self, context: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, tuple[th.Tensor, ...]]:
        """Return mean (..., D), log sigma (..., D) and the K columns of V, each (..., D)."""
        loc, log_std = self.loc_and_log_std(context)
        columns = soft_bound(self.cov_factor(context), COV_FACTOR_BOUND)
        return loc, log_std, columns.chunk(self.rank, dim=-1)

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        loc, log_std, columns = self.covariance_factors(context)
        diag_noise, factor_noise = noise.split([self.action_dim, self.rank], dim=-1)
        hidden = th.cat([diag_noise, -factor_noise], dim=-1)
        sample = self._combine(loc, log_std, columns, noise)
        return sample, self._density(log_std, columns, hidden)

    def _rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        return self._combine(*self.covariance_factors(context), noise)

    def _combine(
        self,
        loc: th.Tensor,
        log_std: th.Tensor,
        columns: tuple[th.Tensor, ...],
        noise: th.Tensor,
    ) -> th.Tensor:
        diag_noise, *factor_noise = noise.split([self.action_dim, *[1] * self.rank], dim=-1)
        sample = loc + log_std.exp() * diag_noise
        for column, each in zip(columns, factor_noise, strict=True):
            sample = sample + column * each
        return sample

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        loc, log_std, columns = self.covariance_factors(context)
        scaled = ((value - loc) * (-log_std).exp()).clamp(-FARTHEST, FARTHEST)
        hidden = th.cat([scaled, scaled.new_zeros(*scaled.shape[:-1], self.rank)], dim=-1)
        return self._density(log_std, columns, hidden)

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        _, log_std, columns = self.covariance_factors(context)
        half_log_det, _ = self._decompose(log_std, columns)
        return half_log_det + self.action_dim * STANDARD_NORMAL_ENTROPY

    def _density(
        self, log_std: th.Tensor, columns: tuple[th.Tensor, ...], hidden: th.Tensor
    ) -> th.Tensor:
        half_log_det, basis = self._decompose(log_std, columns)
        for direction in basis:
            hidden = hidden - (hidden * direction).sum(-1, keepdim=True) * direction
        mahalanobis = hidden.square().sum(-1)
        return -0.5 * mahalanobis - half_log_det - self.action_dim * LOG_SQRT_2PI

    def _decompose(
        self, log_std: th.Tensor, columns: tuple[th.Tensor, ...]
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """Return half of log det Sigma and a basis of the columns of [V / sigma; I].

        The basis comes from modified Gram-Schmidt.
        """
        inv_std = (-log_std).exp()
        identity = th.eye(self.rank, dtype=log_std.dtype, device=log_std.device)
        basis: list[th.Tensor] = []
        half_log_det = log_std.sum(-1)
        for column, unit in zip(columns, identity, strict=True):
            rest = th.cat([column * inv_std, unit.expand(*column.shape[:-1], -1)], dim=-1)
            for direction in basis:
                rest = rest - (rest * direction).sum(-1, keepdim=True) * direction
            norm = rest.norm(dim=-1, keepdim=True)
            basis.append(rest / norm)
            half_log_det = half_log_det + norm.squeeze(-1).log()
        return half_log_det, basis
