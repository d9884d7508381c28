"""SACFlow: SB3's SAC with the options of the thesis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_flowpolicy.algorithms.demonstrations import (
    fill_replay_buffer,
    follow_recipe,
    is_recipe,
    load_demonstrations,
)
from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.bundle import load_bundle, save_bundle
from sb3_flowpolicy.common.validation import check_settings, integer, number, optional
from sb3_flowpolicy.engine.sac import SB3_CRITIC_LOSS_COEF, SACObjective
from sb3_flowpolicy.policies import sac

if TYPE_CHECKING:
    from typing_extensions import Self


class SACFlow(EngineFlow, SAC):
    r"""Soft Actor-Critic with action distributions that correlate and bend.

    Everything of SB3's :class:`~stable_baselines3.SAC` holds: ``ent_coef=0.01`` fixes the entropy
    coefficient, ``ent_coef="auto"`` learns it for any ``target_entropy``, and weight decay goes
    through ``policy_kwargs=dict(optimizer_kwargs=dict(weight_decay=...))``.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, ``"GaussPolicy"``,
            their ``Cnn...`` and ``MultiInput...`` forms, or a policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *sac_args: Further arguments of SB3's SAC, in its order: ``learning_rate``, ...
        random_steps: Number of environment steps with uniformly random actions at the start.
            Default: ``learning_starts``; in SB3 that number decides both when random actions end
            and when updates begin (thesis: "initial random steps", "update after").
        demonstrations: Transitions to put into the replay buffer before learning, as an
            ``.npz`` file or as arrays; see :meth:`add_demonstrations`. Or how to record them,
            ``{"controller": "flowpolicy_envs.Holder", "n_steps": 4000}``; see
            :func:`~sb3_flowpolicy.algorithms.demonstrations.follow_recipe`.
        critic_loss_coef: Factor of the critics' summed mean squared error, above 0: 0.5 as in
            SB3, or 1.0 as in spinningup and the thesis. With Adam the factor cancels except for
            weight decay, which weighs half as much at 1.0.
        compile: Whether to compile the update: several times faster after 5 to 30 seconds of
            warm-up. ``"auto"`` compiles once calls of :meth:`learn` have planned enough updates to
            repay it. Compiled or not, the numbers are the same up to rounding.
        autocast: Whether matrix products run in bfloat16 (``torch.autocast``). On processors that
            support it, networks of 128 units or more train 1.2 to 1.6 times as fast, small ones
            slower. Parameters, optimizer states and replay stay float32; products keep 8 bits.
        action_noise_color: Exponent of the spectrum of the exploration noise, in [0, 1.5]: 0 is
            white, 1 pink. Successive actions then correlate, while their distribution at a fixed
            state is unchanged; see
            :class:`~sb3_flowpolicy.algorithms.exploration.ColoredExploration`.
        action_noise_correlation_time: Instead of a color, the correlation time of an
            Ornstein-Uhlenbeck process in steps, above 0.
        **sac_kwargs: Keyword arguments of SB3's SAC.

    Raises:
        ValueError: If an argument is out of range, or demonstrations are incomplete.

    References:
        Soft Actor-Critic Algorithms and Applications (Haarnoja et al., 2018); thesis
        Algorithm 2 and sections 2.2 and 3.3.3.

    Example:
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1", ent_coef=0.1, random_steps=20, seed=0)
        >>> _ = model.learn(30)
    """

    stock = SAC
    settings: ClassVar = {
        **EngineFlow.settings,
        "random_steps": optional(integer(0)),
        "critic_loss_coef": number(0, above=True),
    }
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = sac.ALIASES
    #: Statistics of ``VecNormalize`` from a bundle that was loaded without an environment.
    normalization: VecNormalize | None = None

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        *sac_args: Any,
        random_steps: int | None = None,
        demonstrations: str | Path | Mapping[str, Any] | None = None,
        critic_loss_coef: float = SB3_CRITIC_LOSS_COEF,
        **sac_kwargs: Any,
    ) -> None:
        own = {"random_steps": random_steps, "critic_loss_coef": critic_loss_coef}
        check_settings(own, self.settings)
        self.random_steps = random_steps
        self.critic_loss_coef = critic_loss_coef
        if demonstrations is not None and not is_recipe(demonstrations):
            demonstrations = load_demonstrations(demonstrations)
        self._demonstrations: Any = demonstrations
        super().__init__(policy, env, *sac_args, **sac_kwargs)

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
        rows = load_demonstrations(demonstrations)
        return fill_replay_buffer(self.replay_buffer, self.policy, rows)

    def save_safe(self, path: str | Path, vec_normalize: VecNormalize | None = None) -> Path:
        """Write a safe bundle: one file to share, as loading it executes no code.

        It holds the policy, target networks, optimizers, all settings, and the statistics of
        ``VecNormalize``, but not the replay buffer; see ``docs/guide/sharing.md``.

        Args:
            path: File to write, ``.safetensors`` if it has no suffix.
            vec_normalize: Statistics to include. Default: those of the model's environment.

        Raises:
            ValueError: If the model has a part that needs code, such as your own features
                extractor or a learning rate that is a function; the message names it.

        Example:
            >>> import tempfile
            >>> import numpy as np
            >>> from sb3_flowpolicy import SACFlow
            >>> model = SACFlow("FlowPolicy", "Pendulum-v1")
            >>> path = model.save_safe(tempfile.mkdtemp() + "/pendulum")
            >>> SACFlow.load_safe(path).predict(np.zeros(3), deterministic=True)[0].shape
            (1,)
        """
        return save_bundle(self, path, vec_normalize)

    @classmethod
    def load_safe(
        cls,
        path: str | Path,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
    ) -> Self:
        """Read a file of :meth:`save_safe` without executing anything that it names.

        Args:
            path: The file.
            env: Environment to train in, without ``VecNormalize``: the bundle's statistics, if
                any, are wrapped around it. Default: none, to predict only; normalize
                observations with ``model.normalization`` if that is not None.
            device: Device of the model.

        Raises:
            BundleError: A ``ValueError``, if the file is damaged or holds no such model.
            ValueError: If ``env`` has other spaces.
        """
        return load_bundle(cls, path, env, device)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        if self.replay_buffer is None:
            raise ValueError("learn() needs a replay buffer: give env to load_safe to train on")
        # Here and not at construction: a model that is loaded to act needs no demonstrations.
        if self._demonstrations is not None:
            rows = self._demonstrations
            if is_recipe(rows):
                assert self.env is not None
                rows = follow_recipe(self.env, self.seed, **rows)
            self.add_demonstrations(rows)
            self._demonstrations = None
        return super()._setup_learn(*args, **kwargs)

    def objective(self) -> SACObjective:
        """Return SAC's objective, with the present ``critic_loss_coef``."""
        return SACObjective(self.critic_loss_coef)

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
            super()._train_with_sb3(gradient_steps, batch_size)
        finally:
            hook.remove()
        self.logger.name_to_value["train/critic_loss"] *= factor

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_demonstrations"]
