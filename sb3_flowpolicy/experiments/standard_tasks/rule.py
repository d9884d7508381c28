"""The rule, and the table and figure of the results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_flowpolicy.common.statistics import BOOTSTRAP_SEED, RESAMPLES, Estimate

RULE = """\
The final value of a run is the mean return of its last two tests, or the share of successes if
the task has a goal. A policy is "not worse than stock" if
the 95 % bootstrap interval of the difference of mean final values, as a share of stock's, reaches
above -5 %, and "better" if it lies above 0. With "surely" the whole interval lies above -5 %."""
_TOLERANCE = -0.05


def finals(table: pd.DataFrame) -> pd.Series:
    """Return the mean of the last two tests of each run: success, or return if there is none."""
    scores = table.assign(score=table["test_success"].fillna(table["test_return"]))
    runs = scores.groupby(["task", "algorithm", "policy", "seed"], sort=False)
    return runs["score"].apply(lambda tests: tests.tail(2).mean())


def difference(ours: np.ndarray, stock: np.ndarray) -> Estimate:
    """Return the difference of the means as a share of stock's, with its 95 % interval.

    If stock's mean is 0, the difference itself.

    Args:
        ours: One final return per seed, (S,).
        stock: The same of the stock policy, (S',).

    Example:
        >>> print(f"{difference(np.array([110.0, 112.0]), np.array([100.0, 100.0])):+.2f}")
        +0.11 (+0.10, +0.12)
    """
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    scale = abs(stock.mean()) or 1.0

    def means(values: np.ndarray) -> np.ndarray:
        return values[rng.integers(len(values), size=(RESAMPLES, len(values)))].mean(1)

    shares = (means(ours) - means(stock)) / scale
    low, high = np.quantile(shares, [0.025, 0.975])
    return Estimate((ours.mean() - stock.mean()) / scale, low, high)


def verdict(found: Estimate) -> str:
    """Return what ``RULE`` says.

    Example:
        >>> verdict(Estimate(0.0, -0.2, 0.2)), verdict(Estimate(0.1, 0.02, 0.2))
        ('not worse', 'better')
    """
    if found.low > 0:
        return "better"
    if found.low > _TOLERANCE:
        return "surely not worse"
    return "not worse" if found.high > _TOLERANCE else "worse"


def summary(table: pd.DataFrame) -> str:
    """Return the results as a Markdown table, with all seeds."""
    lines = [
        "| task | algorithm | policy | final value | against stock | verdict | seeds |",
        "|---|---|---|---|---|---|---|",
    ]
    for (task, algorithm), group in finals(table).groupby(level=[0, 1], sort=False):
        runs = {name: returns.to_numpy() for name, returns in group.groupby(level=2, sort=False)}
        for name, returns in runs.items():
            against = judged = ""
            if name != "stock" and "stock" in runs:
                found = difference(returns, runs["stock"])
                against = f"{found.value:+.0%} ({found.low:+.0%}, {found.high:+.0%})"
                judged = verdict(found)
            each = ", ".join(f"{value:.3g}" for value in returns)
            cells = (task, algorithm, name, f"{returns.mean():.3g}", against, judged, each)
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def save_figure(table: pd.DataFrame, path: Path) -> None:
    """Draw the curves of all seeds, one panel per task and algorithm."""
    from matplotlib.figure import Figure

    groups: Sequence[Any] = list(table.groupby(["task", "algorithm"], sort=False))
    figure = Figure(figsize=(5 * len(groups), 3.6), layout="constrained")
    for axes, ((task, algorithm), group) in zip(
        figure.subplots(1, len(groups), squeeze=False)[0], groups, strict=True
    ):
        for k, (name, runs) in enumerate(group.groupby("policy", sort=False)):
            shade = "black" if name == "stock" else f"C{k}"
            curves = runs.pivot_table(index="step", columns="seed", values="test_return")
            axes.plot(curves.index, curves, color=shade, linewidth=0.6, alpha=0.5)
            axes.plot(curves.index, curves.mean(axis=1), color=shade, linewidth=2, label=name)
        axes.set(title=f"{algorithm} on {task}", xlabel="environment steps", ylabel="return")
        axes.legend()
    figure.savefig(path, dpi=110)
