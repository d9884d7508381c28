"""SACFlow: SB3's SAC with the options of the thesis."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq
from stable_baselines3.sac.policies import SACPolicy

from sb3_flowpolicy.algorithms.demonstrations import (
    fill_replay_buffer,
    follow_recipe,
    is_recipe,
    load_demonstrations,
)
from sb3_flowpolicy.algorithms.exploration import ColoredExploration
from sb3_flowpolicy.algorithms.guarded import Guarded
from sb3_flowpolicy.bundle.shareable import Shareable
from sb3_flowpolicy.checkpoint import Resumable
from sb3_flowpolicy.common.settings import (
    assertions_as_value_errors,
    by_name,
    check_policy,
    check_settings,
)
from sb3_flowpolicy.engine import LOSSES, Engine, settings_key, why_unsupported
from sb3_flowpolicy.engine.subnormals import flushed_subnormals
from sb3_flowpolicy.policies import sac
from sb3_flowpolicy.policies.off_policy import DistributionPolicy

# SB3 halves the squared error, spinningup (and the thesis) does not.
SB3_CRITIC_LOSS_COEF = 0.5
# Compiling takes 10 to 30 seconds and saves one to five milliseconds per update.
UPDATES_WORTH_COMPILING = 10_000
MOST_DRAWN_AT_ONCE = 1000


class SACFlow(Guarded, Resumable, Shareable, ColoredExploration, SAC):
    r"""Soft Actor-Critic with action distributions that correlate and bend.

    Everything of SB3's :class:`~stable_baselines3.SAC` holds. In particular a fixed temperature
    is ``ent_coef=0.01``, a learned one ``ent_coef="auto"`` with any ``target_entropy``, and
    weight decay goes through ``policy_kwargs=dict(optimizer_kwargs=dict(weight_decay=...))``.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, ``"GaussPolicy"``,
            their ``Cnn...`` and ``MultiInput...`` forms, or a policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *sac_args: Further arguments of SB3's SAC, in its order: ``learning_rate``, ...
        random_steps: Number of environment steps with uniformly random actions at the start.
            Default: ``learning_starts``, as in SB3, where one number decides both when random
            actions end and when updates begin (thesis: "initial random steps", "update after").
        demonstrations: Transitions to put into the replay buffer before learning, as an
            ``.npz`` file or as arrays; see :meth:`add_demonstrations`. Or how to record them,
            ``{"controller": "flowpolicy_envs.Holder", "n_steps": 4000}``; see
            :func:`~sb3_flowpolicy.algorithms.demonstrations.follow_recipe`.
        critic_loss_coef: Factor of the critics' summed mean squared error, above 0: 0.5 as in
            SB3, or 1.0 as in spinningup and the thesis. With Adam the factor cancels but for
            weight decay, which weighs half as much at 1.0.
        compile: Whether to compile the update: several times faster after 10 to 30 seconds of
            warm-up. ``"auto"`` does as soon as calls of :meth:`learn` plan enough updates to repay
            it. Compiled or not, the numbers are the same.
        autocast: Whether matrix products run in bfloat16 (``torch.autocast``), on processors that
            have it 1.2 to 1.6 times as fast for networks of 128 units or more, and slower for small
            ones. Parameters, optimiser states and replay stay float32; products keep 8 bits.
        action_noise_color: Exponent of the spectrum of the noise to explore with, in [0, 1.5]: 0 is
            white, 1 pink. Successive actions then lean the same way, while at a fixed state they
            are distributed as ever; see
            :class:`~sb3_flowpolicy.algorithms.exploration.ColoredExploration`.
        action_noise_correlation_time: Instead of a colour, the correlation time of an
            Ornstein-Uhlenbeck process in steps, above 0.
        **sac_kwargs: Keyword arguments of SB3's SAC.

    Raises:
        ValueError: If an argument is out of range, the environment's action space is no Box
            with finite bounds, or demonstrations are incomplete.

    References:
        Soft Actor-Critic Algorithms and Applications (Haarnoja et al., 2018); thesis
        Algorithm 2 and sections 2.2 and 3.3.3.

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1", ent_coef=0.1, random_steps=20, seed=0)
        >>> _ = model.learn(30)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = sac.ALIASES

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        *sac_args: Any,
        random_steps: int | None = None,
        demonstrations: str | Path | Mapping[str, Any] | None = None,
        critic_loss_coef: float = SB3_CRITIC_LOSS_COEF,
        compile: bool | Literal["auto"] = "auto",
        autocast: bool = False,
        action_noise_color: float = 0.0,
        action_noise_correlation_time: float | None = None,
        **sac_kwargs: Any,
    ) -> None:
        check_policy(policy, SACPolicy, self.policy_aliases)
        check_settings(
            {
                **by_name(SAC, (policy, env, *sac_args), sac_kwargs),
                "random_steps": random_steps,
                "critic_loss_coef": critic_loss_coef,
                "compile": compile,
                "autocast": autocast,
                "action_noise_color": action_noise_color,
                "action_noise_correlation_time": action_noise_correlation_time,
            }
        )
        self.random_steps = random_steps
        self.critic_loss_coef = critic_loss_coef
        self.compile: bool | Literal["auto"] = compile
        self.autocast = autocast
        self._worth_compiling = False
        self._planned = 0.0
        self._engine: Engine | None = None
        self._engine_refused = False
        self._demonstrations: Any = (
            demonstrations
            if demonstrations is None or is_recipe(demonstrations)
            else load_demonstrations(demonstrations)
        )
        with assertions_as_value_errors():
            super().__init__(
                policy,
                env,
                *sac_args,
                action_noise_color=action_noise_color,
                action_noise_correlation_time=action_noise_correlation_time,
                **sac_kwargs,
            )

    def add_demonstrations(self, demonstrations: str | Path | Mapping[str, np.ndarray]) -> int:
        """Append transitions to the replay buffer (thesis section 3.3.3).

        Args:
            demonstrations: Path of an ``.npz`` file, or a mapping, with the arrays
                ``observations``, ``actions`` (in the environment's units), ``rewards``,
                ``next_observations``, ``terminations`` and ``truncations``, one row per step, as
                :func:`~sb3_flowpolicy.algorithms.demonstrations.record_demonstrations` returns.

        Returns:
            Number of transitions that were added.

        Raises:
            ValueError: If arrays are missing or of different lengths, do not fit into the
                buffer, or the buffer is of a kind that cannot take them.
        """
        if self.replay_buffer is None:
            raise ValueError("demonstrations need a model that has its replay buffer, got None")
        return fill_replay_buffer(
            self.replay_buffer, self.policy, load_demonstrations(demonstrations)
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self.replay_buffer is None:
            raise ValueError("learn() needs a replay buffer: give env to load_safe to train on")
        # Here and not at construction: a model that is loaded to act needs no demonstrations.
        if self._demonstrations is not None:
            if is_recipe(self._demonstrations):
                assert self.env is not None
                recorded = follow_recipe(self._demonstrations, self.env, self.seed)
                self._demonstrations = recorded
            self.add_demonstrations(self._demonstrations)
            self._demonstrations = None
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        # Many short calls of learn(), with tests in between say, are a long run as well; a resumed
        # one was counted when it began.
        if self._resumption is None:
            self._planned += self._planned_updates(total_timesteps)
        self._worth_compiling = self._planned >= UPDATES_WORTH_COMPILING
        self._engine_refused = False
        if why_unsupported(self) is not None:
            self._drop_engine()
        if self._engine is not None:
            self._engine.synchronize()
        return total_timesteps, callback

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        random_steps = learning_starts if self.random_steps is None else self.random_steps
        engine = self._engine
        if self.num_timesteps < random_steps or engine is None or not engine.compiled:
            return super()._sample_action(random_steps, action_noise, n_envs)
        # What SB3 does, less what it spends on finding out that the observation is an array.
        obs = th.as_tensor(self._last_obs, device=self.device)
        noise = self._exploration_noise()
        if noise is not None:
            noise = noise.to(engine.networks.actor.data).unsqueeze(0)
        scaled = engine.act(obs.unsqueeze(0), noise).squeeze(0).cpu().numpy()
        return self._finished(scaled, action_noise, n_envs)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do ``gradient_steps`` updates with minibatches of ``batch_size`` transitions.

        The numbers are those of SB3's ``SAC.train``. Models that the engine cannot do (image
        observations, optimisers other than Adam, ...) take SB3's own loop.
        """
        engine = self._ready_engine()
        if engine is not None and engine.synchronize() and why_unsupported(self) is not None:
            self._drop_engine()
            engine = self._ready_engine()
        if engine is None:
            return self._train_with_sb3(gradient_steps, batch_size)
        self._update_learning_rate(self.optimizers())
        # Minibatches are drawn for many updates at once, but not for all of an offline run.
        for start in range(0, gradient_steps, MOST_DRAWN_AT_ONCE):
            n_updates = min(MOST_DRAWN_AT_ONCE, gradient_steps - start)
            self._guard.before_updates()
            batches = engine.draw(n_updates, batch_size)
            losses = engine.train(batches, start).tolist()
            self._n_updates += n_updates
            self._guard.after_updates(LOSSES, losses, engine.history, batches)
            self.record_losses(losses)

    def optimizers(self) -> list[th.optim.Optimizer]:
        """Return what follows the learning rate; the temperature has one only if learned."""
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        return optimizers + ([self.ent_coef_optimizer] if self.ent_coef_optimizer else [])

    def record_losses(self, losses: Sequence[Sequence[float]], seed: int = 0) -> None:
        """Record what SB3's ``train`` records: the engine's losses, (4, S), of one seed."""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, values in zip(LOSSES, losses, strict=True):
            if key != "ent_coef_loss" or self.ent_coef_optimizer is not None:
                self.logger.record(f"train/{key}", values[seed])

    def _ready_engine(self) -> Engine | None:
        """Return an engine that fits the model's present settings, None if there can be none."""
        if self._engine_refused:
            return None
        compiled = self._worth_compiling if self.compile == "auto" else bool(self.compile)
        engine = self._engine
        # Compiled once is compiled for good: there is nothing to gain by going back.
        if (
            engine is not None
            and (engine.compiled or not compiled)
            and engine.autocast == self.autocast
            and engine.settings_key == settings_key(self, self.critic_loss_coef)
            and engine.belongs_to([self])
        ):
            return engine
        self._drop_engine()
        reason = why_unsupported(self)
        if reason is not None:
            self._engine_refused = True
            warnings.warn(
                f"training runs SB3's own loop, which is slower: the engine does not do {reason}",
                UserWarning,
                stacklevel=3,
            )
            return None
        self._engine = Engine([self], self.critic_loss_coef, compiled, self.autocast)
        return self._engine

    def _drop_engine(self) -> None:
        """Let go of an engine that does not fit: acting with it would be acting on old weights."""
        if self._engine is not None:
            self._engine.release()
            self._engine = None

    def _train_with_sb3(self, gradient_steps: int, batch_size: int) -> None:
        """Run SB3's loop, with the critic's gradient scaled to ``critic_loss_coef``."""
        factor = self.critic_loss_coef / SB3_CRITIC_LOSS_COEF

        def scale_gradient(optimizer: th.optim.Optimizer, *_: Any) -> None:
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    if parameter.grad is not None:
                        parameter.grad.mul_(factor)

        hook = self.critic.optimizer.register_step_pre_hook(scale_gradient)
        try:
            with flushed_subnormals():
                super().train(gradient_steps, batch_size)
        finally:
            hook.remove()
        self.logger.name_to_value["train/critic_loss"] *= factor

    def _planned_updates(self, total_timesteps: int) -> float:
        """Count the updates that are still to come, roughly where episodes decide."""
        steps = max(0, total_timesteps - max(self.num_timesteps, self.learning_starts))
        if self.gradient_steps < 0:
            return steps
        assert isinstance(self.train_freq, TrainFreq)
        return steps / self.env.num_envs * self.gradient_steps / self.train_freq.frequency

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """Save as SB3 does; a ``deterministic_mode`` that was set later on is saved as well."""
        if isinstance(self.policy, DistributionPolicy):
            self.policy_kwargs = self.policy.up_to_date(self.policy_kwargs)
        super().save(path, exclude, include)

    def _extra_state(self) -> dict[str, Any]:
        # Whoever acts with an engine draws other numbers than whoever acts without.
        return {**super()._extra_state(), "engine": self._engine is not None}

    def _set_extra_state(self, state: dict[str, Any]) -> None:
        if state["engine"]:
            self._ready_engine()

    def _excluded_save_params(self) -> list[str]:
        engine = ["_engine", "_engine_refused", "_worth_compiling", "_planned"]
        return [*super()._excluded_save_params(), "_demonstrations", *engine]
