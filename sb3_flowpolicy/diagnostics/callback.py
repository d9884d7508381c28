"""A callback that logs the policy's action distribution to TensorBoard."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.diagnostics.figures import correlation_figure, samples_figure
from sb3_flowpolicy.policies import DistributionPolicy, FlowActor
from sb3_flowpolicy.policies.deterministic import critic_values

DASHBOARD: dict[str, dict[str, list]] = {
    "Learning": {
        "return (training: with exploration, test: deterministic)": [
            "Multiline",
            ["rollout/ep_rew_mean", "eval/mean_reward"],
        ],
        "success rate": ["Multiline", ["rollout/success_rate", "eval/success_rate"]],
    },
    "Exploration": {
        "entropy (nats)": ["Multiline", ["policy/entropy"]],
        "entropy coefficient": ["Multiline", ["train/ent_coef"]],
        "standard deviation of each action": ["Multiline", [r"policy/scale_\d+"]],
        "mean absolute correlation of actions": ["Multiline", ["policy/mean_abs_correlation"]],
    },
    "Stability": {
        "Q": ["Multiline", ["value/q_policy", "value/q_buffer"]],
        "losses": ["Multiline", ["train/critic_loss", "train/actor_loss"]],
        "steps per second": ["Multiline", ["time/fps"]],
    },
}
"""Category -> chart -> [kind, tags] of TensorBoard's custom-scalars page."""

# SB3's text formats reject figures.
_TEXT_FORMATS = ("stdout", "log", "json", "csv")


class PolicyDiagnosticsCallback(BaseCallback):
    """Log entropy, standard deviation, correlation and value of the policy's actions.

    The callback measures at states of the replay buffer with its own random numbers, so a run is
    the same with and without it. Its dashboard on TensorBoard's custom-scalars page also shows the
    return and success rate that SB3 and ``EvalCallback`` log. The TensorBoard guide lists the keys.

    Args:
        log_freq: Environment steps between two measurements, at least 1.
        image_freq: Environment steps between two sets of pictures, each with a measurement; 0
            for no pictures.
        n_states: Number of states, at least 1.
        n_samples: Number of actions per state, at least 2.

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1", learning_starts=50)
        >>> callback = PolicyDiagnosticsCallback(log_freq=100, image_freq=0)
        >>> _ = model.learn(150, callback=callback)
    """

    model: OffPolicyAlgorithm

    def __init__(
        self,
        log_freq: int = 1000,
        image_freq: int = 10_000,
        n_states: int = 256,
        n_samples: int = 64,
    ) -> None:
        super().__init__()
        self.log_freq = integer(1)("log_freq", log_freq)
        self.image_freq = integer(0)("image_freq", image_freq)
        self.n_states = integer(1)("n_states", n_states)
        self.n_samples = integer(2)("n_samples", n_samples)

    def _on_training_start(self) -> None:
        actor = getattr(self.model, "actor", None)  # on-policy algorithms have none
        self._actor = actor if isinstance(actor, FlowActor) else None
        if self._actor is None and isinstance(self.model.policy, DistributionPolicy):
            warnings.warn(
                "PolicyDiagnosticsCallback records nothing with gSDE (use_sde=True)",
                UserWarning,
                stacklevel=2,
            )
            return
        if self._actor is None:
            raise ValueError(
                "PolicyDiagnosticsCallback needs a policy of sb3_flowpolicy, off-policy, "
                f"got {type(self.model.policy).__name__}"
            )
        for output in self.logger.output_formats:
            if isinstance(output, TensorBoardOutputFormat):
                output.writer.add_custom_scalars(DASHBOARD)

    def _on_step(self) -> bool:
        buffer = self.model.replay_buffer
        is_early = self.num_timesteps <= self.model.learning_starts
        if is_early or buffer is None or self._actor is None:
            return True
        draw = self.image_freq > 0 and self._due(self.image_freq)
        if draw or self._due(self.log_freq):
            with self._own_random_numbers(), th.no_grad():
                data = buffer.sample(self.n_states, env=self.model.get_vec_normalize_env())
                self._measure(self._actor, data.observations, data.actions, draw)
        return True

    def _due(self, freq: int) -> bool:
        """Whether the last step, of any number of environments, crossed a multiple of ``freq``."""
        return self.num_timesteps % freq < self.training_env.num_envs

    def _measure(
        self, actor: FlowActor, obs: PyTorchObs, buffer_actions: th.Tensor, draw: bool
    ) -> None:
        critic = cast("ContinuousCritic", self.model.policy.critic)
        was_training = self.model.policy.training
        self.model.policy.set_training_mode(False)
        context = actor.context(obs)
        noise = actor.density.draw_noise(context, self.n_samples)
        actions, log_prob = actor.density.rsample_and_log_prob(context, noise)
        correlation = actor.action_correlation(obs, self.n_samples).abs().mean(0)
        features = critic.extract_features(obs, critic.features_extractor)
        q_policy = critic_values(critic, features, actions[0])
        q_buffer = critic_values(critic, features, buffer_actions)
        self.model.policy.set_training_mode(was_training)

        record = self.logger.record
        record("policy/entropy", -log_prob.mean().item())
        for i, scale in enumerate(actions.std(0).mean(0).tolist()):
            record(f"policy/scale_{i}", scale)
        record("value/q_policy", q_policy.mean().item())
        record("value/q_buffer", q_buffer.mean().item())
        n_dims = len(correlation)
        if n_dims > 1:
            off_diagonal = (correlation.sum() - n_dims) / (n_dims * (n_dims - 1))
            record("policy/mean_abs_correlation", off_diagonal.item())
        if draw and n_dims > 1:
            figure = correlation_figure(correlation.cpu().numpy())
            record("policy/correlation", Figure(figure, close=True), exclude=_TEXT_FORMATS)
        if draw and n_dims == 2:
            figure = samples_figure(actions[:, :4].movedim(0, 1).cpu().numpy())
            record("policy/samples", Figure(figure, close=True), exclude=_TEXT_FORMATS)

    @contextmanager
    def _own_random_numbers(self) -> Iterator[None]:
        """Restore the global generators, so that measuring does not change the run."""
        state = np.random.get_state()  # noqa: NPY002 (SB3's buffers draw from the global state)
        with th.random.fork_rng(
            devices=[self.model.device] if self.model.device.type == "cuda" else []
        ):
            try:
                yield
            finally:
                np.random.set_state(state)  # noqa: NPY002
