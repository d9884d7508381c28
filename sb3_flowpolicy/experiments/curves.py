"""Curves over training: smoothed, and how often they swing."""

from __future__ import annotations

import numpy as np


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
