"""Still figures: curves as in the thesis (figures 3.5, 3.7, 3.9, ...), profiles and outcomes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import LinearSegmentedColormap

from sb3_flowpolicy.common.statistics import bootstrap_interquartile_mean, interquartile_mean
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.curves import running_mean
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import Agent
from sb3_flowpolicy.experiments.tables import WORDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The thesis's agents have colors that remain distinct in print and for color-blind readers (Okabe
# and Ito); there are not ten such colors.
COLORS = {
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
# Color of a field whose seeds all succeed; white if none does.
_FULL = COLORS["flow"]
# Fields above this share are so dark that their text has to be white.
_DARK = 0.6
PANELS = ("train_return", "test_return", "test_success", "entropy", "ent_coef")
SMOOTHED_OVER = 3
"""Evaluations that a drawn point averages; numbers in tables are not smoothed."""


def color(agent: Agent) -> str:
    """Return the color of an agent in all figures."""
    return COLORS.get(agent.name, "#555555")


def panels(evidence: Evidence) -> list[str]:
    """Return the metrics to draw: those measured, and the entropy coefficient if learned."""
    columns = {
        (setting.name, agent.name): evidence.columns(setting.name, agent.name)
        for setting, agent in evidence.measured
    }
    names = {name for measured in columns.values() for name in measured}
    coefficients = [
        evidence.curves(*pair, "ent_coef")[1] for pair in columns if "ent_coef" in columns[pair]
    ]
    if not any(np.ptp(curves) > 0 for curves in coefficients):
        names.discard("ent_coef")
    extra = sorted(names - set(PANELS) - {"train_success"})
    return [name for name in (*PANELS, *extra) if name in names]


def curves_figure(evidence: Evidence) -> Figure:
    """Draw all curves: a row per setting, a column per metric.

    Every seed is a thin line, their interquartile mean a bold one, its 95 % interval a band.
    """
    experiment, metrics = evidence.experiment, panels(evidence)
    rows = len(experiment.settings)
    figure = new_figure(3.3 * len(metrics), 2.5 * rows + 0.4)
    grid = figure.subplots(rows, len(metrics), squeeze=False)
    for k, (row, setting) in enumerate(zip(grid, experiment.settings, strict=True)):
        for axes, metric in zip(row, metrics, strict=True):
            for agent in experiment.agents:
                if metric in evidence.columns(setting.name, agent.name):
                    steps, values = evidence.curves(setting.name, agent.name, metric)
                    _draw(axes, agent, steps, smoothed(values))
            _style(axes)
            _scale(axes, metric)
            if k == rows - 1:
                axes.set_xlabel("environment steps", fontsize=8)
            if k == 0:
                axes.set_title(WORDS.get(metric, metric), fontsize=10)
        if rows > 1:
            row[0].set_ylabel(setting.name, fontsize=10)
    handles = {
        label: handle
        for axes in grid.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def smoothed(values: np.ndarray) -> np.ndarray:
    """Average over evaluations as drawn."""
    return running_mean(values, SMOOTHED_OVER)


def _draw(axes: Axes, agent: Agent, x: np.ndarray, values: np.ndarray) -> None:
    """Draw seeds (S, T) thin, their interquartile mean bold, its interval as a band."""
    shade, mean = color(agent), bootstrap_interquartile_mean(values)
    axes.plot(x, values.T, color=shade, linewidth=0.5, alpha=0.35)
    axes.fill_between(x, mean.low, mean.high, color=shade, alpha=0.2, linewidth=0)
    axes.plot(x, mean.value, color=shade, linewidth=2, label=agent.label)


def _style(axes: Axes) -> None:
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def _scale(axes: Axes, metric: str) -> None:
    axes.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x else "0")
    axes.set_xlim(left=0)
    if metric.endswith("success"):
        axes.set_ylim(-0.03, 1.03)
    if metric == "ent_coef":
        axes.set_yscale("log")


def profile_figure(evidence: Evidence) -> Figure | None:
    """Draw the entropy along the way to the goal at the end of training (thesis Fig. 3.8)."""
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
            if profile is not None:
                _draw(axes, agent, *profile)
        axes.set_xlabel("share of the way from start to goal, on the centre line", fontsize=8)
        axes.set_ylabel("entropy (nats)", fontsize=8)
        _style(axes)
        axes.legend(fontsize=8, frameon=False)
    return figure


def outcomes_figure(evidence: Evidence) -> Figure | None:
    """Draw the share of seeds that solve their task at the end: a row per agent.

    Each field contains the number of such seeds and their steps until then (interquartile mean;
    seeds that never solve it count with the length of training). None with a single setting, or
    where success was not measured.
    """
    experiment = evidence.experiment
    columns, rows = len(experiment.settings), len(experiment.agents)
    if columns < 2:
        return None
    figure = new_figure(1.6 + 1.5 * columns, 0.9 + 0.5 * rows)
    axes = figure.subplots()
    shares = np.full((rows, columns), np.nan)
    for row, column in np.ndindex(rows, columns):
        setting, agent = experiment.settings[column].name, experiment.agents[row].name
        if "test_success" not in evidence.columns(setting, agent):
            continue
        solved = evidence.solved(setting, agent)
        shares[row, column] = share = solved.mean()
        text = f"{solved.sum()} of {len(solved)}"
        if evidence.solved_once(setting, agent).any():
            steps = interquartile_mean(evidence.steps_until_solved(setting, agent))
            text += f"\n{float(steps.value):,.0f} steps"
        shade = "white" if share > _DARK else "black"
        axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8, color=shade)
    if np.isnan(shares).all():
        return None
    white_to_blue = LinearSegmentedColormap.from_list("shares", ["white", _FULL])
    axes.pcolormesh(shares, cmap=white_to_blue, vmin=0, vmax=1, edgecolors="white", linewidth=3)
    axes.invert_yaxis()
    axes.set_xticks([k + 0.5 for k in range(columns)], [one.name for one in experiment.settings])
    axes.set_yticks([k + 0.5 for k in range(rows)], [agent.label for agent in experiment.agents])
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelsize=8)
    axes.spines[:].set_visible(False)
    axes.set_title("seeds that solve it at the end,\nand steps until they first do", fontsize=9)
    return figure
