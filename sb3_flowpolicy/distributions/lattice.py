"""Normal distribution whose correlations come from the last layer of the policy (Lattice)."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_flowpolicy.common.validation import number
from sb3_flowpolicy.distributions.base import (
    FARTHEST,
    STANDARD_NORMAL_ENTROPY,
    score_standard_normal,
    soft_bound,
    standard_normal_log_prob,
)
from sb3_flowpolicy.distributions.gaussian import DiagGaussian

# A standard deviation of e^-10 = 0.00005 is practically deterministic and leaves enough digits of
# float64 for the Cholesky factor of the covariance. The upper bound is SB3's.
LOG_STD_MIN = -10.0
LOG_STD_MAX = 2.0


class SoftLogStdHead(nn.Linear):
    """Linear layer for log standard deviations in (LOG_STD_MIN, LOG_STD_MAX)."""

    def forward(self, context: th.Tensor) -> th.Tensor:
        """Return the bounded log standard deviations, shape (..., outputs)."""
        log_std = super().forward(context)
        return soft_bound(log_std, th.where(log_std > 0, LOG_STD_MAX, -LOG_STD_MIN))


class Lattice(DiagGaussian):
    r"""Normal distribution that adds noise to the features and to the actions.

    .. math:: u = W (h + \alpha \sigma_h(h) \odot \epsilon_h) + b + \sigma_a(h) \odot \epsilon_a
        \;\sim\; \mathcal N \left( W h + b, \;
        \alpha^2 W \mathrm{diag}(\sigma_h^2) W^\top + \mathrm{diag}(\sigma_a^2) \right)

    W is the weight of the layer that computes the mean, so actions that the policy moves together
    are explored together. A sample takes D normals: :math:`u = W h + b + L \epsilon` with the
    Cholesky factor L of the covariance, computed in float64. In exact arithmetic every pivot is at
    least :math:`\sigma_a^2`. The computed ones are clamped there, so that the factorization cannot
    fail.

    As in the paper's SAC, the covariance passes gradients to W. The differences from the paper are:

    - Standard deviations come from linear heads, as in the authors' variant without correlation in
      time. Their main variant is gSDE's, :math:`\sigma_i^2 = \sum_j S_{ji}^2 h_j^2` with learned S.
    - The authors keep noise matrices of the features for a number of steps. Here D normals are
      drawn at every step; ``action_noise_color`` correlates them in time.
    - Log standard deviations are bounded softly, :math:`\sigma \in (e^{-10}, e^2)`, not clipped.
      Nothing is added to the variance (the authors' ``std_reg``), and the mean is not clipped.
    - Gradients of the standard deviations reach the features with on-policy algorithms, too.

    Args:
        alpha: Scale of the noise of the features, at least 0; 0 gives a diagonal covariance.

    References:
        Latent Exploration for Reinforcement Learning (Chiappa et al., 2023).

    Example:
        >>> Lattice(action_dim=2, context_dim=16).mode(th.zeros(5, 16)).shape
        torch.Size([5, 2])
    """

    log_std_head = SoftLogStdHead

    def __init__(self, action_dim: int, context_dim: int, alpha: float = 1.0) -> None:
        super().__init__(action_dim, context_dim)
        self.alpha = number(0)("alpha", alpha)
        self.latent_log_std = SoftLogStdHead(context_dim, context_dim)

    def scale_tril(self, context: th.Tensor, log_std: th.Tensor) -> th.Tensor:
        """Return the Cholesky factor of the covariance, shape (..., D, D), in float64."""
        latent_variance = (2 * self.latent_log_std(context).double()).exp()
        weight = self.alpha * self.mu.weight.double()
        # The products of the rows of W make the whole covariance a single matrix product.
        pairs = (weight.unsqueeze(0) * weight.unsqueeze(1)).flatten(0, 1)
        rest = (latent_variance @ pairs.mT).unflatten(-1, (self.action_dim, self.action_dim))
        variance = (2 * log_std.double()).exp()
        rest = rest + variance.unsqueeze(-1) * th.eye(self.action_dim).to(rest)
        columns = []
        for i in range(self.action_dim):
            pivot = th.maximum(rest[..., :1, 0], variance[..., i : i + 1]).sqrt()
            below = rest[..., 1:, 0] / pivot
            columns.append(nn.functional.pad(th.cat([pivot, below], dim=-1), (i, 0)))
            rest = rest[..., 1:, 1:] - below.unsqueeze(-1) * below.unsqueeze(-2)
        return th.stack(columns, dim=-1)

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        loc, log_std = self.loc_and_log_std(context)
        lower = self.scale_tril(context, log_std)
        sample = loc + (lower * noise.double().unsqueeze(-2)).sum(-1).to(noise)
        return sample, standard_normal_log_prob(noise) - _half_log_det(lower).to(noise)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        loc, log_std = self.loc_and_log_std(context)
        lower = self.scale_tril(context, log_std)
        distance = (value - loc).double().clamp(-FARTHEST, FARTHEST)
        noise = th.linalg.solve_triangular(lower, distance.unsqueeze(-1), upper=False).squeeze(-1)
        return (score_standard_normal(noise) - _half_log_det(lower)).to(value)

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        half_log_det = _half_log_det(self.scale_tril(context, self.log_std(context)))
        return half_log_det.to(context) + self.action_dim * STANDARD_NORMAL_ENTROPY


def _half_log_det(lower: th.Tensor) -> th.Tensor:
    return lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
