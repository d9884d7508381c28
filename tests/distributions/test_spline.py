"""The spline flow against an independent library, and its splines at knots and edges."""

from __future__ import annotations

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from zuko.transforms import MonotonicRQSTransform

from sb3_flowpolicy.distributions import Spline
from sb3_flowpolicy.distributions.spline import BOUND, MIN_SLOPE, SplineCoupling
from tests.distributions.conftest import CONTEXT_DIM, build


def coupling(active: int, bins: int) -> SplineCoupling:
    return SplineCoupling(passive=1, active=active, hidden=(4,), bins=bins)


def outputs(active: int, bins: int, n: int, scale: float) -> th.Tensor:
    generator = th.Generator().manual_seed(bins)
    shape = (n, active * (3 * bins - 1))
    return scale * th.randn(shape, dtype=th.float64, generator=generator)


@pytest.mark.parametrize("active", [1, 3])
@pytest.mark.parametrize("bins", [2, 5, 8])
@pytest.mark.parametrize("scale", [0.0, 1.0, 30.0])
def test_equals_zuko_given_the_same_outputs(active: int, bins: int, scale: float) -> None:
    raw = outputs(active, bins, 400, scale)
    parts = raw.unflatten(-1, (active, -1)).split([bins, bins, bins - 1], dim=-1)
    peer = MonotonicRQSTransform(*parts, bound=BOUND, slope=MIN_SLOPE)
    ours = coupling(active, bins)
    x = 3 * th.randn(400, active, dtype=th.float64)
    assert (x.abs() > BOUND).any()
    moved, ladj = ours.move(x, raw)
    expected, expected_ladj = peer.call_and_ladj(x)
    th.testing.assert_close(moved, expected)
    th.testing.assert_close(ladj, expected_ladj, rtol=1e-5, atol=1e-7)
    back, back_ladj = ours.move_back(moved, raw)
    th.testing.assert_close(back, x)
    th.testing.assert_close(back_ladj, ladj, rtol=1e-4, atol=1e-5)


@given(
    value=st.floats(-BOUND, BOUND),
    bins=st.integers(2, 12),
    scale=st.floats(0, 50),
    dtype=st.sampled_from([th.float32, th.float64]),
)
def test_splines_rise_invert_and_stay_within(
    value: float, bins: int, scale: float, dtype: th.dtype
) -> None:
    raw = outputs(1, bins, 1, scale).to(dtype)
    ours = coupling(1, bins)
    x = th.tensor([[value]], dtype=dtype)
    moved, ladj = ours.move(x, raw)
    back, _ = ours.move_back(moved, raw)
    assert ladj.isfinite().all()
    assert moved.abs().item() <= BOUND * (1 + 1e-6)
    # The effect on the inverse of rounding a point in between.
    carried = 1 + (-ladj).exp().item()
    slack = 1e-5 if dtype == th.float32 else 1e-12
    assert abs(back.item() - x.item()) <= slack * carried * BOUND


def test_knots_and_edges_belong_to_the_curve() -> None:
    """The spline and its slope are continuous at knots."""
    raw = outputs(1, 6, 1, 2.0)
    ours = coupling(1, 6)
    grid = th.linspace(-BOUND - 0.1, BOUND + 0.1, 200_001, dtype=th.float64).unsqueeze(-1)
    moved, ladj = ours.move(grid, raw)
    steps = moved.diff(dim=0)
    assert (steps > 0).all()
    slope = steps / grid.diff(dim=0)
    middle = 0.5 * (ladj[1:].exp() + ladj[:-1].exp())
    th.testing.assert_close(slope, middle, rtol=1e-2, atol=1e-3)


def test_ends_are_fixed_and_beyond_them_nothing_moves() -> None:
    raw = outputs(2, 8, 3, 5.0)
    ours = coupling(2, 8)
    for value in (-1e12, -BOUND - 1e-9, -BOUND, BOUND, BOUND + 1e-9, 1e12):
        x = th.full((3, 2), value, dtype=th.float64)
        for method in (ours.move, ours.move_back):
            moved, ladj = method(x, raw)
            assert th.equal(moved, x)
            assert th.equal(ladj, th.zeros_like(ladj))


@pytest.mark.parametrize("scale", [1e2, 1e10, 1e30])
def test_extreme_outputs_leave_numbers(scale: float) -> None:
    """Slopes alternate between their bounds, in float32; points on both sides of each knot."""
    bins = 8
    raw = outputs(1, bins, 5000, scale).float().requires_grad_()
    ours = coupling(1, bins)
    starts = ours._bin_of(th.linspace(-BOUND, BOUND, 5000).unsqueeze(-1), raw, by_height=False)[0]
    at_knots = starts.detach()
    for x in (at_knots, th.nextafter(at_knots, at_knots + 1), th.nextafter(at_knots, at_knots - 1)):
        for method in (ours.move, ours.move_back):
            moved, ladj = method(x, raw)
            assert moved.isfinite().all()
            assert ladj.isfinite().all()
            (gradient,) = th.autograd.grad(moved.sum() + ladj.sum(), raw)
            assert gradient.isfinite().all()


def test_starts_as_a_standard_normal_for_every_context() -> None:
    flow = Spline(3, CONTEXT_DIM)
    noise = 2 * th.randn(500, 3)
    u, log_prob = flow.rsample_and_log_prob(th.randn(500, CONTEXT_DIM) * 10, noise)
    th.testing.assert_close(u, noise, rtol=0, atol=1e-5)
    expected = th.distributions.Normal(0.0, 1.0).log_prob(noise).sum(-1)
    th.testing.assert_close(log_prob, expected, rtol=0, atol=1e-4)


def test_one_dimension_can_have_two_modes() -> None:
    """Fitted to two peaks, the flow is far better than the best normal distribution."""
    th.manual_seed(0)
    data = 2 * th.randint(0, 2, (2000, 1)) - 1 + 0.2 * th.randn(2000, 1)
    normal = th.distributions.Normal(data.mean(), data.std()).log_prob(data).mean().item()
    flow = Spline(1, 1)
    optimizer = th.optim.Adam(flow.parameters(), lr=1e-2)
    for _ in range(200):
        loss = -flow.log_prob(th.zeros(1, 1), data).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert -loss.item() > normal + 0.5


def test_far_away_points_score_as_a_normal_would() -> None:
    flow = build("spline", 2)
    far = th.full((1, 2), 8.0, dtype=th.float64)
    expected = th.distributions.Normal(0.0, 1.0).log_prob(far).sum(-1)
    th.testing.assert_close(flow.log_prob(th.zeros(1, CONTEXT_DIM).double(), far), expected)


@pytest.mark.parametrize("bins", [1, 4.0])
def test_bad_numbers_of_bins(bins: float) -> None:
    with pytest.raises(ValueError, match=f"bins must be an integer of at least 2, got {bins}"):
        Spline(2, 3, bins=bins)  # type: ignore[arg-type]
