"""All registered densities in several dimensions."""

from __future__ import annotations

import pytest
import torch as th

from sb3_flowpolicy.distributions import ActionDistribution, registered_distributions
from sb3_flowpolicy.distributions.registry import make_distribution

DIMS = (1, 2, 3, 8, 17)
CONTEXT_DIM = 5


def build(name: str, action_dim: int, dtype: th.dtype = th.float64) -> ActionDistribution:
    """Build a density with random parameters, because an identity flow would prove nothing."""
    th.manual_seed(action_dim)
    density = make_distribution(name, action_dim, CONTEXT_DIM).to(dtype)
    with th.no_grad():
        for parameter in density.parameters():
            parameter.copy_(th.randn(parameter.shape, dtype=th.float64) * 0.3)
    return density


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "density" in metafunc.fixturenames:
        cases = [(name, dim) for name in registered_distributions() for dim in DIMS]
        metafunc.parametrize(
            "density", cases, ids=lambda case: f"{case[0]}-{case[1]}", indirect=True
        )


@pytest.fixture
def density(request: pytest.FixtureRequest) -> ActionDistribution:
    return build(*request.param)


@pytest.fixture
def context() -> th.Tensor:
    return th.randn(CONTEXT_DIM, dtype=th.float64, generator=th.Generator().manual_seed(1))
