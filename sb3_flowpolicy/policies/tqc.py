"""Policy classes for TQC: sb3-contrib's, with a registered density."""

from __future__ import annotations

from sb3_contrib.tqc.policies import TQCPolicy

from sb3_flowpolicy.policies.base import with_forms
from sb3_flowpolicy.policies.off_policy import DistributionPolicy


class GaussTQCPolicy(DistributionPolicy, TQCPolicy):
    """Diagonal normal distribution, the policy of stock TQC."""

    default_distribution = "gaussian"


class LowRankTQCPolicy(DistributionPolicy, TQCPolicy):
    """Normal distribution with low-rank covariance, for correlated actions."""

    default_distribution = "low_rank"


class FlowTQCPolicy(DistributionPolicy, TQCPolicy):
    """Conditional RealNVP, for correlated actions and curved densities.

    Example:
        >>> from sb3_contrib import TQC
        >>> model = TQC(FlowTQCPolicy, "Pendulum-v1", learning_starts=10).learn(20)
    """

    default_distribution = "realnvp"


ALIASES = with_forms(
    FlowPolicy=FlowTQCPolicy, LowRankPolicy=LowRankTQCPolicy, GaussPolicy=GaussTQCPolicy
)
