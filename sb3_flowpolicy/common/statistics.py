"""Statistics over seeds, with the definitions of rliable (Agarwal et al., 2021, arXiv:2108.13264).

They need scipy, which the extra ``[experiments]`` installs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

RESAMPLES = 2000
# Published tables contain intervals: the same data must give the same digits.
BOOTSTRAP_SEED = 20200901


@dataclass(frozen=True)
class Estimate:
    """A point estimate and its 95 % interval: numbers, or arrays over steps."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __format__(self, spec: str) -> str:
        """Format a single number as ``value (low, high)``."""
        spec = spec or ".2f"
        return f"{self.value:{spec}} ({self.low:{spec}}, {self.high:{spec}})"


def interquartile_mean(values: np.ndarray, seed: int = BOOTSTRAP_SEED) -> Estimate:
    """Mean of the middle half of the seeds, with a percentile bootstrap interval.

    For curves the interval holds at each step on its own.

    Args:
        values: One number or curve per seed, (S, ...).
        seed: Seed of the resampling.

    Returns:
        Estimates of shape (...). A single seed has an interval of width zero.

    Example:
        >>> returns = np.array([1.0, 2.0, 2.0, 3.0, 4.0, 99.0])
        >>> print(f"{interquartile_mean(returns):.2f}")
        2.75 (1.75, 51.01)
    """
    from scipy.stats import trim_mean

    return _bootstrap(lambda runs, axis: trim_mean(runs, 0.25, axis=axis), seed, values)


def probability_of_improvement(better: np.ndarray, worse: np.ndarray) -> Estimate:
    """Probability that a run of one agent ends above a run of the other, ties counting half.

    Args:
        better: Values of one agent, (S,).
        worse: Values of the other, (S',).

    Returns:
        The estimate, in [0, 1].

    Example:
        >>> float(probability_of_improvement(np.arange(3.0), np.arange(3.0)).value)
        0.5
    """

    def share(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        x, y = np.moveaxis(x, axis, -1), np.moveaxis(y, axis, -1)
        return np.heaviside(x[..., :, None] - y[..., None, :], 0.5).mean((-2, -1))

    return _bootstrap(share, BOOTSTRAP_SEED, better, worse)


def _bootstrap(statistic: Callable[..., np.ndarray], seed: int, *samples: np.ndarray) -> Estimate:
    from scipy.stats import bootstrap

    value = statistic(*samples, axis=0)
    if min(map(len, samples)) == 1:  # nothing to resample
        return Estimate(value, value, value)
    resampled = bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLES,
        batch=100,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return Estimate(value, *resampled.confidence_interval)
