"""Statistics over seeds, as in rliable (Agarwal et al., 2021, arXiv:2108.13264).

They need scipy and rliable, which the extra ``[experiments]`` installs.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

RESAMPLES = 2000
RESAMPLES_OF_PAIRS = 500
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


def bootstrap_interquartile_mean(values: np.ndarray, seed: int = BOOTSTRAP_SEED) -> Estimate:
    """Mean of the middle half of the seeds, with a percentile bootstrap interval.

    For curves the interval holds at each step on its own. rliable resamples one by one, which takes
    minutes for a page of curves; for a single task its stratified bootstrap is this one.

    Args:
        values: One number or curve per seed, (S, ...).
        seed: Seed of the resampling.

    Returns:
        Estimates of shape (...). A single seed has an interval of width zero.

    Example:
        >>> returns = np.array([1.0, 2.0, 2.0, 3.0, 4.0, 99.0])
        >>> print(f"{bootstrap_interquartile_mean(returns):.2f}")
        2.75 (1.75, 51.01)
    """
    from scipy.stats import bootstrap, trim_mean

    mean = trim_mean(values, 0.25, axis=0)
    if len(values) == 1:
        return Estimate(mean, mean, mean)
    resampled = bootstrap(
        (values,),
        lambda runs, axis: trim_mean(runs, 0.25, axis=axis),
        n_resamples=RESAMPLES,
        batch=100,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return Estimate(mean, *resampled.confidence_interval)


def interquartile_mean(values: np.ndarray) -> Estimate:
    """Mean of the middle half of the seeds, with rliable's stratified bootstrap interval.

    Args:
        values: One value per seed, (S,).

    Raises:
        ValueError: If there are no seeds, or values are not finite.

    Example:
        >>> float(interquartile_mean(np.array([0.0, 1.0, 1.0, 9.0])).value)
        1.0
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"values must be 1-dimensional, finite and not empty, got {values}")
    return _interquartile_mean(tuple(values.tolist()))


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
    return _improvement(tuple(np.asarray(better).tolist()), tuple(np.asarray(worse).tolist()))


# A page and its tables ask for the same estimates, which take up to a second each.
@functools.cache
def _interquartile_mean(values: tuple[float, ...]) -> Estimate:
    from rliable import metrics

    # rliable expects (runs, tasks): the seeds are the runs of one task.
    runs = np.array(values)[:, None]
    return _estimate(runs, lambda runs: np.array([metrics.aggregate_iqm(runs)]), RESAMPLES)


@functools.cache
def _improvement(better: tuple[float, ...], worse: tuple[float, ...]) -> Estimate:
    from rliable import metrics

    return _estimate(
        [np.array(better)[:, None], np.array(worse)[:, None]],
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        RESAMPLES_OF_PAIRS,
    )


def _estimate(scores: Any, statistic: Callable[..., np.ndarray], resamples: int) -> Estimate:
    from rliable import library

    # rliable 1.2 draws from numpy's global generator in whatever state it is.
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(BOOTSTRAP_SEED)  # noqa: NPY002
    try:
        points, intervals = library.get_interval_estimates(
            {"scores": scores}, statistic, reps=resamples
        )
    finally:
        np.random.set_state(before)  # noqa: NPY002
    low, high = intervals["scores"][:, 0]
    return Estimate(points["scores"][0], low, high)
