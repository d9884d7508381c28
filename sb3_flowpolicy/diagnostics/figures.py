"""Pictures of an action distribution. Needs matplotlib (extra ``zoo``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICY_BLUE = "#1f6fb4"


def new_figure(width: float, height: float) -> Figure:
    """Return a figure without a window and without pyplot's global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def correlation_figure(correlation: np.ndarray) -> Figure:
    """Draw the absolute correlation (D, D) of all pairs of actions (thesis Fig. 3.17).

    Example:
        >>> import numpy as np
        >>> correlation_figure(np.eye(3)).axes[0].get_xlabel()
        'action'
    """
    figure = new_figure(4.2, 3.6)
    axes = figure.add_subplot()
    image = axes.imshow(np.abs(correlation), vmin=0, vmax=1, cmap="viridis")
    axes.set(xlabel="action", ylabel="action")
    ticks = np.arange(len(correlation))
    axes.set_xticks(ticks)
    axes.set_yticks(ticks)
    if len(correlation) <= 8:
        for i, j in np.ndindex(correlation.shape):
            value = abs(correlation[i, j])
            color = "black" if value > 0.6 else "white"
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", color=color, fontsize=8)
    figure.colorbar(image, label="|correlation|")
    return figure


def samples_figure(samples: np.ndarray) -> Figure:
    """Scatter squashed actions, shape (states, samples, 2), one panel per state."""
    n_columns = min(2, len(samples))
    n_rows = -(-len(samples) // n_columns)
    figure = new_figure(2.2 * n_columns, 2.2 * n_rows)
    # Leave room around the box, on whose edge the samples of a saturated policy lie.
    limits = (-1.1, 1.1)
    for panel, points in enumerate(samples):
        axes = figure.add_subplot(n_rows, n_columns, panel + 1)
        x, y = points.T
        axes.scatter(x, y, s=6, alpha=0.5, color=POLICY_BLUE, linewidths=0)
        axes.set(xlim=limits, ylim=limits, aspect="equal", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
        axes.tick_params(labelsize=7)
        axes.set_title(f"state {panel}", fontsize=8)
    return figure
