"""Location and scale in front of a shape, as SB3's on-policy policies have them."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_flowpolicy.distributions.base import ActionDistribution
from sb3_flowpolicy.distributions.gaussian import DiagGaussian


class StateIndependent(nn.Module):
    """The same learned value (D,) for every context."""

    def __init__(self, value: nn.Parameter) -> None:
        super().__init__()
        self.value = value

    def forward(self, context: th.Tensor) -> th.Tensor:
        """Return the value, shape (..., D)."""
        return self.value.expand(*context.shape[:-1], -1)


class LocScale(DiagGaussian):
    r"""A density between noise and a location and scale.

    .. math:: u = \mu(h) + \sigma(h) \odot z, \qquad z \sim \mathrm{shape}(\cdot \mid h)

    Args:
        shape: Density of z.

    Example:
        >>> from sb3_flowpolicy.distributions import RealNVP
        >>> LocScale(RealNVP(action_dim=2, context_dim=3)).mode(th.zeros(5, 3)).shape
        torch.Size([5, 2])
    """

    def __init__(self, shape: ActionDistribution) -> None:
        super().__init__(shape.action_dim, shape.context_dim)
        self.shape = shape
        self.noise_dim = shape.noise_dim

    def shrink_heads(self) -> None:
        """Shrink those of location, scale and shape."""
        super().shrink_heads()
        self.shape.shrink_heads()

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        loc, log_std = self.loc_and_log_std(context)
        sample, log_prob = self.shape.rsample_and_log_prob(context, noise)
        return loc + log_std.exp() * sample, log_prob - log_std.sum(-1)

    def _rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        loc, log_std = self.loc_and_log_std(context)
        return loc + log_std.exp() * self.shape.rsample(context, noise)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        loc, log_std = self.loc_and_log_std(context)
        standardized = (value - loc) * (-log_std).exp()
        return self.shape.log_prob(context, standardized) - log_std.sum(-1)

    def _mode(self, context: th.Tensor) -> th.Tensor:
        loc, log_std = self.loc_and_log_std(context)
        return loc + log_std.exp() * self.shape.mode(context)

    def _entropy(self, context: th.Tensor) -> th.Tensor | None:
        entropy = self.shape.entropy(context)
        return None if entropy is None else entropy + self.log_std(context).sum(-1)


def with_heads(density: ActionDistribution, mu: nn.Module, log_std: nn.Module) -> DiagGaussian:
    """Give a density these heads for location and log standard deviation: (..., H) -> (..., D).

    Densities of the Gaussian family have such heads, which are replaced; any other becomes the
    shape of a :class:`LocScale`. All other layers that read the context start small.
    """
    result = density if isinstance(density, DiagGaussian) else LocScale(density)
    result.shrink_heads()
    result.mu, result.log_std = mu, log_std
    return result
