"""Training never stores, or continues with, NaN or infinity."""

from sb3_flowpolicy.guard.finite import NonFiniteError
from sb3_flowpolicy.guard.training_guard import TrainingGuard

__all__ = ["NonFiniteError", "TrainingGuard"]
