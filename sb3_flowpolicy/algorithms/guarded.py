"""An off-policy algorithm that stores nothing, and ends with nothing, that is not finite."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.engine import LOSSES
from sb3_flowpolicy.guard.finite import ENVIRONMENT, NonFiniteError, check_experience, check_step
from sb3_flowpolicy.guard.training_guard import TrainingGuard

# The critics first: means over several updates do not tell which loss was the first.
_NAMES = sorted(LOSSES, key="critic_loss".__ne__)


class Guarded(OffPolicyAlgorithm):
    """Mixin for SAC and its kin, to be named before them and before ``Resumable``.

    What environments hand out is looked at before it is stored, and losses, weights and optimisers
    by a :class:`~sb3_flowpolicy.guard.training_guard.TrainingGuard`.

    Args:
        *args: Arguments of the algorithm.
        **kwargs: Keyword arguments of the algorithm.

    Example:
        >>> from sb3_flowpolicy import TQCFlow
        >>> model = TQCFlow("FlowPolicy", "Pendulum-v1", learning_starts=9)
        >>> _ = model.critic.qf0[0].bias.data.fill_(float("inf"))
        >>> model.learn(20)
        Traceback (most recent call last):
        ...
        sb3_flowpolicy.guard.finite.NonFiniteError: critic.qf0.0.bias must be finite, got inf ...
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._guard = TrainingGuard([self])
        super().__init__(*args, **kwargs)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        found = super()._setup_learn(*args, **kwargs)
        self._guard.restart()
        checkpoints = getattr(self, "_checkpoints", None)
        self._guard.resume_from = None if checkpoints is None else checkpoints.path
        normalized = self._vec_normalize_env is not None
        first = self._last_original_obs if normalized else self._last_obs
        check_experience({"observations": first}, self.num_timesteps, ENVIRONMENT)
        return found

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        seen, earned = new_obs, reward
        if self._vec_normalize_env is not None:  # which would clip infinity
            seen, earned = self._vec_normalize_env.old_obs, self._vec_normalize_env.old_reward
        check_step(seen, earned, dones, infos, self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do ``gradient_steps`` updates of the algorithm's own, and look at their losses.

        Raises:
            NonFiniteError: If one is not finite; weights are as at the last look, 2000 updates ago
                at most.
        """
        if gradient_steps == 0:  # of no losses SB3 logs the mean, NaN
            return
        self._guard.before_updates()
        super().train(gradient_steps, batch_size)
        logged = self.logger.name_to_value
        losses = {f"train/{name}": logged.get(f"train/{name}", 0.0) for name in _NAMES}
        try:
            self._guard.after_updates(_NAMES, [[loss] for loss in losses.values()])
        except NonFiniteError:
            for name in losses:  # or they would be taken for those of updates to come
                logged.pop(name, None)
            raise

    def _on_learning_end(self) -> None:
        self._guard.look()

    def _extra_state(self) -> dict[str, Any]:
        self._guard.look()  # no checkpoint is spoiled
        return super()._extra_state()  # type: ignore[misc]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_guard"]
