"""Figure of the prediction for diagonal tunnels of many dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.figures import COLORS
from sb3_flowpolicy.experiments.section import png

_LINES = (
    ("bound", "any density", "#555555"),
    ("correlated", "LR (any rank), full covariance", COLORS["lowrank"]),
    ("independent", "Gauss", COLORS["gauss"]),
)


def draw(rows: Sequence[Mapping[str, Any]], survival: float) -> bytes:
    """Draw entropy and progress by dimension.

    Args:
        rows: One per number of dimensions, as the command makes.
        survival: Probability with which a step survives.

    Returns:
        A PNG file.
    """
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    dims = [row["dims"] for row in rows]
    for name, label, shade in _LINES:
        style = {"color": shade, "label": label, "marker": "o", "markersize": 4}
        if name == "bound":
            left.plot(dims, [row[name] - row["uniform"] for row in rows], **style)
        else:
            left.plot(dims, [row[name]["entropy"] - row["uniform"] for row in rows], **style)
            right.plot(dims, [row[name]["progress"] for row in rows], **style)
    left.set(title="highest entropy, less that of the uniform density", ylabel="nats")
    right.set(title="standard deviation of the progress of a step", ylabel="share of the reach")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(dims, [str(count) for count in dims])
        axes.minorticks_off()
        axes.set_xlabel(f"coupled dimensions; {survival:.0%} of the steps survive")
        axes.grid(color="#eeeeee")
    right.set_ylim(bottom=0.0)
    left.legend(frameon=False)
    return png(figure, dpi=110)
