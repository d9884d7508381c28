"""The best policy of a family of noise, under SAC's objective at its stationary rate."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cma
import gymnasium as gym
import numpy as np
import torch as th

from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.batch import METRICS, SquareBatch
from flowpolicy_envs.square.config import SquareConfig
from flowpolicy_envs.square.tasks import as_task
from sb3_flowpolicy.algorithms.exploration import NoiseProcess
from sb3_flowpolicy.experiments.coordination.families import (
    FAMILIES,
    INDEPENDENT_START,
    INWARDS,
    Array,
)

_DRAWS = 40
"""Sets of random numbers that a search uses in turn, so that it does not fit a single one."""
_FINAL_EPISODES = 512
"""Episodes with other random numbers, which measure what was found."""
_PRESS_START, _PRESS_STEP = 0.85, 0.3
"""Mean before squashing at the start, and how much of it is a unit of the search."""


@dataclass(frozen=True)
class Setting:
    """An environment, an objective, and the length of a search.

    ``steps`` are those of an episode; ``episodes`` are simulated for each of the ``budget``
    candidates of a family. The random numbers of the episodes do not depend on ``seed``.
    """

    config: SquareConfig
    steps: int
    ent_coef: float = 0.05
    gamma: float = 0.9
    episodes: int = 48
    budget: int = 800
    seed: int = 0


def setting_of(
    env_id: str,
    task: dict[str, float],
    arguments: dict[str, Any],
    **options: Any,
) -> Setting:
    """Return the setting of a Square's id, with other rewards and arguments of the environment.

    Raises:
        ValueError: If the id is not that of a Square, or a value is out of range.
        TypeError: If a coefficient or an argument is unknown.

    Example:
        >>> setting_of("SquareMoveX-v0", {"angle": 1.0}, {"max_force": 2.4}).config.task.angle
        1.0
    """
    spec = gym.spec(env_id)
    if spec.entry_point != "flowpolicy_envs.square.env:SquareEnv":
        raise ValueError(f"the id must be that of a Square, got {env_id}")
    kwargs = {**spec.kwargs, **arguments}
    rules = as_task(kwargs.pop("task", "hold"))
    config = SquareConfig(type(rules)(**{**vars(rules), **task}), **kwargs)
    return Setting(config, spec.max_episode_steps or 80, **options)


def predict(
    setting: Setting,
    names: Sequence[str],
    report: Callable[[int], None] | None = None,
) -> dict[str, dict[str, float]]:
    """Search the best policy of each family, named as in `FAMILIES`, and :func:`measure` it.

    A policy presses with a constant mean, plus noise, squashed by tanh. Independent noise is always
    searched, because the other families begin where it ended. ``report`` is called with the number
    of candidates after each generation.
    """
    batch = SquareBatch(setting.config, setting.episodes)
    final = SquareBatch(setting.config, _FINAL_EPISODES)
    start, found = np.concatenate([np.zeros(2), INDEPENDENT_START]), {}
    for name in ("independent", *(name for name in names if name != "independent")):
        family = FAMILIES[name]
        begin = np.concatenate([start[:2], family.start(start[2:])])
        # For cma, seed 0 is the clock.
        options = {"seed": setting.seed + 1, "verbose": -9, "maxfevals": setting.budget}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # cma's, about options that it changes itself
            search = cma.CMAEvolutionStrategy(begin, 0.3, options)
            while not search.stop():
                points = search.ask()
                draws = search.countiter % _DRAWS
                values = [
                    _evaluate(setting, name, point, batch, draws)["value"] for point in points
                ]
                search.tell(points, [-value for value in values])
                if report is not None:
                    report(len(points))
        best = np.asarray(search.mean)
        if name == "independent":
            start = best
        found[name] = _evaluate(setting, name, best, final, _DRAWS)
    return found


def _evaluate(
    setting: Setting, name: str, parameters: Array, batch: SquareBatch, draws: int
) -> dict[str, float]:
    """Simulate a policy with the random numbers `draws`."""
    family = FAMILIES[name]
    means = np.clip(_PRESS_START + _PRESS_STEP * parameters[:2], 0.0, 3.0) @ INWARDS
    root = family.root(parameters[2:])
    noise = _standard_noise(family.color, (setting.steps, len(batch.rewards), root.shape[1]), draws)
    return measure(setting, means, root, noise @ root.T, batch, draws)


def measure(
    setting: Setting, means: Array, root: Array, noise: Array, batch: SquareBatch, seed: int
) -> dict[str, float]:
    """Simulate one episode in each world of `batch`.

    Args:
        setting: Objective and rules.
        means: Mean of the actions before squashing, (8,).
        root: R (8, M) with the covariance R R^T of the noise.
        noise: Added to the means, (T, N, 8), for T steps in N worlds.
        batch: N worlds with the rules of the setting.
        seed: Seed of the starts.

    Returns:
        What the policy is worth, per step after the warm-up: the columns that the command's help
        explains. A finger that breaks during the warm-up counts as a failure, too.
    """
    generator = np.random.default_rng(seed)
    batch.reset(batch.everyone, lambda _: generator)
    out = batch.roll_out(means, noise)
    task, after = as_task(setting.config.task), slice(setting.config.warm_steps, None)
    lengths = out.taken[after].sum(axis=0)
    steps = max(int(lengths.sum()), 1)
    failures = int(out.failed.sum())
    hazard = min(failures / steps, 1.0)
    penalties = task.failure * out.failed[after].sum()
    reward = (out.rewards[after].sum() + penalties) / steps
    squashing = float((out.log_slopes[after] * out.taken[after]).sum()) / steps
    normal = 0.5 * float(np.linalg.slogdet(2.0 * np.pi * np.e * root @ root.T)[1])
    entropy = normal + squashing
    gain = reward + setting.ent_coef * entropy - task.failure * hazard
    metrics = dict(zip(METRICS, (lengths @ batch.metrics / steps).tolist(), strict=True))
    presses = np.tanh(INWARDS @ means / 2.0)
    return {
        "press_x": float(presses[0]),
        "press_y": float(presses[1]),
        "value": float(gain / (1.0 - setting.gamma * (1.0 - hazard))),
        "entropy": entropy,
        "hazard": hazard,
        "broken": int((batch.ends == kernels.BROKEN).sum()) / max(failures, 1),
        "reward": float(reward),
        "kept": float(reward / task.held) if task.held else 0.0,
        **{name: metrics[name] for name in ("x_std", "x_max", "distance_max")},
        "found": float(batch.found.mean()),
    }


@functools.lru_cache(maxsize=2 * _DRAWS)
def _standard_noise(color: float, shape: tuple[int, int, int], seed: int) -> Array:
    """Return standard normal noise (T, N, M), correlated in time as an agent's would be."""
    steps, count, width = shape
    if color == 0.0:
        return np.random.default_rng(seed).standard_normal(shape)
    process = NoiseProcess(width, count, color, horizon=steps)
    generator = th.Generator().manual_seed(seed)
    white = th.randn((steps, *process.white_shape), generator=generator, dtype=th.float64)
    return th.stack([process.step(step) for step in white]).numpy()
