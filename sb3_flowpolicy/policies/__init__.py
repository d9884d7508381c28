"""Actors and SB3 policy classes that use the densities of ``sb3_flowpolicy.distributions``."""

from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.off_policy import DistributionPolicy
from sb3_flowpolicy.policies.sac import (
    CnnFlowPolicy,
    CnnGaussPolicy,
    CnnLowRankPolicy,
    FlowPolicy,
    GaussPolicy,
    LowRankPolicy,
    MultiInputFlowPolicy,
    MultiInputGaussPolicy,
    MultiInputLowRankPolicy,
)

__all__ = [
    "CnnFlowPolicy",
    "CnnGaussPolicy",
    "CnnLowRankPolicy",
    "DistributionPolicy",
    "FlowActor",
    "FlowPolicy",
    "GaussPolicy",
    "LowRankPolicy",
    "MultiInputFlowPolicy",
    "MultiInputGaussPolicy",
    "MultiInputLowRankPolicy",
]
