"""What the off-policy algorithms that run on the engine share."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback, TrainFreq

from sb3_flowpolicy.algorithms.off_policy import SETTINGS, OffPolicyFlow
from sb3_flowpolicy.common.validation import check_settings, either, flag
from sb3_flowpolicy.engine import LOSSES, Engine, EngineRuntime, build_engine, why_unsupported
from sb3_flowpolicy.engine.update import Objective
from sb3_flowpolicy.guard.finite import check_observation
from sb3_flowpolicy.policies.base import check_finite

MOST_DRAWN_AT_ONCE = 1000

SelfEngineFlow = TypeVar("SelfEngineFlow", bound="EngineFlow")


class EngineFlow(OffPolicyFlow):
    """Mixin for off-policy algorithms whose updates and acting are compiled.

    An algorithm says by :meth:`objective` what it does with its critics. While it learns, an
    :class:`~sb3_flowpolicy.engine.EngineRuntime` binds it to the engine.

    Args:
        *args: Arguments of the algorithm.
        compile: Whether to compile the update: several times faster after 10 to 30 seconds of
            warm-up. ``"auto"`` compiles once calls of :meth:`learn` have planned enough updates to
            repay it. Compiled or not, the numbers are the same.
        autocast: Whether matrix products run in bfloat16 (``torch.autocast``). On processors that
            support it, networks of 128 units or more train 1.2 to 1.6 times as fast, small ones
            slower. Parameters, optimizer states and replay stay float32; products keep 8 bits.
        **kwargs: Keyword arguments of the algorithm and of :class:`OffPolicyFlow`.

    Raises:
        ValueError: If an argument is out of range.
    """

    settings: ClassVar = {**SETTINGS, "compile": either("auto", flag), "autocast": flag}
    random_steps: int | None = None
    """Environment steps with random actions at the start; None stands for ``learning_starts``."""

    def __init__(
        self,
        *args: Any,
        compile: bool | Literal["auto"] = "auto",
        autocast: bool = False,
        **kwargs: Any,
    ) -> None:
        check_settings({"compile": compile, "autocast": autocast}, self.settings)
        self.compile: bool | Literal["auto"] = compile
        self.autocast = autocast
        self._runtime = EngineRuntime([self], why_unsupported, build_engine, warn_of_stock_loop)
        super().__init__(*args, **kwargs)

    @abstractmethod
    def objective(self) -> Objective:
        """Return what the algorithm makes of its critics' outputs, from its present settings."""

    def learn(
        self: SelfEngineFlow,
        total_timesteps: int,
        callback: MaybeCallback = None,
        *args: Any,
        **kwargs: Any,
    ) -> SelfEngineFlow:
        """Train; the arguments are those of :meth:`OffPolicyFlow.learn`."""
        with self._runtime.running(watched=callback is not None):
            return super().learn(total_timesteps, callback, *args, **kwargs)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Choose actions, as in SB3.

        While the model learns with a compiled policy, callbacks such as ``EvalCallback`` act with
        it, too, if they evaluate as many environments at once as the model learns from.
        """
        is_base = not deterministic or getattr(self.policy, "deterministic_mode", "base") == "base"
        if is_base and self._runtime.is_running and isinstance(observation, np.ndarray | dict):
            engine = self._runtime.engine()
            if engine is not None and engine.compiled:
                obs, is_batch = self.policy.obs_to_tensor(observation)
                check_observation(observation)
                rows = engine.networks.observations.pack(obs)
                scaled = self._act_compiled(engine, rows, deterministic)
                if scaled is not None:
                    check_finite(scaled)
                    actions = self.policy.unscale_action(scaled)
                    return (actions if is_batch else actions.squeeze(axis=0)), state
        return super().predict(observation, state, episode_start, deterministic)

    def _act_compiled(
        self, engine: Engine, obs: th.Tensor, deterministic: bool
    ) -> np.ndarray | None:
        """Return scaled actions, None if there is no compiled function for them."""
        obs = obs.unsqueeze(0).contiguous()
        if not engine.has_compiled_policy(obs):
            return None
        noise = None
        if deterministic:  # the mode is the image of no noise
            actor, shape = engine.networks.actor.data, (*obs.shape[:2], engine.networks.noise_dim)
            noise = actor.new_zeros(shape)
        return engine.act(obs, noise).cpu().numpy().reshape(-1, *(self.action_space.shape or ()))

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        self._runtime.plan(self._n_updates, self._planned_updates(total_timesteps))
        return total_timesteps, callback

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        random_steps = learning_starts if self.random_steps is None else self.random_steps
        engine = None
        if self.num_timesteps >= random_steps and self._runtime.is_running:
            engine = self._runtime.engine()
        if engine is None or not engine.compiled:
            return super()._sample_action(random_steps, action_noise, n_envs)
        obs = engine.networks.observations.pack(self._last_obs, self.device)
        noise = self._exploration.next()
        if noise is not None:
            noise = noise.to(engine.networks.actor.data).unsqueeze(0)
        scaled = engine.act(obs.unsqueeze(0), noise).squeeze(0).cpu().numpy()
        return self._finish_action(scaled, action_noise, n_envs)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do ``gradient_steps`` updates with minibatches of ``batch_size`` transitions.

        The numbers are those of the stock algorithm's ``train``. Models that the engine does not
        support (image observations, optimizers other than Adam, ...) use the stock loop.

        Raises:
            NonFiniteError: If a loss is not finite; weights are then as they were when the guard
                last checked them.
        """
        with self._runtime.running():
            engine = self._runtime.engine()
            if engine is None:
                return self._train_with_sb3(gradient_steps, batch_size)
            self._update_learning_rate(list(self.optimizers().values()))
            # Minibatches are drawn for many updates at once, but not for all of an offline run.
            for start in range(0, gradient_steps, MOST_DRAWN_AT_ONCE):
                n_updates = min(MOST_DRAWN_AT_ONCE, gradient_steps - start)
                self._guard.before_updates()
                batches = engine.draw(n_updates, batch_size)
                losses = engine.train(batches, start).tolist()
                self._n_updates += n_updates
                self._guard.after_updates(LOSSES, losses, engine.history, batches)
                self.record_losses(losses, names=engine.logged)

    def _train_with_sb3(self, gradient_steps: int, batch_size: int) -> None:
        """Run the stock algorithm's loop."""
        super().train(gradient_steps, batch_size)

    def record_losses(
        self,
        losses: Sequence[Sequence[float]],
        seed: int = 0,
        names: Sequence[str] = LOSSES,
    ) -> None:
        """Record what SB3's ``train`` records: the engine's losses, (4, S), of one seed."""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, values in zip(LOSSES, losses, strict=True):
            if key in names and (key != "ent_coef_loss" or self.ent_coef_optimizer is not None):
                self.logger.record(f"train/{key}", values[seed])

    def _planned_updates(self, total_timesteps: int) -> float:
        """Count the updates still to come; an estimate where episodes decide."""
        steps = max(0, total_timesteps - max(self.num_timesteps, self.learning_starts))
        if self.gradient_steps < 0:
            return steps
        assert isinstance(self.train_freq, TrainFreq)
        return steps / self.env.num_envs * self.gradient_steps / self.train_freq.frequency

    def _stateful_parts(self) -> dict[str, Any]:
        return {**super()._stateful_parts(), "engine": self._runtime}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_runtime"]


def warn_of_stock_loop(reason: str) -> None:
    """Say that the engine does not support something."""
    warnings.warn(
        f"training runs the stock loop, which is slower: the engine does not support {reason}",
        UserWarning,
        stacklevel=5,
    )
