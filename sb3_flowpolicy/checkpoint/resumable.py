"""An off-policy algorithm whose runs can be taken up again exactly where they stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.checkpoint.environments import check_same_build
from sb3_flowpolicy.checkpoint.segments import Ring, RingOwner
from sb3_flowpolicy.checkpoint.session import (
    Checkpoints,
    Resumption,
    between_rollouts,
    finishing,
    load_agent,
    open_checkpoint,
    start_checkpoints,
    take_up,
)
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.engine.replay import COLUMNS, is_plain

SelfResumable = TypeVar("SelfResumable", bound="Resumable")


class Resumable(OffPolicyAlgorithm):
    """Mixin for SB3's off-policy algorithms, to be named before them.

    Checkpoints are taken, and taken up, between rollouts: all of a run's state is then in objects,
    none in local variables.
    """

    _checkpoints: Checkpoints | None = None
    _resumption: Resumption | None = None

    @classmethod
    def resume(
        cls: type[SelfResumable],
        path: str | Path,
        env: GymEnv | str,
        device: th.device | str = "auto",
    ) -> SelfResumable:
        """Take a run up where its newest undamaged checkpoint stands.

        Make the interrupted call of :meth:`learn` again, with the same arguments: it goes on to the
        same end, and all numbers are those of a run that was not interrupted. Checkpoints contain
        pickles: do not resume those of strangers.

        Args:
            path: Folder of checkpoints.
            env: A new environment, built and wrapped as the run's own, or its id. It takes over the
                state of that one, the running episode included, and its ``Monitor`` file.
            device: Where to put the networks.

        Returns:
            The model.

        Raises:
            ValueError: If the folder holds no undamaged checkpoint, or one of another algorithm, or
                the environment does not fit.
        """
        store, checkpoint = open_checkpoint(path, cls.__name__)
        venv = cls._wrap_env(maybe_make_env(env, 0))
        model = load_agent(cls, checkpoint, "model", venv, device)
        model._resumption = take_up(model._describe_run(), store, checkpoint)
        return model

    def _resume_in_place(self, path: str | Path) -> None:
        """Become the agent of the newest checkpoint, while :meth:`learn` is being set up."""
        store, checkpoint = open_checkpoint(path, type(self).__name__)
        check_same_build(self.env, checkpoint.manifest["layers"]["model"])
        archive = checkpoint.folder / "model.zip"
        _, parameters, variables = load_from_zip_file(archive, device=self.device)
        try:
            self.set_parameters(parameters, device=self.device)
            for name, value in (variables or {}).items():
                if value is not None:
                    getattr(self, name).data.copy_(value.data)
        except (AttributeError, KeyError, RuntimeError, ValueError) as error:
            raise ValueError(
                f"model must be built with the settings of the run in {path}: {error}"
            ) from error
        self._resumption = take_up(self._describe_run(), store, checkpoint)
        if self._last_obs is None:
            assert self.env is not None
            self._last_obs = self.env.reset()  # type: ignore[assignment]

    def learn(
        self: SelfResumable,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint_every: int | None = None,
        checkpoint_path: str | Path | None = None,
    ) -> SelfResumable:
        """Train as in SB3, and write checkpoints to resume from.

        Args:
            total_timesteps: As in SB3, as are the following.
            callback: Called at every step.
            log_interval: Episodes between two dumps of the log.
            tb_log_name: Name of the TensorBoard run; default: the algorithm's.
            reset_num_timesteps: Whether to count from zero.
            progress_bar: Whether to show one.
            checkpoint_every: Environment steps between two checkpoints that :meth:`resume` goes on
                from. Ctrl-C and SIGTERM then write one, too, before they stop the program. Default:
                none are written.
            checkpoint_path: Folder for them, empty for a new run.

        Returns:
            Itself.

        Raises:
            ValueError: If only one of the last two is given, or the folder holds checkpoints of
                another run.
        """
        with finishing(self):
            start_checkpoints(self, checkpoint_path, checkpoint_every)
            super().learn(
                total_timesteps,
                callback,
                log_interval,
                tb_log_name or type(self).__name__,
                reset_num_timesteps,
                progress_bar,
            )
            self._on_learning_end()
        return self

    def _on_learning_end(self) -> None:
        """Do what a subclass wants done when :meth:`learn` has come to its end."""

    def _describe_run(self) -> Run:
        """Describe what a checkpoint of this model consists of."""
        return Run(
            kind=type(self).__name__,
            agents={"model": self},
            environments={"model": self.env},
            ring=self._ring,
            extra=self._extra_state,
            set_extra=self._set_extra_state,
        )

    def _ring(self) -> tuple[RingOwner, Ring] | None:
        buffer = self.replay_buffer
        if buffer is None or not is_plain(buffer):
            return None
        columns = {name: getattr(buffer, name) for name in COLUMNS}
        return buffer, Ring(columns, buffer.pos, buffer.full)

    def _extra_state(self) -> dict[str, Any]:
        """Return what a subclass has to note besides, between two rollouts."""
        return {}

    def _set_extra_state(self, state: dict[str, Any]) -> None:
        """Put back what :meth:`_extra_state` returned."""

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self._resumption is not None:
            total_timesteps = self._resumption.remaining(total_timesteps, reset_num_timesteps)
            reset_num_timesteps = False
        return super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        """Collect experience as SB3 does, after a look at whether a checkpoint is due."""
        if not between_rollouts(self, {"model": callback}):
            return RolloutReturn(0, 0, continue_training=False)
        return super().collect_rollouts(env, callback, *args, **kwargs)

    def get_parameters(self) -> dict[str, dict]:
        """Return the parameters as SB3 does, but copies that share no memory with others."""
        return _copies(super().get_parameters())

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_checkpoints", "_resumption"]


def _copies(value: Any) -> Any:
    """Copy tensors, where views would bring the whole memory that they look at into a file."""
    if isinstance(value, th.Tensor):
        return value.detach().clone()
    if isinstance(value, dict):
        return type(value)((key, _copies(part)) for key, part in value.items())
    return [_copies(part) for part in value] if isinstance(value, list) else value
