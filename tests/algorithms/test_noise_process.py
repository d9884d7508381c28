"""Colored noise: the slope that was asked for, and standard normals at every single step."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from scipy import signal, stats

from sb3_flowpolicy.algorithms.exploration import NoiseProcess


def run(process: NoiseProcess, steps: int, seed: int = 0) -> np.ndarray:
    """Values of many independent copies, (steps, N, M)."""
    generator = th.Generator().manual_seed(seed)
    return np.stack(
        [
            process.step(th.randn(process.white_shape, generator=generator)).numpy()
            for _ in range(steps)
        ]
    )


@pytest.mark.parametrize("color", [0.0, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("horizon", [40, 1000])
def test_the_spectrum_has_the_slope_that_was_asked_for(color: float, horizon: int) -> None:
    values = run(NoiseProcess(10, 20, color, horizon=horizon), 8 * horizon)
    frequencies, power = signal.welch(
        values.reshape(len(values), -1), nperseg=4 * horizon, axis=0, detrend=False
    )
    inside = (frequencies >= 1 / horizon) & (frequencies <= 0.5)
    # One point per octave: a line through all of them would see little but the highest octave.
    octaves = np.floor(np.log2(frequencies[inside] * horizon))
    level = np.log(power[inside].mean(1))
    points = [
        (np.log(frequencies[inside][octaves == k]).mean(), level[octaves == k].mean())
        for k in np.unique(octaves)
    ]
    slope = np.polyfit(*np.transpose(points), 1)[0]
    assert slope == pytest.approx(-color, abs=0.1)


@pytest.mark.parametrize("settings", [{"color": 1.0}, {"color": 0.5}, {"correlation_time": 10.0}])
def test_every_step_is_standard_normal(settings: dict[str, float]) -> None:
    process = NoiseProcess(2, 4000, **settings)
    values = run(process, 12)
    for step in (0, 1, 11):
        assert stats.kstest(values[step].ravel(), "norm").pvalue > 1e-3
    # In all directions, not only along the axes: the dimensions are independent.
    assert abs(np.corrcoef(values[11].T)[0, 1]) < 0.05
    assert np.corrcoef(values[0, :, 0], values[1, :, 0])[0, 1] > 0.2


def test_ornstein_uhlenbeck_forgets_at_the_rate_that_was_asked_for() -> None:
    values = run(NoiseProcess(1, 20_000, correlation_time=5.0), 6)[..., 0]
    assert np.corrcoef(values[0], values[5])[0, 1] == pytest.approx(np.exp(-1), abs=0.02)


def test_white_noise_is_unchanged() -> None:
    white = th.randn(3, 1, 2)
    process = NoiseProcess(2, 3)
    for _ in range(2):
        assert th.equal(process.step(white), white.squeeze(1))


def test_an_episode_begins_without_a_past() -> None:
    process = NoiseProcess(1, 20_000, correlation_time=50.0)
    before = run(process, 1)[0, :, 0]
    process.restart(np.arange(20_000) < 10_000)
    after = run(process, 1, seed=1)[0, :, 0]
    assert abs(np.corrcoef(before[:10_000], after[:10_000])[0, 1]) < 0.04
    assert np.corrcoef(before[10_000:], after[10_000:])[0, 1] > 0.95


def test_a_restored_process_continues_with_the_same_numbers() -> None:
    process = NoiseProcess(2, 3, color=1.0)
    run(process, 5)
    process.restart(np.array([True, False, False]))
    state = process.state()
    expected = run(process, 5, seed=1)
    other = NoiseProcess(2, 3, color=1.0)
    other.load_state(state)
    np.testing.assert_array_equal(run(other, 5, seed=1), expected)
