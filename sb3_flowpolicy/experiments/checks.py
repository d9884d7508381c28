"""Lines of a rule: statements about the final values, success and steadiness of agents."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from sb3_flowpolicy.common.statistics import (
    Estimate,
    interquartile_mean,
    probability_of_improvement,
)
from sb3_flowpolicy.experiments.evidence import SWINGS_OF_AN_OSCILLATION, Evidence
from sb3_flowpolicy.experiments.experiment import Agent, Check, Finding
from sb3_flowpolicy.experiments.tables import WORDS, in_digits

# The share of seeds that have to learn something for an agent to be called steady.
_MOST = 0.9


def ordered(setting: str, metric: str, agents: Sequence[Agent], margin: float = 0.0) -> Check:
    """Check that the final value falls from agent to agent, by more than ``margin`` each.

    In addition, of each pair, a run of the first must be likely to end above one of the second: the
    95 % interval of the probability lies above one half.
    """

    def test(evidence: Evidence) -> Finding:
        finals = [evidence.final(setting, agent.name, metric) for agent in agents]
        means = [interquartile_mean(final) for final in finals]
        chances = list(itertools.starmap(probability_of_improvement, itertools.pairwise(finals)))
        falls = all(more.value - less.value > margin for more, less in itertools.pairwise(means))
        return Finding(
            bool(falls and all(chance.low > 0.5 for chance in chances)),
            _listed(metric, agents, means)
            + "; probability of improvement "
            + ", ".join(f"{chance:.2f}" for chance in chances),
        )

    names = " > ".join(agent.label for agent in agents)
    by = f", by at least {margin:g} each" if margin else ""
    return Check(
        f"{_final(setting, metric)} {names}{by} (and probability of improvement above one "
        "half, by its 95 % interval)",
        test,
    )


def about_equal(setting: str, metric: str, agents: Sequence[Agent], tolerance: float) -> Check:
    """Check that the final values lie within ``tolerance`` of the largest, as a share of it."""

    def test(evidence: Evidence) -> Finding:
        means = _means(evidence, setting, metric, agents)
        values = [float(mean.value) for mean in means]
        equal = max(values) - min(values) <= tolerance * max(abs(value) for value in values)
        return Finding(equal, _listed(metric, agents, means))

    names = ", ".join(agent.label for agent in agents)
    return Check(
        f"{_final(setting, metric)} of {names} within {tolerance:.0%} of the largest", test
    )


def at_least_times(setting: str, metric: str, more: Agent, less: Agent, factor: float) -> Check:
    """Check that one agent's final value is at least ``factor`` times the other's."""

    def test(evidence: Evidence) -> Finding:
        means = _means(evidence, setting, metric, (more, less))
        a, b = (float(mean.value) for mean in means)
        ratio = f", {a / b:.2f} times" if b > 0 else ""
        return Finding(a >= factor * b, _listed(metric, (more, less), means) + ratio)

    return Check(
        f"{_final(setting, metric)} of {more.label} at least {factor:g} times that of {less.label}",
        test,
    )


def reaches(setting: str, metric: str, agent: Agent, least: float) -> Check:
    """Check that the final value is at least ``least``."""

    def test(evidence: Evidence) -> Finding:
        (mean,) = _means(evidence, setting, metric, (agent,))
        return Finding(bool(mean.value >= least), f"{mean:.0f}")

    return Check(f"{_final(setting, metric)} of {agent.label} at least {least:g}", test)


def no_better_than(other: str, setting: str, agents: Sequence[Agent]) -> Check:
    """Check that agents end with no higher training success than in another experiment."""

    def test(evidence: Evidence) -> Finding:
        reference = evidence.others(other)
        if reference is None or not reference.complete:
            return Finding(None, f"{other} has not been run")
        here = _means(evidence, setting, "train_success", agents)
        there = _means(reference, setting, "train_success", agents)
        return Finding(
            all(bool(a.value <= b.value) for a, b in zip(here, there, strict=True)),
            "; ".join(
                f"{agent.label} {a.value:.2f} (there {b.value:.2f})"
                for agent, a, b in zip(agents, here, there, strict=True)
            ),
        )

    names = ", ".join(agent.label for agent in agents)
    return Check(f"{_final(setting, 'train_success')} of {names} no higher than in {other}", test)


def slower(setting: str, slow: Agent, others: Sequence[Agent]) -> Check:
    """Check that an agent is likely to need more steps than others until it solves the task.

    That is, the 95 % interval of the probability lies above one half. Means whose intervals overlap
    would not show it.
    """

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

    names = " and ".join(agent.label for agent in others)
    return Check(
        f"{setting}: {slow.label} needs more steps to solve it than {names} (probability above one "
        "half, by its 95 % interval)",
        test,
    )


def front_loads(setting: str, agent: Agent, than: Agent, margin: float) -> Check:
    """Check that an agent has more entropy at the start than on average along the way.

    An agent meets an entropy target where that costs least: a step that fails at the start loses
    little. Every episode passes through the start, so these states are frequent, too. The agent
    ``than`` is claimed to do so less, by at least ``margin`` nats.
    """

    def test(evidence: Evidence) -> Finding:
        a, b = (
            interquartile_mean(evidence.front_loading(setting, one.name)) for one in (agent, than)
        )
        holds = bool(a.value > 0 and a.value - b.value >= margin)
        return Finding(holds, f"{agent.label} {a:.2f} nats; {than.label} {b:.2f} nats")

    return Check(
        f"{setting}: entropy at the start less the mean along the way (IQM) is above 0 for "
        f"{agent.label}, and at least {margin:g} nats more than for {than.label}",
        test,
    )


def solved(setting: str, agent: Agent, share: float, at_best: bool = False) -> Check:
    """Check that at least this share of the seeds solves the task."""
    when = "at its best" if at_best else "at the end"
    return Check(
        f"{setting}: {agent.label} solves the task {when} in at least {share:.0%} of the seeds",
        _counted(setting, agent, lambda found: found.mean() >= share, at_best),
    )


def mostly_fails(setting: str, agent: Agent, share: float) -> Check:
    """Check that at most this share of the seeds solves the task at the end."""
    return Check(
        f"{setting}: {agent.label} solves the task at the end in at most {share:.0%} of the seeds",
        _counted(setting, agent, lambda found: found.mean() <= share),
    )


def none_fails(setting: str, agent: Agent) -> Check:
    """Check that every seed solves the task at the end."""
    return Check(f"{setting}: no seed of {agent.label} fails", _counted(setting, agent, np.all))


def oscillates(setting: str, agent: Agent, share: float) -> Check:
    """Check that at least this share of the seeds oscillates."""

    def test(evidence: Evidence) -> Finding:
        flags, measured = _swinging(evidence, setting, agent)
        return Finding(bool(flags.mean() >= share), measured)

    return Check(
        f"{setting}: {agent.label} oscillates (at least {SWINGS_OF_AN_OSCILLATION} swings in "
        f"return, entropy and entropy coefficient) in at least {share:.0%} of the seeds",
        test,
    )


def is_steady(setting: str, agent: Agent, share: float) -> Check:
    """Check that at most this share of the seeds oscillates, and that most learn something.

    A seed that learns nothing has nothing to lose again: it is no evidence of steadiness.
    """

    def test(evidence: Evidence) -> Finding:
        flags, measured = _swinging(evidence, setting, agent)
        learned = evidence.succeeded(setting, agent.name)
        return Finding(
            bool(flags.mean() <= share and learned.mean() >= _MOST),
            f"{measured}; {learned.sum()} of {len(learned)} ever succeed in training",
        )

    return Check(
        f"{setting}: {agent.label} oscillates in at most {share:.0%} of the seeds, and at least "
        f"{_MOST:.0%} of them learn to succeed in training",
        test,
    )


def _final(setting: str, metric: str) -> str:
    return f"{setting}: final {WORDS[metric]} (IQM)"


def _means(
    evidence: Evidence, setting: str, metric: str, agents: Sequence[Agent]
) -> list[Estimate]:
    return [interquartile_mean(evidence.final(setting, agent.name, metric)) for agent in agents]


def _listed(metric: str, agents: Sequence[Agent], means: Sequence[Estimate]) -> str:
    return "; ".join(
        f"{a.label} {in_digits(metric, m)}" for a, m in zip(agents, means, strict=True)
    )


def _counted(
    setting: str, agent: Agent, holds: Callable[[np.ndarray], object], at_best: bool = False
) -> Callable[[Evidence], Finding]:
    def test(evidence: Evidence) -> Finding:
        found = (evidence.solved_once if at_best else evidence.solved)(setting, agent.name)
        return Finding(bool(holds(found)), f"{found.sum()} of {len(found)}")

    return test


def _swinging(evidence: Evidence, setting: str, agent: Agent) -> tuple[np.ndarray, str]:
    counts = evidence.oscillations(setting, agent.name)
    flags = counts >= SWINGS_OF_AN_OSCILLATION
    swings = ", ".join(str(count) for count in counts)
    return flags, f"{flags.sum()} of {len(flags)} (swings per seed: {swings})"
