"""Drawings of recordings: a column per agent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.square_pictures.record import Moment, Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FINGERS = ("right", "top", "left", "bottom")
ACTIONS = tuple(f"{finger} {axis}" for finger in FINGERS for axis in "xy")
SIDES = "coolwarm"
"""Colormap from blue, left of the mean, to red, right of it."""
_LEFT, _RIGHT = "#2b4cc0", "#b40426"
_VIEW = 0.66
"""Half the edge of a view of the Square in world units."""
_SECONDS = 0.25
SEQUENCE_STEPS = 7


def correlation_figure(recordings: Sequence[Recording]) -> Figure:
    """Draw the absolute correlation of all pairs of actions (thesis Fig. 3.17)."""
    figure = new_figure(3.3 * len(recordings) + 0.7, 3.7)
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
    """Draw sampled targets at one state, and below them where the square went.

    A dot's color tells where the *right* finger's target lies in the same sample, so that fingers
    that move together show the same order of colors, and independent ones a mixture.
    """
    figure = new_figure(3.3 * len(recordings), 5.6)
    grid = figure.subplots(2, len(recordings), squeeze=False, height_ratios=[3.3, 1.8])
    widest = max(np.nanmax(np.abs(recording.paths)) for recording in recordings) * 1.1
    for (above, below), recording in zip(grid.T, recordings, strict=True):
        above.set_title(_title(recording), fontsize=10)
        _draw_samples(above, recording.moments[0])
        _draw_paths(below, recording)
        below.set_ylim(-widest, widest)
    grid[1, 0].set_ylabel("x of the square", fontsize=8)
    figure.supxlabel(
        "Above: sampled targets of the four fingers at one state, the first after the warm-up. "
        "Color: target of the right finger\nin the same sample, blue to the left, red to the "
        f"right. Below: {len(recordings[0].paths)} sampled episodes; crosses: the square was lost.",
        fontsize=8,
    )
    return figure


def sequence_figure(recordings: Sequence[Recording]) -> Figure:
    """Draw the first steps after the warm-up, a row per step (thesis Fig. 3.19).

    Arrows lead from the mean to the target that was taken, twice as long as in the world.
    """
    figure = new_figure(2.1 * len(recordings), 2.0 * SEQUENCE_STEPS + 0.8)
    grid = figure.subplots(SEQUENCE_STEPS, len(recordings), squeeze=False)
    for column, recording in zip(grid.T, recordings, strict=True):
        column[0].set_title(_title(recording), fontsize=8)
        for k, axes in enumerate(column):
            if k < len(recording.moments):
                _draw_step(axes, recording.moments[k])
                if axes in grid[:, 0]:
                    axes.set_ylabel(f"step {k + 1}", fontsize=8)
            else:
                axes.set_axis_off()
    figure.supxlabel(
        "Dots: sampled targets. Arrows: from their mean\nto the target taken, twice as long; "
        "red to the right,\nblue to the left.",
        fontsize=8,
    )
    return figure


def _title(recording: Recording) -> str:
    return f"{recording.label}\n{recording.origin}"


def _draw_world(axes: Axes, moment: Moment) -> None:
    from matplotlib.patches import Polygon

    x, y, angle = moment.body
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = moment.half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ turn + (x, y)
    axes.add_patch(Polygon(corners, facecolor="#e4e4e4", edgecolor="#555555", linewidth=0.8))
    axes.scatter(*moment.fingers.T, s=60, facecolor="white", edgecolor="black", zorder=3)
    axes.set(xlim=(-_VIEW, _VIEW), ylim=(-_VIEW, _VIEW), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_color("#dddddd")


def _draw_samples(axes: Axes, moment: Moment) -> None:
    _draw_world(axes, moment)
    # Ranks use the whole range of colors, whatever the shape of the distribution.
    rank = moment.samples[:, 0, 0].argsort().argsort() / (len(moment.samples) - 1)
    for k in range(len(FINGERS)):
        x, y = moment.samples[:, k].T
        axes.scatter(x, y, c=rank, cmap=SIDES, s=9, linewidths=0, alpha=0.85, zorder=4)


def _draw_paths(axes: Axes, recording: Recording) -> None:
    seconds = _SECONDS * np.arange(recording.paths.shape[1])
    for path, dropped in zip(recording.paths, recording.dropped, strict=True):
        axes.plot(seconds, path, color="#333333", linewidth=0.7, alpha=0.7)
        reached = np.flatnonzero(~np.isnan(path))
        if dropped and len(reached):
            last = reached[-1]
            axes.plot(seconds[last], path[last], "x", color=_RIGHT, markersize=5)
    after = [path[~np.isnan(path)] for path in recording.paths]
    spread = np.mean([path.std() for path in after if len(path)])
    axes.set_title(f"standard deviation of x {spread:.3f}", fontsize=8)
    axes.set_xlabel("seconds after the warm-up", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_step(axes: Axes, moment: Moment) -> None:
    _draw_world(axes, moment)
    axes.scatter(*moment.samples.reshape(-1, 2).T, s=2, color="#999999", linewidths=0, zorder=4)
    moved = 2 * (moment.chosen - moment.mean)
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "zorder": 5}
    shades = [_RIGHT if x > 0 else _LEFT for x in moved[:, 0]]
    axes.quiver(*moment.mean.T, *moved.T, color=shades, width=0.016, **arrow)
