"""Pictures of the studies: two moons with and without labels, and half circles that turn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from PIL import Image

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.datasets import (
    TRAINING_ANGLES,
    AngleMoons,
    Sample,
    TwoMoons,
    angle_condition,
)
from sb3_flowpolicy.density.figures import (
    BLUE,
    GREY,
    LABELS,
    ORANGE,
    PICTURE_SEED,
    curves_figure,
    density_picture,
    draw_density,
    draw_points,
    grid_of_panels,
    layers_figure,
    picture_noise,
    pixel_centers,
    sample,
    save,
)
from sb3_flowpolicy.density.measure import Fitted, label_posterior
from sb3_flowpolicy.density.models import OurRealNVP
from sb3_flowpolicy.density.studies import Scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Pictures show [-extent, extent]²: standardized moons, and half circles of radius 1.
MOONS_EXTENT, ANGLES_EXTENT = 2.4, 1.5
# Angles of the thesis's Fig. 2.9 and 2.10.
BETWEEN = np.linspace(1.0, 1.2, 8)
AROUND = np.arange(8) * np.pi / 4


def draw_two_moons(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves (2.3), samples (2.4), densities (2.5) and layers (2.1)."""
    ours = fits[0]
    save(curves_figure(fits, ours.rows[0]["entropy"]), folder / "two-moons-curves.png")

    data, seed = TwoMoons(), ours.ensemble.seeds[ours.middle]
    scaler = ours.scalers[ours.middle]
    points = scaler.apply(data.draw(data.n_train, seed).points)
    plane = pixel_centers(MOONS_EXTENT, scale.pixels).numpy().astype(float)
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
                density = density_picture(model, np.zeros(0), MOONS_EXTENT, scale.pixels)
                draw_density(axes, density, MOONS_EXTENT, LABELS[fitted.model])
        save(figure, folder / f"two-moons-{kind}.png")

    model = ours.ensemble.member(ours.middle)
    assert isinstance(model, OurRealNVP)
    noise = picture_noise(4000)
    images = [image.numpy() for image in model.after_each_layer(noise, th.zeros(4000, 0))]
    save(layers_figure(images, noise.numpy()), folder / "two-moons-layers.png")


def draw_label(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves, samples of both labels (2.7), and the probability of each label."""
    fitted = fits[0]
    level = (0.5, "thesis: 0.5 nats within 250 epochs")
    save(curves_figure(fits, fitted.rows[0]["entropy"], level), folder / "label-curves.png")

    data, index = TwoMoons(labelled=True), fitted.middle
    train = data.draw(data.n_train, fitted.ensemble.seeds[index])
    points = fitted.scalers[index].apply(train.points)
    samples = sample(fitted, train.condition)
    colors = np.where(train.condition[:, 0] > 0.5, ORANGE, BLUE)
    figure, panels = grid_of_panels(3, 3, size=2.8)
    draw_points(panels[0], points, MOONS_EXTENT, "training data", colors)
    draw_points(panels[1], samples, MOONS_EXTENT, "RealNVP, given the label", colors)

    model = fitted.ensemble.member(index)
    plane = pixel_centers(MOONS_EXTENT, scale.pixels)
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
    more_likely = label_posterior(lambda label: model(x, label), x.shape[:-1]).numpy() > 0.5
    wrong = more_likely != (fresh.condition[:, 0] > 0.5)
    draw_points(
        axes,
        x.numpy(),
        MOONS_EXTENT,
        f"more likely label; {wrong.sum()} of {len(x)} new points wrong",
        np.where(fresh.condition[:, 0] > 0.5, ORANGE, BLUE),
    )
    axes.scatter(x[wrong, 0], x[wrong, 1], s=30, facecolors="none", edgecolors="black")
    save(figure, folder / "label-samples.png")


def draw_angles(fits: Sequence[Fitted], folder: Path, scale: Scale) -> None:
    """Draw curves, samples (2.8), likelihood over the angle, and densities (2.9, 2.10)."""
    fitted = fits[0]
    save(curves_figure(fits, fitted.rows[0]["entropy"]), folder / "angles-curves.png")
    save(_angle_nll_figure(fitted), folder / "angles-likelihood.png")

    data, index = AngleMoons(), fitted.middle
    train = data.draw(data.n_train, fitted.ensemble.seeds[index])
    samples = sample(fitted, train.condition)
    color = np.arctan2(train.condition[:, 0], train.condition[:, 1])
    figure, panels = grid_of_panels(2, 2, size=2.8)
    draw_points(panels[0], train.points, ANGLES_EXTENT, "training data, 22 angles", color)
    draw_points(panels[1], samples, ANGLES_EXTENT, "RealNVP, given the angle", color)
    save(figure, folder / "angles-samples.png")

    model = fitted.ensemble.member(index)
    for name, angles in (("between", BETWEEN), ("outside", AROUND)):
        figure, panels = grid_of_panels(8, 4)
        for axes, angle in zip(panels, angles, strict=True):
            density = density_picture(model, angle_condition(angle), ANGLES_EXTENT, scale.pixels)
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
    """Draw the held-out likelihood over the angle, for every seed."""
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
    wide.set(ylabel="held-out NLL, nats", yscale="symlog", title="full circle")
    wide.set_ylim(bottom=limit - 0.5)
    close.set(xlim=(-0.1, 2.2), ylim=(limit - 0.05, limit + 0.4), title="trained range, enlarged")
    close.legend(frameon=False, fontsize=7)
    return figure


def _animate(fitted: Fitted, path: Path, scale: Scale) -> None:
    """Turn the condition by a full circle; the title says whether the angle was trained."""
    model = fitted.ensemble.member(fitted.middle)
    frames = []
    for angle in np.linspace(0, 2 * np.pi, scale.frames, endpoint=False):
        condition = angle_condition(angle)
        density = density_picture(model, condition, ANGLES_EXTENT, scale.pixels // 2)
        figure, (axes,) = grid_of_panels(1, 1, size=2.4)
        inside = angle <= TRAINING_ANGLES[-1]
        state = "within the trained range" if inside else "never trained"
        draw_density(axes, density, ANGLES_EXTENT, f"{angle:.1f} rad, {state}")
        _draw_tips(axes, angle)
        frames.append(_as_image(figure))
    with replacing(path) as draft:
        frames[0].save(
            draft, format="gif", save_all=True, append_images=frames[1:], duration=120, loop=0
        )


def _as_image(figure: Figure) -> Image.Image:
    figure.set_dpi(90)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(48)
