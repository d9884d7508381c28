"""RealNVP against an independent flow library, and its parts."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from zuko.flows.coupling import GeneralCouplingTransform
from zuko.transforms import MonotonicAffineTransform

from sb3_flowpolicy.distributions import RealNVP
from sb3_flowpolicy.distributions.coupling import split_order
from sb3_flowpolicy.distributions.realnvp import LOG_SCALE_BOUND
from tests.distributions.conftest import CONTEXT_DIM, build


def as_zuko(flow: RealNVP) -> list[GeneralCouplingTransform]:
    """Build the same couplings, weight by weight, from zuko's transforms, from noise to action."""
    slope = math.exp(-LOG_SCALE_BOUND)
    weights = flow.context_proj.weight.chunk(flow.layers)
    biases = flow.context_proj.bias.chunk(flow.layers)
    transforms = []
    for index, pair in enumerate(flow.pairs):
        order, n_first = split_order(flow.action_dim, index)
        for turn, coupling in enumerate(pair.couplings):
            read = order[:n_first] if turn == 0 else order[n_first:]
            mask = th.zeros(flow.action_dim, dtype=th.bool)
            mask[read] = True
            transform = GeneralCouplingTransform(
                flow.action_dim,
                CONTEXT_DIM,
                mask,
                univariate=partial(MonotonicAffineTransform, slope=slope),
                hidden_features=flow.hidden,
            ).double()
            linears = [m for m in transform.hyper if hasattr(m, "weight")]
            layer = len(transforms)
            active = flow.action_dim - len(read)
            with th.no_grad():
                # We order by halves, zuko by coordinates: sort the input columns.
                by_coordinate = th.tensor(read).argsort()
                assert coupling.first is not None
                first = coupling.first.weight[:, by_coordinate]
                linears[0].weight.copy_(th.cat([first, weights[layer]], dim=1))
                linears[0].bias.copy_(biases[layer])
                between = [m for m in coupling.between if isinstance(m, th.nn.Linear)]
                for theirs, ours in zip(linears[1:-1], between, strict=True):
                    theirs.load_state_dict(ours.state_dict())
                # zuko interleaves (shift, scale) per coordinate.
                moved = th.tensor([i for i in order if i not in read]).argsort()
                rows = th.stack([moved, moved + active], dim=1).flatten()
                linears[-1].weight.copy_(coupling.last.weight[rows])
                linears[-1].bias.copy_(coupling.last.bias[rows])
            transforms.append(transform)
    return transforms


@pytest.mark.parametrize("dim", [2, 3, 8, 17])
def test_equals_zuko_given_the_same_weights(dim: int) -> None:
    flow = build("realnvp", dim)
    assert isinstance(flow, RealNVP)
    context = th.randn(11, CONTEXT_DIM, dtype=th.float64)
    noise = th.randn(11, dim, dtype=th.float64)
    u, log_prob = flow.rsample_and_log_prob(context, noise)
    value = noise
    expected = th.distributions.Normal(0.0, 1.0).log_prob(noise).sum(-1)
    for transform in as_zuko(flow):
        value, ladj = transform(context).call_and_ladj(value)
        expected = expected - ladj
    th.testing.assert_close(u, value)
    th.testing.assert_close(log_prob, expected)


def test_identity_init_is_a_standard_normal_for_every_context() -> None:
    flow = RealNVP(3, CONTEXT_DIM, init="identity")
    noise = th.randn(50, 3)
    u, log_prob = flow.rsample_and_log_prob(th.randn(50, CONTEXT_DIM) * 10, noise)
    assert th.equal(u, noise)
    th.testing.assert_close(log_prob, th.distributions.Normal(0.0, 1.0).log_prob(noise).sum(-1))


def test_default_init_is_not_the_identity() -> None:
    flow = RealNVP(3, CONTEXT_DIM, init="default")
    noise = th.randn(50, 3)
    assert not th.allclose(flow.rsample_and_log_prob(th.zeros(50, CONTEXT_DIM), noise)[0], noise)


@pytest.mark.parametrize("layers", [1, 2, 3, 5])
@pytest.mark.parametrize("hidden", [(4,), (4, 4), (8, 6, 4)])
@pytest.mark.parametrize("dim", [1, 2, 5])
def test_every_shape_inverts(dim: int, layers: int, hidden: tuple[int, ...]) -> None:
    th.manual_seed(0)
    flow = RealNVP(dim, CONTEXT_DIM, layers=layers, hidden=hidden, init="default").double()
    assert sum(len(pair.couplings) for pair in flow.pairs) == layers
    context = th.randn(9, CONTEXT_DIM, dtype=th.float64)
    u, log_prob = flow.rsample_and_log_prob(context, th.randn(9, dim, dtype=th.float64))
    th.testing.assert_close(flow.log_prob(context, u), log_prob)


def test_the_flow_bends_where_a_normal_cannot() -> None:
    """Fitted to a parabola, the flow is far better than the best normal distribution."""
    th.manual_seed(0)
    x = th.randn(2000, 1)
    data = th.cat([x, x.square() + 0.1 * th.randn(2000, 1)], dim=1)
    normal = th.distributions.MultivariateNormal(data.mean(0), th.cov(data.T))
    flow = RealNVP(2, 1)
    optimizer = th.optim.Adam(flow.parameters(), lr=1e-2)
    for _ in range(300):
        loss = -flow.log_prob(th.zeros(1, 1), data).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert -loss.item() > normal.log_prob(data).mean().item() + 0.5


@given(features=st.integers(2, 64))
def test_any_two_coordinates_meet_in_different_halves(features: int) -> None:
    n_splits = math.ceil(math.log2(features))
    together = set()
    for index in range(n_splits):
        order, n_first = split_order(features, index)
        assert sorted(order) == list(range(features))
        assert 1 <= n_first < features
        halves = (order[:n_first], order[n_first:])
        pairs = {(i, j) for half in halves for i in half for j in half if i < j}
        together = pairs if index == 0 else together & pairs
    assert together == set()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"layers": 0}, "layers must be an integer of at least 1, got 0"),
        ({"hidden": ()}, "hidden must be a list of one or more layer sizes"),
        ({"hidden": 10}, "hidden must be a list of one or more layer sizes, got 10"),
        ({"hidden": (10, 0)}, "hidden must be an integer of at least 1, got 0"),
        ({"init": "zeros"}, "init must be one of .*'identity', 'default'.*, got 'zeros'"),
    ],
)
def test_bad_arguments(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RealNVP(2, 3, **kwargs)
