"""Work items, one per agent and setting of an experiment."""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.store import SCHEMA

FIRST_SEED = 1
SEEDS_PER_ITEM = 10
QUICK_STEPS, QUICK_SEEDS = 3000, 2
TEST_EPISODES = 10
"""Per seed and measurement."""
# Short runs write this many checkpoints, long ones one per so many steps.
CHECKPOINTS, MOST_STEPS_BETWEEN_CHECKPOINTS = 6, 50_000


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
    def all_steps(self) -> int:
        """Environment steps of all seeds."""
        return self.steps * len(self.seeds)

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
        """Return all that results depend on, as JSON; runs that share a folder agree on it."""
        items = {}
        for item in self.items:
            spec = gym.spec(item.env_id)
            registration = {"kwargs": spec.kwargs, "max_episode_steps": spec.max_episode_steps}
            items[item.key] = {**vars(item), "env_registration": registration}
            del items[item.key]["key"]
        settings = {
            "schema": SCHEMA,
            "experiment": self.experiment.name,
            "steps": self.steps,
            "seeds": self.seeds,
            "items": items,
        }
        return json.loads(json.dumps(settings))


def vary(
    experiment: Experiment, env_kwargs: Mapping[str, Any], agents: Sequence[str] | None = None
) -> Experiment:
    """Return an experiment with other arguments of its environments or fewer agents, for tuning.

    Raises:
        ValueError: If there is no such agent, or an environment does not take these arguments.
    """
    for setting in experiment.settings if env_kwargs else ():
        register_env(setting.env_id)
        try:
            # By a spec, as gym.make takes some arguments for itself.
            base = gym.spec(setting.env_id)
            kwargs = {**base.kwargs, **setting.env_kwargs, **env_kwargs}
            gym.make(replace(base, kwargs=kwargs)).close()
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

    The profile, ``"full"`` or ``"quick"``, sets ``steps`` per seed and the number of ``seeds``
    unless they are given. Each item trains at most ``seeds_per_item`` seeds in one process: fewer
    make more items to spread over machines.
    """
    quick = profile == "quick"
    steps = (QUICK_STEPS if quick else experiment.steps) if steps is None else steps
    seeds = (QUICK_SEEDS if quick else experiment.seeds) if seeds is None else seeds
    chosen = tuple(range(first_seed, first_seed + seeds))
    groups = [chosen[i : i + seeds_per_item] for i in range(0, seeds, seeds_per_item)]
    # A short run is measured more often, or there would be no curve to look at.
    eval_every = max(1, min(experiment.eval_every, steps // 6))
    between_checkpoints = min(steps / CHECKPOINTS, MOST_STEPS_BETWEEN_CHECKPOINTS)
    items = []
    for (setting, agent), group in itertools.product(experiment.pairs, groups):
        part = f"-seeds-{group[0]}-{group[-1]}" if len(groups) > 1 else ""
        hyperparameters = load_hyperparameters(agent.algo, setting.env_id)
        hyperparameters.pop("n_timesteps", None)
        for overrides in (setting.overrides, agent.overrides):
            hyperparameters = merge(hyperparameters, overrides)
        item = WorkItem(
            key=f"{setting.name}-{agent.name}{part}",
            setting=setting.name,
            agent=agent.name,
            seeds=group,
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
        items.append(item)
    return Plan(experiment, steps, chosen, tuple(items))


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
