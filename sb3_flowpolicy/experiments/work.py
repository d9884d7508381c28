"""Work items, one per agent and setting of an experiment, and how long they take."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.experiments.experiment import Agent, Experiment, Setting
from sb3_flowpolicy.experiments.store import SCHEMA

FIRST_SEED = 1
SEEDS_PER_ITEM = 10
QUICK_STEPS, QUICK_SEEDS = 3000, 2
TEST_EPISODES = 10
"""Per seed and measurement."""
# Short runs write this many checkpoints, long ones one per so many steps.
CHECKPOINTS, MOST_STEPS_BETWEEN_CHECKPOINTS = 6, 50_000

STEPS_PER_SECOND = {16: 2400.0, 128: 340.0, 256: 99.0}
"""Units of the critics' layers -> steps per second of NF, summed over ten seeds of one process with
one thread, on one of two idle cores of an AMD EPYC (docs/benchmarks.md); Gauss is up to a third
faster. All blocks do one update per step, which dominates the time."""

GSDE_STEPS_PER_SECOND = 250.0
"""gSDE runs in SB3's own loop, one seed after the other, at this speed for all small networks."""

_START_SECONDS = 40
"""Starting a process and compiling."""


@dataclass(frozen=True)
class WorkItem:
    """One :class:`SeedBatch` to train: an agent on a setting.

    Its fields are those of :class:`Setting` and :class:`Experiment`, and the entries of an item in
    ``settings.json``.

    Attributes:
        key: Name of its files.
        setting: Name of the setting.
        agent: Name of the agent.
        hyperparameters: Arguments of the agents, ``policy`` among them.
        checkpoint_every: Steps between two checkpoints, a multiple of ``eval_every``.
        pictures_at: Steps after which the first seed's policy is recorded.
    """

    key: str
    setting: str
    agent: str
    seeds: tuple[int, ...]
    env_id: str
    env_kwargs: dict[str, Any]
    hyperparameters: dict[str, Any]
    steps: int
    eval_every: int
    checkpoint_every: int
    test_episodes: int
    measures: tuple[str, ...]
    pictures_at: tuple[int, ...]

    @property
    def updates(self) -> int:
        """Number of gradient updates per seed."""
        settings = self.hyperparameters
        ratio = settings.get("gradient_steps", 1) / settings.get("train_freq", 1)
        return max(0, int((self.steps - settings.get("learning_starts", 100)) * ratio))


@dataclass(frozen=True)
class Plan:
    """All work items of a run."""

    experiment: Experiment
    steps: int
    seeds: tuple[int, ...]
    items: tuple[WorkItem, ...]

    def settings(self) -> dict[str, Any]:
        """Return everything that results depend on; runs that share a folder agree on it."""
        items = {}
        for item in self.items:
            spec = gym.spec(item.env_id)
            registration = {"kwargs": spec.kwargs, "max_episode_steps": spec.max_episode_steps}
            items[item.key] = {**vars(item), "env_registration": registration}
            del items[item.key]["key"]
        return {
            "schema": SCHEMA,
            "experiment": self.experiment.name,
            "steps": self.steps,
            "seeds": list(self.seeds),
            "items": items,
        }


def vary(
    experiment: Experiment, env_kwargs: Mapping[str, Any], agents: Sequence[str] | None = None
) -> Experiment:
    """Return an experiment with other environments or fewer agents, for tuning.

    Args:
        experiment: The experiment.
        env_kwargs: Arguments of the environments, in all settings.
        agents: Names of the agents to keep. Default: all.

    Raises:
        ValueError: If there is no such agent, or an environment does not take these arguments.
    """
    for setting in experiment.settings if env_kwargs else ():
        register_env(setting.env_id)
        try:
            gym.make(setting.env_id, **{**setting.env_kwargs, **env_kwargs}).close()
        except TypeError as error:
            raise ValueError(f"--set must name arguments of {setting.env_id}: {error}") from None
    known = {agent.name: agent for agent in experiment.agents}
    for name in agents or ():
        if name not in known:
            raise ValueError(f"agents of {experiment.name} must be among {[*known]}, got {name!r}")
    settings = (
        replace(setting, env_kwargs={**setting.env_kwargs, **env_kwargs})
        for setting in experiment.settings
    )
    chosen = (agent for name, agent in known.items() if agents is None or name in agents)
    return replace(experiment, agents=tuple(chosen), settings=tuple(settings))


def make_plan(
    experiment: Experiment,
    profile: str = "full",
    steps: int | None = None,
    seeds: int | None = None,
    first_seed: int = FIRST_SEED,
    seeds_per_item: int = SEEDS_PER_ITEM,
) -> Plan:
    """Turn an experiment into work items.

    Args:
        experiment: The experiment.
        profile: ``"full"`` for the experiment's own steps and seeds, ``"quick"`` for a trial.
        steps: Environment steps per seed. Default: the profile's.
        seeds: Number of seeds. Default: the profile's.
        first_seed: The seeds are this one and those after it.
        seeds_per_item: Most seeds trained in one process: fewer make more items to spread over
            machines.
    """
    quick = profile == "quick"
    steps = (QUICK_STEPS if quick else experiment.steps) if steps is None else steps
    seeds = (QUICK_SEEDS if quick else experiment.seeds) if seeds is None else seeds
    chosen = tuple(range(first_seed, first_seed + seeds))
    groups = [chosen[i : i + seeds_per_item] for i in range(0, seeds, seeds_per_item)]
    items = [
        _item(experiment, setting, agent, group, steps, len(groups) > 1)
        for setting in experiment.settings
        for agent in experiment.agents
        for group in groups
    ]
    return Plan(experiment, steps, chosen, tuple(items))


def _item(
    experiment: Experiment,
    setting: Setting,
    agent: Agent,
    seeds: tuple[int, ...],
    steps: int,
    split: bool,
) -> WorkItem:
    hyperparameters = load_hyperparameters(agent.algo, setting.env_id)
    hyperparameters.pop("n_timesteps", None)
    for overrides in (setting.overrides, agent.overrides):
        hyperparameters = merge(hyperparameters, overrides)
    # A short run is measured more often, or there would be no curve to look at.
    eval_every = max(1, min(experiment.eval_every, steps // 6))
    between_checkpoints = min(steps / CHECKPOINTS, MOST_STEPS_BETWEEN_CHECKPOINTS)
    return WorkItem(
        key=f"{setting.name}-{agent.name}" + (f"-seeds-{seeds[0]}-{seeds[-1]}" if split else ""),
        setting=setting.name,
        agent=agent.name,
        seeds=seeds,
        env_id=setting.env_id,
        env_kwargs=dict(setting.env_kwargs),
        hyperparameters=hyperparameters,
        steps=steps,
        eval_every=eval_every,
        checkpoint_every=eval_every * max(1, round(between_checkpoints / eval_every)),
        test_episodes=TEST_EPISODES,
        measures=experiment.measures,
        pictures_at=tuple(round(share * steps) for share in experiment.pictures_at),
    )


def merge(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with ``overrides``, merging nested mappings.

    Example:
        >>> merge({"a": 1, "b": {"c": 2}}, {"b": {"d": 3}})
        {'a': 1, 'b': {'c': 2, 'd': 3}}
    """
    merged = copy.deepcopy(dict(base))
    for key, value in overrides.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both else copy.deepcopy(value)
    return merged


def register_env(env_id: str) -> None:
    """Register the PyBullet environments if ``env_id`` is one of them, in this process.

    Raises:
        ModuleNotFoundError: If PyBullet is needed and not installed.
    """
    if env_id.endswith("BulletEnv-v0"):
        import pybullet_envs_gymnasium  # noqa: F401


def environment(item: WorkItem) -> str:
    """Return the id of the item's environment, registered with its arguments if need be.

    An id, not a factory: only ids lead to an environment's vectorized form.
    """
    register_env(item.env_id)
    if not item.env_kwargs:
        return item.env_id
    base = gym.spec(item.env_id)
    parts = [f"{key}_{value}" for key, value in sorted(item.env_kwargs.items())]
    name = f"{base.name}-{'-'.join(parts)}-v{base.version}"
    if name not in gym.registry:
        kwargs = {**base.kwargs, **item.env_kwargs}
        gym.registry[name] = replace(base, id=name, kwargs=kwargs)
    return name


def item_seconds(item: WorkItem) -> float:
    """Estimate the time of an item on one core, seconds."""
    settings = item.hyperparameters
    net_arch = settings.get("policy_kwargs", {}).get("net_arch", [256, 256])
    critic = net_arch["qf"] if isinstance(net_arch, dict) else net_arch
    speed = STEPS_PER_SECOND[min(STEPS_PER_SECOND, key=lambda known: abs(known - max(critic)))]
    if settings.get("use_sde"):
        speed = min(speed, GSDE_STEPS_PER_SECOND)
    return _START_SECONDS + item.steps * len(item.seeds) / speed


def plan_seconds(plan: Plan, workers: int) -> float:
    """Estimate the time of a plan: each free worker takes the longest remaining item."""
    loads = [0.0] * workers
    for seconds in sorted((item_seconds(item) for item in plan.items), reverse=True):
        loads[loads.index(min(loads))] += seconds
    return max(loads)


def in_words(seconds: float) -> str:
    """Return a rounded time.

    Example:
        >>> in_words(95), in_words(5000), in_words(200_000)
        ('2 min', '1.4 h', '2.3 days')
    """
    if seconds < 3600:
        return f"{max(1, round(seconds / 60))} min"
    return f"{seconds / 3600:.1f} h" if seconds < 86_400 else f"{seconds / 86_400:.1f} days"
