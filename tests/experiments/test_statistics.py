"""Statistics: against numbers worked out by hand, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_flowpolicy.experiments import statistics
from sb3_flowpolicy.experiments.statistics import (
    common_grid,
    interquartile_curve,
    interquartile_mean,
    on_grid,
    probability_of_improvement,
    running_mean,
    swings,
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
    estimate = interquartile_curve(samples)
    covered = ((estimate.low < 0) & (estimate.high > 0)).mean()
    assert 0.88 < covered < 0.98


def test_curves_and_numbers_agree() -> None:
    values = np.random.default_rng(1).normal(size=(10, 3))
    curve = interquartile_curve(values)
    for k in range(3):
        number = interquartile_mean(values[:, k])
        assert number.value == pytest.approx(curve.value[k])
        # Different random numbers, the same distribution.
        assert number.low == pytest.approx(curve.low[k], abs=0.1)
        assert number.high == pytest.approx(curve.high[k], abs=0.1)


def test_one_seed_has_no_interval_but_a_value() -> None:
    curve = interquartile_curve(np.array([[1.0, 2.0]]))
    assert curve.low.tolist() == curve.value.tolist() == [1, 2]


@pytest.mark.parametrize("values", [np.array([]), np.array([1.0, np.nan]), np.ones((2, 2))])
def test_what_is_no_list_of_finite_numbers_is_refused(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="values must be 1-dimensional, finite and not empty"):
        interquartile_mean(values)


def test_probability_of_improvement_counts_pairs() -> None:
    chance = probability_of_improvement(np.array([1.0, 3.0]), np.array([2.0, 2.0]))
    assert chance.value == pytest.approx(0.5)
    certain = probability_of_improvement(np.arange(10, 20.0), np.arange(10.0))
    assert (certain.value, certain.low) == (1, 1)


def test_logs_of_unequal_length_meet_on_a_grid() -> None:
    long, short = np.array([10.0, 20.0, 30.0, 40.0]), np.array([15.0, 25.0])
    grid = common_grid([long, short])
    assert grid.tolist() == [10, 15, 20, 25]
    assert on_grid(grid, long, 2 * long).tolist() == [20, 30, 40, 50]
    assert on_grid(grid, short, np.array([1.0, 3.0])).tolist() == [1, 1, 2, 3]
    gap = np.array([0.0, np.nan, 4.0, 5.0])
    assert on_grid(long, long, gap).tolist() == [0, 2, 4, 5]


def test_running_mean_is_shorter_at_the_start() -> None:
    assert running_mean(np.arange(5.0), 3).tolist() == [0, 0.5, 1, 2, 3]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0, 1, 2, 3], 0),
        ([0, 3, 0], 1),
        ([0, 3, 0, 3, 0], 3),
        ([0, 3, 2.5, 3, 2.5, 3], 0),  # wiggles
        ([3, 0, 3, 0.5], 2),
        ([0, 1, 0.5, 1.5, 1, 3, 2, 1, 0], 1),  # a long way in small steps
        ([5], 0),
    ],
)
def test_swings_are_turns_of_full_size(values: list[float], expected: int) -> None:
    assert swings(np.array(values, float), 2.0) == expected
    assert swings(-np.array(values, float), 2.0) == expected


def test_the_same_data_give_the_same_digits() -> None:
    """rliable draws from numpy's global generator: ours is put in place, and theirs back."""
    values = np.random.default_rng(0).normal(size=10)
    found = []
    for seed in (1, 2):
        statistics._interquartile_mean.cache_clear()
        np.random.seed(seed)  # noqa: NPY002
        found.append(interquartile_mean(values))
        after = np.random.random()  # noqa: NPY002
        np.random.seed(seed)  # noqa: NPY002
        assert after == np.random.random()  # noqa: NPY002
    assert (found[0].low, found[0].high) == (found[1].low, found[1].high)
    assert found[0].low < found[0].high
