"""Results of an experiment, in the terms that rules and tables use."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_flowpolicy.experiments.experiment import (
    NOT_MEASURED,
    NOT_REPRODUCED,
    PARTLY,
    REPRODUCED,
    Agent,
    Check,
    Experiment,
    Finding,
    NotMeasuredError,
    Setting,
)
from sb3_flowpolicy.experiments.store import BASIC_COLUMNS, ItemFiles, read_settings

# "Final" values are means over this share of the evaluations, and at least so many, at the end.
FINAL_SHARE, FINAL_LEAST = 0.1, 3
# Success rate of deterministic episodes from which on a seed has solved its task.
SOLVED = 0.8
# Three times 0.8, summed and divided by three, is a little less than 0.8.
_ROUNDING = 1e-9
# Consecutive evaluations that count for "at its best" and for "steps until solved".
IN_A_ROW = 3

OSCILLATIONS = {"train_return": 0.25, "entropy": 1.0, "log_ent_coef": 0.1}
"""What counts as a swing: a quarter of the best test return, a nat, a tenth of the coefficient."""
SWINGS_OF_AN_OSCILLATION = 3
"""Up, down, up and down again, or the reverse: a single overshoot is no oscillation."""


class Evidence:
    """Results of one experiment.

    Curves are data frames with a row per step and a column per seed; other results are arrays with
    a value per seed, (S,). The folder need not be complete; ``others`` returns the evidence of
    another experiment by its name.

    Raises:
        ValueError: If a file is corrupt, or was changed since its item was finished.
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path,
        others: Callable[[str], Evidence | None] = lambda name: None,
    ) -> None:
        self.experiment, self.folder, self.others = experiment, folder, others
        self.settings = read_settings(folder) or {}
        self.items: dict[str, dict[str, Any]] = self.settings.get("items", {})
        self.done = {
            key: ItemFiles(folder, key).read_done(item["steps"], item["seeds"])
            for key, item in self.items.items()
        }

    def judge(self) -> tuple[str, list[Finding]]:
        """Apply the experiment's rule; return the verdict and the result of each check."""
        checks = self.experiment.checks
        if not self.complete:
            return NOT_MEASURED, [Finding(None, "runs are missing") for _ in checks]
        findings = [self._test(check) for check in checks]
        held = [finding.holds for finding in findings]
        if None in held:
            return NOT_MEASURED, findings
        if all(held):
            return REPRODUCED, findings
        return (PARTLY if any(held) else NOT_REPRODUCED), findings

    def _test(self, check: Check) -> Finding:
        try:
            return check.test(self)
        except NotMeasuredError as error:
            return Finding(None, f"{error} was not measured")

    @property
    def complete(self) -> bool:
        """Whether all agents have finished on all settings."""
        there = {(item["setting"], item["agent"]) for item in self.items.values()}
        wanted = {(setting.name, agent.name) for setting, agent in self.experiment.pairs}
        return wanted <= there and all(self.done.values())

    @cached_property
    def _logs(self) -> dict[tuple[str, str], pd.DataFrame]:
        logs: dict[tuple[str, str], pd.DataFrame] = {}
        for key, item in self.items.items():
            table, pair = ItemFiles(self.folder, key).read_table(), (item["setting"], item["agent"])
            if not table.empty:
                logs[pair] = pd.concat([logs.get(pair), table])
        return logs

    @property
    def measured(self) -> list[tuple[Setting, Agent]]:
        """All settings and agents of which there is anything."""
        return [
            (setting, agent)
            for setting, agent in self.experiment.pairs
            if (setting.name, agent.name) in self._logs
        ]

    def columns(self, setting: str, agent: str) -> list[str]:
        """Return the metrics that were measured for every seed of this agent."""
        if (setting, agent) not in self._logs:
            return []
        counts = self._logs[setting, agent].groupby("seed").count()
        return [name for name in counts if counts[name].all() and name not in BASIC_COLUMNS[:3]]

    def curves(self, setting: str, agent: str, metric: str) -> pd.DataFrame:
        """Return a metric of all seeds on a common grid: all steps at which any was measured.

        Between measurements it is linear, before the first constant. The grid ends where the
        shortest log does.

        Raises:
            NotMeasuredError: If it was not measured.
        """
        if metric not in self.columns(setting, agent):
            raise NotMeasuredError(f"{metric} of {agent} on {setting}")
        log = self._logs[setting, agent]
        end = log.groupby("seed")["step"].max().min()
        curves = log.pivot(index="step", columns="seed", values=metric)
        return curves.interpolate(method="index").bfill().loc[:end]

    def final(self, setting: str, agent: str, metric: str) -> np.ndarray:
        """Return each seed's mean over the last tenth of its evaluations, at least three, (S,)."""
        curves = self.curves(setting, agent, metric)
        return curves.tail(max(FINAL_LEAST, round(FINAL_SHARE * len(curves)))).mean().to_numpy()

    def solved(self, setting: str, agent: str, metric: str = "test_success") -> np.ndarray:
        """Return which seeds succeed at the end, (S,)."""
        return self.final(setting, agent, metric) >= SOLVED - _ROUNDING

    def _solved_at(self, setting: str, agent: str) -> pd.DataFrame:
        """Return whether the last evaluations in a row succeed, by step and seed."""
        success = self.curves(setting, agent, "test_success")
        return success.rolling(IN_A_ROW).mean() >= SOLVED - _ROUNDING

    def solved_once(self, setting: str, agent: str) -> np.ndarray:
        """Return which seeds succeed at their best, (S,)."""
        return self._solved_at(setting, agent).any().to_numpy()

    def steps_until_solved(self, setting: str, agent: str) -> np.ndarray:
        """Return the step at which each seed first succeeds in a row of evaluations, (S,).

        Seeds that never do count with the length of training, a lower bound.
        """
        return _first(self._solved_at(setting, agent)).to_numpy()

    def oscillations(self, setting: str, agent: str) -> np.ndarray:
        """Return the number of swings of each seed, the least over the three curves, (S,).

        Counted from the first training success on, in training return, entropy and the logarithm
        of the entropy coefficient, each averaged over three evaluations. In the thesis all three
        swing together, so the curve with the fewest swings decides.
        """
        starts = _first(self.curves(setting, agent, "train_success") > 0)
        rivals = [other.name for one, other in self.measured if one.name == setting]
        best_return = max(self.curves(setting, one, "test_return").max(axis=None) for one in rivals)
        counts = []
        for metric, amplitude in OSCILLATIONS.items():
            curves = self.curves(setting, agent, metric.removeprefix("log_"))
            curves = np.log(curves) if metric.startswith("log_") else curves
            smooth = curves.rolling(IN_A_ROW, min_periods=1).mean()
            size = amplitude * (best_return if metric == "train_return" else 1.0)
            counts.append([swings(smooth.loc[starts[s] :, s].to_numpy(), size) for s in smooth])
        return np.min(counts, axis=0)

    def succeeded(self, setting: str, agent: str) -> np.ndarray:
        """Return which seeds ever succeeded in training, (S,)."""
        return (self.curves(setting, agent, "train_success") > 0).any().to_numpy()

    def profile(self, setting: str, agent: str) -> pd.DataFrame | None:
        """Return the entropy at the end of training by share of the way (rows) and seed."""
        found = self._details("profile", setting, agent)
        if not found:
            return None
        return pd.DataFrame({one["seed"]: one["entropy"] for one in found}, found[0]["way"])

    def front_loading(self, setting: str, agent: str) -> np.ndarray:
        """Return each seed's entropy at the start less the mean along the way, (S,).

        Every episode visits the start, but hardly any state within a step of it.
        """
        profile = self.profile(setting, agent)
        if profile is None:
            raise NotMeasuredError(f"profile of {agent} on {setting}")
        return (profile.iloc[0] - profile.mean()).to_numpy()

    def pictures(self, setting: str, agent: str) -> list[dict[str, Any]]:
        """Return the recorded policies, in order of steps."""
        return sorted(self._details("picture", setting, agent), key=lambda one: one["step"])

    def _details(self, kind: str, setting: str, agent: str) -> list[dict[str, Any]]:
        return [
            detail
            for key, item in self.items.items()
            if (item["setting"], item["agent"]) == (setting, agent)
            for detail in ItemFiles(self.folder, key).read_details()
            if detail["kind"] == kind
        ]


def swings(values: np.ndarray, amplitude: float) -> int:
    """Count how often a curve turns round after moving at least ``amplitude`` one way.

    Small wiggles do not count. A monotonic curve has none, a square wave over three periods five.

    Example:
        >>> swings(np.array([0.0, 1.0, 0.1, 0.2, 0.9, 0.0]), 0.5)
        3
        >>> swings(np.linspace(0, 9, 50), 1.5)
        0
    """
    low = high = values[0]
    direction, turns = 0, 0
    for value in values[1:]:
        low, high = min(low, value), max(high, value)
        if direction >= 0 and high - value >= amplitude:
            turns += direction
            direction, low = -1, value
        elif direction <= 0 and value - low >= amplitude:
            turns -= direction
            direction, high = 1, value
    return turns


def _first(flags: pd.DataFrame) -> pd.Series:
    """Return the index of each column's first True, the last index if there is none."""
    return flags.idxmax().where(flags.any(), flags.index[-1])
