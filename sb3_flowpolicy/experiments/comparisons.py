"""Checks that compare agents by what they end with."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from sb3_flowpolicy.common.statistics import (
    Estimate,
    interquartile_mean,
    probability_of_improvement,
)
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import Agent, Check, Finding
from sb3_flowpolicy.experiments.tables import WORDS, in_digits


def _listed(metric: str, agents: Sequence[Agent], means: Sequence[Estimate]) -> str:
    return "; ".join(
        f"{a.label} {in_digits(metric, m)}" for a, m in zip(agents, means, strict=True)
    )


def ordered(setting: str, metric: str, agents: Sequence[Agent], margin: float = 0.0) -> Check:
    """Demand that the final value falls from agent to agent, by at least ``margin`` each.

    And that it is no accident: that of each pair a run of the first is likely to end above one of
    the second, the 95 % interval of the probability lying above one half.
    """
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
            falls and all(bool(chance.low > 0.5) for chance in chances),
            _listed(metric, agents, means)
            + "; probability of improvement "
            + ", ".join(f"{chance:.2f}" for chance in chances),
        )

    words = WORDS.get(metric, metric)
    return Check(
        f"{setting}: final {words} (IQM) {names}{by} (and probability of improvement above one "
        "half, by its 95 % interval)",
        test,
    )


def about_equal(setting: str, metric: str, agents: Sequence[Agent], tolerance: float) -> Check:
    """Demand that the final values lie within ``tolerance`` of the largest, as a share of it."""
    names = ", ".join(agent.label for agent in agents)

    def test(evidence: Evidence) -> Finding:
        means = [interquartile_mean(evidence.final(setting, a.name, metric)) for a in agents]
        values = [float(mean.value) for mean in means]
        equal = max(values) - min(values) <= tolerance * max(abs(value) for value in values)
        return Finding(equal, _listed(metric, agents, means))

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
        return Finding(holds, _listed(metric, (more, less), (a, b)) + ratio)

    words = WORDS.get(metric, metric)
    return Check(
        f"{setting}: final {words} (IQM) of {more.label} at least {factor:g} times that of "
        f"{less.label}",
        test,
    )


def slower(setting: str, slow: Agent, others: Sequence[Agent]) -> Check:
    """Demand that one agent is likely to need more steps until it solves the task than others.

    Likely: the 95 % interval of the probability lies above one half. Means that differ by less
    than their intervals are wide show nothing.
    """
    names = " and ".join(agent.label for agent in others)

    def test(evidence: Evidence) -> Finding:
        steps = {
            agent.label: evidence.steps_until_solved(setting, agent.name)
            for agent in (slow, *others)
        }
        chances = {
            other.label: probability_of_improvement(steps[slow.label], steps[other.label])
            for other in others
        }
        means = "; ".join(f"{k} {interquartile_mean(v):,.0f}" for k, v in steps.items())
        more = ", ".join(f"{label} {chance:.2f}" for label, chance in chances.items())
        return Finding(
            all(bool(chance.low > 0.5) for chance in chances.values()),
            f"{means}; probability of more steps than {more}",
        )

    return Check(
        f"{setting}: {slow.label} needs more steps to solve it than {names} (probability above one "
        "half, by its 95 % interval)",
        test,
    )


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
