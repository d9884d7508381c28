"""Curves: on a common grid, smoothed, and the swings counted."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_flowpolicy.experiments.curves import common_grid, on_grid, running_mean, swings


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
