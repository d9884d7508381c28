"""Runs that go on exactly where they stopped: checkpoints that hold everything."""

from sb3_flowpolicy.checkpoint.callback import RunCheckpointCallback
from sb3_flowpolicy.checkpoint.resumable import Resumable
from sb3_flowpolicy.checkpoint.store import has_checkpoint

__all__ = ["Resumable", "RunCheckpointCallback", "has_checkpoint"]
