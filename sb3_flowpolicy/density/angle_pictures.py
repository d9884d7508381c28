"""Pictures of the half circles that turn: on, between and outside the training angles."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from sb3_flowpolicy.density.datasets import TRAINING_ANGLES, AngleMoons, angle_condition
from sb3_flowpolicy.density.figures import (
    BLUE,
    curves_figure,
    draw_density,
    draw_points,
    grid_of_panels,
    picture,
    sample,
    save,
)
from sb3_flowpolicy.density.measure import Fitted
from sb3_flowpolicy.density.studies import Scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Half circles of radius 1.
ANGLES_EXTENT = 1.5
# Angles of the thesis's Fig. 2.9 and 2.10.
BETWEEN = np.linspace(1.0, 1.2, 8)
AROUND = np.arange(8) * np.pi / 4


def draw_angles(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves, samples (2.8), likelihood over the angle, and densities (2.9, 2.10)."""
    fitted = fits[0]
    save(curves_figure(fits, fitted.rows[0]["entropy"]), folder / "angles-curves.png")
    save(_angle_nll_figure(fitted), folder / "angles-likelihood.png")

    data, index = AngleMoons(), fitted.middle
    train = data.draw(data.n_train, fitted.ensemble.seeds[index])
    samples = sample(fitted, train.condition)
    colour = np.arctan2(train.condition[:, 0], train.condition[:, 1])
    figure, panels = grid_of_panels(2, 2, size=2.8)
    draw_points(panels[0], train.points, ANGLES_EXTENT, "training data, 22 angles", colour)
    draw_points(panels[1], samples, ANGLES_EXTENT, "RealNVP, given the angle", colour)
    save(figure, folder / "angles-samples.png")

    model = fitted.ensemble.member(index)
    for name, angles in (("between", BETWEEN), ("outside", AROUND)):
        figure, panels = grid_of_panels(8, 4)
        for axes, angle in zip(panels, angles, strict=True):
            density = picture(model, angle_condition(angle), ANGLES_EXTENT, scale.pixels)
            draw_density(axes, density, ANGLES_EXTENT, f"{angle:.2f} rad, {_kind(angle)}")
            _draw_tips(axes, angle)
        save(figure, folder / f"angles-{name}.png")
    _animate(fitted, folder / "angles.gif", scale)


def _kind(angle: float) -> str:
    if np.abs(TRAINING_ANGLES - angle).min() < 1e-6:
        return "trained"
    return "between" if angle < TRAINING_ANGLES[-1] else "outside"


def _draw_tips(axes: Axes, angle: float) -> None:
    """Mark both tips of the true half circle."""
    tips = np.array([angle, angle + np.pi])
    axes.plot(np.cos(tips), np.sin(tips), "+", color="#7fd4ff", markersize=5, markeredgewidth=0.8)


def _angle_nll_figure(fitted: Fitted) -> Figure:
    """Held-out likelihood at trained, in-between and outside angles, every seed."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    wide, close = figure.subplots(1, 2, width_ratios=(1.4, 1))
    columns = ("angle", "seed", "nll", "kind")
    table = sorted(tuple(row[name] for name in columns) for row in fitted.angle_rows)
    angles = sorted({row[0] for row in table})
    nll = np.array([row[2] for row in table]).reshape(len(angles), -1)
    kinds = {row[0]: row[3] for row in table}
    limit = fitted.rows[0]["entropy"]
    for axes in (wide, close):
        axes.plot(angles, nll, color=BLUE, linewidth=0.5, alpha=0.4)
        axes.plot(angles, np.median(nll, axis=1), color=BLUE, label="median of the seeds")
        axes.axhline(limit, color="black", linestyle="--", linewidth=1, label="entropy of the data")
        axes.axvspan(0, 2.1, color="#000000", alpha=0.06, linewidth=0, label="trained range")
        axes.set(xlabel="angle, radian")
        axes.spines[["top", "right"]].set_visible(False)
    for kind, marker in (("trained", "o"), ("between", "x")):
        chosen = [i for i, angle in enumerate(angles) if kinds[angle] == kind]
        x, y = np.array(angles)[chosen], np.median(nll, axis=1)[chosen]
        close.plot(x, y, marker, color=BLUE, markersize=4, label=f"{kind} angles, median")
    wide.set(ylabel="held-out NLL, nats", yscale="symlog", title="all the way round")
    wide.set_ylim(bottom=limit - 0.5)
    close.set(xlim=(-0.1, 2.2), ylim=(limit - 0.05, limit + 0.4), title="trained range, enlarged")
    close.legend(frameon=False, fontsize=7)
    return figure


def _animate(fitted: Fitted, path: Path, scale: Scale) -> None:
    """Turn the condition once round the circle; a frame says whether its angle was trained."""
    model = fitted.ensemble.member(fitted.middle)
    frames = []
    for angle in np.linspace(0, 2 * np.pi, scale.frames, endpoint=False):
        density = picture(model, angle_condition(angle), ANGLES_EXTENT, scale.pixels // 2)
        figure, (axes,) = grid_of_panels(1, 1, size=2.4)
        inside = angle <= TRAINING_ANGLES[-1]
        state = "within the trained range" if inside else "never trained"
        draw_density(axes, density, ANGLES_EXTENT, f"{angle:.1f} rad, {state}")
        _draw_tips(axes, angle)
        frames.append(_as_image(figure))
    temporary = path.with_name(f".{path.name}.tmp")
    frames[0].save(
        temporary, format="gif", save_all=True, append_images=frames[1:], duration=120, loop=0
    )
    os.replace(temporary, path)


def _as_image(figure: Figure) -> Image.Image:
    figure.set_dpi(90)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(48)
