"""Ensembles equal their members, fits improve, densities integrate to one."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_flowpolicy.density.fit import Data, Ensemble, fit, mean_nll
from sb3_flowpolicy.density.measure import integral
from sb3_flowpolicy.density.models import (
    HIDDEN,
    LAYERS,
    MODELS,
    FlowModel,
    OurRealNVP,
    make_model,
)
from sb3_flowpolicy.density.pictures import density_picture

SEEDS = [0, 1, 2]


def shifted_normal(n: int, seed: int, condition_dim: int = 0) -> Data:
    """Samples of three seeds from a narrow normal away from the origin."""
    generator = th.Generator().manual_seed(seed)
    points = 0.5 * th.randn(3, n, 2, generator=generator) + th.tensor([1.0, -1.0])
    return Data(points, th.rand(3, n, condition_dim, generator=generator))


def shake(model: FlowModel, scale: float = 0.2) -> FlowModel:
    """Change all weights, since an identity flow would pass any test."""
    generator = th.Generator().manual_seed(1)
    with th.no_grad():
        for parameter in model.parameters():
            parameter += scale * th.randn(parameter.shape, generator=generator)
    return model


@pytest.mark.parametrize("condition_dim", [0, 2])
@pytest.mark.parametrize("name", MODELS)
def test_an_ensemble_scores_as_its_members_do(name: str, condition_dim: int) -> None:
    ensemble, data = Ensemble(name, condition_dim, SEEDS), shifted_normal(30, 0, condition_dim)
    with th.no_grad():
        together = ensemble.log_prob(data.points, data.condition)
        for i in range(len(SEEDS)):
            alone = ensemble.member(i)(data.points[i], data.condition[i])
            th.testing.assert_close(together[i], alone, rtol=1e-4, atol=1e-4)
    if name != "realnvp":  # ours starts as the identity, whatever the seed
        assert not th.allclose(together[0], together[1])


@pytest.mark.parametrize("name", MODELS)
def test_fits_improve(name: str) -> None:
    ensemble, train, validation = (
        Ensemble(name, 0, SEEDS),
        shifted_normal(60, 0),
        shifted_normal(60, 1),
    )
    before = mean_nll(ensemble, validation)
    curves = fit(ensemble, train, validation, epochs=6, check_every=2)
    after = mean_nll(ensemble, validation)
    assert (after < before).all()
    # The weights with the best validation are kept.
    best = th.from_numpy(curves.groupby("seed")["other"].min().to_numpy()).float()
    th.testing.assert_close(after, best)
    assert curves["epoch"].tolist() == [2, 4, 6] * 3


def test_seeds_are_independent() -> None:
    """With the same order of points, clipping and averaging act on each seed separately."""
    train, validation = shifted_normal(50, 0), shifted_normal(50, 1)
    wild = Data(train.points.clone(), train.condition)
    wild.points[1:] *= 100
    nll = []
    for data in (train, wild):
        ensemble = Ensemble("realnvp", 0, SEEDS)
        fit(ensemble, data, validation, epochs=5, check_every=1)
        nll.append(mean_nll(ensemble, validation))
    th.testing.assert_close(nll[0][0], nll[1][0])
    assert not th.isclose(nll[0][1], nll[1][1])


def test_fitting_is_reproducible() -> None:
    weights = []
    for _ in range(2):
        ensemble = Ensemble("realnvp", 0, SEEDS)
        fit(ensemble, shifted_normal(50, 0), shifted_normal(50, 1), epochs=3)
        weights.append(ensemble.weights)
    for key, value in weights[0].items():
        th.testing.assert_close(value, weights[1][key], rtol=0, atol=0)


@pytest.mark.parametrize("name", ["realnvp", "zuko-realnvp", "maf", "nsf"])
def test_densities_integrate_to_one(name: str) -> None:
    model = shake(make_model(name, 2, seed=0))
    assert integral(model, th.tensor([0.3, -1.0]), cells=300) == pytest.approx(1, abs=0.01)


def test_a_wrong_log_determinant_is_detected() -> None:
    def wrong(points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        return -0.5 * points.square().sum(-1) - math.log(2 * math.pi) + 0.1

    assert integral(wrong, th.zeros(0), cells=100) == pytest.approx(math.exp(0.1), rel=1e-4)


def test_naf_loses_mass_before_training() -> None:
    """Its layers do not reach the whole plane, which is why integrals are reported."""
    assert integral(make_model("naf", 0, seed=0).eval(), th.zeros(0), cells=100) < 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_naf_does_not_squash_the_plane_from_the_start(seed: int) -> None:
    """zuko's own initial weights do, by five orders of magnitude."""
    naf: Any = make_model("naf", 0, seed)
    untouched = type(naf.flow)(
        2, transforms=LAYERS, hidden_features=HIDDEN, network={"hidden_features": (16,)}
    )
    points = th.randn(500, 2, generator=th.Generator().manual_seed(seed))
    assert untouched().transform(points).std(0).max() < 1e-3
    assert naf.flow().transform(points).std(0).min() > 0.02


@pytest.mark.parametrize("condition_dim", [0, 1])
def test_layers_end_at_the_sample(condition_dim: int) -> None:
    model = shake(make_model("realnvp", condition_dim, seed=0))
    assert isinstance(model, OurRealNVP)
    noise, condition = th.randn(20, 2), th.rand(20, condition_dim)
    images = model.after_each_layer(noise, condition)
    assert len(images) == LAYERS + 1
    assert th.equal(images[0], noise)
    th.testing.assert_close(images[-1], model.sample(noise, condition).detach())
    # The layers move the two coordinates alternately.
    for layer, (before, after) in enumerate(pairwise(images)):
        assert th.equal(before[:, layer % 2], after[:, layer % 2])
        assert not th.equal(before[:, 1 - layer % 2], after[:, 1 - layer % 2])


@pytest.mark.parametrize("name", ["zuko-realnvp", "maf", "nsf"])
def test_samples_follow_the_density(name: str) -> None:
    """The density of a sample is that of its noise divided by the change of volume."""
    model = shake(make_model(name, 1, seed=0)).double()
    noise, condition = th.randn(4, 2, dtype=th.float64), th.rand(4, 1, dtype=th.float64)
    points = model.sample(noise, condition)
    for i in range(4):
        jacobian = th.autograd.functional.jacobian(
            lambda z, i=i: model.sample(z[None], condition[i : i + 1])[0], noise[i]
        )
        expected = -0.5 * noise[i].square().sum() - math.log(2 * math.pi)
        expected = expected - jacobian.det().abs().log()
        scored = model(points[i : i + 1], condition[i : i + 1])[0]
        th.testing.assert_close(scored, expected, rtol=1e-4, atol=1e-4)


def test_density_picture_has_y_upwards() -> None:
    def shifted(points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        centered = points - th.tensor([0.0, 1.0])
        return -0.5 * centered.square().sum(-1) - math.log(2 * math.pi)

    image = density_picture(shifted, np.zeros(0), extent=2.0, pixels=4)
    center = np.array([-1.5, -0.5, 0.5, 1.5])
    expected = np.exp(-0.5 * ((center[:, None] - 1) ** 2 + center**2)) / (2 * np.pi)
    np.testing.assert_allclose(image, expected, rtol=1e-5)
