"""A picture of how policies learned beside each other: a panel per algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_flowpolicy.diagnostics.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# As in the figures of the experiments; "stock" is the algorithm's own policy.
_COLOURS = {
    "stock": "#000000",
    "gauss": "#d55e00",
    "lowrank": "#009e73",
    "flow": "#0072b2",
    "lowrank-clipped": "#8fd3b6",
    "flow-clipped": "#56b4e9",
}


def learning_curves(rows: Sequence[Sequence[str]]) -> Figure:
    """Draw each seed thin and the mean over seeds bold.

    Args:
        rows: Rows of ``algorithms.COLUMNS``, of one task. Success is drawn where it was
            measured, the return elsewhere.

    Returns:
        A matplotlib figure.
    """
    has_success = all(row[6] for row in rows)
    algorithms = list(dict.fromkeys(row[1] for row in rows))
    figure = new_figure(1 + 3 * len(algorithms), 3)
    axes = figure.subplots(1, len(algorithms), squeeze=False)[0]
    for panel, algorithm in zip(axes, algorithms, strict=True):
        mine = [row for row in rows if row[1] == algorithm]
        for policy in dict.fromkeys(row[2] for row in mine):
            curves: dict[str, list[tuple[float, float]]] = {}
            for row in mine:
                if row[2] == policy:
                    value = float(row[6] if has_success else row[5])
                    curves.setdefault(row[3], []).append((float(row[4]), value))
            shade = _COLOURS[policy]
            for curve in curves.values():
                panel.plot(*zip(*curve, strict=True), color=shade, alpha=0.25, linewidth=0.8)
            mean = np.mean([*curves.values()], axis=0)
            panel.plot(*mean.T, color=shade, linewidth=2, label=f"{policy} ({len(curves)})")
        panel.set(title=f"{algorithm.upper()}, {mine[0][0]}", xlabel="steps")
        panel.legend(frameon=False, fontsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("success of test episodes" if has_success else "return of test episodes")
    return figure
