"""Pictures of the two moons, with and without labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch as th
from matplotlib.colors import LinearSegmentedColormap

from sb3_flowpolicy.density.datasets import Sample, TwoMoons
from sb3_flowpolicy.density.figures import (
    BLUE,
    GREY,
    LABELS,
    ORANGE,
    PICTURE_SEED,
    curves_figure,
    draw_density,
    draw_points,
    grid_of_panels,
    layers_figure,
    picture,
    picture_noise,
    sample,
    save,
)
from sb3_flowpolicy.density.measure import Fitted, label_posterior
from sb3_flowpolicy.density.models import OurRealNVP
from sb3_flowpolicy.density.studies import Scale

# What is shown of the plane: standardised moons.
MOONS_EXTENT = 2.4


def draw_two_moons(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves (2.3), samples (2.4), densities (2.5) and layers (2.1)."""
    ours = fits[0]
    save(curves_figure(fits, ours.rows[0]["entropy"]), folder / "two-moons-curves.png")

    data, seed = TwoMoons(), ours.ensemble.seeds[ours.middle]
    scaler = ours.scalers[ours.middle]
    points = scaler.apply(data.draw(data.n_train, seed).points)
    middle = ((np.arange(scale.pixels) + 0.5) / scale.pixels * 2 - 1) * MOONS_EXTENT
    plane = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    raw = Sample(plane * scaler.scale + scaler.mean, np.zeros((len(plane), 0)))
    truth = np.exp(data.log_density(raw) + scaler.log_volume).reshape(scale.pixels, scale.pixels)
    for kind in ("samples", "density"):
        figure, panels = grid_of_panels(len(fits) + 2, 4)
        draw_density(panels[0], truth, MOONS_EXTENT, "true density")
        draw_points(panels[1], points, MOONS_EXTENT, "training data", GREY)
        for axes, fitted in zip(panels[2:], fits, strict=True):
            if kind == "samples":
                samples = sample(fitted, np.zeros((data.n_train, 0)))
                draw_points(axes, samples, MOONS_EXTENT, LABELS[fitted.model])
            else:
                model = fitted.ensemble.member(fitted.middle)
                density = picture(model, np.zeros(0), MOONS_EXTENT, scale.pixels)
                draw_density(axes, density, MOONS_EXTENT, LABELS[fitted.model])
        save(figure, folder / f"two-moons-{kind}.png")

    model = ours.ensemble.member(ours.middle)
    assert isinstance(model, OurRealNVP)
    noise = picture_noise(4000)
    images = [image.numpy() for image in model.after_each_layer(noise, th.zeros(4000, 0))]
    save(layers_figure(images, noise.numpy()), folder / "two-moons-layers.png")


def draw_label(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves, samples of both labels (2.7), and where each label is the likelier one."""
    fitted = fits[0]
    level = (0.5, "thesis: 0.5 nats within 250 epochs")
    save(curves_figure(fits, fitted.rows[0]["entropy"], level), folder / "label-curves.png")

    data, index = TwoMoons(labelled=True), fitted.middle
    train = data.draw(data.n_train, fitted.ensemble.seeds[index])
    points = fitted.scalers[index].apply(train.points)
    samples = sample(fitted, train.condition)
    colours = np.where(train.condition[:, 0] > 0.5, ORANGE, BLUE)
    figure, panels = grid_of_panels(3, 3, size=2.8)
    draw_points(panels[0], points, MOONS_EXTENT, "training data", colours)
    draw_points(panels[1], samples, MOONS_EXTENT, "RealNVP, given the label", colours)

    model = fitted.ensemble.member(index)
    middle = ((th.arange(scale.pixels) + 0.5) / scale.pixels * 2 - 1) * MOONS_EXTENT
    plane = th.cartesian_prod(middle, middle).flip(-1)
    posterior = label_posterior(lambda label: model(plane, label), plane.shape[:-1])
    axes, box = panels[2], (-MOONS_EXTENT, MOONS_EXTENT, -MOONS_EXTENT, MOONS_EXTENT)
    axes.imshow(
        posterior.reshape(scale.pixels, scale.pixels).numpy(),
        origin="lower",
        extent=box,
        cmap=LinearSegmentedColormap.from_list("labels", ["#cfe0f0", "#ffffff", "#f6d9c8"]),
        vmin=0,
        vmax=1,
    )
    fresh = data.draw(1000, PICTURE_SEED)
    x = th.from_numpy(fitted.scalers[index].apply(fresh.points)).float()
    likelier = label_posterior(lambda label: model(x, label), x.shape[:-1]).numpy() > 0.5
    wrong = likelier != (fresh.condition[:, 0] > 0.5)
    draw_points(
        axes,
        x.numpy(),
        MOONS_EXTENT,
        f"likelier label; {wrong.sum()} of {len(x)} new points wrong",
        np.where(fresh.condition[:, 0] > 0.5, ORANGE, BLUE),
    )
    axes.scatter(x[wrong, 0], x[wrong, 1], s=30, facecolors="none", edgecolors="black")
    save(figure, folder / "label-samples.png")
