"""Figures of the diagonal tunnels that are equally likely to be entered."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_flowpolicy.common.statistics import interquartile_mean
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import GAUSS, LOW_RANK
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SOURCES = ("diagonal-widened", "diagonal-causes")
_ANY = ("any density", "any", "#555555")
_FAMILIES = (
    ("LR, full covariance", "correlated", LOW_RANK.color),
    ("Gauss", "independent", GAUSS.color),
)


def prediction_figure(table: pd.DataFrame, survival: float) -> Figure:
    """Draw entropy and progress at equal survival by number of dimensions.

    Args:
        table: A row per number of dimensions, as the command prints it.
        survival: Probability with which a step survives.
    """
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    label, _, shade = _ANY
    left.plot(table["bound"] - table["uniform"], "o-", color=shade, label=label, markersize=4)
    for label, name, shade in _FAMILIES:
        entropy = table[f"{name}.entropy"]
        left.plot(entropy - table["uniform"], "o-", color=shade, label=label, markersize=4)
        right.plot(table[f"{name}.progress"], "o-", color=shade, markersize=4)
    left.set(title="highest entropy, less that of the uniform density", ylabel="nats")
    right.set(title="standard deviation of the progress of a step", ylabel="share of the reach")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(table.index, table.index.astype(str))
        axes.minorticks_off()
        axes.set_xlabel(f"coupled dimensions; {survival:.0%} of the steps survive")
        axes.grid(color="#eeeeee")
    right.set_ylim(bottom=0.0)
    left.legend(frameon=False)
    return figure


def read_results(results: Path) -> list[Evidence]:
    """Read both experiments' results; raise ``ValueError`` if neither is complete."""
    both = [Evidence(EXPERIMENTS[name], results / name) for name in _SOURCES]
    complete = [evidence for evidence in both if evidence.complete]
    if not complete:
        raise ValueError(f"no complete results of {' or '.join(_SOURCES)} in {results}")
    return complete


def results_figure(table: pd.DataFrame, measured: list[Evidence]) -> Figure:
    """Draw the seeds that find and that solve the task, and their steps, by number of dimensions.

    Broken lines are the predicted numbers of seeds that find the goal by noise alone.
    """
    figure = new_figure(12.0, 4.6)
    found, solved, until = figure.subplots(1, 3)
    curves = [(evidence, agent) for evidence in measured for agent in evidence.experiment.agents]
    for place, (evidence, agent) in enumerate(curves):
        dims = [d for d in table.index if evidence.columns(f"{d}-dimensions", agent.name)]
        pairs = [(f"{d}-dimensions", agent.name) for d in dims]
        # Beside each other, as most agents solve either all seeds or none.
        at = table.index.get_indexer(dims) + 0.06 * (place - (len(curves) - 1) / 2)
        marker = "s" if "action_noise_color" in agent.overrides else "o"
        style: dict[str, Any] = {"color": agent.color, "label": agent.label, "marker": marker}
        style |= {"markersize": 4, "linewidth": 1}
        found.plot(at, [evidence.succeeded(*pair).sum() for pair in pairs], **style)
        solved.plot(at, [evidence.solved(*pair).sum() for pair in pairs], **style)
        steps = [interquartile_mean(evidence.steps_until_solved(*pair)) for pair in pairs]
        middle = np.array([one.value for one in steps])
        bars = np.abs(np.array([[one.low, one.high] for one in steps]).T - middle)
        until.errorbar(at, middle, bars, **style, elinewidth=0.8)
    n_seeds = measured[0].experiment.seeds
    for label, name, shade in (_ANY, *_FAMILIES):
        seeds = n_seeds * table[f"{name}.before_reward.runs"]
        found.plot(range(len(table)), seeds, "--", color=shade, label=f"predicted: {label}")
    found.set(title="seeds that find the goal while training", ylabel=f"of {n_seeds}")
    solved.set(title="seeds that solve the task at the end", ylabel=f"of {n_seeds}")
    until.set(title="steps until solved", ylim=(0.0, None))
    until.yaxis.set_major_formatter("{x:,.0f}")
    for axes in (found, solved, until):
        axes.set_xticks(range(len(table)), table.index.astype(str))
        axes.set_xlabel("coupled dimensions")
        axes.grid(color="#eeeeee")
    figure.legend(
        *found.get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False
    )
    return figure
