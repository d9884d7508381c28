"""Exploration with noise that correlates in time, for off-policy algorithms."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.algorithms.noise_process import MAX_COLOR, NoiseProcess
from sb3_flowpolicy.common.validation import Check, number, optional
from sb3_flowpolicy.common.vec_env import BatchedVecEnv
from sb3_flowpolicy.policies import FlowActor

SETTINGS: dict[str, Check] = {
    "action_noise_color": number(0, MAX_COLOR),
    "action_noise_correlation_time": optional(number(0, above=True)),
}
"""Attributes of an agent, with their checks."""


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

        The environment, if it is known, tells how long episodes are.
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
        horizon = _episode_length(env)
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
            self.process.set_state(state)


def _episode_length(env: Any) -> int | None:
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
