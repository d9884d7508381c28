"""PPOFlow: SB3's PPO with our policies by name."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import explained_variance

from sb3_flowpolicy.algorithms.engine_flow import warn_of_stock_loop
from sb3_flowpolicy.common.validation import (
    Check,
    by_name,
    check_policy,
    check_settings,
    either,
    flag,
    integer,
    number,
    optional,
    or_infinity,
    or_schedule,
)
from sb3_flowpolicy.engine import EngineRuntime
from sb3_flowpolicy.engine.ppo_engine import PPOEngine
from sb3_flowpolicy.guard.finite import NonFiniteError, all_finite
from sb3_flowpolicy.policies import on_policy

_SETTINGS: dict[str, Check] = {
    "n_steps": integer(1),
    "batch_size": integer(1),
    "n_epochs": integer(1),
    "gamma": number(0, 1),
    "gae_lambda": number(0, 1),
    "clip_range": or_schedule(number(0, above=True)),
    "clip_range_vf": optional(or_schedule(number(0, above=True))),
    "normalize_advantage": flag,
    "ent_coef": number(0),
    "vf_coef": number(0),
    "max_grad_norm": or_infinity(number(0, above=True)),
    "target_kl": optional(number(0, above=True)),
    "stats_window_size": integer(1),
    "seed": optional(integer(0, 2**32 - 1)),
    "compile": either("auto", flag),
}


class PPOFlow(PPO):
    """Proximal Policy Optimization with action distributions that correlate and bend.

    SB3's :class:`~stable_baselines3.PPO` with additional policy aliases and compiled updates.

    Policies have the names of those of :class:`~sb3_flowpolicy.SACFlow`. There is no colored noise:
    PPO's ratios assume that successive actions are independent.

    Args:
        *args: Arguments of PPO, in its order.
        compile: Whether to compile updates and the policy that collects experience: several times
            faster after about 15 seconds of warm-up. ``"auto"`` compiles once calls of
            :meth:`learn` have planned enough updates to repay it. Compiled or not, the numbers are
            the same up to rounding. Policies and buffers that the engine does not support (with
            dropout, frozen parameters, dictionary observations, ...) run the stock loop.
        **kwargs: Keyword arguments of PPO.

    Raises:
        ValueError: If an argument is out of range.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017).

    Example:
        >>> model = PPOFlow("FlowPolicy", "Pendulum-v1", n_steps=64, seed=0).learn(64)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = on_policy.ALIASES

    def __init__(self, *args: Any, compile: bool | Literal["auto"] = "auto", **kwargs: Any) -> None:
        given = by_name(PPO, args, kwargs)
        check_settings({**given, "compile": compile}, _SETTINGS)
        check_policy(given.get("policy"), ActorCriticPolicy, self.policy_aliases)
        self.compile: bool | Literal["auto"] = compile
        self._runtime = EngineRuntime([self], PPOEngine, warn_of_stock_loop)
        super().__init__(*args, **kwargs)

    def learn(
        self, total_timesteps: int, callback: MaybeCallback = None, *args: Any, **kwargs: Any
    ) -> Any:
        """Learn as SB3's PPO does, compiled where that pays."""
        with self._runtime.running(watched=callback is not None):
            return super().learn(total_timesteps, callback, *args, **kwargs)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        rollout = self.n_steps * self.n_envs
        rollouts = math.ceil((total_timesteps - self.num_timesteps) / rollout)
        minibatches = math.ceil(rollout / self.batch_size)
        # SB3 counts epochs as updates.
        done, updates = self._n_updates, rollouts * self.n_epochs
        self._runtime.plan(done * minibatches, updates * minibatches)
        return total_timesteps, callback

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        """Collect experience as SB3 does."""
        acts = self._runtime.is_running and self._runtime.compiles
        engine = self._runtime.engine() if acts else None
        if engine is None:
            return super().collect_rollouts(*args, **kwargs)
        with engine.collecting(self._runtime.is_watched):
            return super().collect_rollouts(*args, **kwargs)

    def train(self) -> None:
        """Do PPO's updates.

        Raises:
            NonFiniteError: If a reward or a value of the rollout is not finite; nothing is learned
                from that rollout.
        """
        for name in ("rewards", "values"):
            found = getattr(self.rollout_buffer, name)
            if not all_finite(found):
                value = float(found[~np.isfinite(found)][0])
                raise NonFiniteError(
                    f"{name} must be finite, got {value} in the rollout that ends at step "
                    f"{self.num_timesteps}; nothing was learned from it"
                )
        # Otherwise a tenth of the time would go into an entropy that is multiplied by 0.
        if isinstance(self.policy, on_policy.DensityActorCritic):
            self.policy.action_dist.estimates_entropy = self.ent_coef != 0.0
        with self._runtime.running():
            engine = self._runtime.engine()
            if engine is None:
                super().train()
            else:
                self._train_with(engine)

    def _train_with(self, engine: PPOEngine) -> None:
        """Do and record what SB3's ``train`` does and records."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        clip_range_vf = math.inf
        if self.clip_range_vf is not None:
            clip_range_vf = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
        losses = engine.train(clip_range, clip_range_vf)
        last = losses.pop("loss")[-1]
        for name, values in losses.items():
            self.logger.record(f"train/{name}", np.mean(values))
        self.logger.record("train/loss", last)
        buffer = self.rollout_buffer
        variance = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if self.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_runtime"]
