r"""How often noise alone finds the goal of a diagonal tunnel.

The reward is sparse: until an agent first reaches the goal, SAC weighs entropy against the penalty
for leaving. A policy that returns to the center line with every step, has the entropy :math:`H`,
and survives with probability :math:`s`, is worth

.. math:: V = \frac{\alpha H - c (1 - s)}{1 - \gamma s}

with the entropy coefficient :math:`\alpha`, the penalty :math:`c` and the discount :math:`\gamma`.
The noise that maximizes this moves the agent along the tunnel as a random walk, whose steps have a
standard deviation of :math:`\sigma` reaches. After n steps it has passed the distance :math:`d`
with probability

.. math:: F(n) = \operatorname{erfc} \frac{d + 0.583 \sigma}{\sigma \sqrt{2 n}}

(the reflection principle, with the correction for discrete steps by Broadie, Glasserman and Kou, *A
continuity correction for discrete barrier options*, 1997), so that an episode of N steps reaches
the goal with probability :math:`\sum_{n=1}^N s^n (F(n) - F(n - 1))`. This treats steps as normal,
and as independent of survival, and ignores the other end of the world. Means that move the agent
are not part of it, nor is what an agent learns from its first goal.
"""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np

from flowpolicy_envs.registration import TUNNEL_IDS
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.experiments.dimensions.prediction import (
    FAMILIES,
    REACH,
    bound,
    noise_of,
    survives,
)

_ENV = "TunnelDiagonal-v0"
_TUNNEL = TUNNEL_IDS[_ENV]
_HYPERPARAMETERS = load_hyperparameters("sac_flow", _ENV)
_STEPS: int = _HYPERPARAMETERS["n_timesteps"]
_EPISODE: int = gym.spec(_ENV).max_episode_steps  # type: ignore[assignment]
DISTANCE = 0.9 / REACH
"""Distance from the start, the origin, to the goal along each axis, in reaches."""
_CORRECTION = 0.583
_SCALES = np.geomspace(0.003, 0.88, 40)
_UNIFORM_SAMPLES = 200_000


def discovery(family: str, dims: int, width: float) -> dict[str, float]:
    """Predict how often a run finds the goal with the noise that it prefers without a reward.

    Args:
        family: Key of ``FAMILIES``, or ``"any"`` for the density of any shape with the highest
            entropy, which is uniform inside the tunnel.
        dims: Number of coupled dimensions, at least 2.
        width: Width of the tunnel, world units.

    Returns:
        ``survival`` of a step and ``progress``, its standard deviation along the tunnel as a share
        of the reach; ``entropy`` in nats; ``chance``, the probability that an episode reaches the
        goal; ``goals``, the expected number of episodes of a run that do; and ``runs``, the share
        of runs in which at least one does. Of normal noise also the standard deviations before
        tanh, ``scale`` and ``common``, as of
        :func:`~sb3_flowpolicy.experiments.dimensions.prediction.best`.

    Example:
        >>> from sb3_flowpolicy.experiments.dimensions.prediction import WIDTHS
        >>> found = discovery("correlated", 2, WIDTHS[2])
        >>> found["goals"] > 10 > discovery("independent", 2, WIDTHS[2])["goals"]
        True
    """
    if family == "any":
        candidates = _uniform(dims, width)
    else:
        candidates = [
            noise_of(dims, width, float(scale), common)
            for common in FAMILIES[family]
            for scale in _SCALES
        ]
    found = max(candidates, key=_value)
    survival = found["survival"]
    reached = chance(found["progress"], survival)
    length = sum(survival**n for n in range(_EPISODE))
    goals = _STEPS / length * reached
    return {**found, "chance": reached, "goals": goals, "runs": -math.expm1(-goals)}


def _uniform(dims: int, width: float) -> list[dict[str, float]]:
    """Describe densities that are uniform inside the tunnel and uniform, but lower, outside."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (_UNIFORM_SAMPLES, dims))
    progress = float(actions[survives(actions, width)].mean(axis=1).std())
    return [
        {"entropy": bound(dims, survival), "progress": progress, "survival": survival}
        for survival in 1.0 - np.geomspace(1e-4, 0.5, 60)
    ]


def _value(noise: dict[str, float]) -> float:
    """Return the soft value of a policy that always has this noise."""
    leaving = _TUNNEL["leave_penalty"] * (1.0 - noise["survival"])
    reward = _HYPERPARAMETERS["ent_coef"] * noise["entropy"] - leaving
    return reward / (1.0 - _HYPERPARAMETERS["gamma"] * noise["survival"])


def chance(progress: float, survival: float) -> float:
    """Return the probability that a random walk reaches the goal within an episode.

    Args:
        progress: Standard deviation of a step, as a share of the reach.
        survival: Probability with which a step survives.

    Example:
        >>> chance(0.5, 1.0) > chance(0.5, 0.9) > chance(0.25, 0.9)
        True
    """
    distance = DISTANCE / progress + _CORRECTION
    passed = [0.0]
    passed += [math.erfc(distance / math.sqrt(2.0 * n)) for n in range(1, _EPISODE + 1)]
    return sum(survival**n * (passed[n] - passed[n - 1]) for n in range(1, _EPISODE + 1))
