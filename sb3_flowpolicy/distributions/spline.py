"""Conditional neural spline flow: couplings that bend each coordinate at several places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch as th
from torch.nn.functional import pad, softmax

from sb3_flowpolicy.distributions.base import soft_bound
from sb3_flowpolicy.distributions.coupling import Coupling
from sb3_flowpolicy.distributions.coupling_flow import CouplingFlow

# Beyond it a spline is the identity: tanh(5) = 0.9999 leaves next to nothing of the action box.
BOUND = 5.0
# Slopes at the knots, and ratios of two bins' widths or heights, are between this and its inverse.
MIN_SLOPE = 1e-3


class Spline(CouplingFlow):
    r"""Normalizing flow of monotonic rational-quadratic splines, conditioned on h.

    Within (-5, 5) each coordinate is bent by a spline of K bins, whose widths, heights and slopes
    at the knots are the outputs of the coupling's network; outside it is left alone. How
    couplings alternate says :class:`CouplingFlow`. Where a RealNVP of one dimension is a normal
    distribution, this one can have several modes.

    Args:
        action_dim: Number of action dimensions D, at least 1.
        context_dim: Number of context features H, at least 1.
        layers: Number of couplings L, at least 1.
        hidden: Units of the hidden layers of each coupling's network.
        init: ``"identity"`` starts as a standard normal for every h. ``"default"`` leaves
            torch's initialisation.
        bins: Number of bins K, at least 2.

    Raises:
        ValueError: If ``layers``, ``hidden`` or ``bins`` holds anything but such integers, or
            ``init`` is unknown.

    References:
        Neural Spline Flows (Durkan et al., 2019); between its couplings this flow has no linear
        layers.

    Example:
        >>> import torch as th
        >>> _ = th.manual_seed(0)
        >>> flow = Spline(action_dim=2, context_dim=3)
        >>> noise = th.randn(5, 2)
        >>> u, log_prob = flow.rsample_and_log_prob(th.randn(5, 3), noise)
        >>> th.allclose(u, noise, atol=1e-5)  # the identity, until it is trained
        True
    """

    def __init__(
        self,
        action_dim: int,
        context_dim: int,
        layers: int = 4,
        hidden: Sequence[int] = (10, 10),
        init: Literal["identity", "default"] = "identity",
        bins: int = 8,
    ) -> None:
        if isinstance(bins, bool) or not isinstance(bins, int) or bins < 2:
            raise ValueError(f"bins must be an integer >= 2, got {bins!r}")
        self.bins = bins
        super().__init__(action_dim, context_dim, layers, hidden, init)

    def _make_coupling(self, passive: int, active: int) -> SplineCoupling:
        return SplineCoupling(passive, active, self.hidden, self.bins)


class SplineCoupling(Coupling):
    r"""Coupling that bends with a monotonic rational-quadratic spline.

    Within bin k, from knot :math:`(x_k, y_k)` to the next, with width w, height h, mean slope
    s = h / w, slopes :math:`d_k` at the knots and :math:`z = (x - x_k) / w`:

    .. math:: y = y_k + h \frac{s z^2 + d_k z (1 - z)}{s + (d_k + d_{k+1} - 2 s) z (1 - z)}

    Args:
        passive: Number of coordinates that are read, 0 or more.
        active: Number of coordinates that are moved, at least 1.
        hidden: Units of the hidden layers.
        bins: Number of bins K, at least 2.

    References:
        Neural Spline Flows (Durkan et al., 2019), eqs. 4 to 8.
    """

    def __init__(self, passive: int, active: int, hidden: Sequence[int], bins: int) -> None:
        super().__init__(passive, active * (3 * bins - 1), hidden)
        self.bins = bins

    def move(self, active: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Evaluate the spline at ``active``."""
        inside = active.clamp(-BOUND, BOUND)
        x, y, width, height, left, right = self._bin_of(inside, outputs, by_height=False)
        # In float32 a knot is up to a thousandth of the narrowest bin off.
        z = ((inside - x) / width).clamp(0.0, 1.0)
        moved = y + height * _share(z, height / width, left, right)
        ladj = _log_slope(z, height / width, left, right)
        within = active.abs() < BOUND
        return th.where(within, moved, active), th.where(within, ladj, 0.0)

    def move_back(self, moved: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Solve the bin's quadratic equation for z."""
        inside = moved.clamp(-BOUND, BOUND)
        x, y, width, height, left, right = self._bin_of(inside, outputs, by_height=True)
        slope = height / width
        share = (inside - y) / height
        bend = (left + right - 2 * slope) * share
        a, b, c = slope - left + bend, left - bend, -slope * share
        # Of the two forms of the solution this is the one that does not cancel; what is under the
        # root is positive, but for rounding.
        root = (b.square() - 4 * a * c).clamp_min(1e-12).sqrt()
        z = (-2 * c / (b + root)).clamp(0.0, 1.0)
        ladj = _log_slope(z, slope, left, right)
        within = moved.abs() < BOUND
        return th.where(within, x + width * z, moved), th.where(within, ladj, 0.0)

    def _bin_of(
        self, value: th.Tensor, outputs: th.Tensor, by_height: bool
    ) -> tuple[th.Tensor, ...]:
        """Return left end, lower end, width, height and the two slopes of each value's bin."""
        # Knots take more digits than bfloat16 has.
        outputs = outputs.to(value).unflatten(-1, (-1, 3 * self.bins - 1))
        widths, heights, slopes = outputs.split([self.bins, self.bins, self.bins - 1], dim=-1)
        sizes = [
            2 * BOUND * softmax(soft_bound(raw, -0.5 * math.log(MIN_SLOPE)), dim=-1)
            for raw in (widths, heights)
        ]
        ends = [size.cumsum(-1) - BOUND for size in sizes]
        starts = [end - size for end, size in zip(ends, sizes, strict=True)]
        # At both ends the slope is 1, the identity's.
        slopes = pad(soft_bound(slopes, -math.log(MIN_SLOPE)), (1, 1)).exp()
        # A sum over all bins, of which one counts, takes less than looking that one up.
        above = value.unsqueeze(-1) >= ends[by_height][..., :-1]
        reached = pad(above, (1, 0), value=True)
        counts = (reached & ~pad(above, (0, 1), value=False)).to(value)
        parts = (*starts, *sizes, slopes[..., :-1], slopes[..., 1:])
        return tuple((part * counts).sum(-1) for part in parts)


def _share(z: th.Tensor, slope: th.Tensor, left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """Return how much of the bin's height is reached at z."""
    between = z * (1 - z)
    return (slope * z.square() + left * between) / (slope + (left + right - 2 * slope) * between)


def _log_slope(z: th.Tensor, slope: th.Tensor, left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """Return the logarithm of the spline's slope at z."""
    between = z * (1 - z)
    rise = right * z.square() + 2 * slope * between + left * (1 - z).square()
    below = slope + (left + right - 2 * slope) * between
    return 2 * (slope.log() - below.log()) + rise.log()
