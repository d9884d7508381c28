"""Deterministic actions: the image of the base mean, or the best of a fixed set of candidates."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_flowpolicy.distributions import TanhSquashed
from sb3_flowpolicy.policies.actor import FlowActor

MODES = ("base", "log_prob", "q")
DETERMINISTIC_DEFAULTS: dict[str, Any] = {"deterministic_mode": "base", "deterministic_samples": 64}
# Bounds the memory: many observations are processed in parts of this many candidates.
_MOST_AT_ONCE = 2**16


def best_actions(
    actor: FlowActor, critic: Any, obs: PyTorchObs, mode: str, n_candidates: int
) -> th.Tensor:
    """Choose the best of several candidates for each observation, without random numbers.

    The candidates are the images of :func:`candidate_noise`. ``"log_prob"`` takes the one with the
    largest density as a squashed action; ``"q"`` the one with the largest value, the minimum over
    the critics. The first of several equally good ones is taken.

    Returns:
        Actions in [-1, 1], (batch, D).

    References:
        Thesis section 2.2.3, on the base mean as a flow's deterministic action.
    """
    features = actor.extract_features(obs, actor.features_extractor)
    noise = candidate_noise(n_candidates, actor.density.noise_dim).to(features).unsqueeze(1)
    rows = max(1, _MOST_AT_ONCE // n_candidates)
    modules = (actor.latent_pi, actor.density)
    if mode == "log_prob":
        return th.cat(
            [actor.traced(_most_likely, modules, part, noise) for part in features.split(rows)]
        )
    seen = critic.extract_features(obs, critic.features_extractor)
    parts = zip(features.split(rows), seen.split(rows), strict=True)
    return th.cat([actor.traced(_most_valued, (*modules, critic), *part, noise) for part in parts])


def _most_likely(
    latent_pi: nn.Module, density: TanhSquashed, features: th.Tensor, noise: th.Tensor
) -> th.Tensor:
    actions, log_prob = density.rsample_and_log_prob(latent_pi(features), noise)
    return _best(actions, log_prob)


def _most_valued(
    latent_pi: nn.Module,
    density: TanhSquashed,
    critic: Any,
    features: th.Tensor,
    seen: th.Tensor,
    noise: th.Tensor,
) -> th.Tensor:
    actions = density.rsample(latent_pi(features), noise)
    values = critic_values(critic, seen.expand(*noise.shape[:1], *seen.shape), actions)
    return _best(actions, values.amin(0))


def _best(actions: th.Tensor, score: th.Tensor) -> th.Tensor:
    """Take the actions with the highest scores: (N, batch, D), (N, batch) -> (batch, D)."""
    return actions.take_along_dim(score.argmax(0, keepdim=True).unsqueeze(-1), 0).squeeze(0)


def critic_values(critic: Any, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Return the values (n_critics, ...) that the critics of SAC, TQC or CrossQ assign to actions.

    Shapes: features of the critics' extractor (..., F); actions in [-1, 1] (..., D).
    """
    pairs = th.cat([features, actions], dim=-1)
    # A network returns one value, or quantiles whose mean is the value.
    return th.stack([q_network(pairs).mean(-1) for q_network in critic.q_networks])


@lru_cache(maxsize=8)
def candidate_noise(n_candidates: int, noise_dim: int) -> th.Tensor:
    """Return zero, which is the base mean, and N - 1 Sobol points as standard normals, (N, M).

    Example:
        >>> candidate_noise(64, 2).mean(0).abs().max() < 0.1
        tensor(True)
    """
    sobol = th.quasirandom.SobolEngine(noise_dim, scramble=True, seed=0)
    uniform = sobol.draw(n_candidates - 1, dtype=th.float64)
    # The normal quantiles of 0 and 1 are infinite.
    points = th.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9))
    return th.cat([th.zeros(1, noise_dim, dtype=th.float64), points]).float()
