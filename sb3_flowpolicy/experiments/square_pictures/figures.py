"""Drawings of recordings: a column per agent."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.square_pictures.record import N_SHOWN, Moment, Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FINGERS = ("right", "top", "left", "bottom")
ACTIONS = tuple(f"{finger} {axis}" for finger in FINGERS for axis in "xy")
SIDES = "coolwarm"
"""Colormap from blue, one end of the joint movement, to red, the other."""
_LEFT, _RIGHT = "#2b4cc0", "#b40426"
_VIEW = 0.66
"""Half the edge of a view of the Square in world units."""
_NUMBERS = 0.58
"""Distance of a finger's number from the middle."""
_ARROW = {"arrowstyle": "-|>", "linewidth": 2, "color": "black", "shrinkA": 0, "shrinkB": 0}
_SECONDS = 0.25
SEQUENCE_STEPS = 7


def correlation_figure(recordings: Sequence[Recording]) -> Figure:
    """Draw the absolute correlation of all pairs of actions (thesis Fig. 3.17)."""
    figure = new_figure(3.3 * len(recordings) + 0.7, 4.2)
    figure.set_layout_engine("compressed")  # else the colorbar's height cuts the titles
    row = figure.subplots(1, len(recordings), squeeze=False)[0]
    for axes, recording in zip(row, recordings, strict=True):
        image = axes.imshow(recording.correlation, vmin=0, vmax=1, cmap="viridis")
        axes.set_title(_title(recording), fontsize=9)
        axes.set_xticks(range(8), ACTIONS, rotation=90, fontsize=7)
        axes.set_yticks(range(8), ACTIONS if axes is row[0] else [""] * 8, fontsize=7)
        for (i, j), value in np.ndenumerate(recording.correlation):
            shade = "black" if value > 0.6 else "white"
            axes.text(j, i, f"{value:.1f}", ha="center", va="center", color=shade, fontsize=6)
    figure.colorbar(image, ax=row.tolist(), label="|correlation| of two actions", shrink=0.8)
    return figure


def together_figure(recordings: Sequence[Recording]) -> Figure:
    """Draw sampled actions at one state, and below them where the square went.

    A dot's color tells how far the *other three* fingers go along the agent's joint movement in the
    same sample. A finger that moves with them shows its colors in order, an independent one a
    mixture: the arrow from blue to red is long for the one and short for the other.
    """
    figure = new_figure(3.3 * len(recordings), 5.9)
    grid = figure.subplots(2, len(recordings), squeeze=False, height_ratios=[3.3, 1.8])
    longest = max(recording.paths.shape[1] for recording in recordings)
    widest = max(np.nanmax(np.abs(recording.paths)) for recording in recordings) * 1.1
    for (above, below), recording in zip(grid.T, recordings, strict=True):
        above.set_title(_title(recording), fontsize=10)
        _draw_samples(above, recording.moments[0])
        _draw_paths(below, recording)
        below.set(xlim=(0, _SECONDS * longest), ylim=(-widest, widest))
    grid[1, 0].set_ylabel("x of the square", fontsize=8)
    figure.supxlabel(
        "Above: sampled targets at one state, the first after the warm-up, around each finger. "
        "A dot's color tells\nwhat the other three fingers do in the same sample: in order if the "
        "finger moves together with them,\nmixed if it does not. Number: their correlation. "
        "Arrow: from the mean of the blue third to that of the red one,\ntwice as long. "
        f"Below: {len(recordings[0].paths)} sampled episodes; crosses: the square was lost.",
        fontsize=8,
    )
    return figure


def sequence_figure(recordings: Sequence[Recording]) -> Figure:
    """Draw the first steps after the warm-up, a row per step (thesis Fig. 3.19)."""
    steps = min(SEQUENCE_STEPS, max(len(recording.moments) for recording in recordings))
    figure = new_figure(1.7 * len(recordings) + 0.3, 1.7 * steps + 0.9)
    grid = figure.subplots(steps, len(recordings), squeeze=False)
    for column, recording in zip(grid.T, recordings, strict=True):
        column[0].set_title(_title(recording), fontsize=7)
        for k, axes in enumerate(column):
            if k < len(recording.moments):
                _draw_step(axes, recording.moments[k])
            else:
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_color("#dddddd")
                axes.text(0.5, 0.5, "lost", ha="center", transform=axes.transAxes, fontsize=8)
    for k, axes in enumerate(grid[:, 0]):
        axes.set_ylabel(f"step {k + 1}", fontsize=8)
    figure.supxlabel(
        "Dots: sampled targets, relative to their mean, at each finger.\n"
        "Arrows: the target taken, twice as long. Red: to the right, blue: to the left.",
        fontsize=8,
    )
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of 256 colors, a third as large as one of all colors."""
    from PIL import Image

    full = BytesIO()
    figure.savefig(full, dpi=110)
    with replacing(path) as draft:
        Image.open(full).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE).save(
            draft, optimize=True
        )


def _title(recording: Recording) -> str:
    return f"{recording.label}\n{recording.origin}"


def _draw_world(axes: Axes, moment: Moment) -> None:
    from matplotlib.patches import Polygon

    x, y, angle = moment.body
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = moment.half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ turn + (x, y)
    axes.add_patch(Polygon(corners, facecolor="#e4e4e4", edgecolor="#555555", linewidth=0.8))
    axes.set(xlim=(-_VIEW, _VIEW), ylim=(-_VIEW, _VIEW), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_color("#dddddd")


def _around_fingers(moment: Moment, targets: np.ndarray) -> np.ndarray:
    """Move targets (..., 4, 2) from their mean to the fingers.

    Fingers that press hard all have their targets in the middle of the square, on top of each
    other.
    """
    return moment.fingers + targets - moment.mean


def _draw_samples(axes: Axes, moment: Moment) -> None:
    _draw_world(axes, moment)
    dots = _around_fingers(moment, moment.samples[:N_SHOWN])
    own, others = moment.joint_movement()
    for k, start in enumerate(moment.starts):
        x, y = dots[:, k].T
        # Ranks use the whole range of colors, whatever the shape of the distribution.
        rank = others[:, k].argsort().argsort() / N_SHOWN
        axes.scatter(x, y, c=rank, cmap=SIDES, s=9, linewidths=0, zorder=4)
        low, high = (dots[third, k].mean(0) for third in (rank < 1 / 3, rank >= 2 / 3))
        tail, head = moment.fingers[k] + low - high, moment.fingers[k] + high - low
        axes.annotate("", head, tail, arrowprops=_ARROW, zorder=6)
        correlation = np.corrcoef(own[:, k], others[:, k])[0, 1]
        place_x, place_y = start * (_NUMBERS / np.abs(start).max())
        axes.text(place_x, place_y, f"{round(correlation, 1) + 0.0}", ha="center", va="center")


def _draw_paths(axes: Axes, recording: Recording) -> None:
    seconds = _SECONDS * np.arange(recording.paths.shape[1])
    for path, dropped in zip(recording.paths, recording.dropped, strict=True):
        axes.plot(seconds, path, color="#333333", linewidth=0.7, alpha=0.7)
        reached = np.flatnonzero(~np.isnan(path))
        if dropped and len(reached):
            last = reached[-1]
            axes.plot(seconds[last], path[last], "x", color=_RIGHT, markersize=5)
    axes.set_title(f"standard deviation of x {recording.x_std:.3f}", fontsize=8)
    axes.set_xlabel("seconds after the warm-up", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_step(axes: Axes, moment: Moment) -> None:
    _draw_world(axes, moment)
    x, y = _around_fingers(moment, moment.samples[:N_SHOWN]).reshape(-1, 2).T
    axes.scatter(x, y, s=1.5, color="#999999", linewidths=0, zorder=3)
    moved = 2 * (moment.chosen - moment.mean)
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "zorder": 4}
    shades = [_RIGHT if x > 0 else _LEFT for x in moved[:, 0]]
    axes.quiver(*moment.fingers.T, *moved.T, color=shades, width=0.018, headwidth=3.5, **arrow)
