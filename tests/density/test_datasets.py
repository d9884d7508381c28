"""Data sets against scikit-learn, and entropies against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.datasets import make_moons
from sklearn.preprocessing import StandardScaler

from sb3_flowpolicy.density.datasets import (
    NOISE,
    AngleMoons,
    DataSet,
    Sample,
    TwoMoons,
    angle_condition,
    entropy_on_grid,
    moon_log_density,
)

DATA_SETS = {"moons": TwoMoons(), "label": TwoMoons(labeled=True), "angle": AngleMoons()}


def test_two_moons_are_scikit_learns() -> None:
    sample = TwoMoons(labeled=True).draw(2000, seed=3)
    points, label = make_moons(2000, noise=0.05, random_state=3)
    np.testing.assert_array_equal(sample.points, points)
    np.testing.assert_array_equal(sample.condition[:, 0], label)


def test_standardizing_is_scikit_learns() -> None:
    train = TwoMoons().draw(2000, seed=0)
    points = train.points
    scaler = StandardScaler().fit(points)
    ours = TwoMoons().scaler(train)
    np.testing.assert_allclose(ours.apply(points), scaler.transform(points), atol=1e-12)
    assert ours.log_volume == pytest.approx(np.log(scaler.scale_).sum())


def test_angle_moons_are_the_thesiss() -> None:
    data = AngleMoons()
    sample = data.draw(data.n_train, seed=0)
    assert data.n_train == 4994
    assert len(data.draw(100, seed=0).points) == 110
    np.testing.assert_allclose(data.angles, np.linspace(0.0, 2.1, 22))
    _, counts = np.unique(sample.condition.round(6), axis=0, return_counts=True)
    assert counts.tolist() == [227] * 22
    # Turned back, every point lies on the upper half circle, except for the noise.
    angle = np.arctan2(sample.condition[:, 0], sample.condition[:, 1])
    direction = np.arctan2(sample.points[:, 1], sample.points[:, 0]) - angle
    radius = np.linalg.norm(sample.points, axis=1)
    assert radius.mean() == pytest.approx(1 + NOISE**2 / 2, abs=0.005)
    assert radius.std() == pytest.approx(NOISE, rel=0.05)
    middle = np.mean(np.angle(np.exp(1j * (direction - np.pi / 2))))
    assert middle == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("data", DATA_SETS.values(), ids=DATA_SETS)
def test_a_seed_draws_the_same_points_and_another_one_others(data: DataSet) -> None:
    n = data.n_train // 2 if isinstance(data, TwoMoons) else data.n_train
    first, again, other = data.draw(n, 1), data.draw(n, 1), data.draw(n, 2)
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.condition, again.condition)
    assert not np.allclose(first.points, other.points)


@pytest.mark.parametrize("data", DATA_SETS.values(), ids=DATA_SETS)
def test_entropy_is_the_mean_surprise_of_samples(data: DataSet) -> None:
    surprise = -data.log_density(data.draw(22_000, seed=5))
    error = surprise.std() / np.sqrt(len(surprise))
    assert data.entropy() == pytest.approx(surprise.mean(), abs=4 * error)


def test_two_moons_hardly_overlap() -> None:
    assert TwoMoons().entropy() == pytest.approx(
        TwoMoons(labeled=True).entropy() + np.log(2), abs=1e-3
    )


def test_density_of_one_moon_follows_from_the_other() -> None:
    points = np.random.default_rng(0).normal(size=(50, 2))
    labeled = TwoMoons(labeled=True)
    upper = labeled.log_density(Sample(points, np.zeros((50, 1))))
    lower = labeled.log_density(Sample(points, np.ones((50, 1))))
    np.testing.assert_allclose(
        TwoMoons().log_density(Sample(points, np.zeros((50, 0)))),
        np.log(0.5 * np.exp(upper) + 0.5 * np.exp(lower)),
    )


def test_turning_points_and_angle_changes_nothing() -> None:
    points = np.random.default_rng(0).normal(size=(20, 2)) * 0.3 + [0.0, 1.0]
    turn = 0.7
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    condition = angle_condition(np.full(20, turn))
    np.testing.assert_allclose(
        AngleMoons().log_density(Sample(points @ matrix, condition)),
        moon_log_density(points),
    )


def test_moon_density_converged_in_its_nodes() -> None:
    """Against a sum over many evenly spaced nodes."""
    points = np.random.default_rng(1).uniform(-1.3, 1.3, size=(40, 2))
    angle = (np.arange(20_000) + 0.5) * np.pi / 20_000
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance = ((points[:, None] - arc) ** 2).sum(-1)
    density = np.exp(-distance / (2 * NOISE**2)).mean(1) / (2 * np.pi * NOISE**2)
    ours = np.exp(moon_log_density(points))
    np.testing.assert_allclose(ours, density, rtol=1e-5, atol=1e-9)


def test_entropy_of_a_gaussian_mixture() -> None:
    """Two normals far apart: the entropy of one, plus log 2."""
    scale, centers = np.array([0.3, 0.5]), np.array([[-4.0, 0.0], [4.0, 1.0]])

    def log_density(points: np.ndarray) -> np.ndarray:
        z = (points[:, None] - centers) / scale
        single = -0.5 * (z**2).sum(-1) - np.log(2 * np.pi * scale.prod())
        return np.logaddexp(single[:, 0], single[:, 1]) - np.log(2)

    exact = np.log(2 * np.pi * np.e * scale.prod()) + np.log(2)
    low, high = (-6.0, -4.0), (6.0, 5.0)
    assert entropy_on_grid(log_density, low, high, noise=0.2) == pytest.approx(exact, abs=1e-6)


def test_entropy_of_a_box_that_misses_mass_is_refused() -> None:
    def half_outside(points: np.ndarray) -> np.ndarray:
        return -0.5 * (points**2).sum(1) - np.log(2 * np.pi)

    with pytest.raises(ValueError, match=r"all its mass in the box, got 0\.\d+"):
        entropy_on_grid(half_outside, (0.8, -8.0), (8.0, 8.0), noise=0.1)
