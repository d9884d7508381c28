"""The density that two-moons data are drawn from, and its entropy: the limit for every model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import logsumexp

# Gauss-Legendre nodes on the half circle: neighbours are at most 0.04 apart. Where that is no more
# than the noise, the relative error is below 1e-8.
N_NODES = 128
MIN_NOISE = 0.04
# Points scored at once: their distances to all nodes are held in memory together.
CHUNK = 10_000
# The integration grid: half the noise between neighbours, eight times the noise as margin.
CELLS_PER_NOISE, MARGIN_IN_NOISE = 2, 8


def moon_log_density(points: np.ndarray, noise: float) -> np.ndarray:
    r"""Log-density of the upper half of the unit circle, blurred by isotropic normal noise.

    .. math:: p(x) = \frac{1}{\pi} \int_0^\pi
        \mathcal N\bigl(x; (\cos t, \sin t), \sigma^2 I\bigr)\, dt

    Args:
        points: Points x, shape (N, 2).
        noise: Standard deviation :math:`\sigma`, at least 0.04.

    Returns:
        log p(x) in nats, shape (N,).

    Raises:
        ValueError: If the noise is finer than the nodes resolve.

    Example:
        >>> import numpy as np
        >>> on_the_arc, beside = moon_log_density(np.array([[0.0, 1.0], [0.0, 0.0]]), noise=0.05)
        >>> bool(on_the_arc > 0 > beside)
        True
    """
    if not noise >= MIN_NOISE:
        raise ValueError(f"noise must be at least {MIN_NOISE}, got {noise}")
    node, weight = np.polynomial.legendre.leggauss(N_NODES)
    angle = 0.5 * np.pi * (node + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # The weights sum to 2, so half of them is a distribution over the arc.
    log_weight = np.log(0.5 * weight) - np.log(2 * np.pi * noise**2)
    scored = []
    for start in range(0, len(points), CHUNK):
        chunk = points[start : start + CHUNK]
        distance = ((chunk[:, None, :] - arc) ** 2).sum(-1)
        scored.append(logsumexp(log_weight - distance / (2 * noise**2), axis=1))
    return np.concatenate(scored) if scored else np.empty(0)


def entropy_on_grid(
    log_density: Callable[[np.ndarray], np.ndarray],
    low: tuple[float, float],
    high: tuple[float, float],
    noise: float,
) -> float:
    r"""Differential entropy :math:`-\int p \log p` of a density that noise has blurred.

    The trapezoidal rule converges faster than any power of the spacing for smooth densities that
    have vanished at the border of the grid.

    Args:
        log_density: Points (N, 2) -> log p in nats (N,).
        low: Lower corner of a box around the centre lines of the data, before the noise.
        high: Upper corner.
        noise: Standard deviation of the noise.

    Returns:
        The entropy in nats.

    Raises:
        ValueError: If less or more than all of the mass lies on the grid.

    Example:
        >>> import numpy as np
        >>> normal = lambda x: -0.5 * (x**2).sum(1) - np.log(2 * np.pi)
        >>> h = entropy_on_grid(normal, low=(0, 0), high=(0, 0), noise=1.0)
        >>> print(f"{h:.6f} = {np.log(2 * np.pi * np.e):.6f}")
        2.837877 = 2.837877
    """
    step, margin = noise / CELLS_PER_NOISE, MARGIN_IN_NOISE * noise
    axes = [np.arange(a - margin, b + margin + step, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    log_p = log_density(points)
    p = np.exp(log_p)
    mass = p.sum() * step**2
    if abs(mass - 1) > 1e-6:
        raise ValueError(f"log_density must have all its mass in the box, got {mass:.8f} of it")
    # p log p -> 0 where p has underflowed.
    return float(-np.sum(np.where(p > 0, p * log_p, 0)) * step**2)
