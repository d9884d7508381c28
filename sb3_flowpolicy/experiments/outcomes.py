"""Who solves what, at one glance: a field per agent and setting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_flowpolicy.common.statistics import interquartile_mean
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.evidence import Evidence

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Colour of a field whose seeds all succeed; white is none.
_FULL = np.array([0.0, 0.447, 0.698])
# From here on a field is so dark that its text has to be white.
_DARK = 0.6


def outcomes_figure(evidence: Evidence) -> Figure | None:
    """Draw the share of seeds that solve their task at the end: a row per agent.

    Each field says how many seeds do, and after how many steps (interquartile mean; seeds that
    never solve it count with the length of training).

    Args:
        evidence: Results, complete or not.

    Returns:
        A matplotlib figure; None with a single setting, or where success was not measured.
    """
    experiment = evidence.experiment
    fields = {
        (row, column): (evidence.solved(setting.name, agent.name), setting.name, agent.name)
        for column, setting in enumerate(experiment.settings)
        for row, agent in enumerate(experiment.agents)
        if "test_success" in evidence.columns(setting.name, agent.name)
    }
    columns, rows = len(experiment.settings), len(experiment.agents)
    if columns < 2 or not fields:
        return None
    figure = new_figure(1.6 + 1.5 * columns, 0.9 + 0.5 * rows)
    axes = figure.subplots()
    for (row, column), (solved, setting, agent) in fields.items():
        share = solved.mean()
        axes.fill_between([column, column + 1], row, row + 1, color=1 - share * (1 - _FULL))
        text = f"{solved.sum()} of {len(solved)}"
        if evidence.solved_once(setting, agent).any():
            steps = interquartile_mean(evidence.steps_until_solved(setting, agent))
            text += f"\n{float(steps.value):,.0f} steps"
        shade = "white" if share > _DARK else "black"
        axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8, color=shade)
    axes.set(xlim=(0, columns), ylim=(rows, 0))
    axes.set_xticks([k + 0.5 for k in range(columns)], [one.name for one in experiment.settings])
    axes.set_yticks([k + 0.5 for k in range(rows)], [agent.label for agent in experiment.agents])
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelsize=8)
    for k in range(1, columns):
        axes.axvline(k, color="white", linewidth=3)
    for k in range(1, rows):
        axes.axhline(k, color="white", linewidth=3)
    axes.spines[:].set_visible(False)
    axes.set_title("seeds that solve it at the end,\nand steps until they first do", fontsize=9)
    return figure
