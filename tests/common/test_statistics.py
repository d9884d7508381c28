"""Statistics: against numbers worked out by hand, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_flowpolicy.common.statistics import (
    interquartile_mean,
    probability_of_improvement,
)


def test_interquartile_mean_ignores_the_extreme_quarters() -> None:
    estimate = interquartile_mean(np.array([-100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]))
    assert estimate.value == pytest.approx(3.5)
    assert estimate.low < 3.5 < estimate.high
    same = interquartile_mean(np.full(10, 2.0))
    assert (same.value, same.low, same.high) == (2, 2, 2)


def test_intervals_cover_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(30, 400))
    estimate = interquartile_mean(samples)
    covered = ((estimate.low < 0) & (estimate.high > 0)).mean()
    assert 0.88 < covered < 0.98


def test_curves_and_numbers_agree() -> None:
    values = np.random.default_rng(1).normal(size=(10, 3))
    curve = interquartile_mean(values)
    for k in range(3):
        number = interquartile_mean(values[:, k])
        assert number.value == pytest.approx(curve.value[k])
        # Different random numbers, the same distribution.
        assert number.low == pytest.approx(curve.low[k], abs=0.1)
        assert number.high == pytest.approx(curve.high[k], abs=0.1)


def test_one_seed_has_no_interval_but_a_value() -> None:
    curve = interquartile_mean(np.array([[1.0, 2.0]]))
    assert curve.low.tolist() == curve.value.tolist() == [1, 2]


def test_probability_of_improvement_counts_pairs() -> None:
    chance = probability_of_improvement(np.array([1.0, 3.0]), np.array([2.0, 2.0]))
    assert chance.value == pytest.approx(0.5)
    certain = probability_of_improvement(np.arange(10, 20.0), np.arange(10.0))
    assert (certain.value, certain.low) == (1, 1)


def test_the_same_data_give_the_same_digits() -> None:
    values = np.random.default_rng(0).normal(size=10)
    first, second = (interquartile_mean(values) for _ in range(2))
    assert (first.low, first.high) == (second.low, second.high)
    assert first.low < first.high
