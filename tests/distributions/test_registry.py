"""The registry: known names, refusals, and densities of third parties."""

from __future__ import annotations

from typing import Any

import pytest

from sb3_flowpolicy.distributions import (
    DiagGaussian,
    RealNVP,
    make_distribution,
    register_distribution,
    registered_distributions,
    registry,
)


class Mine(DiagGaussian):
    """A third party's density."""


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"distribution must be one of .*'full_cov.*got 'nvp'"):
        make_distribution("nvp", 2, 3)


def test_kwargs_reach_the_density() -> None:
    flow = make_distribution("realnvp", 2, 3, layers=6, hidden=[8, 8])
    assert isinstance(flow, RealNVP)
    assert (flow.layers, flow.hidden) == (6, (8, 8))


def test_register_and_build(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_REGISTRY", registered_distributions())
    register_distribution("mine", Mine)
    register_distribution("mine", Mine)  # registering twice is allowed
    assert type(make_distribution("mine", 2, 3)) is Mine


def test_names_are_not_stolen() -> None:
    with pytest.raises(ValueError, match='name "realnvp" is taken by RealNVP'):
        register_distribution("realnvp", Mine)


@pytest.mark.parametrize(("name", "kind"), [("mine", int), (5, Mine), ("mine", Mine(2, 3))])
def test_only_densities_are_registered(name: Any, kind: Any) -> None:
    with pytest.raises(TypeError):
        register_distribution(name, kind)
