"""The SAC update as a pure function of tensors: eager, compiled, or stacked over seeds."""

from sb3_flowpolicy.engine.engine import Engine, update_settings, why_unsupported
from sb3_flowpolicy.engine.update import Losses

__all__ = ["Engine", "Losses", "update_settings", "why_unsupported"]
