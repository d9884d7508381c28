"""Names of densities, for ``policy_kwargs`` and YAML files."""

from __future__ import annotations

from typing import Any

from sb3_flowpolicy.common.validation import one_of
from sb3_flowpolicy.distributions.base import ActionDistribution
from sb3_flowpolicy.distributions.full_covariance import FullCovarianceGaussian
from sb3_flowpolicy.distributions.gaussian import DiagGaussian
from sb3_flowpolicy.distributions.lattice import Lattice
from sb3_flowpolicy.distributions.low_rank import LowRankGaussian
from sb3_flowpolicy.distributions.realnvp import RealNVP
from sb3_flowpolicy.distributions.spline import Spline

_REGISTRY: dict[str, type[ActionDistribution]] = {
    "gaussian": DiagGaussian,
    "low_rank": LowRankGaussian,
    "full_covariance": FullCovarianceGaussian,
    "lattice": Lattice,
    "realnvp": RealNVP,
    "spline": Spline,
}


def register_distribution(name: str, distribution_class: type[ActionDistribution]) -> None:
    """Make a density available as ``policy_kwargs=dict(distribution=name)``.

    A saved model refers to the density by name, so register it before loading the model, too.

    Args:
        name: Name to register.
        distribution_class: Subclass of :class:`ActionDistribution` whose constructor takes
            ``action_dim``, ``context_dim`` and keyword arguments of its own.

    Raises:
        TypeError: If the class is not a density.
        ValueError: If the name is taken by another class.

    Example:
        >>> from sb3_flowpolicy.distributions import DiagGaussian
        >>> class Sharp(DiagGaussian):
        ...     "A normal distribution, half as wide."
        ...     def loc_and_log_std(self, context):
        ...         loc, log_std = super().loc_and_log_std(context)
        ...         return loc, log_std - 0.7
        >>> register_distribution("sharp", Sharp)
        >>> make_distribution("sharp", action_dim=2, context_dim=8).action_dim
        2
    """
    if not isinstance(name, str) or not issubclass(distribution_class, ActionDistribution):
        raise TypeError(
            "a density must be registered as a name and a subclass of ActionDistribution, got "
            f"{name!r} and {distribution_class!r}"
        )
    if _REGISTRY.get(name, distribution_class) is not distribution_class:
        raise ValueError(f'name "{name}" is taken by {_REGISTRY[name].__name__}')
    _REGISTRY[name] = distribution_class


def registered_distributions() -> dict[str, type[ActionDistribution]]:
    """Return a copy of the registry: name -> class."""
    return dict(_REGISTRY)


def make_distribution(
    name: str, action_dim: int, context_dim: int, **distribution_kwargs: Any
) -> ActionDistribution:
    """Build the density of unsquashed actions that is registered as ``name``.

    Raises:
        ValueError: If the name is unknown, or an argument is out of range.
        TypeError: If the density's constructor takes no such keyword argument.
    """
    one_of(*_REGISTRY)("distribution", name)
    try:
        return _REGISTRY[name](action_dim, context_dim, **distribution_kwargs)
    except TypeError as error:
        raise TypeError(f'distribution "{name}": {error}') from error
