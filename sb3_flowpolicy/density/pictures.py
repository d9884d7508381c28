"""Pictures of the studies: two moons with and without labels, and half circles that turn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from matplotlib.animation import FuncAnimation
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from scipy.stats import trim_mean

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.datasets import (
    TRAINING_ANGLES,
    AngleMoons,
    Sample,
    TwoMoons,
    angle_condition,
)
from sb3_flowpolicy.density.measure import Fitted, LogProb, label_posterior
from sb3_flowpolicy.density.models import FlowModel, OurRealNVP
from sb3_flowpolicy.density.studies import Scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Seed of the noise and of the new points.
PICTURE_SEED = 7
BLUE, ORANGE, GRAY = "#1f6fb4", "#d9662b", "#555555"
# Model -> its label and its color.
STYLES = {
    "realnvp": ("RealNVP (ours)", BLUE),
    "zuko-realnvp": ("RealNVP (zuko)", "#7fb2dc"),
    "maf": ("MAF", ORANGE),
    "maf-random": ("MAF, random orders", "#e9b08f"),
    "naf": ("NAF", "#3a923a"),
    "nsf": ("neural spline flow", "#8e5ea2"),
}
# Pictures show [-extent, extent]²: standardized moons, and half circles of radius 1.
MOONS_EXTENT, ANGLES_EXTENT = 2.4, 1.5
# Angles of the thesis's Fig. 2.9 and 2.10.
ANGLES = {"between": np.linspace(1.0, 1.2, 8), "outside": np.arange(8) * np.pi / 4}


def draw_two_moons(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves (2.3), samples (2.4), densities (2.5) and layers (2.1)."""
    ours, data = fits[0], TwoMoons()
    _save(_curves_figure(fits, ours.fits["entropy"][0]), folder / "two-moons-curves.png")
    scaler, train = ours.middle_data(data)
    plane = _pixel_centers(MOONS_EXTENT, scale.pixels).numpy().astype(float)
    raw = Sample(plane * scaler.scale + scaler.mean, np.zeros((len(plane), 0)))
    truth = np.exp(data.log_density(raw) + scaler.log_volume).reshape(scale.pixels, scale.pixels)
    for kind in ("samples", "density"):
        figure, panels = _grid_of_panels(len(fits) + 2, 4)
        _draw_density(panels[0], truth, MOONS_EXTENT, "true density")
        _draw_points(panels[1], scaler.apply(train.points), MOONS_EXTENT, "training data", GRAY)
        for axes, fitted in zip(panels[2:], fits, strict=True):
            model, label = fitted.middle_model(), STYLES[fitted.model][0]
            if kind == "samples":
                _draw_points(axes, _sample(model, train.condition), MOONS_EXTENT, label)
            else:
                density = density_picture(model, np.zeros(0), MOONS_EXTENT, scale.pixels)
                _draw_density(axes, density, MOONS_EXTENT, label)
        _save(figure, folder / f"two-moons-{kind}.png")
    _save(_layers_figure(ours.middle_model()), folder / "two-moons-layers.png")


def _curves_figure(fits: Sequence[Fitted], limit: float) -> Figure:
    """Draw likelihoods over epochs: every seed and the interquartile mean."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    titles = {"train": "training sample", "other": "sample not trained on"}
    for axes, (column, title) in zip(panels, titles.items(), strict=True):
        for fitted in fits:
            label, color = STYLES[fitted.model]
            nll = fitted.curves.pivot(index="epoch", columns="seed", values=column)
            axes.plot(nll, color=color, linewidth=0.5, alpha=0.35)
            axes.plot(nll.index, trim_mean(nll, 0.25, axis=1), color=color, label=label)
        axes.axhline(limit, color="black", linestyle="--", linewidth=1, label="entropy of the data")
        axes.set(xlabel="epoch", ylim=(limit - 0.15, limit + 1.0), title=title)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("negative log-likelihood, nats")
    panels[1].legend(frameon=False, fontsize=8)
    return figure


def _layers_figure(model: FlowModel) -> Figure:
    """Draw the base samples after each layer, colored by their quadrant."""
    assert isinstance(model, OurRealNVP)
    noise = _picture_noise(4000)
    images = [image.numpy() for image in model.after_each_layer(noise, th.zeros(4000, 0))]
    # One color per quadrant: lower left, upper left, lower right, upper right.
    right, up = (noise.numpy() >= 0).T
    colors = np.array(["#2e8b57", "#e0a030", "#2f6db5", "#c0392b"])[2 * right + up]
    figure, panels = _grid_of_panels(len(images), 3)
    titles = {0: "base: standard normal", len(images) - 1: "after layer 8: two moons"}
    for index, (axes, points) in enumerate(zip(panels, images, strict=True)):
        # Layers in between may shift and stretch all points: zoom each panel to its points.
        x, y = points.mean(0)
        extent = 1.05 * np.quantile(np.abs(points - [x, y]), 0.995)
        axes.scatter(points[:, 0], points[:, 1], s=1.5, c=colors, linewidths=0, rasterized=True)
        axes.set(xlim=(x - extent, x + extent), ylim=(y - extent, y + extent))
        axes.set_title(titles.get(index, f"after layer {index}"), fontsize=8)
    return figure


def draw_label(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw samples of both labels (2.7), and the probability of each label."""
    (fitted,) = fits
    data, model = TwoMoons(labeled=True), fitted.middle_model()
    scaler, train = fitted.middle_data(data)
    colors = np.where(train.condition[:, 0] > 0.5, ORANGE, BLUE)
    figure, panels = _grid_of_panels(3, 3, size=2.8)
    _draw_points(panels[0], scaler.apply(train.points), MOONS_EXTENT, "training data", colors)
    samples = _sample(model, train.condition)
    _draw_points(panels[1], samples, MOONS_EXTENT, "RealNVP, given the label", colors)

    posterior = label_posterior(model, _pixel_centers(MOONS_EXTENT, scale.pixels)).numpy()
    colormap = LinearSegmentedColormap.from_list("labels", ["#cfe0f0", "#ffffff", "#f6d9c8"])
    image = posterior.reshape(scale.pixels, scale.pixels)
    _draw_image(panels[2], image, MOONS_EXTENT, colormap)
    fresh = data.draw(1000, PICTURE_SEED)
    x, second = scaler.apply(fresh.points), fresh.condition[:, 0] > 0.5
    wrong = (label_posterior(model, th.from_numpy(x).float()).numpy() > 0.5) != second
    title = f"more likely label; {wrong.sum()} of {len(x)} new points wrong"
    _draw_points(panels[2], x, MOONS_EXTENT, title, np.where(second, ORANGE, BLUE))
    panels[2].scatter(x[wrong, 0], x[wrong, 1], s=30, facecolors="none", edgecolors="black")
    _save(figure, folder / "label-samples.png")


def draw_angles(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw likelihood over the angle, samples (2.8), and densities (2.9, 2.10)."""
    (fitted,) = fits
    _save(_angle_nll_figure(fitted), folder / "angles-likelihood.png")

    model, (_, train) = fitted.middle_model(), fitted.middle_data(AngleMoons())
    color = np.arctan2(train.condition[:, 0], train.condition[:, 1])
    samples = _sample(model, train.condition)
    figure, panels = _grid_of_panels(2, 2, size=2.8)
    _draw_points(panels[0], train.points, ANGLES_EXTENT, "training data, 22 angles", color)
    _draw_points(panels[1], samples, ANGLES_EXTENT, "RealNVP, given the angle", color)
    _save(figure, folder / "angles-samples.png")

    for name, angles in ANGLES.items():
        figure, panels = _grid_of_panels(8, 4)
        for axes, angle in zip(panels, angles, strict=True):
            kind = "between" if angle < TRAINING_ANGLES[-1] else "outside"
            if np.abs(TRAINING_ANGLES - angle).min() < 1e-6:
                kind = "trained"
            _draw_angle(axes, model, angle, scale.pixels, f"{angle:.2f} rad, {kind}")
        _save(figure, folder / f"angles-{name}.png")
    _animate(model, folder / "angles.gif", scale)


def _draw_angle(axes: Axes, model: FlowModel, angle: float, pixels: int, title: str) -> None:
    """Draw the density given an angle, and mark both tips of the true half circle."""
    density = density_picture(model, angle_condition(np.asarray(angle)), ANGLES_EXTENT, pixels)
    _draw_density(axes, density, ANGLES_EXTENT, title)
    tips = np.array([angle, angle + np.pi])
    axes.plot(np.cos(tips), np.sin(tips), "+", color="#7fd4ff", markersize=5, markeredgewidth=0.8)


def _angle_nll_figure(fitted: Fitted) -> Figure:
    """Draw the held-out likelihood over the angle, for every seed."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    wide, close = figure.subplots(1, 2, width_ratios=(1.4, 1))
    nll = fitted.angles.pivot(index="angle", columns="seed", values="nll")
    median, limit = nll.median(axis=1), fitted.fits["entropy"][0]
    for axes in (wide, close):
        axes.plot(nll, color=BLUE, linewidth=0.5, alpha=0.4)
        axes.plot(median, color=BLUE, label="median of the seeds")
        axes.axhline(limit, color="black", linestyle="--", linewidth=1, label="entropy of the data")
        axes.axvspan(0, 2.1, color="#000000", alpha=0.06, linewidth=0, label="trained range")
        axes.set(xlabel="angle, radian")
        axes.spines[["top", "right"]].set_visible(False)
    for kind, marker in (("trained", "o"), ("between", "x")):
        own = median[fitted.angles.loc[fitted.angles["kind"] == kind, "angle"].unique()]
        close.plot(own, marker, color=BLUE, markersize=4, label=f"{kind} angles, median")
    wide.set(ylabel="held-out NLL, nats", yscale="symlog", title="full circle")
    wide.set_ylim(bottom=limit - 0.5)
    close.set(xlim=(-0.1, 2.2), ylim=(limit - 0.05, limit + 0.4), title="trained range, enlarged")
    close.legend(frameon=False, fontsize=7)
    return figure


def _animate(model: FlowModel, path: Path, scale: Scale) -> None:
    """Turn the condition by a full circle; the title says whether the angle was trained."""
    figure, (axes,) = _grid_of_panels(1, 1, size=2.4)

    def draw(frame: int) -> None:
        axes.clear()
        axes.set(xticks=[], yticks=[])
        angle = 2 * np.pi * frame / scale.frames
        state = "within the trained range" if angle <= TRAINING_ANGLES[-1] else "never trained"
        _draw_angle(axes, model, angle, scale.pixels // 2, f"{angle:.1f} rad, {state}")

    with replacing(path) as draft:
        animation = FuncAnimation(figure, draw, scale.frames, init_func=lambda: None, interval=120)
        animation.save(draft, writer="pillow", dpi=90)


def _grid_of_panels(n_panels: int, n_columns: int, size: float = 2.1) -> tuple[Figure, list[Axes]]:
    """Return a figure of full rows of square panels without ticks."""
    n_rows = n_panels // n_columns
    figure = Figure(figsize=(size * n_columns, (size + 0.25) * n_rows), layout="constrained")
    bare = {"xticks": [], "yticks": [], "aspect": "equal"}
    return figure, list(figure.subplots(n_rows, n_columns, squeeze=False, subplot_kw=bare).flat)


def _draw_points(
    axes: Axes, points: np.ndarray, extent: float, title: str, color: str | np.ndarray = BLUE
) -> None:
    """Scatter points (N, 2); those outside [-extent, extent] are counted in the title."""
    outside = int((np.abs(points) > extent).any(axis=1).sum())
    axes.scatter(points[:, 0], points[:, 1], s=2.0, c=color, linewidths=0, rasterized=True)
    axes.set(xlim=(-extent, extent), ylim=(-extent, extent))
    axes.set_title(title + (f" ({outside} outside)" if outside else ""), fontsize=8)


def _draw_density(axes: Axes, density: np.ndarray, extent: float, title: str) -> None:
    """Draw the square root of a density as brightness, so that thin bridges stay visible.

    The brightest percent of the pixels may saturate.
    """
    bright = np.quantile(density[density > density.max() * 1e-3], 0.99)
    _draw_image(axes, np.sqrt(np.minimum(density / bright, 1)), extent, "magma")
    axes.set_title(title, fontsize=8)


def _draw_image(
    axes: Axes, image: np.ndarray, extent: float, colormap: str | LinearSegmentedColormap
) -> None:
    box = (-extent, extent, -extent, extent)
    axes.imshow(image, origin="lower", extent=box, cmap=colormap, vmin=0, vmax=1)


@th.no_grad()
def density_picture(
    log_prob: LogProb, condition: np.ndarray, extent: float, pixels: int
) -> np.ndarray:
    """Evaluate p(. | condition) at the pixel centers of a square, from the lowest y and x up."""
    points = _pixel_centers(extent, pixels)
    log_p = log_prob(points, th.from_numpy(condition).float().expand(len(points), -1))
    return log_p.exp().reshape(pixels, pixels).numpy()


def _pixel_centers(extent: float, pixels: int) -> th.Tensor:
    """Return the centers of the pixels of a square, row by row from the lowest: (pixels², 2)."""
    center = ((th.arange(pixels) + 0.5) / pixels * 2 - 1) * extent
    return th.cartesian_prod(center, center).flip(-1)


def _picture_noise(n: int) -> th.Tensor:
    """Return the same standard normal noise (n, 2) for every picture."""
    return th.randn(n, 2, generator=th.Generator().manual_seed(PICTURE_SEED))


@th.no_grad()
def _sample(model: FlowModel, condition: np.ndarray) -> np.ndarray:
    """Draw one point per condition: (N, C) -> (N, 2)."""
    return model.sample(_picture_noise(len(condition)), th.from_numpy(condition).float()).numpy()


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as draft:
        figure.savefig(draft, dpi=110, format="png", pil_kwargs={"optimize": True})


# Study -> what draws its pictures.
DRAW = {
    "two-moons": draw_two_moons,
    "two-moons-label": draw_label,
    "angle-moons": draw_angles,
}
