"""Conditional RealNVP: a normalizing flow small enough to be a policy."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th

from sb3_flowpolicy.distributions.base import soft_bound
from sb3_flowpolicy.distributions.coupling import Coupling, CouplingFlow

# A layer may scale a coordinate by up to e^5: far more than a policy needs, and float32 holds the
# product over any sensible number of layers.
LOG_SCALE_BOUND = 5.0


class RealNVP(CouplingFlow):
    r"""Normalizing flow of affine couplings over a standard normal, conditioned on h.

    .. math:: u = (g_L \circ \dots \circ g_1)(\epsilon), \qquad
        \log p(u \mid h) = \log \mathcal N(\epsilon; 0, I) - \sum_{l,i} s_{l,i}

    :class:`CouplingFlow` documents the arguments and how the couplings alternate. With D = 1 the
    flow is a normal distribution whose parameters depend on h.

    References:
        Density estimation using Real NVP (Dinh et al., 2017); Structured Output Learning with
        Conditional Generative Flows (Lu and Huang, 2020); thesis eq. 2.14 and Fig. 2.6.

    Example:
        >>> flow = RealNVP(action_dim=2, context_dim=3)
        >>> noise = th.randn(5, 2)
        >>> u, log_prob = flow.rsample_and_log_prob(th.randn(5, 3), noise)
        >>> th.equal(u, noise)  # the identity before training
        True
    """

    def _make_coupling(self, passive: int, active: int) -> AffineCoupling:
        return AffineCoupling(passive, active, self.hidden)


class AffineCoupling(Coupling):
    r"""Coupling that scales and shifts.

    .. math:: b \mapsto b \odot \exp(s(a, h)) + t(a, h)

    References:
        Density estimation using Real NVP (Dinh et al., 2017), eq. 7.
    """

    def __init__(self, passive: int, active: int, hidden: Sequence[int]) -> None:
        super().__init__(passive, 2 * active, hidden)

    def move(self, active: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Scale and shift."""
        shift, log_scale = outputs.chunk(2, dim=-1)
        log_scale = soft_bound(log_scale, LOG_SCALE_BOUND)
        return active * log_scale.exp() + shift, log_scale

    def move_back(self, moved: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Undo the shift and the scaling."""
        shift, log_scale = outputs.chunk(2, dim=-1)
        log_scale = soft_bound(log_scale, LOG_SCALE_BOUND)
        return (moved - shift) * (-log_scale).exp(), log_scale
