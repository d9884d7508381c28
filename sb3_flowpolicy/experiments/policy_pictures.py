"""Policies drawn in their tunnel, from recorded samples (thesis figures 3.2, 3.4, 3.6, 3.8)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.diagnostics.figures import POLICY_BLUE, new_figure
from sb3_flowpolicy.experiments.evidence import Evidence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WALL, _GOAL = "#d62728", "#78c878"
_VIEW = 1.6
"""Half the edge of a view of the agent, in reaches."""


def policies_figure(evidence: Evidence) -> Figure | None:
    """Draw each agent's action samples at several states of one test episode.

    A row per setting, agent and moment of training; first the whole episode, then views of the
    agent at several of its states.
    """
    rows = [
        (setting, agent, picture)
        for setting in evidence.experiment.settings
        for agent in evidence.experiment.agents
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
    low, high = path.ends
    centre = path.polyline(low, high)
    along = np.gradient(centre, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]])
    across *= config.width / 2 / np.linalg.norm(across, axis=1, keepdims=True)
    goal = path.polyline(*path.goal_arcs)
    axes.plot(*goal.T, color=_GOAL, linewidth=5, solid_capstyle="butt")
    for side in (-1, 1):
        axes.plot(*(centre + side * across).T, color=_WALL, linewidth=0.7)


def _draw_policy(axes: Axes, env: Any, picture: dict[str, Any], k: int) -> None:
    from matplotlib.patches import Rectangle

    x, y = picture["positions"][k]
    trail = np.array(picture["trail"])[: picture["steps"][k] + 1]
    reach, view = env.config.reach, _VIEW * env.config.reach
    ends = (x, y) + reach * np.array(picture["samples"][k])
    box = {"fill": False, "edgecolor": "#aaaaaa", "linewidth": 0.7}
    _draw_tunnel(axes, env)
    axes.scatter(*trail.T, s=4, color="#969696", linewidths=0)
    axes.add_patch(Rectangle((x - reach, y - reach), 2 * reach, 2 * reach, **box))
    axes.scatter(*ends.T, s=2.5, color=POLICY_BLUE, alpha=0.6, linewidths=0)
    axes.scatter(x, y, s=10, color="black", zorder=3)
    axes.set(xlim=(x - view, x + view), ylim=(y - view, y + view), aspect="equal")
    axes.set_title(f"step {picture['steps'][k]}", fontsize=7)
