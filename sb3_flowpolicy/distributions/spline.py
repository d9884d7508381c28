"""Conditional neural spline flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch as th
from torch.nn.functional import pad, softmax

from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.distributions.base import soft_bound
from sb3_flowpolicy.distributions.coupling import Coupling, CouplingFlow

# A spline is the identity outside (-5, 5); tanh(5) = 0.9999 is almost the edge of the action box.
BOUND = 5.0
# Slopes at the knots, and ratios of two bins' widths or heights, lie between this and its inverse.
MIN_SLOPE = 1e-3


class Spline(CouplingFlow):
    r"""Normalizing flow of monotonic rational-quadratic splines, conditioned on h.

    A spline of K bins maps each coordinate within (-5, 5); outside it is the identity. A network
    computes the widths and heights of the bins and the slopes at the knots.
    With D = 1 a RealNVP is a normal distribution, whereas this flow can have several modes.
    :class:`CouplingFlow` documents the other arguments and how the couplings alternate.

    Args:
        bins: Number of bins K, at least 2.

    References:
        Neural Spline Flows (Durkan et al., 2019); here without linear layers between couplings.

    Example:
        >>> flow, noise = Spline(action_dim=2, context_dim=3), th.randn(5, 2)
        >>> th.allclose(flow.rsample(th.randn(5, 3), noise), noise, atol=1e-5)  # the identity
        True
    """

    def __init__(self, action_dim: int, context_dim: int, *args: Any, bins: int = 8, **kwargs: Any):
        self.bins = integer(2)("bins", bins)
        super().__init__(action_dim, context_dim, *args, **kwargs)

    def _make_coupling(self, passive: int, active: int) -> SplineCoupling:
        return SplineCoupling(passive, active, self.hidden, self.bins)


class SplineCoupling(Coupling):
    r"""Coupling with a monotonic rational-quadratic spline.

    Within bin k, from knot :math:`(x_k, y_k)` to the next, with width w, height h, mean slope
    s = h / w, slopes :math:`d_k` at the knots and :math:`z = (x - x_k) / w`:

    .. math:: y = y_k + h \frac{s z^2 + d_k z (1 - z)}{s + (d_k + d_{k+1} - 2 s) z (1 - z)}

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
        # In float32 the error of a knot is up to a thousandth of the narrowest bin.
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
        # This form of the solution avoids cancellation. The radicand is positive up to rounding.
        root = (b.square() - 4 * a * c).clamp_min(1e-12).sqrt()
        z = (-2 * c / (b + root)).clamp(0.0, 1.0)
        ladj = _log_slope(z, slope, left, right)
        within = moved.abs() < BOUND
        return th.where(within, x + width * z, moved), th.where(within, ladj, 0.0)

    def _bin_of(
        self, value: th.Tensor, outputs: th.Tensor, by_height: bool
    ) -> tuple[th.Tensor, ...]:
        """Return left end, lower end, width, height and both slopes of the bin of each value."""
        # bfloat16 has too few digits for the knots.
        outputs = outputs.to(value).unflatten(-1, (-1, 3 * self.bins - 1))
        widths, heights, slopes = outputs.split([self.bins, self.bins, self.bins - 1], dim=-1)
        sizes = [
            2 * BOUND * softmax(soft_bound(raw, -0.5 * math.log(MIN_SLOPE)), dim=-1)
            for raw in (widths, heights)
        ]
        ends = [size.cumsum(-1) - BOUND for size in sizes]
        starts = [end - size for end, size in zip(ends, sizes, strict=True)]
        # The slope at both ends is 1, as that of the identity.
        slopes = pad(soft_bound(slopes, -math.log(MIN_SLOPE)), (1, 1)).exp()
        # A sum over all bins with one-hot weights is faster than a gather.
        above = value.unsqueeze(-1) >= ends[by_height][..., :-1]
        reached = pad(above, (1, 0), value=True)
        counts = (reached & ~pad(above, (0, 1), value=False)).to(value)
        parts = (*starts, *sizes, slopes[..., :-1], slopes[..., 1:])
        return tuple((part * counts).sum(-1) for part in parts)


def _share(z: th.Tensor, slope: th.Tensor, left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """Return the share of the bin's height that is reached at z."""
    between = z * (1 - z)
    return (slope * z.square() + left * between) / (slope + (left + right - 2 * slope) * between)


def _log_slope(z: th.Tensor, slope: th.Tensor, left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """Return the logarithm of the spline's slope at z."""
    between = z * (1 - z)
    rise = right * z.square() + 2 * slope * between + left * (1 - z).square()
    below = slope + (left + right - 2 * slope) * between
    return 2 * (slope.log() - below.log()) + rise.log()
