"""The rule, and the table and figure of the results."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from sb3_flowpolicy.common.statistics import Estimate
from sb3_flowpolicy.diagnostics.figures import new_figure
from sb3_flowpolicy.experiments.figures import draw_seeds
from sb3_flowpolicy.experiments.tables import markdown

RULE = """\
The final value of a run is the mean return of its last two tests, or the share of successes where
the task has a goal. Differences from stock have a 95 % interval (Welch's) and are relative to
stock's mean return, or absolute for successes. "better": the interval lies above 0. "not worse": it
lies above -5 %. "worse": it lies below -5 %. Otherwise, and with fewer than five seeds:
"undecided". Our policies are never worse than stock if no verdict is "worse"."""
_TOLERANCE, _FEWEST_SEEDS = -0.05, 5


def finals(table: pd.DataFrame) -> pd.Series:
    """Return the mean of the last two tests of each run: success, or return if there is none."""
    scores = table.assign(score=table["test_success"].fillna(table["test_return"]))
    runs = scores.groupby(["task", "algorithm", "policy", "seed"], sort=False)
    return runs["score"].apply(lambda tests: tests.tail(2).mean())


def difference(ours: np.ndarray, stock: np.ndarray, scale: float = 1.0) -> Estimate:
    """Return the difference of the means as a share of ``scale``, with its 95 % interval.

    ``ours`` and ``stock`` hold a final value per seed, at least two each.

    Example:
        >>> print(f"{difference(np.array([110.0, 112.0]), np.array([99.0, 101.0]), 100.0):+.2f}")
        +0.11 (+0.05, +0.17)
    """
    mean = (ours.mean() - stock.mean()) / scale
    if np.ptp(ours) == np.ptp(stock) == 0.0:  # all seeds solve the task, or none does
        return Estimate(mean, mean, mean)
    with warnings.catch_warnings():  # about seeds of one policy that are all equal
        warnings.simplefilter("ignore", RuntimeWarning)
        interval = ttest_ind(ours, stock, equal_var=False).confidence_interval(0.95)
    return Estimate(mean, interval.low / scale, interval.high / scale)


def verdict(found: Estimate) -> str:
    """Return what ``RULE`` says of enough seeds.

    Example:
        >>> verdict(Estimate(0.0, -0.2, 0.2)), verdict(Estimate(0.1, 0.02, 0.2))
        ('undecided', 'better')
    """
    if found.low > 0:
        return "better"
    if found.low > _TOLERANCE:
        return "not worse"
    return "worse" if found.high < _TOLERANCE else "undecided"


def summary(table: pd.DataFrame) -> str:
    """Return the results as a Markdown table, with all seeds."""
    rows = []
    has_goal = table.groupby(["task", "algorithm"])["test_success"].count() > 0
    for (task, algorithm), group in finals(table).groupby(level=[0, 1], sort=False):
        runs = {name: returns.to_numpy() for name, returns in group.groupby(level=2, sort=False)}
        for name, returns in runs.items():
            against = judged = ""
            stock = runs.get("stock")
            if name != "stock" and stock is not None and min(len(returns), len(stock)) > 1:
                scale = 1.0 if has_goal[task, algorithm] else abs(stock.mean())
                found = difference(returns, stock, scale)
                against = f"{found.value:+.0%} ({found.low:+.0%}, {found.high:+.0%})"
                enough = min(len(returns), len(stock)) >= _FEWEST_SEEDS
                judged = verdict(found) if enough else "undecided"
            each = ", ".join(f"{value:.3g}" for value in returns)
            rows.append((task, algorithm, name, f"{returns.mean():.3g}", against, judged, each))
    head = ("task", "algorithm", "policy", "final value", "against stock", "verdict", "seeds")
    return markdown(pd.DataFrame(rows, columns=head))


def save_figure(table: pd.DataFrame, path: Path) -> None:
    """Draw the curves of all seeds, one panel per task and algorithm."""
    groups: Sequence[Any] = list(table.groupby(["task", "algorithm"], sort=False))
    figure = new_figure(5 * len(groups), 3.6)
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, ((task, algorithm), group) in zip(panels, groups, strict=True):
        for k, (name, runs) in enumerate(group.groupby("policy", sort=False)):
            scores = runs.assign(score=runs["test_success"].fillna(runs["test_return"]))
            curves = scores.pivot_table(index="step", columns="seed", values="score")
            draw_seeds(axes, curves, "black" if name == "stock" else f"C{k}", name)
        axes.set(
            title=f"{algorithm} on {task}",
            xlabel="environment steps",
            ylabel="return" if group["test_success"].isna().all() else "share of successes",
        )
        axes.legend()
    figure.savefig(path, dpi=110)
