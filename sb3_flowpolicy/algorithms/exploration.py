"""Exploration with noise that correlates in time, for off-policy algorithms."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.common.validation import Check, number, optional
from sb3_flowpolicy.common.vec_env import BatchedVecEnv
from sb3_flowpolicy.policies import FlowActor

# Largest exponent of the spectrum.
MAX_COLOR = 1.5
DEFAULT_HORIZON = 1000
SETTINGS: dict[str, Check] = {
    "action_noise_color": number(0, MAX_COLOR),
    "action_noise_correlation_time": optional(number(0, above=True)),
}
"""Attributes of an agent, with their checks."""


class NoiseProcess:
    r"""A stationary Gaussian process per environment, with a spectrum like :math:`f^{-\beta}`.

    Each value is exactly standard normal, from the first step of an episode on. At a fixed state,
    actions made from this noise therefore have their usual distribution, while successive actions
    correlate: the agent moves somewhere instead of jittering in place.

    The process is a weighted sum of first-order autoregressions with correlation times from half a
    step to sixteen horizons. Unlike noise that is made in the frequency domain it needs no length
    in advance, and its state is small.

    Args:
        noise_dim: Size M of the noise.
        n_envs: Number of environments N.
        color: Exponent :math:`\beta` of the spectrum, in [0, 1.5]: 0 is white, 1 pink.
        correlation_time: Steps after which the autocorrelation has fallen to 1/e, above 0: an
            Ornstein-Uhlenbeck process, instead of a color.
        horizon: Steps of an episode, at least 2: the spectrum follows the power law for
            frequencies from 1/horizon to 1/2 and is flat below.

    References:
        Pink Noise Is All You Need (Eberhard et al., 2023); thesis chapter 4, on the Brownian motion
        that independent steps add up to.

    Example:
        >>> process = NoiseProcess(noise_dim=2, n_envs=3, color=1.0, horizon=40)
        >>> process.step(th.randn(process.white_shape)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        noise_dim: int,
        n_envs: int = 1,
        color: float = 0.0,
        correlation_time: float | None = None,
        horizon: int | None = None,
    ) -> None:
        horizon = DEFAULT_HORIZON if horizon is None else horizon
        #: Arguments of the constructor: processes with the same ones have the same distribution.
        self.settings = (noise_dim, n_envs, color, correlation_time, horizon)
        if correlation_time is not None:
            decays, shares = np.array([math.exp(-1 / correlation_time)]), np.ones(1)
        elif color == 0:
            decays, shares = np.zeros(1), np.ones(1)
        else:
            decays, shares = _fit(float(color), int(horizon))
        self._decays = th.as_tensor(decays, dtype=th.float64).unsqueeze(-1)
        self._weights = th.as_tensor(shares, dtype=th.float64).sqrt().unsqueeze(-1)
        #: Shape (N, J, M) of the white noise that one step consumes.
        self.white_shape = (n_envs, len(decays), noise_dim)
        self._values = th.zeros(self.white_shape, dtype=th.float64)
        self._starting = th.ones(n_envs, 1, 1, dtype=th.bool)

    def step(self, white: th.Tensor) -> th.Tensor:
        """Return standard normals (N, M) that correlate with those before.

        They are made of independent ones, (N, J, M), see ``white_shape``.
        """
        # At the start of an episode there is no past: the first value is drawn afresh.
        decays = th.where(self._starting, 0.0, self._decays)
        self._values = decays * self._values + (1 - decays**2).sqrt() * white
        self._starting.zero_()
        return (self._weights * self._values).sum(1).to(white.dtype)

    def restart(self, ended: np.ndarray | None = None) -> None:
        """Forget the past where an episode ended, boolean (N,); default: everywhere."""
        self._starting |= True if ended is None else th.as_tensor(ended).view(-1, 1, 1)

    def state(self) -> dict[str, th.Tensor]:
        """Return what is needed to continue the same process."""
        return {"values": self._values.clone(), "starting": self._starting.clone()}

    def load_state(self, state: dict[str, th.Tensor]) -> None:
        """Restore what :meth:`state` returned."""
        self._values, self._starting = state["values"].clone(), state["starting"].clone()


@lru_cache(maxsize=8)
def _fit(color: float, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """Return decays and shares of the variance, both (J,), whose spectrum follows the power law."""
    frequencies = np.geomspace(1 / horizon, 0.5, 256)
    times = np.geomspace(0.5, 16 * horizon, 2 + int(np.log2(32 * horizon)))
    decays = np.concatenate([[0.0], np.exp(-1 / times)])
    turns = np.cos(2 * np.pi * frequencies)[:, None]
    spectra = (1 - decays**2) / (1 - 2 * decays * turns + decays**2)
    # Errors count relative to the power law, so the target of each row is one.
    relative = spectra * frequencies[:, None] ** color
    relative /= relative.mean()
    # Least squares under non-negativity, by the multiplicative updates of Lee and Seung (2001).
    shares = np.ones(len(decays))
    gram, aim = relative.T @ relative, relative.sum(0)
    for _ in range(5000):
        shares *= aim / (gram @ shares)
    kept = shares > 1e-3 * shares.sum()
    return decays[kept], shares[kept] / shares[kept].sum()


class ColoredExploration:
    """The noise that an agent explores with: a :class:`NoiseProcess` per environment.

    The process begins anew with every episode. At a fixed state the distribution of actions is
    unchanged, but successive actions correlate. Updates and ``predict`` use independent noise.

    The settings are the agent's attributes ``action_noise_color`` and
    ``action_noise_correlation_time``; white noise needs no process.

    References:
        Pink Noise Is All You Need (Eberhard et al., 2023).
    """

    def __init__(self) -> None:
        self.process: NoiseProcess | None = None

    def fit(self, agent: OffPolicyAlgorithm, n_envs: int, env: Any) -> None:
        """Adopt the agent's present settings; a process that already has them continues.

        The time limit of the environment, if there is one, sets the horizon.
        """
        color, correlation_time = (
            check(name, getattr(agent, name)) for name, check in SETTINGS.items()
        )
        if color == 0 and correlation_time is None:
            self.process = None
            return
        if color != 0 and correlation_time is not None:
            raise ValueError(
                "action_noise_color must be 0 where action_noise_correlation_time is given, "
                f"got {color} and {correlation_time}"
            )
        actor = agent.policy.actor
        if not isinstance(actor, FlowActor):
            raise ValueError(
                "action_noise_color must be 0 unless the policy is one of sb3_flowpolicy's with "
                f"use_sde=False, got {color} with {type(actor).__name__}"
            )
        horizon = episode_length(env)
        new = NoiseProcess(actor.density.noise_dim, n_envs, color, correlation_time, horizon)
        if self.process is None or self.process.settings != new.settings:
            self.process = new

    def next(self) -> th.Tensor | None:
        """Return the next noise (N, M) to act with; None for white noise."""
        process = self.process
        return None if process is None else process.step(th.randn(process.white_shape))

    def restart(self, ended: np.ndarray | None = None) -> None:
        """Begin anew in environments whose episode ended, boolean (N,); default: all."""
        if self.process is not None:
            self.process.restart(ended)

    def state(self) -> dict[str, th.Tensor] | None:
        """Return what a checkpoint stores."""
        return None if self.process is None else self.process.state()

    def load_state(self, state: dict[str, th.Tensor] | None) -> None:
        """Restore what :meth:`state` returned."""
        if self.process is not None and state is not None:
            self.process.load_state(state)


def episode_length(env: Any) -> int | None:
    """Return the time limit of episodes in steps, None without one."""
    steps = None
    if not isinstance(env, VecEnv):
        steps = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    # gymnasium's TimeLimit. A spec may hold objects that cannot be sent from another process.
    elif env.has_attr("_max_episode_steps"):
        steps = env.get_attr("_max_episode_steps")[0]
    elif isinstance(env.unwrapped, BatchedVecEnv):
        steps = getattr(env.get_attr("spec")[0], "max_episode_steps", None)
    return steps if steps is None or steps >= 2 else None
