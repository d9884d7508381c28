"""An experiment: a claim, the runs that test it, and the rule that judges them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

REPRODUCED = "reproduced"
PARTLY = "partly reproduced"
NOT_REPRODUCED = "not reproduced"
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Agent:
    """A column of the comparison.

    Attributes:
        name: Name in commands and file names.
        label: Name in figures.
        algo: ``sac_gauss``, ``sac_lowrank``, or ``sac_flow``: the file of ``zoo_hyperparams`` with
            its hyperparameters.
        color: Its color in all figures. The colors of the thesis's agents remain distinct in print
            and for color-blind readers (Okabe and Ito).
        overrides: What differs from that file, merged into nested mappings.
    """

    name: str
    label: str
    algo: str
    color: str
    overrides: Mapping[str, Any] = field(default_factory=dict)


GAUSS = Agent("gauss", "Gauss", "sac_gauss", "#d55e00")
LOW_RANK = Agent("lowrank", "LR", "sac_lowrank", "#009e73")
FLOW = Agent("flow", "NF", "sac_flow", "#0072b2")
FLOW_DEFAULT_INIT = Agent(
    "flow-default-init",
    "NF, torch's initialization",
    "sac_flow",
    "#cc79a7",
    {"policy_kwargs": {"distribution_kwargs": {"init": "default"}}},
)
AGENTS = (GAUSS, LOW_RANK, FLOW)


@dataclass(frozen=True)
class Setting:
    """An environment with hyperparameters, on which the experiment's agents are trained.

    Attributes:
        name: Name in commands and file names.
        env_id: Registered environment.
        env_kwargs: Arguments in which the environment differs from its registration.
        overrides: What differs from the environment's block of ``zoo_hyperparams``, for all agents.
        without: Names of agents that are not trained on it.
    """

    name: str
    env_id: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    overrides: Mapping[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()

    def trained(self, agents: Iterable[Agent]) -> list[Agent]:
        """Return those of the agents that are trained on it."""
        return [agent for agent in agents if agent.name not in self.without]


@dataclass(frozen=True)
class Finding:
    """Result of a check: whether it holds, None if it could not be measured, and the numbers."""

    holds: bool | None
    measured: str


class NotMeasuredError(LookupError):
    """A check needs a measurement that is not among the results."""


@dataclass(frozen=True)
class Check:
    """One line of an experiment's rule: a statement, and its test on an ``Evidence``."""

    statement: str
    test: Callable[..., Finding]


@dataclass(frozen=True)
class Experiment:
    """A claim of the thesis, or a comparison of ours, and everything needed to test it.

    Attributes:
        name: Name in commands and folders.
        claim: Number of the claim; E1 to E11 follow the thesis, D2 and up are ours.
        source: Section and figures of the thesis; ``"ours"`` where there is nothing to reproduce.
        title: The comparison in one line.
        thesis: The thesis's finding, in our words.
        settings: Environments with hyperparameters.
        checks: The rule: all hold, reproduced; none, not reproduced; else partly.
        agents: The agents that are compared.
        steps: Environment steps per seed.
        seeds: Number of seeds; they are 1, 2, ...
        eval_every: Steps between two measurements.
        measures: Names of further measurements, see ``measures.py``.
        pictures_at: When to record the first seed's policy along an episode, as shares of
            ``steps``; only on two-dimensional Tunnels.
        notes: Remarks on the setup, for readers.
    """

    name: str
    claim: str
    source: str
    title: str
    thesis: str
    settings: tuple[Setting, ...]
    checks: tuple[Check, ...]
    agents: tuple[Agent, ...] = AGENTS
    steps: int = 60_000
    seeds: int = 10
    eval_every: int = 1000
    measures: tuple[str, ...] = ()
    pictures_at: tuple[float, ...] = ()
    notes: str = ""

    @property
    def pairs(self) -> list[tuple[Setting, Agent]]:
        """Each setting with each agent that is trained on it."""
        return [(one, agent) for one in self.settings for agent in one.trained(self.agents)]
