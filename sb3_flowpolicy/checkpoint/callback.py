"""Checkpoints by callback: from a hyperparameter file, say."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_flowpolicy.checkpoint.resumable import Resumable
from sb3_flowpolicy.checkpoint.session import check_every, start_checkpoints
from sb3_flowpolicy.checkpoint.store import has_checkpoint


class RunCheckpointCallback(BaseCallback):
    """What ``SACFlow.learn(checkpoint_every=..., checkpoint_path=...)`` does, as a callback.

    SB3's ``CheckpointCallback`` saves models to act with; this one saves runs to go on with.

    Args:
        checkpoint_every: Environment steps between two checkpoints, at least 1.
        checkpoint_path: Folder for the checkpoints.
        resume: Whether a new model goes on from the folder's newest checkpoint, if there is one:
            the same command, given again, then continues the run.

    Raises:
        ValueError: If ``checkpoint_every`` is below 1; when learning starts, if the model is not
            resumable or the folder holds checkpoints of another run.
    """

    def __init__(
        self, checkpoint_every: int, checkpoint_path: str | Path, resume: bool = False
    ) -> None:
        super().__init__()
        self.checkpoint_every = check_every(checkpoint_every)
        self.checkpoint_path = checkpoint_path
        self.resume = resume

    def _init_callback(self) -> None:
        if not isinstance(self.model, Resumable):
            raise ValueError(
                "RunCheckpointCallback needs a model that can be resumed, such as SACFlow, got "
                f"{type(self.model).__name__}"
            )
        is_new = self.model._checkpoints is None and self.model._resumption is None
        if self.resume and is_new and has_checkpoint(self.checkpoint_path):
            self.model._resume_in_place(self.checkpoint_path)
        start_checkpoints(self.model, self.checkpoint_path, self.checkpoint_every)

    def _on_step(self) -> bool:
        return True
