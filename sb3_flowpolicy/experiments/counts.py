"""Checks that count seeds: those that solve their task, and those that oscillate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sb3_flowpolicy.experiments.evidence import SWINGS_OF_AN_OSCILLATION, Evidence
from sb3_flowpolicy.experiments.experiment import Agent, Check, Finding

_MOST = 0.9


def solved(setting: str, agent: Agent, share: float, at_best: bool = False) -> Check:
    """Demand that at least this share of the seeds solves the task."""
    when = "at its best" if at_best else "at the end"
    return Check(
        f"{setting}: {agent.label} solves the task {when} in at least {share:.0%} of the seeds",
        _counted(setting, agent, at_best, lambda found: found.mean() >= share - 1e-9),
    )


def mostly_fails(setting: str, agent: Agent, share: float) -> Check:
    """Demand that at most this share of the seeds solves the task at the end."""
    return Check(
        f"{setting}: {agent.label} solves the task at the end in at most {share:.0%} of the seeds",
        _counted(setting, agent, False, lambda found: found.mean() <= share + 1e-9),
    )


def none_fails(setting: str, agent: Agent) -> Check:
    """Demand that every seed solves the task at the end."""
    return Check(
        f"{setting}: no seed of {agent.label} fails",
        _counted(setting, agent, False, lambda found: bool(found.all())),
    )


def _counted(
    setting: str, agent: Agent, at_best: bool, judge: Callable[[np.ndarray], bool]
) -> Callable[[Evidence], Finding]:
    def test(evidence: Evidence) -> Finding:
        found = (evidence.solved_once if at_best else evidence.solved)(setting, agent.name)
        return Finding(bool(judge(found)), f"{found.sum()} of {len(found)}")

    return test


def oscillates(setting: str, agent: Agent, share: float) -> Check:
    """Demand that at least this share of the seeds oscillates."""
    return Check(
        f"{setting}: {agent.label} oscillates (at least {SWINGS_OF_AN_OSCILLATION} swings in "
        f"return, entropy and temperature) in at least {share:.0%} of the seeds",
        _swinging(setting, agent, lambda flags: flags.mean() >= share - 1e-9),
    )


def is_steady(setting: str, agent: Agent, share: float) -> Check:
    """Demand that at most this share of the seeds oscillates, and that most learn something.

    A seed that never gets anywhere has nothing to swing between: it shows no steadiness.
    """

    def test(evidence: Evidence) -> Finding:
        finding = _swinging(setting, agent, lambda flags: flags.mean() <= share + 1e-9)(evidence)
        learned = evidence.succeeded(setting, agent.name)
        return Finding(
            bool(finding.holds) and bool(learned.mean() >= _MOST),
            f"{finding.measured}; {learned.sum()} of {len(learned)} ever succeed in training",
        )

    return Check(
        f"{setting}: {agent.label} oscillates in at most {share:.0%} of the seeds, and at least "
        f"{_MOST:.0%} of them learn to succeed in training",
        test,
    )


def _swinging(
    setting: str, agent: Agent, judge: Callable[[np.ndarray], bool]
) -> Callable[[Evidence], Finding]:
    def test(evidence: Evidence) -> Finding:
        counts = evidence.oscillations(setting, agent.name)
        flags = counts >= SWINGS_OF_AN_OSCILLATION
        swings = ", ".join(str(count) for count in counts)
        return Finding(
            bool(judge(flags)), f"{flags.sum()} of {len(flags)} (swings per seed: {swings})"
        )

    return test
