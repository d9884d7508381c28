"""Statistics over seeds, by rliable's definitions (Agarwal et al., 2021, arXiv:2108.13264)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from rliable import library, metrics
from scipy.stats import bootstrap, trim_mean

RESAMPLES = 2000
RESAMPLES_OF_PAIRS = 500
# Intervals are part of the published tables: the same data give the same digits.
_BOOTSTRAP_SEED = 20200901


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


def interquartile_mean(values: np.ndarray) -> Estimate:
    """Mean of the middle half of the seeds, with a stratified bootstrap interval.

    Args:
        values: One value per seed, (S,). Finite.

    Returns:
        The estimate.

    Raises:
        ValueError: If there are no seeds, or values are not finite.

    Example:
        >>> float(interquartile_mean(np.array([0.0, 1.0, 1.0, 9.0])).value)
        1.0
    """
    values = _checked(values, 1)
    return _interquartile_mean(tuple(values.tolist()))


@functools.cache
def _interquartile_mean(values: tuple[float, ...]) -> Estimate:
    """Remember estimates: page and tables ask for the same ones, at a second each."""
    # rliable wants (runs, tasks); the seeds of a setting are the runs of one task.
    return _estimate(
        np.array(values)[:, None], lambda runs: np.array([metrics.aggregate_iqm(runs)]), RESAMPLES
    )


def interquartile_curve(values: np.ndarray) -> Estimate:
    """Do the same at each step of a curve.

    rliable resamples one by one, which takes minutes for a page of curves. With a single task its
    stratified bootstrap is the ordinary one, and scipy does that at once.

    Args:
        values: One curve per seed, (S, T). Finite.

    Returns:
        Estimates of shape (T,); the interval holds at each step on its own.

    Raises:
        ValueError: If there are no seeds, or values are not finite.
    """
    values = _checked(values, 2)
    mean = trim_mean(values, 0.25, axis=0)
    if len(values) == 1:
        return Estimate(mean, mean, mean)
    resampled = bootstrap(
        (values,),
        lambda runs, axis: trim_mean(runs, 0.25, axis=axis),
        axis=0,
        n_resamples=RESAMPLES,
        batch=100,
        method="percentile",
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    )
    return Estimate(mean, *resampled.confidence_interval)


def _checked(values: np.ndarray, ndim: int) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.ndim != ndim or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"values must be {ndim}-dimensional, finite and not empty, got {values}")
    return values


@contextmanager
def _same_digits_each_time() -> Iterator[None]:
    """Seed numpy's global generator, which rliable 1.2 draws from whatever random state it gets."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(_BOOTSTRAP_SEED)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


def _estimate(scores: Any, statistic: Callable[..., np.ndarray], resamples: int) -> Estimate:
    with _same_digits_each_time():
        points, intervals = library.get_interval_estimates(
            {"scores": scores}, statistic, reps=resamples
        )
    low, high = intervals["scores"][:, 0]
    return Estimate(points["scores"][0], low, high)


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


@functools.cache
def _improvement(better: tuple[float, ...], worse: tuple[float, ...]) -> Estimate:
    return _estimate(
        [np.array(better)[:, None], np.array(worse)[:, None]],
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        RESAMPLES_OF_PAIRS,
    )


def common_grid(steps: Sequence[np.ndarray]) -> np.ndarray:
    """Return all steps at which any seed was measured, up to where the shortest log ends.

    Example:
        >>> common_grid([np.array([1, 2, 3]), np.array([2, 4])]).tolist()
        [1, 2, 3]
    """
    last = min(one[-1] for one in steps)
    grid = np.unique(np.concatenate(list(steps)))
    return grid[grid <= last]


def on_grid(grid: np.ndarray, steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate a log linearly; before its first value it is taken to be constant.

    Args:
        grid: Where values are wanted, (T,).
        steps: Where values were measured, increasing.
        values: What was measured; NaN where nothing was, but not everywhere.

    Returns:
        Values at the grid, (T,).
    """
    known = np.isfinite(values)
    return np.interp(grid, steps[known], values[known])


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Average each value with up to ``window - 1`` before it, along the last axis.

    Example:
        >>> running_mean(np.array([0.0, 1.0, 1.0]), 2).tolist()
        [0.0, 0.5, 1.0]
    """
    sums = np.cumsum(values, axis=-1)
    sums[..., window:] -= sums[..., :-window].copy()
    return sums / np.minimum(np.arange(values.shape[-1]) + 1, window)


def swings(values: np.ndarray, amplitude: float) -> int:
    """Count how often a curve turns round after moving at least ``amplitude`` one way.

    Small wiggles do not count: a turn is one only if the curve has moved by ``amplitude`` one way
    and then moves by ``amplitude`` the other way. A monotonic curve has none, a square wave over
    three periods five.

    Args:
        values: The curve, (T,).
        amplitude: Least difference between a high and the low that follows, above 0.

    Example:
        >>> swings(np.array([0.0, 1.0, 0.1, 0.2, 0.9, 0.0]), 0.5)
        3
        >>> swings(np.linspace(0, 9, 50), 1.5)
        0
    """
    low = high = values[0]
    direction, turns = 0, 0
    for value in values[1:]:
        low, high = min(low, value), max(high, value)
        if direction >= 0 and high - value >= amplitude:
            turns += direction
            direction, low = -1, value
        elif direction <= 0 and value - low >= amplitude:
            turns -= direction
            direction, high = 1, value
    return turns
