"""Interactive curves for the page: the same lines as in ``figures.py``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from sb3_flowpolicy.common.statistics import interquartile_mean
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import Agent
from sb3_flowpolicy.experiments.figures import color, smoothed
from sb3_flowpolicy.experiments.tables import WORDS


def curves_plot(evidence: Evidence, setting: str, metric: str) -> go.Figure:
    """Draw one metric of all agents on one setting; a click on the legend hides an agent."""
    figure = go.Figure()
    for agent in evidence.experiment.agents:
        if metric in evidence.columns(setting, agent.name):
            _add(figure, agent, smoothed(evidence.curves(setting, agent.name, metric)))
    _dress(figure, WORDS.get(metric, metric), "environment steps")
    if metric == "ent_coef":
        figure.update_yaxes(type="log")
    if metric.endswith("success"):
        figure.update_yaxes(range=[-0.03, 1.03])
    return figure


def profile_plot(evidence: Evidence, setting: str) -> go.Figure | None:
    """Draw the entropy along the way to the goal; None where it was not measured."""
    figure = go.Figure()
    for agent in evidence.experiment.agents:
        profile = evidence.profile(setting, agent.name)
        if profile is not None:
            _add(figure, agent, profile)
    if not figure.data:
        return None
    _dress(figure, "entropy along the way, at the end", "share of the way from start to goal")
    return figure


def _add(figure: go.Figure, agent: Agent, curves: pd.DataFrame) -> None:
    x, values = curves.index.to_numpy(), curves.to_numpy().T
    shade, mean = color(agent), interquartile_mean(values)
    group: dict[str, Any] = {"name": agent.label, "legendgroup": agent.name, "mode": "lines"}
    silent = {**group, "hoverinfo": "skip", "showlegend": False}
    # One trace for all seeds, with gaps in between: a phone draws few traces quickly.
    each_x = [number for _ in values for number in [*_short(x), None]]
    each_y = [number for seed in values for number in [*_short(seed), None]]
    thin = {"color": shade, "width": 0.6}
    figure.add_scatter(x=each_x, y=each_y, line=thin, opacity=0.4, **silent)
    around = [*_short(x), *_short(x[::-1])]
    band = [*_short(mean.high), *_short(mean.low[::-1])]
    fill = {"fill": "toself", "fillcolor": shade, "line": {"width": 0}}
    figure.add_scatter(x=around, y=band, opacity=0.18, **fill, **silent)
    bold = {"color": shade, "width": 2.5}
    figure.add_scatter(x=_short(x), y=_short(mean.value), line=bold, **group)


def _dress(figure: go.Figure, title: str, x_title: str) -> None:
    axis = {"gridcolor": "#eeeeee", "zeroline": False, "fixedrange": False}
    figure.update_layout(
        title={"text": title, "font": {"size": 15}, "x": 0.02, "y": 0.97},
        template="none",
        margin={"l": 46, "r": 10, "t": 38, "b": 74},
        height=320,
        hovermode="x unified",
        legend={"orientation": "h", "y": -0.24, "x": 0},
        font={"size": 12},
    )
    figure.update_xaxes(title={"text": x_title, "font": {"size": 12}}, **axis)
    figure.update_yaxes(**axis)


def _short(values: np.ndarray) -> list[float]:
    return [float(f"{value:.4g}") if abs(value) < 1000 else round(value) for value in values]
