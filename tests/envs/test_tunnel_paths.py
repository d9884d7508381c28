import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowpolicy_envs.tunnel.config import TunnelConfig
from flowpolicy_envs.tunnel.paths import Path, circle_path, line_path, spline_path

PATHS = {
    "diagonal": line_path(2, 2, 0, 0.9),
    "horizontal": line_path(2, 1, 0, 0.9),
    "one dimension": line_path(1, 1, 0, 0.5),
    "64 dimensions": line_path(64, 40, 8, 0.9),
    "circle": circle_path(0.7),
    "spline": TunnelConfig(path="spline").geometry,
}
L_SHAPE = spline_path([(0.0, 0.0), (0.5, 0.0), (0.5, 0.5)])


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_center_line_has_no_offset_and_leads_to_the_goal(path: Path):
    goal = path.goal_arcs[0]
    arcs = np.linspace(0.0, goal, 50)
    offsets, remaining = zip(*(path.locate(path.point(arc)) for arc in arcs), strict=True)
    assert np.allclose(offsets, 0.0, atol=1e-12)
    assert remaining[0] > 0.0
    assert remaining[-1] == pytest.approx(0.0, abs=1e-12)
    if path is not PATHS["circle"]:  # where the way back is shorter at first
        assert np.allclose(remaining, goal - arcs)


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_whole_goal_region_has_nothing_remaining(path: Path):
    low, high = path.goal_arcs
    for arc in np.linspace(low + 1e-9, high - 1e-9, 9):
        assert path.locate(path.point(arc))[1] == pytest.approx(0.0, abs=1e-12)


@settings(deadline=None, max_examples=60)
@given(st.data(), st.integers(1, 64))
def test_line_offset_against_the_projection_matrix(data, total):
    coupled = data.draw(st.integers(1, total))
    free = data.draw(st.integers(0, total - coupled))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    position = rng.uniform(-1, 1, total)
    offset, remaining = line_path(total, coupled, free, 0.9).locate(position)

    unit = np.full(coupled, 1 / math.sqrt(coupled))
    residual = position[:coupled] - unit * (unit @ position[:coupled])
    bound = np.abs(position[coupled : total - free])
    assert offset == pytest.approx(max([np.linalg.norm(residual), *bound]), abs=1e-12)
    to_goal = unit @ (0.9 * np.ones(coupled) - position[:coupled])
    assert remaining == pytest.approx(max(to_goal, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("position", "offset", "remaining"),
    [
        ((0.6, 0.0), 0.1, 111 / 360 * 2 * math.pi * 0.7),
        ((0.0, 0.7), 0.0, (210 - 69) / 360 * 2 * math.pi * 0.7),
        ((-0.8, 0.0), 0.1, 51 / 360 * 2 * math.pi * 0.7),
        ((-0.5, -0.5 * math.sqrt(3)), 0.3, 0.0),
        ((0.0, 0.0), 0.7, None),
    ],
)
def test_circle_values(position, offset, remaining):
    found = PATHS["circle"].locate(position)
    assert found[0] == pytest.approx(offset)
    if remaining is not None:
        assert found[1] == pytest.approx(remaining, abs=1e-12)


def test_circle_starts_two_thirds_of_the_circumference_from_the_goal():
    path = circle_path(0.5)
    assert path.point(0.0) == pytest.approx([0.5, 0.0])
    assert np.mean(path.goal_arcs) == pytest.approx(2 / 3 * 2 * math.pi * 0.5)
    assert path.goal_arcs[1] - path.goal_arcs[0] == pytest.approx(2 * math.pi * 0.5 / 20)


@pytest.mark.parametrize(
    ("position", "offset", "arc"),
    [
        ((0.2, 0.1), 0.1, 0.2),
        ((0.6, 0.3), 0.1, 0.8),
        ((0.5, 0.0), 0.0, 0.5),
        ((0.6, -0.1), 0.1 * math.sqrt(2), 0.5),
        ((-0.3, 0.4), 0.5, 0.0),
        ((0.5, 0.9), 0.4, 0.95),
    ],
)
def test_spline_values(position, offset, arc):
    found = L_SHAPE.locate(position)
    assert found[0] == pytest.approx(offset)
    assert found[1] == pytest.approx(0.95 - arc, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=2, max_size=6, unique=True))
def test_spline_offset_is_the_least_distance_to_the_polyline(waypoints):
    points = np.array(waypoints)
    if np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 1e-3:
        return
    position = np.array([0.1, -0.3])
    offset, _ = spline_path(points).locate(position)
    shares = np.linspace(0.0, 1.0, 2001)[:, None]
    dense = np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(points)])
    least = np.linalg.norm(dense - position, axis=1).min()
    half_spacing = np.linalg.norm(np.diff(points, axis=0), axis=1).max() / 2000 / 2
    assert least - half_spacing - 1e-9 <= offset <= least + 1e-9


def test_polyline_contains_the_corners():
    points = L_SHAPE.polyline(0.0, 1.0)
    assert [0.5, 0.0] in points.tolist()
    assert points[0] == pytest.approx([0.0, 0.0])
    assert points[-1] == pytest.approx([0.5, 0.5])
