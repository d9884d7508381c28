"""Drawings and film of recordings: a column per agent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flowpolicy_envs.square.rendering import RENDER_FPS
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
_LOST = "#b40426"
_VIEW = 0.66
"""Half the edge of a view of the Square in world units."""
_NUMBERS = 0.58
"""Distance of a finger's number from the middle."""
_ARROW = {"arrowstyle": "-|>", "linewidth": 2, "color": "black", "shrinkA": 0, "shrinkB": 0}
_SECONDS = 0.25
_HEAD = 20
"""Height of the labels of a film in pixels."""


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
        _draw_samples(above, recording.moment)
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


def write_film(recordings: Sequence[Recording], path: Path) -> None:
    """Write the agents' episodes as an animated WebP in real time, an image for browsers.

    An episode that ends early rests on its last frame.
    """
    from PIL import Image, ImageDraw

    size = recordings[0].frames[0].shape[1]
    pictures = []
    for k in range(max(len(recording.frames) for recording in recordings)):
        row = [recording.frames[min(k, len(recording.frames) - 1)] for recording in recordings]
        picture = Image.new("RGB", (size * len(row), size + _HEAD), "white")
        picture.paste(Image.fromarray(np.hstack(row)), (0, _HEAD))
        for column, recording in enumerate(recordings):
            label = f"{recording.label}: {recording.origin}"
            ImageDraw.Draw(picture).text((size * column + 6, 4), label, "black", font_size=13)
        pictures.append(picture)
    with replacing(path) as draft:
        pictures[0].save(
            draft,
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 / RENDER_FPS),
            loop=0,
            quality=60,
            method=6,  # slow and small
        )


def _title(recording: Recording) -> str:
    return f"{recording.label}\n{recording.origin}"


def _draw_samples(axes: Axes, moment: Moment) -> None:
    from matplotlib.patches import Polygon

    x, y, angle = moment.body
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    corners = moment.half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) @ turn + (x, y)
    axes.add_patch(Polygon(corners, facecolor="#e4e4e4", edgecolor="#555555", linewidth=0.8))
    axes.set(xlim=(-_VIEW, _VIEW), ylim=(-_VIEW, _VIEW), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_color("#dddddd")
    # Around the fingers: those that press hard all have their targets in the middle of the square.
    dots = moment.fingers + moment.samples[:N_SHOWN] - moment.samples.mean(0)
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
            axes.plot(seconds[last], path[last], "x", color=_LOST, markersize=5)
    axes.set_title(f"standard deviation of x {recording.x_std:.3f}", fontsize=8)
    axes.set_xlabel("seconds after the warm-up", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
