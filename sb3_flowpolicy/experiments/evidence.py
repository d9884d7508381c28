"""Results of an experiment, in the terms that rules and tables use."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_flowpolicy.experiments.curves import running_mean, swings
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

# The share of evaluations, at the end of training, that "final" refers to, and the least number.
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

    Args:
        experiment: The experiment.
        folder: Its folder, complete or not.
        others: Returns the evidence of another experiment by name, None if there is none.

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
        self.files = {key: ItemFiles(folder, key) for key in self.items}
        self.done = {
            key: self.files[key].read_done(item["steps"], item["seeds"])
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
        wanted = {
            (setting.name, agent.name)
            for setting in self.experiment.settings
            for agent in self.experiment.agents
        }
        return wanted <= there and all(self.done.values())

    @property
    def seeds(self) -> list[int]:
        """All seeds of the run."""
        return self.settings.get("seeds", [])

    @cached_property
    def _logs(self) -> dict[tuple[str, str], pd.DataFrame]:
        logs: dict[tuple[str, str], list[pd.DataFrame]] = {}
        for key, item in self.items.items():
            table = self.files[key].read_table()
            if not table.empty:
                logs.setdefault((item["setting"], item["agent"]), []).append(table)
        return {pair: pd.concat(tables) for pair, tables in logs.items()}

    @cached_property
    def _details(self) -> dict[tuple[str, str], list[dict[str, Any]]]:
        details: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for key, item in self.items.items():
            found = details.setdefault((item["setting"], item["agent"]), [])
            found += self.files[key].read_details()
        return details

    def has(self, setting: str, agent: str) -> bool:
        """Whether there is anything of this agent on this setting."""
        return (setting, agent) in self._logs

    @property
    def measured(self) -> list[tuple[Setting, Agent]]:
        """All settings and agents of which there is anything."""
        return [
            (setting, agent)
            for setting in self.experiment.settings
            for agent in self.experiment.agents
            if self.has(setting.name, agent.name)
        ]

    def columns(self, setting: str, agent: str) -> list[str]:
        """Return the metrics that were measured for every seed of this agent."""
        if not self.has(setting, agent):
            return []
        counts = self._logs[setting, agent].groupby("seed").count()
        return [name for name in counts if counts[name].all() and name not in BASIC_COLUMNS[:3]]

    def curves(self, setting: str, agent: str, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """Return a metric of all seeds on a common grid: all steps at which any was measured.

        Between measurements it is linear, before the first constant.

        Returns:
            Steps (T,) and values (S, T); the grid ends where the shortest log does.

        Raises:
            NotMeasuredError: If it was not measured.
        """
        if metric not in self.columns(setting, agent):
            raise NotMeasuredError(f"{metric} of {agent} on {setting}")
        log = self._logs[setting, agent]
        end = log.groupby("seed")["step"].max().min()
        curves = log.pivot(index="step", columns="seed", values=metric)
        curves = curves.interpolate(method="index").bfill().loc[:end]
        # A copy has its seeds in rows, so that sums over steps keep their order and last digit.
        return curves.index.to_numpy(), curves.to_numpy().T.copy()

    def final(self, setting: str, agent: str, metric: str) -> np.ndarray:
        """Return each seed's mean over the last tenth of its evaluations, (S,)."""
        _, values = self.curves(setting, agent, metric)
        return values[:, -max(FINAL_LEAST, round(FINAL_SHARE * values.shape[1])) :].mean(1)

    def best(self, setting: str, agent: str, metric: str) -> np.ndarray:
        """Return each seed's best mean over three evaluations in a row, (S,)."""
        _, values = self.curves(setting, agent, metric)
        return running_mean(values, IN_A_ROW)[:, IN_A_ROW - 1 :].max(1, initial=-np.inf)

    def solved(self, setting: str, agent: str) -> np.ndarray:
        """Return which seeds succeed at the end, (S,)."""
        return self.final(setting, agent, "test_success") >= SOLVED - _ROUNDING

    def solved_once(self, setting: str, agent: str) -> np.ndarray:
        """Return which seeds succeed at their best, (S,)."""
        return self.best(setting, agent, "test_success") >= SOLVED - _ROUNDING

    def steps_until_solved(self, setting: str, agent: str) -> np.ndarray:
        """Return the step at which each seed first succeeds in a row of evaluations, (S,).

        Seeds that never do count with the length of training, a lower bound.
        """
        steps, values = self.curves(setting, agent, "test_success")
        reached = running_mean(values, IN_A_ROW) >= SOLVED - _ROUNDING
        reached[:, : IN_A_ROW - 1] = False
        return np.where(reached.any(1), steps[reached.argmax(1)], steps[-1])

    def oscillations(self, setting: str, agent: str) -> np.ndarray:
        """Return the number of swings of each seed, the least over the three curves, (S,).

        Counted from the first training success on, in training return, entropy and the logarithm
        of the entropy coefficient, each averaged over three evaluations. In the thesis all three
        swing together, so the curve with the fewest swings decides.
        """
        _, success = self.curves(setting, agent, "train_success")
        counts = []
        amplitudes = {**OSCILLATIONS}
        amplitudes["train_return"] *= self._best_test_return(setting)
        for metric, amplitude in amplitudes.items():
            _, values = self.curves(setting, agent, metric.removeprefix("log_"))
            curves = np.log(values) if metric.startswith("log_") else values
            smooth = running_mean(curves, IN_A_ROW)
            counts.append(
                [
                    swings(curve[start:], amplitude)
                    for curve, start in zip(smooth, _first(success > 0), strict=True)
                ]
            )
        return np.min(counts, axis=0)

    def succeeded(self, setting: str, agent: str) -> np.ndarray:
        """Return which seeds ever succeeded in training, (S,)."""
        _, success = self.curves(setting, agent, "train_success")
        return np.any(success > 0, axis=1)

    def _best_test_return(self, setting: str) -> float:
        """Return the highest test return of any agent, the unit of swings in return."""
        agents = [agent.name for one, agent in self.measured if one.name == setting]
        return max(float(self.curves(setting, one, "test_return")[1].max()) for one in agents)

    def profile(self, setting: str, agent: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Return shares of the way (K,) and the entropy there (S, K) at the end of training."""
        found = self._kind("profile", setting, agent)
        if not found:
            return None
        return np.array(found[0]["way"]), np.array([one["entropy"] for one in found])

    def front_loading(self, setting: str, agent: str) -> np.ndarray:
        """Return each seed's entropy at the start less the mean along the way, (S,).

        Every episode visits the start, and then hardly any state before the end of its first step.
        """
        profile = self.profile(setting, agent)
        if profile is None:
            raise NotMeasuredError(f"profile of {agent} on {setting}")
        entropy = profile[1]
        return entropy[:, 0] - entropy.mean(1)

    def pictures(self, setting: str, agent: str) -> list[dict[str, Any]]:
        """Return the recorded policies, in order of steps."""
        return sorted(self._kind("picture", setting, agent), key=lambda one: one["step"])

    def _kind(self, kind: str, setting: str, agent: str) -> list[dict[str, Any]]:
        return [one for one in self._details.get((setting, agent), []) if one["kind"] == kind]


def _first(flags: np.ndarray) -> np.ndarray:
    """Return the index of each row's first True, the length of the row if there is none."""
    return np.where(flags.any(1), flags.argmax(1), flags.shape[1] - 1)
