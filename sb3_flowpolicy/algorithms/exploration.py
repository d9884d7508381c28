"""Exploration that goes somewhere: noise that correlates in time, for off-policy algorithms."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.algorithms.noise_process import NoiseProcess, check_color
from sb3_flowpolicy.common.vec_env import BatchedVecEnv
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.policies.off_policy import check_finite_actions


class ColoredExploration(OffPolicyAlgorithm):
    """Mixin for SB3's off-policy algorithms, to be named before them.

    While experience is collected, the density's noise comes from a :class:`NoiseProcess` per
    environment, which begins anew with every episode: at a fixed state the distribution of actions
    is what it always is, but successive actions lean the same way. Updates and ``predict`` go on
    with independent noise.

    Args:
        *args: Arguments of the algorithm.
        action_noise_color: Exponent of the noise's spectrum, in [0, 1.5]: 0 is white, 1 pink.
        action_noise_correlation_time: Instead of a colour, steps after which the autocorrelation
            of an Ornstein-Uhlenbeck process has fallen to 1/e, above 0.
        **kwargs: Keyword arguments of the algorithm.

    Raises:
        ValueError: If one is out of range, both are given, or the policy has no density of ours.

    References:
        Pink Noise Is All You Need (Eberhard et al., 2023).

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1", action_noise_color=1.0, random_steps=10)
        >>> _ = model.learn(20)
    """

    def __init__(
        self,
        *args: Any,
        action_noise_color: float = 0.0,
        action_noise_correlation_time: float | None = None,
        **kwargs: Any,
    ) -> None:
        check_color(action_noise_color, action_noise_correlation_time, "action_noise_")
        self.action_noise_color = action_noise_color
        self.action_noise_correlation_time = action_noise_correlation_time
        self._noise_process: NoiseProcess | None = None
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.fit_noise_process(None, self.n_envs, self.env)  # raises what is wrong with it

    def fit_noise_process(
        self, process: NoiseProcess | None, n_envs: int, env: Any
    ) -> NoiseProcess | None:
        """Return a process of the present settings; None for white noise.

        Args:
            process: One that was used so far; returned if it still fits.
            n_envs: Number of environments.
            env: What steps them, for the length of its episodes.

        Raises:
            ValueError: If settings are out of range, or the policy has no density of ours.
        """
        color, correlation_time = self.action_noise_color, self.action_noise_correlation_time
        check_color(color, correlation_time, "action_noise_")
        if color == 0 and correlation_time is None:
            return None
        actor = self.policy.actor
        if not isinstance(actor, FlowActor):
            raise ValueError(
                "action_noise_color must be 0 unless the policy is one of sb3_flowpolicy's with "
                f"use_sde=False, got {color} with {type(actor).__name__}"
            )
        new = NoiseProcess(
            actor.density.noise_dim, n_envs, color, correlation_time, _episode_length(env)
        )
        return process if process is not None and process.settings == new.settings else new

    def _exploration_noise(self) -> th.Tensor | None:
        """Return the next noise (N, M) to act with; None where it is white."""
        process = self._noise_process
        return None if process is None else process.step(th.randn(process.white_shape))

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        before = self._last_obs
        found = super()._setup_learn(*args, **kwargs)
        process = self.fit_noise_process(self._noise_process, self.n_envs, self.env)
        if process is not None and self._last_obs is not before:
            process.restart()  # environments were reset
        self._noise_process = process
        return found

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        warms_up = self.num_timesteps < learning_starts
        noise = None if warms_up else self._exploration_noise()
        if noise is None:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        # As SB3, only that the noise is given.
        self.policy.set_training_mode(False)
        obs, _ = self.policy.obs_to_tensor(self._last_obs)  # type: ignore[arg-type]
        actor = self.policy.actor
        assert isinstance(actor, FlowActor)
        with th.no_grad():
            scaled = actor(obs, noise=noise.to(next(actor.parameters()))).cpu().numpy()
        return self._finished(scaled, action_noise, n_envs)

    def _finished(
        self, scaled: np.ndarray, action_noise: ActionNoise | None, n_envs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return actions for the environment and for the replay buffer."""
        check_finite_actions(scaled)
        scaled = scaled.reshape(n_envs, *(self.action_space.shape or ()))
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise(), -1, 1)
        return self.policy.unscale_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: Any,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        if self._noise_process is not None:
            self._noise_process.restart(dones)


def _episode_length(env: Any) -> int | None:
    """Return after how many steps episodes are cut, None where nobody says."""
    steps = None
    if not isinstance(env, VecEnv):
        steps = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    # gymnasium's TimeLimit. A spec may hold what cannot be sent from another process.
    elif env.has_attr("_max_episode_steps"):
        steps = env.get_attr("_max_episode_steps")[0]
    elif isinstance(env.unwrapped, BatchedVecEnv):
        steps = getattr(env.get_attr("spec")[0], "max_episode_steps", None)
    return steps if steps is None or steps >= 2 else None
