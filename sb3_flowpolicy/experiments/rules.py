"""The checks that rules are made of. Each states what it demands and shows what it found."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from sb3_flowpolicy.experiments.evidence import SWINGS_OF_AN_OSCILLATION, Evidence
from sb3_flowpolicy.experiments.experiment import Agent, Check, Finding
from sb3_flowpolicy.experiments.statistics import interquartile_mean, probability_of_improvement

WORDS = {
    "train_return": "training return",
    "train_success": "training success",
    "test_return": "test return",
    "test_success": "test success",
    "entropy": "entropy",
    "ent_coef": "temperature",
    "same_axis_correlation": "correlation of same-axis actions",
}
"""How metrics are called in sentences."""


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


def ordered(setting: str, metric: str, agents: Sequence[Agent], margin: float = 0.0) -> Check:
    """Demand that the final value falls from agent to agent, by at least ``margin`` each."""
    names = " > ".join(agent.label for agent in agents)
    by = f", by at least {margin:g} each" if margin else ""

    def test(evidence: Evidence) -> Finding:
        finals = [evidence.final(setting, agent.name, metric) for agent in agents]
        means = [interquartile_mean(final) for final in finals]
        chances = [
            probability_of_improvement(more, less) for more, less in itertools.pairwise(finals)
        ]
        falls = all(
            float(more.value - less.value) > margin for more, less in itertools.pairwise(means)
        )
        return Finding(
            falls,
            "; ".join(f"{a.label} {m:.2f}" for a, m in zip(agents, means, strict=True))
            + "; probability of improvement "
            + ", ".join(f"{float(chance.value):.2f}" for chance in chances),
        )

    return Check(f"{setting}: final {WORDS.get(metric, metric)} (IQM) {names}{by}", test)


def about_equal(setting: str, metric: str, agents: Sequence[Agent], tolerance: float) -> Check:
    """Demand that the final values lie within ``tolerance`` of the largest, as a share of it."""
    names = ", ".join(agent.label for agent in agents)

    def test(evidence: Evidence) -> Finding:
        means = [interquartile_mean(evidence.final(setting, a.name, metric)) for a in agents]
        values = [float(mean.value) for mean in means]
        equal = max(values) - min(values) <= tolerance * max(abs(value) for value in values)
        listed = "; ".join(f"{a.label} {m:.2f}" for a, m in zip(agents, means, strict=True))
        return Finding(equal, listed)

    words = WORDS.get(metric, metric)
    return Check(
        f"{setting}: final {words} (IQM) of {names} within {tolerance:.0%} of the largest", test
    )


def at_least_times(setting: str, metric: str, more: Agent, less: Agent, factor: float) -> Check:
    """Demand that one agent's final value is at least ``factor`` times the other's."""

    def test(evidence: Evidence) -> Finding:
        a, b = (
            interquartile_mean(evidence.final(setting, agent.name, metric))
            for agent in (more, less)
        )
        holds = float(a.value) >= factor * float(b.value)
        ratio = f", {float(a.value) / float(b.value):.2f} times" if b.value > 0 else ""
        return Finding(holds, f"{more.label} {a:.2f}; {less.label} {b:.2f}{ratio}")

    words = WORDS.get(metric, metric)
    return Check(
        f"{setting}: final {words} (IQM) of {more.label} at least {factor:g} times that of "
        f"{less.label}",
        test,
    )


def slower(setting: str, slow: Agent, others: Sequence[Agent]) -> Check:
    """Demand that one agent needs more steps until it solves the task than each other one."""
    names = " and ".join(agent.label for agent in others)

    def test(evidence: Evidence) -> Finding:
        means = {
            agent.label: interquartile_mean(evidence.steps_until_solved(setting, agent.name))
            for agent in (slow, *others)
        }
        holds = all(means[slow.label].value > means[other.label].value for other in others)
        return Finding(holds, "; ".join(f"{label} {mean:,.0f}" for label, mean in means.items()))

    return Check(f"{setting}: {slow.label} needs more steps (IQM) to solve it than {names}", test)


def oscillates(setting: str, agent: Agent, share: float) -> Check:
    """Demand that at least this share of the seeds oscillates."""
    return Check(
        f"{setting}: {agent.label} oscillates (at least {SWINGS_OF_AN_OSCILLATION} swings in "
        f"return, entropy and temperature) in at least {share:.0%} of the seeds",
        _swinging(setting, agent, lambda flags: flags.mean() >= share - 1e-9),
    )


def is_steady(setting: str, agent: Agent, share: float) -> Check:
    """Demand that at most this share of the seeds oscillates."""
    return Check(
        f"{setting}: {agent.label} oscillates in at most {share:.0%} of the seeds",
        _swinging(setting, agent, lambda flags: flags.mean() <= share + 1e-9),
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


def front_loads(setting: str, agent: Agent, than: Agent, margin: float) -> Check:
    """Demand that an agent holds more entropy early on the way than late, and another does less.

    Args:
        setting: The setting.
        agent: Who is said to put its entropy first.
        than: Who is said to do so less.
        margin: Least difference between the two, nats.
    """

    def test(evidence: Evidence) -> Finding:
        a, b = (
            interquartile_mean(evidence.front_loading(setting, one.name)) for one in (agent, than)
        )
        holds = float(a.value) > 0 and float(a.value - b.value) >= margin
        return Finding(holds, f"{agent.label} {a:.2f} nats; {than.label} {b:.2f} nats")

    return Check(
        f"{setting}: entropy on the first third of the way less that on the last (IQM) is above 0 "
        f"for {agent.label}, and at least {margin:g} nats more than for {than.label}",
        test,
    )


def reaches(setting: str, metric: str, agent: Agent, least: float) -> Check:
    """Demand that the final value is at least ``least``."""

    def test(evidence: Evidence) -> Finding:
        mean = interquartile_mean(evidence.final(setting, agent.name, metric))
        return Finding(bool(mean.value >= least), f"{mean:.0f}")

    words = WORDS.get(metric, metric)
    return Check(f"{setting}: final {words} (IQM) of {agent.label} at least {least:g}", test)


def no_better_than(other: str, setting: str, agents: Sequence[Agent]) -> Check:
    """Demand that agents end with no higher training success than in another experiment."""
    names = ", ".join(agent.label for agent in agents)

    def test(evidence: Evidence) -> Finding:
        reference = evidence.others(other)
        if reference is None or not reference.complete:
            return Finding(None, f"{other} has not been run")
        found, holds = [], True
        for agent in agents:
            here, there = (
                float(interquartile_mean(one.final(setting, agent.name, "train_success")).value)
                for one in (evidence, reference)
            )
            holds = holds and here <= there
            found.append(f"{agent.label} {here:.2f} (there {there:.2f})")
        return Finding(holds, "; ".join(found))

    return Check(
        f"{setting}: final training success (IQM) of {names} no higher than in {other}", test
    )
