"""Normal distribution with a full covariance matrix, in a numerically stable parametrization."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_flowpolicy.distributions.base import (
    FARTHEST,
    STANDARD_NORMAL_ENTROPY,
    score_standard_normal,
    soft_bound,
    standard_normal_log_prob,
)
from sb3_flowpolicy.distributions.gaussian import DiagGaussian

# Two coordinates can correlate up to 10 / sqrt(1 + 10^2) = 0.995.
OFF_DIAGONAL_BOUND = 10.0


class FullCovarianceGaussian(DiagGaussian):
    r"""Normal distribution with covariance :math:`\Sigma = L L^\top`.

    The thesis tried a clipped Cholesky factor and gave it up because it was numerically unstable:
    :math:`L^{-1}` explodes if an off-diagonal entry is much larger than the diagonal. Here scale
    and correlation are separate. T is unit lower triangular with softly bounded entries, its rows
    are normalized, and the standard deviations multiply the rows:

    .. math:: L_{ij} = \sigma_i T_{ij} / \| T_{i \cdot} \|, \qquad T_{ii} = 1

    So :math:`\sigma` is the marginal standard deviation as in :class:`DiagGaussian`, T alone
    determines the correlations, and no inverse depends on a ratio of scales.

    References:
        Thesis section 2.2.2, "Covariance Matrix".

    Example:
        >>> FullCovarianceGaussian(action_dim=3, context_dim=4).mode(th.zeros(5, 4)).shape
        torch.Size([5, 3])
    """

    _entry_index: th.Tensor

    def __init__(self, action_dim: int, context_dim: int) -> None:
        super().__init__(action_dim, context_dim)
        n_entries = action_dim * (action_dim - 1) // 2
        # One dimension has no correlations.
        self.off_diagonal = nn.Linear(context_dim, n_entries) if n_entries else None
        # Entry (i, j) of T is a lookup in [head output, 0, 1].
        index = th.full((action_dim, action_dim), n_entries)
        rows, cols = th.tril_indices(action_dim, action_dim, offset=-1)
        index[rows, cols] = th.arange(n_entries)
        index.fill_diagonal_(n_entries + 1)
        self.register_buffer("_entry_index", index.flatten(), persistent=False)

    def factors(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return the mean (..., D), T (..., D, D) and the log of the diagonal of L (..., D)."""
        loc, log_std = self.loc_and_log_std(context)
        entries = zero_one = context.new_tensor([0.0, 1.0]).expand(*context.shape[:-1], 2)
        if self.off_diagonal is not None:
            bounded = soft_bound(self.off_diagonal(context), OFF_DIAGONAL_BOUND)
            entries = th.cat([bounded, zero_one], dim=-1)
        lower = entries.index_select(-1, self._entry_index)
        lower = lower.unflatten(-1, (self.action_dim, self.action_dim))
        return loc, lower, log_std - 0.5 * lower.square().sum(-1).log()

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        loc, lower, log_diag = self.factors(context)
        sample = loc + log_diag.exp() * (lower * noise.unsqueeze(-2)).sum(-1)
        return sample, standard_normal_log_prob(noise) - log_diag.sum(-1)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        loc, lower, log_diag = self.factors(context)
        scaled = ((value - loc) * (-log_diag).exp()).clamp(-FARTHEST, FARTHEST)
        # Values may grow by a factor of 11 per dimension: float64 suffices for 250 dimensions.
        noise = th.linalg.solve_triangular(
            lower.double(), scaled.double().unsqueeze(-1), upper=False, unitriangular=True
        ).squeeze(-1)
        return score_standard_normal(noise).to(scaled) - log_diag.sum(-1)

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        _, _, log_diag = self.factors(context)
        return log_diag.sum(-1) + self.action_dim * STANDARD_NORMAL_ENTROPY
