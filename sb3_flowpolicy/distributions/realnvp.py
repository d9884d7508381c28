"""Conditional RealNVP: a normalizing flow small enough to be a policy."""

from __future__ import annotations

from sb3_flowpolicy.distributions.coupling import AffineCoupling
from sb3_flowpolicy.distributions.coupling_flow import CouplingFlow


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
        >>> import torch as th
        >>> _ = th.manual_seed(0)
        >>> flow = RealNVP(action_dim=2, context_dim=3)
        >>> noise = th.randn(5, 2)
        >>> u, log_prob = flow.rsample_and_log_prob(th.randn(5, 3), noise)
        >>> th.equal(u, noise)  # the identity before training
        True
    """

    def _make_coupling(self, passive: int, active: int) -> AffineCoupling:
        return AffineCoupling(passive, active, self.hidden)
