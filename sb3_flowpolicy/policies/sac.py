"""Policy classes for SAC: SB3's, with a registered density."""

from __future__ import annotations

from stable_baselines3.sac.policies import SACPolicy

from sb3_flowpolicy.policies.base import with_forms
from sb3_flowpolicy.policies.off_policy import DistributionPolicy


class GaussPolicy(DistributionPolicy, SACPolicy):
    """Diagonal normal distribution (thesis: Gauss-Agent), the policy of stock SAC.

    Example:
        >>> from stable_baselines3 import SAC
        >>> model = SAC(GaussPolicy, "Pendulum-v1", learning_starts=10).learn(20)
    """

    default_distribution = "gaussian"


class LowRankPolicy(DistributionPolicy, SACPolicy):
    """Normal distribution with low-rank covariance (thesis: LR-Agent), for correlated actions."""

    default_distribution = "low_rank"


class FlowPolicy(DistributionPolicy, SACPolicy):
    """Conditional RealNVP (thesis: NF-Agent), for correlated actions and curved densities.

    Example:
        >>> from stable_baselines3 import SAC
        >>> kwargs = dict(distribution_kwargs=dict(layers=6, hidden=(16, 16)))
        >>> model = SAC(FlowPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "realnvp"


ALIASES = with_forms(FlowPolicy=FlowPolicy, LowRankPolicy=LowRankPolicy, GaussPolicy=GaussPolicy)
_KINDS = ("Flow", "LowRank", "Gauss")
CnnFlowPolicy, CnnLowRankPolicy, CnnGaussPolicy = (ALIASES[f"Cnn{kind}Policy"] for kind in _KINDS)
MultiInputFlowPolicy, MultiInputLowRankPolicy, MultiInputGaussPolicy = (
    ALIASES[f"MultiInput{kind}Policy"] for kind in _KINDS
)
