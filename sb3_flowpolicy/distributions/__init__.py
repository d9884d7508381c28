"""Action densities as pure functions of parameters, context and noise, without SB3."""

from sb3_flowpolicy.distributions.base import ActionDistribution
from sb3_flowpolicy.distributions.full_covariance import FullCovarianceGaussian
from sb3_flowpolicy.distributions.gaussian import DiagGaussian
from sb3_flowpolicy.distributions.lattice import Lattice
from sb3_flowpolicy.distributions.low_rank import LowRankGaussian
from sb3_flowpolicy.distributions.realnvp import RealNVP
from sb3_flowpolicy.distributions.registry import (
    make_distribution,
    register_distribution,
    registered_distributions,
)
from sb3_flowpolicy.distributions.spline import Spline
from sb3_flowpolicy.distributions.squashed import TanhSquashed

__all__ = [
    "ActionDistribution",
    "DiagGaussian",
    "FullCovarianceGaussian",
    "Lattice",
    "LowRankGaussian",
    "RealNVP",
    "Spline",
    "TanhSquashed",
    "make_distribution",
    "register_distribution",
    "registered_distributions",
]
