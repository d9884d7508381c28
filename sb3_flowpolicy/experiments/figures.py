"""Figures: curves, profiles, outcomes, and policies (thesis figures 3.2 to 3.11)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pandas as pd
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Rectangle

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.statistics import interquartile_mean
from sb3_flowpolicy.diagnostics.figures import POLICY_BLUE, new_figure
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import FLOW, Agent
from sb3_flowpolicy.experiments.tables import WORDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WALL, _GOAL = "#d62728", "#78c878"
_VIEW = 1.6
"""Half the edge of a view of the agent, in reaches."""
SMOOTHED_OVER = 3
"""Evaluations that a drawn point averages; numbers in tables are not smoothed."""


def panels(evidence: Evidence) -> list[str]:
    """Return the metrics to draw: the entropy coefficient only if learned.

    The second deterministic action is left to the tables.
    """
    measured = {(s.name, a.name): evidence.columns(s.name, a.name) for s, a in evidence.measured}
    names = {name for columns in measured.values() for name in columns}
    if not any(
        np.ptp(evidence.curves(*pair, "ent_coef")) > 0
        for pair, columns in measured.items()
        if "ent_coef" in columns
    ):
        names.discard("ent_coef")
    return [name for name in WORDS if name in names and not name.startswith("log_prob")]


def curves_figure(evidence: Evidence) -> Figure:
    """Draw all curves: a row per setting, a column per metric.

    Every seed is a thin line, their interquartile mean a bold one, its 95 % interval a band.
    """
    experiment, metrics = evidence.experiment, panels(evidence)
    figure = new_figure(3.3 * len(metrics), 2.5 * len(experiment.settings) + 0.4)
    grid = figure.subplots(len(experiment.settings), len(metrics), squeeze=False)
    for row, setting in zip(grid, experiment.settings, strict=True):
        for axes, metric in zip(row, metrics, strict=True):
            for agent in experiment.agents:
                if metric in evidence.columns(setting.name, agent.name):
                    curves = evidence.curves(setting.name, agent.name, metric)
                    smooth = curves.rolling(SMOOTHED_OVER, min_periods=1).mean()
                    draw_seeds(axes, smooth, agent.color, agent.label)
            _style(axes)
            axes.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x else "0")
            axes.set_xlim(left=0)
            if metric.endswith("success"):
                axes.set_ylim(-0.03, 1.03)
            if metric == "ent_coef":
                axes.set_yscale("log")
        if len(grid) > 1:
            row[0].set_ylabel(setting.name, fontsize=10)
    for above, below, metric in zip(grid[0], grid[-1], metrics, strict=True):
        above.set_title(WORDS[metric], fontsize=10)
        below.set_xlabel("environment steps", fontsize=8)
    handles = {
        label: handle
        for axes in grid.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles, loc="outside upper center", ncols=len(handles), frameon=False
    )
    return figure


def draw_seeds(axes: Axes, curves: pd.DataFrame, shade: str, label: str) -> None:
    """Draw each column thin, their interquartile mean bold, its 95 % interval as a band."""
    mean = interquartile_mean(curves.to_numpy().T)
    axes.plot(curves.index, curves, color=shade, linewidth=0.5, alpha=0.35)
    axes.fill_between(curves.index, mean.low, mean.high, color=shade, alpha=0.2, linewidth=0)
    axes.plot(curves.index, mean.value, color=shade, linewidth=2, label=label)


def _style(axes: Axes) -> None:
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)


def profile_figure(evidence: Evidence) -> Figure | None:
    """Draw the entropy along the way to the goal at the end of training (thesis Fig. 3.8)."""
    found: dict[str, list[tuple[Agent, pd.DataFrame]]] = {}
    for setting, agent in evidence.measured:
        profile = evidence.profile(setting.name, agent.name)
        if profile is not None:
            found.setdefault(setting.name, []).append((agent, profile))
    if not found:
        return None
    figure = new_figure(6.5, 3.0 * len(found))
    column = figure.subplots(len(found), 1, squeeze=False)[:, 0]
    for axes, profiles in zip(column, found.values(), strict=True):
        for agent, profile in profiles:
            draw_seeds(axes, profile, agent.color, agent.label)
        axes.set_xlabel("share of the way from start to goal, on the center line", fontsize=8)
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
        pair = experiment.settings[column].name, experiment.agents[row].name
        if "test_success" not in evidence.columns(*pair):
            continue
        solved = evidence.solved(*pair)
        shares[row, column] = share = solved.mean()
        text = f"{solved.sum()} of {len(solved)}"
        if evidence.solved_once(*pair).any():
            steps = interquartile_mean(evidence.steps_until_solved(*pair))
            text += f"\n{float(steps.value):,.0f} steps"
        shade = "white" if share > 0.6 else "black"  # the fields darken with the share
        axes.text(column, row, text, ha="center", va="center", fontsize=8, color=shade)
    if np.isnan(shares).all():
        return None
    white_to_blue = LinearSegmentedColormap.from_list("shares", ["white", FLOW.color])
    fields = np.arange(columns), np.arange(rows)  # their centers
    axes.pcolormesh(
        *fields, shares, cmap=white_to_blue, vmin=0, vmax=1, edgecolors="white", linewidth=3
    )
    axes.invert_yaxis()
    axes.set_xticks(range(columns), [one.name for one in experiment.settings])
    axes.set_yticks(range(rows), [agent.label for agent in experiment.agents])
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelsize=8)
    axes.spines[:].set_visible(False)
    axes.set_title("seeds that solve it at the end,\nand steps until they first do", fontsize=9)
    return figure


def policies_figure(evidence: Evidence) -> Figure | None:
    """Draw each agent's action samples at several states of one test episode.

    A row per setting, agent and moment of training; first the whole episode, then views of the
    agent at several of its states.
    """
    rows = [
        (setting, agent, picture)
        for setting, agent in evidence.measured
        for picture in evidence.pictures(setting.name, agent.name)
    ]
    if not rows:
        return None
    columns = 1 + max(len(picture["steps"]) for _, _, picture in rows)
    figure = new_figure(2.0 * columns + 0.4, 2.15 * len(rows))
    grid = figure.subplots(len(rows), columns, squeeze=False)
    several = len(evidence.experiment.settings) > 1
    for line, (setting, agent, picture) in zip(grid, rows, strict=True):
        env = gym.make(setting.env_id, **setting.env_kwargs).unwrapped
        for axes in line:
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_color("#dddddd")
        for axes in line[1 + len(picture["steps"]) :]:
            axes.set_axis_off()
        _draw_tunnel(line[0], env)
        trail = np.array(picture["trail"])
        line[0].plot(*trail.T, color="black", linewidth=0.6, marker=".", markersize=3)
        line[0].set(xlim=(-1.04, 1.04), ylim=(-1.04, 1.04), aspect="equal")
        line[0].set_title("the episode", fontsize=7)
        for k, axes in zip(range(len(picture["steps"])), line[1:], strict=False):
            _draw_policy(axes, env, picture, k)
        where = f"{setting.name}, " if several else ""
        line[0].set_ylabel(
            f"{where}{agent.label}\nseed {picture['seed']}, {picture['step'] / 1000:g}k steps",
            fontsize=7,
        )
    return figure


def _draw_tunnel(axes: Axes, env: Any) -> None:
    config = env.config
    path = config.geometry
    center = path.polyline(*path.ends)
    along = np.gradient(center, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across *= config.width / 2 / np.linalg.norm(across, axis=1, keepdims=True)
    goal = path.polyline(*path.goal_arcs)
    axes.plot(*goal.T, color=_GOAL, linewidth=5, solid_capstyle="butt")
    for side in (-1, 1):
        axes.plot(*(center + side * across).T, color=_WALL, linewidth=0.7)


def _draw_policy(axes: Axes, env: Any, picture: dict[str, Any], k: int) -> None:
    x, y = picture["positions"][k]
    trail = np.array(picture["trail"])[: picture["steps"][k] + 1]
    reach, view = env.config.reach, _VIEW * env.config.reach
    ends = (x, y) + reach * np.array(picture["samples"][k])
    corner = x - reach, y - reach
    _draw_tunnel(axes, env)
    axes.scatter(trail[:, 0], trail[:, 1], s=4, color="#969696", linewidths=0)
    axes.add_patch(
        Rectangle(corner, 2 * reach, 2 * reach, fill=False, edgecolor="#aaaaaa", linewidth=0.7)
    )
    axes.scatter(ends[:, 0], ends[:, 1], s=2.5, color=POLICY_BLUE, alpha=0.6, linewidths=0)
    axes.scatter(x, y, s=10, color="black", zorder=3)
    axes.set(xlim=(x - view, x + view), ylim=(y - view, y + view), aspect="equal")
    axes.set_title(f"step {picture['steps'][k]}", fontsize=7)
