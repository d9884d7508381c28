"""Curves of an experiment as one picture, in the thesis's layout (figures 3.5, 3.7, 3.9, ...)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flowpolicy.common.statistics import bootstrap_interquartile_mean
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.curves import running_mean
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import Agent
from sb3_flowpolicy.experiments.tables import WORDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Those of the thesis's agents are told apart by every common kind of colour vision, and in print
# (Okabe and Ito); ten are more than can be.
COLOURS = {
    "gauss": "#d55e00",
    "lowrank": "#009e73",
    "flow": "#0072b2",
    "flow-default-init": "#cc79a7",
    "gauss-pink": "#8c2d04",
    "gsde": "#999999",
    "lattice": "#f0e442",
    "full-covariance": "#66c2a5",
    "flow-pink": "#56b4e9",
    "spline": "#6a3d9a",
    "spline-pink": "#cab2d6",
}
PANELS = ("train_return", "test_return", "test_success", "entropy", "ent_coef")
SMOOTHED_OVER = 3
"""Evaluations that a drawn point averages; numbers in tables are not smoothed."""


def colour(agent: Agent) -> str:
    """Return the colour of an agent in all figures."""
    return COLOURS.get(agent.name, "#555555")


def panels(evidence: Evidence) -> list[str]:
    """Return the metrics that are worth a panel: those measured, temperature if learned."""
    measured: set[str] = set()
    moves = False
    for setting in evidence.experiment.settings:
        for agent in evidence.experiment.agents:
            columns = evidence.columns(setting.name, agent.name)
            measured |= set(columns)
            if "ent_coef" in columns:
                moves |= bool(np.ptp(evidence.curves(setting.name, agent.name, "ent_coef")[1]) > 0)
    extra = sorted(measured - set(PANELS) - {"train_success"})
    return [
        name for name in (*PANELS, *extra) if name in measured and (name != "ent_coef" or moves)
    ]


def curves_figure(evidence: Evidence) -> Figure:
    """Draw all curves: a row per setting, a column per metric.

    Every seed is a thin line, their interquartile mean a bold one, its 95 % interval a band.

    Args:
        evidence: Results, complete or not.

    Returns:
        A matplotlib figure.

    Raises:
        ValueError: If there is nothing to draw.
    """
    experiment, metrics = evidence.experiment, panels(evidence)
    if not metrics:
        raise ValueError(f"evidence must hold at least one measurement, got {evidence.folder}")
    rows = len(experiment.settings)
    figure = new_figure(3.3 * len(metrics), 2.5 * rows + 0.4)
    grid = figure.subplots(rows, len(metrics), squeeze=False)
    for k, (row, setting) in enumerate(zip(grid, experiment.settings, strict=True)):
        for axes, metric in zip(row, metrics, strict=True):
            for agent in experiment.agents:
                if metric in evidence.columns(setting.name, agent.name):
                    _draw(axes, evidence, setting.name, agent, metric)
            _dress(axes, metric)
            if k == rows - 1:
                axes.set_xlabel("environment steps", fontsize=8)
            if k == 0:
                axes.set_title(WORDS.get(metric, metric), fontsize=10)
        if rows > 1:
            row[0].set_ylabel(setting.name, fontsize=10)
    handles, labels = _legend(grid)
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def smoothed(values: np.ndarray) -> np.ndarray:
    """Average over evaluations as drawn."""
    return running_mean(values, SMOOTHED_OVER)


def _draw(axes: Axes, evidence: Evidence, setting: str, agent: Agent, metric: str) -> None:
    steps, values = evidence.curves(setting, agent.name, metric)
    values = smoothed(values)
    shade = colour(agent)
    axes.plot(steps, values.T, color=shade, linewidth=0.5, alpha=0.35)
    mean = bootstrap_interquartile_mean(values)
    axes.fill_between(steps, mean.low, mean.high, color=shade, alpha=0.2, linewidth=0)
    axes.plot(steps, mean.value, color=shade, linewidth=2, label=agent.label)


def _dress(axes: Axes, metric: str) -> None:
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x else "0")
    axes.set_xlim(left=0)
    if metric.endswith("success"):
        axes.set_ylim(-0.03, 1.03)
    if metric == "ent_coef":
        axes.set_yscale("log")


def _legend(grid: np.ndarray) -> tuple[list, list]:
    found: dict[str, Any] = {}
    for axes in grid.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return list(found.values()), list(found)


def profile_figure(evidence: Evidence) -> Figure | None:
    """Draw the entropy along the way to the goal at the end of training (thesis Fig. 3.8).

    Returns:
        A matplotlib figure, None where it was not measured.
    """
    settings = [
        setting
        for setting in evidence.experiment.settings
        if any(evidence.profile(setting.name, a.name) for a in evidence.experiment.agents)
    ]
    if not settings:
        return None
    figure = new_figure(6.5, 3.0 * len(settings))
    for axes, setting in zip(
        figure.subplots(len(settings), 1, squeeze=False)[:, 0], settings, strict=True
    ):
        for agent in evidence.experiment.agents:
            profile = evidence.profile(setting.name, agent.name)
            if profile is None:
                continue
            way, values = profile
            mean, shade = bootstrap_interquartile_mean(values), colour(agent)
            axes.plot(way, values.T, color=shade, linewidth=0.5, alpha=0.35)
            axes.fill_between(way, mean.low, mean.high, color=shade, alpha=0.2, linewidth=0)
            axes.plot(way, mean.value, color=shade, linewidth=2, label=agent.label)
        axes.set_xlabel("share of the way from start to goal, on the centre line", fontsize=8)
        axes.set_ylabel("entropy (nats)", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False)
    return figure
