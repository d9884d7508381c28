"""The chapter's data sets: samples to fit, and the density that they really come from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from sklearn.datasets import make_moons

from sb3_flowpolicy.density.moons import entropy_on_grid, moon_log_density

NOISE = 0.05
# From 0.0 to 2.1 in steps of 0.1 radian.
TRAINING_ANGLES = np.arange(22) / 10
POINTS_PER_ANGLE = 227


@dataclass(frozen=True)
class Sample:
    """Points, and what each of them is conditioned on.

    Args:
        points: Shape (N, 2).
        condition: Shape (N, C); C = 0 where there is no condition.
    """

    points: np.ndarray
    condition: np.ndarray


@dataclass(frozen=True)
class Scaler:
    """Shift and scale that standardise a training sample; applied to all others as well.

    Args:
        mean: Shape (2,).
        scale: Standard deviation, shape (2,).
    """

    mean: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> Scaler:
        """Measure mean and standard deviation of points (N, 2), as scikit-learn's scaler does."""
        return cls(points.mean(0), points.std(0))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Standardise points (..., 2)."""
        return (points - self.mean) / self.scale

    @property
    def log_volume(self) -> float:
        """Nats by which standardising lowers an entropy: the sum of the log-scales."""
        return float(np.log(self.scale).sum())


class DataSet(ABC):
    """A distribution over points in the plane, perhaps given a condition.

    Attributes:
        n_train: Size of a training sample.
        condition_dim: Number C of conditioning variables, 0 for none.
        standardised: Whether models are fitted to standardised points.
    """

    n_train: int
    condition_dim: int
    standardised: bool

    @abstractmethod
    def draw(self, n: int, seed: int) -> Sample:
        """Draw n points, in random order; the same seed draws the same points."""

    @abstractmethod
    def log_density(self, sample: Sample) -> np.ndarray:
        """Return log p(x | condition) of the true density in nats, shape (N,)."""

    @abstractmethod
    def entropy(self) -> float:
        """Return the differential entropy given the condition, in nats, before standardising."""

    def scaler(self, sample: Sample) -> Scaler:
        """Return the scaler that the sample asks for: the identity where not standardised."""
        return Scaler.of(sample.points) if self.standardised else Scaler(np.zeros(2), np.ones(2))


class TwoMoons(DataSet):
    """Two interleaved half circles, as scikit-learn's ``make_moons`` makes them.

    Args:
        labelled: Whether the moon that a point belongs to is its condition, as 0 or 1.

    Example:
        >>> TwoMoons(labelled=True).draw(2000, seed=0).points.shape
        (2000, 2)
        >>> print(f"{TwoMoons().entropy():.3f} nats")
        0.289 nats
    """

    n_train = 2000
    standardised = True

    def __init__(self, labelled: bool = False) -> None:
        self.labelled = labelled
        self.condition_dim = int(labelled)

    def draw(self, n: int, seed: int) -> Sample:
        """Draw n points, half of them from each moon."""
        points, label = make_moons(n, noise=NOISE, random_state=seed)
        return Sample(points, label[:, None][:, : self.condition_dim].astype(float))

    def log_density(self, sample: Sample) -> np.ndarray:
        """Mix both moons, or take the one that the label names."""
        upper = moon_log_density(sample.points, NOISE)
        # Half a turn around (0.5, 0.25) takes one moon to the other.
        lower = moon_log_density(np.array([1.0, 0.5]) - sample.points, NOISE)
        if self.labelled:
            return np.where(sample.condition[:, 0] > 0.5, lower, upper)
        return np.logaddexp(upper, lower) - np.log(2)

    def entropy(self) -> float:
        """Integrate over both moons, or over one: the other is as large."""
        condition = np.zeros((1, self.condition_dim))

        def log_density(points: np.ndarray) -> np.ndarray:
            return self.log_density(Sample(points, condition.repeat(len(points), axis=0)))

        return entropy_on_grid(log_density, (-1.0, -0.5), (2.0, 1.0), NOISE)


class AngleMoons(DataSet):
    """Half circles around the origin that point in the direction of an angle.

    At angle 0 the half circle is the upper one; angle θ turns it by θ, counter-clockwise. The
    condition is (sin θ, cos θ), so that there is no jump after a full turn.

    Args:
        angles: Angles in radian; a sample has equally many points of each.

    Example:
        >>> AngleMoons().draw(4994, seed=0).condition.shape
        (4994, 2)
    """

    n_train = len(TRAINING_ANGLES) * POINTS_PER_ANGLE
    condition_dim = 2
    standardised = False

    def __init__(self, angles: np.ndarray = TRAINING_ANGLES) -> None:
        self.angles = np.asarray(angles, dtype=float)

    def draw(self, n: int, seed: int) -> Sample:
        """Draw n points, n / number of angles from each half circle.

        Raises:
            ValueError: If n is not a multiple of the number of angles.
        """
        per_angle, rest = divmod(n, len(self.angles))
        if rest or n < 1:
            raise ValueError(f"n must be a multiple of {len(self.angles)} angles, got {n}")
        rng = np.random.default_rng(seed)
        order = rng.permutation(n)
        turn = self.angles.repeat(per_angle)[order]
        # Evenly spaced along the arc, as make_moons does it.
        along = np.tile(np.linspace(0, np.pi, per_angle), len(self.angles))[order]
        points = np.stack([np.cos(turn + along), np.sin(turn + along)], axis=1)
        points += NOISE * rng.standard_normal(points.shape)
        return Sample(points, angle_condition(turn))

    def log_density(self, sample: Sample) -> np.ndarray:
        """Turn every point back to angle 0 and score it there."""
        sin, cos = sample.condition.T
        x, y = sample.points.T
        return moon_log_density(np.stack([cos * x + sin * y, cos * y - sin * x], axis=1), NOISE)

    def entropy(self) -> float:
        """Integrate one half circle: all are equally large."""
        return entropy_on_grid(lambda x: moon_log_density(x, NOISE), (-1, 0), (1, 1), NOISE)


def angle_condition(angle: np.ndarray) -> np.ndarray:
    """Return (sin θ, cos θ): shape (N,) -> (N, 2)."""
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)
