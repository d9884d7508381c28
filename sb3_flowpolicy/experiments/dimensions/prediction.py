r"""What correlation is worth in diagonal tunnels of many dimensions.

A tunnel of fixed width becomes impossible to enter: the probability that independent noise stays
inside falls exponentially with the number of coupled dimensions. :data:`WIDTHS` therefore keeps the
probability that a uniformly random first step survives. At that width, this predicts the highest
entropy that a family of policies can hold while it survives a step with a given probability.

An action :math:`a \in [-1, 1]^D` at the center line survives if

.. math:: \lVert a - \bar a \mathbf 1 \rVert \le \rho = \frac{w}{2 r},

with the mean :math:`\bar a` of its coordinates, the width :math:`w` and the reach :math:`r`.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.registration import TUNNEL_IDS

WIDTHS = {
    2: 0.0175,
    3: 0.0752,
    4: 0.1331,
    6: 0.2280,
    8: 0.3034,
    12: 0.4208,
    16: 0.5144,
    32: 0.7941,
}
"""Width of the tunnel by number of coupled dimensions, world units. That of two dimensions is the
registered one; the others let as large a share of uniformly random first steps survive."""

REACH: float = TUNNEL_IDS["TunnelDiagonal-v0"]["reach"]

SURVIVAL_OF_RANDOM_STEPS = 1.0 - (1.0 - WIDTHS[2] / (2.0 * math.sqrt(2.0) * REACH)) ** 2
"""Share of uniformly random first steps that survive with two dimensions, 8.6 %."""

FAMILIES = {
    "independent": (0.0,),
    "correlated": (0.0, *np.geomspace(0.02, 2.0, 24), *np.geomspace(2.2, 6.0, 6)),
}
"""Standard deviations of common noise to try, by family. A policy squashes a normal by tanh. The
coordinates can be exchanged, so the best covariance treats them alike: it is a multiple of the
identity plus common noise. A low-rank policy of any rank contains it, and so does one with a full
covariance: their predictions coincide."""

_SAMPLES = 20_000
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(200)


def survival_of(actions: NDArray[np.float64], width: float) -> float:
    """Return the share of actions (N, D) at the center line that stay in the tunnel."""
    return float(survives(actions, width).mean())


def survives(actions: NDArray[np.float64], width: float) -> NDArray[np.bool_]:
    """Return which actions (N, D) at the center line stay in the tunnel, (N,)."""
    offsets = np.linalg.norm(actions - actions.mean(axis=1, keepdims=True), axis=1)
    return offsets <= width / (2.0 * REACH)


def bound(dims: int, survival: float) -> float:
    r"""Return the highest entropy of any density that survives a step with this probability.

    In nats. That density is uniform inside the tunnel, and uniform outside:

    .. math:: D \ln 2 + p \ln \frac{q}{p} + (1 - p) \ln \frac{1 - q}{1 - p}

    with the probability p of surviving, and that of a uniformly random step, q. As q does not
    depend on D here, neither does the distance to the entropy of the uniform distribution.

    Example:
        >>> round(bound(2, 0.9) - math.log(4), 2) == round(bound(32, 0.9) - 32 * math.log(2), 2)
        True
    """
    q = SURVIVAL_OF_RANDOM_STEPS
    inside = survival * math.log(q / survival)
    outside = (1.0 - survival) * math.log((1.0 - q) / (1.0 - survival))
    return dims * math.log(2.0) + inside + outside


def best(family: str, dims: int, width: float, survival: float) -> dict[str, float]:
    """Find the noise of a family with the highest entropy at the center line at this survival.

    Args:
        family: Key of ``FAMILIES``.
        dims: Number of coupled dimensions D, at least 2.
        width: Width of the tunnel, world units.
        survival: Probability with which a step survives, in (0, 1).

    Returns:
        ``entropy`` in nats; ``progress``, the standard deviation of the mean coordinate of an
        action, which is the progress along the tunnel as a share of the reach; ``survival``; and
        the standard deviations before tanh of each coordinate's own noise, ``scale``, and of the
        noise that all coordinates share, ``common``.
    """
    shared, own = _samples(dims)
    candidates = []
    for common in FAMILIES[family]:
        scale = _widest(common * shared, own, width, survival)
        candidates.append(noise_of(dims, width, scale, common))
    return max(candidates, key=lambda found: found["entropy"])


def noise_of(dims: int, width: float, scale: float, common: float) -> dict[str, float]:
    """Describe the noise tanh(common z 1 + scale e) at the center of the tunnel.

    Returns:
        As :func:`best`; ``survival`` is the probability with which a step survives.
    """
    shared, own = _samples(dims)
    actions = np.tanh(common * shared + scale * own)
    return {
        "entropy": _entropy(dims, scale, common),
        "progress": float(actions.mean(axis=1).std()),
        "survival": survival_of(actions, width),
        "scale": scale,
        "common": float(common),
    }


@functools.cache
def _samples(dims: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return standard normal noise that all coordinates share, (N, 1), and their own, (N, D)."""
    rng = np.random.default_rng(0)
    return rng.standard_normal((_SAMPLES, 1)), rng.standard_normal((_SAMPLES, dims))


def _widest(
    shared: NDArray[np.float64], own: NDArray[np.float64], width: float, survival: float
) -> float:
    """Return the largest scale of ``own`` (N, D) that survives, by bisection of its logarithm.

    The search ends where the entropy of a squashed coordinate falls again.
    """
    low, high = math.log(1e-4), math.log(0.88)
    for _ in range(18):
        middle = (low + high) / 2.0
        enough = survival_of(np.tanh(shared + math.exp(middle) * own), width) >= survival
        low, high = (middle, high) if enough else (low, middle)
    return math.exp(low)


def _entropy(dims: int, scale: float, common: float) -> float:
    """Return the entropy of tanh(common z 1 + scale e) with standard normal z and e (D,), nats."""
    normal = dims * (0.5 * math.log(2.0 * math.pi * math.e) + math.log(scale))
    normal += 0.5 * math.log1p(dims * (common / scale) ** 2)
    size = np.abs(math.hypot(scale, common) * _NODES)
    log_slope = 2.0 * (math.log(2.0) - size - np.log1p(np.exp(-2.0 * size)))
    return normal + dims * float(_WEIGHTS @ log_slope / _WEIGHTS.sum())
