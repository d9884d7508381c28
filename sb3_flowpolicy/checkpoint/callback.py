"""Checkpoints as a callback, for example in a hyperparameter file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_flowpolicy.checkpoint.environments import check_same_build
from sb3_flowpolicy.checkpoint.session import RunCheckpoints, open_checkpoint
from sb3_flowpolicy.checkpoint.store import has_checkpoint
from sb3_flowpolicy.common.validation import integer


class RunCheckpointCallback(BaseCallback):
    """Write checkpoints as ``SACFlow.learn(checkpoint_every=..., checkpoint_path=...)`` does.

    SB3's ``CheckpointCallback`` saves models to act with; this one saves runs to resume.

    Args:
        checkpoint_every: Environment steps between two checkpoints, at least 1.
        checkpoint_path: Folder for the checkpoints.
        resume: Whether a new model continues from the folder's newest checkpoint, if there is one.
            The same command, given again, then continues the run.

    Raises:
        ValueError: If ``checkpoint_every`` is below 1; when learning starts, if the model cannot be
            resumed or the folder holds checkpoints of another run.
    """

    def __init__(
        self, checkpoint_every: int, checkpoint_path: str | Path, resume: bool = False
    ) -> None:
        super().__init__()
        self.checkpoint_every = integer(1)("checkpoint_every", checkpoint_every)
        self.checkpoint_path = Path(checkpoint_path)
        self.resume = resume

    def _init_callback(self) -> None:
        checkpoints = getattr(self.model, "_checkpoints", None)
        if not isinstance(checkpoints, RunCheckpoints):
            raise ValueError(
                "RunCheckpointCallback needs a model that can be resumed, such as SACFlow, got "
                f"{type(self.model).__name__}"
            )
        is_new = checkpoints.path is None and not checkpoints.resuming
        if self.resume and is_new and has_checkpoint(self.checkpoint_path):
            _resume_in_place(self.model, checkpoints, self.checkpoint_path)
        checkpoints.start(self.checkpoint_path, self.checkpoint_every)

    def _on_step(self) -> bool:
        return True


def _resume_in_place(model: Any, checkpoints: RunCheckpoints, path: Path) -> None:
    """Turn a new model into the agent of the newest checkpoint, during the setup of ``learn``."""
    checkpoint = open_checkpoint(path, type(model).__name__)
    check_same_build(model.env, checkpoint.manifest["layers"]["model"])
    archive = checkpoint.folder / "model.zip"
    _, parameters, variables = load_from_zip_file(archive, device=model.device)
    try:
        model.set_parameters(parameters, device=model.device)
        for name, value in (variables or {}).items():
            if value is not None:
                getattr(model, name).data.copy_(value.data)
    except (AttributeError, KeyError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"model must be built with the settings of the run in {path}: {error}"
        ) from error
    checkpoints.load(checkpoint)
    if model._last_obs is None:
        model._last_obs = model.env.reset()
