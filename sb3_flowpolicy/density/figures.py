"""Panels of the chapter's pictures. Needs matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from matplotlib.figure import Figure
from PIL import Image

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.measure import CHUNK
from sb3_flowpolicy.density.models import FlowModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Seed of the noise and of the new points in pictures.
PICTURE_SEED = 7
DPI = 110
BLUE, ORANGE, GREY = "#1f6fb4", "#d9662b", "#555555"


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
    """Evaluate p(. | condition) at the pixel centers of a square, from the lowest y and x up."""
    scores = [
        model(points, th.from_numpy(condition).float().expand(len(points), -1))
        for points in pixel_centers(extent, pixels).split(CHUNK)
    ]
    return th.cat(scores).exp().reshape(pixels, pixels).numpy()


def pixel_centers(extent: float, pixels: int) -> th.Tensor:
    """Return the centers of the pixels of a square, row by row from the lowest: (pixels², 2)."""
    center = ((th.arange(pixels) + 0.5) / pixels * 2 - 1) * extent
    return th.cartesian_prod(center, center).flip(-1)


def picture_noise(n: int) -> th.Tensor:
    """Return the same standard normal noise (n, 2) for every picture."""
    return th.randn(n, 2, generator=th.Generator().manual_seed(PICTURE_SEED))


@th.no_grad()
def sample(model: FlowModel, condition: np.ndarray) -> np.ndarray:
    """Draw one point per condition: (N, C) -> (N, 2)."""
    return model.sample(picture_noise(len(condition)), th.from_numpy(condition).float()).numpy()


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of 128 colors, about half the size of a full-color one."""
    with replacing(path) as draft:
        figure.savefig(draft, dpi=DPI, format="png")
        image = Image.open(draft).convert("RGB").quantize(128)
        image.save(draft, format="png", optimize=True)
