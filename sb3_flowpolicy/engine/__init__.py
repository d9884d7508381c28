"""The updates of SAC, TQC, CrossQ (for one seed or several) and PPO as functions of tensors."""

from sb3_flowpolicy.engine.engine import Engine
from sb3_flowpolicy.engine.runtime import EngineRuntime
from sb3_flowpolicy.engine.update import LOSSES

__all__ = ["LOSSES", "Engine", "EngineRuntime"]
