"""The engine of PPO: binds a policy to one flat tensor, acts, updates, and releases it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples

from sb3_flowpolicy.engine.adam import FlatAdam, adam_settings
from sb3_flowpolicy.engine.compiling import Compiled, Compiler
from sb3_flowpolicy.engine.flat import FlatParameters
from sb3_flowpolicy.engine.ppo_update import (
    PPO_LOSSES,
    PPOSettings,
    make_ppo_update,
    policy_function,
)
from sb3_flowpolicy.engine.runtime import BoundEngine, Place, why_network_unsupported
from sb3_flowpolicy.guard.finite import NonFiniteError, check_finite
from sb3_flowpolicy.policies.on_policy import DensityActorCritic


class PPOEngine(BoundEngine):
    """Acts with and updates the policy of one PPOFlow model."""

    def __init__(self, models: Sequence[PPO], compiled: bool = False) -> None:
        super().__init__(models, compiled)
        (model,) = models
        policy = model.policy
        assert isinstance(policy, DensityActorCritic)
        self.model, self.policy = model, policy
        names = {f"module.{name}": [value] for name, value in policy.named_parameters()}
        self.flat = FlatParameters([names])
        self.adam = FlatAdam(self.flat, [policy.optimizer])
        self.acting_parts = [self.flat]
        self.parts = [self.flat, self.adam]
        places: list[Place] = [(vars(model), "policy"), (vars(policy), "optimizer")]
        for module in policy.modules():
            places += [(module._parameters, name) for name in module._parameters]
        self._note(places)
        self.compiler = Compiler(self.flat.data.device, enabled=compiled)
        update = make_ppo_update(policy, self.flat, self.settings)
        self._update = Compiled(update, "the PPO update", self.compiler)
        act = policy_function(policy, self.flat, "sample_and_score")
        self._act = Compiled(act, "the policy", self.compiler)
        self._is_watched = True

    @staticmethod
    def why_unsupported(model: PPO) -> str | None:
        """Return which part of a model the engine does not support, or None."""
        if not isinstance(model.policy, DensityActorCritic):
            return f"policy of type {type(model.policy).__name__}"
        if type(model.rollout_buffer) is not RolloutBuffer:
            return f"rollout buffer of type {type(model.rollout_buffer).__name__}"
        return why_network_unsupported(model.policy)

    @staticmethod
    def settings_of(model: PPO) -> PPOSettings:
        """Return the constants of a model's update."""
        return PPOSettings(
            adam_settings(model.policy.optimizer),  # type: ignore[arg-type]
            model.ent_coef,
            model.vf_coef,
            model.max_grad_norm,
            model.normalize_advantage,
            model.clip_range_vf is not None,
            model.target_kl,
        )

    @contextmanager
    def collecting(self, watched: bool = True) -> Iterator[None]:
        """Let the policy's ``forward`` run compiled, ``watched`` if callbacks may change it."""
        self._is_watched = watched
        self.policy.forward = self.act  # type: ignore[method-assign]
        try:
            yield
        finally:
            del self.policy.forward

    @th.no_grad()
    def act(
        self, obs: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return actions, values and log-probabilities, as the policy's ``forward`` does."""
        # An engine for the policy as it is now follows at the next rollout.
        is_outdated = self._is_watched and not self._has_same_things()
        if deterministic or is_outdated:
            return type(self.policy).forward(self.policy, obs, deterministic)
        if self._is_watched:
            self.synchronize()
        noise = self.policy.draw_noise(len(obs))
        key = (obs.shape, obs.dtype)
        actions, values, log_prob = self._act(key, self.flat.data, obs, noise)
        check_finite(actions.cpu().numpy())
        return actions, values, log_prob

    def train(self, clip_range: float, clip_range_vf: float) -> dict[str, list[float]]:
        """Do the updates of one rollout.

        Args:
            clip_range: Bound on the change of an action's probability ratio.
            clip_range_vf: Bound on the change of values, if the model clips them.

        Returns:
            Name -> one number per minibatch, of ``PPO_LOSSES``; the estimates of the KL divergence
            are those of the last epoch, as in SB3.

        Raises:
            NonFiniteError: If a log-probability is not finite: that minibatch changed nothing.
        """
        model, target_kl = self.model, self.settings.target_kl
        rate = self.policy.optimizer.param_groups[0]["lr"]
        scalars = th.tensor([rate, clip_range, clip_range_vf], dtype=th.float64)
        scalars = scalars.to(self.flat.data.device)
        found: list[th.Tensor] = []
        start_of_epoch, stopped = 0, False
        for epoch in range(model.n_epochs):
            start_of_epoch = len(found)
            for samples in model.rollout_buffer.get(model.batch_size):
                found.append(self._update_once(samples, scalars))
                if target_kl is not None and found[-1][3] > 1.5 * target_kl:
                    stopped = True
                    break
            model._n_updates += 1
            if stopped:
                if model.verbose >= 1:
                    kl = float(found[-1][3])
                    print(f"Early stopping at step {epoch} due to reaching max kl: {kl:.2f}")
                break
        *columns, finite = th.stack(found).T.tolist()
        if not all(finite):
            raise NonFiniteError(
                "observation and weights must be finite, got log-probabilities with NaN or infinity"
            )
        losses = dict(zip(PPO_LOSSES, columns, strict=True))
        losses["approx_kl"] = losses["approx_kl"][start_of_epoch:]
        return losses

    def _update_once(self, samples: RolloutBufferSamples, scalars: th.Tensor) -> th.Tensor:
        size = len(samples.actions)
        noise = self.policy.draw_entropy_noise(size) if self.settings.ent_coef else None
        arguments = (self.flat.data, self.adam.moments, samples, noise, scalars)
        # The rest of a rollout that does not fill a minibatch is not worth a graph of its own.
        if size < self.model.batch_size:
            return self._update.function(*arguments)
        return self._update(size, *arguments)
