"""Policy classes for SAC: the same arguments as SB3's, and a few more."""

from __future__ import annotations

from stable_baselines3.sac.policies import SACPolicy

from sb3_flowpolicy.policies.extractors import for_dicts, for_images
from sb3_flowpolicy.policies.off_policy import DistributionPolicy


class GaussPolicy(DistributionPolicy, SACPolicy):
    """Diagonal normal distribution (thesis: Gauss-Agent): stock SAC, on our code.

    Example:
        >>> from stable_baselines3 import SAC
        >>> model = SAC(GaussPolicy, "Pendulum-v1", learning_starts=10).learn(20)
    """

    default_distribution = "gaussian"


class LowRankPolicy(DistributionPolicy, SACPolicy):
    """Normal distribution with low-rank covariance (thesis: LR-Agent); actions correlate.

    Example:
        >>> from stable_baselines3 import SAC
        >>> kwargs = dict(distribution_kwargs=dict(rank=1))
        >>> model = SAC(LowRankPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "low_rank"


class FlowPolicy(DistributionPolicy, SACPolicy):
    """Conditional RealNVP (thesis: NF-Agent); the distribution correlates and bends.

    Example:
        >>> from stable_baselines3 import SAC
        >>> kwargs = dict(distribution_kwargs=dict(layers=6, hidden=(16, 16)))
        >>> model = SAC(FlowPolicy, "Pendulum-v1", policy_kwargs=kwargs)
        >>> obs = model.get_env().reset()
        >>> model.predict(obs)[0].shape
        (1, 1)
    """

    default_distribution = "realnvp"


_POLICIES = (GaussPolicy, LowRankPolicy, FlowPolicy)
CnnGaussPolicy, CnnLowRankPolicy, CnnFlowPolicy = for_images(*_POLICIES)
MultiInputGaussPolicy, MultiInputLowRankPolicy, MultiInputFlowPolicy = for_dicts(*_POLICIES)
