"""Complete checkpoints: a resumed run equals one that was not interrupted."""

from sb3_flowpolicy.checkpoint.callback import RunCheckpointCallback
from sb3_flowpolicy.checkpoint.session import RunCheckpoints
from sb3_flowpolicy.checkpoint.store import has_checkpoint

__all__ = ["RunCheckpointCallback", "RunCheckpoints", "has_checkpoint"]
