"""The chapter's data sets: samples to fit, with their true density and its entropy."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import logsumexp
from sklearn.datasets import make_moons

NOISE = 0.05
# From 0.0 to 2.1 in steps of 0.1 radian.
TRAINING_ANGLES = np.arange(22) / 10
POINTS_PER_ANGLE = 227

# Gauss-Legendre nodes on the half circle, at most 0.04 apart, less than the noise: the relative
# error is below 1e-8.
N_NODES = 128
# Spacing and margin of the integration grid.
CELLS_PER_NOISE, MARGIN_IN_NOISE = 2, 8


class Sample(NamedTuple):
    """Points and their conditions; C = 0 without conditions."""

    points: np.ndarray  # (N, 2)
    condition: np.ndarray  # (N, C)


class Scaler(NamedTuple):
    """Mean and standard deviation (2,) that standardize a training sample and all others."""

    mean: np.ndarray
    scale: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Standardize points (..., 2)."""
        return (points - self.mean) / self.scale

    @property
    def log_volume(self) -> float:
        """Nats by which standardizing lowers an entropy: the sum of the log-scales."""
        return float(np.log(self.scale).sum())


class TwoMoons:
    """Two interleaved half circles from scikit-learn's ``make_moons``.

    Args:
        labeled: Whether the label of the moon, 0 or 1, is the condition.

    Example:
        >>> TwoMoons(labeled=True).draw(2000, seed=0).points.shape
        (2000, 2)
        >>> print(f"{TwoMoons().entropy():.3f} nats")
        0.289 nats
    """

    n_train = 2000

    def __init__(self, labeled: bool = False) -> None:
        self.labeled = labeled
        self.condition_dim = int(labeled)

    def conditions(self, n: int) -> np.ndarray:
        """Return the conditions whose densities are integrated, (K, C)."""
        return np.array([[0.0], [1.0]]) if self.labeled else np.zeros((1, 0))

    def draw(self, n: int, seed: int) -> Sample:
        """Draw n points, half of them from each moon."""
        points, label = make_moons(n, noise=NOISE, random_state=seed)
        return Sample(points, label[:, None][:, : self.condition_dim].astype(float))

    def scaler(self, sample: Sample) -> Scaler:
        """Measure mean and standard deviation of a training sample."""
        return Scaler(sample.points.mean(0), sample.points.std(0))

    def log_density(self, sample: Sample) -> np.ndarray:
        """Score points, in nats, under the moon of their label, or under the mixture of both."""
        upper = moon_log_density(sample.points)
        # A rotation by 180 degrees around (0.5, 0.25) maps one moon to the other.
        lower = moon_log_density(np.array([1.0, 0.5]) - sample.points)
        if self.labeled:
            return np.where(sample.condition[:, 0] > 0.5, lower, upper)
        return np.logaddexp(upper, lower) - np.log(2)

    def entropy(self) -> float:
        """Return the entropy given the label, if any, in nats, before standardizing."""
        condition = np.zeros((1, self.condition_dim))

        def log_density(points: np.ndarray) -> np.ndarray:
            return self.log_density(Sample(points, condition.repeat(len(points), axis=0)))

        return entropy_on_grid(log_density, (-1.0, -0.5), (2.0, 1.0))


class AngleMoons:
    """Half circles around the origin that point in the direction of an angle.

    The upper half circle has angle 0; angle θ turns it by θ, counter-clockwise. The condition is
    (sin θ, cos θ), so that it does not jump after a full turn.

    Args:
        angles: Angles in radian; a sample has equally many points of each.

    Example:
        >>> AngleMoons().draw(4994, seed=0).condition.shape
        (4994, 2)
    """

    n_train = len(TRAINING_ANGLES) * POINTS_PER_ANGLE
    condition_dim = 2

    def __init__(self, angles: np.ndarray = TRAINING_ANGLES) -> None:
        self.angles = np.asarray(angles, dtype=float)

    def conditions(self, n: int) -> np.ndarray:
        """Return the conditions of n angles over the full circle, (n, 2)."""
        return angle_condition(np.arange(n) * 2 * np.pi / n)

    def draw(self, n: int, seed: int) -> Sample:
        """Draw at least n points, equally many from each half circle."""
        per_angle = -(-n // len(self.angles))
        n = per_angle * len(self.angles)
        rng = np.random.default_rng(seed)
        order = rng.permutation(n)
        turn = self.angles.repeat(per_angle)[order]
        # Evenly spaced along the arc, as in make_moons.
        along = np.tile(np.linspace(0, np.pi, per_angle), len(self.angles))[order]
        points = np.stack([np.cos(turn + along), np.sin(turn + along)], axis=1)
        points += NOISE * rng.standard_normal(points.shape)
        return Sample(points, angle_condition(turn))

    def scaler(self, sample: Sample) -> Scaler:
        """Return the identity: the half circles are centered, with radius 1."""
        return Scaler(np.zeros(2), np.ones(2))

    def log_density(self, sample: Sample) -> np.ndarray:
        """Score points, in nats, after turning them back to angle 0."""
        sin, cos = sample.condition.T
        x, y = sample.points.T
        return moon_log_density(np.stack([cos * x + sin * y, cos * y - sin * x], axis=1))

    def entropy(self) -> float:
        """Return the entropy given the angle: that of any half circle."""
        return entropy_on_grid(moon_log_density, (-1, 0), (1, 1))


DataSet = TwoMoons | AngleMoons


def angle_condition(angle: np.ndarray) -> np.ndarray:
    """Return (sin θ, cos θ): shape (N,) -> (N, 2)."""
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def moon_log_density(points: np.ndarray) -> np.ndarray:
    r"""Log-density of the upper half of the unit circle, blurred by isotropic normal noise.

    .. math:: p(x) = \frac{1}{\pi} \int_0^\pi
        \mathcal N\bigl(x; (\cos t, \sin t), \sigma^2 I\bigr)\, dt

    Example:
        >>> on_the_arc, beside = moon_log_density(np.array([[0.0, 1.0], [0.0, 0.0]]))
        >>> bool(on_the_arc > 0 > beside)
        True
    """
    node, weight = np.polynomial.legendre.leggauss(N_NODES)
    angle = 0.5 * np.pi * (node + 1)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # The weights sum to 2, so half of them is a distribution over the arc.
    log_weight = np.log(0.5 * weight) - np.log(2 * np.pi * NOISE**2)
    distance = cdist(points, arc, "sqeuclidean")
    return logsumexp(log_weight - distance / (2 * NOISE**2), axis=1)


def entropy_on_grid(
    log_density: Callable[[np.ndarray], np.ndarray],
    low: tuple[float, float],
    high: tuple[float, float],
    noise: float = NOISE,
) -> float:
    r"""Differential entropy :math:`-\int p \log p` of a density with normal noise.

    For a smooth density that vanishes at the border of the grid, the error of the trapezoidal rule
    falls faster than any power of the spacing.

    Args:
        log_density: Points (N, 2) -> log p in nats (N,).
        low: Lower corner of a box around the data without the noise.
        high: Upper corner.
        noise: Standard deviation of the noise.

    Example:
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
