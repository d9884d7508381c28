"""Panels of the chapter's pictures. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import trim_mean

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.measure import CHUNK, Fitted
from sb3_flowpolicy.density.models import FlowModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Seed of the noise and of the new points in pictures.
PICTURE_SEED = 7
DPI = 110

BLUE, ORANGE, GREY = "#1f6fb4", "#d9662b", "#555555"
COLORS = {
    "realnvp": BLUE,
    "zuko-realnvp": "#7fb2dc",
    "maf": ORANGE,
    "maf-random": "#e9b08f",
    "naf": "#3a923a",
    "nsf": "#8e5ea2",
}
LABELS = {
    "realnvp": "RealNVP (ours)",
    "zuko-realnvp": "RealNVP (zuko)",
    "maf": "MAF",
    "maf-random": "MAF, random orders",
    "naf": "NAF",
    "nsf": "neural spline flow",
}
# One color per quadrant of the base distribution, counter-clockwise from the upper right.
QUADRANTS = ("#c0392b", "#e0a030", "#2e8b57", "#2f6db5")


def grid_of_panels(n_panels: int, n_columns: int, size: float = 2.1) -> tuple[Figure, list[Axes]]:
    """Return a figure of square panels without ticks, filled row by row."""
    n_rows = -(-n_panels // n_columns)
    figure = Figure(figsize=(size * n_columns, (size + 0.25) * n_rows), layout="constrained")
    panels = [figure.add_subplot(n_rows, n_columns, i + 1) for i in range(n_panels)]
    for axes in panels:
        axes.set(xticks=[], yticks=[], aspect="equal")
    return figure, panels


def draw_points(
    axes: Axes, points: np.ndarray, extent: float, title: str, color: str | np.ndarray = BLUE
) -> None:
    """Scatter points (N, 2); those outside [-extent, extent] are counted in the title."""
    outside = int((np.abs(points) > extent).any(axis=1).sum())
    axes.scatter(points[:, 0], points[:, 1], s=2.0, c=color, linewidths=0, rasterized=True)
    axes.set(xlim=(-extent, extent), ylim=(-extent, extent))
    axes.set_title(title + (f" ({outside} outside)" if outside else ""), fontsize=8)


def draw_density(axes: Axes, density: np.ndarray, extent: float, title: str) -> None:
    """Draw the square root of a density as brightness, so that thin bridges stay visible.

    The brightest percent of the pixels may saturate.
    """
    bright = np.quantile(density[density > density.max() * 1e-3], 0.99)
    box = (-extent, extent, -extent, extent)
    image = np.sqrt(np.minimum(density / bright, 1))
    axes.imshow(image, origin="lower", extent=box, cmap="magma", vmin=0, vmax=1)
    axes.set_title(title, fontsize=8)


@th.no_grad()
def density_picture(
    model: FlowModel, condition: np.ndarray, extent: float, pixels: int
) -> np.ndarray:
    """Evaluate a density at the pixel centers of the square [-extent, extent]².

    Args:
        model: The density.
        condition: Its condition, shape (C,).
        extent: Half the width of the picture.
        pixels: Pixels per side.

    Returns:
        Densities, shape (pixels, pixels), from the lowest y and x up.
    """
    scores = [
        model(points, th.from_numpy(condition).float().expand(len(points), -1))
        for points in pixel_centers(extent, pixels).split(CHUNK)
    ]
    return th.cat(scores).exp().reshape(pixels, pixels).numpy()


def pixel_centers(extent: float, pixels: int) -> th.Tensor:
    """Return the centers of the pixels of a square, row by row from the lowest: (pixels², 2)."""
    center = ((th.arange(pixels) + 0.5) / pixels * 2 - 1) * extent
    return th.cartesian_prod(center, center).flip(-1)


def curves_figure(
    fits: Sequence[Fitted], limit: float, line: tuple[float, str] | None = None
) -> Figure:
    """Draw likelihoods over epochs (thesis Fig. 2.3): every seed and the interquartile mean.

    Args:
        fits: One per model.
        limit: Entropy of the data in nats.
        line: A level to compare with, and its label.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, title in ((left, "training sample"), (right, "sample not trained on")):
        for fitted in fits:
            curves = fitted.curves
            nll = (curves.train if axes is left else curves.validation).numpy()
            color = COLORS[fitted.model]
            axes.plot(curves.epoch, nll, color=color, linewidth=0.5, alpha=0.35)
            middle = trim_mean(nll, 0.25, axis=1)
            axes.plot(curves.epoch, middle, color=color, label=LABELS[fitted.model])
        axes.axhline(limit, color="black", linestyle="--", linewidth=1)
        axes.annotate(
            "entropy of the data: no model can be lower",
            (0.98, limit),
            (0, -4),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="right",
            va="top",
            fontsize=7,
        )
        if line is not None:
            axes.axhline(line[0], color=GREY, linestyle=":", linewidth=1)
            axes.annotate(
                line[1],
                (0.02, line[0]),
                (0, 3),
                xycoords=("axes fraction", "data"),
                textcoords="offset points",
                fontsize=7,
                color=GREY,
            )
        axes.set(xlabel="epoch", ylim=(limit - 0.15, limit + 1.0), title=title)
        axes.spines[["top", "right"]].set_visible(False)
    left.set_ylabel("negative log-likelihood, nats")
    right.legend(frameon=False, fontsize=8)
    return figure


def layers_figure(images: Sequence[np.ndarray], start: np.ndarray) -> Figure:
    """Draw the base samples after each layer, colored by their quadrant (thesis Fig. 2.1).

    Args:
        images: Points (N, 2) after 0, 1, ... L layers.
        start: The base samples (N, 2).
    """
    quadrant = np.select(
        [(start[:, 0] >= 0) & (start[:, 1] >= 0), start[:, 1] >= 0, start[:, 0] < 0], [0, 1, 2], 3
    )
    colors = [QUADRANTS[q] for q in quadrant]
    figure, panels = grid_of_panels(len(images), 3)
    for index, (axes, points) in enumerate(zip(panels, images, strict=True)):
        # Layers in between may shift and stretch all points: zoom each panel to its points.
        middle = points.mean(0)
        extent = 1.05 * np.quantile(np.abs(points - middle), 0.995)
        titles = {0: "base: standard normal", len(images) - 1: "after layer 8: two moons"}
        axes.scatter(points[:, 0], points[:, 1], s=1.5, c=colors, linewidths=0, rasterized=True)
        axes.set(
            xlim=(middle[0] - extent, middle[0] + extent),
            ylim=(middle[1] - extent, middle[1] + extent),
        )
        axes.set_title(titles.get(index, f"after layer {index}"), fontsize=8)
    return figure


def picture_noise(n: int) -> th.Tensor:
    """Return the same standard normal noise (n, 2) for every picture."""
    return th.randn(n, 2, generator=th.Generator().manual_seed(PICTURE_SEED))


def sample(fitted: Fitted, condition: np.ndarray) -> np.ndarray:
    """Draw one point per condition from the median seed: (N, C) -> (N, 2)."""
    model = fitted.ensemble.member(fitted.middle)
    with th.no_grad():
        points = model.sample(picture_noise(len(condition)), th.from_numpy(condition).float())
    return points.numpy()


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of 128 colors, about half the size of a full-color one."""
    with replacing(path) as draft:
        figure.savefig(draft, dpi=DPI, format="png")
        image = Image.open(draft).convert("RGB").quantize(128)
        image.save(draft, format="png", optimize=True)
