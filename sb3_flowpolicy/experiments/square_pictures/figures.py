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
_TOP = FINGERS.index("top")
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
    """Draw sampled actions at one state, and below them where the square went.

    A dot's color tells where the *top* finger's target lies in the same sample, so that fingers
    that move together show the same order of colors, and independent ones a mixture. The top
    finger, because it drags the square along x, where those at the sides only press.
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
        "Above: sampled targets at one state, the first after the warm-up: dots around each "
        "finger,\nrelative to their mean. Color: x of the top finger's target in the same "
        "sample, blue left, red right.\n"
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
                axes.set(xticks=[], yticks=[], xlabel="")
                axes.text(0.5, 0.5, "lost", ha="center", transform=axes.transAxes, fontsize=8)
    for k, axes in enumerate(grid[:, 0]):
        axes.set_ylabel(f"step {k + 1}", fontsize=8)
    figure.supxlabel(
        "Arrows: the target taken, relative to the mean\nof the sampled ones (dots). Red: to the "
        "right,\nblue: to the left.",
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
    dots = _around_fingers(moment, moment.samples)
    # Ranks use the whole range of colors, whatever the shape of the distribution.
    rank = moment.samples[:, _TOP, 0].argsort().argsort() / (len(moment.samples) - 1)
    for k in range(len(FINGERS)):
        axes.scatter(*dots[:, k].T, c=rank, cmap=SIDES, s=9, linewidths=0, zorder=4)


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
    dots = _around_fingers(moment, moment.samples).reshape(-1, 2)
    axes.scatter(*dots.T, s=1.5, color="#999999", linewidths=0, zorder=3)
    moved = moment.chosen - moment.mean
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "zorder": 4}
    shades = [_RIGHT if x > 0 else _LEFT for x in moved[:, 0]]
    axes.quiver(*moment.fingers.T, *moved.T, color=shades, width=0.02, **arrow)
