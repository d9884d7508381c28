"""Curves: on a common grid, and their swings counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_flowpolicy.experiments.evidence import Evidence, swings
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS


def test_logs_of_unequal_length_meet_on_a_grid(tmp_path: Path) -> None:
    evidence = Evidence(EXPERIMENTS["circle-narrow"], tmp_path)
    log = {
        "seed": [1, 1, 1, 1, 2, 2],
        "step": [10.0, 20.0, 30.0, 40.0, 15.0, 25.0],
        "entropy": [20, np.nan, 60, 80, 1, 3],
    }
    evidence._logs = {("narrow", "flow"): pd.DataFrame(log)}
    curves = evidence.curves("narrow", "flow", "entropy")
    assert curves.index.tolist() == [10, 15, 20, 25]
    assert curves.to_numpy().T.tolist() == [[20, 30, 40, 50], [1, 1, 2, 3]]


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
